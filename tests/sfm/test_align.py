"""The similarity found is the one that made the data, with wrong positions, on strips, with and without attitudes."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxba.geometry import Similarity
from jaxba.sfm._align import align, look_down

DOWN = np.diag([1.0, -1, -1])


class Made:
    """A reconstruction of nadir images in a frame of its own, and measurements in the local frame."""

    def __init__(self, stations: np.ndarray, seed: int = 0, *, std_m: float = 1.0, tilt_rad: float = 0.05) -> None:
        rng = np.random.default_rng(seed)
        num = len(stations)
        self.local = np.column_stack([stations, 100 + rng.normal(size=num)])
        turn = Rotation.from_rotvec(tilt_rad * rng.normal(size=(num, 3)))
        heading = Rotation.from_rotvec(np.column_stack([np.zeros((num, 2)), rng.integers(0, 2, num) * np.pi]))
        self.cam_from_local = (turn * Rotation.from_matrix(DOWN) * heading).as_matrix()
        self.world = Rotation.random(rng=rng).as_matrix()
        self.centers = (self.local / 100 + rng.normal(size=3)) @ self.world.T
        self.rotations = self.cam_from_local @ self.world.T
        self.std_m = np.full((num, 3), std_m)
        self.xyz_m = self.local + std_m * rng.normal(size=(num, 3))
        self.is_used = np.ones(num, bool)
        self.quaternion = np.full((num, 4), np.nan)
        self.attitude_std = np.full((num, 3), np.nan)
        self.rng = rng

    def with_attitudes(self, std_rad: float) -> "Made":
        noise = Rotation.from_rotvec(std_rad * self.rng.normal(size=(len(self.local), 3)))
        self.quaternion = (noise * Rotation.from_matrix(self.cam_from_local)).as_quat(scalar_first=True)
        self.attitude_std = np.full((len(self.local), 3), std_rad)
        return self

    def align(self) -> Similarity | None:
        return align(
            self.centers, self.rotations, self.xyz_m, self.std_m, self.is_used, self.quaternion, self.attitude_std
        )

    def errors(self) -> tuple[float, float]:
        """Largest error of a position (metres) and of a rotation (radians)."""
        found = self.align()
        assert found is not None
        turn = Rotation.from_matrix(found.rotations(self.rotations)).inv() * Rotation.from_matrix(self.cam_from_local)
        return float(np.abs(found.points(self.centers) - self.local).max()), float(turn.magnitude().max())


def grid(num: int = 6, base: float = 25.0) -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(num), np.arange(num)), -1).reshape(-1, 2) * base


def strip(num: int = 12, base: float = 25.0) -> np.ndarray:
    return np.column_stack([np.zeros(num), base * np.arange(num)])


@pytest.mark.parametrize("seed", range(4))
def test_a_third_of_wrong_positions_does_no_harm(seed: int) -> None:
    made = Made(grid(), seed)
    wrong = made.rng.permutation(36)[:12]
    made.xyz_m[wrong] += made.rng.uniform(12, 80, (12, 1)) * Rotation.random(12, rng=made.rng).apply([1.0, 0, 0])
    error_m, error_rad = made.errors()
    # sigma 1 m on 24 positions over 150 m: 0.2 m for the mean, 0.006 rad for the tilt, some sigmas of these
    assert error_m < 1.5 and error_rad < 0.02


@pytest.mark.parametrize("seed", range(3))
def test_a_straight_strip_without_attitudes_is_levelled_by_its_views(seed: int) -> None:
    error_m, error_rad = Made(strip(), seed, tilt_rad=0.03).errors()
    assert error_m < 3 and error_rad < 0.05  # the mean of 12 views that tilt by 0.03 each, and 1 m over 275 m


@pytest.mark.parametrize("seed", range(3))
def test_a_straight_strip_with_attitudes_is_levelled_by_these(seed: int) -> None:
    # views that all tilt: they alone would level the block wrongly
    made = Made(strip(), seed)
    tilt = Rotation.from_rotvec([0.0, 0.3, 0]).as_matrix()
    made.cam_from_local = tilt @ made.cam_from_local
    made.rotations = tilt @ made.rotations
    error_m, error_rad = made.with_attitudes(0.02).errors()
    assert error_m < 3 and error_rad < 0.03


def test_wrong_altitudes_do_not_cost_the_horizontal_positions() -> None:
    # four images carry the corners' horizontal positions, and all four have a wrong altitude
    made = Made(grid(), std_m=0.2)
    made.is_used[:] = False
    made.is_used[[0, 5, 14, 15, 20, 21, 30, 35]] = True
    made.xyz_m[[0, 5, 30, 35], 2] += [40.0, -30, 25, 60]
    error_m, _ = made.errors()
    assert error_m < 3  # the four inner ones, 25 m apart, level the block to 0.2 / 25 over 90 m


def test_altitudes_without_a_sigma_do_not_tilt_the_block() -> None:
    made = Made(grid())
    made.xyz_m[:, 2] += np.linspace(0, 100, 36)
    made.std_m[:, 2] = np.inf
    found = made.align()
    assert found is not None
    error = found.points(made.centers) - made.local
    assert np.abs(error[:, :2]).max() < 2
    assert np.ptp(error[:, 2]) < 5  # tilts by 0.05 in each of 36 views: 0.01 rad, over 175 m


def test_attitudes_alone_do_not_make_up_for_positions() -> None:
    made = Made(grid()).with_attitudes(0.02)
    made.is_used[1:] = False
    assert made.align() is None


def test_positions_within_their_own_noise_give_no_similarity() -> None:
    assert Made(grid(3, base=0.5)).align() is None


def test_two_positions_are_enough_with_attitudes() -> None:
    made = Made(grid(), std_m=0.1).with_attitudes(0.02)
    made.is_used[:] = False
    made.is_used[[0, 35]] = True
    error_m, error_rad = made.errors()
    assert error_m < 2 and error_rad < 0.02


def test_look_down_turns_the_mean_view_down() -> None:
    rotations = Rotation.random(5, rng=np.random.default_rng(0)).as_matrix()
    view = (rotations @ look_down(rotations).T)[:, 2].mean(axis=0)
    np.testing.assert_allclose(view / np.linalg.norm(view), [0, 0, -1], atol=1e-12)
