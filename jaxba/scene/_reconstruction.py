"""Another program's result: its block in jaxba's conventions, and what its files say of it."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from jaxba.scene._block import Block


@dataclass(frozen=True, kw_only=True)
class Claim:
    """What a file says of its own model.

    - `name`: of the figure: `images`, `points`, `mean track length`, ... `stated`: its value. `place`: file and line.
    """

    name: str
    stated: float
    place: str


@dataclass(frozen=True, kw_only=True, eq=False)
class Reconstruction:
    """Another program's result.

    - `block`: all its images have a pose; `image_index` counts them from 0. Pixels, cameras and poses are as everywhere
      in jaxba; the world is the program's own.
    - `names`, `size_px`: of each image. `point_ids`: the name of each point in the files.
    - `program`: that wrote it, or whose form it has. `files`: that it was read from.
    - `claims`: what the files say of the whole. `point_error`: the error of each point as they state it, NaN where they
      do not, in the unit of `unit_px`.
    - `unit`, `unit_px`: what the program counts errors in, and how many pixels that is in each image.
    - `notes`: what was found and decided in reading, in sentences.
    """

    block: Block
    names: tuple[str, ...]
    size_px: Int[np.ndarray, "images 2"]
    point_ids: tuple[str, ...]
    program: str
    files: tuple[Path, ...]
    point_error: Float[np.ndarray, " points"]
    claims: tuple[Claim, ...] = ()
    unit: str = "px"
    unit_px: Float[np.ndarray, " images"]
    notes: tuple[str, ...] = ()
