"""Quality: reprojection errors at a problem's present values, and the threshold that tells inliers from outliers.

    threshold = median + 2.5 MAD,   MAD = median |error - median|

over the errors as distances in pixels, without their sigmas. The MAD is the raw one, not scaled to a normal
distribution's sigma. Cost: numpy alone; 500k observations take 0.3 s, most of it the medians of images and points.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxba._errors import JaxbaError
from jaxba.ba._problem import Problem
from jaxba.ba._projection import points_in_cam, project
from jaxba.ba._selection import Selection, selected
from jaxba.geometry import require_number


@dataclasses.dataclass(frozen=True)
class GroupErrors:
    """Errors of the observations of each image, point or camera, pixels; NaN where it has none.

    - `count`: observations used.
    """

    count: Int[np.ndarray, " groups"]
    median_px: Float[np.ndarray, " groups"]
    max_px: Float[np.ndarray, " groups"]


@dataclasses.dataclass(frozen=True)
class Quality:
    """Reprojection errors of a problem and their statistics; statistics are over the observations used.

    - `error_px`: of every observation, used or not; infinite where the point is behind the camera or has no pixel.
    - `median_px`, `mad_px`, `threshold_px`: see the module's equations.
    - `mean_px`, `rms_px`: of the finite errors. `num_infinite`: how many of those used are not.
    - `is_inlier`: used, and at most the threshold. `inlier_rate`: of all observations; what was left out is no inlier.
    """

    error_px: Float[np.ndarray, " observations"]
    median_px: float
    mean_px: float
    rms_px: float
    mad_px: float
    threshold_px: float
    num_infinite: int
    is_inlier: Bool[np.ndarray, " observations"]
    inlier_rate: float
    images: GroupErrors
    points: GroupErrors
    cameras: GroupErrors


def reprojection_errors(problem: Problem) -> Float[np.ndarray, " observations"]:
    """Return the distance, in pixels, of each measured pixel from that of its point at the problem's present values.

    Infinite where the point is behind the camera (unless the camera model sees there) or has no pixel.

    >>> import numpy as np
    >>> from jaxba.ba import Observations, Problem, reprojection_errors
    >>> from jaxba.geometry import Pinhole, Pose
    >>> seen = Observations(np.array([[503.0, 404.0]]), np.ones(1), np.array([0]), np.array([0]))
    >>> pose = Pose(np.array([[1.0, 0, 0, 0]]), np.zeros((1, 3)))
    >>> problem = Problem.build(pose, Pinhole(1000.0, 1000.0, 500.0, 400.0), np.array([[0.0, 0, 10]]), seen)
    >>> reprojection_errors(problem).tolist()
    [5.0]
    """
    point = points_in_cam(problem)
    xy_px = np.asarray(problem.observations.xy_px, float).T
    with np.errstate(all="ignore"):
        error = np.hypot(*(project(problem, point, slice(None)) - xy_px))
        visible = np.isfinite(error) & (type(problem.cameras).sees_behind | (point[2] > 0))
    return np.where(visible, error, np.inf)


def quality(problem: Problem, used: Selection = None, *, mad_factor: float = 2.5) -> Quality:
    """Return the reprojection errors at the problem's present values, their statistics and the inliers.

    - `used`: the observations that statistics are over, as indices or a mask; all by default.
    - `mad_factor`: of the MAD, from the median to the threshold.

    Raises `JaxbaError` if no observation is used.

    >>> import jaxba
    >>> survey = jaxba.synthetic.uav_block(8)
    >>> found = jaxba.ba.quality(survey.problem)
    >>> len(found.images.median_px), bool(found.threshold_px == found.median_px + 2.5 * found.mad_px)
    (8, True)
    """
    require_mad_factor(mad_factor)
    used = selected("used", True if used is None else used, problem.num_observations, "observations")
    if not used.any():
        raise JaxbaError("No observation is used, so there are no errors to judge; give a mask with some True.")
    error = reprojection_errors(problem)
    of_used = error[used]
    median = float(np.median(of_used))
    with np.errstate(invalid="ignore"):
        deviation = np.abs(of_used - median)
    mad = float(np.median(np.where(np.isnan(deviation), np.inf, deviation)))
    threshold = median + mad_factor * mad
    inlier = used & np.isfinite(error) & (error <= threshold)
    finite = of_used[np.isfinite(of_used)]
    image = np.asarray(problem.observations.image_index)
    return Quality(
        error_px=error,
        median_px=median,
        mean_px=float(np.mean(finite)) if len(finite) else np.inf,
        rms_px=float(np.sqrt(np.mean(finite**2))) if len(finite) else np.inf,
        mad_px=mad,
        threshold_px=threshold,
        num_infinite=len(of_used) - len(finite),
        is_inlier=inlier,
        inlier_rate=float(np.mean(inlier)),
        images=_group_errors(of_used, image[used], problem.num_images),
        points=_group_errors(of_used, np.asarray(problem.observations.point_index)[used], problem.num_points),
        cameras=_group_errors(of_used, np.asarray(problem.camera_index)[image[used]], problem.num_cameras),
    )


def require_mad_factor(mad_factor: float) -> None:
    """Raise `JaxbaError` for a factor that is not positive and finite."""
    require_number(
        "mad_factor", mad_factor, np.finfo(float).tiny, np.finfo(float).max, "give a positive number, as 2.5"
    )


def _group_errors(error: Float[np.ndarray, " n"], group: Int[np.ndarray, " n"], count: int) -> GroupErrors:
    """Sort by group, then error: the median and the largest stand at known places."""
    by_error = np.argsort(error)
    ordered = error[by_error][np.argsort(group[by_error], kind="stable")]
    counts = np.bincount(group, minlength=count)
    start = np.cumsum(counts) - counts
    some = counts > 0
    median, largest = np.full(count, np.nan), np.full(count, np.nan)
    low, high = start + (counts - 1) // 2, start + counts // 2
    median[some] = (ordered[low[some]] + ordered[high[some]]) / 2
    largest[some] = ordered[(start + counts - 1)[some]]
    return GroupErrors(counts, median, largest)
