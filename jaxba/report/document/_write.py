"""Write a report beside the project: the page, its numbers, tables as CSV and figures as PNG.

project/
  report.html       the page: one file, which needs no network
  report.json       every number of it
  report/           its tables as CSV and its figures as PNG
"""

import json
from pathlib import Path
from typing import Any

from jaxba._atomic import write_atomically, write_folder_atomically
from jaxba.engine._stage import Pipeline
from jaxba.report.document._csv_tables import tables
from jaxba.report.document._facts import report_facts
from jaxba.report.document._pngs import pngs
from jaxba.report.page import page

REPORT = "report"


def write_report(folder: Path, pipeline: Pipeline) -> tuple[Path, dict[str, Any]]:
    """Write the report of a project, also of one whose run has not ended; return the page's path and the facts.

    Raises `JaxbaError` where the folder is no project, or a file cannot be written.
    """
    facts = report_facts(folder, pipeline)
    return write_facts(folder, facts), facts


def write_facts(folder: Path, facts: dict[str, Any]) -> Path:
    """Write the report of facts into a folder that is there; return the page's path.

    Raises `JaxbaError` where a file cannot be written.
    """
    with write_folder_atomically(folder / REPORT) as partial:
        for name, content in (*tables(facts).items(), *pngs(facts).items()):
            (partial / name).write_bytes(content)
    html = folder / f"{REPORT}.html"
    for path, text in ((folder / f"{REPORT}.json", f"{_json(facts)}\n"), (html, page(facts))):
        with write_atomically(path) as file:
            file.write(text.encode())
    return html


def _json(value: Any, indent: str = "") -> str:
    """Return JSON with a line a field, and lists of plain values, which are most of a report, on one line each.

    >>> print(_json({"schema": 1, "cloud": {"x": [1.5, None]}}))
    {
     "schema": 1,
     "cloud": {
      "x": [1.5, null]
     }
    }
    """
    inner = f"{indent} "
    if isinstance(value, dict) and value:
        fields = (f"{inner}{json.dumps(name)}: {_json(entry, inner)}" for name, entry in value.items())
        return "{\n" + ",\n".join(fields) + f"\n{indent}}}"
    if isinstance(value, list) and any(isinstance(entry, dict) for entry in value):
        return "[\n" + ",\n".join(f"{inner}{_json(entry, inner)}" for entry in value) + f"\n{indent}]"
    return json.dumps(value)
