"""The synthetic block is what it says: seen through independent numpy formulas and the residual groups at the truth."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from jaxba._errors import JaxbaError
from jaxba.ba import Unknowns
from jaxba.geometry import BAL, OpenCVFisheye, Radial
from jaxba.simulation import Survey, uav_block
from jaxba.simulation._flight import FlightPattern


@pytest.fixture(scope="module")
def survey() -> Survey:
    return uav_block(
        200,
        seed=3,
        outlier_fraction=0.05,
        gnss_outlier_fraction=0.1,
        lever_arm_m=(0.1, -0.2, 0.3),
        num_control=6,
        num_check=9,
    )


def opencv_pixels(survey: Survey) -> np.ndarray:
    """Project the true points by OpenCV's formulas, written out here once more."""
    truth, seen = survey.truth, survey.problem.observations
    attitude = Rotation.from_quat(np.asarray(truth.poses.quaternion), scalar_first=True)
    p = attitude[seen.image_index].apply(truth.points[seen.point_index]) + truth.poses.translation[seen.image_index]
    a, b = p[:, 0] / p[:, 2], p[:, 1] / p[:, 2]
    assert np.all(p[:, 2] > 0)
    c, r2 = truth.cameras, a**2 + b**2
    radial = 1 + c.k1 * r2 + c.k2 * r2**2
    u = a * radial + 2 * c.p1 * a * b + c.p2 * (r2 + 2 * a**2)
    v = b * radial + c.p1 * (r2 + 2 * b**2) + 2 * c.p2 * a * b
    return np.stack([c.fx * u + c.cx, c.fy * v + c.cy], axis=1)


def centers_and_attitudes(survey: Survey) -> tuple[np.ndarray, Rotation]:
    poses = survey.truth.poses
    attitude = Rotation.from_quat(np.asarray(poses.quaternion), scalar_first=True)
    return -attitude.inv().apply(np.asarray(poses.translation)), attitude


def test_measurements_are_the_true_projection_plus_noise_of_the_sigma_asked(survey: Survey) -> None:
    exact = opencv_pixels(survey)
    np.testing.assert_allclose(survey.truth.xy_px, exact, rtol=0, atol=1e-8)  # pixels of 5e3, rounding of 1e-12
    error = (survey.problem.observations.xy_px - exact)[~survey.truth.is_outlier]
    # the standard error of a sigma from n values is sigma / sqrt(2 n); 4 of them
    assert abs(error.std() / 0.5 - 1) < 4 / np.sqrt(2 * error.size)
    assert np.all(np.abs(error.mean(axis=0)) < 4 * 0.5 / np.sqrt(len(error)))


def test_outliers_are_as_many_and_as_large_as_asked_and_spare_the_marks(survey: Survey) -> None:
    seen, outlier = survey.problem.observations, survey.truth.is_outlier
    tie = seen.point_index >= 15
    assert np.count_nonzero(outlier) == round(0.05 * np.count_nonzero(tie))
    assert not np.any(outlier & ~tie)
    size = np.linalg.norm((seen.xy_px - survey.truth.xy_px)[outlier], axis=1)
    # between 5 and 200 px, with up to 5 sigmas of noise in each axis on top
    assert size.min() > 5 - 3.6 and size.max() < 200 + 3.6
    assert size.mean() == pytest.approx(102.5, abs=4 * 56.3 / np.sqrt(len(size)))  # uniform: sigma 195 / sqrt(12)


def test_positions_have_the_sigma_asked_and_outliers_beyond(survey: Survey) -> None:
    centers, attitude = centers_and_attitudes(survey)
    prior = survey.problem.prior("position")
    error = prior.xyz - (centers + attitude.inv().apply(np.array([0.1, -0.2, 0.3])))
    bad = survey.truth.gnss_is_outlier
    assert np.count_nonzero(bad) == 20
    np.testing.assert_allclose(error[~bad].std(axis=0), [0.03, 0.03, 0.06], rtol=4 / np.sqrt(2 * 180))
    assert np.linalg.norm(error[bad], axis=1).min() > 0.7  # 1 m, less 5 sigmas


def test_observations_are_unique_and_inside_the_image_and_tracks_have_two_at_least(survey: Survey) -> None:
    seen = survey.problem.observations
    assert np.all((seen.xy_px >= 0) & (seen.xy_px <= [5472, 3648]))
    pairs = seen.image_index.astype(np.int64) * survey.problem.num_points + seen.point_index
    assert np.unique(pairs).size == pairs.size
    length = np.bincount(seen.point_index, minlength=survey.problem.num_points)
    assert length.min() >= 2
    assert length[15:].mean() == pytest.approx(3.75, abs=0.05)  # 13,200 tracks of sigma 1.4: 0.012 is one sigma
    assert survey.problem.num_points == 200 * 66 + 15


def test_block_hangs_together_and_every_image_sees_points(survey: Survey) -> None:
    seen, n = survey.problem.observations, 200
    assert np.bincount(seen.image_index, minlength=n).min() >= 20
    graph = coo_array((np.ones(len(seen.std_px)), (seen.image_index, n + seen.point_index)), shape=(20000, 20000))
    part = connected_components(graph, directed=False)[1]
    assert np.all(part[: n + survey.problem.num_points] == part[0])


def test_marks_are_seen_by_every_image_they_lie_in(survey: Survey) -> None:
    truth, seen = survey.truth, survey.problem.observations
    np.testing.assert_array_equal(np.concatenate([truth.control_index, truth.check_index]), np.arange(15))
    centers, attitude = centers_and_attitudes(survey)
    count = np.bincount(seen.point_index)
    for mark in range(15):
        p = attitude.apply(truth.points[mark] - centers)
        # well inside the image whatever the distortion: 70% of the half angle
        inside = (np.abs(p[:, 0] / p[:, 2]) < 0.7 * 0.75) & (np.abs(p[:, 1] / p[:, 2]) < 0.7 * 0.5)
        images = seen.image_index[seen.point_index == mark]
        assert set(np.flatnonzero(inside)) <= set(images)
        assert count[mark] > 5
    surveyed = survey.problem.prior("control")
    np.testing.assert_array_equal(survey.problem.points[:6], surveyed.xyz)
    assert np.abs((surveyed.xyz - truth.points[:6]) / surveyed.std_m).max() < 5


@pytest.mark.parametrize(("forward", "side"), [(0.8, 0.6), (0.65, 0.3)])
def test_images_overlap_as_asked(forward: float, side: float) -> None:
    truth = uav_block(
        36, forward_overlap=forward, side_overlap=side, num_lines=6, position_jitter_m=0.0, attitude_jitter_rad=0.0,
        camera=Radial(3650.0, 2736.0, 1824.0, 0.0, 0.0), terrain_relief_m=0.0,
    ).truth  # fmt: skip
    attitude = Rotation.from_quat(np.asarray(truth.poses.quaternion), scalar_first=True)
    centers = -attitude.inv().apply(np.asarray(truth.poses.translation))
    assert np.all(truth.points[:, 2] == 0)
    footprint = 100.0 * np.array([5472, 3648]) / 3650
    lines = centers.reshape(6, 6, 3)
    # the walk to the image's edge has steps of 0.0005 in x/z, 0.05 m on the ground
    np.testing.assert_allclose(np.abs(np.diff(lines[:, :, 1], axis=1)), (1 - forward) * footprint[1], atol=0.06)
    np.testing.assert_allclose(np.diff(lines[:, 0, 0]), (1 - side) * footprint[0], atol=0.06)
    np.testing.assert_allclose(lines[0, :, 1], lines[1, ::-1, 1], atol=1e-9)  # flown up and down
    np.testing.assert_allclose(attitude.as_matrix()[[0, 6]], [np.diag([1, -1, -1]), np.diag([-1, 1, -1])], atol=1e-12)


@pytest.mark.parametrize("flight", ["lines", "crossing", "second", "orbit"])
def test_images_stand_and_look_as_their_flight_says(flight: FlightPattern) -> None:
    # breaks where the crossing lines are turned and not their cameras, or an orbit looks outwards
    survey = uav_block(
        40, flight=flight, position_jitter_m=0.0, attitude_jitter_rad=0.0, terrain_relief_m=0.0, side_overlap=0.7,
        height_m=80.0,
    )  # fmt: skip
    centers, attitude = centers_and_attitudes(survey)
    seen = survey.problem.observations
    np.testing.assert_allclose(opencv_pixels(survey), survey.truth.xy_px, atol=1e-6)
    assert np.bincount(seen.image_index).min() >= 20 and abs(len(seen.image_index) / 40 - 260) < 40
    right, down, ahead = np.swapaxes(attitude.as_matrix(), 0, 1)
    if flight == "orbit":
        np.testing.assert_allclose(np.linalg.norm(centers[:, :2], axis=1), 80.0)
        np.testing.assert_allclose(centers + 80.0 * np.sqrt(2) * ahead, np.zeros((40, 3)), atol=1e-9)
        assert np.all(np.abs(right[:, 2]) < 1e-12) and np.all(down[:, 2] < 0)
        assert np.bincount(seen.point_index).max() == 40  # all see the middle
        return
    np.testing.assert_allclose(ahead, np.tile([0.0, 0.0, -1.0], (40, 1)), atol=1e-12)
    along = np.abs(np.einsum("ni,ni->n", np.diff(centers, axis=0), down[:-1])) / np.linalg.norm(
        np.diff(centers, axis=0), axis=1
    )
    assert np.mean(along > 1 - 1e-9) > 0.8  # the next image lies ahead but where lines end
    across = np.abs(down[0] @ down.T) < 1e-9
    assert np.array_equal(np.flatnonzero(across), np.arange(20, 40) if flight == "crossing" else [])
    if flight == "second":
        np.testing.assert_allclose(centers[20:], centers[:20])
    if flight == "crossing":
        np.testing.assert_allclose(np.ptp(centers[20:], axis=0), np.ptp(centers[:20], axis=0)[[1, 0, 2]])


def test_same_seed_same_survey_and_outliers_leave_the_block_unchanged() -> None:
    first, again, other = uav_block(12, seed=5), uav_block(12, seed=5), uav_block(12, seed=6)
    spoilt = uav_block(12, seed=5, outlier_fraction=0.1, gnss_outlier_fraction=0.5)
    for a, b in zip(jax.tree.leaves(first.problem), jax.tree.leaves(again.problem), strict=True):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(first.truth.points, other.truth.points)
    np.testing.assert_array_equal(first.truth.points, spoilt.truth.points)
    good = ~spoilt.truth.is_outlier
    difference = first.problem.observations.xy_px - spoilt.problem.observations.xy_px
    assert np.all(difference[good] == 0) and np.all(np.abs(difference[~good]).max(axis=1) > 0)


def test_residuals_at_the_truth_are_standard_normal_in_every_group() -> None:
    survey = uav_block(
        60, seed=2, num_control=40, num_check=0, lever_arm_m=(0.1, 0.2, -0.3), lever_arm_std_m=0.05,
        attitude_prior=True, num_cameras=3,
    )  # fmt: skip
    truth = survey.truth
    assert [prior.name for prior in survey.problem.priors] == ["position", "attitude", "control", "lever_arm"]
    assert bool(survey.problem.free.lever_arm)
    unknowns = Unknowns(
        jax.tree.map(jnp.asarray, truth.poses), truth.cameras.parameters, jnp.asarray(truth.lever_arm),
        jnp.asarray(truth.points),
    )  # fmt: skip
    for prior in survey.problem.priors:
        residual = np.asarray(prior.residual(unknowns))
        # the sum of n squares has the sigma sqrt(2 n)
        assert abs(np.sum(residual**2) - residual.size) < 4 * np.sqrt(2 * residual.size), prior.name


def test_start_values_are_off_by_what_is_asked(survey: Survey) -> None:
    truth, problem = survey.truth, survey.problem
    _, attitude = centers_and_attitudes(survey)
    start = Rotation.from_quat(np.asarray(problem.poses.quaternion), scalar_first=True)
    turn = (start * attitude.inv()).as_rotvec()
    np.testing.assert_allclose(turn.std(axis=0), 0.0175, rtol=4 / np.sqrt(2 * 200))
    antenna = start.inv().apply(truth.lever_arm - np.asarray(problem.poses.translation))
    np.testing.assert_allclose(antenna, problem.prior("position").xyz, atol=1e-9)
    camera = problem.cameras
    np.testing.assert_allclose(camera.fx / truth.cameras.fx, 1.01)
    assert (camera.cx[0], camera.cy[0], camera.k1[0], camera.p2[0]) == (2736, 1824, 0, 0)
    names = type(camera).parameter_names()
    assert [name for name, free in zip(names, problem.free.intrinsics[0], strict=True) if not free] == ["k3"]
    moved = (problem.points - truth.points)[6:]
    assert moved.std() == pytest.approx(2.0, rel=4 / np.sqrt(2 * moved.size))


@pytest.mark.parametrize("num_images", [2, 4, 6])
@pytest.mark.parametrize(
    "camera", [BAL(3650.0, -0.02, 0.01), OpenCVFisheye(3000.0, 3000.0, 2730.0, 1830.0, 0.01, 0.0, 0.0, 0.0)]
)
def test_small_flat_blocks_of_other_cameras_are_made(num_images: int, camera: BAL | OpenCVFisheye) -> None:
    survey = uav_block(num_images, camera=camera, terrain_relief_m=0.0, gnss_std_m=None, pixel_std_px=0.0, num_check=2)
    xy = survey.problem.observations.xy_px
    np.testing.assert_array_equal(xy, survey.truth.xy_px)
    middle = np.zeros(2) if isinstance(camera, BAL) else np.array([2736, 1824])
    assert np.all(np.abs(xy - middle) < [2736, 1824]) and np.all(np.abs(xy - middle).max(axis=0) > [1800, 1200])
    assert survey.problem.priors == ()


def test_each_image_can_have_its_own_camera() -> None:
    survey = uav_block(8, num_cameras=8)
    np.testing.assert_array_equal(survey.problem.camera_index, np.arange(8))
    assert survey.problem.num_cameras == 8 and np.unique(survey.truth.cameras.fx).size == 8


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"forward_overlap": 1.2}, "forward_overlap=1.2"),
        ({"gnss_std_m": (0.0, 0.1, 0.1)}, "gnss_std_m"),
        ({"points_per_image": 5.0}, "raise points_per_image"),
        ({"side_overlap": 0.0, "forward_overlap": 0.1}, "raise"),
    ],
)
def test_impossible_blocks_are_refused_with_the_cure(options: dict, message: str) -> None:
    with pytest.raises(JaxbaError, match=message):
        uav_block(12, **options)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("height_m", 0.0),
        ("height_m", -100.0),
        ("position_jitter_m", np.nan),
        ("attitude_jitter_rad", 10.0),
        ("points_per_image", np.inf),
        ("pixel_std_px", np.nan),
        ("num_control", -1),
        ("focal_error", -1.0),
        ("point_error_m", -2.0),
        ("seed", -1),
    ],
)
def test_an_option_out_of_range_is_named(name: str, value: float):
    with pytest.raises(JaxbaError, match=f"{name}={value} is out of range; choose it from"):
        uav_block(8, **{name: value})


def test_a_negative_focal_length_is_named():
    with pytest.raises(JaxbaError, match=r"camera.f=-900.0 is out of range"):
        uav_block(8, camera=Radial(-900.0, 0.0, 0.0, 0.0, 0.0))
