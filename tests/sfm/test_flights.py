"""Offsets of flights: found by the adjustment, with sigmas that hold, and taken off the positions that are judged."""

import dataclasses

import numpy as np
import pytest

from jaxba import sfm
from jaxba.report import flight_facts, flight_lines
from jaxba.scene import FlightOffsets, Reference
from jaxba.simulation.staged import Simulated, measured_anew, simulate, spread_control

OFF_M = np.array([0.4, -0.3, 0.5])
SETTINGS = sfm.Settings(max_rounds=4)


@pytest.fixture(scope="module")
def survey() -> Simulated:
    """Of two flights with RTK, the base of the second standing half a metre beside that of the first."""
    made = measured_anew(simulate(20, seed=4), np.random.default_rng(1), (0.02, 0.02, 0.04))
    xyz_m = made.reference.xyz_m.copy()
    xyz_m[10:] += OFF_M
    return dataclasses.replace(made, reference=dataclasses.replace(made.reference, xyz_m=xyz_m))


def told_apart(reference: Reference) -> Reference:
    return dataclasses.replace(reference, flight=np.repeat([0, 1], 10), flight_std_m=1.0)


def adjusted(survey: Simulated, reference: Reference, **options: object) -> tuple[sfm.Adjusted, sfm.Uncertainty]:
    block = sfm.with_points(survey.block, survey.tracks, min_angle_rad=0.02, max_error_px=20.0)
    found = sfm.adjust(block, survey.tracks, survey.view_graph, reference, survey.photos, SETTINGS, **options)
    return found, sfm.uncertainty(found, reference)


def squared_error(survey: Simulated, found: sfm.Adjusted, sigmas: sfm.Uncertainty) -> float:
    off_m = found.block.centers_m - np.asarray(survey.survey.truth.poses.center)
    assert sigmas.covariance is not None
    return float(np.mean(np.einsum("ni,nij,nj->n", off_m, np.linalg.inv(sigmas.covariance.centers), off_m))) / 3


def test_the_offset_between_flights_is_found_and_bends_nothing(survey: Simulated) -> None:
    reference = told_apart(survey.reference)
    found, sigmas = adjusted(survey, reference)
    flights = sfm.flight_offsets(found, sigmas, reference)
    assert flights is not None and flights.num_photos.tolist() == [10, 10]
    # photos tell what one flight is off from the other; what both are off in common nobody knows but the prior
    between = np.diff(flights.offset_m, axis=0)[0]
    np.testing.assert_allclose(between, OFF_M, atol=0.06)
    np.testing.assert_allclose(flights.std_m, np.sqrt(0.5), rtol=0.02)
    assert squared_error(survey, found, sigmas) < 3.0
    fit = sfm.gnss_fit(found.block, sfm.without_offsets(reference, flights))
    assert fit.rms_m is not None and max(fit.rms_m) < 0.08 and not fit.is_outlier.any()
    # as one flight the block is bent between both, under sigmas of centimetres
    bent, of_bent = adjusted(survey, survey.reference)
    assert squared_error(survey, bent, of_bent) > 20.0


def test_control_tells_what_both_flights_are_off(survey: Simulated) -> None:
    reference = told_apart(survey.reference)
    control = spread_control(survey, 4, 3, np.random.default_rng(2))
    found, sigmas = adjusted(survey, reference, control=control)
    flights = sfm.flight_offsets(found, sigmas, reference)
    assert flights is not None and found.on_control is not None
    assert not found.on_control.explained.wrong.any()
    truth = np.stack([np.zeros(3), OFF_M])
    assert np.all(flights.std_m < 0.08)
    np.testing.assert_array_less(np.abs(flights.offset_m - truth) / flights.std_m, 4.0)
    assert squared_error(survey, found, sigmas) < 3.0
    # what both flights are off from control beside that is told, with their offsets taken into account
    away = dataclasses.replace(reference, xyz_m=reference.xyz_m + np.array([0.0, 0.0, 30.0]))
    found, sigmas = adjusted(survey, away, control=control)
    assert found.on_control is not None and found.on_control.explained.is_shifted.tolist() == [False, False, True]
    assert not found.on_control.explained.wrong.any()
    off_m = found.block.centers_m - np.asarray(survey.survey.truth.poses.center)
    assert np.abs(off_m).max() < 0.2


def test_one_flight_has_no_offset_of_its_own(survey: Simulated) -> None:
    reference = dataclasses.replace(survey.reference, flight=np.zeros(20, int), flight_std_m=1.0)
    problem = sfm.to_problem(survey.block, reference, survey.photos)
    assert len(problem.position_offset) == 0


def test_offsets_are_told_with_their_sigmas() -> None:
    flights = FlightOffsets(
        np.array([0, 2]), np.array([3, 4]), np.array([[0.1, -0.2, 0.3], [0.0, 0.0, 1.0]]), np.full((2, 3), np.nan)
    )
    flights.std_m[0] = 0.05
    facts = flight_facts(flights)
    assert facts[0] == {"flight": 1, "photos": 3, "offset_m": [-0.1, 0.2, -0.3], "std_m": [0.05] * 3}
    assert facts[1]["std_m"] == [None] * 3 and flight_facts(None) == []
    assert flight_lines(facts) == [
        "1, 3 photos: adjusted minus measured positions in common -0.100 (0.050), +0.200 (0.050), -0.300 (0.050) m "
        "east, north, up",
        "3, 4 photos: adjusted minus measured positions in common +0.000, +0.000, -1.000 m east, north, up",
    ]


def test_too_few_positions_have_no_offsets_of_flights(survey: Simulated) -> None:
    # breaks where photos that are held at their start get offsets that no position of theirs has
    used = np.isin(np.arange(20), [0, 15])
    reference = dataclasses.replace(told_apart(survey.reference), is_used=used)
    problem = sfm.to_problem(survey.block, reference, survey.photos)
    assert len(problem.position_offset) == 0


def test_an_axis_that_is_not_measured_has_no_offset(survey: Simulated) -> None:
    found, sigmas = adjusted(survey, told_apart(survey.reference))
    std_m = survey.reference.std_m.copy()
    std_m[:, 2] = np.inf
    flat = dataclasses.replace(told_apart(survey.reference), std_m=std_m)
    flights = sfm.flight_offsets(found, sigmas, flat)
    assert flights is not None and np.isnan(flights.offset_m[:, 2]).all() and np.isfinite(flights.offset_m[:, :2]).all()
    assert np.isfinite(sfm.without_offsets(flat, flights).xyz_m).all()
