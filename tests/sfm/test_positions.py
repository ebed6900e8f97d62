"""Global positions equal the truth up to a similarity, from exact and from noisy and wrong rays."""

import numpy as np
import pytest

from jaxba.sfm._positions import global_positions


def scene(
    rng: np.random.Generator, *, relief: float, noise_rad: float = 0.0, wrong: float = 0.0
) -> tuple[np.ndarray, ...]:
    """25 cameras on a grid over terrain, each point seen by those within reach; rays as unit vectors in the world."""
    grid = np.stack(np.meshgrid(np.arange(5.0), np.arange(5.0)), -1).reshape(-1, 2) * 25
    centers = np.column_stack([grid, np.full(25, 100.0)]) + rng.normal(size=(25, 3))
    points = np.column_stack([rng.uniform(-20, 120, (600, 2)), relief * rng.uniform(-0.5, 0.5, 600)])
    near = np.abs(points[:, None, :2] - centers[:, :2]).max(axis=2) < 45
    near &= (near.sum(axis=1) >= 2)[:, None]
    point, image = np.nonzero(near)
    point = np.unique(point, return_inverse=True)[1]
    ray = points[near.any(axis=1)][point] - centers[image]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    noise = noise_rad * rng.normal(size=ray.shape)
    bad = rng.uniform(size=len(ray)) < wrong
    noise[bad] = 0.3 * rng.normal(size=(bad.sum(), 3))
    ray = ray + noise
    return centers, ray / np.linalg.norm(ray, axis=1, keepdims=True), image, point


def misfit(found: np.ndarray, true: np.ndarray) -> float:
    """Largest distance after the best shift and scale; rotations are known here."""
    a, b = found - found.mean(axis=0), true - true.mean(axis=0)
    return float(np.abs(a * (a * b).sum() / (a * a).sum() - b).max())


@pytest.mark.parametrize("relief", [0.0, 20.0, 60.0])
def test_exact_rays_give_exact_positions(relief: float) -> None:
    centers, ray, image, point = scene(np.random.default_rng(0), relief=relief)
    found, _, angle = global_positions(25, ray, image, point, scale_rad=0.01)
    # the faint term that holds the distances converges by a factor a round: metres at a height of 100
    assert misfit(found, centers) < 0.02
    assert angle.max() < 2e-4


@pytest.mark.parametrize("seed", range(3))
def test_wrong_rays_do_no_harm(seed: int) -> None:
    rng = np.random.default_rng(seed)
    centers, ray, image, point = scene(rng, relief=20.0, noise_rad=0.002, wrong=0.1)
    found, _, _ = global_positions(25, ray, image, point, scale_rad=0.01)
    assert misfit(found, centers) < 1.0  # 0.2 m of noise on each ray's foot, 0.3 rad (30 m) on one in ten
