"""`jaxba report` and `jaxba run --report`: where the report lies, what is said of it, and what refuses it."""

import json
import webbrowser
from pathlib import Path

import pytest
from commands import Cli
from small_survey import FAST, Survey

from jaxba.report.document import _write


def test_the_report_lies_in_the_project_and_holds_its_own_numbers(made: Survey, tmp_path: Path, cli: Cli):
    project = made.copy(tmp_path).project
    code, out, err = cli("report", str(project))
    assert (code, err) == (0, "")
    assert out.splitlines()[-1] == f"report  {project / 'report.html'}"
    assert "Photos adjusted: 8 of 8" in out
    facts = json.loads((project / "report.json").read_text())
    assert facts["project"]["state"] == "complete"
    names = {path.name for path in (project / "report").iterdir()}
    assert {"photos.csv", "pairs.csv", "map.png", "residuals.png"} <= names
    before = {path: path.read_bytes() for path in (project / "report.html", project / "report.json")}
    code, out, _ = cli("report", str(project), "--json")
    assert code == 0 and json.loads(out) == facts
    assert {path: path.read_bytes() for path in before} == before


def test_the_page_is_opened_where_that_is_asked_for(
    made: Survey, tmp_path: Path, cli: Cli, monkeypatch: pytest.MonkeyPatch
):
    shown: list[str] = []
    monkeypatch.setattr(webbrowser, "open", lambda url: shown.append(url) or True)
    project = made.copy(tmp_path).project
    assert cli("report", str(project), "--open")[0] == 0
    assert shown == [(project / "report.html").as_uri()]


def test_a_run_writes_it_at_the_end_and_says_where(
    made: Survey, tmp_path: Path, cli: Cli, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("jaxba.cli._run.use_compilation_cache", lambda: None)
    project = made.copy(tmp_path).project
    options = [part for change in (*FAST, "workers.workers=1") for part in ("--set", change)]
    code, out, _ = cli("run", str(made.photos), "--out", str(project), "--report", *options)
    assert code == 0 and f"report      {project / 'report.html'}" in out.splitlines()
    assert (project / "report.html").exists()


def test_what_is_no_project_and_a_full_disk_are_told(
    made: Survey, tmp_path: Path, cli: Cli, monkeypatch: pytest.MonkeyPatch
):
    code, _, err = cli("report", str(tmp_path))
    assert code == 2 and "is no project" in err
    project = made.copy(tmp_path).project
    (project / "report.html").write_text("the last one")

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(_write, "tables", full)
    code, _, err = cli("report", str(project))
    assert code == 2 and "No space left" in err and len(err.splitlines()) == 1
    assert (project / "report.html").read_text() == "the last one" and not (project / "report").exists()
