"""Lets the tests here, and the workers that they start, import the modules beside them by name; shares one survey."""

import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parent))
from small_survey import Survey, make_photos, make_project, once, shared_folder


@pytest.fixture(scope="session")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Photos of a small simulated survey; not to be changed."""
    return once(shared_folder(tmp_path_factory), "survey", make_photos) / "photos"


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory, photos: Path) -> Survey:
    """One whole run on them; not to be changed."""
    return Survey(photos, once(shared_folder(tmp_path_factory), "run", make_project(photos)) / "project")
