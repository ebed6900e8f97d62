"""GTSAM on the same problem: its Levenberg-Marquardt and its Bundler cameras, from the gtsam wheel.

An unknown of GTSAM's is a whole camera: pose, `f`, `k1` and `k2` together. So it takes problems in which every image
has a camera of its own and each camera is BAL's. GTSAM's camera looks along +z with y down, as jaxba's does; its pose
is world from camera.

Chosen by measurement on bal21 and bal49: `LevenbergMarquardtParams.CeresDefaults()`, multifrontal Cholesky, and points
first in COLAMD's ordering. METIS's ordering takes as long. GTSAM's optimizer for structure from motion, with the linear
solver that is its default, takes 1.2 and 2.2 times as long to 0.1%. The older defaults of the damping take more steps.
The wheel is built without TBB, so one thread does all of it.

GTSAM gives a point behind its camera the residual 0, which is not BAL's cost. A point that starts there is also seen by
its camera turned half about the x axis, as in `benchmarks.peers.ceres`; a factor in Python has these residuals.

Preprocessing is the ordering and making the optimizer. The symbolic analysis is a part of each step: GTSAM repeats it.
"""

import dataclasses
import time
from importlib.metadata import version

import gtsam
import numpy as np
from gtsam.symbol_shorthand import P
from scipy.spatial.transform import Rotation

from benchmarks.cost import reprojection
from benchmarks.record import HistoryRow, Record, Values
from jaxba.ba import Problem
from jaxba.geometry import AbstractLoss

_HALF_TURN = gtsam.Pose3(gtsam.Rot3(np.diag([1.0, -1.0, -1.0])), np.zeros(3))
_TURNED = np.array([1.0, -1.0, -1.0, 1.0, -1.0, -1.0])
"""Signs of a camera's small motion, rotation and then translation, in the axes of the turned camera."""
_MIRROR = np.array([-1.0, 1.0])


def why_left_out(problem: Problem, loss: AbstractLoss) -> str | None:
    """Return what GTSAM has no factor for here, in words, or None."""
    if type(problem.cameras).__name__ != "BAL":
        return f"GTSAM's factors have BAL's camera; this problem's is {type(problem.cameras).__name__}"
    if problem.num_cameras != problem.num_images or problem.priors:
        return "each image has a camera of its own in GTSAM's factors, and no priors are made for it here"
    free = problem.free
    if not (np.all(free.poses) and np.all(free.points) and np.all(free.intrinsics)):
        return "all unknowns of GTSAM's factors are free, and some of this problem's are held"
    if np.any(np.isfinite(problem.lower)) or np.any(np.isfinite(problem.upper)):
        return "GTSAM has no bounds, and this problem's intrinsics have some"
    if type(loss).__name__ not in ("Linear", "Huber"):
        return f"loss {type(loss).__name__} is not made for GTSAM here, linear and huber are"
    return None


def solve_with_gtsam(
    problem: Problem, loss: AbstractLoss, *, max_num_iterations: int = 100, function_tolerance: float = 1e-8
) -> Record:
    """Solve a problem that is not left out with GTSAM's Levenberg-Marquardt.

    A step of its history is an accepted one: GTSAM tries larger dampings within a step until the cost falls.
    `function_tolerance` is that of `benchmarks.peers.ceres`.
    """
    graph, initial = _graph(problem, loss), _initial(Values.of(problem))
    history: list[HistoryRow] = [{"step": 0, "seconds": 0.0, "cost": graph.error(initial), "accepted": True}]
    params = gtsam.LevenbergMarquardtParams.CeresDefaults()
    params.setMaxIterations(max_num_iterations)
    params.setRelativeErrorTol(function_tolerance)

    def note(step: int, _: float, cost: float) -> None:
        seconds = time.perf_counter() - first_step
        history.append({"step": step, "seconds": seconds, "cost": cost, "accepted": cost < history[-1]["cost"]})

    params.iterationHook = note
    start = time.perf_counter()
    points = [P(index) for index in range(problem.num_points)]
    ordering = gtsam.Ordering.ColamdConstrainedFirstNonlinearFactorGraph(graph, points)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, initial, ordering, params)
    first_step = time.perf_counter()
    solved = optimizer.optimize()
    seconds_total = time.perf_counter() - start
    num_iterations = optimizer.iterations()
    return Record(
        solver=f"GTSAM {version('gtsam')}",
        initial_cost=history[0]["cost"],
        final_cost=optimizer.error(),
        history=history,
        seconds_preprocess=first_step - start,
        seconds_compile=0.0,
        seconds_total=seconds_total,
        termination="most steps" if num_iterations >= max_num_iterations else "cost no longer falls",
        num_iterations=num_iterations,
        values=_values(solved, problem),
    )


def _graph(problem: Problem, loss: AbstractLoss) -> gtsam.NonlinearFactorGraph:
    """Return a factor for each observation, and one more for all that are behind their camera at the start."""
    observations = problem.observations
    std_px, noise_of = np.asarray(observations.std_px, float), {}
    for std in np.unique(std_px):
        noise_of[std] = gtsam.noiseModel.Isotropic.Sigma(2, std)
        if type(loss).__name__ == "Huber":
            huber = gtsam.noiseModel.mEstimator.Huber.Create(float(loss.f_scale))
            noise_of[std] = gtsam.noiseModel.Robust.Create(huber, noise_of[std])
    images, points = np.asarray(observations.image_index).tolist(), np.asarray(observations.point_index).tolist()
    graph = gtsam.NonlinearFactorGraph()
    for k, xy in enumerate(np.asarray(observations.xy_px, float)):
        graph.add(gtsam.GeneralSFMFactorCal3Bundler(xy, noise_of[std_px[k]], images[k], P(points[k])))
    _, depth = reprojection(problem, Values.of(problem))
    behind = [
        _Behind(np.asarray(observations.xy_px[k], float), std_px[k], images[k], P(points[k]))
        for k in np.flatnonzero(depth <= 0)
    ]
    if behind:
        graph.add(_factor_behind(behind, loss))
    return graph


@dataclasses.dataclass(frozen=True)
class _Behind:
    """An observation whose point is behind its camera at the start."""

    xy_px: np.ndarray
    std_px: float
    camera_key: int
    point_key: int

    def residual(self, values: gtsam.Values) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return BAL's residual over its sigma and its derivatives by camera and point; all 0 for a point in front.

        The turned camera sees the point at (-u, v), since (x, y, z) -> (x, -y, -z) has y / z unchanged.
        """
        camera, at = values.atPinholeCameraCal3Bundler(self.camera_key), values.atPoint3(self.point_key)
        turned = gtsam.PinholeCameraCal3Bundler(camera.pose().compose(_HALF_TURN), camera.calibration())
        if not turned.projectSafe(at)[1]:
            return np.zeros(2), np.zeros((2, 9)), np.zeros((2, 3))
        by_pose, by_point, by_intrinsics = (np.zeros((2, columns), order="F") for columns in (6, 3, 3))
        uv = turned.project(at, by_pose, by_point, by_intrinsics)
        by_camera = np.hstack([by_pose * _TURNED, by_intrinsics])
        mirror = _MIRROR[:, None] / self.std_px
        return (uv * _MIRROR - self.xy_px) / self.std_px, mirror * by_camera, mirror * by_point


def _factor_behind(behind: list[_Behind], loss: AbstractLoss) -> gtsam.CustomFactor:
    """Return one factor for all: each call of a factor in Python copies all values of the problem first.

    It scales its residuals by the loss, as GTSAM's robust noise does: for a step by the root of the weight, for the
    cost so that half their square is the loss.
    """
    keys = sorted({each.camera_key for each in behind}) + sorted({each.point_key for each in behind})
    column = {key: index for index, key in enumerate(keys)}
    k = float(loss.f_scale) if type(loss).__name__ == "Huber" else np.inf

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[np.ndarray] | None) -> np.ndarray:
        residuals = np.zeros((len(behind), 2))
        blocks = [np.zeros((len(behind), 2, 3 if gtsam.Symbol(key).chr() else 9)) for key in keys]
        for row, each in enumerate(behind):
            residual, by_camera, by_point = each.residual(values)
            over = max(float(np.linalg.norm(residual)) / k, 1.0)  # Huber's residual over its scale, 1 within
            scale = over**-0.5 if jacobians is not None else np.sqrt(2 * over - 1) / over
            residuals[row] = scale * residual
            blocks[column[each.camera_key]][row] = scale * by_camera
            blocks[column[each.point_key]][row] = scale * by_point
        if jacobians is not None:
            for index, block in enumerate(blocks):
                jacobians[index] = block.reshape(2 * len(behind), -1)
        return residuals.reshape(-1)

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(2 * len(behind)), keys, error)


def _initial(values: Values) -> gtsam.Values:
    world_from_cam = Rotation.from_quat(values.quaternion, scalar_first=True).inv()
    centers = -world_from_cam.apply(values.translation)
    initial = gtsam.Values()
    for image, rotation in enumerate(world_from_cam.as_matrix()):
        pose = gtsam.Pose3(gtsam.Rot3(rotation), centers[image])
        f, k1, k2 = values.intrinsics[image]
        initial.insert(image, gtsam.PinholeCameraCal3Bundler(pose, gtsam.Cal3Bundler(f, k1, k2, 0, 0)))
    for index, xyz in enumerate(values.points):
        initial.insert(P(index), xyz)
    return initial


def _values(solved: gtsam.Values, problem: Problem) -> Values:
    cameras = [solved.atPinholeCameraCal3Bundler(image) for image in range(problem.num_images)]
    cam_from_world = [camera.pose().inverse() for camera in cameras]
    calibrations = [camera.calibration() for camera in cameras]
    return Values(
        Rotation.from_matrix([pose.rotation().matrix() for pose in cam_from_world]).as_quat(scalar_first=True),
        np.array([pose.translation() for pose in cam_from_world]),
        np.array([(each.fx(), each.k1(), each.k2()) for each in calibrations]),
        np.array([solved.atPoint3(P(index)) for index in range(problem.num_points)]),
    )
