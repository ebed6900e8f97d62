"""The section `audit` of a report as plain values: claims, faults, and what moved."""

from pathlib import Path
from typing import Any

import numpy as np

from jaxba.audit._claims import Claims
from jaxba.audit._faults import (
    image_limits,
    images_off,
    is_fault,
    is_off,
    num_parallel,
    wrong_limit_px,
    wrong_matches,
)
from jaxba.audit._moved import MovedImages, MovedIntrinsic
from jaxba.audit._readjust import Readjusted
from jaxba.report import sentence
from jaxba.scene import Block, Finding, Reconstruction


def section(
    path: Path,
    given: Reconstruction,
    claims: Claims,
    found: Readjusted,
    images: MovedImages,
    intrinsics: list[MovedIntrinsic],
    findings: tuple[Finding, ...],
    min_angle_deg: float,
) -> dict[str, Any]:
    """Return the section; its form is told in `jaxba/report/document/_audit_schema.py`."""
    faults = [finding for finding in findings if is_fault(finding)]
    return {
        "model": str(path),
        "program": given.program,
        "fault_count": len(faults),
        "faults": [{"kind": fault.kind, "text": sentence(fault)} for fault in faults],
        "claims": _claims(claims),
        "point_errors": _point_errors(given, claims),
        "observations": {
            "num": found.tracks.num_observations,
            "rejected": found.tracks.num_observations - found.outputs.block.num_observations,
            "wrong": int(wrong_matches(found).sum()),
            "wrong_limit_px": wrong_limit_px(found.outputs),
            "behind": int(claims.is_behind.sum()),
        },
        "points": {
            "num": found.start.num_points,
            "near_parallel": num_parallel(found, min_angle_deg),
            "min_angle_deg": min_angle_deg,
        },
        "intrinsics": _intrinsics(found, intrinsics),
        "images": _images(found, images),
        **dict(zip(("images_limit_sigma", "images_limit_px"), image_limits(images), strict=True)),
        "held": list(found.held),
    }


def _claims(claims: Claims) -> list[dict[str, Any]]:
    return [
        {
            "name": figure.name,
            "unit": figure.unit,
            "stated": figure.stated,
            "recomputed": figure.recomputed,
            "difference": figure.difference,
            "limit": figure.limit,
            "differs": figure.differs,
            "definition": figure.definition,
            "place": figure.place,
        }
        for figure in claims.figures
    ]


def _point_errors(given: Reconstruction, claims: Claims) -> dict[str, Any]:
    off = np.abs(given.point_error - claims.point_error)
    return {
        "stated": int(np.isfinite(given.point_error).sum()),
        "differing": int(claims.point_differs.sum()),
        "largest": float(np.nanmax(off)) if np.isfinite(off).any() else None,
        "unit": given.unit,
    }


def _intrinsics(found: Readjusted, intrinsics: list[MovedIntrinsic]) -> list[dict[str, Any]]:
    return [
        {
            "camera": one.camera,
            "name": one.name,
            "before": one.before,
            "after": one.after,
            "std": one.std,
            "over_sigma": one.over_sigma,
            "apart_px": one.apart_px,
            "off": is_off(found, one),
        }
        for one in intrinsics
    ]


def _images(found: Readjusted, images: MovedImages) -> list[dict[str, Any]]:
    block: Block = found.outputs.block
    off = images_off(images)
    return [
        {
            "name": found.photos[int(index)].name,
            "shift": float(images.shift[row]),
            "turn_deg": float(np.degrees(images.turn_rad[row])),
            "over_sigma": float(images.over_sigma[row]),
            "apart_px": float(images.apart_px[row]),
            "off": bool(off[row]),
        }
        for row, index in enumerate(block.image_index)
    ]
