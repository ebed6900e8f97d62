"""The page of a report: one HTML file that asks for nothing from elsewhere, made of the facts of `report.json`.

Style, scripts and Plotly stand inside it, so that it can be sent, kept and printed. The same facts give the same bytes.
Every text of the facts is escaped: names of photos and points come from files that others made.
"""

import re
from importlib import resources
from typing import Any

import jinja2

from jaxba.report.page._drawing import Figure
from jaxba.report.page._sections import Section, sections
from jaxba.report.page._tables import UNKNOWN, Table

OPENING = {"verdict": "Verdict", "summary": "Key figures", "findings": "Findings"}
GLOSSARY = {"glossary": "How every figure was computed"}


def page(report: dict[str, Any]) -> str:
    """Return the HTML of the page.

    - `report`: the facts, as `report.json` has them. Numbers that are not known are None.
    """
    found = sections(report)
    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(_file), autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True,
        lstrip_blocks=True, keep_trailing_newline=True,
    )  # fmt: skip
    environment.filters |= {"moment": _moment, "or_unknown": lambda text: text or UNKNOWN}
    environment.tests |= {
        "figure": lambda block: isinstance(block, Figure), "table": lambda block: isinstance(block, Table),
    }  # fmt: skip
    return environment.get_template("page.html.j2").render(
        report=report, sections=found, opening=OPENING, glossary=GLOSSARY, contents=_contents(found),
        css=_file("page.css"), script=_file("page.js"), 
        footer=_css_text(f"{report['project']['name']}: bundle adjustment report"),
        plotly=resources.files("plotly").joinpath("package_data", "plotly.min.js").read_text("utf-8"),
    )  # fmt: skip


def _contents(found: list[Section]) -> list[tuple[str, str]]:
    """Return address and title of every section."""
    return [*OPENING.items(), *((section.name, section.title) for section in found), *GLOSSARY.items()]


def _file(name: str) -> str:
    return resources.files("jaxba.report.page").joinpath(name).read_text("utf-8")


def _moment(text: str | None) -> str:
    """Return a time of a photo as date and time of day."""
    return UNKNOWN if text is None else text[:16].replace("T", " ")


def _css_text(text: str) -> str:
    """Return a text as it can stand between quotes in a style sheet: letters and spaces, all else by its number."""
    return re.sub(r"[^A-Za-z ]", lambda found: f"\\{ord(found.group()):06x} ", text)  # the space belongs to the number
