"""Tiles of a block in files: each a `tile.npz` whose extras tell its place, so that all of them can be put together.

    extra_tile_number, extra_tile_count             tile 3 of 9; numbers from 0
    extra_tile_block, extra_tile_partition          fingerprints of the block, and of how it was cut
    extra_tile_block_images, _cameras, _points      how many the block has
    extra_tile_images, _cameras, _points            the number in the block of each that the tile has, ascending
    extra_tile_own                                  which images are the tile's own

A solved tile keeps them. Fingerprints are over the arrays as a tile holds them, so they do not depend on where the
block was read from.
"""

import contextlib
import dataclasses
import hashlib
import itertools
import os
import re
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Int

from jaxba._atomic import cannot_write, refuse_same_file
from jaxba._errors import JaxbaError
from jaxba.ba import BlockTile, Partition, Problem
from jaxba.geometry import AbstractLoss
from jaxba.io._read import read_bytes
from jaxba.io._schema import EXTRA
from jaxba.io._tile import arrays_of, tile_of_bytes, write_tile

_NAME = re.compile(r"tile_\d{3,}\.npz")
_PLACE = "tile_"
_NUMBERS = ("number", "count", "block_images", "block_cameras", "block_points")
_AGAIN = "cut the block again (jaxba partition)"


@dataclasses.dataclass(frozen=True, eq=False)
class TileFile:
    """A tile of a block, read from a file, and its place.

    - `number`, `count`: which tile it is, counted from 0, of how many.
    - `block`, `partition`: fingerprints of the block, and of how it was cut.
    - `cameras`: numbers, in the block, of the tile's cameras.
    - `num_images`, `num_cameras`, `num_points`: how many the block has.
    """

    path: Path
    tile: BlockTile
    number: int
    count: int
    block: str
    partition: str
    cameras: Int[np.ndarray, " cameras"]
    num_images: int
    num_cameras: int
    num_points: int


def write_tiles(
    folder: str | os.PathLike[str],
    partition: Partition,
    *,
    loss: AbstractLoss | None = None,
    source: str | os.PathLike[str] | None = None,
) -> list[Path]:
    """Write the tiles of a partition as `tile_000.npz` and so on, each whole or not at all; return their paths.

    The folder is made. Tiles that were written there before are removed first, and nothing else is.

    - `loss`: as of `write_tile`. `source`: the file that the block was read from, which is never removed.

    Raises:
        JaxbaError: the folder may not be written to, a full disk, a file in it that is called like a tile and is none
            of a partition, or what `write_tile` refuses.

    >>> import tempfile
    >>> import jaxba
    >>> found = jaxba.partition(jaxba.synthetic.uav_block(16).problem, max_images=8, overlap=2)
    >>> [path.name for path in write_tiles(tempfile.mkdtemp(), found)]
    ['tile_000.npz', 'tile_001.npz']
    """
    folder = Path(folder)
    places = _places(partition, os.fspath(folder))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        before = sorted(path for path in folder.iterdir() if _NAME.fullmatch(path.name))
        for path in before:
            if source is not None:
                refuse_same_file(source, path)
            if _partition_of(path) is None:
                raise JaxbaError(
                    f"{path}: not written over, since it is no tile of a partition; move it, or choose another folder "
                    "(--out)."
                )
        for path in before:
            path.unlink()
    except OSError as error:
        raise cannot_write(folder, error) from error
    paths = [folder / f"tile_{number:03d}.npz" for number in range(len(places))]
    for path, tile, place in zip(paths, partition.tiles, places, strict=True):
        write_tile(path, tile.problem, loss=loss, extras=place)
    return paths


def solved_before(paths: Sequence[Path]) -> list[Path]:
    """Return the solved tiles beside these tiles that belong to another partition."""
    now = _partition_of(paths[0])
    solved = sorted(path for path in paths[0].parent.glob("tile_*.solved.npz"))
    return [path for path in solved if _partition_of(path) not in (None, now)]


def read_block_tile(path: str | os.PathLike[str]) -> TileFile:
    """Return a tile of a block, solved or not, with its place.

    Raises `JaxbaError` as `read_tile` does, and for a tile of no partition, or whose place contradicts its arrays.
    """
    label = os.fspath(path)
    held = tile_of_bytes(read_bytes(path), label)
    return _placed(Path(path), held.problem, held.extras)


def read_tiles(paths: Sequence[str | os.PathLike[str]], block: Problem | None = None) -> list[TileFile]:
    """Return all tiles of a partition in their order.

    - `block`: the problem that was cut, if it is known; tiles of another one are refused.

    Raises `JaxbaError` as `read_block_tile` does, and where a tile is missing or given twice, or is of another block
    or of another partition of it.
    """
    if not paths:
        raise JaxbaError("no tiles are given; name the files that jaxba partition wrote.")
    found = sorted((read_block_tile(path) for path in paths), key=lambda tile: tile.number)
    first = found[0]
    if block is not None and first.block != fingerprint_of(block):
        raise JaxbaError(
            f"{first.path}: is a tile of another block than the one given; give the block that it was cut from, or "
            f"{_AGAIN}."
        )
    for before, tile in itertools.pairwise(found):
        for what, same in (("block", first.block == tile.block), ("partition", first.partition == tile.partition)):
            if not same:
                raise JaxbaError(
                    f"{tile.path}: is of another {what} than {first.path}; give the tiles of one, or {_AGAIN}."
                )
        if before.number == tile.number:
            raise JaxbaError(
                f"{tile.path}: is tile {tile.number}, as {before.path} is; give one of them, such as all "
                "tile_*.solved.npz."
            )
    missing = sorted(set(range(first.count)) - {tile.number for tile in found})
    if missing:
        more = f" (and {len(missing) - 1} more)" if len(missing) > 1 else ""
        raise JaxbaError(
            f"{first.path.parent}: tile {missing[0]} of 0 to {first.count - 1} is missing{more}; give all tiles of the "
            f"partition, or {_AGAIN}."
        )
    return found


def place_of(extras: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return those of a tile's extras that tell its place in a block; none of a problem that is no tile of one."""
    return {name: value for name, value in extras.items() if name.startswith(_PLACE)}


def fingerprint_of(problem: Problem) -> str:
    """Return 32 hexadecimal digits of all arrays of a problem.

    Raises `JaxbaError` where a tile cannot hold the problem.
    """
    return _hashed(arrays_of(problem, "block").items())


def _hashed(arrays: Iterable[tuple[str, np.ndarray]]) -> str:
    state = hashlib.sha256()
    for name, array in arrays:
        array = np.ascontiguousarray(array)
        state.update(f"{name} {array.dtype.str} {array.shape} ".encode())
        state.update(array.reshape(-1).view(np.uint8).data)
    return state.hexdigest()[:32]


def _places(partition: Partition, label: str) -> list[dict[str, np.ndarray]]:
    """Return the extras of each tile."""
    block, tiles = partition.block, partition.tiles
    fingerprint = _hashed(arrays_of(block, label).items())
    camera_index = np.asarray(block.camera_index)
    cut = [(what, getattr(tile, what)) for tile in tiles for what in ("images", "own")]
    common = {
        "count": np.array(len(tiles)),
        "block": np.array(fingerprint),
        "partition": np.array(_hashed([("block", np.array(fingerprint)), *cut])),
        "block_images": np.array(block.num_images),
        "block_cameras": np.array(block.num_cameras),
        "block_points": np.array(block.num_points),
    }
    places = []
    for number, tile in enumerate(tiles):
        own = {
            "number": np.array(number),
            "images": tile.images,
            "cameras": np.unique(camera_index[tile.images]),
            "points": tile.points,
            "own": tile.own,
        }
        places.append({_PLACE + name: value for name, value in (own | common).items()})
    return places


def _placed(path: Path, problem: Problem, extras: Mapping[str, np.ndarray]) -> TileFile:
    """Return the tile with its place, checked."""
    sizes = {"images": problem.num_images, "cameras": problem.num_cameras, "points": problem.num_points}
    names = (*_NUMBERS, "block", "partition", *sizes, "own")
    missing = [f"{EXTRA}{_PLACE}{name}" for name in names if _PLACE + name not in extras]
    if missing:
        raise JaxbaError(
            f"{path}: is no tile of a partition, since it lacks {', '.join(missing)}; give what jaxba partition wrote, "
            "or what jaxba solve made of that."
        )
    place = {name: extras[_PLACE + name] for name in names}

    def refuse(name: str, what: str) -> JaxbaError:
        return JaxbaError(f"{path}: {EXTRA}{_PLACE}{name} {what}; {_AGAIN}, or write the tile with all its images.")

    kinds = {**dict.fromkeys((*_NUMBERS, *sizes), "iu"), "block": "U", "partition": "U", "own": "b"}
    lengths = {**dict.fromkeys(names, ()), **{name: (size,) for name, size in sizes.items()}}
    lengths["own"] = lengths["images"]
    for name, value in place.items():
        if value.dtype.kind not in kinds[name]:
            raise refuse(name, f"has the type {value.dtype}")
        if value.shape != lengths[name]:
            raise refuse(name, f"has the shape {value.shape}, but the tile's arrays say {lengths[name]}")
    number, count, *of_block = (int(place[name]) for name in _NUMBERS)
    if not 0 <= number < count:
        raise refuse("number", f"is {number}, but tiles go from 0 to {count - 1}")
    for name, most in zip(sizes, of_block, strict=True):
        value = place[name].astype(np.int64)
        if len(value) and (value[0] < 0 or value[-1] >= most or np.any(np.diff(value) <= 0)):
            raise refuse(name, f"must hold numbers from 0 to {most - 1}, ascending")
    images, points = place["images"].astype(np.int64), place["points"].astype(np.int64)
    return TileFile(
        path=path,
        tile=BlockTile(problem, images, points, place["own"]),
        number=number,
        count=count,
        block=str(place["block"]),
        partition=str(place["partition"]),
        cameras=place["cameras"].astype(np.int64),
        num_images=of_block[0],
        num_cameras=of_block[1],
        num_points=of_block[2],
    )


def _partition_of(path: Path) -> str | None:
    """Return the fingerprint of the partition that a file is a tile of; None where it is no such tile."""
    with contextlib.suppress(OSError, ValueError, KeyError, zipfile.BadZipFile), np.load(path) as arrays:
        return str(arrays[f"{EXTRA}{_PLACE}partition"])
    return None
