"""The facts of a report: each is what the stages recorded and the exports hold, and every field is documented."""

import copy
import csv
import dataclasses
import hashlib
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
from jaxba.report.document._light import high, low
from jaxba.report.document._material import Material
from jaxba.report.document._photos import photo_rows
from jaxba.report.document._pngs import pngs
from jaxba.report.document._schema import SECTIONS_WITHOUT_DATA
from jaxba.report.document._sigmas import sigmas
from jaxba.report.document._survey import attitudes, common_offset, positions
from jaxba.report.document._survey_lights import check_light, control_light
from jaxba.report.document._write import _json
from jaxba.scene import CommonOffset, Control, ControlFit, Finding


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
    linked = sum(state != "rejected" for state in facts["pairs"]["state"])
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
    assert all("none" in found[section] for section in SECTIONS_WITHOUT_DATA if section != "pairs")
    assert {photo["state"] for photo in found["photos"]} == {"not adjusted"} and len(found["pairs"]["first"]) > 5
    changed = [f"{p['section']}.{p['name']}={p['value']}" for p in found["processing"]["parameters"] if p["changed"]]
    assert {FAST[0], "tracks.require_connected=true"} <= set(changed)


@pytest.mark.parametrize(
    ("value", "falling", "rising"),
    [
        (1.0, "good", "poor"),
        (1.5, "good", "poor"),
        (2.0, "fair", "fair"),
        (3.5, "poor", "good"),
        (np.nan, "unknown", "unknown"),
    ],
)
def test_a_figure_is_judged_by_its_limits(value: float, falling: str, rising: str) -> None:
    assert low(value, (1.5, 3.0)) == falling and high(value, (3.0, 2.0)) == rising


def with_points(
    adjusted: Any,
    residual_m: list[list[float]],
    std_m: float,
    *,
    is_check: bool,
    aside: int = 0,
    target: tuple[float | None, float | None] = (None, None),
) -> Material:
    """Return the block with surveyed points of its own, which it differs from by so much."""
    count = len(residual_m)
    control = dataclasses.replace(
        Control.nothing(),
        names=tuple("abcdefgh"[:count]),
        xyz_m=np.zeros((count, 3)),
        std_m=np.full((count, 3), std_m),
        is_check=np.full(count, is_check),
    )
    fit = dataclasses.replace(
        ControlFit.nothing(count),
        residual_m=np.array(residual_m),
        is_set_aside=np.repeat(np.arange(count)[:, None] < aside, 3, axis=1),
    )
    done = SimpleNamespace(adjust=dataclasses.replace(adjusted, control=fit), control=SimpleNamespace(control=control))
    found = Recorded(done=done, stopped=None, killed=None, running=None, stale=None, failed={})
    export = dataclasses.replace(PIPELINE.settings["export"], accuracy_h=target[0], accuracy_v=target[1])
    return Material(Path(), found, {}, {"export": export}, {}, {})


@pytest.mark.parametrize(("aside", "state"), [(0, "good"), (1, "fair"), (2, "poor"), (4, "unknown")])
def test_control_that_is_mostly_set_aside_is_no_good_control(adjusted: Any, aside: int, state: str) -> None:
    # breaks where the few points that are left, which agree with each other, are taken for the survey
    light = control_light(with_points(adjusted, [[0.01] * 3] * 4, 1.0, is_check=False, aside=aside))
    assert light["state"] == state
    assert (f"contradicting all else: {aside}." in light["text"]) == (0 < aside < 4)


@pytest.mark.parametrize(
    ("off", "std_m", "state"),
    [(1.9, 0.001, "good"), (3.0, 0.001, "fair"), (4.5, 0.001, "poor"), (4.5, 4.6, "good"), (9.1, 4.6, "fair")],
)
def test_points_are_held_to_no_less_than_their_survey(adjusted: Any, off: float, std_m: float, state: str) -> None:
    # in pixels on the ground: the sigma of the survey counts where it is larger than two of them
    block = adjusted.block
    above = [
        block.centers_m[i, 2] - np.median(block.points_m[block.observation_point[block.observation_image == i], 2])
        for i in range(block.num_images)
    ]
    gsd = float(np.median(above) / block.camera_parameters[0, 0])
    residual_m = [[0.0, 0.0, off * gsd], [0.0, 0.0, -off * gsd]]
    for light in (control_light, check_light):
        found = light(with_points(adjusted, residual_m, std_m * gsd, is_check=light is check_light))
        assert found["state"] == state and found["value"].endswith(f"{off * gsd:.3f} m up")


def test_check_points_are_judged_by_the_target_and_the_worst_is_named(adjusted: Any) -> None:
    residual_m = [[0.01, 0.0, 0.02], [0.0, 0.01, -0.05], [0.01, 0.0, 0.0]]
    up = float(np.hypot(np.sqrt((0.02**2 + 0.05**2) / 3), 0.01))  # 0.033 m with the sigma of the survey
    for target, state in ((up + 1e-4, "good"), (up - 1e-4, "poor")):
        found = check_light(with_points(adjusted, residual_m, 0.01, is_check=True, target=(None, target)))
        assert found["state"] == state and f"target accuracy of {target:g} m up" in found["limits"]
        assert "Worst is b: east +0.000, north +0.010, up -0.050 m." in found["text"]
    assert "0.033 m up" in found["text"]
    flat = check_light(with_points(adjusted, [[0.03, 0.04, np.nan]], 0.01, is_check=True))
    assert flat["value"] == "0.050 m across" and "up" not in flat["text"]


def test_redundancies_sum_up_and_each_kind_says_what_weighed_it(facts: dict[str, Any], adjusted: Any) -> None:
    kinds = {kind["name"]: kind for kind in facts["statistics"]["kinds"]}
    total = sum(kind["redundancy"] for kind in kinds.values())
    assert total == pytest.approx(facts["statistics"]["redundancy"], abs=1e-3)
    assert kinds["tie points"]["weighed_std"] == adjusted.std_px and kinds["tie points"]["taken_std"] is None
    position = kinds["position vertical"]
    assert position["weighed_std"] == pytest.approx(position["taken_std"] * adjusted.position_scale[2])
    assert kinds["assumed beforehand"]["count"] == 9  # eight intrinsics that are free, and square pixels


def test_sigmas_say_whether_they_hold_what_the_whole_block_may_be_off(made: Survey, facts: Any, adjusted: Any) -> None:
    assert facts["sigmas"]["scope"] == "within the block" and facts["sigmas"]["absolute_m"] is None  # RTK, no control
    names = [row["name"] for row in facts["summary"]]
    assert "Sigma of a point within the block" in names and "Absolute accuracy of a point" in names
    done = recorded(made.project, PIPELINE).done
    plain = dataclasses.replace(done.control.reference, std_m=np.full((NUM_PHOTOS, 3), (3.0, 3.0, 5.0)))
    points = with_points(adjusted, [[0.3, -0.4, 0.5]] * 3, 0.01, is_check=True)
    control = points.done.control.control

    def told(fit: ControlFit) -> dict[str, Any]:
        given = SimpleNamespace(control=control, reference=plain)
        changed = SimpleNamespace(adjust=dataclasses.replace(adjusted, control=fit), control=given)
        return sigmas(dataclasses.replace(points, found=dataclasses.replace(points.found, done=changed)))

    bare = told(ControlFit.nothing(3))
    median = np.median(adjusted.point_std_m, axis=0)
    np.testing.assert_allclose(bare["absolute_m"], np.hypot(median, [3.0, 3.0, 5.0]))
    held = told(dataclasses.replace(ControlFit.nothing(3), method="adjust", used_std_m=np.full((3, 3), 0.02)))
    assert held["scope"] == "absolute" and held["absolute_m"] == median.tolist()
    checked = told(points.adjusted.control)
    np.testing.assert_allclose(checked["absolute_m"], np.hypot([0.3, 0.4, 0.5], 0.01))


def test_what_nothing_has_told_of_the_offset_is_not_determined(adjusted: Any) -> None:
    # breaks where the sigma that was assumed beforehand is shown as one that control has found
    fit = dataclasses.replace(
        ControlFit.nothing(),
        method="adjust",
        gnss_minus_control_m=np.array([1.5, -2.0, 0.4]),
        gnss_minus_control_std_m=np.array([0.02, 0.03, 4.9]),
    )
    prior = CommonOffset(np.zeros(3), np.array([3.0, 3.0, 5.0]))
    done = SimpleNamespace(adjust=dataclasses.replace(adjusted, control=fit, common=prior))
    found = Recorded(done=done, stopped=None, killed=None, running=None, stale=None, failed={})
    common, std = common_offset(Material(Path(), found, {}, {}, {}, {}))
    np.testing.assert_array_equal(common, [-1.5, 2.0, np.nan])  # adjusted minus measured
    np.testing.assert_array_equal(std, [0.02, 0.03, np.nan])


def test_attitudes_are_averaged_on_the_circle(made: Survey, adjusted: Any) -> None:
    # half of the tags point the other way round: the headings differ by 179 and -179 degrees, whose mean is 180
    done = recorded(made.project, PIPELINE).done
    world_from_cam = Rotation.from_quat(adjusted.block.quaternion, scalar_first=True).inv()
    up_deg = np.where(np.arange(NUM_PHOTOS) % 2, 179.0, -179.0)
    tags = Rotation.from_rotvec(np.outer(-np.radians(up_deg), [0.0, 0.0, 1.0])) * world_from_cam
    quaternion = np.full((len(done.photos), 4), np.nan)
    quaternion[adjusted.block.image_index] = tags.inv().as_quat(scalar_first=True)
    reference = dataclasses.replace(done.control.reference, quaternion=quaternion)
    control = dataclasses.replace(done.control, reference=reference)
    changed = SimpleNamespace(adjust=adjusted, control=control)
    bad = Finding.of("attitudes contradict", names=["a.jpg"], turn_deg=[179.0], measured=8, quarter_turns=2)
    changed.adjust = dataclasses.replace(adjusted, findings=(bad,))
    found = Recorded(done=changed, stopped=None, killed=None, running=None, stale=None, failed={})
    told = attitudes(Material(Path(), found, {}, {}, {}, {}))
    np.testing.assert_allclose(np.abs(told["mean_deg"]), [0.0, 0.0, 180.0], atol=1e-6)
    np.testing.assert_allclose(told["spread_deg"], [0.0, 0.0, 1.0], atol=1e-3)  # of one degree to each side
    assert told["contradict"] == ["a.jpg"]


def test_positions_that_were_left_out_have_residuals_and_are_marked(made: Survey, facts: dict[str, Any]) -> None:
    # breaks where a position that was not trusted shows as if it had taken part, or without its difference
    found = recorded(made.project, PIPELINE)
    used = found.done.control.reference.is_used.copy()
    used[2] = False
    reference = dataclasses.replace(found.done.control.reference, is_used=used)
    residual_m = found.done.adjust.gnss_residual_m.copy()
    residual_m[2] = np.nan
    bad = Finding.of("positions contradict", names=[found.done.photos[1].name], residual_m=[], measured=8, sigmas=3.3)
    adjust = dataclasses.replace(found.done.adjust, gnss_residual_m=residual_m, findings=(bad,))
    control = dataclasses.replace(found.done.control, reference=reference)
    done = copy.copy(found.done)
    done.adjust, done.control = adjust, control
    material = Material(made.project, dataclasses.replace(found, done=done), {}, {}, {}, {})
    rows = photo_rows(material)
    assert [row["position"] for row in rows[:4]] == ["used", "let go", "left out", "used"]
    assert rows[2]["residual_m"] == pytest.approx(facts["photos"][2]["residual_m"])
    told = positions(material, rows)
    assert (told["num"], told["num_let_go"], told["num_left_out"]) == (NUM_PHOTOS - 2, 1, 1)
    kept = [row["residual_m"] for row in rows if row["position"] == "used"]
    np.testing.assert_allclose(told["mean_m"], np.mean(kept, axis=0))


def test_intrinsics_begin_at_what_the_tags_say(facts: dict[str, Any], adjusted: Any, made: Survey) -> None:
    (camera,) = facts["cameras"]
    photo = recorded(made.project, PIPELINE).done.photos[0]
    parts = {part["name"]: part for part in camera["parameters"]}
    assert parts["fx"]["start"] == photo.focal_px and parts["cx"]["start"] == photo.width_px / 2
    assert parts["k1"]["start"] == 0.0 and camera["focal_from"].startswith("the tags")
    for part in parts.values():
        assert part["change"] == pytest.approx(part["value"] - part["start"])
        assert part["fixed"] or part["change_over_sigma"] == pytest.approx(part["change"] / part["std"])


def test_key_figures_and_inputs_are_those_of_the_flight(facts: dict[str, Any], made: Survey, tmp_path: Path) -> None:
    found = {row["name"]: row["value"] for row in facts["summary"]}
    rows = np.array(facts["overlap"]["rows"])
    area = float((rows >= 2).sum()) * facts["overlap"]["cell"] ** 2  # by the grid, whose scale is 0.9996
    assert facts["overlap"]["area_m2"] == pytest.approx(area, rel=2e-3)
    assert (
        found["Date of the flight"] == "2024-06-01"
        and 65 < float(found["Flying height above ground, median"].removesuffix(" m")) < 75
    )
    assert found["Area seen by two photos or more"].startswith(f"{facts['overlap']['area_m2']:,.0f} m")
    survey = made.copy(tmp_path)
    listed = tmp_path / "gcp_list.txt"
    listed.write_text("EPSG:32615\n")
    given = json.loads((survey.project / "run.json").read_text())
    (survey.project / "run.json").write_text(json.dumps(given | {"gcp": str(listed)}))
    with pytest.raises(JaxbaError):  # no point in it
        survey.run(gcp=listed)
    first = report_facts(survey.project, PIPELINE)["processing"]["inputs"][0]
    assert first == {"name": "gcp_list.txt", "what": "gcp", "sha256": hashlib.sha256(b"EPSG:32615\n").hexdigest()}


def test_the_file_holds_the_facts_with_long_lists_on_one_line(facts: dict[str, Any]) -> None:
    text = _json(facts)
    assert json.loads(text) == facts
    line = next(line for line in text.splitlines() if line.startswith('  "angle_deg": ['))
    assert line.count(",") >= len(facts["pairs"]["angle_deg"]) - 1


def test_the_schema_is_in_the_readme() -> None:
    readme = (Path(__file__).parents[2] / "jaxba" / "report" / "README.md").read_text(encoding="utf-8")
    assert schema_markdown() in readme, "paste the output of jaxba.report.document.schema_markdown() into it"
