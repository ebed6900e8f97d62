"""Are the errors of observations independent, as an adjustment takes them? `python -m benchmarks.residuals project`.

Of a project's `tile.npz`, at its values, prints three tables.

- How residuals of different points in one photo are correlated, by the distance between them, in tracks of four views
  or more; and the mean residual of all photos in cells of the frame over its sigma: 1 where nothing is systematic.
- How far the sums of squares of tracks scatter over what normal errors of one sigma let expect (chi-squared).
- What the sigmas of the intrinsics become where only tracks are independent of each other, over those of the tile: the
  covariance is then N^-1 (sum of s s^T over tracks) N^-1, s being what a track contributes to the gradient with its
  point eliminated (Liang and Zeger 1986); beside it, what the scatter of residuals alone makes of them.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from scipy.spatial import KDTree

import jaxba
from jaxba import PositionPrior, Problem
from jaxba.geometry import AbstractLoss, Linear

_EDGES_PX = (0.0, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0)
_LEAST_VIEWS, _CELLS = 4, 8


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("project", type=Path)
    tile = parser.parse_args().project / "export" / "tile.npz"
    with jax.enable_x64(True):
        rows = _Rows(jaxba.read_tile(tile), jaxba.read_loss(tile) or Linear())
        _within_photos(rows)
        _of_tracks(rows)


class _Rows:
    """Residuals and derivatives of all observations over their sigmas, weighed by the loss."""

    def __init__(self, problem: Problem, loss: AbstractLoss) -> None:
        seen, model = problem.observations, type(problem.cameras)
        self.problem = problem
        self.image, self.point = np.asarray(seen.image_index), np.asarray(seen.point_index)
        self.xy_px = np.asarray(seen.xy_px)
        names = model.parameter_names()
        self.refined = np.flatnonzero(np.asarray(problem.free.intrinsics).any(axis=0))
        self.names = [names[k] for k in self.refined]
        intrinsics = np.stack([np.asarray(getattr(problem.cameras, name)) for name in names], axis=1)
        camera = np.asarray(problem.camera_index)[self.image]

        def pixel(pose: jaxba.Pose, k: Array, x: Array, step: Array, by_k: Array, by_x: Array) -> Array:
            return model.from_parameters(k + by_k).project(pose.retract(step).transform(x + by_x))

        def of_row(pose: jaxba.Pose, k: Array, x: Array) -> tuple[Array, tuple[Array, ...]]:
            zero = jnp.zeros(6), jnp.zeros_like(k), jnp.zeros(3)
            return pixel(pose, k, x, *zero), jax.jacfwd(pixel, argnums=(3, 4, 5))(pose, k, x, *zero)

        poses = jax.tree.map(lambda leaf: jnp.asarray(leaf)[self.image], problem.poses)
        points = jnp.asarray(problem.points)[self.point]
        predicted, parts = jax.jit(jax.vmap(of_row))(poses, jnp.asarray(intrinsics[camera]), points)
        std_px = np.asarray(seen.std_px)[:, None]
        self.residual_px = self.xy_px - np.asarray(predicted)
        over = self.residual_px / std_px
        weight = np.asarray(loss.derivatives(jnp.asarray(np.sum(over**2, axis=1)))[1])
        root = np.sqrt(weight)[:, None]
        self.residual = over * root
        by_pose, by_k, by_point = (np.asarray(part) * (root / std_px)[:, :, None] for part in parts)
        self.by_pose, self.by_k, self.by_point = by_pose, by_k[:, :, self.refined], by_point


def _within_photos(rows: _Rows) -> None:
    views = np.bincount(rows.point)[rows.point]
    long = views >= _LEAST_VIEWS
    products, pairs = np.zeros(len(_EDGES_PX)), np.zeros(len(_EDGES_PX))
    for image in np.unique(rows.image):
        mine = np.flatnonzero((rows.image == image) & long)
        near = KDTree(rows.xy_px[mine]).query_pairs(_EDGES_PX[-1], output_type="ndarray")
        one, other = mine[near[:, 0]], mine[near[:, 1]]
        bin_of = np.digitize(np.linalg.norm(rows.xy_px[one] - rows.xy_px[other], axis=1), _EDGES_PX) - 1
        product = np.sum(rows.residual_px[one] * rows.residual_px[other], axis=1)
        products += np.bincount(bin_of, product, minlength=len(products))[: len(products)]
        pairs += np.bincount(bin_of, minlength=len(pairs))[: len(pairs)]
    variance = np.mean(np.sum(rows.residual_px[long] ** 2, axis=1))
    print("| apart in a photo (px) | pairs | correlation |\n| --- | --- | --- |")
    for low, high, total, count in zip(_EDGES_PX, _EDGES_PX[1:], products, pairs, strict=False):
        print(f"| {low:g} to {high:g} | {int(count):,} | {total / max(count, 1) / variance:+.3f} |")
    cell = np.clip((rows.xy_px[long] / rows.xy_px.max(axis=0) * _CELLS).astype(int), 0, _CELLS - 1) @ [_CELLS, 1]
    count = np.bincount(cell, minlength=_CELLS**2)
    residual = rows.residual_px[long]
    means = [np.bincount(cell, column, minlength=_CELLS**2) / np.sqrt(count) / column.std() for column in residual.T]
    rms = np.sqrt(np.mean(np.square(means)))
    print(f"\nMean residual of a cell over its sigma, RMS of {_CELLS} x {_CELLS}: {rms:.2f}")


def _of_tracks(rows: _Rows) -> None:
    problem = rows.problem
    assert problem.num_cameras == 1  # one block of intrinsics below
    images, size = problem.num_images, 6 * problem.num_images + len(rows.refined)
    normal, meat, held = np.zeros((size, size)), np.zeros((size, size)), np.zeros((size, size))
    order = np.argsort(rows.point, kind="stable")
    squares: dict[int, list[float]] = {}
    for track in np.split(order, np.flatnonzero(np.diff(rows.point[order])) + 1):
        if len(track) < 2:
            continue
        by_all = np.zeros((len(track), 2, size))
        for k, row in enumerate(track):
            by_all[k, :, 6 * rows.image[row] :][:, :6] = rows.by_pose[row]
        by_all[:, :, 6 * images :] = rows.by_k[track]
        flat, residual = by_all.reshape(-1, size), rows.residual[track].ravel()
        taken, _ = np.linalg.qr(rows.by_point[track].reshape(-1, 3))
        flat, residual = flat - taken @ (taken.T @ flat), residual - taken @ (taken.T @ residual)
        normal += flat.T @ flat
        score = flat.T @ residual
        meat += np.outer(score, score)
        squares.setdefault(2 * len(track) - 3, []).append(float(residual @ residual))
    factor = sum(map(sum, squares.values())) / sum(freedom * len(sums) for freedom, sums in squares.items())
    print("\n| views | tracks | mean square | scatter of sums over chi-squared's |\n| --- | --- | --- | --- |")
    for freedom, sums in sorted(squares.items())[:7]:
        mean = np.mean(sums) / freedom
        ratio = np.var(sums) / (2 * freedom * mean**2)
        print(f"| {(freedom + 3) // 2} | {len(sums):,} | {mean:.2f} | {ratio:.1f} |")
    _add_positions(held, problem)
    inverse = np.linalg.inv(normal + held)
    stated, scattered, of_tracks = (
        np.sqrt(np.diagonal(inverse @ (m + held) @ inverse))[6 * images :] for m in (normal, factor * normal, meat)
    )
    print("\n| intrinsic | sigma | by scatter, over it | by tracks, over it |\n| --- | --- | --- | --- |")
    for name, one, by_scatter, by_track in zip(rows.names, stated, scattered, of_tracks, strict=True):
        print(f"| {name} | {one:.3g} | {by_scatter / one:.2f} | {by_track / one:.2f} |")


def _add_positions(normal: Float[np.ndarray, "n n"], problem: Problem) -> None:
    """Add what positions hold the block by; other priors are weak beside them."""
    prior = problem.prior("position")
    assert isinstance(prior, PositionPrior)
    rotation = np.asarray(problem.poses.rotation)
    for image, std_m in zip(np.asarray(prior.image_index), np.asarray(prior.std_m), strict=True):
        by_place = -rotation[image].T / std_m[:, None]
        at = slice(6 * image + 3, 6 * image + 6)
        normal[at, at] += by_place.T @ by_place


if __name__ == "__main__":
    main()
