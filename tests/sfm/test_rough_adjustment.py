"""The rough adjustment's derivatives are the finite differences', and it finds the focal length and k1."""

import dataclasses

import numpy as np
import pytest
from surveys import Case, make_case

from jaxba.geometry import SimpleRadial
from jaxba.scene import Block
from jaxba.sfm import with_points
from jaxba.sfm._rough_adjustment import _Rows, _State, adjust_roughly

CAMERA = SimpleRadial(f=3650.0, cx=2736.0, cy=1824.0, k1=-0.06)


@pytest.fixture(scope="module")
def case() -> Case:
    return make_case(10, seed=1, camera=CAMERA, outlier_fraction=0.0, pixel_std_px=0.3)


def block_of(case: Case, *, focal_px: float, k1: float, position_m: float) -> Block:
    """Return the true block, its cameras moved and its lens wrong."""
    truth, rng = case.survey.truth, np.random.default_rng(0)
    centers = case.centers + position_m * rng.normal(size=case.centers.shape)
    empty = np.zeros(0, int)
    block = Block(
        image_index=np.arange(10),
        quaternion=np.asarray(truth.poses.quaternion),
        translation_m=-np.einsum("nij,nj->ni", case.rotations, centers),
        camera_model="SIMPLE_RADIAL",
        camera_names=("c",),
        camera_parameters=np.array([[focal_px, 2736.0, 1824.0, k1]]),
        camera_index=np.zeros(10, int),
        points_m=np.zeros((0, 3)),
        track_index=empty,
        rgb=np.zeros((0, 3), np.uint8),
        observation_image=empty,
        observation_point=empty,
        observation_xy_px=np.zeros((0, 2)),
        is_georeferenced=True,
    )
    return with_points(block, case.tracks, min_angle_rad=0.026, max_error_px=200.0)


def test_derivatives_match_central_differences(case: Case) -> None:
    block = block_of(case, focal_px=3600.0, k1=-0.05, position_m=0.5)
    state = _State.of(block)
    rows = state.rows(block)
    no_image, no_camera, no_point = np.zeros((10, 6)), np.zeros((1, 2)), np.zeros_like(block.points_m)
    step = 1e-5

    def difference(image: np.ndarray, camera: np.ndarray, points: np.ndarray) -> np.ndarray:
        ends: list[_Rows] = [state.moved(s * image, s * camera, s * points).rows(block) for s in (step, -step)]
        return (ends[0].error - ends[1].error) / (2 * step)

    # rounding of 1e-12 px over 1e-5, and the third derivative of pixels of 1e3 times its square
    close = {"rtol": 1e-6, "atol": 1e-4}
    for k in range(6):
        moved = no_image.copy()
        moved[:, k] = 1
        np.testing.assert_allclose(difference(moved, no_camera, no_point), rows.by_image[:, :, k], **close)
    for k in range(2):
        moved = no_camera.copy()
        moved[:, k] = 1
        np.testing.assert_allclose(difference(no_image, moved, no_point), rows.by_camera[:, :, k], **close)
    for k in range(3):
        moved = no_point.copy()
        moved[:, k] = 1
        np.testing.assert_allclose(difference(no_image, no_camera, moved), rows.by_point[:, :, k], **close)


def test_lens_and_poses_are_found(case: Case) -> None:
    block = block_of(case, focal_px=3760.0, k1=0.0, position_m=1.0)
    found = adjust_roughly(
        block,
        xyz_m=case.reference.xyz_m,
        std_m=case.reference.std_m,
        focal_std=np.array([0.03]),
    )
    focal, k1 = found.camera_parameters[0, [0, 3]]
    # over 20 m of relief the focal length goes with the height, which GNSS holds to 2 m / sqrt(10) of 100 m
    assert focal == pytest.approx(3650, rel=0.02) and k1 == pytest.approx(-0.06, abs=0.004)
    error = np.hypot(*_State.of(found).rows(found).error.T)
    assert np.median(error) < 0.5  # noise of 0.3 px an axis
    assert np.linalg.norm(found.centers_m - case.centers, axis=1).max() < 3


def test_observations_stay_as_they_were(case: Case) -> None:
    block = block_of(case, focal_px=3650.0, k1=-0.06, position_m=0.1)
    nothing = np.full((10, 3), np.nan)
    found = adjust_roughly(block, xyz_m=nothing, std_m=nothing, focal_std=np.array([0.03]))
    for field in dataclasses.fields(Block):
        if field.name.startswith("observation") or field.name in ("image_index", "track_index", "camera_index"):
            np.testing.assert_array_equal(getattr(found, field.name), getattr(block, field.name))
