"""Tiles of a block in files: their place is read back, and what does not belong together is told apart."""

import dataclasses
import errno
import functools
import re
from collections.abc import Callable
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
import pytest

import jaxba
from jaxba import JaxbaError, Partition, Problem
from jaxba.io import _tiles, fingerprint_of, place_of, read_block_tile, read_tile, read_tiles, write_tile, write_tiles
from jaxba.io._tile import tile_of_bytes


@functools.cache
def _block(seed: int = 0) -> Problem:
    problem = jaxba.synthetic.uav_block(16, seed=seed, points_per_image=40.0, num_cameras=4, num_control=3).problem
    return dataclasses.replace(problem, image_names=tuple(f"{k}.JPG" for k in range(16)))


@functools.cache
def _cut(seed: int = 0, max_images: int = 4, overlap: int = 2) -> Partition:
    return jaxba.partition(_block(seed), max_images=max_images, overlap=overlap)


@pytest.fixture
def paths(tmp_path: Path) -> list[Path]:
    return write_tiles(tmp_path / "tiles", _cut())


def _rewrite(path: Path, **changes: object) -> None:
    """Write a file's arrays again, some of them changed, or left out where the change is None."""
    with np.load(path) as arrays:
        kept = {name: changes.pop(name, arrays[name]) for name in arrays.files}
    np.savez(path, **{name: value for name, value in (kept | changes).items() if value is not None})


def test_tiles_are_read_back_in_their_order_with_their_place(paths: list[Path]) -> None:
    found = read_tiles(paths[::-1], _block())
    assert [tile.path for tile in found] == paths and [tile.number for tile in found] == [0, 1, 2, 3]
    for read, tile in zip(found, _cut().tiles, strict=True):
        for name in ("images", "points", "own"):
            np.testing.assert_array_equal(getattr(read.tile, name), getattr(tile, name))
        for value, same in zip(jax.tree.leaves(read.tile.problem), jax.tree.leaves(tile.problem), strict=True):
            np.testing.assert_array_equal(value, same)
        assert read.tile.problem.image_names == tile.problem.image_names
        np.testing.assert_array_equal(read.cameras, np.unique(_block().camera_index[tile.images]))
        assert (read.count, read.num_images, read.num_cameras, read.num_points) == (4, 16, 4, _block().num_points)
        assert read.block == fingerprint_of(_block())
    assert [read_tile(path).num_images for path in paths] == [tile.problem.num_images for tile in _cut().tiles]


def test_equal_partitions_give_the_same_bytes_wherever_the_block_was_read(paths: list[Path], tmp_path: Path) -> None:
    write_tile(tmp_path / "block.npz", _block())
    again = jaxba.partition(read_tile(tmp_path / "block.npz"), max_images=4, overlap=2)
    for path, other in zip(paths, write_tiles(tmp_path / "again", again), strict=True):
        assert path.read_bytes() == other.read_bytes()


def test_a_solved_tile_keeps_its_place(paths: list[Path], tmp_path: Path) -> None:
    held = tile_of_bytes(paths[1].read_bytes(), "tile")
    problem, extras = held.problem, held.extras
    moved = eqx.tree_at(lambda p: p.points, problem, problem.points + 1.0)
    solved = tmp_path / "tile_001.solved.npz"
    write_tile(solved, moved, extras=place_of(extras) | {"error_px": np.zeros(3)})
    found = read_tiles([paths[0], solved, *paths[2:]], _block())
    np.testing.assert_array_equal(found[1].tile.problem.points, moved.points)
    assert "error_px" not in place_of(extras) and len(place_of(extras)) == 11


def test_the_extras_of_a_tile_are_those_that_the_readme_tells(paths: list[Path]) -> None:
    text = (Path(jaxba.io.__file__).parent / "README.md").read_text(encoding="utf-8")
    section = text.split("## Tiles of a block\n")[1].split("\n## ")[0]
    with np.load(paths[0]) as arrays:
        extras = {name for name in arrays.files if name.startswith("extra_")}
        for line in section.splitlines():
            names = re.findall(r"`(extra_tile_\w+)`", line)
            for name in names if line.startswith("|") else ():
                shape = re.search(r"\| \(([a-z]*),?\) \|", line)
                assert shape is not None and (arrays[name].ndim == 1) == bool(shape[1])
    assert set(re.findall(r"`(extra_tile_\w+)`", section)) == extras


@pytest.mark.parametrize(
    ("choose", "message"),
    [
        (lambda p: p[:2] + p[3:], "tile 2 of 0 to 3 is missing; give all tiles"),
        (lambda p: p[:1], r"tile 1 of 0 to 3 is missing \(and 2 more\)"),
        (lambda p: [*p, p[1]], r"tile_001.npz: is tile 1, as .*tile_001.npz is; give one of them"),
        (lambda p: [], "no tiles are given"),
    ],
)
def test_missing_and_double_tiles_are_named(
    paths: list[Path], choose: Callable[[list[Path]], list[Path]], message: str
) -> None:
    with pytest.raises(JaxbaError, match=message):
        read_tiles(choose(paths))


def test_tiles_of_another_survey_or_partition_are_told_apart(paths: list[Path], tmp_path: Path) -> None:
    of_survey = write_tiles(tmp_path / "survey", _cut(seed=1))
    with pytest.raises(JaxbaError, match=r"survey/tile_002.npz: is of another block than .*tiles/tile_000.npz"):
        read_tiles([*paths[:2], of_survey[2], paths[3]])
    of_partition = write_tiles(tmp_path / "other", _cut(overlap=3))
    with pytest.raises(JaxbaError, match=r"other/tile_003.npz: is of another partition than .*tiles/tile_000.npz"):
        read_tiles([*paths[:3], of_partition[3]])
    with pytest.raises(JaxbaError, match=r"tile_000.npz: is a tile of another block than the one given"):
        read_tiles(paths, _block(1))
    for change in (
        eqx.tree_at(lambda p: p.observations.xy_px, _block(), _block().observations.xy_px + 1e-9),
        _block().fix(poses=[3]),
        _block().bound(k1=(-1.0, 1.0)),
    ):
        with pytest.raises(JaxbaError, match="is a tile of another block"):
            read_tiles(paths, change)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"extra_tile_images": np.arange(5)},
            r"extra_tile_images has the shape \(5,\), but the tile's arrays say \(6,\)",
        ),
        ({"extra_tile_own": np.ones((6, 1), bool)}, r"extra_tile_own has the shape \(6, 1\)"),
        ({"extra_tile_own": np.ones(6)}, "extra_tile_own has the type float64"),
        ({"extra_tile_points": np.arange(3)}, r"extra_tile_points has the shape \(3,\)"),
        ({"extra_tile_cameras": np.arange(9)}, r"extra_tile_cameras has the shape \(9,\)"),
        ({"extra_tile_images": np.arange(6)[::-1]}, "extra_tile_images must hold numbers from 0 to 15, ascending"),
        ({"extra_tile_images": np.arange(6) + 13}, "extra_tile_images must hold numbers from 0 to 15"),
        ({"extra_tile_images": np.arange(6) - 1}, "extra_tile_images must hold numbers from 0 to 15"),
        ({"extra_tile_number": np.array(4)}, "extra_tile_number is 4, but tiles go from 0 to 3"),
        ({"extra_tile_number": np.array("one")}, "extra_tile_number has the type <U3"),
        ({"extra_tile_count": np.array([4])}, r"extra_tile_count has the shape \(1,\)"),
        ({"extra_tile_block": np.array(3)}, "extra_tile_block has the type int64"),
        ({"extra_tile_own": None, "extra_tile_block": None}, "it lacks extra_tile_block, extra_tile_own; give what"),
    ],
)
def test_a_place_that_contradicts_the_tile_is_refused(
    paths: list[Path], changes: dict[str, object], message: str
) -> None:
    assert _cut().tiles[2].problem.num_images == 6
    _rewrite(paths[2], **changes)
    with pytest.raises(JaxbaError, match=f"tile_002.npz: .*{message}"):
        read_tiles(paths)
    read_tile(paths[2])  # as a problem of its own it is as good as before


def test_images_left_out_of_a_tile_by_another_program_are_noticed(paths: list[Path]) -> None:
    tile = read_block_tile(paths[0]).tile
    smaller = jaxba.partition(tile.problem, max_images=4, overlap=0).tiles[0].problem
    extras = tile_of_bytes(paths[0].read_bytes(), "tile").extras
    write_tile(paths[0], smaller, extras=place_of(extras))
    with pytest.raises(JaxbaError, match=r"extra_tile_images has the shape \(6,\), .* cut the block again"):
        read_tiles(paths)


def test_a_file_that_is_no_tile_of_a_block_is_told(tmp_path: Path) -> None:
    write_tile(tmp_path / "a.npz", _block())
    with pytest.raises(JaxbaError, match=r"a.npz: is no tile of a partition, since it lacks extra_tile_number"):
        read_block_tile(tmp_path / "a.npz")
    with pytest.raises(JaxbaError, match="no such file"):
        read_tiles([tmp_path / "b.npz"])


def test_old_tiles_give_way_and_nothing_else_does(paths: list[Path]) -> None:
    folder = paths[0].parent
    others = ["tile_000.solved.npz", "tile_01.npz", "notes.txt", "tiles.png", "my_tile_000.npz"]
    for name in others:
        (folder / name).write_bytes(b"mine")
    written = write_tiles(folder, _cut(max_images=8))
    assert [path.name for path in written] == ["tile_000.npz", "tile_001.npz"]
    assert sorted(path.name for path in folder.iterdir()) == sorted([*others, "tile_000.npz", "tile_001.npz"])
    assert all((folder / name).read_bytes() == b"mine" for name in others)


@pytest.mark.parametrize("name", ["tile_000.npz", "tile_077.npz"])
@pytest.mark.parametrize("kind", ["a problem", "no zip", "a folder"])
def test_a_file_of_the_user_that_is_called_like_a_tile_is_kept(tmp_path: Path, name: str, kind: str) -> None:
    path = tmp_path / name
    if kind == "a problem":
        write_tile(path, _block())
    elif kind == "no zip":
        path.write_text("mine")
    else:
        path.mkdir()
    with pytest.raises(JaxbaError, match=rf"{name}: not written over, since it is no tile of a partition; move it"):
        write_tiles(tmp_path, _cut())
    assert list(tmp_path.iterdir()) == [path]


def test_the_file_that_the_block_came_from_is_kept(paths: list[Path]) -> None:
    with pytest.raises(JaxbaError, match=r"tile_002.npz: the output is the input"):
        write_tiles(paths[0].parent, _cut(max_images=8), source=paths[2])
    assert all(path.is_file() for path in paths)


def test_a_full_disk_is_said_and_leaves_whole_tiles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def write_two(path: Path, *args: object, **options: object) -> None:
        if path.name == "tile_002.npz":
            raise _tiles.cannot_write(path, OSError(errno.ENOSPC, ""))
        write_tile(path, *args, **options)  # pyright: ignore[reportArgumentType]

    monkeypatch.setattr(_tiles, "write_tile", write_two)
    with pytest.raises(JaxbaError, match=r"tile_002.npz: not written, No space left on device: free some space"):
        write_tiles(tmp_path, _cut())
    assert [read_block_tile(path).number for path in sorted(tmp_path.iterdir())] == [0, 1]


def test_a_folder_that_cannot_be_made_is_said(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for folder in (tmp_path / "file", tmp_path / "file" / "tiles"):
        with pytest.raises(JaxbaError, match=r"file.*: not written, "):
            write_tiles(folder, _cut())
