"""What is found on an adjusted block: each finding with its figures, and nothing where there is none."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxba.report import sentences
from jaxba.scene import AssumedDatum, Block, Finding, LeftOut, PrunedEdge, Reference
from jaxba.sfm import Adjusted, Settings, Uncertainty, adjust, findings, gnss_fit, height_above_ground, with_points
from jaxba.sfm._measured import position_scale
from jaxba.simulation.staged import Simulated, simulate, true_block


@pytest.fixture(scope="module")
def survey() -> Simulated:
    return simulate(12, seed=6, points_per_image=40.0, gnss_std_m=(0.03, 0.03, 0.06))


@pytest.fixture(scope="module")
def adjusted(survey: Simulated) -> Adjusted:
    """One round for its solution, then the true block: the findings speak of the block alone."""
    s = survey
    found = adjust(s.block, s.tracks, s.view_graph, s.reference, s.photos, Settings(max_rounds=1, max_nfev=100))
    block = with_points(true_block(s), s.tracks, min_angle_rad=0.02, max_error_px=2.0)
    return replace(
        found,
        block=block,
        error_px=np.full(block.num_observations, 0.5),
        medians_px=(0.5,),
        converged=True,
        position_scale=np.ones(3),
        notes=(),
    )


def _findings(
    adjusted: Adjusted, survey: Simulated, reference: Reference | None = None, focal_std_px: float = 5.0
) -> dict[str, dict[str, Any]]:
    block, reference = adjusted.block, reference or survey.reference
    std = np.zeros(block.camera_parameters.shape)
    std[:, :2] = focal_std_px
    sigmas = Uncertainty(np.full((block.num_images, 3), 0.02), np.full((block.num_points, 3), 0.05), std, 1.0)
    fit = gnss_fit(block, reference)
    return _by_kind(findings(adjusted, survey.block, sigmas, fit, reference, survey.photos))


def _by_kind(found: Sequence[Finding]) -> dict[str, dict[str, Any]]:
    """Return the figures by kind; each finding can be told, and none of these blocks has two of a kind."""
    assert all(sentences(found)) and len({finding.kind for finding in found}) == len(found)
    return {finding.kind: dict(finding.figures) for finding in found}


def _with_block(adjusted: Adjusted, **changes: object) -> Adjusted:
    return replace(adjusted, block=replace(adjusted.block, **changes))  # type: ignore[arg-type]


def test_a_good_block_has_none(adjusted: Adjusted, survey: Simulated) -> None:
    above = replace(survey.reference, height_above_ground_m=height_above_ground(adjusted.block))
    assert _findings(adjusted, survey, above) == {}


def test_height_above_ground_is_that_of_the_flight(adjusted: Adjusted) -> None:
    assert np.nanmedian(height_above_ground(adjusted.block)) == pytest.approx(100.0, abs=5.0)  # 20 m of relief


def test_focal_length_that_contradicts_the_measured_height_is_reported(adjusted: Adjusted, survey: Simulated) -> None:
    measured = np.nanmedian(height_above_ground(adjusted.block)) / 1.15
    above = replace(survey.reference, height_above_ground_m=np.full(12, measured))
    found = _findings(adjusted, survey, above)["focal and height"]
    assert found["looks"] == "down from one height" and found["parameter"] == "fx" and found["std_px"] == 5.0
    assert found["above_take_off_m"] == measured and found["above_ground_m"] == pytest.approx(1.15 * measured)
    assert found["focal_px"] == adjusted.block.camera_parameters[0, 0] and found["height_m"] == found["above_ground_m"]


def test_a_focal_length_that_is_not_determined_is_reported(adjusted: Adjusted, survey: Simulated) -> None:
    found = _findings(adjusted, survey, focal_std_px=182.6)["focal and height"]
    assert found["std_px"] / found["focal_px"] == pytest.approx(0.05, abs=5e-4)
    assert "above_take_off_m" not in found  # the flight's record tells nothing


def test_wrong_positions_are_named_and_left_out_of_the_rms(adjusted: Adjusted, survey: Simulated) -> None:
    xyz = survey.reference.xyz_m.copy()
    xyz[[3, 8]] += [[2.0, 0, 0], [0, 0, -4.0]]
    wrong = replace(survey.reference, xyz_m=xyz)
    fit = gnss_fit(adjusted.block, wrong)
    assert np.flatnonzero(fit.is_outlier).tolist() == [3, 8] and fit.num == 10
    assert fit.rms_m is not None and max(fit.rms_m) < 0.1
    found = _findings(adjusted, survey, wrong)["positions contradict"]
    assert found["names"] == ["DJI_0008.JPG", "DJI_0003.JPG"] and found["measured"] == 12
    by_chance = np.random.default_rng(0).normal(size=(20_000, 12))
    robust = 1.4826 * np.median(np.abs(by_chance - np.median(by_chance, axis=1, keepdims=True)), axis=1)
    over = np.abs(by_chance - np.median(by_chance, axis=1, keepdims=True)) / robust[:, None]
    assert np.mean(over > found["sigmas"]) == pytest.approx(1e-3, rel=0.3)  # of twelve, the robust sigma is rough
    np.testing.assert_array_equal(found["residual_m"], fit.residual_m[[8, 3]])  # the farthest off first
    np.testing.assert_allclose(found["residual_m"], [[0.0, 0, 4.0], [-2.0, 0, 0]], atol=0.25)  # 4 sigmas of 0.06 m


def test_positions_that_scatter_more_than_they_claim_are_reported(adjusted: Adjusted, survey: Simulated) -> None:
    xyz = survey.reference.xyz_m.copy()
    xyz[:, 2] += 0.24 * np.random.default_rng(1).normal(size=12)
    wide = replace(survey.reference, xyz_m=xyz)
    found = _findings(replace(adjusted, position_scale=np.array([1.0, 1.0, 4.0])), survey, wide)["positions scatter"]
    assert found["axes"] == ["up"] and found["stated_m"] == [0.06]
    assert found["scale_m"] == [gnss_fit(adjusted.block, wide).scale_m[2]]


def test_scatter_within_chance_is_no_finding(adjusted: Adjusted, survey: Simulated) -> None:
    found = _findings(replace(adjusted, position_scale=np.array([1.6, 1.1, 1.6])), survey)
    assert "positions scatter" not in found


def test_heights_that_drift_are_reported(adjusted: Adjusted, survey: Simulated) -> None:
    xyz = survey.reference.xyz_m.copy()
    xyz[:, 2] += np.linspace(0, 80, 12)
    found = _findings(adjusted, survey, replace(survey.reference, xyz_m=xyz))["heights drift"]
    assert found["drift_m"] == pytest.approx(80.0, abs=0.5) and found["share"] > 0.99  # heights have 0.06 m


def test_heights_that_are_not_used_are_reported(adjusted: Adjusted, survey: Simulated) -> None:
    std = survey.reference.std_m.copy()
    std[:, 2] = np.inf
    assert _findings(adjusted, survey, replace(survey.reference, std_m=std))["no heights"] == {}


def test_parameters_at_a_bound_and_far_from_the_photos_are_reported(adjusted: Adjusted, survey: Simulated) -> None:
    parameters = adjusted.block.camera_parameters.copy()
    parameters[0, [0, 2, 4]] *= [1.2, 1.1, 0.0]
    parameters[0, 4] = -0.5
    found = _findings(_with_block(adjusted, camera_parameters=parameters), survey)
    bound, focal, center = (found[kind] for kind in ("at bound", "focal moved", "principal point off"))
    assert bound == {"camera": "camera 0", "parameter": "k1", "value": -0.5, "low": -0.5, "high": 0.5}
    assert (focal["parameter"], focal["value"]) == ("fx", parameters[0, 0])
    assert focal["before"] == survey.block.camera_parameters[0, 0]
    assert (center["parameter"], center["value"]) == ("cx", parameters[0, 2])
    assert center["middle"] == survey.photos[0].width_px / 2


def test_images_with_few_points_are_named(adjusted: Adjusted, survey: Simulated) -> None:
    block: Block = adjusted.block
    first = np.flatnonzero(block.observation_image == 2)[7:]
    keep = np.ones(block.num_observations, bool)
    keep[first] = False
    changes = {name: getattr(block, name)[keep] for name in
               ("observation_image", "observation_point", "observation_xy_px")}  # fmt: skip
    found = _findings(_with_block(adjusted, **changes), survey)["few points"]
    assert found == {"names": ["DJI_0002.JPG"], "points": [7], "least": 20}


def test_what_the_rounds_left_out_is_told(adjusted: Adjusted, survey: Simulated) -> None:
    left = replace(
        adjusted,
        pruned=(
            PrunedEdge(name="a.jpg, b.jpg", num_matches=60, median_px=5.1, limit_px=3.0),
            PrunedEdge(name="b.jpg, c.jpg", num_matches=45, median_px=9.2, limit_px=3.0),
        ),
        lost=(LeftOut(name="c.jpg", reason="fewer than 3 of its features fit"),),
    )
    found = _findings(left, survey)
    assert found["edges left out"] == {
        "names": ["b.jpg, c.jpg", "a.jpg, b.jpg"], "matches": [45, 60], "median_px": [9.2, 5.1], "limit_px": 3.0,
    }  # fmt: skip
    assert found["image lost"] == {"name": "c.jpg", "reason": "fewer than 3 of its features fit"}


def test_sigmas_of_a_single_receiver_are_explained(adjusted: Adjusted, survey: Simulated) -> None:
    plain = replace(survey.reference, std_m=np.full((12, 3), 3.0))
    assert _findings(adjusted, survey, plain)["common offset"] == {
        "median_m": 0.02, "axes": ["east", "north", "up"], "receiver_std_m": [3.0] * 3,
    }  # fmt: skip


def test_position_sigmas_are_those_of_the_axes_that_were_measured(adjusted: Adjusted, survey: Simulated) -> None:
    without_heights = replace(survey.reference, std_m=np.full(survey.reference.std_m.shape, (3.0, 3.0, np.inf)))
    sigmas = Uncertainty(
        np.full((adjusted.block.num_images, 3), (0.02, 0.03, np.nan)),
        np.full((adjusted.block.num_points, 3), (0.05, 0.05, np.nan)),
        np.zeros(adjusted.block.camera_parameters.shape),
        1.0,
    )
    fit = gnss_fit(adjusted.block, without_heights)
    found = _by_kind(findings(adjusted, survey.block, sigmas, fit, without_heights, survey.photos))
    assert found["common offset"] == {"median_m": 0.03, "axes": ["east", "north"], "receiver_std_m": [3.0] * 2}
    assert "nan" not in str(found)


def test_a_finding_that_fails_costs_nothing_but_itself(
    adjusted: Adjusted, survey: Simulated, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*arguments: object) -> None:
        raise IndexError("index 7 is out of bounds")

    monkeypatch.setattr("jaxba.sfm._findings._scatter", fail)
    found = _findings(
        adjusted, survey, replace(survey.reference, height_above_ground_m=height_above_ground(adjusted.block))
    )
    assert list(found) == ["note"]
    assert "Scatter of positions could not be measured" in found["note"]["text"] and "index 7" in found["note"]["text"]


def test_sigmas_of_positions_stand_unless_their_scatter_contradicts_them(survey: Simulated) -> None:
    block, rng = true_block(survey), np.random.default_rng(3)
    centers = block.centers_m

    def scales(noise_m: float, std_m: float, draws: int = 200) -> np.ndarray:
        std = np.full((12, 3), std_m)
        positions = (replace(survey.reference, xyz_m=centers + noise_m * rng.normal(size=(12, 3)), std_m=std)
                     for _ in range(draws))  # fmt: skip
        return np.array([position_scale(block, reference) for reference in positions])

    assert np.mean(scales(0.02, 0.02) == 1) > 0.98
    worse = scales(0.10, 0.02)
    # nothing has been fitted here but their mean, where a similarity takes 2 degrees of freedom across and 3 up; what
    # so many tell is itself uncertain, as Student's t is
    known = np.sqrt(11 / (12 - np.array([2, 2, 3]) - 2))
    np.testing.assert_allclose(np.sqrt(np.mean(worse**2, axis=0)), 5.0 * known, rtol=0.05)
    plain = scales(1.5, 3.0)
    assert (plain != 1).all()
    np.testing.assert_allclose(np.sqrt(np.mean(plain**2, axis=0)), 0.5 * known, rtol=0.05)
    apart = replace(survey.reference, xyz_m=centers + 0.02 * rng.normal(size=(12, 3)), std_m=np.full((12, 3), 0.02))
    apart.xyz_m[4] += 30.0
    assert (position_scale(block, apart) < 3).all()  # one fix that is off does not make the others worse


@pytest.mark.parametrize(
    ("turned", "about", "angle_deg", "quarters"),
    [
        ([3, 4, 8], (0, 0, 1), 180.0, 2),
        ([3, 4, 8], (0, 0, 1), -90.0, 3),
        (range(12), (0, 0, 1), 90.0, 1),
        ([5], (1, 0, 0), 60.0, 0),
        ([5], (0, 0, 1), 60.0, 0),
    ],
)
def test_attitudes_that_no_gimbal_errs_by_are_named_with_the_turn_of_the_picture(
    adjusted: Adjusted, survey: Simulated, turned: Sequence[int], about: tuple, angle_deg: float, quarters: int
) -> None:
    # the camera's frame of the tags against that of the block, in matrices: a picture that was turned after the flight
    measured = Rotation.from_quat(adjusted.block.quaternion, scalar_first=True).as_matrix()
    for row in turned:
        angle = np.radians(angle_deg)
        measured[row] = Rotation.from_rotvec(-angle * np.array(about, float)).as_matrix() @ measured[row]
    quaternion = Rotation.from_matrix(measured).as_quat(scalar_first=True)
    std = np.full((12, 3), np.radians([2.0, 2.0, 5.0]))
    found = _findings(adjusted, survey, replace(survey.reference, quaternion=quaternion, attitude_std_rad=std))
    of = found["attitudes contradict"]
    assert of["names"] == [survey.photos[row].name for row in turned] and of["measured"] == 12
    np.testing.assert_allclose(of["turn_deg"], abs(angle_deg), atol=1.0)
    assert of["quarter_turns"] == quarters


@pytest.mark.parametrize(("angle_deg", "yaw_std_deg"), [(40.0, 5.0), (170.0, 180.0)])
def test_attitudes_within_their_sigmas_or_a_bad_compass_are_no_finding(
    adjusted: Adjusted, survey: Simulated, angle_deg: float, yaw_std_deg: float
) -> None:
    turn = Rotation.from_rotvec([0.0, 0.0, np.radians(angle_deg)])
    quaternion = (turn * Rotation.from_quat(adjusted.block.quaternion, scalar_first=True)).as_quat(scalar_first=True)
    std = np.full((12, 3), np.radians([2.0, 2.0, yaw_std_deg]))
    found = _findings(adjusted, survey, replace(survey.reference, quaternion=quaternion, attitude_std_rad=std))
    assert "attitudes contradict" not in found


def test_heights_whose_datum_was_assumed_are_told(adjusted: Adjusted, survey: Simulated) -> None:
    assumed = AssumedDatum(("photos", "gcp_list.txt"), "unknown")
    reference = replace(survey.reference, assumed_datum=assumed)
    found = _findings(adjusted, survey, reference)
    assert found["height datum assumed"] == {"of": ["photos", "gcp_list.txt"], "datum": "unknown"}
