"""The adjustment problem: unknowns, observations, priors, what is free and within which bounds.

Host data: arrays may be numpy (the usual case, float64 kept whatever jax is set to) or jax arrays and tracers, when a
problem is built inside `jit` or differentiated. Units and frames: metres in the world (a local frame, origin near the
block), pixels in the images with the first pixel's centre at (0.5, 0.5), radians.
"""

import abc
from collections.abc import Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jaxtyping import Bool, Float, Int

from jaxba._errors import JaxbaError
from jaxba.ba._rows import Rows
from jaxba.ba._selection import Selection, holds_tracer, selected, selected_names
from jaxba.ba._unknowns import Unknowns
from jaxba.geometry import AbstractCamera, AbstractLoss, Pose


class Observations(eqx.Module):
    """Image measurements of points.

    - `xy_px`: pixels.
    - `std_px`: standard deviation of each coordinate, pixels.
    - `image_index`, `point_index`: what is seen where.
    """

    xy_px: Float[Array | np.ndarray, "observations 2"]
    std_px: Float[Array | np.ndarray, " observations"]
    image_index: Int[Array | np.ndarray, " observations"]
    point_index: Int[Array | np.ndarray, " observations"]


class AbstractPrior(eqx.Module):
    """A residual group beside the reprojections: a class of your own, or one of those in `ba/groups`.

    `name` is the group's name in files, tables and messages. `loss` is applied to the squared norm of each row's
    residual, which is already divided by its sigmas. `in_world` names the fields with coordinates of the world, which a
    solve counts from the middle of a block that lies far from the origin; None, for a class that does not say, keeps
    the coordinates of all as they are.
    """

    name: ClassVar[str]
    in_world: ClassVar[tuple[str, ...] | None] = None
    loss: eqx.AbstractVar[AbstractLoss]

    @abc.abstractmethod
    def residual(self, unknowns: Unknowns) -> Float[Array, "components rows"]:
        """Return the residuals over their sigmas, one column a row of the group."""

    @abc.abstractmethod
    def rows(self, unknowns: Unknowns) -> Rows:
        """Return residuals and exact derivatives, equal to `jax.jacfwd` of `residual`."""


class Free(eqx.Module):
    """What the adjustment may change: True is free.

    `intrinsics` has a column for each of the camera model's parameters, in the model's order.
    """

    poses: Bool[Array | np.ndarray, " images"]
    points: Bool[Array | np.ndarray, " points"]
    intrinsics: Bool[Array | np.ndarray, "cameras parameters"]
    lever_arm: Bool[Array | np.ndarray, ""]
    position_offset: Bool[Array | np.ndarray, ""] = eqx.field(default_factory=lambda: np.array(False))


class Problem(eqx.Module):
    """A bundle adjustment problem, with start values for all unknowns.

    - `poses`: `cam_from_world` of each image.
    - `cameras`: one camera model, its fields with one entry a camera.
    - `camera_index`: the camera of each image; a survey flown with one camera has zeros.
    - `points`: metres, world.
    - `observations`: pixels.
    - `priors`: position, attitude, intrinsics priors and control points, each at most once.
    - `lever_arm`: from the camera's centre to the GNSS antenna, metres, camera frame; shared by all images.
    - `free`: what may change.
    - `lower`, `upper`: bounds on the intrinsics, infinite where there is none.
    - `image_names`: used in messages; empty, or one an image.
    - `position_offset`: what positions of the position prior have in common beside their errors, measured minus true,
      metres, world: a row for all of them, one a flight, a drift (`PositionPrior.offset_weights`); none without such.
      The last rows are the ends of scale bars, where there are any (`with_scale_bars`).

    `Problem.build` fills in the defaults; `fix` and `bound` return changed copies.
    """

    poses: Pose
    cameras: AbstractCamera
    camera_index: Int[Array | np.ndarray, " images"]
    points: Float[Array | np.ndarray, "points 3"]
    observations: Observations
    priors: tuple[AbstractPrior, ...]
    lever_arm: Float[Array | np.ndarray, "3"]
    free: Free
    lower: Float[Array | np.ndarray, "cameras parameters"]
    upper: Float[Array | np.ndarray, "cameras parameters"]
    image_names: tuple[str, ...] = eqx.field(static=True, converter=tuple, default=())
    position_offset: Float[Array | np.ndarray, "offsets 3"] = eqx.field(default_factory=lambda: np.zeros((0, 3)))

    @property
    def num_images(self) -> int:
        return self.poses.translation.shape[0]

    @property
    def num_points(self) -> int:
        return self.points.shape[0]

    @property
    def num_observations(self) -> int:
        return self.observations.xy_px.shape[0]

    @property
    def num_cameras(self) -> int:
        return self.lower.shape[0]

    @property
    def antenna(self) -> Any:
        """Lever arm and position offset in one vector, numpy unless one of them is traced."""
        parts = self.lever_arm, self.position_offset
        xp = _namespace(parts)
        return xp.concatenate([xp.asarray(part).reshape(-1) for part in parts])

    @property
    def num_bar_ends(self) -> int:
        """How many rows of `position_offset`, the last ones, are the ends of scale bars."""
        bars = self.prior("scale_bar")
        return 0 if bars is None else np.shape(vars(bars)["offset_index"])[0]

    @property
    def free_antenna(self) -> Any:
        """Which entries of `antenna` may change, likewise."""
        free = self.free.lever_arm, self.free.position_offset
        xp = _namespace(free)
        counts = 3, 3 * self.position_offset.shape[0]
        return xp.concatenate([xp.asarray(of) & np.ones(n, bool) for of, n in zip(free, counts, strict=True)])

    @staticmethod
    def build(
        poses: Pose,
        cameras: AbstractCamera,
        points: Float[Array | np.ndarray, "points 3"],
        observations: Observations,
        *,
        camera_index: Int[Array | np.ndarray, " images"] | None = None,
        priors: Sequence[AbstractPrior] = (),
        lever_arm: Float[Array | np.ndarray, "3"] | None = None,
        free: Free | None = None,
        image_names: Sequence[str] = (),
    ) -> "Problem":
        """Return a problem with everything free, no bounds, a zero lever arm held fixed, and one camera for all images.

        A camera without a batch axis becomes a batch of one. Several cameras need `camera_index`.
        """
        num_images = poses.translation.shape[0]
        names = type(cameras).parameter_names()
        columns = np.broadcast_arrays(*(np.atleast_1d(np.asarray(getattr(cameras, n), float)) for n in names))
        cameras = type(cameras)(*(np.array(column) for column in columns))
        num_cameras = columns[0].shape[0]
        if camera_index is None:
            if num_cameras > 1:
                raise JaxbaError(f"{num_cameras} cameras but no camera_index; give the camera of each image.")
            camera_index = np.zeros(num_images, np.int32)
        if free is None:
            free = Free(
                poses=np.ones(num_images, bool),
                points=np.ones(points.shape[0], bool),
                intrinsics=np.ones((num_cameras, len(names)), bool),
                lever_arm=np.array(False),
            )
        return Problem(
            poses=poses,
            cameras=cameras,
            camera_index=camera_index,
            points=points,
            observations=observations,
            priors=tuple(priors),
            lever_arm=np.zeros(3) if lever_arm is None else lever_arm,
            free=free,
            lower=np.full((num_cameras, len(names)), -np.inf),
            upper=np.full((num_cameras, len(names)), np.inf),
            image_names=tuple(image_names),
        )

    def fix(
        self,
        *,
        poses: Selection = None,
        points: Selection = None,
        intrinsics: Selection = None,
    ) -> "Problem":
        """Return the problem with more blocks held fixed.

        Each argument is True for all of its kind, an index, indices or a mask (list, range, numpy or jax array), or a
        slice; None and False are none. Intrinsics are chosen by the parameters' names or by their place in the model;
        a mask with a row for each camera chooses them camera by camera.

        Raises `JaxbaError` for an index out of range, one below 0, a mask of another length, and an unknown name.

        >>> import jaxba
        >>> problem = jaxba.synthetic.uav_block(8).problem.fix(poses=[0, 7], intrinsics="k1")
        >>> problem.free.poses.tolist(), problem.free.intrinsics[0].tolist()
        ([False, True, True, True, True, True, True, False], [True, True, True, True, False, True, True, True, False])
        """
        model, names = type(self.cameras).__name__, type(self.cameras).parameter_names()
        fixed_poses = selected("fix: poses", poses, self.num_images, "images")
        fixed_points = selected("fix: points", points, self.num_points, "points")
        of_cameras = np.zeros(0) if holds_tracer(intrinsics) else np.asarray(intrinsics, object)
        if of_cameras.shape == self.free.intrinsics.shape:
            fixed = selected("fix: intrinsics", of_cameras.reshape(-1), of_cameras.size, "intrinsics of all cameras")
            fixed_intrinsics = fixed.reshape(self.free.intrinsics.shape)
        else:
            fixed_intrinsics = selected_names("fix: intrinsics", intrinsics, names, f"intrinsics of a {model} camera")
        free = Free(
            np.asarray(self.free.poses) & ~fixed_poses,
            np.asarray(self.free.points) & ~fixed_points,
            np.asarray(self.free.intrinsics) & ~fixed_intrinsics,
            self.free.lever_arm,
            self.free.position_offset,
        )
        return eqx.tree_at(lambda p: p.free, self, free)

    def bound(self, **bounds: Any) -> "Problem":
        """Return the problem with box bounds on intrinsics, e.g. `bound(k1=(-0.1, 0.1))`.

        `focal=(0.9, 1.1)` bounds every focal length relative to its start value; all other names are parameters of the
        model, with absolute bounds. A bound is a number, or one for each camera.
        """
        names = type(self.cameras).parameter_names()
        lower, upper = np.array(self.lower), np.array(self.upper)
        for key, pair in bounds.items():
            try:
                low, high = (np.broadcast_to(np.asarray(bound, float), self.num_cameras) for bound in pair)
            except (TypeError, ValueError) as error:
                raise JaxbaError(
                    f"bounds {key}={pair}: give the lower and the upper one, each a number or one for each of "
                    f"{self.num_cameras} cameras."
                ) from error
            for camera in np.flatnonzero(~(low < high)):
                raise JaxbaError(
                    f"bounds {key}={low[camera]:g},{high[camera]:g}: the lower bound must be below the upper one."
                )
            if key == "focal":
                for name in names:
                    if name in ("f", "fx", "fy"):
                        start = np.asarray(getattr(self.cameras, name))
                        lower[:, names.index(name)], upper[:, names.index(name)] = low * start, high * start
            elif key in names:
                lower[:, names.index(key)], upper[:, names.index(key)] = low, high
            else:
                raise JaxbaError(f"bounds {key}: a {type(self.cameras).__name__} camera has focal, {', '.join(names)}.")
        return eqx.tree_at(lambda p: (p.lower, p.upper), self, (lower, upper))

    def prior(self, name: str) -> AbstractPrior | None:
        """Return the prior of this name, or None."""
        return next((prior for prior in self.priors if prior.name == name), None)

    def image_label(self, index: int) -> str:
        """Return `image 14 (DJI_0021.JPG)`, for messages."""
        name = f" ({self.image_names[index]})" if self.image_names else ""
        return f"image {index}{name}"


def _namespace(parts: Sequence[Any]) -> Any:
    """numpy for concrete values, jax.numpy where anything is traced."""
    return jnp if any(isinstance(part, Tracer) for part in parts) else np
