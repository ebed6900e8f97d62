"""The picture of a partition: sameness, and that tiles, separators and points cut are seen on it."""

import functools
import io

import equinox as eqx
import numpy as np
import pytest
from PIL import Image

import jaxba
from jaxba import Partition
from jaxba.report import draw_tiles
from jaxba.report._tiles_picture import _COLOURS, _colour_of_tile


@functools.cache
def _cut(max_images: int = 9, overlap: int = 3) -> Partition:
    problem = jaxba.synthetic.uav_block(36, points_per_image=40.0).problem
    return jaxba.partition(problem, max_images=max_images, overlap=overlap)


def _pixels(found: Partition) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(draw_tiles(found, "tiles", "images"))).convert("RGB")).astype(int)


def _count(shown: np.ndarray, colour: str) -> int:
    return int(np.all(shown == [int(colour[k : k + 2], 16) for k in (1, 3, 5)], axis=2).sum())


def test_the_same_partition_gives_the_same_bytes() -> None:
    assert draw_tiles(_cut(), "a", "b") == draw_tiles(_cut(), "a", "b")
    assert draw_tiles(_cut(), "a", "b") != draw_tiles(_cut(overlap=4), "a", "b")


def test_each_tile_has_its_colour_on_the_map_and_among_the_sizes() -> None:
    shown = _pixels(_cut())
    assert shown.shape == (900, 1600, 3)
    for colour in _COLOURS[:4]:
        assert _count(shown[:, :780], colour) > 100 and _count(shown[:, 800:], colour) > 1000
    assert _count(shown, _COLOURS[4]) == 0
    assert _count(shown[:, :780], "#5b6673") > 500  # points that are cut
    assert _count(_pixels(_cut(max_images=36)), "#5b6673") == 0


def test_tiles_that_overlap_have_different_colours() -> None:
    found = jaxba.partition(jaxba.synthetic.uav_block(100, points_per_image=40.0).problem, max_images=5, overlap=3)
    colour = _colour_of_tile(found)
    assert len(found.tiles) == 20 and set(colour) == set(range(10))
    for number, tile in enumerate(found.tiles):
        others = np.unique(found.owner[tile.images[~tile.own]])
        assert colour[number] not in colour[others]


@pytest.mark.parametrize("kind", ["one place", "a line", "one tile", "many tiles"])
def test_odd_blocks_are_drawn_too(kind: str) -> None:
    options = {"one tile": {"max_images": 36}, "many tiles": {"max_images": 2, "overlap": 1}}.get(kind, {})
    found = _cut(**options)
    if kind in ("one place", "a line"):
        scale = np.array([0.0, 0, 0] if kind == "one place" else [0.0, 1, 0])
        block = eqx.tree_at(lambda p: p.poses.translation, found.block, found.block.poses.translation * scale)
        found = Partition(**{**vars(found), "block": block})
    shown = _pixels(found)
    assert shown.shape == (900, 1600, 3) and _count(shown, _COLOURS[0]) > 100
