"""The findings of the adjustment are one list, which the run, status, diagnose and verify tell alike."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from small_survey import FAST, Survey

from jaxba.cli import main
from jaxba.engine._store import load, read_record, save
from jaxba.pipeline import adjust
from jaxba.report import sentences
from jaxba.scene import Finding

FOCAL = Finding.of("focal moved", camera="DJI", parameter="fx", value=1165.0, before=929.0)
OFFSET = Finding.of("common offset", median_m=0.02, axes=["east"], receiver_std_m=[3.0])
EDGES = Finding.of(
    "edges left out", names=[f"a{i}, b{i}" for i in range(13)], matches=[45] * 13, median_px=[5.0] * 13, limit_px=3.0
)
FLAGS = [part for change in FAST for part in ("--set", change)]


def with_findings(made: Survey, to: Path, *findings: Finding) -> Survey:
    """Return a copy of the project whose adjustment recorded these findings, as the export of it is made anew."""
    survey = made.copy(to)
    folder = survey.project / "stages" / "adjust"
    record = read_record(folder)
    assert record is not None
    save(folder, replace(load(folder, adjust.Outputs), findings=findings), record.key)
    return survey


def answer(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str]:
    with pytest.raises(SystemExit) as stop:
        main([str(argument) for argument in arguments])
    return int(stop.value.code or 0), capsys.readouterr().out


def rows(text: str, label: str = "findings") -> str:
    """Return what stands below a label, as one line."""
    lines = text.splitlines()
    first = next(k for k, line in enumerate(lines) if line.startswith(label))
    width = len(lines[first]) - len(lines[first][len(label) :].lstrip())
    last = next((k for k in range(first + 1, len(lines)) if lines[k][:width].strip()), len(lines))
    return " ".join(" ".join(lines[first:last]).split()).removeprefix(f"{label} ")


@pytest.mark.parametrize(
    ("findings", "code", "last"),
    [
        ((FOCAL,), 1, ""),
        ((EDGES, FOCAL, OFFSET), 1, ""),
        ((OFFSET,), 0, "nothing is to be acted on"),
        ((EDGES, OFFSET), 0, "nothing is to be acted on"),
    ],
)
def test_all_commands_tell_the_same_findings(
    made: Survey,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    findings: tuple[Finding, ...],
    code: int,
    last: str,
):
    survey = with_findings(made, tmp_path, *findings)
    said = sentences(findings)
    wanted = " ".join(" ".join(said).split())
    ended, text = answer(capsys, "run", survey.photos, "--out", survey.project, *FLAGS)
    assert ended == 0 and wanted in " ".join(text.split())
    assert json.loads((survey.project / "summary.json").read_text())["adjust"]["findings"] == said
    for command, good in (("status", 0), ("verify", 0), ("diagnose", code)):
        ended, text = answer(capsys, command, survey.project)
        assert ended == good and rows(text).startswith(wanted)
        assert "nothing looks poor" not in text
        ended, text = answer(capsys, command, survey.project, "--json")
        assert ended == good and json.loads(text)["findings"] == said
    ended_with = answer(capsys, "diagnose", survey.project)[1].splitlines()[-1]
    assert ended_with == last if last else not ended_with.startswith("nothing")


def test_a_run_without_findings_lists_none(made: Survey, capsys: pytest.CaptureFixture[str]):
    for command in ("status", "verify", "diagnose"):
        code, text = answer(capsys, command, made.project)
        assert code == 0 and "findings" not in text
        assert json.loads(answer(capsys, command, made.project, "--json")[1])["findings"] == []
