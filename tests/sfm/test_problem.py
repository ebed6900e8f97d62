"""What a block and its reference become in an adjustment problem."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxba.ba import free_gauge
from jaxba.scene import Block
from jaxba.sfm import free_parameters, to_problem, with_points
from jaxba.sfm._problem import is_collinear
from jaxba.simulation.staged import Simulated, simulate

NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")


@pytest.fixture(scope="module")
def survey() -> Simulated:
    return simulate(9, seed=5, points_per_image=40.0)


@pytest.fixture(scope="module")
def block(survey: Simulated) -> Block:
    return with_points(survey.block, survey.tracks, min_angle_rad=0.02, max_error_px=20.0)


def test_used_positions_become_robust_priors(survey: Simulated, block: Block) -> None:
    used = survey.reference.is_used.copy()
    used[[2, 4]] = False
    prior: Any = to_problem(block, replace(survey.reference, is_used=used), survey.photos).prior("position")
    np.testing.assert_array_equal(prior.image_index, np.flatnonzero(used))
    np.testing.assert_array_equal(prior.xyz, survey.reference.xyz_m[used])
    near, far = (float(prior.loss.derivatives(jnp.array([s**2]))[1][0]) for s in (1.0, 5.0))
    assert near > 0.85 and far < 0.2  # a fix at five sigmas has lost four fifths of its weight


def test_an_axis_that_is_not_measured_has_no_weight(survey: Simulated, block: Block) -> None:
    std, xyz = survey.reference.std_m.copy(), survey.reference.xyz_m.copy()
    std[3, 2], xyz[5, 2] = np.inf, np.nan
    prior: Any = to_problem(block, replace(survey.reference, std_m=std, xyz_m=xyz), survey.photos).prior("position")
    assert np.isinf(prior.std_m[[3, 5], 2]).all() and np.isfinite(prior.xyz).all()
    assert np.isinf(prior.std_m).sum() == 2


def test_nothing_is_free_to_drift_whatever_is_measured(survey: Simulated, block: Block) -> None:
    reference, nowhere = survey.reference, replace(block, is_georeferenced=False)
    no_heights = replace(reference, std_m=np.where([True, True, False], reference.std_m, np.inf))
    one = replace(reference, is_used=np.arange(9) == 0)
    for case in ((block, reference), (nowhere, reference), (block, no_heights), (block, one)):
        assert free_gauge(to_problem(*case, survey.photos)) == ()


def test_attitudes_of_a_flight_together_count_once(survey: Simulated, block: Block) -> None:
    std = np.full((9, 3), 0.05)
    measured = replace(survey.reference, quaternion=block.quaternion, attitude_std_rad=std)
    prior: Any = to_problem(block, measured, survey.photos).prior("attitude")
    np.testing.assert_allclose(1 / np.sum(prior.std_rad**-2.0, axis=0), 0.05**2)
    assert to_problem(block, survey.reference, survey.photos).prior("attitude") is None


def test_cameras_start_within_their_bounds_around_what_photos_tell(survey: Simulated, block: Block) -> None:
    photos = [replace(p, focal_px=3000.0, focal_source="sensor_table") for p in survey.photos]
    far = replace(block, camera_parameters=np.array([[9000.0, 9000, 2736, 1824, 0.9, 0, 0, 0, 0]]))
    problem = to_problem(far, survey.reference, photos)
    np.testing.assert_allclose([problem.lower[0, 0], problem.upper[0, 0]], [2100, 4200])
    assert np.asarray(problem.cameras.parameters)[0, [0, 4]].tolist() == [4200.0, 0.5]
    prior: Any = problem.prior("intrinsics")
    np.testing.assert_allclose(prior.parameters[0, :4], [3000, 3000, 2736, 1824])
    np.testing.assert_allclose(prior.std[0, :4], [150, 150, 54.72, 54.72])
    assert not problem.free.intrinsics[0, NAMES.index("k3")]


def test_held_parameters_keep_the_shape_of_the_problem(survey: Simulated, block: Block) -> None:
    held = to_problem(block, survey.reference, survey.photos, held=("k2", "p1"))
    free = to_problem(block, survey.reference, survey.photos)
    assert jax.tree.map(np.shape, held) == jax.tree.map(np.shape, free)
    np.testing.assert_array_equal(held.free.intrinsics, free.free.intrinsics)
    prior: Any = held.prior("intrinsics")
    assert prior.std[0, NAMES.index("k2")] < 1e-6 and prior.parameters[0, NAMES.index("k2")] == 0.0


def test_small_blocks_calibrate_focal_length_and_k1_alone() -> None:
    assert free_parameters("OPENCV", num_images=5) == ("fx", "fy", "k1")
    assert free_parameters("SIMPLE_RADIAL", num_images=50) == ("f", "cx", "cy", "k1")
    assert "k3" not in free_parameters("OPENCV", num_images=50)
    assert "k3" in free_parameters("OPENCV_FISHEYE", num_images=50)


def test_positions_on_a_line_are_told() -> None:
    along = np.linspace(0, 100, 9)[:, None] * [1.0, 0.2, 0.0]
    bent = along + np.array([0.0, 0, 1]) * (np.arange(9) % 2)[:, None] * 20
    assert is_collinear(along) and is_collinear(bent[:2]) and not is_collinear(bent)
