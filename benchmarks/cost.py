"""The cost of a solution, computed once more in plain numpy and scipy, the same way for every solver.

    cost = 1/2 sum over observations of rho(|r / sigma|^2)  +  1/2 sum over priors' rows of rho(|r / sigma|^2)

Written apart from `jaxba.geometry` and `jaxba.ba` on purpose: it shares no formula with what it judges.
"""

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.record import Values
from jaxba._errors import JaxbaError
from jaxba.ba import PositionPrior, Problem
from jaxba.geometry import AbstractLoss

_RHO: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "Linear": lambda z: z,
    "SoftL1": lambda z: 2 * (np.sqrt(1 + z) - 1),
    "Huber": lambda z: np.where(z <= 1, z, 2 * np.sqrt(z) - 1),
    "Cauchy": np.log1p,
    "Arctan": np.arctan,
}


def cost_of(problem: Problem, loss: AbstractLoss, values: Values) -> float:
    """Return the cost of `values` in a problem's observations and priors."""
    residuals, _ = reprojection(problem, values)
    total = _robust_sum(loss, residuals)
    for prior in problem.priors:
        if not isinstance(prior, PositionPrior) or np.any(problem.lever_arm):
            raise JaxbaError(f"prior {prior.name}: benchmarks know position priors without a lever arm only.")
        index = np.asarray(prior.image_index)
        centers = -_rotations(values, index).inv().apply(values.translation[index])
        total += _robust_sum(prior.loss, (centers - np.asarray(prior.xyz)) / np.asarray(prior.std_m))
    return total / 2


def reprojection(problem: Problem, values: Values) -> tuple[np.ndarray, np.ndarray]:
    """Return the residuals over their sigmas, (n, 2), and the depths in the camera's frame, metres."""
    observations = problem.observations
    image = np.asarray(observations.image_index)
    point = values.points[np.asarray(observations.point_index)]
    in_cam = _rotations(values, image).apply(point) + values.translation[image]
    intrinsics = values.intrinsics[np.asarray(problem.camera_index)[image]].T
    parameters = dict(zip(type(problem.cameras).parameter_names(), intrinsics, strict=True))
    pixels = _project(type(problem.cameras).__name__, parameters, in_cam)
    std_px = np.asarray(observations.std_px)[:, None]
    return (pixels - np.asarray(observations.xy_px)) / std_px, in_cam[:, 2]


def _project(model: str, parameters: dict[str, np.ndarray], in_cam: np.ndarray) -> np.ndarray:
    def get(name: str) -> np.ndarray | float:
        return parameters.get(name, 0.0)

    if model == "OpenCVFisheye":
        raise JaxbaError("camera OpenCVFisheye: benchmarks use pinhole cameras with radial and tangential distortion.")
    xy = in_cam[:, :2] / in_cam[:, 2:]
    r2 = np.sum(xy**2, axis=1)
    radial = 1 + get("k1") * r2 + get("k2") * r2**2 + get("k3") * r2**3
    x, y = xy.T
    u = x * radial + 2 * get("p1") * x * y + get("p2") * (r2 + 2 * x**2)
    v = y * radial + get("p1") * (r2 + 2 * y**2) + 2 * get("p2") * x * y
    fx, fy = (parameters["f"],) * 2 if "f" in parameters else (parameters["fx"], parameters["fy"])
    return np.stack([fx * u + get("cx"), fy * v + get("cy")], axis=1)


def _rotations(values: Values, image: np.ndarray) -> Rotation:
    return Rotation.from_quat(values.quaternion[image], scalar_first=True)


def _robust_sum(loss: AbstractLoss, residuals: np.ndarray) -> float:
    squared_scale = float(loss.f_scale) ** 2
    squared_norm = np.sum(residuals**2, axis=1)
    return float(np.sum(squared_scale * _RHO[type(loss).__name__](squared_norm / squared_scale)))
