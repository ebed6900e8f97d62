"""A small simulated survey and one run of the pipeline on it, shared by tests in all processes of a session."""

import fcntl
import io
import os
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from jaxba.engine import changed
from jaxba.pipeline import PIPELINE, Event, Run, run_pipeline
from jaxba.simulation.photos import Params, write_survey

FAST = ("features.nfeatures=2000",)
NUM_PHOTOS = 8


@dataclass(frozen=True)
class Survey:
    """Folders of a run: the photos, and the project made of them. Tests work on copies."""

    photos: Path
    project: Path

    def copy(self, to: Path, *, photos: bool = False) -> "Survey":
        """Return a copy of the project, and of the photos where a test changes them."""
        shutil.copytree(self.project, to / "project")
        if photos:
            shutil.copytree(self.photos, to / "photos")
        return Survey(to / "photos" if photos else self.photos, to / "project")

    def run(
        self,
        *changes: str,
        until: str | None = None,
        geotags: Path | None = None,
        gcp: Path | None = None,
        check: Path | None = None,
        bars: Path | None = None,
        workers: int = 1,
        tell: Callable[[Event], None] = lambda event: None,
    ) -> Run:
        """Run as far as told; one worker does, since the session's processes keep the cores busy among them."""
        settings = changed(PIPELINE.settings, [*FAST, f"workers.workers={workers}", *changes])
        return run_pipeline(
            self.photos,
            self.project,
            settings,
            until=until,
            geotags=geotags,
            gcp=gcp,
            check=check,
            bars=bars,
            tell=tell,
        )


def shared_folder(factory: pytest.TempPathFactory) -> Path:
    """Return a folder that all processes of the session see."""
    base = factory.getbasetemp()
    return base.parent if "PYTEST_XDIST_WORKER" in os.environ else base


def once(folder: Path, name: str, make: Callable[[Path], None]) -> Path:
    """Return a folder that one process of the session makes, and the others wait for."""
    place = folder / name
    with open(folder / f"{name}.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (place / "done").exists():
            make(place)
            (place / "done").touch()
    return place


def repaint(path: Path, paint: Callable[[np.ndarray], np.ndarray]) -> None:
    """Change the pixels of a JPEG, keeping the segments of its tags as they are."""
    content = path.read_bytes()
    with Image.open(io.BytesIO(content)) as image:
        pixels = paint(np.array(image))
    changed = io.BytesIO()
    Image.fromarray(pixels).save(changed, "JPEG", quality=95)
    tables = b"\xff\xdb"
    path.write_bytes(content[: content.index(tables)] + changed.getvalue()[changed.getvalue().index(tables) :])


def make_photos(place: Path) -> None:
    write_survey(place, Params(num_images=NUM_PHOTOS, num_oblique=2, width_px=640))


def make_project(photos: Path) -> Callable[[Path], None]:
    def make(place: Path) -> None:
        begun = time.perf_counter()
        Survey(photos, place / "project").run()
        (place / "seconds").write_text(f"{time.perf_counter() - begun:.1f}")

    return make
