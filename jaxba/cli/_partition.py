"""`jaxba partition`: read a block, cut it into tiles, write them and a picture, tell."""

from pathlib import Path
from typing import Any, Literal

import numpy as np

from jaxba._atomic import write_atomically
from jaxba._errors import JaxbaError
from jaxba.ba import Partition, partition
from jaxba.cli._settings import configured
from jaxba.cli._solve import default_output, tile_of
from jaxba.cli._text import first_of, many, table, to_json
from jaxba.engine._project import EXPORT, is_project
from jaxba.io import problem_of_bytes, read_bytes, solved_before, write_tiles
from jaxba.pipeline import PIPELINE, Tiles
from jaxba.report import draw_tiles, project_settings

_FOLDER, _PICTURE = "tiles", "tiles.png"
_MOST_ROWS = 40


def run(
    file: Path,
    *,
    max_observations: float | None,
    max_images: int | None,
    by: Literal["space", "flight-line"] | None,
    overlap: int | None,
    out: Path | None,
    as_json: bool,
    quiet: bool,
) -> int:
    """Cut the block in a file or a project; return the exit code. What is None comes from the settings."""
    if max_images is not None and max_observations is not None:
        raise JaxbaError(
            f"--max-images {max_images} and --max-observations {max_observations:g}: a tile has one size; give one."
        )
    settings = _settings(file, quiet=quiet or as_json)
    name = file.resolve().name
    file = tile_of(file)
    if max_images is None and max_observations is None:
        max_observations = settings.max_observations
        max_images = settings.chunk_size if max_observations is None else None
    out = default_output(file).parent / _FOLDER if out is None else out
    held = problem_of_bytes(read_bytes(file), str(file))
    found = partition(
        held.problem,
        max_observations=max_observations,
        max_images=max_images,
        by=by or settings.by,  # pyright: ignore[reportArgumentType]
        overlap=settings.overlap if overlap is None else overlap,
    )
    paths = write_tiles(out, found, loss=held.loss, source=file)
    told = {
        "input": str(file),
        "by": by or settings.by,
        "max_images": max_images,
        "max_observations": max_observations,
        **facts(found),
        "output": [str(path) for path in paths],
        "picture": str(out / _PICTURE),
        "of_other_partitions": [str(path) for path in solved_before(paths)],
    }
    with write_atomically(out / _PICTURE) as stream:
        stream.write(draw_tiles(found, f"{name}: {_title(told)}", _subtitle(told)))
    if as_json:
        print(to_json(told))
    elif not quiet:
        print(text(told))
    return 0


def facts(found: Partition) -> dict[str, Any]:
    """Return everything about a partition by name, for `--json`."""
    block = found.block
    return {
        "num_images": block.num_images,
        "num_cameras": block.num_cameras,
        "num_points": block.num_points,
        "num_observations": block.num_observations,
        "num_tiles": len(found.tiles),
        "num_separators": int(np.count_nonzero(found.is_separator)),
        "num_points_cut": int(np.count_nonzero(found.is_cut)),
        "num_points_left_out": int(np.count_nonzero(found.is_left_out)),
        "tiles": [
            {
                "num_images": tile.problem.num_images,
                "num_own": int(np.count_nonzero(tile.own)),
                "num_cameras": tile.problem.num_cameras,
                "num_points": tile.problem.num_points,
                "num_observations": tile.problem.num_observations,
            }
            for tile in found.tiles
        ],
    }


def text(told: dict[str, Any]) -> str:
    """Return the facts in words."""
    tiles = told["tiles"]
    sizes = (
        many(told["num_images"], "image"),
        many(told["num_cameras"], "camera"),
        many(told["num_points"], "point"),
        many(told["num_observations"], "observation"),
    )

    def spread(name: str) -> str:
        values = [tile[name] for tile in tiles]
        if min(values) == max(values):
            return f"{values[0]} a tile"
        return f"{min(values)} to {max(values)} a tile, median {np.median(values):.0f}"

    titles = f"{'tile':>4}{'images':>9}{'own':>7}{'points':>10}{'observations':>14}"
    rows = [
        f"{number:>4}{tile['num_images']:>9}{tile['num_own']:>7}{tile['num_points']:>10}{tile['num_observations']:>14}"
        for number, tile in enumerate(tiles[:_MOST_ROWS])
    ]
    more = [f" ... {len(tiles) - _MOST_ROWS} more"] if len(tiles) > _MOST_ROWS else []
    left_out = told["num_points_left_out"]
    first, last = (Path(told["output"][place]) for place in (0, -1))
    other = told["of_other_partitions"]
    several = len(tiles) > 1
    overlap = f"{told['num_separators']} of {many(told['num_images'], 'image')} are in more than one tile"
    cut = f"{told['num_points_cut']} of {many(told['num_points'], 'point')} are seen by own images of several tiles"
    summary = table(
        (
            ("block", f"{told['input']}: {', '.join(sizes)}"),
            ("tiles", _tiles_text(told)),
            ("images", f"{spread('num_images')}, with those that overlap" if several else []),
            ("points", spread("num_points") if several else []),
            ("observed", spread("num_observations") if several else []),
            ("separators", overlap if several else []),
            ("cut", cut if several else []),
            ("left out", f"{many(left_out, 'point')}: no tile sees them twice" if left_out else []),
            ("written", f"{first}{f' to {last.name}' if several else ''}, and {told['picture']}"),
            ("to delete", f"solved tiles of another partition: {first_of(other)}" if other else []),
        )
    )
    return "\n".join([summary, "", titles, *rows, *more] if several else [summary])


def _settings(file: Path, *, quiet: bool) -> Tiles:
    """Return the section on tiles: of the project that this is or lies in, else of `jaxba.toml` here, or defaults."""
    project = file if file.is_dir() else file.absolute().parent.parent
    of_project = is_project(project) and (file.is_dir() or file.absolute().parent.name == EXPORT)
    settings = project_settings(project, PIPELINE) if of_project else configured(None, quiet=quiet)
    tiles = settings["tiles"]
    assert isinstance(tiles, Tiles)
    return tiles


def _size(told: dict[str, Any]) -> str:
    if told["max_images"] is not None:
        return f"at most {told['max_images']} images of their own"
    return f"at most {told['max_observations']:g} observations of their own images"


def _tiles_text(told: dict[str, Any]) -> str:
    if told["num_tiles"] == 1:
        return f"1: the block fits in one tile, with {_size(told)}; give a smaller size to cut it"
    return f"{told['num_tiles']} by {told['by']}, with {_size(told)}"


def _title(told: dict[str, Any]) -> str:
    return f"{many(told['num_tiles'], 'tile')} by {told['by']}"


def _subtitle(told: dict[str, Any]) -> str:
    return (
        f"{many(told['num_images'], 'image')}, {told['num_separators']} in more than one tile; tiles of {_size(told)}"
    )
