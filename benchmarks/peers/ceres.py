"""Ceres on the same problem: cost functions in C++ from the pycolmap wheel, solver from the pyceres wheel.

COLMAP's pose block is (quaternion x y z w, translation), its point block is metres in the world, its camera block the
model's parameters. What COLMAP's model has and ours lacks is held constant: BAL's camera is RADIAL with its principal
point fixed at 0. Neither wheel exposes a way to order the elimination; Ceres itself picks the points.

COLMAP gives a point behind its camera the residual 0, which is not BAL's cost: `problem-49-7776` has 31 such
observations, which would lower its final cost from 13344 to 13308. For a point that starts there, the image is mirrored
instead: after half a turn about the camera's x axis, (x, y, z) -> (x, -y, -z), it lies in front and is seen at (-u, v).

Where all pixels have one sigma s, Ceres is given s times all residuals and loss scales, so s^2 times the cost, and
plain reprojection errors: with a covariance given to COLMAP the same steps take 1.5 times as long (500 images).
"""

import ctypes
import functools
import time

import numpy as np
import pyceres
import pycolmap
import pycolmap.cost_functions as costs

from benchmarks.cost import reprojection
from benchmarks.record import HistoryRow, Record, Values
from jaxba._errors import JaxbaError
from jaxba.ba import AbstractPrior, PositionPrior, Problem
from jaxba.geometry import AbstractLoss

_MODELS = {
    "SimplePinhole": ("SIMPLE_PINHOLE", ("f", "cx", "cy")),
    "Pinhole": ("PINHOLE", ("fx", "fy", "cx", "cy")),
    "SimpleRadial": ("SIMPLE_RADIAL", ("f", "cx", "cy", "k1")),
    "Radial": ("RADIAL", ("f", "cx", "cy", "k1", "k2")),
    "BAL": ("RADIAL", ("f", "cx", "cy", "k1", "k2")),
    "OpenCV": ("OPENCV", ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")),
    "OpenCVFisheye": ("OPENCV_FISHEYE", ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")),
}
"""COLMAP's model and the order of its parameters, for each of ours; what ours lacks is zero and constant."""


def solve_with_ceres(
    problem: Problem,
    loss: AbstractLoss,
    *,
    num_threads: int = 2,
    max_num_iterations: int = 100,
    linear_solver: str = "sparse_schur",
    function_tolerance: float = 1e-8,
) -> Record:
    """Solve a problem with Ceres's Levenberg-Marquardt, all other options at Ceres's defaults.

    Arguments: `loss` is applied once to each observation; `linear_solver` is a name of Ceres's, in lower case.
    `function_tolerance` is tighter than Ceres's 1e-6 so that it is not stopped before it comes near its minimum.

    Raises JaxbaError for what COLMAP has no cost function for: a lever arm, priors other than positions, k3.
    """
    blocks = _Blocks(problem)
    ceres_problem = pyceres.Problem()
    kept: list[object] = [blocks]  # Ceres holds addresses: everything it was given stays alive until it is done
    std_px = np.asarray(problem.observations.std_px, float)
    scale = float(std_px[0]) if np.all(std_px == std_px[0]) else 1.0
    _add_observations(ceres_problem, problem, blocks, loss, scale, kept)
    for prior in problem.priors:
        _add_position_prior(ceres_problem, problem, blocks, prior, scale, kept)
    _set_what_is_free(ceres_problem, problem, blocks, kept)

    history = _History()
    options = pyceres.SolverOptions()
    options.linear_solver_type = getattr(pyceres.LinearSolverType, linear_solver.upper())
    options.num_threads = num_threads
    options.max_num_iterations = max_num_iterations
    options.function_tolerance = function_tolerance
    options.logging_type = pyceres.LoggingType.SILENT
    pyceres.logging.minloglevel = 2  # a factorisation that fails is a rejected step, in the history, and no line
    options.callbacks = [history]
    summary = pyceres.SolverSummary()
    start = time.perf_counter()
    pyceres.solve(options, ceres_problem, summary)
    seconds_total = time.perf_counter() - start

    preprocess = summary.preprocessor_time_in_seconds
    rows: list[HistoryRow] = [
        {**row, "seconds": row["seconds"] - preprocess, "cost": row["cost"] / scale**2} for row in history.rows
    ]
    return Record(
        solver=f"Ceres {pyceres.__ceres_version__} {linear_solver}",
        initial_cost=summary.initial_cost / scale**2,
        final_cost=summary.final_cost / scale**2,
        history=rows,
        seconds_preprocess=preprocess,
        seconds_compile=0.0,
        seconds_total=seconds_total,
        termination=summary.message,
        num_iterations=len(rows) - 1,
        values=blocks.values(),
    )


class _Blocks:
    """Parameter blocks in COLMAP's layout, one row a block, and back."""

    def __init__(self, problem: Problem) -> None:
        start = Values.of(problem)
        model = type(problem.cameras)
        name, fields = _MODELS[model.__name__]
        self.model_id = getattr(pycolmap.CameraModelId, name)
        self.ours = model.parameter_names()
        self.column = {field: column for column, field in enumerate(fields)}
        for index, field in enumerate(self.ours):
            if field not in fields and (start.intrinsics[:, index].any() or problem.free.intrinsics[:, index].any()):
                raise JaxbaError(f"intrinsic {field}: COLMAP's {name} has none; set it to 0 and fix it.")
        self.poses = np.concatenate([np.roll(start.quaternion, -1, axis=1), start.translation], axis=1)
        self.points = start.points
        self.cameras = np.zeros((start.intrinsics.shape[0], len(fields)))
        for index, field in enumerate(self.ours):
            if field in fields:
                self.cameras[:, self.column[field]] = start.intrinsics[:, index]

    def values(self) -> Values:
        intrinsics = np.zeros((self.cameras.shape[0], len(self.ours)))
        for index, field in enumerate(self.ours):
            if field in self.column:
                intrinsics[:, index] = self.cameras[:, self.column[field]]
        quaternion = np.roll(self.poses[:, :4], 1, axis=1)
        return Values(quaternion, self.poses[:, 4:].copy(), intrinsics, self.points.copy())


class _History(pyceres.IterationCallback):
    """Collects cost and time of every step; the time counts from the start of the solve."""

    def __init__(self) -> None:
        pyceres.IterationCallback.__init__(self)
        self.rows: list[HistoryRow] = []

    def __call__(self, step: pyceres.IterationSummary) -> pyceres.CallbackReturnType:
        self.rows.append(
            {
                "step": step.iteration,
                "seconds": step.cumulative_time_in_seconds,
                "cost": step.cost,
                "accepted": step.step_is_successful or step.iteration == 0,
            }
        )
        return pyceres.CallbackReturnType.SOLVER_CONTINUE


def _add_observations(
    ceres_problem: pyceres.Problem,
    problem: Problem,
    blocks: _Blocks,
    loss: AbstractLoss,
    scale: float,
    kept: list[object],
) -> None:
    observations = problem.observations
    ceres_loss = _ceres_loss(loss, scale)
    kept.append(ceres_loss)
    poses, points, cameras = list(blocks.poses), list(blocks.points), list(blocks.cameras)
    std_px = np.asarray(observations.std_px, float) / scale
    covariance = np.square(std_px)[:, None, None] * np.eye(2)
    unit = bool(np.all(std_px == 1))
    image_index, point_index = np.asarray(observations.image_index), np.asarray(observations.point_index)
    camera_index = np.asarray(problem.camera_index)[image_index]
    xy_px = np.array(observations.xy_px, float)
    for k, (xy, image, point, camera) in enumerate(zip(xy_px, image_index, point_index, camera_index, strict=True)):
        cost = (
            costs.ReprojErrorCost(blocks.model_id, xy)
            if unit
            else costs.ReprojErrorCost(blocks.model_id, covariance[k], xy)
        )
        ceres_problem.add_residual_block(cost, ceres_loss, [points[point], poses[image], cameras[camera]])

    # behind the camera COLMAP's residual is 0, BAL's is not: a second one looks back, and is 0 in front
    _, depth = reprojection(problem, Values.of(problem))
    if not np.any(depth <= 0):
        return
    if type(problem.cameras).__name__ != "BAL" or not unit:
        raise JaxbaError(f"{np.count_nonzero(depth <= 0)} points start behind their camera; COLMAP leaves them out.")
    half_turn = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([1.0, 0.0, 0.0, 0.0])), np.zeros(3))
    for k in np.flatnonzero(depth <= 0):
        cost = costs.RigReprojErrorCost(blocks.model_id, xy_px[k] * [-1, 1], half_turn)
        image, point, camera = image_index[k], point_index[k], camera_index[k]
        ceres_problem.add_residual_block(cost, ceres_loss, [points[point], poses[image], cameras[camera]])


def _add_position_prior(
    ceres_problem: pyceres.Problem,
    problem: Problem,
    blocks: _Blocks,
    prior: AbstractPrior,
    scale: float,
    kept: list[object],
) -> None:
    if not isinstance(prior, PositionPrior) or np.any(problem.lever_arm) or problem.free.lever_arm:
        raise JaxbaError("priors: this comparison knows position priors without a lever arm only; remove the others.")
    ceres_loss = _ceres_loss(prior.loss, scale)
    kept.append(ceres_loss)
    for image, xyz, std in zip(prior.image_index, np.asarray(prior.xyz), np.asarray(prior.std_m), strict=True):
        cost = costs.AbsolutePosePositionPriorCost(np.diag(np.square(std / scale)), xyz)
        ceres_problem.add_residual_block(cost, ceres_loss, [blocks.poses[image]])


def _set_what_is_free(ceres_problem: pyceres.Problem, problem: Problem, blocks: _Blocks, kept: list[object]) -> None:
    manifold = _pose_manifold()
    for pose, free in zip(blocks.poses, problem.free.poses, strict=True):
        if ceres_problem.has_parameter_block(pose):
            ceres_problem.set_manifold(pose, manifold)
            if not free:
                ceres_problem.set_parameter_block_constant(pose)
    for index in np.flatnonzero(~np.asarray(problem.free.points)):
        if ceres_problem.has_parameter_block(blocks.points[index]):
            ceres_problem.set_parameter_block_constant(blocks.points[index])
    for row, camera in enumerate(blocks.cameras):
        free_columns = {
            blocks.column[field]: index
            for index, field in enumerate(blocks.ours)
            if field in blocks.column and problem.free.intrinsics[row, index]
        }
        constant = [column for column in range(camera.size) if column not in free_columns]
        if not free_columns:
            ceres_problem.set_parameter_block_constant(camera)
        elif constant:
            subset = pyceres.SubsetManifold(camera.size, constant)
            kept.append(subset)
            ceres_problem.set_manifold(camera, subset)
        for column, index in free_columns.items():
            if np.isfinite(problem.lower[row, index]):
                ceres_problem.set_parameter_lower_bound(camera, column, problem.lower[row, index])
            if np.isfinite(problem.upper[row, index]):
                ceres_problem.set_parameter_upper_bound(camera, column, problem.upper[row, index])


def _ceres_loss(loss: AbstractLoss, residual_scale: float) -> pyceres.LossFunction:
    """Return Ceres's loss with the same cost; Ceres's arctan scales the squared norm, all others the norm."""
    scale = float(loss.f_scale) * residual_scale
    match type(loss).__name__:
        case "Linear":
            return pyceres.TrivialLoss()
        case "Huber":
            return pyceres.HuberLoss(scale)
        case "SoftL1":
            return pyceres.SoftLOneLoss(scale)
        case "Cauchy":
            return pyceres.CauchyLoss(scale)
        case "Arctan":
            return pyceres.LossFunction({"name": "arctan", "params": [scale * scale]})
        case name:
            raise JaxbaError(f"loss {name}: Ceres's wheel has linear, huber, soft_l1, cauchy and arctan.")


@functools.cache
def _pose_manifold() -> pyceres.Manifold:
    """Return the manifold of COLMAP's pose block, borrowed from one of COLMAP's own adjustments.

    pyceres has no product of manifolds, and none can be written in Python. The Python object that it hands out would
    delete what COLMAP owns, so a reference more is counted than there is and neither is ever deleted.
    """
    options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=2, num_points3D=10)
    reconstruction = pycolmap.synthesize_dataset(options)
    config = pycolmap.BundleAdjustmentConfig()
    for image in reconstruction.reg_image_ids():
        config.add_image(image)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(pycolmap.BundleAdjustmentOptions(), config, reconstruction)
    pose = reconstruction.frame(reconstruction.reg_frame_ids()[0]).rig_from_world
    assert pose is not None  # registered
    manifold = adjuster.problem.get_manifold(pose.params)
    for never_deleted in (manifold, adjuster, reconstruction):
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(never_deleted))
    return manifold
