"""`jaxba plan`: what it prints, of a plan and of a project, and what refuses it."""

import json
from pathlib import Path

import numpy as np
import pytest
from commands import Cli
from small_survey import Survey

from jaxba.design import sections
from jaxba.engine import explained
from jaxba.pipeline import PIPELINE
from jaxba.report import recorded

PLAN = """
[area]
polygon = [[500000, 4970000], [500080, 4970000], [500080, 4970060], [500000, 4970060]]
crs = "EPSG:32615"
[camera]
width_px = 2000
height_px = 1500
focal_px = 1600
[flight]
height_m = 60
forward_overlap = 0.65
side_overlap = 0.55
[gnss]
kind = "rtk"
[ties]
points_per_image = 60
"""


@pytest.fixture
def plan(tmp_path: Path) -> Path:
    path = tmp_path / "flight.toml"
    path.write_text(PLAN)
    return path


def test_a_plan_is_told_in_figures_and_in_words(plan: Path, cli: Cli):
    code, out, err = cli("plan", str(plan), "--improve", "control", "--points", "3", "--json")
    assert (code, err) == (0, "")
    told = json.loads(out)
    assert told["area_m2"] == pytest.approx(80 * 60 / 0.9996**2, rel=1e-4)  # the grid is smaller than the ground
    assert told["gsd_m"] == pytest.approx(60 / 1600)
    own, oblique, _, control = told["gains"]
    assert own["worst_std_m"] == pytest.approx(max(told["ground"]["worst_std_m"]))
    assert oblique["dome_std_m"] < own["dome_std_m"] and oblique["photos"] == told["photos"] + 8
    assert control["worst_std_m"] < told["improve"]["worst_std_m"] < own["worst_std_m"]
    for point in told["improve"]["points"]:
        assert 500000 - 0.1 <= point["x"] <= 500080.1 and 4970000 - 0.1 <= point["y"] <= 4970060.1
        assert point["without_m"] >= told["improve"]["worst_std_m"]
    code, out, _ = cli("plan", str(plan))
    assert code == 0 and f"{told['photos']} photos on {told['lines']} lines" in out
    assert f"sigma {told['focal_std_px']:.2f} px" in out
    assert "what more would gain" in out and "more control points, where they help most:" not in out


@pytest.fixture(autouse=True)
def _own_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("jaxba.cli._plan.use_compilation_cache", lambda: None)  # the tests' own stays


def test_a_project_is_told_from_its_own_adjustment(made: Survey, cli: Cli):
    """Cameras are known as its adjustment says, whose sigmas the exported tile has."""
    code, out, _ = cli("plan", str(made.project), "--json")
    assert code == 0
    told = json.loads(out)
    adjusted = recorded(made.project, PIPELINE).done.adjust
    assert told["photos"] == adjusted.block.num_images
    expected = np.median(adjusted.position_std_m, axis=0)
    np.testing.assert_allclose(told["cameras"]["median_std_m"], expected, rtol=0.05)


def test_an_example_is_a_plan(tmp_path: Path, cli: Cli):
    code, out, _ = cli("plan", "--example")
    assert code == 0
    path = tmp_path / "flight.toml"
    path.write_text(out.replace("height_m = 100.0", "height_m = 15.0"))
    code, _, err = cli("plan", str(path))
    assert code == 2 and "fly higher (flight.height_m)" in err


def test_what_is_no_plan_is_refused(tmp_path: Path, cli: Cli):
    assert cli("plan")[0] == 2
    code, _, err = cli("plan", str(tmp_path))
    assert code == 2 and f"{tmp_path}: is a folder, and no project" in err
    code, _, err = cli("plan", str(tmp_path), "--improve", "control", "--points", "50")
    assert code == 2 and "--points 50: give from 1 to 40" in err
    code, out, _ = cli("plan", str(tmp_path / "none.toml"), "--json")
    assert code == 2 and json.loads(out)["exit_code"] == 2


def test_the_readme_has_the_plans_parameters():
    import jaxba.design

    text = (Path(str(jaxba.design.__file__)).parent / "README.md").read_text(encoding="utf-8")
    for name, default, allowed, meaning in explained(sections()):
        assert f"| `{name}` | {default} | {allowed} | {meaning} |" in text
