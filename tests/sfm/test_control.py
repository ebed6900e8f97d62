"""Control points in the adjustment and in fits after it: against the truth, with blunders, without heights or GNSS."""

from dataclasses import replace
from unittest import mock

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxba.ba import make_plan
from jaxba.geometry import Similarity
from jaxba.report import sentences
from jaxba.scene import Control, Finding
from jaxba.sfm import (
    Adjusted,
    Settings,
    Uncertainty,
    adjust,
    apply_control,
    control_findings,
    gnss_fit,
    place_by_control,
    to_problem,
    uncertainty as uncertainty_of,
    with_points,
)
from jaxba.sfm.control import _onto_control
from jaxba.sfm.control._control import agreeing_marks, control_part, intersect, mark_std
from jaxba.sfm.control._explained import Explained, explain
from jaxba.sfm.control._fit import Controlled, apply_affine, fit_affine
from jaxba.sfm.control._misclosure import Misclosure
from jaxba.sfm.control._start import transformed
from jaxba.simulation.staged import Simulated, simulate, true_block

OFFSET_M = np.array([12.0, -7.0, 31.0])
SETTINGS = Settings(max_rounds=3)


@pytest.fixture(scope="module")
def survey() -> Simulated:
    """GNSS with a noise of 3 m, and as much off in common as another datum makes."""
    found = simulate(12, seed=4, points_per_image=60.0, gnss_std_m=(3.0, 3.0, 5.0))
    return replace(found, reference=replace(found.reference, xyz_m=found.reference.xyz_m + OFFSET_M))


@pytest.fixture(scope="module")
def points(survey: Simulated) -> Control:
    """Six control and four check points, spread over the block, in photos that show them."""
    truth, seen = survey.survey.truth, survey.survey.problem.observations
    point, image = np.asarray(seen.point_index), np.asarray(seen.image_index)
    often = np.flatnonzero(np.bincount(point, minlength=len(truth.points)) >= 5)
    chosen = [often[0]]
    while len(chosen) < 10:  # the farthest from those before
        away = np.linalg.norm(truth.points[often, None] - truth.points[chosen], axis=2).min(axis=1)
        chosen.append(often[np.argmax(away)])
    rng = np.random.default_rng(1)
    rows = np.concatenate([np.flatnonzero(point == p) for p in chosen])
    std_m = np.tile([0.02, 0.02, 0.03], (10, 1))
    return Control(
        names=tuple(f"gcp{k}" for k in range(10)),
        xyz_m=truth.points[chosen] + std_m / 2 * rng.normal(size=(10, 3)),
        std_m=std_m,
        is_check=np.arange(10) % 3 == 2,
        mark_point=np.array([chosen.index(p) for p in point[rows]]),
        mark_image=image[rows].astype(np.int64),
        mark_xy_px=truth.xy_px[rows] + 0.5 * rng.normal(size=(len(rows), 2)),
    )


def moved(control: Control, row: int, by_m: list[float]) -> Control:
    xyz_m = control.xyz_m.copy()
    xyz_m[row] += by_m
    return replace(control, xyz_m=xyz_m)


def without_heights(control: Control) -> Control:
    return replace(control, std_m=np.where([True, True, False], control.std_m, np.inf))


def run(survey: Simulated, control: Control) -> tuple[Adjusted, Controlled]:
    block = with_points(survey.block, survey.tracks, min_angle_rad=0.02, max_error_px=20.0)
    adjusted = adjust(
        block, survey.tracks, survey.view_graph, survey.reference, survey.photos, SETTINGS, control=control
    )
    sigmas = uncertainty_of(adjusted, survey.reference)
    return adjusted, apply_control(adjusted, sigmas, control, survey.reference)


def found_on(survey: Simulated, control: Control, made: tuple[Adjusted, Controlled]) -> tuple[Finding, ...]:
    found = control_findings(made[0], control, made[1].fit, survey.reference, survey.photos)
    assert all(sentences(found))  # each can be told
    return found


@pytest.fixture(scope="module")
def made(survey: Simulated, points: Control) -> tuple[Adjusted, Controlled]:
    return run(survey, points)


@pytest.fixture(scope="module")
def sigmas(survey: Simulated, made: tuple[Adjusted, Controlled]) -> Uncertainty:
    return uncertainty_of(made[0], survey.reference)


def test_check_points_lie_where_they_were_surveyed_though_gnss_is_metres_off(
    survey: Simulated, points: Control, made: tuple[Adjusted, Controlled]
) -> None:
    fit = made[1].fit
    assert fit.method == "adjust" and (fit.num_marks >= 5).all()
    assert (fit.control_rms_m < 0.03).all() and (fit.check_rms_m < [0.04, 0.04, 0.08]).all()
    over = fit.residual_m / np.hypot(fit.std_m, points.std_m)
    assert np.abs(over).max() < 4 and not fit.is_suspect.any() and (fit.scale == 1).all()
    centers = np.asarray(survey.survey.truth.poses.center)
    # heights of cameras trade off with the focal length over flat ground; those of points do not
    assert (np.abs(made[1].block.centers_m - centers).max(axis=0) < [0.15, 0.15, 1.5]).all()
    none = run(survey, replace(points, method="none"))[1].fit
    assert none.method == "none" and (np.abs(none.check_rms_m) > 3).all()


def test_an_offset_of_gnss_from_control_is_told_and_does_not_pull(
    survey: Simulated, points: Control, made: tuple[Adjusted, Controlled]
) -> None:
    fit = made[1].fit
    np.testing.assert_allclose(fit.gnss_minus_control_m, OFFSET_M, atol=4.0)  # medians of 12 with 3 and 5 m
    centers = np.asarray(survey.survey.truth.poses.center)
    off_m = np.mean(survey.reference.xyz_m - centers, axis=0)
    assert (np.abs(fit.gnss_minus_control_m - off_m) < 3 * fit.gnss_minus_control_std_m).all()
    assert (
        fit.gnss_minus_control_std_m < [2.0, 2.0, 3.0]
    ).all()  # of 3 and 5 m, twelve of them, and the scatter that they show
    found = {finding.kind: finding.figures for finding in found_on(survey, points, made)}
    assert found["gnss off control"]["offset_m"] == fit.gnss_minus_control_m.tolist()
    assert found["gnss off control"]["std_m"] == [3.0, 3.0, 5.0] and not found["gnss off control"]["is_compared"]
    assert "control point contradicts" not in found


def test_check_points_change_nothing(survey: Simulated, points: Control, made: tuple[Adjusted, Controlled]) -> None:
    wrong = points
    for row in np.flatnonzero(points.is_check):
        wrong = moved(wrong, int(row), [5.0, 5.0, 5.0])
    other = run(survey, wrong)
    assert np.array_equal(other[1].block.centers_m, made[1].block.centers_m)
    assert np.array_equal(other[1].block.points_m, made[1].block.points_m)
    assert other[1].fit.check_rms_m[0] > 4


def test_a_control_point_that_is_off_by_a_metre_is_named_and_hardly_pulls(
    survey: Simulated, points: Control, made: tuple[Adjusted, Controlled]
) -> None:
    wrong = moved(points, 3, [0.8, 0.6, 0.0])
    other = run(survey, wrong)
    assert [wrong.names[k] for k in np.flatnonzero(other[1].fit.is_suspect)] == ["gcp3"]
    assert np.abs(other[1].fit.residual_m[3] + [0.8, 0.6, 0.0]).max() < 0.15
    assert np.isinf(other[1].fit.used_std_m[3]).tolist() == [True, True, False]  # its height stands
    pulled = np.abs(other[1].fit.adjusted_m - made[1].fit.adjusted_m)
    assert np.delete(pulled, 3, axis=0)[:, :2].max() < 0.1
    suspect = [f.figures for f in found_on(survey, wrong, other) if f.kind == "control point set aside"]
    assert [(s["name"], s["axes"], s["rivals"]) for s in suspect] == [("gcp3", [0, 1], [])]
    over = (suspect[0]["off_m"] + np.array([0.8, 0.6, np.nan])) / suspect[0]["std_m"]
    assert np.abs(over[:2]).max() < 3.5 and np.isnan(over[2]) and suspect[0]["over_sigma"] > 3.29


@pytest.mark.parametrize("method", ["helmert", "affine"])
def test_a_fit_afterwards_brings_the_block_onto_control(survey: Simulated, points: Control, method: str) -> None:
    control = replace(points, method=method)
    adjusted, found = run(survey, control)
    assert adjusted.control is None and not adjusted.common_m.any() and found.fit.method == method
    assert (found.fit.control_rms_m < [0.1, 0.1, 0.3]).all() and (found.fit.check_rms_m < [0.1, 0.1, 0.3]).all()
    assert np.isnan(found.sigmas.position_std_m).all() and "method=adjust" in (found.sigmas.why_not or "")
    points_m = apply_affine(found.affine, found.block.points_m)
    truth = survey.survey.truth.points[found.block.track_index]
    assert np.median(np.linalg.norm(points_m - truth, axis=1)) < 0.3
    assert np.array_equal(found.affine, np.eye(3, 4)) == (method == "helmert")
    wrong = replace(moved(points, 3, [1.5, 1.0, 0.0]), method=method)
    assert apply_control(adjusted, found.sigmas, wrong, survey.reference).fit.is_suspect[3]


def test_wrong_marks_are_told_where_the_others_agree(survey: Simulated, points: Control) -> None:
    block = true_block(survey)
    assert agreeing_marks(block, points).all()
    xy_px = points.mark_xy_px.copy()
    xy_px[[2, 30]] += [[60.0, -40.0], [0.0, 300.0]]
    use = agreeing_marks(block, replace(points, mark_xy_px=xy_px))
    assert np.flatnonzero(~use).tolist() == [2, 30]
    first = np.flatnonzero(points.mark_point == 0)
    two = replace(points, mark_point=points.mark_point[first[:2]], mark_image=points.mark_image[first[:2]],
                  mark_xy_px=xy_px[[first[0], 2]])  # fmt: skip
    assert agreeing_marks(block, two).all()  # which of two is wrong nobody can tell


def test_the_sigma_of_marks_is_that_of_their_scatter_where_nobody_states_it(survey: Simulated, points: Control) -> None:
    block, use = true_block(survey), np.ones(len(points.mark_point), bool)
    assert mark_std(block, points, use) == 1.0  # as stated, though they were set with 0.5
    assumed = replace(points, mark_std_is_assumed=True)
    assert mark_std(block, assumed, use) == pytest.approx(0.5, rel=0.2)  # of some 60 marks
    two = use & (np.arange(len(use)) < 2)
    assert mark_std(block, assumed, two) == pytest.approx(1.0, abs=0.15)  # one degree of freedom against four


def test_control_places_a_block_of_any_frame(survey: Simulated, points: Control) -> None:
    truth = survey.survey.truth
    free = with_points(true_block(survey), survey.tracks, min_angle_rad=0.02, max_error_px=20.0)
    turn = Similarity(scale=0.02, rotation=Rotation.from_rotvec([0.3, -0.2, 2.0]).as_matrix(), shift=np.ones(3))
    free = replace(transformed(free, turn), is_georeferenced=False)
    centers = np.asarray(truth.poses.center)
    wrong = moved(points, 0, [40.0, 0.0, 0.0])
    for control in (points, wrong):
        placed = place_by_control(free, control.without_check_points(), is_placed=False)
        assert placed.is_georeferenced and np.abs(placed.centers_m - centers).max() < (
            1.0 if control is points else 4.0
        )
    flat = place_by_control(free, without_heights(points).without_check_points(), is_placed=False)
    assert flat.is_georeferenced and "tilt" in flat.notes[-1]
    assert np.abs(flat.centers_m - centers)[:, :2].max() < 8.0  # the photos look down on average, and control is flat
    two = replace(points, is_check=np.arange(10) > 1)
    kept = place_by_control(free, two.without_check_points(), is_placed=False)
    assert not kept.is_georeferenced and "2 are marked" in kept.notes[-1]


def test_horizontal_control_leaves_heights_to_gnss(survey: Simulated, points: Control) -> None:
    control = without_heights(points)
    found = run(survey, control)[1]
    assert np.isnan(found.fit.residual_m[:, 2]).all() and (found.fit.check_rms_m[:2] < 0.1).all()
    assert abs(found.fit.gnss_minus_control_m[2]) < found.fit.gnss_minus_control_std_m[2]  # its sigma alone tells it
    up = np.median(found.block.centers_m[:, 2] - survey.reference.xyz_m[:, 2])
    assert abs(up) < 3.0  # GNSS of 5 m, 12 of them


@pytest.mark.parametrize("method", ["adjust", "helmert", "affine", "none"])
@pytest.mark.parametrize("unknown", [[], [2], [0, 1, 2]])
@pytest.mark.parametrize("has_heights", [True, False])
def test_points_have_no_sigma_along_an_axis_that_nothing_measured_holds(
    survey: Simulated,
    points: Control,
    made: tuple[Adjusted, Controlled],
    sigmas: Uncertainty,
    method: str,
    unknown: list[int],
    has_heights: bool,
) -> None:
    point_std_m = sigmas.point_std_m.copy()
    point_std_m[:, unknown] = np.nan
    control = replace(points if has_heights else without_heights(points), method=method)
    found = apply_control(made[0], replace(sigmas, point_std_m=point_std_m), control, survey.reference).fit
    held = ~np.isin(np.arange(3), unknown)
    if method in ("helmert", "affine"):  # the fit itself holds what control has
        held = np.array([True, True, held[2] or has_heights])
    assert np.array_equal(np.isfinite(found.std_m), np.tile(held, (10, 1)))


def test_points_and_marks_stand_behind_the_blocks_own(survey: Simulated, points: Control) -> None:
    block = with_points(survey.block, survey.tracks, min_angle_rad=0.02, max_error_px=20.0)
    part = control_part(block, points, np.ones(len(points.mark_point), bool))
    assert part is not None and part.rows.tolist() == [0, 1, 3, 4, 6, 7, 9]
    plain = to_problem(block, survey.reference, survey.photos, std_px=0.4)
    problem = to_problem(block, survey.reference, survey.photos, std_px=0.4, control=part)
    extra = len(part.observation_image)
    assert problem.num_points == block.num_points + 7 and problem.num_observations == block.num_observations + extra
    assert np.array_equal(problem.points[: block.num_points], plain.points)
    assert set(problem.observations.std_px[-extra:]) == {1.0} and set(plain.observations.std_px) == {0.4}
    prior = problem.prior("control")
    assert prior is not None and plain.prior("control") is None
    np.testing.assert_array_equal(prior.xyz, points.xyz_m[part.rows])  # pyright: ignore[reportAttributeAccessIssue]
    assert control_part(block, replace(points, method="helmert"), np.ones(len(points.mark_point), bool)) is None


def test_a_mark_less_compiles_nothing_anew(survey: Simulated, points: Control) -> None:
    block = with_points(survey.block, survey.tracks, min_angle_rad=0.02, max_error_px=20.0)
    use = np.ones(len(points.mark_point), bool)
    full = make_plan(to_problem(block, survey.reference, survey.photos, control=control_part(block, points, use)))
    use[3] = False
    less = to_problem(block, survey.reference, survey.photos, control=control_part(block, points, use))
    assert make_plan(less, like=full.shape).shape == full.shape


def test_intersection_is_least_squares_of_pixels(survey: Simulated, points: Control) -> None:
    block = true_block(survey)
    found = intersect(block, points, np.ones(len(points.mark_point), bool))
    off = (found.point_m - points.xyz_m) / np.sqrt(found.variance_m2 / 4 + points.std_m**2 / 4)
    assert 0.5 < np.sqrt(np.mean(off**2)) < 1.5  # marks and survey have half of their sigmas


def test_affine_shears_only_what_points_tell() -> None:
    rng = np.random.default_rng(0)
    source = rng.normal(size=(12, 3)) * [50, 50, 10]
    true = np.array([[1.001, 0.002, 0.0, 5.0], [0.0, 0.999, 0.001, -3.0], [0.003, 0.0, 1.002, 1.0]])
    found = fit_affine(source, apply_affine(true, source), np.full((12, 3), 0.01))
    np.testing.assert_allclose(found, true, atol=2e-5)
    flat = source * [1, 1, 0]
    held = fit_affine(flat, apply_affine(true, flat), np.full((12, 3), 0.01))
    np.testing.assert_allclose(held[:, 2], [0, 0, 1], atol=1e-9)
    np.testing.assert_allclose(held[:, [0, 1, 3]], true[:, [0, 1, 3]], atol=2e-5)


def test_good_positions_are_moved_only_where_they_contradict_control(survey: Simulated, points: Control) -> None:
    centers = np.asarray(survey.survey.truth.poses.center)
    std_m = np.tile([0.03, 0.03, 0.05], (12, 1))
    measured = centers + std_m * np.random.default_rng(3).normal(size=centers.shape)
    # horizontal: an offset of heights over flat ground looks like another focal length
    offset_m = np.array([0.5, 0.0, 0.0])
    for off_m in (np.zeros(3), offset_m):
        reference = replace(survey.reference, xyz_m=measured + off_m, std_m=std_m)
        given = replace(survey, reference=reference)
        adjusted, found = run(given, points)
        np.testing.assert_allclose(found.fit.gnss_minus_control_m, off_m, atol=0.15)
        kinds = {finding.kind for finding in found_on(given, points, (adjusted, found))}
        assert ("gnss off control" in kinds) == off_m.any() and "control point set aside" not in kinds
        assert (found.fit.check_rms_m < [0.04, 0.04, 0.08]).all()


@pytest.fixture(scope="module")
def rtk(survey: Simulated) -> Simulated:
    """The same flight with positions of 2 and 4 cm."""
    std_m = np.tile([0.02, 0.02, 0.04], (12, 1))
    centers = np.asarray(survey.survey.truth.poses.center)
    measured = centers + std_m * np.random.default_rng(5).normal(size=centers.shape)
    return replace(survey, reference=replace(survey.reference, xyz_m=measured, std_m=std_m))


def test_a_shift_that_all_check_points_have_is_told_and_blamed_on_none(rtk: Simulated, points: Control) -> None:
    """A base that stands beside its mark, and no control point: all of the block is off, no check point is wrong."""
    shift = np.array([1.0, -0.8, 0.8])
    away = replace(rtk, reference=replace(rtk.reference, xyz_m=rtk.reference.xyz_m + shift))
    checks = replace(points, is_check=np.ones(10, bool))
    for given, expected in ((rtk, np.zeros(3)), (away, shift)):
        made = run(given, checks)
        fit = made[1].fit
        assert not fit.is_suspect.any() and (fit.over_sigma < 4).all()
        over = (fit.check_shift_m - expected) / fit.check_shift_std_m
        assert np.abs(over).max() < 3.5 and (fit.check_shift_std_m < 0.15).all()
        found = {finding.kind: finding.figures for finding in found_on(given, checks, made)}
        assert ("check points shifted" in found) == expected.any() and "control point contradicts" not in found
        gnss = gnss_fit(made[1].block, given.reference)
        assert not gnss.is_outlier.any() and (gnss.scale_m < 0.06).all()
    assert found["check points shifted"]["count"] == 10 and not found["check points shifted"]["is_controlled"]
    # one that is wrong beside the shift is named, and it alone
    wrong = run(away, moved(checks, 3, [0.0, 0.0, 0.6]))[1].fit
    assert np.flatnonzero(wrong.is_suspect).tolist() == [3]


def test_reliability_of_control_is_what_a_planted_error_shows(rtk: Simulated, points: Control) -> None:
    """An error as large as `detectable_m` shifts the test by 4.13 sigmas, and the point by `reach_m`."""
    clean = run(rtk, points)[1].fit
    control = np.flatnonzero(~points.is_check)
    assert np.isfinite(clean.detectable_m[control]).all() and np.isnan(clean.detectable_m[points.is_check]).all()
    assert (clean.detectable_m[control] > 4.13 * points.std_m[control]).all() and (clean.over_sigma < 4).all()
    size = clean.detectable_m[3, 2]
    wrong = run(rtk, moved(points, 3, [0.0, 0.0, size]))[1].fit
    # signs of chance before: the test moves by 4.13 from where it was
    assert 4.13 - clean.over_sigma[3] - 0.1 < wrong.over_sigma[3] < 4.13 + clean.over_sigma[3] + 0.1
    half = run(rtk, moved(points, 3, [0.0, 0.0, size / 2]))[1].fit  # too small to be set aside: it pulls
    assert not half.is_suspect.any()
    pulled = half.adjusted_m[3, 2] - clean.adjusted_m[3, 2]
    assert pulled == pytest.approx(clean.reach_m[3, 2] / 2, rel=0.05)


@pytest.mark.parametrize(("by_m", "left"), [([0.0, 0.0, 0.0], 0.15), ([1.0, -0.8, 0.8], 0.15)])
def test_what_photos_say_of_control_is_the_same_before_and_after_it_holds_the_block(
    rtk: Simulated, points: Control, by_m: list[float], left: float
) -> None:
    """The misclosure from the solution on control, by its covariance, is that of the block which control never held."""
    away = replace(rtk, reference=replace(rtk.reference, xyz_m=rtk.reference.xyz_m + np.array(by_m)))
    seen: list[Misclosure] = []

    def kept(found: Misclosure) -> Explained:
        seen.append(found)
        return explain(found)

    with mock.patch.object(_onto_control, "explain", kept):
        residual_m = run(away, points)[1].fit.residual_m
    assert len(seen) >= 2
    known = np.isfinite(seen[0].off_m)
    back, moved_by = (seen[-1].off_m - seen[0].off_m)[known], (residual_m - seen[0].off_m)[known]
    assert np.sqrt(np.mean(back**2)) < left * np.sqrt(np.mean(moved_by**2))
