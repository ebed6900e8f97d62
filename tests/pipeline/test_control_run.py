"""A whole run with control and check points: what is rerun, what the files and the summary say, the truth."""

import csv
from pathlib import Path

import numpy as np
import pytest
from pyproj import Transformer
from small_survey import Survey

from jaxba._errors import JaxbaError
from jaxba.ba import covariance
from jaxba.geometry import Huber
from jaxba.io import read_loss, read_tile
from jaxba.pipeline import PIPELINE
from jaxba.pipeline._events import Run
from jaxba.report import control_rows
from jaxba.report.document import report_facts
from jaxba.report.verification import Params, verify


@pytest.fixture(scope="module")
def survey(made: Survey, tmp_path_factory: pytest.TempPathFactory) -> Survey:
    return made.copy(tmp_path_factory.mktemp("control"))


@pytest.fixture(scope="module")
def run(survey: Survey) -> Run:
    lists = survey.photos.parent
    return survey.run(gcp=lists / "gcp_list.txt", check=lists / "check_list.txt")


def rows_of(survey: Survey) -> list[dict[str, str]]:
    with open(survey.project / "export" / "control.csv", encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_lists_rerun_what_uses_them_and_nothing_before(run: Run, survey: Survey) -> None:
    assert run.stages_run == ("control", "start", "adjust", "export")
    lists = survey.photos.parent
    again = survey.run(gcp=lists / "gcp_list.txt", check=lists / "check_list.txt", workers=1)
    assert again.stages_run == ()


def test_points_lie_where_the_truth_has_them(run: Run, survey: Survey) -> None:
    truth = np.load(survey.photos.parent / "truth.npz")
    where = dict(zip(truth["target_name"].tolist(), truth["target_in_crs_m"], strict=True))
    rows = rows_of(survey)
    assert [row["role"] for row in rows].count("check") == 5 and len(rows) == len(where)
    off = np.array([[float(row[f"adjusted_{a}"]) for a in "xyz"] - where[row["name"]] for row in rows])
    std = np.array([[float(row[f"std_{a}_m"]) for a in ("east", "north", "up")] for row in rows])
    assert np.abs(off / std).max() < 3.5 and np.sqrt(np.mean(off**2)) < 0.06
    assert {row["suspect"] for row in rows} == {"no"} and all(float(row["mark_rms_px"]) < 1.5 for row in rows)


def test_summary_and_terminal_tell_control_and_check_apart(run: Run) -> None:
    facts = run.facts["control"]
    assert facts["method"] == "adjust" and facts["control"]["num"] == facts["check"]["num"] == 5
    assert {point["role"] for point in facts["points"]} == {"control", "check"}
    # positions of 3 and 5 cm agree with control, and hold the block with it
    assert len(facts["gnss_minus_control_m"]) == 3 and max(map(abs, facts["gnss_minus_control_m"])) < 0.1
    (first, control), (second, check), (third, unseen) = control_rows(facts)
    largest = max((point["detectable_m"][2], point["name"]) for point in facts["points"] if point["role"] == "control")
    assert third == "control" and f"{largest[1]} under {largest[0]:.2f} m in height would not show" in unseen
    assert (first, second) == ("control", "check")
    assert control.startswith("RMS 0.0") and "m east, north, up over 5 points; worst gcp" in control
    assert "worst check" in check
    assert not [text for text in run.facts["adjust"]["findings"] if "ontrol" in text and "contradict" in text]


def test_summary_tells_how_each_kind_of_measurement_scatters(run: Run) -> None:
    found = run.facts["adjust"]["statistics"]
    kinds = {kind["name"]: kind for kind in found["kinds"]}
    assert kinds["marks"]["std"] == pytest.approx(0.3, abs=0.1)  # as they were set
    across, up = kinds["position horizontal"], kinds["position vertical"]
    assert (across["taken_std"], up["taken_std"]) == (0.03, 0.06)
    for kind, true in ((across, 0.03), (up, 0.05)):
        assert abs(np.log(kind["std"] / true)) < 4 * kind["std_share"]
    assert not kinds["control horizontal"]["is_known"] and not kinds["control vertical"]["is_known"]
    assert found["unknowns"][:2] == ["fx", "fy"] and found["correlation"][0][1] > 0.8
    cameras = run.facts["adjust"]["cameras"]
    np.testing.assert_allclose(next(iter(cameras.values()))["std"][:2], found["unknown_std"][:2])


def test_tile_holds_the_control_points_with_their_marks(run: Run, survey: Survey) -> None:
    tile = survey.project / "export" / "tile.npz"
    problem, loss = read_tile(tile), read_loss(tile)
    prior = problem.prior("control")
    assert prior is not None
    block = run.done.adjust.block
    assert problem.num_points == block.num_points + 5
    marks = np.asarray(problem.observations.point_index) >= block.num_points
    std_px = run.done.adjust.mark_std_px
    assert 0.2 < std_px < 0.5  # they were set with 0.3
    assert marks.sum() >= 10 and set(np.asarray(problem.observations.std_px)[marks]) == {std_px}
    assert isinstance(loss, Huber)
    found = covariance(problem, loss=loss)  # the tile's sigmas are the run's
    std_m = np.sqrt(np.einsum("nii->ni", found.centers))
    np.testing.assert_allclose(std_m, run.done.adjust.position_std_m, rtol=0.01)
    np.testing.assert_allclose(problem.position_offset[0], run.done.adjust.control.gnss_minus_control_m, atol=0.01)
    adjusted = run.done.adjust.control.adjusted_m[~run.done.control.control.is_check]
    # the tile starts at the marks' intersection, the adjusted points are held by the survey too
    np.testing.assert_allclose(np.asarray(problem.points)[block.num_points :], adjusted, atol=0.1)


def test_verification_passes_with_control_in_the_adjustment_and_fitted_afterwards(
    run: Run, survey: Survey, tmp_path: Path
) -> None:
    def failed(of: Survey) -> list[str]:
        return [check.text for check in verify(of.project, PIPELINE, Params()) if check.state != "ok"]  # nor skipped

    assert failed(survey) == []
    lists = survey.photos.parent
    fitted = survey.copy(tmp_path)
    fitted.run("control.method=affine", gcp=lists / "gcp_list.txt", check=lists / "check_list.txt")
    assert failed(fitted) == []


def test_the_report_tells_of_control_what_the_files_and_the_summary_do(run: Run, survey: Survey) -> None:
    facts = report_facts(survey.project, PIPELINE)
    found = facts["control"]
    rows, points = rows_of(survey), {point["name"]: point for point in run.facts["control"]["points"]}
    assert (found["num_control"], found["num_check"], len(rows)) == (5, 5, 10)
    for row, point in zip(rows, found["points"], strict=True):
        assert point["name"] == row["name"] and point["role"] == row["role"]
        assert [point["adjusted"][k] for k in range(3)] == pytest.approx(
            [float(row[f"adjusted_{a}"]) for a in "xyz"], abs=1e-4
        )
        assert point["residual_m"] == pytest.approx(points[row["name"]]["residual_m"])
        assert point["survey_std_m"] == [0.02, 0.02, 0.03]
    of_checks = np.array([point["residual_m"] for point in found["points"] if point["role"] == "check"])
    np.testing.assert_allclose(found["check_rms_m"], np.sqrt(np.mean(of_checks**2, axis=0)), rtol=1e-9)
    up = next(row for row in facts["accuracy"]["rows"] if row["name"] == "up")
    assert up["product_m"] == pytest.approx(np.hypot(found["check_rms_m"][2], 0.03)) and up["num"] == 5
    lights = {light["name"]: light for light in facts["quality"]}
    assert lights["Control points"]["state"] == lights["Check points"]["state"] == "good"
    east, north, up_m = found["check_rms_m"]
    assert lights["Check points"]["value"] == f"{np.hypot(east, north):.3f} m across, {up_m:.3f} m up"
    worst = int(np.argmax(np.linalg.norm(of_checks, axis=1)))
    assert f"Worst is {found['points'][5 + worst]['name']}:" in lights["Check points"]["text"]
    assert facts["sigmas"]["scope"] == "absolute"
    assert facts["sigmas"]["absolute_m"] == pytest.approx(np.hypot(found["check_rms_m"], [0.02, 0.02, 0.03]))
    told = zip(facts["positions"]["common_m"] or [None] * 3, run.facts["control"]["gnss_minus_control_m"], strict=True)
    assert all(common is None or common == -offset for common, offset in told)
    assert any("gcp_list.txt and check_list.txt do not say what they are above" in text for text in facts["findings"])
    # redundancy numbers of the points, by the sizes of errors that show, are those of the adjustment's rows
    kinds = {kind["name"]: kind["redundancy"] for kind in facts["statistics"]["kinds"]}
    numbers = np.array([point["redundancy"] for point in found["points"] if point["role"] == "control"])
    assert numbers[:, :2].sum() == pytest.approx(kinds["control horizontal"], rel=0.02)
    assert numbers[:, 2].sum() == pytest.approx(kinds["control vertical"], rel=0.02)
    assert sum(kinds.values()) == pytest.approx(facts["statistics"]["redundancy"], abs=1e-3)


def test_a_list_that_is_not_there_is_named(survey: Survey, tmp_path: Path) -> None:
    with pytest.raises(JaxbaError, match=r"none.txt: there is no such file; give a gcp_list.txt or CSV"):
        survey.run(gcp=tmp_path / "none.txt", until="control")


def test_scale_bars_take_part_and_reach_the_summary_and_the_files(survey: Survey, tmp_path: Path) -> None:
    truth = np.load(survey.photos.parent / "truth.npz")
    to_earth = Transformer.from_crs("EPSG:32615", "EPSG:4978", always_xy=True)  # over a few metres heights are as good
    targets = dict(zip(truth["target_name"].tolist(), truth["target_in_crs_m"], strict=True))
    one, two, three = (np.array(to_earth.transform(*targets[f"gcp0{k}"])) for k in (1, 2, 3))
    own = survey.copy(tmp_path)
    lines = (survey.photos.parent / "gcp_list.txt").read_text().splitlines()
    marks = [f"NaN NaN NaN {' '.join(line.split()[3:])}" for line in lines[1:]]
    (tmp_path / "marks.txt").write_text("\n".join([lines[0], *marks]))
    longer = np.linalg.norm(two - three) + 0.5
    bars = [f"gcp01,gcp02,{np.linalg.norm(one - two):.4f},0.003", f"gcp02,gcp03,{longer:.4f},0.003"]
    (tmp_path / "bars.csv").write_text("\n".join(["first,second,length_m,std_m", *bars]))
    run = own.run(gcp=tmp_path / "marks.txt", bars=tmp_path / "bars.csv")
    good, wrong = run.facts["bars"]
    assert good["used"] and not good["set_aside"] and abs(good["residual_m"]) < 0.01
    assert wrong["set_aside"] and wrong["residual_m"] == pytest.approx(-0.5, abs=0.05)
    assert any(text.startswith("Scale bar gcp02-gcp03 contradicts") for text in run.facts["adjust"]["findings"])
    assert "control" not in run.facts
    kinds = {kind["name"]: kind for kind in run.facts["adjust"]["statistics"]["kinds"]}
    assert kinds["marks"]["taken_std"] is None  # nobody states it
    with open(own.project / "export" / "bars.csv", encoding="utf-8", newline="") as file:
        assert [row["used"] for row in csv.DictReader(file)] == ["yes", "no"]
    problem = read_tile(own.project / "export" / "tile.npz")
    assert problem.num_bar_ends == 2 and problem.num_points == run.done.adjust.block.num_points + 2
    again = own.run(gcp=tmp_path / "marks.txt", bars=tmp_path / "bars.csv")
    assert again.stages_run == ()
    assert report_facts(own.project, PIPELINE)["bars"]["bars"] == run.facts["bars"]
    assert [check.text for check in verify(own.project, PIPELINE, Params()) if check.state != "ok"] == []
