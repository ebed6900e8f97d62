"""Findings of an audit in words: what is wrong with another program's result."""

import math
from collections.abc import Callable, Sequence

_MOST_NAMES = 10
_MOST_INTRINSICS = 4


def _note(text: str) -> str:
    return text


def _figure(value: float) -> str:
    return f"{value:,.0f}" if float(value).is_integer() else f"{value:.6g}"


def _claim_differs(name: str, unit: str, stated: float, recomputed: float, limit: float, place: str) -> str:
    of = f" {unit}" if unit else ""
    more = f", over the {limit:.2g}{of} that rounding explains" if limit else ""
    return (
        f"The files state {_figure(stated)}{of} for the {name}, and their own numbers give {_figure(recomputed)}{of}: "
        f"{abs(stated - recomputed):.4g}{of} apart{more} ({place}). The statement is of another state of the model: "
        "export it again."
    )


def _point_errors_differ(
    count: int, num_stated: int, name: str, stated: float, recomputed: float, unit: str, limit: float
) -> str:
    return (
        f"The errors that the files state of {count:,} of {num_stated:,} points are not those of their observations, "
        f"by more than {limit:.2g} {unit} and 1%: of point {name} {stated:.4g} {unit} are stated, {recomputed:.4g} "
        "computed. Points, poses or cameras were changed after they were written: export the model again."
    )


def _intrinsics_off(
    cameras: Sequence[str],
    parameters: Sequence[str],
    before: Sequence[float],
    after: Sequence[float],
    std: Sequence[float],
    over_sigma: Sequence[float],
    apart_px: Sequence[float],
    least_px: Sequence[float],
    limit_sigma: float,
) -> str:
    texts = [
        _intrinsic(*row)
        for row in zip(cameras, parameters, before, after, std, over_sigma, apart_px, least_px, strict=True)
    ]
    more = f"; and {len(texts) - _MOST_INTRINSICS:,} more" if len(texts) > _MOST_INTRINSICS else ""
    what = "An intrinsic is" if len(texts) == 1 else f"{len(texts):,} intrinsics are"
    return (
        f"{what} not what the model's own measurements say: {'; '.join(texts[:_MOST_INTRINSICS])}{more}. Limits are "
        f"{limit_sigma:g} sigmas, and the pixels that stand in brackets. Adjust the model again with "
        f"{'it' if len(texts) == 1 else 'these'} free, or compare with a calibration."
    )


def _intrinsic(
    camera: str,
    parameter: str,
    before: float,
    after: float,
    std: float,
    over_sigma: float,
    apart_px: float,
    least_px: float,
) -> str:
    is_focal = parameter in ("f", "fx", "fy")
    share = f", which is {before / after - 1:+.1%} off" if is_focal else ""
    return (
        f"{'focal length ' if is_focal else ''}{parameter} of camera {camera} is {before:.6g} where they give "
        f"{after:.6g} with a sigma of {std:.2g}{share}, {over_sigma:.1f} sigmas, and moves pixels by up to "
        f"{apart_px:.1f} ({least_px:.1f})"
    )


def _images_off(
    names: Sequence[str],
    shift: Sequence[float],
    turn_deg: Sequence[float],
    over_sigma: Sequence[float],
    apart_px: Sequence[float],
    unit: str,
    others_px: float,
    limit_sigma: float,
    least_px: float,
) -> str:
    rows = zip(names, shift, turn_deg, over_sigma, apart_px, strict=True)
    of = f" {unit}" if unit else " of its units"
    texts = [
        f"{name} (by {far:.3g}{of} and {turn:.2g} degrees, "
        + (f"{sigmas:.0f} sigmas, " if math.isfinite(sigmas) else "")
        + (f"{pixels:.0f} px)" if math.isfinite(pixels) else "behind its points)")
        for name, far, turn, sigmas, pixels in rows
    ]
    more = f" and {len(texts) - _MOST_NAMES:,} more" if len(texts) > _MOST_NAMES else ""
    one = len(texts) == 1
    return (
        f"{len(texts)} {'image does' if one else 'images do'} not stand where {'its' if one else 'their'} own "
        f"measurements put {'it' if one else 'them'}: {', '.join(texts[:_MOST_NAMES])}{more}. Limits are "
        f"{limit_sigma:.1f} sigmas and {least_px:.1f} px, where the median of all images is {others_px:.2g} px. Adjust "
        "the model again, or take these images out."
    )


def _wrong_matches(
    count: int,
    observations: int,
    limit_px: float,
    std_px: float,
    least_share: float,
    names: Sequence[str],
    shares: Sequence[float],
) -> str:
    worst = ", ".join(f"{name} ({share:.0%})" for name, share in zip(names, shares, strict=True))
    return (
        f"{count:,} of {observations:,} observations ({count / observations:.1%}) are wrong matches: they miss their "
        f"points by more than {limit_px:.1f} px, where the others scatter with a sigma of {std_px:.2f} px; up to "
        f"{least_share:.0%} is usual. Most in {worst}. Filter the matches, and adjust with a robust loss."
    )


def _behind(count: int, points: int, names: Sequence[str]) -> str:
    more = f" and {len(names) - _MOST_NAMES:,} more" if len(names) > _MOST_NAMES else ""
    return (
        f"{count:,} observations show points that lie behind their camera ({points:,} points; in "
        f"{', '.join(names[:_MOST_NAMES])}{more}): no camera sees these. Take them out."
    )


def _parallel(count: int, points: int, angle_deg: float, least_share: float) -> str:
    return (
        f"{count:,} of {points:,} points ({count / points:.1%}, where up to {least_share:.0%} is usual) are seen under "
        f"angles below {angle_deg:g} degrees alone: their distance is hardly known. Take them out, or photograph from "
        "farther apart."
    )


AUDIT_WORDS: dict[str, Callable[..., str]] = {
    "audit note": _note,
    "claim differs": _claim_differs,
    "point errors differ": _point_errors_differ,
    "intrinsics off": _intrinsics_off,
    "images off": _images_off,
    "wrong matches": _wrong_matches,
    "points behind": _behind,
    "rays near parallel": _parallel,
}
"""What writes each kind of finding of an audit, from its figures by name."""
