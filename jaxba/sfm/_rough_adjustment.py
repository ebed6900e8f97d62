"""Rough adjustment: poses, a focal length and a radial term a camera, and some points, before the adjustment proper.

Relative poses come from an uncalibrated lens, so the first points miss their pixels by tens of pixels in the corners,
and no threshold could tell a wrong match from a right one. A few Levenberg-Marquardt steps with two unknowns a camera
change that. `jaxba.solve` does the same and more, but compiles for 5 to 7 seconds for each new size; here only the
projection's derivatives are compiled, for pieces of one size, and a few thousand points need 0.1 s a step in numpy.

Unknowns: (w, v) an image, `R' = exp(w) R`, `t' = exp(w) t + v`; the focal length (as a factor) and k1 a camera, each
with a prior, since over flat ground they are hardly determined. Loss: Cauchy, at a scale that follows the median error
down. Points are eliminated, the reduced system is factored by SuperLU.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int
from scipy import sparse
from scipy.spatial.transform import Rotation

from jaxba.ba import fast_jit
from jaxba.geometry import CAMERAS, AbstractCamera
from jaxba.scene import Block
from jaxba.sfm._sparse import block_diagonal, block_matrix, solve_positive, sum_rows

_CHUNK = 8192
_LEAST_SCALE_PX = 2.0
_POSITION_LOSS = 2.0  # sigmas
_K1_STD = 0.1
_CONVERGED = 1e-3  # relative change of the cost


def adjust_roughly(
    block: Block,
    *,
    xyz_m: Float[np.ndarray, "images 3"],
    std_m: Float[np.ndarray, "images 3"],
    focal_std: Float[np.ndarray, " cameras"],
    num_steps: int = 30,
) -> Block:
    """Return the block with poses, points, focal lengths and k1 adjusted to its observations.

    - `xyz_m`, `std_m`: measured positions, a robust prior; NaN or an infinite sigma where there is none.
    - `focal_std`: sigma of each camera's focal length, as a share.
    """
    state = _State.of(block)
    prior = _Prior(xyz_m, std_m, np.log(state.focal), focal_std)
    damping = 1e-3
    rows = state.rows(block)
    for _ in range(num_steps):
        scale = max(_LEAST_SCALE_PX, 1.5 * float(np.median(np.hypot(*rows.error.T))))
        cost = _cost(rows.error, scale) + prior.cost(state)
        system = _System.of(block, state, rows, prior, scale)
        improved = False
        for _ in range(8):
            trial = system.step(state, damping)
            trial_rows = trial.rows(block)
            trial_cost = _cost(trial_rows.error, scale) + prior.cost(trial)
            if np.isfinite(trial_cost) and trial_cost < cost:
                improved, damping = True, max(damping / 5, 1e-9)
                break
            damping *= 3
        if not improved:
            break
        state, rows = trial, trial_rows
        if cost - trial_cost < _CONVERGED * cost and scale == _LEAST_SCALE_PX:
            break
    return state.into(block)


def _cost(error: Float[np.ndarray, "n 2"], scale: float) -> float:
    """Half the Cauchy losses of errors whose sigma is half the scale."""
    return float(2 * np.log1p((error**2).sum(axis=1) / scale**2).sum())


@dataclasses.dataclass(frozen=True, eq=False)
class _Rows:
    """Errors (pixels) and derivatives of all observations."""

    error: Float[np.ndarray, "n 2"]
    by_image: Float[np.ndarray, "n 2 6"]
    by_camera: Float[np.ndarray, "n 2 2"]
    by_point: Float[np.ndarray, "n 2 3"]


@dataclasses.dataclass(frozen=True, eq=False)
class _State:
    rotation: Float[np.ndarray, "images 3 3"]
    translation: Float[np.ndarray, "images 3"]
    points: Float[np.ndarray, "points 3"]
    parameters: Float[np.ndarray, "cameras parameters"]
    model: type[AbstractCamera]

    @staticmethod
    def of(block: Block) -> "_State":
        rotation = Rotation.from_quat(block.quaternion, scalar_first=True).as_matrix()
        model = CAMERAS[block.camera_model]
        return _State(rotation, block.translation_m, block.points_m, block.camera_parameters, model)

    def into(self, block: Block) -> Block:
        quaternion = Rotation.from_matrix(self.rotation).as_quat(canonical=True, scalar_first=True)
        return dataclasses.replace(
            block,
            quaternion=quaternion,
            translation_m=self.translation,
            points_m=self.points,
            camera_parameters=self.parameters,
        )

    @property
    def focal(self) -> Float[np.ndarray, " cameras"]:
        return self.parameters[:, 0]

    @property
    def k1(self) -> Float[np.ndarray, " cameras"]:
        return self.parameters[:, self.model.parameter_names().index("k1")]

    @property
    def center(self) -> Float[np.ndarray, "images 3"]:
        return -np.einsum("nji,nj->ni", self.rotation, self.translation)

    def rows(self, block: Block) -> _Rows:
        image, point = block.observation_image, block.observation_point
        rotation = self.rotation[image]
        in_cam = np.einsum("nij,nj->ni", rotation, self.points[point]) + self.translation[image]
        camera = self.parameters[block.camera_index[image]]
        xy, by_cam, by_k1 = _project(self.model, camera, in_cam)
        x, y, z = in_cam.T
        zero = np.zeros_like(x)
        turn = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], axis=1).reshape(-1, 3, 3)  # -[p]_x
        names = self.model.parameter_names()
        middle = camera[:, [names.index("cx"), names.index("cy")]]
        error = np.where(z[:, None] > 0, xy - block.observation_xy_px, 1e4)
        return _Rows(
            error=error,
            by_image=np.concatenate([by_cam @ turn, by_cam], axis=2),
            by_camera=np.stack([xy - middle, by_k1], axis=2),
            by_point=by_cam @ rotation,
        )

    def moved(
        self,
        image: Float[np.ndarray, "images 6"],
        camera: Float[np.ndarray, "cameras 2"],
        points: Float[np.ndarray, "points 3"],
    ) -> "_State":
        turn = Rotation.from_rotvec(image[:, :3]).as_matrix()
        parameters, names = self.parameters.copy(), self.model.parameter_names()
        for name in ("f", "fx", "fy"):
            if name in names:
                parameters[:, names.index(name)] *= 1 + np.clip(camera[:, 0], -0.5, 0.5)
        parameters[:, names.index("k1")] += camera[:, 1]
        return dataclasses.replace(
            self,
            rotation=turn @ self.rotation,
            translation=np.einsum("nij,nj->ni", turn, self.translation) + image[:, 3:],
            points=self.points + points,
            parameters=parameters,
        )


@dataclasses.dataclass(frozen=True, eq=False)
class _Prior:
    xyz_m: Float[np.ndarray, "images 3"]
    std_m: Float[np.ndarray, "images 3"]
    log_focal: Float[np.ndarray, " cameras"]
    focal_std: Float[np.ndarray, " cameras"]

    def position(self, state: _State) -> tuple[Float[np.ndarray, "images 3"], Float[np.ndarray, "images 3"]]:
        """Return residuals over sigmas, and 1/sigma (0 where there is no prior)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            weight = np.where(np.isfinite(self.xyz_m), 1 / self.std_m, 0.0)
        weight = np.nan_to_num(weight, nan=0.0, posinf=0.0)
        return (state.center - np.nan_to_num(self.xyz_m)) * weight, weight

    def camera(self, state: _State) -> tuple[Float[np.ndarray, "cameras 2"], Float[np.ndarray, "cameras 2"]]:
        weight = np.stack([1 / self.focal_std, np.full(len(self.focal_std), 1 / _K1_STD)], axis=1)
        return np.stack([np.log(state.focal) - self.log_focal, state.k1], axis=1) * weight, weight

    def cost(self, state: _State) -> float:
        squared = _joined(self.position(state)[0])[:, 1:]
        robust = _POSITION_LOSS**2 / 2 * np.log1p(squared / _POSITION_LOSS**2).sum()
        return float(robust + (self.camera(state)[0] ** 2).sum() / 2)


def _joined(residual: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Return the squares, of the horizontal as one vector: a wrong altitude says nothing of the horizontal position."""
    horizontal = (residual[:, :2] ** 2).sum(axis=1)
    return np.stack([horizontal, horizontal, residual[:, 2] ** 2], axis=1)


@dataclasses.dataclass(frozen=True, eq=False)
class _System:
    """Normal equations; images first, then cameras, points apart.

    `by_image`, `by_camera`: the blocks that join both with the points, and their places.
    """

    corner: sparse.csc_array
    by_image: "_Blocks"
    by_camera: "_Blocks"
    of_point: Float[np.ndarray, "points 3 3"]
    side: Float[np.ndarray, " unknowns"]
    side_point: Float[np.ndarray, "points 3"]

    @staticmethod
    def of(block: Block, state: _State, rows: _Rows, prior: _Prior, scale: float) -> "_System":
        image, point = block.observation_image, block.observation_point
        camera = block.camera_index[image]
        num_images, num_points, num_cameras = len(state.rotation), len(state.points), len(state.parameters)
        weight = 4 / scale**2 / (1 + (rows.error**2).sum(axis=1) / scale**2)
        a, k, b, e = rows.by_image, rows.by_camera, rows.by_point, rows.error[:, :, None]
        wa, wk, wb = (np.swapaxes(j * weight[:, None, None], 1, 2) for j in (a, k, b))

        def total(products: Float[np.ndarray, "n r c"], group: Int[np.ndarray, " n"], count: int) -> np.ndarray:
            summed = sum_rows(products.reshape(len(products), -1), group, count)
            return summed.reshape(count, *products.shape[1:])

        of_image, of_camera = total(wa @ a, image, num_images), total(wk @ k, camera, num_cameras)
        side_image, side_camera = total(wa @ e, image, num_images)[..., 0], total(wk @ e, camera, num_cameras)[..., 0]
        residual, inverse_std = prior.position(state)
        robust = 1 / (1 + _joined(residual) / _POSITION_LOSS**2)
        by_v = -np.swapaxes(state.rotation, 1, 2) * inverse_std[:, :, None]  # d residual / d v
        of_image[:, 3:, 3:] += np.swapaxes(by_v, 1, 2) @ (robust[:, :, None] * by_v)
        side_image[:, 3:] += np.einsum("nij,ni->nj", by_v, robust * residual)
        residual, inverse_std = prior.camera(state)
        of_camera += (inverse_std**2)[:, :, None] * np.eye(2)
        side_camera += inverse_std * residual

        mixed = total(wa @ k, image, num_images)
        border = block_matrix(mixed, np.arange(num_images), block.camera_index, (num_images, num_cameras))
        corner = sparse.block_array([[block_diagonal(of_image), border], [border.T, block_diagonal(of_camera)]])
        place, where = np.unique(camera * num_points + point, return_inverse=True)
        camera, at = np.divmod(place, num_points)
        return _System(
            corner=sparse.csc_array(corner.tocsc()),
            by_image=_Blocks(wa @ b, image, point, (num_images, num_points)),
            by_camera=_Blocks(total(wk @ b, where, len(place)), camera, at, (num_cameras, num_points)),
            of_point=total(wb @ b, point, num_points),
            side=np.concatenate([side_image.ravel(), side_camera.ravel()]),
            side_point=total(wb @ e, point, num_points)[..., 0],
        )

    def step(self, state: _State, damping: float) -> _State:
        of_point = self.of_point * (1 + damping * np.eye(3))
        of_point = of_point + 1e-12 * np.trace(of_point, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        inverse = np.linalg.inv(of_point)
        plain = [blocks.matrix() for blocks in (self.by_image, self.by_camera)]
        scaled = [blocks.matrix(inverse) for blocks in (self.by_image, self.by_camera)]
        mixed = scaled[0] @ plain[1].T
        through_points = sparse.block_array([[scaled[0] @ plain[0].T, mixed], [mixed.T, scaled[1] @ plain[1].T]])
        diagonal = self.corner.diagonal()
        ridge = sparse.diags_array(damping * diagonal + 1e-9 * diagonal.mean(), format="csc")
        reduced = self.corner - through_points.tocsc() + ridge
        side = self.side - np.concatenate([part @ self.side_point.ravel() for part in scaled])
        step = -solve_positive(reduced, side)
        split = 6 * len(state.rotation)
        pulled = plain[0].T @ step[:split] + plain[1].T @ step[split:]
        points = -(inverse @ (self.side_point + pulled.reshape(-1, 3))[:, :, None])[:, :, 0]
        return state.moved(step[:split].reshape(-1, 6), step[split:].reshape(-1, 2), points)


@dataclasses.dataclass(frozen=True, eq=False)
class _Blocks:
    """Blocks of the normal equations between unknowns (rows) and points (columns); `shape` counts blocks."""

    block: Float[np.ndarray, "blocks size 3"]
    row: Int[np.ndarray, " blocks"]
    point: Int[np.ndarray, " blocks"]
    shape: tuple[int, int]

    def matrix(self, inverse: Float[np.ndarray, "points 3 3"] | None = None) -> sparse.bsr_array:
        """Return the matrix, times the block diagonal of `inverse` where that is given."""
        block = self.block if inverse is None else self.block @ inverse[self.point]
        return block_matrix(block, self.row, self.point, self.shape)


def _project(
    model: type[AbstractCamera], parameters: Float[np.ndarray, "n parameters"], in_cam: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2 3"], Float[np.ndarray, "n 2"]]:
    """Return pixels and their derivatives by the point in the camera's frame and by k1."""
    num = len(in_cam)
    xy, by_cam, by_k1 = np.empty((num, 2)), np.empty((num, 2, 3)), np.empty((num, 2))
    with jax.enable_x64(True):
        for start in range(0, num, _CHUNK):
            rows = np.minimum(np.arange(start, start + _CHUNK), num - 1)  # the last one fills up
            here = slice(start, min(start + _CHUNK, num))
            found = np.asarray(_derivatives(model(*parameters[rows].T), in_cam[rows].T))[:, :, : here.stop - start]
            xy[here], by_cam[here], by_k1[here] = found[0].T, np.moveaxis(found[1:4], (2, 1, 0), (0, 1, 2)), found[4].T
    return xy, by_cam, by_k1


@fast_jit
def _derivatives(camera: AbstractCamera, in_cam: Float[Array | np.ndarray, "3 n"]) -> Float[Array, "5 2 n"]:
    """Return pixels, and their derivatives by x, y, z and k1."""

    point = jnp.asarray(in_cam)

    def project(in_cam: Array, k1: Array) -> Array:
        moved = dataclasses.replace(camera, k1=k1)
        z = jnp.where(in_cam[2] > 1e-9, in_cam[2], 1.0)
        return jnp.stack(moved.project_components(in_cam[0], in_cam[1], z))

    k1 = jnp.asarray(getattr(camera, "k1"))  # noqa: B009  # every model on offer has one
    still = jnp.zeros_like(k1)
    columns = [jnp.zeros_like(point).at[axis].set(1.0) for axis in range(3)]
    xy = project(point, k1)
    by_cam = [jax.jvp(project, (point, k1), (column, still))[1] for column in columns]
    by_k1 = jax.jvp(project, (point, k1), (jnp.zeros_like(point), jnp.ones_like(k1)))[1]
    return jnp.stack([xy, *by_cam, by_k1])
