"""Merging tiles: similarities, means and the pass over the block, against the truth and whole adjustments."""

import dataclasses
import functools
from collections.abc import Callable, Sequence

import equinox as eqx
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxba
from jaxba import BlockTile, JaxbaError, Merged, Pose, Problem
from jaxba.ba.tiles._cut import sub_problem
from jaxba.geometry import Similarity

_GROUPS = (range(0, 14), range(10, 24))  # the two halves of four lines, four images in common


def _cut(problem: Problem, groups: Sequence[Sequence[int]], *, is_apart: bool = False) -> list[BlockTile]:
    """Return tiles of these images, with the points that two of them see, or, apart, those that none before has."""
    seen, tiles = problem.observations, []
    taken, has_tile = np.zeros(problem.num_images, bool), np.zeros(problem.num_points, bool)
    for group in groups:
        images = np.array(sorted(group))
        rows = np.flatnonzero(np.isin(seen.image_index, images))
        twice = np.bincount(seen.point_index[rows], minlength=problem.num_points) > 1
        points = np.flatnonzero(twice & ~(has_tile & is_apart))
        rows = rows[np.isin(seen.point_index[rows], points)]
        cameras = np.unique(problem.camera_index[images])
        of_kind = {"image_index": images, "point_index": points, "camera_index": cameras}
        chosen = []
        for prior in problem.priors:
            name = next((name for name in of_kind if hasattr(prior, name)), None)
            index = np.array([0]) if name is None else getattr(prior, name)
            chosen.append(np.flatnonzero(np.isin(index, of_kind[name]) if name else index == 0))
        part = sub_problem(problem, rows, images, points, cameras, chosen)
        names = tuple(problem.image_names[number] for number in images) if problem.image_names else ()
        tiles.append(BlockTile(dataclasses.replace(part, image_names=names), images, points, ~taken[images]))
        taken[images], has_tile[points] = True, True
    return tiles


@functools.cache
def _truth(*, gnss: bool, num_control: int = 0, num_cameras: int = 1) -> Problem:
    """A block without noise at its true values."""
    survey = jaxba.synthetic.uav_block(
        24, points_per_image=40.0, side_overlap=0.7, pixel_std_px=0.0, num_control=num_control, num_cameras=num_cameras,
        gnss_std_m=(0.03, 0.03, 0.06) if gnss else None, lever_arm_m=(0.1, -0.2, 0.3),
    )  # fmt: skip
    truth, problem = survey.truth, survey.problem
    exact = {"control": truth.points[truth.control_index], "position": truth.poses.center}
    exact["position"] = exact["position"] + np.einsum("nji,j->ni", truth.poses.rotation, truth.lever_arm)
    priors = tuple(dataclasses.replace(prior, xyz=np.asarray(exact[prior.name])) for prior in problem.priors)
    return dataclasses.replace(
        problem,
        poses=truth.poses,
        cameras=truth.cameras,
        points=truth.points,
        priors=priors,
        image_names=tuple(f"{number}.JPG" for number in range(24)),
    )


def _moved(tile: BlockTile, by: Similarity) -> BlockTile:
    """Return a tile in another frame."""
    poses = tile.problem.poses
    rotation = Rotation.from_matrix(by.rotations(np.asarray(poses.rotation)))
    changed = Pose(rotation.as_quat(scalar_first=True), -rotation.apply(by.points(np.asarray(poses.center))))
    values = changed, by.points(tile.problem.points), by.scale * tile.problem.lever_arm
    where = lambda p: (p.poses, p.points, p.lever_arm)  # noqa: E731
    return dataclasses.replace(tile, problem=eqx.tree_at(where, tile.problem, values))


def _some_similarity(seed: int) -> Similarity:
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(rng.normal(size=3)).as_matrix()
    return Similarity(scale=float(np.exp(rng.normal())), rotation=turn, shift=200 * rng.normal(size=3))


def _assert_values(found: Problem, wanted: Problem, atol: float) -> None:
    np.testing.assert_allclose(found.poses.center, wanted.poses.center, rtol=0, atol=atol)
    np.testing.assert_allclose(found.poses.rotation, wanted.poses.rotation, rtol=0, atol=atol)
    np.testing.assert_allclose(found.points, wanted.points, rtol=0, atol=atol)
    for name in wanted.cameras.parameter_names():
        np.testing.assert_allclose(getattr(found.cameras, name), getattr(wanted.cameras, name), rtol=1e-12, atol=1e-12)


def _fixed(problem: Problem) -> Problem:
    return problem.fix(poses=[1, 2, 5])


_PLACED: dict[str, tuple[Problem, Callable[[Problem], Problem]]] = {
    "GNSS": (_truth(gnss=True), lambda p: p),
    "control": (_truth(gnss=False, num_control=5), lambda p: p),
    "fixed poses": (_truth(gnss=False), _fixed),
    "a camera for every six images": (_truth(gnss=True, num_cameras=4), lambda p: p),
}


@pytest.mark.parametrize("kind", list(_PLACED))
def test_moved_tiles_come_back_to_the_frame_of_what_places_them(kind: str) -> None:
    # breaks where a frame is left to a tile's own, a similarity is taken backwards, or cameras change places
    block, changed = _PLACED[kind]
    block = changed(block)
    moves = [Similarity.identity() if kind == "fixed poses" else _some_similarity(3), _some_similarity(4)]
    tiles = [_moved(*each) for each in zip(_cut(block, _GROUPS), moves, strict=True)]
    merged = jaxba.merge_tiles(block, tiles, global_pass=False)
    assert merged.by_priors
    _assert_values(merged.problem, block, 1e-8)
    for tile, move in zip(merged.tiles, moves, strict=True):
        back = move.inverse()
        np.testing.assert_allclose(tile.similarity.scale, back.scale, rtol=1e-10)
        np.testing.assert_allclose(tile.similarity.rotation, back.rotation, rtol=0, atol=1e-10)
        np.testing.assert_allclose(tile.similarity.shift, back.shift, rtol=0, atol=1e-8)
        assert tile.misfit_m < 1e-8


def test_tiles_that_nothing_places_come_into_the_frame_of_the_largest() -> None:
    # breaks where the frame wanders by the steps that all tiles take, or wrong points turn a tile
    block = _truth(gnss=False)
    moves = [_some_similarity(5), Similarity.identity(), _some_similarity(6)]
    tiles = [_moved(*each) for each in zip(_cut(block, [range(9), range(5, 20), range(16, 24)]), moves, strict=True)]
    wrong = np.random.default_rng(0).permutation(tiles[0].problem.num_points)[:60]
    points = np.array(tiles[0].problem.points)
    points[wrong] += np.random.default_rng(1).normal(size=(60, 3)) * 10.0 ** np.linspace(0, 6, 60)[:, None]
    tiles[0] = dataclasses.replace(tiles[0], problem=eqx.tree_at(lambda p: p.points, tiles[0].problem, points))
    merged = jaxba.merge_tiles(block, tiles, global_pass=False)
    assert not merged.by_priors and merged.root == 1
    np.testing.assert_allclose(merged.problem.poses.center, block.poses.center, rtol=0, atol=1e-6)
    shared = np.isin(tiles[0].points, np.concatenate([tile.points for tile in tiles[1:]]))
    contradicted = np.isin(tiles[0].points[wrong], np.concatenate([tile.points for tile in tiles[1:]]))
    off = np.linalg.norm(merged.problem.points - block.points, axis=1)[tiles[0].points]
    assert shared.any() and contradicted.any() and merged.num_contradictions >= np.count_nonzero(contradicted)
    assert "of a tile are left out of the mean" in " ".join(merged.summary())
    assert np.count_nonzero(off > 1e-6) <= len(wrong)
    assert merged.tiles[1].similarity.scale == pytest.approx(1.0, abs=1e-14)


def test_a_point_that_no_tile_has_is_intersected() -> None:
    # breaks where its start value stays, which may be in another frame than the merged images
    block = _truth(gnss=True)
    tiles = _cut(block, [range(0, 12), range(12, 24)])
    held = np.isin(np.arange(block.num_points), np.concatenate([tile.points for tile in tiles]))
    spoilt = eqx.tree_at(lambda p: p.points, block, block.points + 3.0 * ~held[:, None])
    merged = jaxba.merge_tiles(spoilt, tiles, global_pass=False)
    assert not held.all() and np.array_equal(merged.intersected, np.flatnonzero(~held))
    np.testing.assert_allclose(merged.problem.points, block.points, rtol=0, atol=1e-5)
    assert merged.shared.any()  # no image is in two tiles, but points of both are seen from either side


@functools.cache
def _merged() -> tuple[Problem, list[BlockTile], Merged, Merged]:
    """A strip with GNSS and some things held fixed, its tiles after each was solved, and both ways to merge them."""
    survey = jaxba.synthetic.uav_block(24, points_per_image=40.0, num_lines=1, seed=2)
    problem, truth = survey.problem.fix(poses=[3, 12], points=[4, 200], intrinsics=["p1"]), survey.truth
    free = problem.free
    poses = Pose(
        np.where(free.poses[:, None], problem.poses.quaternion, truth.poses.quaternion),
        np.where(free.poses[:, None], problem.poses.translation, truth.poses.translation),
    )
    values = poses, np.where(free.points[:, None], problem.points, truth.points), truth.cameras.p1
    problem = eqx.tree_at(lambda p: (p.poses, p.points, p.cameras.p1), problem, values)
    tiles = _cut(problem, _GROUPS)
    solved = [
        dataclasses.replace(tile, problem=solution.apply(tile.problem))
        for tile, solution in zip(tiles, jaxba.solve_batch([tile.problem for tile in tiles]), strict=True)
    ]
    once = jaxba.merge_tiles(problem, solved, global_pass=False)
    return problem, solved, once, jaxba.merge_tiles(problem, solved, ftol=1e-13, xtol=1e-13)


def _cost(problem: Problem) -> float:
    """Half the sum of squared residuals, by numpy."""
    cost = 0.5 * np.sum((jaxba.reprojection_errors(problem) / problem.observations.std_px) ** 2)
    prior = problem.priors[0]
    return float(cost + 0.5 * np.sum(((np.asarray(problem.poses.center) - prior.xyz) / prior.std_m) ** 2))


def test_the_pass_is_that_of_the_block_with_all_else_held() -> None:
    # breaks where an observation or a prior's row is lost in the part of the block that takes part
    problem, _, once, whole = _merged()
    assert whole.solutions[1].report is not None
    assert whole.solutions[1].report.problem.num_observations < problem.num_observations
    first = jaxba.solve(once.problem.fix(poses=True, intrinsics=True), ftol=1e-13, xtol=1e-13).apply(problem)
    seen = problem.observations
    moves = np.unique(seen.point_index[once.shared[seen.image_index]])
    assert 3 <= np.count_nonzero(once.shared) < 24 and len(moves) < problem.num_points
    held = first.fix(poses=~once.shared, intrinsics=True)
    held = held.fix(points=~np.isin(np.arange(problem.num_points), moves))
    solution = jaxba.solve(held, ftol=1e-13, xtol=1e-13)
    _assert_values(whole.problem, solution.apply(problem), 1e-7)
    costs = [_cost(one) for one in (once.problem, first, whole.problem)]
    assert costs[0] > 1.05 * costs[1] and costs[1] > 1.001 * costs[2]
    np.testing.assert_allclose(costs[2], solution.final_cost, rtol=1e-9)


def test_the_exact_adjustment_is_better_than_what_was_merged() -> None:
    problem, _, once, whole = _merged()
    exact = jaxba.solve(problem)
    assert exact.final_cost < 0.9999 * _cost(whole.problem)
    assert _cost(whole.problem) < 1.1 * exact.final_cost < _cost(once.problem)
    again = jaxba.solve(whole.problem)
    np.testing.assert_allclose(again.final_cost, exact.final_cost, rtol=1e-7)  # ftol


def test_a_camera_of_shared_images_alone_is_adjusted_with_them() -> None:
    # breaks where an image has a camera of its own, and keeps the mean of what its tiles say of it
    block = _truth(gnss=True, num_cameras=24)
    tiles = _cut(block, _GROUPS)
    for number, tile in enumerate(tiles):
        fx = np.array(tile.problem.cameras.fx)
        fx[tile.images == 11] += 2.0
        spoilt = eqx.tree_at(lambda p: p.cameras.fx, tile.problem, fx)
        tiles[number] = dataclasses.replace(tile, problem=spoilt)
    merged = jaxba.merge_tiles(block, tiles)
    assert merged.shared[11]
    np.testing.assert_allclose(merged.problem.cameras.fx, block.cameras.fx, rtol=0, atol=1e-2)


def test_what_is_held_fixed_stays() -> None:
    # breaks where a mean, an intersection or the pass writes over it
    problem, _, once, whole = _merged()
    for merged in (once.problem, whole.problem):
        for name in ("quaternion", "translation"):
            kept, given = (getattr(one.poses, name)[[3, 12]] for one in (merged, problem))
            np.testing.assert_allclose(kept, given, rtol=1e-14)  # a solve normalises quaternions
        np.testing.assert_array_equal(merged.points[[4, 200]], problem.points[[4, 200]])
        assert merged.cameras.p1 == problem.cameras.p1


def _renamed(tile: BlockTile) -> BlockTile:
    return dataclasses.replace(tile, problem=dataclasses.replace(tile.problem, image_names=("a.JPG",) * 14))


def _nan_at_3(values: np.ndarray) -> np.ndarray:
    values[3] = np.nan
    return values


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: dataclasses.replace(t, images=t.images + 5), "tile 1 of 2: images: number 24, but .* 24 images"),
        (
            lambda t: dataclasses.replace(t, images=t.images[1:], own=t.own[1:]),
            "images: 13 numbers for 14 images of its problem",
        ),
        (lambda t: dataclasses.replace(t, images=t.images * 0 + 9), "images: a number stands twice"),
        (lambda t: dataclasses.replace(t, points=-1 - t.points), "points: number -1, but .* cut from another block"),
        (_renamed, r"tile 1 of 2: a.JPG is image 10 \(10.JPG\) of the block: .*another block"),
    ],
)
def test_tiles_of_another_block_are_refused(change: Callable[[BlockTile], BlockTile], message: str) -> None:
    block = _truth(gnss=True)
    first, second = _cut(block, _GROUPS)
    with pytest.raises(JaxbaError, match=message):
        jaxba.merge_tiles(block, [first, change(second)])


@pytest.mark.parametrize(
    ("where", "change", "message"),
    [
        (lambda p: p.points, _nan_at_3, "tile 1 of 2: points: point 3 has nan"),
        (lambda p: p.poses.translation, _nan_at_3, r"tile 1 of 2: poses.translation: image 3 \(13.JPG\) has nan"),
        (lambda p: p.cameras.fx, lambda fx: -fx, "tile 1 of 2: cameras: .*focal"),
        (
            lambda p: p.observations.xy_px,
            lambda xy: xy + 1.0,
            r"tile 1 of 2: \d+ of its observations are none of the block, first: point \d+ at .* px in image",
        ),
    ],
)
def test_values_that_are_none_are_refused(
    where: Callable[[Problem], object], change: Callable[[np.ndarray], np.ndarray], message: str
) -> None:
    block = _truth(gnss=True)
    first, second = _cut(block, _GROUPS)
    spoilt = eqx.tree_at(where, second.problem, change(np.array(where(second.problem))))
    with pytest.raises(JaxbaError, match=message):
        jaxba.merge_tiles(block, [first, dataclasses.replace(second, problem=spoilt)])


@pytest.mark.parametrize(
    ("groups", "message"),
    [
        ([range(0, 14)], r"image 14 \(14.JPG\) \(and 9 more\) is in no tile"),
        ([], "tiles are empty"),
        ([range(0, 4), range(20, 24), range(4, 20)], "tile 0; tile 1; tile 2 have too little in common"),
        ([range(0, 8), range(6, 12), range(12, 24)], "tiles 0, 1; tile 2 have too little in common"),
    ],
)
def test_tiles_that_do_not_make_the_block_are_named(groups: list[range], message: str) -> None:
    block = _truth(gnss=False)
    with pytest.raises(JaxbaError, match=message):
        jaxba.merge_tiles(block, _cut(block, groups, is_apart=True))


def test_tiles_with_an_offset_of_positions_each_are_refused() -> None:
    block = _truth(gnss=True)
    offset = np.zeros((1, 3)), np.array(True)
    free = eqx.tree_at(lambda p: (p.position_offset, p.free.position_offset), block, offset)
    with pytest.raises(JaxbaError, match=r"position offset is free, .* jaxba\.solve_tiled finds one"):
        jaxba.merge_tiles(free, _cut(free, _GROUPS))


def test_wrong_options_are_refused() -> None:
    block = _truth(gnss=True)
    with pytest.raises(JaxbaError, match="merge_tiles: max_nfev is 0"):
        jaxba.merge_tiles(block, _cut(block, _GROUPS), max_nfev=0)
