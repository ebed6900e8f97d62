"""Findings in words: what a surveyor should know of an adjusted block, in a sentence or two with figures and cure.

Which findings hold is decided in `jaxba.sfm` by figures alone; other words here rerun no solve. The run, `status`,
`diagnose` and `verify` all tell the findings that the stage adjust recorded, in these words. What is not known is left
out of a sentence.
"""

import math
from collections.abc import Callable, Sequence

from jaxba.engine._words import many
from jaxba.report._audit_findings import AUDIT_WORDS
from jaxba.report._bars import BAR_WORDS
from jaxba.report._control_findings import CONTROL_WORDS, along_axes
from jaxba.scene import Finding

_MOST_NAMES = 10
_MOST_ROWS = 8
_TO_KNOW = ("edges left out", "common offset", "scale by bars", "height datum assumed", "audit note")
_DATUMS = {"ellipsoidal": "the WGS 84 ellipsoid", "mean_sea_level": "mean sea level (no geoid named)"}
_TURNS = {1: "a quarter turn", 2: "half a turn", 3: "a quarter turn"}
_LOOKS = {
    "down from one height": " (all photos look straight down from one height)",
    "down": " (photos look straight down)",
    "around": "",
}


def sentence(finding: Finding) -> str:
    """Return a finding in words; a table has a line for each row.

    >>> sentence(Finding.of("image lost", name="a.jpg", reason="fewer than 3 of its features fit"))
    'Image lost in the adjustment: a.jpg: fewer than 3 of its features fit.'
    """
    return WORDS[finding.kind](**finding.figures)


def sentences(findings: Sequence[Finding]) -> list[str]:
    """Return findings in words, in their order."""
    return [sentence(finding) for finding in findings]


def is_to_act_on(finding: Finding) -> bool:
    """Return whether a finding asks for something, and does not only tell what was done or how to read a figure."""
    return finding.kind not in _TO_KNOW


def _of_the_shape() -> str:
    return (
        "The block has no place on earth: sigmas of positions and points say how well its shape is known, under inner "
        "constraints over its points."
    )


def _note(text: str) -> str:
    return text


def _not_settled(medians_px: Sequence[float]) -> str:
    medians = ", ".join(f"{m:.2f}" for m in medians_px)
    return (
        f"The median error still changed after {len(medians_px)} rounds ({medians} px); set "
        "adjust.max_rounds higher, or look at the edges and images named here."
    )


def _not_converged(advice: str) -> str:
    return f"The last solve: {advice}"


def _large_median(median_px: float) -> str:
    return (
        f"The median error is {median_px:.1f} px: check the focal length against the sensor's "
        "specification, and whether cameras or zooms are mixed."
    )


def _edges_left_out(names: Sequence[str], matches: Sequence[int], median_px: Sequence[float], limit_px: float) -> str:
    """Return a table, the worst edge first as it is given."""
    rows = [
        f"  {error:6.1f} px  {count:5d} matches  {name}"
        for name, count, error in zip(names, matches, median_px, strict=True)
    ]
    left = len(rows) - _MOST_ROWS
    more = [f"  and {left:,} more: summary.json, adjust.edges_left_out"] if left > 0 else []
    were, their, photos = ("was", "its", "its photos") if len(rows) == 1 else ("were", "their", "photos of the worst")
    first = (
        f"{many(len(rows), 'edge')} {were} left out, since {their} matches are off by over {limit_px:g} px in the "
        f"median. Look at {photos} for repeated patterns or movement."
    )
    return "\n".join([first, *rows[:_MOST_ROWS], *more])


def _image_lost(name: str, reason: str) -> str:
    return f"Image lost in the adjustment: {name}: {reason}."


def _few_points(names: Sequence[str], points: Sequence[int], least: int) -> str:
    return (
        f"{many(len(names), 'image')} with fewer than {least} points, so weakly placed: "
        f"{_named(names, [f'{count} points' for count in points])}. More overlap or features cure it."
    )


def _positions_contradict(
    names: Sequence[str], residual_m: Sequence[Sequence[float]], measured: int, sigmas: float
) -> str:
    figures = [along_axes(row, "+.1f") for row in residual_m]
    verb, count = ("contradicts", "counts") if len(names) == 1 else ("contradict", "count")
    return (
        f"{many(len(names), 'measured position')} of {measured:,} {verb} the photos by more than {sigmas:.1f} robust "
        f"sigmas and hardly {count} (adjusted minus measured): {_named(names, figures)}."
    )


def _positions_scatter(axes: Sequence[str], scale_m: Sequence[float], stated_m: Sequence[float]) -> str:
    rows = zip(axes, scale_m, stated_m, strict=True)
    text = ", ".join(f"{axis} {scale:.2g} m instead of {stated:.2g} m" for axis, scale, stated in rows)
    return (
        f"Measured positions scatter more than their sigmas say ({text}); the sigmas were enlarged to that. Check the "
        "antenna's offset, the time between exposure and fix, and whether the receiver had its fixed solution."
    )


def _heights_drift(drift_m: float, share: float) -> str:
    return (
        f"Measured heights drift against the photos by {drift_m:.1f} m from the first to the last photo, which "
        f"explains {share:.0%} of their residuals: the receiver's altitude cannot be trusted. Leave heights out, or "
        "use ground control."
    )


def _no_heights() -> str:
    return (
        "No measured height is used, so the block's height and its tilt are those of the start values and not "
        "measured: heights and slopes of the results are not to be relied on. Add ground control, or photos with "
        "heights that can be trusted."
    )


def _focal_and_height(
    parameter: str,
    focal_px: float,
    std_px: float,
    height_m: float,
    looks: str,
    above_ground_m: float | None = None,
    above_take_off_m: float | None = None,
) -> str:
    text = f"Focal length and height trade off{_LOOKS[looks]}: {parameter} is {focal_px:.1f} px"
    if math.isfinite(std_px):
        share = std_px / focal_px
        text += (
            f" with a sigma of {std_px:.1f} px ({share:.1%}), which alone makes the height above ground of "
            f"{height_m:.1f} m uncertain by {share * height_m:.1f} m"
        )
    text += "."
    if above_ground_m is not None and above_take_off_m is not None:
        ratio = above_ground_m / above_take_off_m
        text += (
            f" The cameras are {above_ground_m:.1f} m above the ground points by the adjustment and "
            f"{above_take_off_m:.1f} m above the take-off point by the flight's own record ({ratio - 1:+.0%}); a focal "
            f"length of {focal_px / ratio:.0f} px would agree with it, if the ground lies at the height of the "
            "take-off point."
        )
    return text + (
        " Hold the focal length at a calibrated value (metadata.focal), fly a second height, add oblique photos, "
        "or measure ground control."
    )


def _at_bound(camera: str, parameter: str, value: float, low: float, high: float) -> str:
    return (
        f"Camera {camera}: {parameter} is at its bound ({value:.4g}, allowed {low:.4g} to {high:.4g}): the "
        "calibration takes up another error. Check the focal length and the camera model, add oblique "
        "photos or control, or hold it fixed."
    )


def _focal_moved(camera: str, parameter: str, value: float, before: float) -> str:
    return (
        f"Camera {camera}: {parameter} moved from {before:.0f} to {value:.0f} px "
        f"({value / before - 1:+.1%}). Compare with the sensor's specification."
    )


def _principal_point_off(camera: str, parameter: str, value: float, middle: float) -> str:
    return (
        f"Camera {camera}: the principal point's {parameter} is {value - middle:+.0f} px off the "
        "middle; in a block without cross strips it may stand for a tilt. Photos turned by 90 degrees tell."
    )


def _weak_positions(names: Sequence[str], std_m: Sequence[float], median_m: float) -> str:
    return (
        f"{many(len(names), 'image')} with a position sigma over five times the median of {median_m:.2g} m: "
        f"{_named(names, [f'{std:.2g} m' for std in std_m])}."
    )


def _common_offset(median_m: float, axes: Sequence[str], receiver_std_m: Sequence[float]) -> str:
    of_receiver = ", ".join(f"{axis} {std:.1f}" for axis, std in zip(axes, receiver_std_m, strict=True))
    return (
        f"Position sigmas (median {median_m:.2g} m) are those within the block, about the mean of all GNSS positions. "
        f"Positions of a single receiver have an offset in common, up to their own sigma ({of_receiver} m), "
        "which is not in these: only control or a differential receiver removes it."
    )


def _height_datum_assumed(of: Sequence[str], datum: str) -> str:
    whose = " and ".join("the photos" if name == "photos" else name for name in of)
    what = "above an unknown surface" if datum == "unknown" else f"taken to be above {_DATUMS.get(datum, datum)}"
    return (
        f"Heights of {whose} do not say what they are above: they are {what}, and so are the heights of all results. "
        "Ellipsoid and mean sea level lie up to 100 m apart. Declare it, by crs.height_datum for photos and "
        "control.height_datum for surveyed points."
    )


def _attitudes_contradict(names: Sequence[str], turn_deg: Sequence[float], measured: int, quarter_turns: int) -> str:
    figures = [f"{angle:.0f} degrees" for angle in turn_deg]
    verb = "contradicts" if len(names) == 1 else "contradict"
    if quarter_turns and len(names) < measured:
        cause = (
            f"These are {_TURNS[quarter_turns]} about the viewing direction, and the other photos are not turned: "
            "such pictures were turned after the flight, as image viewers do, which leave the gimbal's tags as they "
            "were. Give these photos as the camera wrote them."
        )
    elif quarter_turns:
        cause = (
            f"All photos have {_TURNS[quarter_turns]} about the viewing direction: the camera is mounted turned by "
            "it, or its yaw is counted from another side. Give attitudes in the list of positions that say how the "
            "pictures lie."
        )
    else:
        cause = (
            "They may be of the aircraft rather than of the camera, or in another convention of yaw, pitch and roll. "
            "Look at the tags, or give attitudes in the list of positions."
        )
    return (
        f"{many(len(names), 'attitude')} of {measured:,} {verb} the block by more than a gimbal or a compass errs, and "
        f"hardly {'counts' if len(names) == 1 else 'count'} in it: {_named(names, figures)}. {cause} Attitudes also "
        "choose pairs and start values."
    )


def _named(names: Sequence[str], figures: Sequence[str]) -> str:
    shown = [f"{name} ({figure})" for name, figure in zip(names, figures, strict=True)]
    more = f" and {len(shown) - _MOST_NAMES:,} more" if len(shown) > _MOST_NAMES else ""
    return ", ".join(shown[:_MOST_NAMES]) + more


WORDS: dict[str, Callable[..., str]] = {
    "note": _note,
    "no sigmas": _note,
    "sigmas of the shape": _of_the_shape,
    "not settled": _not_settled,
    "not converged": _not_converged,
    "large median": _large_median,
    "edges left out": _edges_left_out,
    "image lost": _image_lost,
    "few points": _few_points,
    "positions contradict": _positions_contradict,
    "positions scatter": _positions_scatter,
    "heights drift": _heights_drift,
    "no heights": _no_heights,
    "focal and height": _focal_and_height,
    "at bound": _at_bound,
    "focal moved": _focal_moved,
    "principal point off": _principal_point_off,
    "weak positions": _weak_positions,
    "common offset": _common_offset,
    "height datum assumed": _height_datum_assumed,
    "attitudes contradict": _attitudes_contradict,
    **AUDIT_WORDS,
    **BAR_WORDS,
    **CONTROL_WORDS,
}
"""What writes each kind of finding, from its figures by name."""
