"""What is foretold of spots, cameras and control equals the covariance of the adjustment that has them as points."""

import itertools

import jax
import numpy as np
import pytest
from small_plan import AREA_M, CONTROL_STD_M, small_network, small_plan

from benchmarks.plans import compare
from jaxba._errors import JaxbaError
from jaxba.ba import covariance
from jaxba.design import network_of, place_control, spots_in, with_control
from jaxba.design._modes import dome_of, modes_of, shift_of
from jaxba.design._network import Spots
from jaxba.design._on_grid import OnGrid
from jaxba.design._placement import _given, _slope, _std
from jaxba.design._sections import Gnss
from jaxba.design._variants import with_oblique, with_positions, with_second_height

UNKNOWN = (np.inf, np.inf, np.inf)
INNER = AREA_M / 2


def sigmas(problem, rows):
    return np.sqrt(np.diagonal(covariance(problem).points[rows], axis1=1, axis2=2))


def test_spots_are_known_as_points_marked_in_all_photos_would_be():
    """The adjustment takes them as points of its own: it breaks where rays, weights or the block's part are wrong."""
    network = small_network()
    before = network.problem.num_points
    measured = with_control(network, INNER, UNKNOWN).problem
    expected = sigmas(measured, slice(before, None))
    np.testing.assert_allclose(network.at(INNER).std_m, expected, rtol=0.06)
    found = covariance(measured)
    centers = np.sqrt(np.diagonal(found.centers, axis1=1, axis2=2))
    np.testing.assert_allclose(network.position_std_m, centers, rtol=0.02)
    assert network.focal_std_px == pytest.approx(np.sqrt(found.intrinsics[0, 0, 0]), rel=0.03)


@pytest.mark.parametrize("kind", ["rtk", "plain"])
def test_control_does_what_an_adjustment_with_it_says(kind: str):
    network = small_network(kind)
    control = np.array([[-30.0, -20.0], [25.0, -25.0], [0.0, 22.0]])
    foretold = _std(_given(network, CONTROL_STD_M), control)
    with_it = with_control(network, control, CONTROL_STD_M)
    exact = with_it.spots.std_m.max(axis=1)
    assert np.all((foretold > 0.99 * exact) & (foretold < 1.08 * exact))  # its marks tie photos, too, which is left out
    assert foretold.max() < 0.7 * network.spots.std_m.max()


def test_the_gradient_of_a_placement_is_that_of_differences():
    given = _given(small_network("plain"), CONTROL_STD_M)
    at = np.array([[-25.0, -18.0], [22.0, -20.0], [3.0, 19.0]])
    with jax.enable_x64(True):
        _, gradient = _slope(given, at)
        for k, axis in itertools.product(range(3), range(2)):
            step = np.zeros((3, 2))
            step[k, axis] = 1e-4
            (high, _), _ = _slope(given, at + step)
            (low, _), _ = _slope(given, at - step)
            assert float(gradient[k, axis]) == pytest.approx(float(high - low) / 2e-4, rel=1e-3, abs=1e-9)


@pytest.mark.parametrize("kind", ["rtk", "plain"])
def test_placement_is_no_worse_than_the_best_of_all_placements_on_a_grid(kind: str):
    """Four points: 10,626 placements on 24 places are all tried."""
    network = small_network(kind)
    placed = place_control(network, 4, CONTROL_STD_M)
    given = _given(network, CONTROL_STD_M)
    grid = OnGrid(network, network.at(spots_in(AREA_M, 6)), CONTROL_STD_M)
    best = min(grid.variances(chosen).max() for chosen in itertools.combinations(range(grid.num), 4)) ** 0.5
    assert placed.worst_m <= 1.05 * best
    assert placed.worst_m == pytest.approx(_std(given, placed.plan_m).max())
    assert np.all(placed.without_m >= placed.worst_m)
    assert placed.before_m == pytest.approx(network.spots.std_m.max())


@pytest.mark.slow
def test_simulations_err_as_was_foretold():
    """A hundred adjustments of the plan, each with measurements drawn anew."""
    found = compare(small_network(), 100)
    assert len(found) == 7
    for name, (foretold, rms) in found.items():
        assert rms == pytest.approx(foretold, rel=0.2), name


def test_modes_are_named_by_their_shape():
    plan = spots_in(AREA_M, 5)
    xyz = np.column_stack([plan, np.zeros(len(plan))])
    r2 = np.sum(plan**2, axis=1)
    bent = np.zeros((len(plan), 3))
    bent[:, 2] = 0.05 * (r2 - r2.mean()) / (r2.max() - r2.min())
    tilted = np.zeros((len(plan), 3))
    tilted[:, 2] = 0.02 * plan[:, 0] / 40.0
    shifted = np.tile([0.5, 0.0, 0.0], (len(plan), 1))
    joint = sum(np.outer(d.ravel(), d.ravel()) for d in (bent, tilted, shifted)) + 1e-10 * np.eye(3 * len(plan))
    nothing = np.zeros((len(plan), 3, 3))
    spots = Spots(xyz, np.full(len(plan), 9.0), np.zeros((len(joint), 1)), joint, nothing)
    modes = modes_of(spots)
    assert [mode.name for mode in modes[:2]] == ["dome", "tilt"]
    assert dome_of(spots) == pytest.approx(0.05, rel=1e-3)
    np.testing.assert_allclose(shift_of(spots), [0.5, 0.0, 0.0], atol=1e-5)
    up = [modes[0].corners_m[2], modes[0].middle_m[2]]
    assert up[0] - up[1] == pytest.approx(0.05, rel=0.02)
    assert modes[1].corners_m[2] == pytest.approx(0.02, rel=0.02)
    assert modes[1].middle_m[2] == pytest.approx(0.0, abs=1e-4)


def test_more_photos_and_better_positions_gain_what_a_plan_with_them_says():
    """The variants, made of the block itself, lie near plans that have the same from the start."""
    plain = small_network("plain")
    rtk = with_positions(plain, Gnss(kind="rtk"))
    np.testing.assert_allclose(rtk.spots.std_m, small_network("rtk").spots.std_m, rtol=1e-6)
    oblique = with_oblique(small_network())
    planned = network_of(small_plan(oblique=8))
    assert oblique.photos.num == planned.photos.num
    assert oblique.focal_std_px == pytest.approx(planned.focal_std_px, rel=0.25)
    assert oblique.focal_std_px < 0.4 * small_network().focal_std_px
    high = with_second_height(small_network())
    assert high.photos.num == small_network().photos.num + -(-small_network().photos.num // 2)
    assert high.focal_std_px < small_network().focal_std_px
    assert np.all(np.isfinite(high.spots.std_m))


def test_a_control_point_outside_the_block_is_refused():
    with pytest.raises(
        JaxbaError, match="control point 500 m east and 0 m north of the middle is seen in fewer than 2"
    ):
        with_control(small_network(), np.array([[500.0, 0.0]]), CONTROL_STD_M)
    with pytest.raises(JaxbaError, match="from 1 to 40"):
        place_control(small_network(), 0, CONTROL_STD_M)
