"""Verification of a project's exports: what lies on the disk is read anew and checked.

Files and their form, counts that agree, numbers that are finite, the same points in every cloud, the reprojection
errors computed anew from COLMAP's text, the inlier rate that the adjustment recorded; then the CRS and the place on
earth (see `_place.py`).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxba._errors import JaxbaError
from jaxba.engine._parameters import Parameters, parameter
from jaxba.engine._project import Project
from jaxba.engine._stage import Pipeline
from jaxba.engine._store import damaged_file, load, read_record
from jaxba.report.verification._check import Check, failed, judged, ok, skipped
from jaxba.report.verification._exported import (
    BINARY,
    CLOUDS,
    DESCRIPTION,
    FRAME,
    OPENSFM,
    SITES,
    TEXT,
    TILE,
    Exported,
    read_export,
)
from jaxba.scene import Finding

if TYPE_CHECKING:
    from jaxba.ba import Problem

_ROUNDING = 0.002  # units of the CRS: CSV has three decimals, LAZ whole thousandths
_CURE = "run again to export it anew"
_POOR = "see `jaxba diagnose`"


@dataclass(frozen=True, kw_only=True)
class Params(Parameters):
    """What the user may set."""

    max_median_px: float = parameter(
        1.0, low=0.1, high=5, help="the most that the median reprojection error may be, px"
    )
    min_inlier_rate: float = parameter(0.9, low=0.5, high=1, help="the least share of observations that fit")


def verify(folder: Path, pipeline: Pipeline, params: Params) -> list[Check]:
    """Check the exports of a project.

    Raises `JaxbaError` where the folder is no project, or nothing was exported yet.
    """
    from jaxba.report.verification._place import place_checks  # loads pyproj

    project = Project(folder, make=False)
    record = project.stage("export")
    if read_record(record) is None:
        raise JaxbaError(
            f"{folder}: nothing was exported yet; let `jaxba run` end first, `jaxba status` tells how far."
        )
    written = load(record, pipeline["export"].module.Outputs)
    exported, schema = read_export(project.export, written.files)
    record = project.stage("adjust")
    adjusted = load(record, pipeline["adjust"].module.Outputs) if read_record(record) else None
    return [
        _files(project.export, written),
        *schema,
        *_counts(exported),
        *_finite(exported),
        _same_points(exported, adjusted),
        _median(exported, params),
        _inliers(adjusted, params),
        *place_checks(project, pipeline, exported, _moved_m(adjusted)),
    ]


def exported_findings(folder: Path, pipeline: Pipeline) -> tuple[Finding, ...]:
    """Return what the adjustment found of the block that was exported; none where its record is gone."""
    record = Project(folder, make=False).stage("adjust")
    return load(record, pipeline["adjust"].module.Outputs).findings if read_record(record) else ()


def _moved_m(adjusted: Any | None) -> np.ndarray:
    """Return what the measured positions are off from the block, where control holds that."""
    if adjusted is None:
        return np.zeros(3)
    return np.nan_to_num(adjusted.gnss_minus_control_m)


def _files(folder: Path, written: Any) -> Check:
    """All files are there and hold something; one that was changed since is named, and judged by its contents alone."""
    missing = [name for name in written.files if not (folder / name).is_file()]
    empty = [name for name in written.files if name not in missing and not (folder / name).stat().st_size]
    wrong = [f"{name} is missing" for name in missing] + [f"{name} is empty" for name in empty]
    if wrong:
        return failed("files", f"{', '.join(wrong)}, of {len(written.files)} files; {_CURE}.")
    sums = zip(written.files, written.sha256, strict=True)
    changed = [name for name, checksum in sums if damaged_file(folder, {name: checksum})]
    unread = [name for name in changed if name.startswith(f"{BINARY}/")]  # of which no more than the head is read
    if unread:
        return failed("files", f"{', '.join(unread)} changed since they were written; {_CURE}.")
    since = f"; changed since they were written: {', '.join(changed)}" if changed else ""
    return ok("files", f"{len(written.files)} files, none empty{since}")


def _counts(exported: Exported) -> Iterator[Check]:
    points = {name: exported[name].cloud.num_points for name in CLOUDS if exported.has(name)}
    images = {name: int(exported[name].is_registered.sum()) for name in SITES if exported.has(name)}
    observations = {name: int(exported[name].cloud.track_length.sum()) for name in CLOUDS if exported.has(name)}
    if exported.has(DESCRIPTION):
        points[DESCRIPTION] = exported[DESCRIPTION]["points"]
    if exported.has(TEXT):
        block = exported[TEXT].block
        points[TEXT], images[TEXT], observations[TEXT] = block.num_points, block.num_images, block.num_observations
    if exported.has(BINARY):
        points[BINARY], images[BINARY] = exported[BINARY].num_points, exported[BINARY].num_images
    if exported.has(OPENSFM):
        points[OPENSFM], images[OPENSFM] = len(exported[OPENSFM]["points"]), len(exported[OPENSFM]["shots"])
    if exported.has(TILE):
        images[TILE] = exported[TILE].num_images
        points[TILE], observations[TILE] = _without_marked(exported[TILE])
    for what, counts in (("points", points), ("images", images), ("observations", observations)):
        name = f"counts {what}"
        if len(counts) < 2:
            yield skipped(name, "fewer than two files that tell it could be read")
            continue
        texts = ", ".join(f"{file} {count:,}" for file, count in counts.items())
        same = f"{next(iter(counts.values())):,} in each of {len(counts)} files"
        yield judged(name, len(set(counts.values())) == 1, same, f"the files disagree: {texts}; {_CURE}.")


def _without_marked(tile: "Problem") -> tuple[int, int]:
    """Return the numbers of tie points and of their observations: a tile holds what marks show, too."""
    from jaxba.ba import ControlPointPrior, ScaleBarPrior

    marked = ControlPointPrior, ScaleBarPrior
    points = [np.asarray(vars(prior)["point_index"]) for prior in tile.priors if isinstance(prior, marked)]
    index = np.unique(np.concatenate([np.zeros(0, int), *points]))
    marks = np.isin(np.asarray(tile.observations.point_index), index)
    return tile.num_points - len(index), tile.num_observations - int(marks.sum())


def _finite(exported: Exported) -> Iterator[Check]:
    """Everything that must be a number is one; sigmas may be missing."""
    for file in CLOUDS:
        if exported.has(file):
            cloud = exported[file].cloud
            values = dict(zip("XYZ", cloud.xyz.T, strict=True)) | {"error_px": cloud.error_px}
            if file == "cloud.csv":
                stds = zip("xyz", cloud.std_m.T, strict=True)
                values |= {f"std_{axis}_m": np.where(np.isnan(std), 0.0, std) for axis, std in stds}
            yield _all_finite(file, values, [f"point {number}" for number in cloud.point_id])
    for file in SITES:
        if exported.has(file):
            sites = exported[file]
            error_px = np.where(sites.is_registered, sites.median_error_px, 0.0)
            values = dict(zip(("x", "y", "z"), sites.xyz.T, strict=True)) | {"median_error_px": error_px}
            yield _all_finite(file, values, sites.name)
    if exported.has(TEXT):
        model = exported[TEXT]
        block = model.block
        points = [f"POINT3D_ID {number + 1}" for number in range(block.num_points)]
        values = dict(zip("XYZ", block.points_m.T, strict=True)) | {"ERROR": model.error_px}
        yield _all_finite(f"{TEXT}/points3D.txt", values, points)
        cameras = [f"CAMERA_ID {name}" for name in block.camera_names]
        yield _all_finite(f"{TEXT}/cameras.txt", {"PARAMS": block.camera_parameters.sum(axis=1)}, cameras)
        seen = [model.names[row] for row in block.observation_image]
        yield _all_finite(f"{TEXT}/images.txt", dict(zip("XY", block.observation_xy_px.T, strict=True)), seen)
    if exported.has(OPENSFM):
        parts = exported[OPENSFM]
        xyz = np.array([point["coordinates"] for point in parts["points"].values()], float).reshape(-1, 3)
        poses = [[*shot["rotation"], *shot["translation"]] for shot in parts["shots"].values()]
        shots = np.array(poses, float).reshape(-1, 6).sum(axis=1)
        both = np.concatenate([xyz.sum(axis=1), shots])
        yield _all_finite(OPENSFM, {"coordinates or pose": both}, [*parts["points"], *parts["shots"]])


def _all_finite(file: str, values: dict[str, np.ndarray], names: Sequence[str]) -> Check:
    bad = {field: np.flatnonzero(~np.isfinite(column)) for field, column in values.items()}
    bad = {field: rows for field, rows in bad.items() if rows.size}
    count = sum(column.size for column in values.values())
    if not bad:
        return ok(f"numbers {file}", f"{count:,} values of {', '.join(values)}, all finite")
    field, rows = next(iter(bad.items()))
    total = sum(rows.size for rows in bad.values())
    return failed(
        f"numbers {file}",
        f"{field} of {names[rows[0]]} is {values[field][rows[0]]:g} ({total} of {count:,} values are not finite, in "
        f"{', '.join(bad)}); {_CURE}.",
    )


def _same_points(exported: Exported, adjusted: Any | None) -> Check:
    """Every cloud has the same points at the same coordinates, and COLMAP's points are those in the CRS.

    Where control was fitted by twelve parameters, the clouds are mapped by them and COLMAP's poses cannot be.
    """
    name, clouds = "same points", {file: exported[file].cloud for file in CLOUDS if exported.has(file)}
    places = {file: (cloud.point_id, cloud.xyz) for file, cloud in clouds.items()}
    if exported.has(TEXT, FRAME) and places:
        xyz_m = exported[TEXT].block.points_m
        if adjusted is not None and not np.array_equal(adjusted.affine, np.eye(3, 4)):
            xyz_m = xyz_m @ adjusted.affine[:, :3].T + adjusted.affine[:, 3]
        try:
            xyz = _in_crs(exported, xyz_m)
        except JaxbaError as error:
            return failed(name, f"{TEXT}: {error}")
        places[TEXT] = np.arange(1, len(xyz) + 1), xyz
    if len(places) < 2:
        return skipped(name, "fewer than two clouds could be read")
    (first, (ids, xyz)), *others = places.items()
    largest = 0.0
    for file, (other_ids, other_xyz) in others:
        order, other_order = np.argsort(ids, kind="stable"), np.argsort(other_ids, kind="stable")
        if len(ids) != len(other_ids) or np.any(ids[order] != other_ids[other_order]):
            return failed(name, f"{first} and {file} hold points of different numbers (PointID, point_id); {_CURE}.")
        with np.errstate(invalid="ignore"):
            apart = np.abs(xyz[order] - other_xyz[other_order]).max(axis=1)
        worst = int(np.nanargmax(apart)) if np.isfinite(apart).any() else 0
        if apart[worst] > _ROUNDING:
            return failed(
                name,
                f"point {ids[order][worst]} lies {apart[worst]:.3f} units of the CRS apart in {first} and {file} "
                f"(median {np.nanmedian(apart):.3f}, allowed {_ROUNDING:g}): one of the files was shifted or changed; "
                f"{_CURE}.",
            )
        largest = max(largest, float(apart[worst]))
    return ok(name, f"{len(ids):,} points at most {largest:.4f} units apart in {', '.join(places)}")


def _in_crs(exported: Exported, xyz_m: np.ndarray) -> np.ndarray:
    from jaxba.geo import projected_from_local

    return xyz_m if exported.frame is None else projected_from_local(exported.frame, xyz_m)


def _median(exported: Exported, params: Params) -> Check:
    """The median reprojection error, computed anew from the exported model."""
    name = "median error"
    if not exported.has(TEXT):
        return skipped(name, f"{TEXT} could not be read")
    error_px = _errors_px(exported)
    if not error_px.size:
        return failed(name, f"{TEXT}/images.txt holds no observation of a point; {_CURE}.")
    median = float(np.median(error_px))
    limit = f"verify.max_median_px={params.max_median_px:g}"
    figures = f"{median:.3f} px over {error_px.size:,} observations of {TEXT}"
    return judged(
        name,
        median <= params.max_median_px,
        f"{figures}, at most {limit}",
        f"{figures}, over {limit}: the model does not fit its photos; {_POOR}.",
    )


def _errors_px(exported: Exported) -> np.ndarray:
    from jaxba.ba import Observations, Problem, reprojection_errors  # loads jax
    from jaxba.geometry import CAMERAS, Pose

    block = exported[TEXT].block
    if not block.num_observations:
        return np.zeros(0)
    problem = Problem.build(
        Pose(block.quaternion, block.translation_m),
        CAMERAS[block.camera_model].from_parameters(block.camera_parameters),
        block.points_m,
        Observations(
            block.observation_xy_px,
            np.ones(block.num_observations),
            block.observation_image.astype(np.int32),
            block.observation_point.astype(np.int32),
        ),
        camera_index=block.camera_index.astype(np.int32),
    )
    return reprojection_errors(problem)


def _inliers(adjusted: Any | None, params: Params) -> Check:
    name = "inlier rate"
    if adjusted is None:
        return failed(name, "the record of the adjust stage is missing or damaged; run again to make it anew.")
    rate, limit = adjusted.inlier_rate, f"verify.min_inlier_rate={params.min_inlier_rate:g}"
    figures = f"{rate:.1%} of {adjusted.block.num_observations + adjusted.num_rejected:,} observations judged"
    return judged(
        name,
        rate >= params.min_inlier_rate,
        f"{figures}, at least {limit}",
        f"{figures}, under {limit}: {adjusted.num_rejected:,} were rejected; {_POOR}.",
    )
