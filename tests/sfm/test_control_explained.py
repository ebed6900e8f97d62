"""Mistakes of control and positions explained from misclosures, against linear models drawn from their covariance."""

from dataclasses import replace

import numpy as np
import pytest

from jaxba.sfm.control._explained import Explained, explain
from jaxba.sfm.control._misclosure import Misclosure
from jaxba.sfm.control._statistics import control_statistics

STD_M = np.array([0.02, 0.02, 0.03])
RTK, PLAIN = "RTK", "plain"


def drawn(kind: str, num_points: int, rng: np.random.Generator) -> Misclosure:
    """A block that turns, tilts, scales and moves by what its positions are good to, and marks of a centimetre."""
    xyz_m = rng.uniform(-50, 50, (num_points, 3)) * [1, 1, 0.1]
    x, y, z = (xyz_m - xyz_m.mean(axis=0)).T
    zero = np.zeros(num_points)
    sways = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero], [x, y, z]]).transpose(2, 1, 0)
    sways = sways.reshape(3 * num_points, 4) * ((0.02 if kind is RTK else 3.0) / 150)
    shifts = np.tile(np.diag([0.006, 0.006, 0.012] if kind is RTK else [1.0, 1.0, 1.5]), (num_points, 1))
    covariance = sways @ sways.T + shifts @ shifts.T + 0.01**2 * np.eye(3 * num_points)
    off = (np.linalg.cholesky(covariance) @ rng.normal(size=3 * num_points)).reshape(num_points, 3)
    common_std_m = np.array([0.002, 0.002, 0.004] if kind is RTK else [3.0, 3.0, 5.0])
    return Misclosure(
        off + STD_M * rng.normal(size=off.shape) + common_std_m * rng.normal(size=3),
        xyz_m,
        np.tile(STD_M, (num_points, 1)),
        covariance.reshape(num_points, 3, num_points, 3),
        common_std_m,
    )


def moved(given: Misclosure, row: int, by_m: list[float]) -> Misclosure:
    off_m = given.off_m.copy()
    off_m[row] -= by_m
    return replace(given, off_m=off_m)


def exchanged(given: Misclosure, first: int, second: int) -> Misclosure:
    """The same with two labels exchanged in the list."""
    xyz_m, off_m = given.xyz_m.copy(), given.off_m.copy()
    xyz_m[[first, second]] = xyz_m[[second, first]]
    off_m += given.xyz_m - xyz_m
    return replace(given, xyz_m=xyz_m, off_m=off_m)


def culprits(found: Explained) -> set[tuple[str, tuple[int, ...]]]:
    return {mistake.culprit for mistake in found.mistakes}


@pytest.mark.parametrize(("kind", "num_points"), [(RTK, 3), (RTK, 12), (PLAIN, 5), (PLAIN, 12)])
def test_clean_surveys_are_accused_as_rarely_as_the_level_says(kind: str, num_points: int) -> None:
    rng = np.random.default_rng(0)
    accused = sum(bool(explain(drawn(kind, num_points, rng)).mistakes) for _ in range(300))
    tests = 2 * num_points + 2  # a point across and in height, and the shift
    assert accused <= 300 * 0.001 * tests + 3 * np.sqrt(300 * 0.001 * tests) + 1


@pytest.mark.parametrize("kind", [RTK, PLAIN])
def test_a_wrong_point_and_exchanged_labels_are_named_and_nothing_else(kind: str) -> None:
    rng = np.random.default_rng(1)
    right = np.zeros(4, int)
    for _ in range(20):
        given = drawn(kind, 12, rng)
        two = moved(moved(given, 3, [0.3, 0.0, 0.0]), 5, [0.0, 0.0, 0.4])
        expected = (
            (moved(given, 3, [0.2, 0.2, 0.0]), {("point", (3,))}, [(3, 0), (3, 1)]),
            (moved(given, 3, [0.0, 0.0, 0.4]), {("point", (3,))}, [(3, 2)]),
            (two, {("point", (3,)), ("point", (5,))}, [(3, 0), (3, 1), (5, 2)]),
            (exchanged(given, 2, 7), {("swapped", (2, 7))}, [(k, axis) for k in (2, 7) for axis in range(3)]),
        )
        for k, (wrong, named, aside) in enumerate(expected):
            found = explain(wrong)
            right[k] += culprits(found) == named and list(zip(*np.nonzero(found.wrong), strict=True)) == aside
    assert (right >= 17).all()  # a false alarm beside it in some


def test_what_positions_have_in_common_is_told_and_measured() -> None:
    rng, shift = np.random.default_rng(2), np.array([1.0, -0.8, 0.8])
    for kind, named in ((RTK, {("common", ())}), (PLAIN, set())):  # 1 m is nothing to sigmas of 3 m
        right, off = 0, []
        for _ in range(30):
            given = drawn(kind, 5, rng)
            given = replace(given, off_m=given.off_m + shift)
            found = explain(given)
            right += culprits(found) == named
            off.append(control_statistics(given, found).shift_m - shift)
        assert right >= 27
        if kind is RTK:  # known by the mean of five points
            assert np.abs(np.median(off, axis=0)).max() < 0.01 and np.median(np.abs(off)) < 0.03


def test_a_survey_that_contradicts_as_a_whole_is_worse_than_it_says_and_no_point_is_wrong() -> None:
    rng = np.random.default_rng(3)
    right = 0
    for _ in range(12):
        given = drawn(PLAIN, 12, rng)
        given = replace(given, off_m=given.off_m + np.array([0.1, 0.1, 0.0]) * rng.normal(size=(12, 3)))
        found = explain(given)
        right += 3 < found.scale[0] < 8 and found.scale[1] < 2 and len(found.mistakes) <= 1
    assert right >= 10


def test_which_of_two_is_wrong_is_not_claimed_where_nothing_tells_it() -> None:
    rng = np.random.default_rng(4)
    alone = drawn(RTK, 1, rng)  # one point against all positions
    found = explain(moved(alone, 0, [0.5, 0.0, 0.0]))
    assert len(found.mistakes) == 1
    assert {found.mistakes[0].culprit, *(m.culprit for m in found.mistakes[0].rivals)} == {
        ("point", (0,)),
        ("common", ()),
    }
    assert np.isfinite(control_statistics(alone, explain(alone)).test).all()


@pytest.mark.parametrize("kind", [RTK, PLAIN])
def test_statistics_are_those_of_adjustments_without_the_point(kind: str) -> None:
    """Each point against the adjustment of all others: unknowns of the block, of what is in common, generalised LS."""
    rng = np.random.default_rng(5)
    given = moved(drawn(kind, 6, rng), 4, [0.0, 0.0, 2.0])
    found = explain(given)
    assert culprits(found) == {("point", (4,))}
    had = control_statistics(given, found)
    prior = given.covariance_m2.reshape(18, 18) + np.tile(np.diag(given.common_std_m**2), (6, 6))
    off, survey = given.off_m.ravel(), np.tile(STD_M, 6)
    for row in range(18):
        if row == 14:  # what is set aside
            continue
        use = np.ones(18, bool)
        use[[row, 14]] = False
        # p ~ (off, prior) observed as 0 with the survey's sigmas: updated by what is used
        gain = prior[:, use] @ np.linalg.inv(prior[np.ix_(use, use)] + np.diag(survey[use] ** 2))
        without, variance = off - gain @ off[use], np.diagonal(prior - gain @ prior[use])
        std = np.sqrt(variance[row] + survey[row] ** 2)
        assert had.test.ravel()[row] == pytest.approx(without[row] / std, rel=1e-6)
        assert had.detectable_m.ravel()[row] == pytest.approx(4.1319 * std, rel=1e-4)
        with_it = use | (np.arange(18) == row)
        gain = prior[:, with_it] @ np.linalg.inv(prior[np.ix_(with_it, with_it)] + np.diag(survey[with_it] ** 2))
        pulled = gain[row, np.flatnonzero(with_it) == row][0]
        assert had.reach_m.ravel()[row] == pytest.approx(pulled * 4.1319 * std, rel=1e-4)
    for point in (0, 4):
        use = np.repeat(np.arange(6) != point, 3) & (np.arange(18) != 14)
        gain = prior[:, use] @ np.linalg.inv(prior[np.ix_(use, use)] + np.diag(survey[use] ** 2))
        mine = slice(3 * point, 3 * point + 3)
        np.testing.assert_allclose(had.without_m[point], (off - gain @ off[use])[mine], rtol=1e-6)
        variance = np.diagonal(prior - gain @ prior[use])[mine] + STD_M**2
        np.testing.assert_allclose(had.without_std_m[point], np.sqrt(variance), rtol=1e-6)
