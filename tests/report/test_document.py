"""The facts of a report: each is what the stages recorded and the exports hold, and every field is documented."""

import csv
import dataclasses
import io
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pandas as pd
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation
from small_survey import FAST, NUM_PHOTOS, Survey

from jaxba import JaxbaError
from jaxba.io._read_cloud import read_csv_cloud
from jaxba.pipeline import PIPELINE
from jaxba.report import Recorded, recorded
from jaxba.report.document import FIELDS, paths_of, report_facts, schema_markdown
from jaxba.report.document._csv_tables import tables
from jaxba.report.document._lights import _control, _high, _low
from jaxba.report.document._material import Material
from jaxba.report.document._pngs import pngs
from jaxba.report.document._schema import SECTIONS_WITHOUT_DATA
from jaxba.scene import Control, ControlFit


@pytest.fixture(scope="module")
def facts(made: Survey) -> dict[str, Any]:
    return report_facts(made.project, PIPELINE)


@pytest.fixture(scope="module")
def adjusted(made: Survey) -> Any:
    return recorded(made.project, PIPELINE).done.adjust


def undocumented(facts: dict[str, Any]) -> set[str]:
    """Return the fields that the schema does not know; a null may stand for a list."""
    known = {*FIELDS, *(f"{section}.none" for section in SECTIONS_WITHOUT_DATA)}
    known |= {field.removesuffix("[]") for field in FIELDS} | {field.removesuffix("[][]") for field in FIELDS}
    return paths_of(facts) - known


def test_every_field_is_documented_and_the_same_each_time(made: Survey, facts: dict[str, Any]) -> None:
    assert undocumented(facts) == set()
    text = json.dumps(facts, allow_nan=False)
    assert json.dumps(report_facts(made.project, PIPELINE), allow_nan=False) == text


def test_photos_and_cloud_are_those_of_the_exports(made: Survey, facts: dict[str, Any], adjusted: Any) -> None:
    cloud = read_csv_cloud(made.project / "export" / "cloud.csv").cloud
    shown = facts["cloud"]
    assert shown["num_points"] == shown["num_shown"] == len(cloud.xyz)
    np.testing.assert_allclose(np.transpose([shown[axis] for axis in "xyz"]), cloud.xyz, atol=1e-3)
    sites = {
        feature["properties"]["name"]: feature["properties"]
        for feature in json.loads((made.project / "export" / "cameras.geojson").read_text())["features"]
    }
    assert len(facts["photos"]) == len(sites) == NUM_PHOTOS
    for row, photo in enumerate(facts["photos"]):
        site = sites[photo["name"]]
        assert photo["state"] == "adjusted" and photo["observations"] == site["num_observations"]
        assert photo["median_px"] == pytest.approx(site["median_error_px"], abs=2e-3)
        assert photo["std_m"] == pytest.approx([site[f"std_{axis}_m"] for axis in "enu"], abs=1e-4)
        assert photo["residual_m"] == pytest.approx([site[f"gnss_residual_{axis}_m"] for axis in "enu"], abs=1e-3)
        a, b, azimuth = photo["ellipse_m"]
        along = np.array([np.sin(np.radians(azimuth)), np.cos(np.radians(azimuth))])
        covariance = adjusted.position_covariance_m2[row, :2, :2]
        assert along @ covariance @ along == pytest.approx(a**2) and a >= b > 0
        np.testing.assert_allclose(np.sqrt(np.diagonal(adjusted.position_covariance_m2[row])), photo["std_m"])
    linked = sum(pair["state"] != "rejected" for pair in facts["pairs"])
    assert sum(photo["partners"] for photo in facts["photos"]) == 2 * linked > 0


def test_residuals_are_those_of_the_adjustment_and_of_opencv(facts: dict[str, Any], adjusted: Any) -> None:
    histogram, block = facts["residuals"]["histogram"], adjusted.block
    assert sum(histogram["counts"]) == block.num_observations
    edges = np.array(histogram["edges_px"])
    inside = adjusted.error_px < edges[-2]
    expected, _ = np.histogram(adjusted.error_px[inside], edges[:-1])
    np.testing.assert_array_equal(histogram["counts"][:-1], expected)
    assert 0 < sum(histogram["rejected"]) < 0.5 * block.num_observations
    # the mean residual of each cell, by OpenCV's projection
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = block.camera_parameters[0]
    sensor, off, seen = facts["residuals"]["sensors"][0], [], []
    for image in range(block.num_images):
        mine = block.observation_image == image
        turn = Rotation.from_quat(block.quaternion[image], scalar_first=True).as_rotvec()
        projected, _ = cv2.projectPoints(
            block.points_m[block.observation_point[mine]], turn, block.translation_m[image],
            np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.array([k1, k2, p1, p2, k3]),
        )  # fmt: skip
        off.append(projected[:, 0] - block.observation_xy_px[mine])
        seen.append(block.observation_xy_px[mine])
    off_px, xy_px = np.concatenate(off), np.concatenate(seen)
    ny, nx = np.shape(sensor["count"])
    cell = np.floor(xy_px / [sensor["width_px"], sensor["height_px"]] * [nx, ny]).astype(int)
    row, column = ny // 2, nx // 3
    mine = (cell == [column, row]).all(axis=1)
    assert sensor["count"][row][column] == mine.sum() > 10
    assert [sensor[f"d{axis}_px"][row][column] for axis in "xy"] == pytest.approx(off_px[mine].mean(axis=0), abs=1e-9)
    radius = np.hypot(*(xy_px - [sensor["width_px"] / 2, sensor["height_px"] / 2]).T)
    ring = radius * len(sensor["radial"]["count"]) / (np.hypot(sensor["width_px"], sensor["height_px"]) / 2)
    third = (ring >= 3) & (ring < 4)
    assert sensor["radial"]["count"][3] == third.sum()
    assert sensor["radial"]["rms_px"][3] == pytest.approx(np.sqrt(np.mean(np.sum(off_px[third] ** 2, axis=1))))


def test_overlap_counts_the_photos_that_see_a_point(facts: dict[str, Any], adjusted: Any) -> None:
    # breaks where rows run the other way, the grid lies elsewhere, or photos are counted by their frame alone
    found = facts["overlap"]
    rows = np.array(found["rows"])
    xyz = np.transpose([facts["cloud"][axis] for axis in "xyz"])
    column, row = ((xyz[:, k] - found[f"{axis}0"]) // found["cell"] for k, axis in enumerate("xy"))
    inside = (column >= 0) & (column < rows.shape[1]) & (row >= 0) & (row < rows.shape[0])
    views = np.bincount(adjusted.block.observation_point, minlength=len(xyz))[inside]
    seen = rows[row[inside].astype(int), column[inside].astype(int)]
    # a point is seen by no more photos than its cell is, up to the cell's size at the rims of photos
    assert np.mean(views <= seen) > 0.97 and np.mean(seen - views) > 0.3
    assert rows.max() == NUM_PHOTOS


def test_tables_hold_what_the_facts_hold(facts: dict[str, Any]) -> None:
    found = {name: pd.read_csv(io.BytesIO(content)) for name, content in tables(facts).items()}
    assert {"photos.csv", "pairs.csv", "intrinsics.csv", "components.csv", "parameters.csv"} <= set(found)
    photos = found["photos.csv"]
    np.testing.assert_array_equal(photos["std_north_m"], [photo["std_m"][1] for photo in facts["photos"]])
    np.testing.assert_array_equal(photos["ellipse_azimuth_deg"], [photo["ellipse_m"][2] for photo in facts["photos"]])
    assert set(found["pairs.csv"]["first"]) <= {photo["name"] for photo in facts["photos"]}
    hostile = tables({"photos": [{"name": 'a, "b".jpg', "measured": None, "state": "left out"}]})["photos.csv"]
    (row,) = csv.DictReader(io.StringIO(hostile.decode()))
    assert row == {"name": 'a, "b".jpg', "measured_x": "", "measured_y": "", "measured_z": "", "state": "left out"}


def test_figures_are_pictures_and_the_same_each_time(facts: dict[str, Any]) -> None:
    found = pngs(facts)
    assert set(found) == {"map.png", "matches.png", "overlap.png", "residuals.png", "correlation.png"}
    for name, content in found.items():
        with Image.open(io.BytesIO(content)) as image:
            assert image.size == (1600, 900) and len(np.unique(np.array(image.convert("L")))) > 10, name
    assert pngs(facts) == found


def test_a_run_that_ended_early_is_reported_as_far_as_it_came(
    made: Survey, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object) -> None:
        raise JaxbaError("no two photos are joined.")

    survey = made.copy(tmp_path)
    monkeypatch.setattr("jaxba.pipeline.tracks.run", fails)
    with pytest.raises(JaxbaError):
        survey.run("tracks.require_connected=true")
    found = report_facts(survey.project, PIPELINE)
    assert undocumented(found) == set()
    assert found["project"]["state"] == "stopped" and "tracks" in found["project"]["reason"]
    assert found["verdict"]["state"] == "unknown" and {light["state"] for light in found["quality"]} == {"unknown"}
    assert all("none" in found[section] for section in SECTIONS_WITHOUT_DATA)
    assert {photo["state"] for photo in found["photos"]} == {"not adjusted"} and len(found["pairs"]) > 5
    changed = [f"{p['section']}.{p['name']}={p['value']}" for p in found["processing"]["parameters"] if p["changed"]]
    assert {FAST[0], "tracks.require_connected=true"} <= set(changed)


@pytest.mark.parametrize(
    ("value", "low", "high"),
    [
        (1.0, "good", "poor"),
        (1.5, "good", "poor"),
        (2.0, "fair", "fair"),
        (3.5, "poor", "good"),
        (np.nan, "unknown", "unknown"),
    ],
)
def test_a_figure_is_judged_by_its_limits(value: float, low: str, high: str) -> None:
    assert _low(value, (1.5, 3.0)) == low and _high(value, (3.0, 2.0)) == high


@pytest.mark.parametrize(("aside", "state"), [(0, "good"), (1, "fair"), (2, "poor"), (4, "poor")])
def test_control_that_is_mostly_set_aside_is_no_good_control(adjusted: Any, aside: int, state: str) -> None:
    # breaks where the few points that are left, which agree with each other, are taken for the survey
    fit = dataclasses.replace(
        ControlFit.nothing(4),
        control_rms_m=np.full(3, 0.01),
        is_set_aside=np.repeat(np.arange(4)[:, None] < aside, 3, axis=1),
    )
    control = dataclasses.replace(
        Control.nothing(),
        names=tuple("abcd"),
        xyz_m=np.zeros((4, 3)),
        std_m=np.ones((4, 3)),
        is_check=np.zeros(4, bool),
    )
    done = SimpleNamespace(adjust=dataclasses.replace(adjusted, control=fit), control=SimpleNamespace(control=control))
    found = Recorded(done=done, stopped=None, killed=None, running=None, stale=None, failed={})
    light = _control(Material(Path(), found, {}, {}, {}, {}))
    assert light["state"] == state and (f"contradicting all else: {aside}." in light["text"]) == bool(aside)


def test_the_schema_is_in_the_readme() -> None:
    readme = (Path(__file__).parents[2] / "jaxba" / "report" / "README.md").read_text(encoding="utf-8")
    assert schema_markdown() in readme, "paste the output of jaxba.report.document.schema_markdown() into it"
