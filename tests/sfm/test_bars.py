"""Scale bars in the adjustment in rounds: they hold the scale, a wrong one is named, a free block takes theirs."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxba import sfm
from jaxba.geometry import umeyama
from jaxba.report import bar_facts, bar_rows, sentences
from jaxba.scene import BarFit, Block, Control, Reference, ScaleBars
from jaxba.simulation.staged import Simulated, measured_anew, simulate, spread_control

SETTINGS = sfm.Settings(max_rounds=2)
STD_M = 0.003


@pytest.fixture(scope="module")
def survey() -> Simulated:
    """Positions of a single receiver, which leave a percent of the scale open."""
    return measured_anew(simulate(12, seed=4), np.random.default_rng(5), (3.0, 3.0, 5.0))


@pytest.fixture(scope="module")
def ends(survey: Simulated) -> Control:
    """Six marked points; their coordinates serve the tests alone."""
    return spread_control(survey, 6, 0, np.random.default_rng(2), std_m=(1e-9,) * 3)


def bars_of(ends: Control, longer_m: tuple[float, ...] = (0.0, 0.0, 0.0), check: int | None = None) -> ScaleBars:
    """Three bars between the ends, some of them measured too long."""
    first, second = np.array([0, 2, 4]), np.array([1, 3, 5])
    length_m = np.linalg.norm(ends.xyz_m[first] - ends.xyz_m[second], axis=1) + longer_m
    is_check = np.arange(3) == check
    noise = STD_M * np.random.default_rng(3).normal(size=3)
    unknown = dataclasses.replace(ends, xyz_m=np.zeros((6, 3)), std_m=np.full((6, 3), np.inf))
    return ScaleBars(
        ends=unknown,
        first=first,
        second=second,
        length_m=length_m + noise,
        std_m=np.full(3, STD_M),
        is_check=is_check,
    )


def adjusted(survey: Simulated, bars: ScaleBars, reference: Reference | None = None, **changes: object) -> sfm.Adjusted:
    start = dataclasses.replace(survey.block, **changes)  # type: ignore[arg-type]
    block = sfm.with_points(start, survey.tracks, min_angle_rad=0.02, max_error_px=20.0)
    reference = survey.reference if reference is None else reference
    return sfm.adjust(block, survey.tracks, survey.view_graph, reference, survey.photos, SETTINGS, bars=bars)


def adjusted_without_a_place(survey: Simulated, bars: ScaleBars) -> sfm.Adjusted:
    """Adjust the survey as photos alone have it, at a fortieth of its size."""
    nowhere = dataclasses.replace(
        survey.reference,
        xyz_m=np.full((12, 3), np.nan),
        std_m=np.full((12, 3), np.nan),
        is_used=np.zeros(12, bool),
        quaternion=np.full((12, 4), np.nan),
    )
    small = {"translation_m": survey.block.translation_m / 40.0, "is_georeferenced": False}
    return adjusted(survey, bars, nowhere, **small)


def scale_error(survey: Simulated, block: Block) -> float:
    onto = umeyama(block.points_m, np.asarray(survey.survey.truth.points)[block.track_index])
    assert onto is not None
    return 1 / onto.scale - 1


@pytest.fixture(scope="module")
def held(survey: Simulated, ends: Control) -> sfm.Adjusted:
    return adjusted(survey, bars_of(ends))


def test_bars_hold_the_scale_and_their_sigmas_are_true(survey: Simulated, ends: Control, held: sfm.Adjusted) -> None:
    bars, fit = bars_of(ends), held.bars
    assert fit.is_used.all() and not fit.is_set_aside.any()
    # the marks place an end to two centimetres, three of them hold the block's scale
    assert (np.abs(fit.residual_m) < 4 * STD_M).all() and (np.abs(fit.over_sigma) < 3.29).all()
    assert (fit.distance_std_m < STD_M).all()
    none = adjusted(survey, ScaleBars.nothing())
    assert abs(scale_error(survey, held.block)) < 2e-4 and abs(scale_error(survey, none.block)) > 1e-2
    sigmas, bare = sfm.uncertainty(held, survey.reference), sfm.uncertainty(none, survey.reference)
    off_m = held.block.centers_m - np.asarray(survey.survey.truth.poses.center)
    assert sigmas.covariance is not None and len(sigmas.point_std_m) == held.block.num_points
    squared = np.einsum("ni,nij,nj->n", off_m, np.linalg.inv(sigmas.covariance.centers), off_m)
    assert np.mean(squared) / 3 < 3
    assert np.mean(sigmas.position_std_m) < np.mean(bare.position_std_m)
    assert sfm.bar_findings(bars, fit, held.block) == ()
    rows = bar_rows(bar_facts(bars, fit))
    assert len(rows) == 1 and "over 3 bars used; worst gcp0" in rows[0][1]


def test_a_wrong_bar_is_set_aside_and_no_other(survey: Simulated, ends: Control, held: sfm.Adjusted) -> None:
    bars = bars_of(ends, (0.0, 0.4, 0.0))
    found = adjusted(survey, bars)
    assert found.bars.is_set_aside.tolist() == [False, True, False] == (~found.bars.is_used).tolist()
    assert found.bars.residual_m[1] == pytest.approx(-0.4, abs=0.1)
    assert abs(scale_error(survey, found.block)) < 2e-4
    said = sentences(sfm.bar_findings(bars, found.bars, found.block))
    assert len(said) == 1 and said[0].startswith("Scale bar gcp02-gcp03 contradicts the block: there it is 0.")
    assert "m shorter than the" in said[0] and "It was set aside." in said[0]


@pytest.mark.parametrize("times", [1.1, 3.28])
def test_a_single_bar_is_tested_before_it_may_pull(survey: Simulated, ends: Control, times: float) -> None:
    every = bars_of(ends)
    one = dataclasses.replace(
        every,
        **{name: getattr(every, name)[:1] for name in ("first", "second", "std_m", "is_check")},
        length_m=every.length_m[:1] * times,
    )
    found = adjusted(survey, one)
    assert found.bars.is_set_aside.all() and not found.bars.is_unclear.any()
    assert abs(scale_error(survey, found.block)) < 0.05  # as positions have it
    assert len(sfm.bar_findings(one, found.bars, found.block)) == 1
    assert "1 bar set aside" in bar_rows(bar_facts(one, found.bars))[0][1]


def test_bars_that_pull_untested_are_told(survey: Simulated, ends: Control, held: sfm.Adjusted) -> None:
    without = dataclasses.replace(held.bars, distance_std_m=np.full(3, np.nan), over_sigma=np.full(3, np.nan))
    said = sentences(sfm.bar_findings(bars_of(ends), without, held.block))
    assert len(said) == 1 and "gcp04-gcp05 hold the block and were not tested" in said[0]


def test_a_bar_at_a_check_point_is_compared_alone(survey: Simulated, ends: Control) -> None:
    bars = bars_of(ends, (0.0, 0.0, 0.5), check=2)
    found = adjusted(survey, bars)
    assert found.bars.is_used.tolist() == [True, True, False] and not found.bars.is_set_aside.any()
    assert found.bars.over_sigma[2] < -3.29 and np.isfinite(found.bars.distance_std_m).all()
    assert "It took no part." in sentences(sfm.bar_findings(bars, found.bars, found.block))[0]
    assert [row[1].split(" over ")[1].split(";")[0] for row in bar_rows(bar_facts(bars, found.bars))] == [
        "2 bars used",
        "1 bar compared alone",
    ]


def test_a_block_without_a_place_takes_the_scale_of_its_bars(survey: Simulated, ends: Control) -> None:
    bars = bars_of(ends)
    found = adjusted_without_a_place(survey, bars)
    assert found.bars.is_used.all() and abs(scale_error(survey, found.block)) < 2e-4
    assert (np.abs(found.bars.residual_m) < 5 * STD_M).all()
    said = sentences(sfm.bar_findings(bars, found.bars, found.block))
    assert said == ["3 scale bars told the scale of a block that has no place on earth: it is in metres."]
    bare = adjusted_without_a_place(survey, ScaleBars.nothing())
    assert scale_error(survey, bare.block) < -0.9
    # sigmas are those of the shape, so the truth is brought onto it by place and rotation alone
    sigmas, none = (sfm.uncertainty(of, survey.reference) for of in (found, bare))
    assert none.why_not is not None and np.isnan(none.position_std_m).all() and not none.is_of_shape
    assert sigmas.why_not is None and sigmas.is_of_shape and sigmas.covariance is not None
    truth, block = survey.survey.truth, found.block
    true_m, middle = np.asarray(truth.points)[block.track_index], block.points_m.mean(axis=0)
    turn, _ = Rotation.align_vectors(block.points_m - middle, true_m - true_m.mean(axis=0))
    off_m = block.centers_m - turn.apply(np.asarray(truth.poses.center) - true_m.mean(axis=0)) - middle
    squared = np.einsum("ni,nij,nj->n", off_m, np.linalg.inv(sigmas.covariance.centers), off_m) / 3
    assert 0.2 < squared.mean() < 2 and sigmas.position_std_m.max() < 0.5  # heights go with the focal length


def test_two_bars_against_each_other_tell_no_scale_and_three_tell_which_is_wrong(
    survey: Simulated, ends: Control
) -> None:
    bars = bars_of(ends)
    in_feet = dataclasses.replace(bars, length_m=bars.length_m * [1.0, 3.28, 1.0])
    found = adjusted_without_a_place(survey, in_feet)
    assert found.bars.is_set_aside.tolist() == [False, True, False]
    assert abs(scale_error(survey, found.block)) < 2e-4
    names = ("first", "second", "length_m", "std_m", "is_check")
    two = dataclasses.replace(in_feet, **{name: getattr(in_feet, name)[:2] for name in names})
    found = adjusted_without_a_place(survey, two)
    assert found.bars.is_unclear.all() and not found.bars.is_used.any()
    said = sentences(sfm.bar_findings(two, found.bars, found.block))
    assert len(said) == 1 and "contradict each other" in said[0] and "the block has no scale" in said[0]


def test_a_fit_to_control_is_compared_with_the_bars_where_it_leaves_the_block(
    survey: Simulated, ends: Control, held: sfm.Adjusted
) -> None:
    bars = bars_of(ends)
    fit = sfm.compared_bars(held.block, lambda xyz_m: 1.01 * xyz_m, bars, ends)
    np.testing.assert_allclose(fit.residual_m, 0.01 * bars.length_m, atol=0.05)
    assert (fit.over_sigma > 3.29).all() and not fit.is_used.any()
    said = sentences(sfm.bar_findings(bars, fit, held.block))
    assert len(said) == 3 and all("It took no part." in text for text in said)


def test_ends_that_too_few_photos_show_are_told(survey: Simulated, ends: Control) -> None:
    lost = ends.mark_point != 4
    few = dataclasses.replace(
        ends, mark_point=ends.mark_point[lost], mark_image=ends.mark_image[lost], mark_xy_px=ends.mark_xy_px[lost]
    )
    bars = dataclasses.replace(bars_of(ends), ends=few)
    found = adjusted(survey, bars)
    assert found.bars.is_used.tolist() == [True, True, False] and np.isnan(found.bars.distance_m[2])
    said = sentences(sfm.bar_findings(bars, found.bars, found.block))
    assert said == [
        "Scale bars of which fewer than two adjusted photos show an end: gcp04-gcp05; mark the ends in more photos."
    ]
    assert BarFit.nothing(2).is_used.tolist() == [False, False]
