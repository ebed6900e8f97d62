"""Partition: what each tile holds, counted again one observation at a time; sizes, overlap, flight lines, refusals."""

import dataclasses
import functools
import inspect
from typing import Any

import equinox as eqx
import jax
import numpy as np
import pytest
from small_problems import EVERY_CAMERA, bounded, small_problem

import jaxba
from jaxba import JaxbaError, Partition, Problem
from jaxba.ba.tiles._flight_lines import flight_lines, packed

_BLOCK = functools.partial(jaxba.synthetic.uav_block, side_overlap=0.7, points_per_image=40.0, num_control=4)


@functools.cache
def _everything() -> Problem:
    """Four cameras, every prior, fixed parts, bounds, names, and an image that sees nothing."""
    problem = bounded(small_problem(EVERY_CAMERA[3], num_images=30, num_points=200, num_cameras=4, lever_arm=True), 9.0)
    problem = problem.fix(poses=[0, 7, 21], points=[5, 9, 100], intrinsics=["k2"])
    seen = problem.observations
    kept = jax.tree.map(lambda of: of[seen.image_index != 12], seen)
    return dataclasses.replace(problem, observations=kept, image_names=tuple(f"DJI_{k:04d}.JPG" for k in range(30)))


@functools.cache
def _lines() -> Problem:
    """Four lines of nine images, there and back."""
    return _BLOCK(36, num_lines=4).problem


_CASES: dict[str, tuple[Any, dict[str, Any]]] = {
    "by images": (_everything, {"max_images": 10, "overlap": 3}),
    "by observations": (_everything, {"max_observations": 150.0, "overlap": 4}),
    "without overlap": (_everything, {"max_images": 8, "overlap": 0}),
    "much overlap": (_everything, {"max_images": 15, "overlap": 14}),
    "along the flight": (_everything, {"max_images": 12, "overlap": 3, "by": "flight-line"}),
    "a block of lines": (_lines, {"max_images": 12, "overlap": 5}),
    "one tile": (_lines, {"max_images": 36, "overlap": 50}),
    "own cameras": (lambda: _BLOCK(24, num_cameras=24).problem, {"max_observations": 2000.0, "overlap": 3}),
}


@functools.cache
def _cut(case: str) -> Partition:
    make, options = _CASES[case]
    return jaxba.partition(make(), **options)


every_case = pytest.mark.parametrize("case", _CASES)


@every_case
def test_each_image_is_own_once_and_sizes_are_kept(case: str) -> None:
    found, options = _cut(case), _CASES[case][1]
    block = found.block
    owned = np.concatenate([tile.images[tile.own] for tile in found.tiles])
    assert sorted(owned) == list(range(block.num_images))
    counts = np.bincount(block.observations.image_index, minlength=block.num_images)
    for number, tile in enumerate(found.tiles):
        own = tile.images[tile.own]
        assert np.all(found.owner[own] == number)
        assert len(own) <= options.get("max_images", block.num_images)
        assert counts[own].sum() <= options.get("max_observations", np.inf)
        assert 0 <= len(tile.images) - len(own) <= options["overlap"]


@every_case
def test_a_tile_holds_what_its_images_see_twice_and_all_of_it(case: str) -> None:
    # breaks where an observation is lost, or a number of the block is taken for one of the tile
    found = _cut(case)
    block, seen = found.block, found.block.observations
    rows = list(zip(seen.image_index.tolist(), seen.point_index.tolist(), strict=True))
    held = np.zeros(block.num_points, bool)
    for tile in found.tiles:
        images, part = set(tile.images.tolist()), tile.problem
        views: dict[int, int] = {}
        for image, point in rows:
            if image in images:
                views[point] = views.get(point, 0) + 1
        assert tile.points.tolist() == sorted(point for point, count in views.items() if count >= 2)
        held[tile.points] = True
        kept = [k for k, (image, point) in enumerate(rows) if image in images and views[point] >= 2]
        mine = part.observations
        np.testing.assert_array_equal(tile.images[mine.image_index], seen.image_index[kept])
        np.testing.assert_array_equal(tile.points[mine.point_index], seen.point_index[kept])
        np.testing.assert_array_equal(mine.xy_px, seen.xy_px[kept])
        np.testing.assert_array_equal(mine.std_px, seen.std_px[kept])
        np.testing.assert_array_equal(part.points, block.points[tile.points])
        np.testing.assert_array_equal(part.poses.translation, block.poses.translation[tile.images])
        np.testing.assert_array_equal(part.poses.quaternion, block.poses.quaternion[tile.images])
        np.testing.assert_array_equal(part.free.poses, block.free.poses[tile.images])
        np.testing.assert_array_equal(part.free.points, block.free.points[tile.points])
        cameras = np.unique(block.camera_index[tile.images])
        np.testing.assert_array_equal(cameras[part.camera_index], block.camera_index[tile.images])
        for name in block.cameras.parameter_names():
            np.testing.assert_array_equal(getattr(part.cameras, name), getattr(block.cameras, name)[cameras])
        for of_part, of_block in (
            (part.lower, block.lower), (part.upper, block.upper), (part.free.intrinsics, block.free.intrinsics)
        ):  # fmt: skip
            np.testing.assert_array_equal(of_part, of_block[cameras])
        assert part.image_names == tuple(block.image_names[k] for k in tile.images if block.image_names)
        assert part.free.lever_arm == block.free.lever_arm
        _check_priors(block, part, {"image": tile.images, "point": tile.points, "camera": cameras})
    times = np.bincount(seen.point_index, minlength=block.num_points)
    np.testing.assert_array_equal(found.is_left_out, (times >= 2) & ~held)


def _check_priors(block: Problem, part: Problem, numbers: dict[str, np.ndarray]) -> None:
    """Each row of each prior is there if, and only if, what it is of is."""
    assert [prior.name for prior in part.priors] == [prior.name for prior in block.priors]
    for whole, mine in zip(block.priors, part.priors, strict=True):
        assert mine.loss == whole.loss
        index = next((name for name in vars(whole) if name.endswith("_index")), None)
        kept = np.arange(len(next(iter(vars(whole).values()))))
        if index is not None:
            of = numbers[index.removesuffix("_index")]
            kept = np.array([k for k, number in enumerate(getattr(whole, index)) if number in of], int)
            np.testing.assert_array_equal(of[getattr(mine, index)], getattr(whole, index)[kept])
        for name in vars(whole):
            if name not in ("loss", index) and getattr(whole, name) is not None:
                np.testing.assert_array_equal(getattr(mine, name), np.asarray(getattr(whole, name))[kept])


@every_case
def test_separators_and_points_cut_are_those_of_several_tiles(case: str) -> None:
    found = _cut(case)
    seen = found.block.observations
    times = np.zeros(found.block.num_images, int)
    for tile in found.tiles:
        times[tile.images] += 1
    np.testing.assert_array_equal(found.is_separator, times > 1)
    owners: list[set[int]] = [set() for _ in range(found.block.num_points)]
    for image, point in zip(seen.image_index, seen.point_index, strict=True):
        owners[point].add(int(found.owner[image]))
    np.testing.assert_array_equal(found.is_cut, [len(of_point) > 1 for of_point in owners])


@every_case
def test_equal_blocks_are_cut_alike_whatever_holds_their_arrays(case: str) -> None:
    found = _cut(case)
    make, options = _CASES[case]
    again = jaxba.partition(jax.tree.map(np.copy, make()), **options)
    for one, other in zip(found.tiles, again.tiles, strict=True):
        for value, same in zip(jax.tree.leaves(vars(one)), jax.tree.leaves(vars(other)), strict=True):
            np.testing.assert_array_equal(value, same)
    np.testing.assert_array_equal(found.owner, again.owner)


def test_the_images_taken_over_share_most_points_and_each_neighbour_gives_some() -> None:
    # breaks where shared points are counted with the wrong tile, or one neighbour gives all
    problem = _BLOCK(100).problem
    found = jaxba.partition(problem, max_images=25, overlap=10)
    seen = problem.observations
    assert len(found.tiles) == 4
    for number, tile in enumerate(found.tiles):
        of_own = set(seen.point_index[found.owner[seen.image_index] == number].tolist())
        shared = np.zeros(100, int)
        for image, point in zip(seen.image_index, seen.point_index, strict=True):
            shared[image] += point in of_own and found.owner[image] != number
        taken = tile.images[~tile.own]
        assert len(taken) == 10 and shared[taken].min() > 0
        for neighbour in set(range(4)) - {number}:
            theirs = np.flatnonzero(found.owner == neighbour)
            given = np.intersect1d(taken, theirs)
            assert len(given) >= min(3, np.count_nonzero(shared[theirs]))
            left = np.setdiff1d(theirs, given)
            assert not len(left) or shared[given].min() >= shared[left].max()


def test_cuts_by_space_need_few_separators() -> None:
    # of 100 images, cuts across the shorter overlap leave few points seen from both sides
    problem = _BLOCK(100).problem
    by_space = jaxba.partition(problem, max_images=25, overlap=0)
    at_random = np.random.default_rng(0).permutation(100) // 25
    seen = problem.observations
    tiles = np.unique(np.stack([seen.point_index, at_random[seen.image_index]]), axis=1)
    assert [int(tile.own.sum()) for tile in by_space.tiles] == [25] * 4
    assert by_space.is_cut.sum() < 0.5 * np.count_nonzero(np.bincount(tiles[0]) > 1)


@pytest.mark.parametrize("num_lines", [2, 3, 4, 6])
@pytest.mark.parametrize("turned", [0.0, 0.7])
def test_tiles_along_the_flight_end_at_turns(num_lines: int, turned: float) -> None:
    # breaks where wind and jitter count as a turn, or a turn is taken for one
    survey = _BLOCK(36, num_lines=num_lines)
    of_line = np.repeat(np.arange(num_lines), 36 // num_lines)
    centers = np.column_stack([of_line * 60.0, np.zeros(36), np.full(36, 100.0)])
    along = np.tile(np.arange(36 // num_lines), num_lines)
    centers[:, 1] = 20.0 * np.where(of_line % 2, 36 // num_lines - 1 - along, along)
    rotation = np.array([[np.cos(turned), -np.sin(turned), 0], [np.sin(turned), np.cos(turned), 0], [0, 0, 1]])
    starts = flight_lines(centers @ rotation.T + np.random.default_rng(0).normal(0, 1.0, (36, 3)))
    assert starts.tolist() == list(range(0, 36, 36 // num_lines))
    found = jaxba.partition(survey.problem, max_images=18, overlap=3, by="flight-line")
    assert np.all(np.diff(found.owner) >= 0)
    ends = np.flatnonzero(np.diff(found.owner)) + 1
    assert len(ends) == (2 if num_lines == 3 else 1) and set(ends.tolist()) <= set(starts.tolist())


@pytest.mark.parametrize(
    ("centers", "starts"),
    [
        ([[0, 0], [10, 0], [20, 0], [30, 15], [20, 30], [10, 30], [0, 30]], [0, 3, 4]),  # a photo in the turn
        ([[0, 0], [10, 0], [10, 0], [10.5, 0], [20, 0], [30, 0]], [0]),  # the drone stands
        ([[k * 10.0, k % 2] for k in range(9)], [0]),  # it wavers
        ([[30 * np.cos(a), 30 * np.sin(a)] for a in np.arange(0, 6.2, 0.2)], [0]),  # an orbit
        ([[0, 0], [10, 0], [20, 0], [30, 0], [30, 10], [30, 20], [30, 30]], [0, 4]),  # across
        ([[0, 0], [0, 10], [10, 10], [10, 0], [20, 0], [20, 10], [30, 10], [30, 0]], [0, 2, 4, 6]),
        ([[0, 0], [10, 0]], [0]),
    ],
    ids=["in the turn", "stands", "wavers", "orbit", "corner", "lines of two", "two"],
)
def test_lines_of_other_flights(centers: list[list[float]], starts: list[int]) -> None:
    assert flight_lines(np.column_stack([np.array(centers, float), np.zeros(len(centers))])).tolist() == starts


def test_a_line_that_is_too_large_is_cut_into_like_pieces() -> None:
    problem = _BLOCK(30, num_lines=1).problem
    found = jaxba.partition(problem, max_images=12, overlap=2, by="flight-line")
    assert np.bincount(found.owner).tolist() == [10, 10, 10]


@pytest.mark.parametrize(
    ("sizes", "most", "parts"),
    [
        ([5, 5, 5, 5], 10, [0, 0, 1, 1]),
        ([9, 1, 9, 1], 10, [0, 0, 1, 1]),
        ([1, 9, 9, 1], 10, [0, 0, 1, 1]),
        ([20, 1, 1], 10, [0, 1, 1]),
        ([3], 10, [0]),
        ([0, 0, 5], 10, [0, 0, 0]),
    ],
)
def test_lines_are_put_together_up_to_the_size(sizes: list[float], most: float, parts: list[int]) -> None:
    assert packed(np.array(sizes, float), float(most)).tolist() == parts


def test_cameras_in_one_place_and_equal_points_are_cut_all_the_same() -> None:
    problem = _lines()
    in_one_place = eqx.tree_at(lambda p: p.poses.translation, problem, np.zeros((36, 3)))
    for options in ({"max_images": 9}, {"max_images": 9, "by": "flight-line"}, {"max_observations": 800.0}):
        found = jaxba.partition(in_one_place, overlap=2, **options)
        assert len(found.tiles) >= 4 and min(len(tile.images) for tile in found.tiles) >= 2


def test_each_tile_is_a_problem_that_can_be_checked_and_keeps_what_is_given_up_small() -> None:
    for case in _CASES:
        for tile in _cut(case).tiles:
            jaxba.ba.prepare(tile.problem)
    found = _cut("a block of lines")
    assert found.is_left_out.sum() < 0.05 * found.is_cut.sum() + 30


_untyped = inspect.unwrap(jaxba.partition)  # in tests alone, values of other types do not even get that far


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "max_images and max_observations: neither is given; give one of them"),
        ({"max_images": 5, "max_observations": 1e3}, "5 and 1000 are given; give one of them"),
        ({"max_images": 1}, "max_images is 1; give a whole number of images, 2 or more"),
        ({"max_images": 7.5}, "max_images is 7.5; give a whole number"),
        ({"max_images": "many"}, "max_images is 'many', which is no number"),
        ({"max_images": float("nan")}, "max_images is nan"),
        ({"max_observations": 0}, "max_observations is 0; give a number of observations"),
        ({"max_observations": float("nan")}, "max_observations is nan"),
        ({"max_observations": 60, "overlap": 0}, r"max_observations 60 leaves 36 of 36 tiles one image .* alone has"),
        ({"max_images": 9, "by": "time"}, "by 'time': choose space or flight-line"),
        ({"max_images": 9, "overlap": -1}, "overlap is -1; give a whole number of images"),
        ({"max_images": 9, "overlap": 2.5}, "overlap is 2.5"),
        ({"max_images": 9, "overlap": 9}, r"overlap 9: the tiles have 9 images of their own .* such as 2"),
        ({"max_images": 9}, "overlap 50: the tiles have 9 images of their own"),
    ],
)
@pytest.mark.parametrize("by", ["space", "flight-line"])
def test_sizes_that_make_no_tiles_are_refused(by: str, options: dict[str, Any], message: str) -> None:
    with pytest.raises(JaxbaError, match=f"partition: .*{message}"):
        _untyped(_lines(), **{"by": by, **options})


def test_a_problem_that_cannot_be_cut_is_refused() -> None:
    problem = _lines()
    alone = jaxba.partition(problem, max_images=18, overlap=0).tiles[0].problem
    one = dataclasses.replace(
        alone, poses=jax.tree.map(lambda of: of[:1], alone.poses), camera_index=alone.camera_index[:1], priors=(),
        free=dataclasses.replace(alone.free, poses=alone.free.poses[:1]),
        observations=jax.tree.map(lambda of: of[alone.observations.image_index == 0], alone.observations),
    )  # fmt: skip
    with pytest.raises(JaxbaError, match="the block has one image; there is nothing to cut"):
        jaxba.partition(one, max_images=5)
    wrong = eqx.tree_at(lambda p: p.observations.image_index, problem, problem.observations.image_index + 1)
    with pytest.raises(JaxbaError, match="refers to image 36, but there are 36 images"):
        jaxba.partition(wrong, max_images=5)

    def cut(points: jax.Array) -> jax.Array:
        jaxba.partition(eqx.tree_at(lambda p: p.points, problem, points), max_images=9)
        return points

    with pytest.raises(JaxbaError, match="the problem is traced"):
        jax.jit(cut)(problem.points)
