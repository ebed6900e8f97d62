"""What a pipeline is to the engine: a table of stages, what feeds each, and the settings of each.

A stage is a module with frozen `Inputs`, `Params`, `Outputs`, `run(inputs, params)`, and `lines` and `facts`, which say
in words and in plain values what it made. What the stages of a run have made so far stands in an object with a field a
stage, `done`; here nothing is known of either but their names.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from jaxba.engine._parameters import Parameters
from jaxba.engine._workers import Resources
from jaxba.scene import LeftOut


@dataclass(frozen=True)
class Item:
    """The inputs of one photo, what of them counts, by name, the photo's size, and how many others go with it."""

    name: str
    inputs: Any
    identity: dict[str, Any]
    megapixels: float
    partners: int = 0


@dataclass(frozen=True)
class Stage:
    """A stage and how it is fed.

    - `inputs`: from what is done. `collect`: for a stage that runs once a photo, from its items' folders.
    - `left_out`: of what is done, the files that the stage could not use.
    - `useless`: photos of which a stage that runs once a photo made something that nothing can be done with.
    - `refuse`: raises `JaxbaError` where items that are to be worked on would not fit, before the first of them is:
      takes the stage's folder, the items, the stage's parameters and the workers' resources.
    - `writes_files`: what it makes are files for others, in the project's folder of exports.
    - `reads_places`: where its inputs lie counts, not their contents alone.
    - `reads_given`: its inputs are photos and lists that may have moved since.
    - `takes_room`: its `run` is given a `Room`.
    """

    module: ModuleType
    inputs: Callable[[Any], Any]
    collect: Callable[[Any, dict[int, Path], dict[int, str]], Any] | None = None
    left_out: Callable[[Any], tuple[LeftOut, ...]] = lambda done: ()
    useless: Callable[[Any, Any], tuple[LeftOut, ...]] = lambda done, outputs: ()
    refuse: Callable[[Path, Sequence[Any], Any, Resources], None] = lambda folder, items, params, resources: None
    writes_files: bool = False
    reads_places: bool = False
    reads_given: bool = False
    takes_room: bool = False

    @property
    def name(self) -> str:
        return self.module.__name__.rpartition(".")[2]

    @property
    def is_by_photo(self) -> bool:
        """Whether it runs once a photo."""
        return self.collect is not None


@dataclass(frozen=True)
class Pipeline:
    """The stages in their order.

    - `settings`: the defaults of every section: of the stages, and of what supervises and checks them.
    - `begin`: what is done before the first stage, from the files, the settings and the lists by name.
    """

    stages: tuple[Stage, ...]
    settings: Mapping[str, Parameters]
    begin: Callable[..., Any]

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(stage.name for stage in self.stages)

    def __getitem__(self, name: str) -> Stage:
        return next(stage for stage in self.stages if stage.name == name)


def left_out(stages: Sequence[Stage], done: Any) -> dict[str, tuple[LeftOut, ...]]:
    """Return the files that are not in the result, and photos that could not be matched, by stage.

    Each is named once, with the first stage that could not use it.
    """
    result: dict[str, tuple[LeftOut, ...]] = {}
    named: set[str] = set()
    for stage in stages:
        entries = () if getattr(done, stage.name) is None else stage.left_out(done)
        result[stage.name] = tuple(entry for entry in entries if entry.name not in named)
        named.update(entry.name for entry in entries)
    return result
