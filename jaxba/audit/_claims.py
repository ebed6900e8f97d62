"""What a model says of itself beside the same figures computed anew, by the definition of the program that wrote it.

The residual of an observation is projected minus measured. Every program that is read counts it in the image plane:

    COLMAP    px; ERROR of a point: mean length over its observations; the model's: mean over the points
    OpenSfM   the same in units of the image's longer side
    BAL       px; cost: half the sum of squares over both coordinates

Points behind a camera are projected as the formula has it, since none of these looks at the sign of the depth first.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from jaxba._errors import JaxbaError
from jaxba.scene import Block, Reconstruction

LEAST_PX = 0.01
"""Difference of errors that rounding of a text explains: six digits of a pose move pixels by some thousandths."""
LEAST_SHARE = 0.01
"""Difference of errors, as a share of the error, that is of no practical size."""
_ROUNDED = 1e-5  # share by which texts of six digits round a mean


@dataclass(frozen=True, kw_only=True)
class Figure:
    """A figure of a model.

    - `name`, `unit`, `definition`: what it is. `stated`: by the files, None where they do not; `place`: where.
    - `recomputed`: from the model. `limit`: a difference up to it is none.
    """

    name: str
    unit: str
    definition: str
    recomputed: float
    stated: float | None = None
    place: str = ""
    limit: float = 0.0

    @property
    def difference(self) -> float | None:
        """Stated minus recomputed; None where nothing is stated."""
        return None if self.stated is None else self.stated - self.recomputed

    @property
    def differs(self) -> bool:
        """Whether what is stated is not so."""
        return self.difference is not None and not abs(self.difference) <= self.limit


@dataclass(frozen=True, kw_only=True, eq=False)
class Claims:
    """A model's residuals, its figures, and how the stated errors of its points compare.

    - `residual_px`: projected minus measured, of every observation. `is_behind`: its point is behind the camera.
    - `point_error`: mean length of each point's residuals, in the program's unit; NaN without an observation.
    - `point_differs`: the file states another error of the point. `point_limit`: beyond which it is another.
    """

    residual_px: Float[np.ndarray, "observations 2"]
    is_behind: Bool[np.ndarray, " observations"]
    figures: tuple[Figure, ...]
    point_error: Float[np.ndarray, " points"]
    point_differs: Bool[np.ndarray, " points"]
    point_limit: float

    @property
    def error_px(self) -> Float[np.ndarray, " observations"]:
        """Lengths of the residuals."""
        return np.hypot(*self.residual_px.T)


def points_in_cam(block: Block) -> Float[np.ndarray, "observations 3"]:
    """Return the point of each observation in the frame of its camera."""
    turn = Rotation.from_quat(block.quaternion, scalar_first=True).as_matrix()[block.observation_image]
    points = block.points_m[block.observation_point]
    return np.einsum("nij,nj->ni", turn, points) + block.translation_m[block.observation_image]


def residuals_px(block: Block) -> Float[np.ndarray, "observations 2"]:
    """Return projected minus measured pixels of a block's observations."""
    from jaxba.ba import project_in_cameras
    from jaxba.geometry import CAMERAS

    cameras = CAMERAS[block.camera_model].from_parameters(block.camera_parameters)
    with np.errstate(all="ignore"):
        seen = project_in_cameras(cameras, block.camera_index[block.observation_image], points_in_cam(block).T).T
    return seen - block.observation_xy_px


def check_claims(given: Reconstruction) -> Claims:
    """Return the figures of a model beside what its files say of them.

    Raises `JaxbaError` where it has no observation.
    """
    block = given.block
    if not block.num_observations:
        raise JaxbaError(
            f"{given.files[0]}: none of its {block.num_points:,} points is observed in its images; give the whole "
            "model, with keypoints and tracks."
        )
    residual_px = residuals_px(block)
    error_px = np.hypot(*residual_px.T)
    error = error_px / given.unit_px[block.observation_image]
    views = np.bincount(block.observation_point, minlength=block.num_points)
    seen = views > 0
    total = np.bincount(block.observation_point, error, minlength=block.num_points)
    point_error = np.where(seen, total / np.maximum(views, 1), np.nan)
    least = LEAST_PX / float(np.max(given.unit_px))
    off = np.abs(given.point_error - point_error)
    with np.errstate(invalid="ignore"):
        point_differs = off > np.maximum(least, LEAST_SHARE * point_error)
    return Claims(
        residual_px=residual_px,
        is_behind=points_in_cam(block)[:, 2] <= 0,
        figures=_figures(given, error_px, error, point_error, least),
        point_error=point_error,
        point_differs=point_differs,
        point_limit=least,
    )


def _figures(
    given: Reconstruction,
    error_px: Float[np.ndarray, " observations"],
    error: Float[np.ndarray, " observations"],
    point_error: Float[np.ndarray, " points"],
    least: float,
) -> tuple[Figure, ...]:
    block = given.block
    stated = {claim.name: claim for claim in given.claims}
    counts = {
        "cameras": (len(block.camera_names), "whose intrinsics the files have"),
        "images": (block.num_images, "that have a pose"),
        "points": (block.num_points, "in space"),
        "observations": (block.num_observations, "keypoints that have a point"),
        "mean track length": (block.num_observations / block.num_points, "observations over points"),
        "mean observations per image": (block.num_observations / block.num_images, "observations over images"),
    }
    found = []
    for name, (value, definition) in counts.items():
        claim = stated.get(name)
        found.append(
            Figure(
                name=name, unit="", definition=definition, recomputed=float(value),
                stated=None if claim is None else claim.stated, place="" if claim is None else claim.place,
                limit=_ROUNDED * value if name.startswith("mean") else 0.0,
            )
        )  # fmt: skip
    known = np.isfinite(given.point_error)
    mean = float(np.nanmean(point_error))
    found.append(
        Figure(
            name="mean reprojection error", unit=given.unit, recomputed=mean,
            definition="mean over the points of the mean length of each one's residuals",
            stated=float(np.mean(given.point_error[known])) if known.any() else None,
            place=f"{given.files[-1].name}, errors of {int(known.sum()):,} points" if known.any() else "",
            limit=max(least, LEAST_SHARE * mean),
        )
    )  # fmt: skip
    of_all = {
        "mean residual": (error, "mean length over the observations"),
        "median residual": (error, "median length over the observations"),
        "RMS residual": (error, "root of the mean squared length over the observations"),
    }
    averages = np.mean, np.median, lambda values: np.sqrt(np.mean(values**2))
    for (name, (values, definition)), average in zip(of_all.items(), averages, strict=True):
        found.append(Figure(name=name, unit=given.unit, definition=definition, recomputed=float(average(values))))
    if given.unit != "px":
        found.append(
            Figure(
                name="mean residual in pixels", unit="px", definition="mean length over the observations",
                recomputed=float(np.mean(error_px)),
            )
        )  # fmt: skip
    cost = Figure(
        name="cost", unit="px²", definition="half the sum of squared residuals, without a robust loss",
        recomputed=float(np.sum(error_px**2) / 2),
    )  # fmt: skip
    return (*found, cost)
