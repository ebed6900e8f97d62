"""Rules on the adjustment: a large median error, parameters at their bounds, a solver that runs out of steps."""

from typing import Any

import numpy as np

from jaxba._errors import JaxbaError
from jaxba.engine._words import some
from jaxba.report._recorded import Recorded
from jaxba.report.diagnosis._diagnosis import Diagnosis
from jaxba.scene import Photo, PhotoFile

_HIGH_COST_PX = 1.5


def large_median(case: Recorded) -> Diagnosis | None:
    """Large errors, or start values that nothing fits: wrong focal length, mixed cameras, corrupt edges."""
    done = case.done
    failed = case.stopped is not None and case.stopped.name in ("start", "adjust") and done.tracks is not None
    median_px = None if done.adjust is None else done.adjust.median_px
    if not failed and not has_large_errors(case):
        return None
    if failed and _mean_angle_deg(case) < 1.0:
        return None  # photos from one place: another rule's
    graph = done.match.view_graph
    edges = graph.is_edge
    begin = (
        f"The median reprojection error is {median_px:.2f} px and {done.adjust.inlier_rate:.0%} of the observations fit"
        if done.adjust is not None
        else f"No block fits the matches (stage {case.stopped.name}: {case.stopped.reason.rstrip('.')})"
        if case.stopped
        else ""
    )
    cameras, focals = _cameras(case)
    pruned = () if done.adjust is None else done.adjust.pruned
    edge_px = float(np.median(graph.residual_px[edges])) if edges.any() else float("nan")
    text = f"{begin}, though pairs alone fit to {edge_px:.2f} px: wrong focal lengths, mixed cameras or corrupt edges. "
    text += f"{cameras} "
    if done.adjust is not None:
        text += f"Edges left out: {some([left.name for left in pruned], 3)}." if pruned else "No edge was left out."
    return Diagnosis(
        name="large errors",
        cause=text.rstrip(),
        cure="Compare the focal length with the sensor's specification and set metadata.focal, or leave it to the "
        "tags; keep photos of one camera, zoom and size in one folder; look at the photos of the edges named.",
        figures={"median_px": median_px, "edge_median_px": edge_px, "focal_px": focals,
                 "pruned": [left.name for left in pruned]},
    )  # fmt: skip


def has_large_errors(case: Recorded) -> bool:
    """Whether the adjusted block fails what verification asks of its errors."""
    adjusted, limits = case.done.adjust, case.done.settings["verify"]
    if adjusted is None:
        return False
    return adjusted.median_px > limits.max_median_px or adjusted.inlier_rate < limits.min_inlier_rate


def _mean_angle_deg(case: Recorded) -> float:
    graph = case.done.match.view_graph
    angle = graph.angle_rad[graph.is_edge & np.isfinite(graph.angle_rad)]
    return float(np.rad2deg(np.median(angle))) if len(angle) else 90.0


def _cameras(case: Recorded) -> tuple[str, dict[str, dict[str, float | None]]]:
    """Return each camera's focal lengths in words and figures: used, by the tags of its first photo, adjusted."""
    done, texts = case.done, []
    figures: dict[str, dict[str, float | None]] = {}
    first: dict[str, Photo] = {}
    for photo in done.photos:
        first.setdefault(photo.camera, photo)
    block = None if done.adjust is None else done.adjust.block
    for camera, photo in first.items():
        tagged = _tagged_focal(photo) if photo.focal_source == "given" else None
        row = block.camera_names.index(camera) if block is not None and camera in block.camera_names else None
        adjusted = None if block is None or row is None else float(block.camera_parameters[row, 0])
        figures[camera] = {"used": photo.focal_px, "tags": tagged, "adjusted": adjusted}
        used = "unknown" if photo.focal_px is None else f"{photo.focal_px:.0f} px ({photo.focal_source})"
        text = f"Camera {camera}: focal length {used}"
        text += f", by its tags and sensor {tagged:.0f} px" if tagged is not None else ""
        text += f", adjusted {adjusted:.0f} px" if adjusted is not None else ""
        texts.append(f"{text}, photos of {photo.width_px} x {photo.height_px} px.")
    count = f"{len(first)} cameras. " if len(first) > 1 else ""
    return count + " ".join(texts[:3]), figures


def _tagged_focal(photo: Photo) -> float | None:
    """Return the focal length that a photo's tags tell; None where they do not, or the file is gone."""
    from jaxba.vision import read_photo

    try:
        return read_photo(PhotoFile(name=photo.name, path=photo.path, sha256=photo.sha256)).focal_px
    except (JaxbaError, OSError):  # the file may have moved since the run: then there is nothing to compare with
        return None


def bounds_reached(case: Recorded) -> tuple[Any, ...]:
    """Return the intrinsics of the adjusted block that lie at a bound."""
    from jaxba.sfm import intrinsics_at_bounds  # loads jax

    return intrinsics_at_bounds(case.done.adjust.block, case.done.start.block, case.done.photos)


def at_bound(case: Recorded) -> Diagnosis | None:
    """Distortion or focal length at its bound: self-calibration absorbs model error."""
    done = case.done
    if done.adjust is None:
        return None
    found = bounds_reached(case)
    if not found:
        return None
    texts = [f"{b.parameter} of {b.camera} is {b.value:.4g}, allowed {b.low:.4g} to {b.high:.4g}" for b in found]
    cameras, focals = _cameras(case)
    return Diagnosis(
        name="parameter at its bound",
        cause=f"{'; '.join(texts)}: the calibration takes up another error, such as a wrong focal length or camera "
        f"model. {cameras}",
        cure="Hold the focal length at a calibrated value (metadata.focal), choose another start.camera_model, add "
        "oblique photos or ground control, or another adjust.loss.",
        figures={"at_bounds": [f"{b.camera}: {b.parameter}" for b in found], "focal_px": focals},
    )


def out_of_steps(case: Recorded) -> Diagnosis | None:
    """A solver that stops at its limit with a high cost: bad input, not too few steps."""
    adjusted = case.done.adjust
    if adjusted is None or adjusted.solver in ("ftol", "xtol", "gtol", "") or adjusted.median_px < _HIGH_COST_PX:
        return None
    graph = case.done.match.view_graph
    edges = graph.is_edge
    inliers, planar = int(np.median(graph.num_inliers[edges])), float(np.mean(graph.is_planar[edges]))
    limit = case.done.settings["adjust"].max_nfev
    stops = {"max_nfev": f"at adjust.max_nfev={limit} steps"}.get(adjusted.solver, f"as {adjusted.solver}")
    return Diagnosis(
        name="no convergence",
        cause=f"The last solve stopped {stops} with a median error of {adjusted.median_px:.1f} px and "
        f"{adjusted.inlier_rate:.0%} inliers: the input contradicts itself, more steps do not help. A pair has "
        f"{inliers} verified matches (median of {int(edges.sum())}), {planar:.0%} of the pairs are planar.",
        cure="Look at the focal lengths, at photos of other cameras and at edges left out; raise match.min_inliers, "
        "or set adjust.loss=cauchy. Only where the median is small raise adjust.max_nfev.",
        figures={"solver": adjusted.solver, "median_px": adjusted.median_px, "inliers_of_a_pair": inliers,
                 "planar_share": planar},
    )  # fmt: skip
