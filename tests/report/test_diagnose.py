"""Diagnosis: each fault, planted in a simulated survey, is found by its own rule; a clean survey has none."""

import contextlib
import dataclasses
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image, ImageFilter
from pyproj import Transformer
from scipy.spatial.transform import Rotation
from small_survey import NUM_PHOTOS, Survey, repaint

from jaxba import JaxbaError
from jaxba.cli import main
from jaxba.engine import changed
from jaxba.pipeline import PIPELINE, run_pipeline
from jaxba.report._recorded import recorded
from jaxba.report.diagnosis import RULES, diagnose
from jaxba.report.diagnosis._adjustment import out_of_steps
from jaxba.report.diagnosis._diagnosis import Diagnosis
from jaxba.report.diagnosis._limits import crashed, over_memory
from jaxba.scene import Attitude, LeftOut
from jaxba.sfm import _rounds
from jaxba.simulation import PhotoTags, jpeg_with_tags

FOCAL_PX = 540  # of the small survey


def found(survey: Survey, *changes: str, until: str | None, **lists: Path) -> dict[str, Diagnosis]:
    """Run a survey as far as it goes, and return what is diagnosed."""
    with contextlib.suppress(JaxbaError):  # diagnosis is for runs that stop, too
        survey.run(*changes, until=until, **lists)
    return {diagnosis.name: diagnosis for diagnosis in diagnose(survey.project, PIPELINE)}


def photos_of(survey: Survey) -> list[Path]:
    return sorted(survey.photos.glob("*.JPG"))


def places(survey: Survey) -> list[tuple[str, float, float, float]]:
    """Name, longitude, latitude and height of each photo's tags."""
    positions = [(photo.name, photo.position) for photo in recorded(survey.project, PIPELINE).done.photos]
    return [(name, p.x, p.y, p.z_m) for name, p in positions]


def in_utm(rows: list[tuple[str, float, float, float]]) -> list[tuple[str, float, float, float]]:
    way = Transformer.from_crs("EPSG:4326", "EPSG:32615", always_xy=True)
    return [(name, *way.transform(x, y), z) for name, x, y, z in rows]


def geo_txt(path: Path, crs: str, rows: list[tuple[str, float, float, float]]) -> Path:
    path.write_text("\n".join([crs, *(f"{name} {x:.9f} {y:.9f} {z:.3f}" for name, x, y, z in rows), ""]))
    return path


def test_a_clean_survey_triggers_no_rule_and_is_not_touched(made: Survey, capsys: pytest.CaptureFixture[str]):
    before = {str(path): path.stat().st_mtime_ns for path in made.project.rglob("*")}
    assert diagnose(made.project, PIPELINE) == []
    assert {str(path): path.stat().st_mtime_ns for path in made.project.rglob("*")} == before
    case = recorded(made.project, PIPELINE)
    assert case.done.export is not None and len(case.done.features) == NUM_PHOTOS and case.stale is None
    with pytest.raises(SystemExit) as ended:
        main(["diagnose", str(made.project)])
    assert ended.value.code == 0 and capsys.readouterr().out == "nothing looks poor\n"


def test_blurred_photos_have_too_little_texture(made: Survey, tmp_path: Path):
    survey = made.copy(tmp_path, photos=True)
    for path in photos_of(survey):
        repaint(path, lambda a: np.array(Image.fromarray(a).filter(ImageFilter.GaussianBlur(12))))
    diagnosis = found(survey, until="tracks")["few matches"]
    assert "too little texture" in diagnosis.cause and "contrast_threshold" in diagnosis.cure
    assert diagnosis.figures["keypoints"] < 500


def test_photos_that_do_not_show_the_same_ground(made: Survey, tmp_path: Path):
    """Every photo shows a pattern of its own, though by its tags it overlaps with others."""
    survey = made.copy(tmp_path, photos=True)
    noise = np.random.default_rng(0)
    for path in photos_of(survey):
        tiles = np.kron(noise.integers(0, 255, (80, 107, 3)), np.ones((6, 6, 1)))[:480, :640].astype(np.uint8)
        repaint(path, lambda a, tiles=tiles: tiles)
    diagnosis = found(survey, until="match")["few matches"]
    assert "there are keypoints" in diagnosis.cause
    assert diagnosis.figures["keypoints"] > 500 and diagnosis.figures["share_without_edge"] > 0.9


def test_groups_are_named_with_the_pairs_that_would_join_them(made: Survey, tmp_path: Path):
    survey = made.copy(tmp_path, photos=True)
    for path in photos_of(survey)[:4]:
        repaint(path, lambda a: np.ascontiguousarray(a[:, ::-1]))  # mirrored features match only each other
    diagnosis = found(survey, until="tracks")["several groups"]
    groups = [set(group) for group in diagnosis.figures["groups"]]
    names = [path.name for path in photos_of(survey)]
    assert set().union(*groups) == set(names) and diagnosis.figures["joining"]
    assert not any(group & set(names[:4]) and group & set(names[4:]) for group in groups)
    for pair in diagnosis.figures["joining"]:
        assert pair in diagnosis.cure
        first, second = pair.split(", ")
        assert not any({first, second} <= group for group in groups)


def test_photos_from_one_place_are_degenerate(made: Survey, tmp_path: Path):
    survey = made.copy(tmp_path, photos=True)
    source = np.array(Image.open(photos_of(survey)[0]))
    camera = np.array([[FOCAL_PX, 0, 320], [0, FOCAL_PX, 240], [0, 0, 1.0]])
    for k, path in enumerate(photos_of(survey)):
        turn = Rotation.from_euler("xy", [0.02 * k, -0.03 * k]).as_matrix()
        warp = camera @ turn @ np.linalg.inv(camera)
        repaint(path, lambda a, warp=warp: cv2.warpPerspective(source, warp, (640, 480)))
    diagnosis = found(survey, until="tracks")["degenerate geometry"]
    assert diagnosis.figures["narrow_pairs"] > 0.5 * diagnosis.figures["pairs"]
    assert "taken from one place" in diagnosis.cause and "The pairs: SIM_0" in diagnosis.cause


def test_a_wrong_focal_length_is_at_its_bound_with_large_errors(made: Survey, tmp_path: Path):
    survey = made.copy(tmp_path)
    result = found(survey, "metadata.focal=1600", until="adjust")
    assert set(result) == {"large errors", "parameter at its bound"}
    assert "focal length 1600 px (given), by its tags and sensor 536 px" in result["large errors"].cause
    bound = result["parameter at its bound"]
    assert any(text.endswith(": fx") for text in bound.figures["at_bounds"]) and "allowed 1120 to 2240" in bound.cause


def bend(pixels: np.ndarray, noise: np.random.Generator, amount_px: float) -> np.ndarray:
    """Move the pixels of a photo smoothly, each photo's otherwise."""
    rows, columns = pixels.shape[:2]
    coarse = amount_px * noise.normal(size=(2, 4, 5)).astype(np.float32)
    x, y = (cv2.resize(moved, (columns, rows), interpolation=cv2.INTER_CUBIC) for moved in coarse)
    x, y = x + np.arange(columns, dtype=np.float32), y + np.arange(rows, dtype=np.float32)[:, None]
    return cv2.remap(pixels, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)


def test_bent_photos_have_a_large_median_and_more_steps_do_not_help(
    made: Survey, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """They fit in pairs, not together. The least limit, 100 steps, is not reached: three stand for it."""
    full = _rounds.solve
    monkeypatch.setattr(_rounds, "solve", lambda *a, max_nfev, **named: full(*a, max_nfev=min(max_nfev, 3), **named))
    survey, noise = made.copy(tmp_path, photos=True), np.random.default_rng(0)
    for path in photos_of(survey):
        repaint(path, lambda a: bend(a, noise, 7.0))
    loose = ("match.ransac_threshold=5", "adjust.track_threshold=4", "adjust.mad_factor=5", "adjust.loss=linear")
    result = found(survey, *loose, "adjust.max_rounds=1", until="adjust")
    assert result["large errors"].figures["median_px"] > 3 > 2 * result["large errors"].figures["edge_median_px"]
    stuck = result["no convergence"]
    assert stuck.figures["solver"] == "max_nfev" and stuck.figures["median_px"] > 3
    assert "more steps do not help" in stuck.cause and stuck.figures["inliers_of_a_pair"] > 12


def test_a_solver_out_of_steps_with_a_high_cost_speaks_of_bad_input(made: Survey):
    case = recorded(made.project, PIPELINE)
    poor = dataclasses.replace(case.done.adjust, solver="max_nfev", median_px=4.2)
    diagnosis = out_of_steps(dataclasses.replace(case, done=dataclasses.replace(case.done, adjust=poor)))
    assert diagnosis is not None and "more steps do not help" in diagnosis.cause
    small = dataclasses.replace(poor, median_px=0.3)
    assert out_of_steps(dataclasses.replace(case, done=dataclasses.replace(case.done, adjust=small))) is None


def test_swapped_axes_are_told_from_the_tags(made: Survey, tmp_path: Path):
    rows = [(name, y, x, z) for name, x, y, z in in_utm(places(made))]
    result = found(made.copy(tmp_path), until="crs", geotags=geo_txt(tmp_path / "geo.txt", "EPSG:32615", rows))
    assert "with x and y swapped it would be 0 m" in result["far off"].cause
    assert result["far off"].cure == "Correct the list: x and y swapped."


def test_a_wrong_zone_of_the_list_is_named(made: Survey, tmp_path: Path):
    geotags = geo_txt(tmp_path / "geo.txt", "EPSG:32616", in_utm(places(made)))
    result = found(made.copy(tmp_path), until="crs", geotags=geotags)
    assert "with UTM zone 15N (EPSG:32615) it would be 0 m" in result["far off"].cause


def test_a_target_crs_of_another_zone_is_said_with_its_area(made: Survey, tmp_path: Path):
    result = found(made.copy(tmp_path), "crs.target_crs=EPSG:32617", until="crs")
    assert "-84 to -78" in result["far off"].cause and "EPSG:32615" in result["far off"].cure
    assert result["stopped"].figures["stage"] == "crs"


def test_heights_above_another_datum_than_the_tags(made: Survey, tmp_path: Path):
    rows = [(name, x, y, z + 27.0) for name, x, y, z in places(made)]
    result = found(made.copy(tmp_path), until="crs", geotags=geo_txt(tmp_path / "geo.txt", "EPSG:4326", rows))
    diagnosis = result["mixed datum"]
    assert diagnosis.figures["up_m"] == pytest.approx(27.0, abs=0.01)
    assert "above the ellipsoid" in diagnosis.cause and "crs.height_datum" in diagnosis.cure


def test_two_height_systems_in_one_set(made: Survey, tmp_path: Path):
    rows = [(name, x, y, z + 27.0 * (k % 2)) for k, (name, x, y, z) in enumerate(places(made))]
    result = found(made.copy(tmp_path), until="crs", geotags=geo_txt(tmp_path / "geo.txt", "EPSG:4326", rows))
    assert result["mixed datum"].figures["apart_m"] == pytest.approx(27.0, abs=1.0)  # the barometer's noise
    assert "two groups" in result["mixed datum"].cause


def test_control_of_another_datum_with_a_blunder(made: Survey, tmp_path: Path):
    """All heights of the list are 27 m up, and one of its points is 0.6 m east of where it was surveyed."""
    crs, *marks = (made.photos.parent / "gcp_list.txt").read_text().splitlines()
    rows = [mark.split() for mark in marks]
    for row in rows:
        row[0] = f"{float(row[0]) + 0.6 * (row[-1] == 'gcp02'):.4f}"
        row[2] = f"{float(row[2]) + 27:.4f}"
    (tmp_path / "gcp_list.txt").write_text("\n".join([crs, *(" ".join(row) for row in rows), ""]))
    result = found(made.copy(tmp_path), until="adjust", gcp=tmp_path / "gcp_list.txt")
    assert set(result) == {"mixed datum", "poor control"}
    assert result["mixed datum"].figures["gnss_minus_control_m"][2] == pytest.approx(-27, abs=0.5)
    assert "control.height_datum" in result["mixed datum"].cure
    assert "gcp02" in result["poor control"].figures["suspects"] and "not the solver" in result["poor control"].cause


def test_control_hundreds_of_metres_off(made: Survey, tmp_path: Path):
    crs, *marks = (made.photos.parent / "gcp_list.txt").read_text().splitlines()
    rows = [mark.split() for mark in marks]
    moved = [" ".join([f"{float(row[0]) + 300:.4f}", *row[1:]]) for row in rows]
    (tmp_path / "gcp_list.txt").write_text("\n".join([crs, *moved, ""]))
    result = found(made.copy(tmp_path), "adjust.max_rounds=1", until="adjust", gcp=tmp_path / "gcp_list.txt")
    assert result["far off"].figures["gnss_minus_control_m"][0] == pytest.approx(-300, abs=1)
    assert "control in another zone, or with swapped axes" in result["far off"].cause


def test_altitudes_that_climb_in_one_flight(tmp_path: Path):
    folder, pixels = tmp_path / "photos", np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)
    folder.mkdir()
    for k in range(16):
        tags = PhotoTags(
            make="jaxba", model="simulated", time=f"2024:06:01 10:00:{k:02d}", focal_mm=11.06, focal_35mm=29,
            sensor_width_mm=13.2, latitude_deg=44.9 + 1e-4 * (k % 4), longitude_deg=-93.2 + 1e-4 * (k // 4),
            altitude_m=320 + 7.0 * k, relative_altitude_m=70.0, std_h_m=1.0, std_v_m=2.0, is_rtk=False,
            gimbal=Attitude(yaw_deg=0.0, pitch_deg=-90.0, roll_deg=0.0),
            flight=Attitude(yaw_deg=0.0, pitch_deg=0.0, roll_deg=0.0),
        )  # fmt: skip
        pixels[0, 0] = k
        (folder / f"P{k:02d}.JPG").write_bytes(jpeg_with_tags(pixels, tags))
    survey = Survey(folder, tmp_path / "project")
    diagnosis = found(survey, until="crs")["GNSS contradicts itself"]
    assert "from 320.0 m (P00.JPG) to 425.0 m (P15.JPG)" in diagnosis.cause


def test_photos_over_the_memory_limit(made: Survey, tmp_path: Path):
    settings = changed(PIPELINE.settings, ["features.nfeatures=2000", "workers.max_memory=150MB"])
    with pytest.raises(JaxbaError):
        run_pipeline(made.photos, tmp_path / "project", settings, until="features")
    result = {diagnosis.name: diagnosis for diagnosis in diagnose(tmp_path / "project", PIPELINE)}
    assert len(result["out of memory"].figures["photos"]) == NUM_PHOTOS
    assert "workers.max_memory=150MB allows 150.0 MB" in result["out of memory"].cause
    assert result["stopped"].figures["stage"] == "features"


def test_workers_that_ended_are_named_by_what_they_died_of(made: Survey):
    case, died = (
        recorded(made.project, PIPELINE),
        "its worker process was killed by {} twice: out of memory, or a broken file",
    )
    lost = (
        LeftOut(name="SIM_0001.JPG", reason=died.format("SIGKILL")),
        LeftOut(name="SIM_0002.JPG", reason=died.format("SIGSEGV")),
    )
    case = dataclasses.replace(case, failed={"features": lost})
    memory, crash = over_memory(case), crashed(case)
    assert memory is not None and memory.figures["photos"] == ["SIM_0001.JPG"] and "fewer --workers" in memory.cure
    assert "1 of 8 photos" in memory.cause and "(SIM_0001.JPG)" in memory.cause and "SIM_0002" not in memory.cause
    assert crash is not None and crash.figures["photos"] == ["SIM_0002.JPG"] and "SIGSEGV" in crash.cause


def test_features_over_the_store_limit(made: Survey, tmp_path: Path):
    settings = changed(PIPELINE.settings, ["features.nfeatures=20000", "workers.max_store=1MB"])
    with pytest.raises(JaxbaError):
        run_pipeline(made.photos, tmp_path / "project", settings, until="features")
    result = {diagnosis.name: diagnosis for diagnosis in diagnose(tmp_path / "project", PIPELINE)}
    assert "workers.max_store=1MB allows 1.0 MB" in result["out of disk"].cause


@pytest.mark.parametrize("stage", ["features", "start"])
def test_a_killed_run_is_said_with_what_it_needed(made: Survey, tmp_path: Path, stage: str):
    survey = made.copy(tmp_path)
    shutil.rmtree(survey.project / "stages" / stage)
    run = json.loads((survey.project / "run.json").read_text())
    (survey.project / "run.json").write_text(json.dumps({**run, "stage": stage}))
    (diagnosis,) = diagnose(survey.project, PIPELINE)
    assert diagnosis.name == "killed" and f"killed in stage {stage}" in diagnosis.cause
    assert "GB" in diagnosis.cause and "Run again" in diagnosis.cure


def test_records_of_other_parameters_are_not_believed(made: Survey, tmp_path: Path):
    survey = made.copy(tmp_path)
    toml = survey.project / "jaxba.toml"
    toml.write_text(toml.read_text().replace("max_rounds = 5", "max_rounds = 6"))
    case = recorded(survey.project, PIPELINE)
    assert case.stale == "adjust" and case.done.start is not None and case.done.adjust is None
    assert [diagnosis.name for diagnosis in diagnose(survey.project, PIPELINE)] == ["out of date"]


def test_every_rule_says_nothing_of_a_project_without_stages(made: Survey, tmp_path: Path):
    survey = made.copy(tmp_path)
    shutil.rmtree(survey.project / "stages")
    case = recorded(survey.project, PIPELINE)
    assert [rule(case) for rule in RULES] == [None] * len(RULES)
    with pytest.raises(JaxbaError, match="is no project"):
        diagnose(tmp_path, PIPELINE)


@pytest.mark.parametrize("name", ["caliterra", "copr"])
def test_real_sets_get_sensible_answers(name: str, data_dir: Path, tmp_path: Path):
    survey = Survey(data_dir / "images" / name, tmp_path / "project")
    result = found(survey, until="crs")
    assert list(result) == (["GNSS contradicts itself"] if name == "caliterra" else [])
