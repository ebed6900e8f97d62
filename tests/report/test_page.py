"""The page of a report: what it says, what it escapes, and that a browser draws it without asking for anything."""

import base64
import copy
import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from report_sample import UNKNOWN, sample

from jaxba.report.document._glossary import GLOSSARY
from jaxba.report.page import page
from jaxba.report.page._tables import UNKNOWN as UNKNOWN_NUMBER

SECTIONS = {
    "Verdict", "Key figures", "Findings", "The block from above", "Cameras and their accuracy", "Overlap",
    "Matches between photos", "The block in three dimensions", "Reprojection errors", "Camera calibration",
    "GNSS positions", "Attitudes", "Control and check points", "Scale bars", "Variance components",
    "Accuracy by check points", "Photos", "What was left out", "Processing", "How every figure was computed",
}  # fmt: skip
MAY_BE_EMPTY = {
    "sigmas": (), "pairs": ("matches",), "cloud": ("preview", "space"),
    "overlap": ("overlap",), "residuals": ("residuals",), "positions": ("positions",),
    "attitudes": ("attitudes",), "control": ("control",), "bars": ("bars",), "statistics": ("statistics",),
    "accuracy": ("accuracy",),
}  # fmt: skip
HOSTILE = ("<script>alert(1)</script>.jpg", '"x".jpg', "</script><b>y</b>.jpg", "{{ 7 * 7 }}.jpg", "%{x}&amp;'.jpg")


class Seen(HTMLParser):
    """What a browser would see: headings, names of elements, the text of each section, addresses, and figures."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.classes: list[str] = []
        self.headings: list[str] = []
        self.sections: dict[str, str] = {}
        self.links: list[str] = []
        self.figures: list[Any] = []
        self._within: list[str] = []
        self._section = ""
        self._is_figure = False
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        self.tags.append(tag)
        self.classes += (found.get("class") or "").split()
        self._within = [tag]
        self.links += [found[name] or "" for name in ("href", "src") if name in found]
        self._is_figure = found.get("type") == "application/json"
        if tag == "section":
            self._section = found["id"] or ""
            self.sections[self._section] = ""
        if tag == "h2":
            self.headings.append("")

    def handle_data(self, data: str) -> None:
        if self._is_figure:
            self.figures.append(json.loads(data, parse_constant=lambda name: pytest.fail(f"{name} in a figure")))
            self._is_figure = False
        elif self._within != ["script"] and self._section:
            self.sections[self._section] += data
        if self._within == ["h2"]:
            self.headings[-1] += data.strip()


def unpacked(part: dict[str, str]) -> np.ndarray:
    """Return numbers that the page has packed."""
    return np.frombuffer(base64.b64decode(part["bdata"]), np.dtype(part["dtype"]).newbyteorder("<"))


@pytest.fixture(scope="module")
def full() -> str:
    return page(sample())


def test_the_same_facts_give_the_same_bytes(full: str) -> None:
    assert page(sample()) == full


def test_facts_are_left_as_they_are() -> None:
    facts = sample(8, 50)
    before = copy.deepcopy(facts)
    page(facts)
    assert facts == before


def test_every_section_has_its_title_and_content(full: str) -> None:
    seen = Seen(full)
    assert set(seen.headings) == SECTIONS and len(seen.headings) == len(SECTIONS)
    assert len(seen.figures) == 13
    for text in ("Harbour quarry, north face", "EPSG:32615+5773", "stopped by Ctrl-C", "2024-05-02 10:31"):
        assert text in full
    assert "GCP4 is off by 3.4 sigmas" in seen.sections["findings"]
    assert "21 of 24" in seen.sections["summary"]
    assert "4,612,800.299" in seen.sections["photos"]
    assert "unchecked" in seen.sections["control"] and "3.4" in seen.sections["control"]
    assert "0.000087" in seen.sections["cameras"] and "held fixed" in seen.sections["cameras"]
    assert not {"nan", "NaN", "None"} & set(re.findall(r"\w+", " ".join(seen.sections.values())))


@pytest.mark.parametrize("part", MAY_BE_EMPTY)
def test_a_section_without_data_says_why(part: str) -> None:
    seen = Seen(page(sample(8, 50) | {part: UNKNOWN}))
    for name in MAY_BE_EMPTY[part]:
        assert UNKNOWN["none"] in seen.sections[name]
    assert set(seen.headings) == SECTIONS


def test_a_run_that_has_just_begun_has_a_page() -> None:
    facts = sample(1, 1) | dict.fromkeys([*MAY_BE_EMPTY, "correlation"], UNKNOWN)
    facts |= {name: [] for name in ("quality", "findings", "summary", "photos", "cameras", "left_out", "glossary")}
    facts["project"] |= dict.fromkeys(
        ("crs", "crs_name", "unit", "height_unit", "heights", "first_photo", "last_photo")
    )
    seen = Seen(page(facts))
    assert set(seen.headings) == SECTIONS and seen.figures == []
    assert "There are no photos." in seen.sections["photos"] and "No camera was adjusted." in seen.sections["cameras"]


def test_numbers_that_are_not_known_are_told_as_such() -> None:
    facts = sample(8, 50)
    facts["project"] |= dict.fromkeys(("crs", "crs_name", "unit", "height_unit", "heights"))
    for photo in facts["photos"]:
        photo |= {
            "std_m": [None] * 3,
            "ellipse_m": None,
            "residual_m": [None] * 3,
            "measured": None,
            "position": "none",
        }
    facts["cloud"]["std_z_m"] = [None] * 50
    facts["cloud"]["error_px"][::2] = [None] * 25
    facts["cameras"][0] |= {"width_px": None, "height_px": None}
    sensor = facts["residuals"]["sensors"][0]
    sensor["dx_px"][3][3] = sensor["radial"]["mean_px"][0] = None
    seen = Seen(page(facts))
    assert [mode["label"] for figure in seen.figures for mode in figure["modes"]] == [
        "Colours", "Height", "Reprojection error",
    ]  # fmt: skip
    assert "No sigmas of positions were computed" in seen.sections["positions-map"]
    assert UNKNOWN_NUMBER in seen.sections["photos"] and "without a place on earth" in page(facts)


@pytest.mark.parametrize("count", [1, 2])
def test_a_block_of_a_point_has_maps(count: int) -> None:
    facts = sample(count, count)
    for photo in facts["photos"]:
        photo |= {"x": 0.1, "y": 0.2, "z": 0.3, "residual_m": [0.0, 0.0, 0.0]}
    figures = Seen(page(facts)).figures
    layouts = [figure["layout"] for figure in figures if figure["ratio"]]
    for axis in ("xaxis", "yaxis"):
        assert all(abs(layout[axis]["range"][1] - layout[axis]["range"][0]) > 0.1 for layout in layouts)


def test_a_small_frame_of_its_own_is_drawn_as_finely() -> None:
    facts = sample(24, 50)
    facts["project"] |= dict.fromkeys(("crs", "crs_name", "unit", "height_unit", "heights"))
    for photo in facts["photos"]:
        photo |= {"x": photo["x"] and photo["x"] / 1e6, "y": photo["y"] and photo["y"] / 1e6, "measured": None}
    graph = next(figure for figure in Seen(page(facts)).figures if figure["places"])
    places, ends = (unpacked(part) for part in (graph["places"], graph["data"][-3]["ends"]))
    pairs = {(places[2 * k], places[2 * k + 1]) for k in range(24)} - {(0.0, 0.0)}
    assert len(pairs) == 21 and ends.max() < 24  # as many as photos: rounding has made none of them one


def test_lines_of_pairs_join_the_photos_that_were_matched(full: str) -> None:
    facts = sample()
    graph = next(figure for figure in Seen(full).figures if figure["places"])
    found = [unpacked(trace["ends"]).reshape(-1, 2) for trace in graph["data"] if "ends" in trace]
    joined = sorted(map(tuple, np.concatenate(found).tolist()))
    assert joined == sorted(zip(facts["pairs"]["first"], facts["pairs"]["second"], strict=True))
    places = unpacked(graph["places"]).reshape(-1, 2)
    adjusted = [k for k, photo in enumerate(facts["photos"]) if photo["x"] is not None]
    np.testing.assert_array_equal(places[adjusted], [[facts["photos"][k][axis] for axis in "xy"] for k in adjusted])


def test_terms_of_the_glossary_are_the_words_of_the_page(full: str) -> None:
    # breaks where a heading is renamed and the glossary is not, or the other way round
    seen = Seen(full)
    texts = " ".join(text for name, text in seen.sections.items() if name != "glossary").lower()
    texts += "bundle adjustment" if "Bundle adjustment report" in full else ""
    facts = sample()
    facts["sigmas"]["scope"] = "within the block"
    texts += Seen(page(facts)).sections["positions-map"].lower()
    assert [term for term in GLOSSARY if term.lower() not in texts] == []


def test_what_is_not_determined_and_what_sigmas_are_of_is_said(full: str) -> None:
    seen = Seen(full)
    assert seen.sections["positions"].count("not determined") == 2  # offset in common up, and its sigma
    assert "Absolute accuracy" in seen.sections["positions-map"] and "absolute sigma east" in seen.sections["photos"]
    assert "let go" in seen.sections["photos"] and "left out" in seen.sections["photos"]
    assert "assumed beforehand" in seen.sections["statistics"] and "gcp_list.txt" in seen.sections["processing"]
    for heading in ("redundancy number east", "internal reliability up", "external reliability north"):
        assert heading in seen.sections["control"]


def test_names_from_files_stay_text() -> None:
    facts = sample(12, 50)
    for name, photo in zip(HOSTILE, facts["photos"], strict=False):
        photo["name"] = name
    for part in ("points", "bars"):
        facts["control" if part == "points" else "bars"][part][0] |= {"name": HOSTILE[0], "first": HOSTILE[0]}
    facts["project"]["name"] = HOSTILE[2]
    facts["findings"][0] = facts["correlation"]["names"][0] = HOSTILE[0]
    html = page(facts)
    own, plain = Seen(html), Seen(page(sample(12, 50)))
    assert own.tags == plain.tags  # not one element more
    for name in HOSTILE:
        assert name in own.sections["photos"]
    assert "alert(1)" in html and "<script>alert(1)" not in html
    texts = json.dumps(own.figures)
    assert "&lt;script&gt;alert(1)" in texts and "<script>" not in texts  # Plotly reads markup, too


def test_the_page_asks_for_nothing_and_every_table_has_headings(full: str) -> None:
    seen = Seen(full)
    assert all(link.startswith(("#", "data:")) for link in seen.links)
    assert seen.tags.count("table") == seen.tags.count("thead") > 10
    own = full.split("plotly.js v")[0] + full[full.rindex("</script>", 0, full.rindex("drawAll")) :]
    assert not re.search("https?://", own)


def test_a_large_block_stays_small_enough_to_send() -> None:
    facts = sample(500, 50_000)
    assert len(page(facts).encode()) < 8_000_000
    rng = np.random.default_rng(1)
    facts["pairs"] = {
        name: rng.integers(0, 400, 60_000).tolist() for name in ("first", "second", "matches", "putative")
    } | {"state": ["good"] * 60_000, "median_px": [0.5] * 60_000, "angle_deg": [9.5] * 60_000}
    assert len(page(facts).encode()) < 8_000_000


def test_a_browser_draws_every_figure_and_asks_for_nothing(full: str, tmp_path: Path) -> None:
    found = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if found is None:
        pytest.skip("needs Chromium, and there is none on the PATH")
    path = tmp_path / "report.html"
    path.write_text(full, "utf-8")
    flags = [  # a window that shows all of it, since the points in space wait until they are looked at
        *("--headless", "--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader", "--disable-dev-shm-usage"),
        *("--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-component-update"),
        *(
            "--window-size=1200,30000",
            "--disable-sync",
            "--enable-logging=stderr",
            "--v=0",
            "--virtual-time-budget=30000",
            "--dump-dom",
        ),
    ]
    done = subprocess.run(
        [found, *flags, f"--user-data-dir={tmp_path / 'profile'}", path.as_uri()],
        capture_output=True, text=True, timeout=120, check=True,
    )  # fmt: skip
    seen = Seen(done.stdout)
    assert 'data-drawn="true"' in done.stdout[:2000]
    assert seen.tags.count("figure") == seen.classes.count("js-plotly-plot") == 13
    assert seen.classes.count("main-svg") > 13 and seen.tags.count("canvas") > 0
    # what the page's policy forbids, anything from elsewhere above all, would be told here, as errors are
    assert "default-src 'none'" in full and "connect-src" not in full.split("</head>")[0]
    said = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    assert [line for line in said if not re.search("willReadFrequently|GPU stall", line)] == []
