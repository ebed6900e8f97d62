"""Small bundle adjustment problems of every camera model, with every prior."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from quick_jit import quick_jit
from scipy.spatial.transform import Rotation

from jaxba.ba import (
    AttitudePrior,
    ControlPointPrior,
    IntrinsicsPrior,
    LeverArmPrior,
    Observations,
    PositionOffsetPrior,
    PositionPrior,
    Problem,
    with_scale_bars,
)
from jaxba.geometry import (
    BAL,
    AbstractCamera,
    AbstractLoss,
    Arctan,
    Barron,
    Cauchy,
    GemanMcClure,
    Huber,
    Linear,
    OpenCV,
    OpenCVFisheye,
    Pinhole,
    Pose,
    Radial,
    SimplePinhole,
    SimpleRadial,
    SoftL1,
    Tukey,
)

EVERY_CAMERA = (
    SimplePinhole(f=800.0, cx=500.0, cy=400.0),
    Pinhole(fx=800.0, fy=805.0, cx=500.0, cy=400.0),
    SimpleRadial(f=800.0, cx=500.0, cy=400.0, k1=-0.05),
    Radial(f=800.0, cx=500.0, cy=400.0, k1=-0.05, k2=0.02),
    OpenCV(fx=800.0, fy=805.0, cx=500.0, cy=400.0, k1=-0.05, k2=0.02, p1=0.001, p2=-0.002, k3=0.003),
    OpenCVFisheye(fx=800.0, fy=805.0, cx=500.0, cy=400.0, k1=-0.05, k2=0.02, k3=-0.01, k4=0.002),
    BAL(f=800.0, k1=-0.05, k2=0.02),
)
"""One camera of every model."""

RADIAL = EVERY_CAMERA[3]


class OneOf(AbstractLoss):
    """The loss at `index` of `LOSSES`, chosen at run time, so that one compilation serves all of them."""

    index: Array | np.ndarray
    f_scale: Array | np.ndarray

    def rho(self, z: Array) -> Array:
        # a number among numbers: the solver's systems hold losses as floats
        return jax.lax.switch(jnp.asarray(self.index).astype(jnp.int32), [loss.rho for loss in LOSSES], z)


LOSSES = (
    *(Linear(), SoftL1(1.5), Huber(1.5), Cauchy(2.0), Arctan(6.0)),
    *(Tukey(15.0), GemanMcClure(6.0), Barron(alpha=-1.0, f_scale=4.0), Barron(alpha=1.5, f_scale=2.0)),
)
"""Every loss, with a scale that leaves most of a small problem's residuals their influence."""


def one_of(index: int) -> OneOf:
    """Return `LOSSES[index]` as a loss that shares its compilation with the others."""
    return OneOf(np.array(float(index)), np.array(LOSSES[index].f_scale, float))


_project = quick_jit(lambda camera, point_in_cam: camera.project(point_in_cam))


def small_problem(
    camera: AbstractCamera,
    *,
    num_images: int = 5,
    num_points: int = 20,
    num_cameras: int = 1,
    seen_by: int = 4,
    lever_arm: bool = False,
    position_offset: bool = False,
    num_outliers: int = 0,
    prior_loss: AbstractLoss | None = None,
    at_truth: bool = False,
    seed: int = 0,
) -> Problem:
    """Return a flight along x, 3 m between images and 10 m above the points, with all five priors.

    Each point lies in the `seen_by` nearest images but for every sixth observation; pixels have 0.5 px of noise and
    outliers 30 px. The last image has no measured height, the last camera no calibrated last parameter and the last
    control point no surveyed height. Cameras look down with any heading, tilted by 0.15 rad. Start
    values are some sigmas off, or the truth. `position_offset`: two, of the first and the second half of the images.
    """
    rng = np.random.default_rng(seed)
    prior_loss = Linear() if prior_loss is None else prior_loss
    names = camera.parameter_names()
    along = 3.0 * np.arange(num_images)
    centers = np.column_stack([along, rng.uniform(-2, 2, num_images), 10 + rng.uniform(-1, 1, num_images)])
    headings = Rotation.from_rotvec([0, 0, 1] * rng.uniform(-np.pi, np.pi, (num_images, 1)))
    down = Rotation.from_rotvec([np.pi, 0, 0]) * headings
    attitudes = Rotation.from_rotvec(0.15 * rng.normal(size=(num_images, 3))) * down
    points = np.column_stack(
        [rng.uniform(0, along[-1], num_points), rng.uniform(-4, 4, num_points), rng.uniform(-1.5, 1.5, num_points)]
    )
    arm = np.array([0.1, -0.2, 0.3]) * lever_arm

    camera_index = rng.permutation(np.arange(num_images) % num_cameras).astype(np.int32)
    scale = np.array([1e-3 if n.startswith("f") else 1.0 if n.startswith("c") else 1e-2 for n in names])
    parameters = np.array([float(getattr(camera, n)) for n in names])
    scale = np.where([n.startswith("f") for n in names], scale * parameters, scale)
    true_parameters = parameters + scale * rng.normal(size=(num_cameras, len(names))) * (num_cameras > 1)

    distance = np.abs(points[None, :, 0] - along[:, None])
    seen = np.argsort(np.argsort(distance, axis=0), axis=0) < seen_by
    image_index, point_index = (index.astype(np.int32) for index in np.nonzero(seen))
    kept = rng.permutation(len(image_index)) >= len(image_index) // 6
    image_index, point_index = image_index[kept], point_index[kept]
    in_cam = attitudes[image_index].apply(points[point_index] - centers[image_index])
    of_row = type(camera)(*true_parameters[camera_index[image_index]].T)
    xy_px = np.asarray(_project(of_row, in_cam)) + 0.5 * rng.normal(size=(len(image_index), 2))
    outliers = rng.permutation(len(xy_px))[:num_outliers]
    xy_px[outliers] += 30 * rng.normal(size=(num_outliers, 2))

    gnss_std_m = np.tile([0.05, 0.04, 0.06], (num_images, 1))
    antennas = centers + attitudes.inv().apply(arm) + gnss_std_m * rng.normal(size=(num_images, 3))
    gnss_std_m[-1, 2] = np.inf
    gimbal = Rotation.from_rotvec(0.02 * rng.normal(size=(num_images, 3))) * attitudes
    with_attitude = np.arange(0, num_images, 2, dtype=np.int32)
    calibration_std = np.tile(2 * scale, (num_cameras, 1))
    calibrated = true_parameters + calibration_std * rng.normal(size=true_parameters.shape)
    calibration_std[-1, -1] = np.inf
    control = np.array([num_points - 1, 0, num_points // 2], np.int32)
    control_std_m = np.tile([0.02, 0.02, 0.03], (3, 1))
    surveyed = points[control] + control_std_m * rng.normal(size=(3, 3))
    control_std_m[-1, 2] = np.inf
    measured_arm = arm + 0.05 * rng.normal(size=3) * lever_arm
    every_image, every_camera = np.arange(num_images, dtype=np.int32), np.arange(num_cameras, dtype=np.int32)
    priors = [
        PositionPrior(
            every_image[::-1].copy(),
            antennas[::-1],
            gnss_std_m[::-1],
            prior_loss,
            of_flights(every_image[::-1], num_images) if position_offset else None,
        ),
        AttitudePrior(
            with_attitude,
            gimbal.as_quat(scalar_first=True)[with_attitude],
            np.full((len(with_attitude), 3), 0.02),
            prior_loss,
        ),
        IntrinsicsPrior(every_camera, calibrated, calibration_std),
        ControlPointPrior(control, surveyed, control_std_m, prior_loss),
    ]
    if lever_arm:
        priors.append(LeverArmPrior(measured_arm[None], np.full((1, 3), 0.05)))
    if position_offset:
        expected = np.array([[0.02, -0.01, 0.03], [-0.03, 0.02, 0.01]])
        priors.append(PositionOffsetPrior(expected, np.array([[0.05, 0.06, 0.2], [0.08, 0.05, 0.1]])))

    off = 0.0 if at_truth else 1.0
    start = Rotation.from_rotvec(off * 0.003 * rng.normal(size=(num_images, 3))) * attitudes
    start_centers = centers + off * 0.03 * rng.normal(size=centers.shape)
    start_parameters = true_parameters + off * scale * rng.normal(size=true_parameters.shape)
    problem = Problem.build(
        Pose(start.as_quat(scalar_first=True), -start.apply(start_centers)),
        type(camera)(*start_parameters.T),
        points + off * 0.03 * rng.normal(size=points.shape),
        Observations(xy_px, rng.uniform(0.4, 0.8, len(xy_px)), image_index, point_index),
        camera_index=camera_index,
        priors=priors,
        lever_arm=measured_arm,
    )
    problem = eqx.tree_at(lambda p: p.free.lever_arm, problem, np.array(lever_arm))
    if not position_offset:
        return problem
    offset = np.array([[0.01, -0.02, 0.04], [-0.01, 0.03, 0.02]]), np.array(True)
    return eqx.tree_at(lambda p: (p.position_offset, p.free.position_offset), problem, offset)


def with_bars(problem: Problem) -> Problem:
    """Return a problem with two scale bars, which have a point in common and are longer and shorter than they look."""
    apart_m = np.linalg.norm(problem.points[[2, 9]] - problem.points[[9, 5]], axis=1)
    return with_scale_bars(problem, [2, 9], [9, 5], apart_m + np.array([0.15, -0.2]), [0.02, 0.05])


def of_flights(images: np.ndarray, num_images: int) -> np.ndarray:
    """Weights of two position offsets: of the first and the second half of the images."""
    return np.eye(2)[np.asarray(images) * 2 // num_images]


def two_flights(problem: Problem) -> Problem:
    """Return a problem with one position offset with two, of the first and the second half of its images."""
    position, offset = problem.prior("position"), problem.prior("position_offset")
    changed = {
        "position": dataclasses.replace(position, offset_weights=of_flights(position.image_index, problem.num_images)),
        "position_offset": PositionOffsetPrior(
            np.repeat(offset.xyz, 2, axis=0), np.repeat(offset.std_m, 2, axis=0) * [[1.0], [0.5]]
        ),
    }
    priors = tuple(changed.get(prior.name, prior) for prior in problem.priors)
    return dataclasses.replace(problem, priors=priors, position_offset=np.repeat(problem.position_offset, 2, axis=0))


def bounded(problem: Problem, half_width: float) -> Problem:
    """Bound each camera's focal length and last parameter about its start values, by so many times 1 px or 0.01."""
    names = problem.cameras.parameter_names()
    lower, upper = problem.lower.copy(), problem.upper.copy()
    for column, width in ((0, 1.0), (len(names) - 1, 1.0 if names[-1].startswith("c") else 0.01)):
        start = np.asarray(getattr(problem.cameras, names[column]))
        lower[:, column], upper[:, column] = start - half_width * width, start + half_width * width
    return eqx.tree_at(lambda p: (p.lower, p.upper), problem, (lower, upper))
