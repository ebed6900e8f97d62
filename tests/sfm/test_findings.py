"""What a surveyor is told of an adjusted block: each finding with its figures, and silence where there is none."""

from dataclasses import replace

import numpy as np
import pytest
from simulated import Simulated, simulate, true_block

from jaxba.report import sentences
from jaxba.scene import Block, LeftOut, Reference
from jaxba.sfm import Adjusted, Settings, Uncertainty, adjust, findings, gnss_fit, height_above_ground, with_points


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
) -> str:
    block, reference = adjusted.block, reference or survey.reference
    std = np.zeros(block.camera_parameters.shape)
    std[:, :2] = focal_std_px
    sigmas = Uncertainty(np.full((block.num_images, 3), 0.02), np.full((block.num_points, 3), 0.05), std, 1.0)
    fit = gnss_fit(block, reference)
    return "\n".join(sentences(findings(adjusted, survey.block, sigmas, fit, reference, survey.photos)))


def _with_block(adjusted: Adjusted, **changes: object) -> Adjusted:
    return replace(adjusted, block=replace(adjusted.block, **changes))  # type: ignore[arg-type]


def test_a_good_block_has_none(adjusted: Adjusted, survey: Simulated) -> None:
    above = replace(survey.reference, height_above_ground_m=height_above_ground(adjusted.block))
    assert _findings(adjusted, survey, above) == ""


def test_height_above_ground_is_that_of_the_flight(adjusted: Adjusted) -> None:
    assert np.nanmedian(height_above_ground(adjusted.block)) == pytest.approx(100.0, abs=5.0)  # 20 m of relief


def test_focal_length_that_contradicts_the_measured_height_is_reported(adjusted: Adjusted, survey: Simulated) -> None:
    measured = np.nanmedian(height_above_ground(adjusted.block)) / 1.15
    above = replace(survey.reference, height_above_ground_m=np.full(12, measured))
    text = _findings(adjusted, survey, above)
    assert "Focal length and height trade off (all photos look straight down from one height)" in text
    assert f"{measured:.1f} m above the take-off point" in text and "(+15%)" in text
    assert f"a focal length of {3652 / 1.15:.0f} px would agree" in text and "Hold the focal length" in text


def test_a_focal_length_that_is_not_determined_is_reported(adjusted: Adjusted, survey: Simulated) -> None:
    text = _findings(adjusted, survey, focal_std_px=182.6)
    assert "(5.0%), which alone makes the height above ground" in text


def test_wrong_positions_are_named_and_left_out_of_the_rms(adjusted: Adjusted, survey: Simulated) -> None:
    xyz = survey.reference.xyz_m.copy()
    xyz[[3, 8]] += [[2.0, 0, 0], [0, 0, -4.0]]
    wrong = replace(survey.reference, xyz_m=xyz)
    fit = gnss_fit(adjusted.block, wrong)
    assert np.flatnonzero(fit.is_outlier).tolist() == [3, 8] and fit.num == 10
    assert fit.rms_m is not None and max(fit.rms_m) < 0.1
    text = _findings(adjusted, survey, wrong)
    assert "2 measured positions of 12" in text and "DJI_0003.JPG (-2.0, " in text and "DJI_0008.JPG" in text


def test_positions_that_scatter_more_than_they_claim_are_reported(adjusted: Adjusted, survey: Simulated) -> None:
    xyz = survey.reference.xyz_m.copy()
    xyz[:, 2] += 0.24 * np.random.default_rng(1).normal(size=12)
    wide = replace(survey.reference, xyz_m=xyz)
    text = _findings(replace(adjusted, position_scale=np.array([1.0, 1.0, 4.0])), survey, wide)
    assert "scatter more than their sigmas say (up " in text and "instead of 0.06 m" in text


def test_scatter_within_chance_is_no_finding(adjusted: Adjusted, survey: Simulated) -> None:
    text = _findings(replace(adjusted, position_scale=np.array([1.6, 1.1, 1.6])), survey)
    assert "scatter more" not in text


def test_heights_that_drift_are_reported(adjusted: Adjusted, survey: Simulated) -> None:
    xyz = survey.reference.xyz_m.copy()
    xyz[:, 2] += np.linspace(0, 80, 12)
    text = _findings(adjusted, survey, replace(survey.reference, xyz_m=xyz))
    assert "Measured heights drift against the photos by 80" in text


def test_heights_that_are_not_used_are_reported(adjusted: Adjusted, survey: Simulated) -> None:
    std = survey.reference.std_m.copy()
    std[:, 2] = np.inf
    assert "No measured height is used" in _findings(adjusted, survey, replace(survey.reference, std_m=std))


def test_parameters_at_a_bound_and_far_from_the_photos_are_reported(adjusted: Adjusted, survey: Simulated) -> None:
    parameters = adjusted.block.camera_parameters.copy()
    parameters[0, [0, 2, 4]] *= [1.2, 1.1, 0.0]
    parameters[0, 4] = -0.5
    text = _findings(_with_block(adjusted, camera_parameters=parameters), survey)
    assert "k1 is at its bound (-0.5, allowed -0.5 to 0.5)" in text
    assert "fx moved from" in text and "principal point's cx" in text


def test_images_with_few_points_are_named(adjusted: Adjusted, survey: Simulated) -> None:
    block: Block = adjusted.block
    first = np.flatnonzero(block.observation_image == 2)[7:]
    keep = np.ones(block.num_observations, bool)
    keep[first] = False
    changes = {name: getattr(block, name)[keep] for name in
               ("observation_image", "observation_point", "observation_xy_px")}  # fmt: skip
    text = _findings(_with_block(adjusted, **changes), survey)
    assert "1 image with fewer than 20 points" in text and "DJI_0002.JPG (7 points)" in text


def test_what_the_rounds_left_out_is_told(adjusted: Adjusted, survey: Simulated) -> None:
    left = replace(
        adjusted,
        pruned=(LeftOut(name="a.jpg, b.jpg", reason="their 60 matches are off by 5.1 px"),),
        lost=(LeftOut(name="c.jpg", reason="fewer than 3 of its features fit"),),
    )
    text = _findings(left, survey)
    assert "Edge left out: a.jpg, b.jpg: their 60 matches" in text
    assert "Image lost in the adjustment: c.jpg: fewer than 3" in text


def test_sigmas_of_a_single_receiver_are_explained(adjusted: Adjusted, survey: Simulated) -> None:
    plain = replace(survey.reference, std_m=np.full((12, 3), 3.0))
    assert "up to their own sigma of 3.0 m horizontally" in _findings(adjusted, survey, plain)


def test_position_sigmas_are_those_of_the_axes_that_were_measured(adjusted: Adjusted, survey: Simulated) -> None:
    without_heights = replace(survey.reference, std_m=np.full(survey.reference.std_m.shape, (3.0, 3.0, np.inf)))
    sigmas = Uncertainty(
        np.full((adjusted.block.num_images, 3), (0.02, 0.03, np.nan)),
        np.full((adjusted.block.num_points, 3), (0.05, 0.05, np.nan)),
        np.zeros(adjusted.block.camera_parameters.shape),
        1.0,
    )
    fit = gnss_fit(adjusted.block, without_heights)
    text = "\n".join(sentences(findings(adjusted, survey.block, sigmas, fit, without_heights, survey.photos)))
    assert "Position sigmas (median 0.03 m)" in text and "nan" not in text
