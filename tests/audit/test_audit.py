"""A clean model has no fault; each planted fault is named, alone, with its figure; bad input ends with one error."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from commands import Cli

from benchmarks.audits import FOCAL_PX, PLANTS, clean, control_list, with_camera_shifted, with_wrong_matches, written
from jaxba.audit import Audited, audit
from jaxba.report.document import FIELDS, paths_of
from jaxba.report.document._schema import SECTIONS_WITHOUT_DATA


def audited(folder: Path, plant: str = "", control: str = "", **options: str) -> Audited:
    model = clean()
    if plant:
        PLANTS[plant](model)
        model.update_point_3d_errors()
    written(folder / "model", model)
    gcp = None
    if control:
        gcp = folder / "gcp_list.txt"
        gcp.write_text(control)
    return audit(folder / "model", folder / "audit", gcp=gcp, **options)


def kinds(found: Audited) -> list[str]:
    return [fault.kind for fault in found.faults]


def test_a_clean_model_has_no_fault_and_a_whole_report(tmp_path: Path):
    found = audited(tmp_path)
    assert found.faults == ()
    facts = found.facts
    known = {*FIELDS, *(f"{section}.none" for section in SECTIONS_WITHOUT_DATA)}
    known |= {field.removesuffix("[]") for field in FIELDS} | {field.removesuffix("[][]") for field in FIELDS}
    assert paths_of(facts) - known == set()
    assert facts["verdict"]["state"] in ("good", "fair")
    assert facts["audit"]["fault_count"] == 0
    assert facts["audit"]["held"] == ["cx", "cy"]  # in the middle of the image, as COLMAP leaves them
    values = {part["name"]: part["value"] for part in facts["cameras"][0]["parameters"]}
    assert (values["cx"], values["cy"]) == pytest.approx((512, 384), abs=1e-3)
    assert values["f"] != facts["cameras"][0]["parameters"][0]["start"]
    assert all("none" in facts[section] for section in ("positions", "control", "bars", "accuracy"))
    assert json.loads((tmp_path / "audit" / "report.json").read_text()) == facts
    html = found.page.read_text()
    assert html.index('id="findings"') < html.index('id="audit"') < html.index('id="preview"')
    assert "No fault was found." in html
    names = {path.name for path in (tmp_path / "audit" / "report").iterdir()}
    assert {"audit_claims.csv", "audit_images.csv", "audit_intrinsics.csv", "residuals.png"} <= names
    # noise of half a pixel, of which points and poses take up their share
    assert facts["quality"][1]["state"] == "good"
    (sigma,) = (row["value"] for row in facts["summary"] if row["name"] == "Sigma of an image coordinate")
    assert float(sigma.split()[0]) == pytest.approx(0.5, abs=0.03)


def test_a_focal_length_off_by_a_twentieth_is_named(tmp_path: Path):
    found = audited(tmp_path, "focal")
    assert kinds(found) == ["intrinsics off"]
    figures = found.faults[0].figures
    assert (figures["cameras"], figures["parameters"]) == (["1"], ["f"])
    (before,), (after,), (std,) = figures["before"], figures["after"], figures["std"]
    assert before / after - 1 == pytest.approx(0.05, abs=2e-3)
    assert abs(after - FOCAL_PX) < 4 * std
    assert found.facts["quality"][0]["state"] == "poor" == found.facts["verdict"]["state"]


def test_one_shifted_camera_is_named_and_no_other(tmp_path: Path):
    name = with_camera_shifted(clean())
    found = audited(tmp_path, "camera")
    assert kinds(found) == ["images off"]
    figures = found.faults[0].figures
    assert figures["names"] == [name]
    model = clean()
    (before,) = (image.projection_center() for image in model.images.values() if image.name == name)
    with_camera_shifted(model)
    (after,) = (image.projection_center() for image in model.images.values() if image.name == name)
    assert figures["shift"][0] == pytest.approx(np.linalg.norm(after - before), rel=0.05)
    assert figures["over_sigma"][0] > 10 * figures["limit_sigma"]
    assert [row["name"] for row in found.facts["audit"]["images"] if row["off"]] == [name]


def test_wrong_matches_are_counted(tmp_path: Path):
    planted = with_wrong_matches(clean())
    found = audited(tmp_path, "matches")
    assert kinds(found) == ["wrong matches"]
    figures = found.faults[0].figures
    assert (figures["count"], figures["observations"]) == (pytest.approx(planted, abs=1), 1800)


def test_control_places_the_model_and_exchanged_names_are_named(tmp_path: Path):
    model = clean()
    good = audited(tmp_path / "good", control=control_list(model))
    assert good.faults == ()
    control = good.facts["control"]
    assert control["num_control"] == 8
    # surveyed to 2 and 3 cm
    assert max(control["control_rms_m"]) < 0.05
    assert good.facts["project"]["crs"] == "EPSG:32615"
    first = good.facts["photos"][0]
    assert abs(first["x"] - 576300) < 200 and abs(first["y"] - 5183400) < 200
    assert max(first["std_m"]) < 0.2
    swapped = audited(tmp_path / "swapped", control=control_list(model, exchanged=("g1", "g5")))
    assert kinds(swapped) == ["control labels exchanged"]
    assert sorted(swapped.faults[0].figures["names"]) == ["g1", "g5"]


def test_a_list_without_a_crs_is_in_the_one_that_is_given(tmp_path: Path):
    found = audited(tmp_path, control=control_list(clean(), crs=""), crs="EPSG:32615")
    assert found.faults == ()
    assert found.facts["project"]["crs"] == "EPSG:32615"


@pytest.mark.slow
def test_lund_door_has_no_fault(data_dir: Path, tmp_path: Path):
    found = audit(data_dir / "colmap" / "lund_door", tmp_path)
    assert found.faults == ()
    section = found.facts["audit"]
    assert section["observations"]["num"] == 73327 - 498  # points that COLMAP's tracks show twice in an image
    assert section["observations"]["wrong"] < 0.01 * 73327
    assert section["held"] == ["cx", "cy"]


def test_the_command_tells_faults_and_ends_by_them(tmp_path: Path, cli: Cli):
    model = clean()
    written(tmp_path / "clean", model)
    code, out, _ = cli("audit", tmp_path / "clean", "--out", tmp_path / "out")
    assert code == 0
    words = " ".join(out.split())  # lines are wrapped
    assert "COLMAP, 10 images, 300 points, 1,800 observations error mean 0.5445" in words
    assert "no fault was found" in words and str(tmp_path / "out" / "report.html") in out
    PLANTS["focal"](model)
    model.update_point_3d_errors()
    written(tmp_path / "off", model)
    code, out, _ = cli("audit", tmp_path / "off", "--out", tmp_path / "out", "--json")
    told = json.loads(out)
    assert code == told["exit_code"] == 1
    assert [fault["kind"] for fault in told["audit"]["faults"]] == ["intrinsics off"]
    assert "focal length f of camera 1" in told["audit"]["faults"][0]["text"]


def test_bad_input_ends_with_one_error_that_names_the_file(tmp_path: Path, cli: Cli):
    written(tmp_path / "model", clean())
    path = tmp_path / "model" / "images.bin"
    whole = path.read_bytes()
    path.write_bytes(whole[:-100])
    (tmp_path / "empty").mkdir()
    for given, message in (
        (tmp_path / "model", r"images\.bin, image 10: truncated, [\d,]+ bytes are wanted .*; copy the file again"),
        (tmp_path / "empty", r"empty: holds neither a COLMAP model .* give the folder with one"),
        (tmp_path / "nothing", r"nothing: no such file .*; check the path"),
    ):
        code, out, err = cli("audit", given, "--out", tmp_path / "out")
        assert (code, out) == (2, "")
        assert re.search(message, err) and err.count("\n") == 1, err
    path.write_bytes(whole)
    (tmp_path / "file").touch()
    code, _, err = cli("audit", tmp_path / "model", "--out", tmp_path / "file")
    assert code == 2 and "file: is a file, where the folder of the report is to be" in err
    code, _, err = cli("audit", tmp_path / "model", "--gcp", tmp_path / "none.txt", "--out", tmp_path / "out")
    assert code == 2 and "none.txt: there is no such file" in err
    assert not (tmp_path / "out").exists()
