"""What goes to review, with which words, and that drifting heights are told from heights that were flown."""

import numpy as np
import pytest
from geo_photos import photo, place
from hypothesis import given, settings, strategies as st

from jaxba.geo import Judgement, judge_positions, measured_positions
from jaxba.scene import Position


def judge(photos, **changes) -> Judgement:
    params = {
        "h_accuracy_threshold_m": 2.0, "altitude_variance": 0.05, "max_height_drift_m": 20.0, "max_extent_m": 1e5,
        "std_v_m": 5.0,
    }  # fmt: skip
    return judge_positions(measured_positions(photos), **{**params, **changes})


def flight(heights, relative=None, east=None, north=None, seconds=2.0, **fields):
    """Photos of a flight to and fro, two lines of half the frames, in order of time."""
    count = len(heights)
    half = count // 2
    along = np.concatenate([np.arange(half), np.arange(count - half)[::-1]])
    east = np.where(np.arange(count) < half, 0.0, 30.0) if east is None else east
    north = 20.0 * along if north is None else north
    photos = []
    for k in range(count):
        x, y = place(east[k], north[k])
        above = None if relative is None else relative[k]
        position = Position(x=x, y=y, z_m=heights[k], relative_altitude_m=above, **fields)
        photos.append(photo(k, position, time_s=seconds * k))
    return photos


def grid(lines: int = 6, per_line: int = 10):
    """East and north of a grid flown in lines to and fro."""
    line = np.repeat(np.arange(lines), per_line)
    along = np.tile(np.arange(per_line), lines)
    along = np.where(line % 2 == 1, per_line - 1 - along, along)
    return 30.0 * line, 20.0 * along


def noise(count: int, std_m: float) -> np.ndarray:
    return np.random.default_rng(1).normal(0, std_m, count)


def test_a_quiet_flight_is_used_whole():
    judged = judge(flight(300 + noise(40, 3.0)))
    assert judged.is_used.all()
    assert judged.review == ()
    assert judged.drift is None
    assert "No relative altitude tells the flight height" in judged.notes[0]


def test_missing_and_far_positions_are_not_used_and_go_to_review_with_the_inaccurate_ones():
    photos = flight(300 + noise(20, 1.0))
    photos[3] = photo(3, None)
    photos[4] = photo(4, Position(x=0.0, y=0.0))
    photos[5] = photo(5, Position(x=92.0, y=46.8, z_m=300.0))  # the sign of the longitude lost
    photos[6] = photo(6, Position(x=-92.0, y=46.8, z_m=300.0, std_h_m=2.5))
    photos[7] = photo(7, Position(x=-92.0, y=46.8, z_m=300.0, std_h_m=2.0))
    judged = judge(photos)
    assert [left.name for left in judged.review] == ["p003.jpg", "p004.jpg", "p005.jpg", "p006.jpg"]
    assert "no usable coordinates" in judged.review[1].reason
    assert "km from the middle of the survey, over 100 km" in judged.review[2].reason
    assert "states a horizontal accuracy of 2.50 m, over 2 m" in judged.review[3].reason
    assert "the position is used with that sigma" in judged.review[3].reason
    assert np.flatnonzero(~judged.is_used).tolist() == [3, 4, 5]
    assert judged.counts == {"missing coordinates": 2, "far from the others": 1}
    assert len(judge(photos, h_accuracy_threshold_m=3.0).review) == 3


@given(
    st.lists(st.one_of(st.none(), st.floats(0.05, 500)), min_size=4, max_size=12),
    st.floats(0.05, 100),
)
@settings(max_examples=30)
def test_an_honest_sigma_weighs_a_position_and_the_threshold_only_names_it(stated: list[float | None], limit_m: float):
    photos = [
        photo(k, Position(x=place(20.0 * k, 0)[0], y=46.8, z_m=300.0 + k % 2, std_h_m=std_m))
        for k, std_m in enumerate(stated)
    ]
    measured, judged = measured_positions(photos), judge(photos, h_accuracy_threshold_m=limit_m)
    assert judged.is_used.all()
    assert measured.std_m[:, 0].tolist() == [3.0 if std_m is None else std_m for std_m in stated]
    over = [photos[k].name for k, std_m in enumerate(stated) if std_m is not None and std_m > limit_m]
    assert [left.name for left in judged.review] == over


@pytest.mark.parametrize("share", [0.05, 0.1])
def test_the_altitude_gate_is_a_share_of_the_median_flight_height(share: float):
    relative = np.full(20, 80.0)
    relative[2], relative[3] = 80 * (1 + share) + 0.1, 80 * (1 - share) - 0.1
    relative[4], relative[5] = 80 * (1 + share) - 0.1, 80 * (1 - share) + 0.1
    judged = judge(flight(300 + relative, relative), altitude_variance=share)
    assert np.flatnonzero(~judged.is_used).tolist() == [2, 3]
    assert f"{80 * share + 0.1:.1f} m above the median flight height of 80.0 m, over {share:.0%} of it" in (
        judged.review[0].reason
    )
    assert judged.height_above_ground_m.tolist() == relative.tolist()


def test_a_frame_on_the_ground_goes_to_review_without_relative_altitudes():
    heights = 300 + noise(30, 2.0)
    heights[0] = 240.0
    judged = judge(flight(heights))
    assert np.flatnonzero(~judged.is_used).tolist() == [0]
    assert "has a height of 240.0 m, " in judged.review[0].reason


@pytest.mark.parametrize("num_below", [1, 10, 19])
def test_heights_of_one_size_and_both_signs_are_named(num_below: int):
    heights = 320 + noise(20, 1.0)
    heights[:num_below] *= -1
    judged = judge(flight(heights, np.full(20, 70.0)))
    (note,) = [note for note in judged.notes if "below zero" in note]
    assert f"Heights of {num_below} positions are about 320 m below zero (first: p000.jpg)" in note
    assert f"of {20 - num_below} as much above (first: p{num_below:03d}.jpg)" in note


@pytest.mark.parametrize("heights", [np.linspace(-30, 30, 20), np.full(20, -410.0), np.linspace(2, 40, 20)])
def test_heights_about_or_below_sea_level_are_not(heights: np.ndarray):
    assert not any("below zero" in note for note in judge(flight(heights, np.full(20, 70.0))).notes)


def test_relative_altitudes_of_zero_are_no_flight_height():
    judged = judge(flight(300 + noise(20, 2.0), np.zeros(20)))
    assert judged.is_used.all()
    assert np.isnan(judged.height_above_ground_m).all()


def test_a_flight_at_two_heights_says_how_to_use_both():
    relative = np.repeat([60.0, 90.0], 10)
    judged = judge(flight(300 + relative, relative))
    assert judged.is_used.sum() < 20
    assert "a flight at several heights, or over steep ground?" in judged.notes[-1]
    assert judge(flight(300 + relative, relative), altitude_variance=0.5).is_used.all()


@pytest.mark.parametrize("rise_m", [60.0, -60.0])
def test_heights_that_drift_with_time_are_found_and_every_position_is_kept(rise_m: float):
    heights = 300 + np.linspace(0, rise_m, 40) + noise(40, 1.5)
    east, north = grid(lines=4)
    judged = judge(flight(heights, east=east, north=north))
    assert judged.is_used.all()
    assert judged.drift is not None
    assert judged.drift.first_m == pytest.approx(heights[0])
    assert f"from {heights[0]:.1f} m (p000.jpg) to {heights[-1]:.1f} m (p039.jpg) in one flight" in judged.drift.reason
    assert judge(flight(heights, east=east, north=north), max_height_drift_m=100.0).drift is None


def test_drift_is_found_without_times_by_the_order_of_names():
    east, north = grid(lines=4)
    photos = flight(300 + np.linspace(0, 80, 40), east=east, north=north)
    assert judge([photo(k, p.position) for k, p in enumerate(photos)]).drift is not None


def test_following_the_terrain_is_no_drift():
    east, north = grid()
    rng = np.random.default_rng(0)
    for _ in range(20):  # slopes up to 1 in 2, waves of 5 m, and noise
        a, b, c, d = rng.uniform(-1, 1, 4)
        wave = 5 * np.sin(east / 40 + 6 * c) * np.cos(north / 60 + 6 * d)
        heights = 300 + 0.5 * a * east + 0.5 * b * north + wave + rng.normal(0, 1.5, 60)
        assert judge(flight(heights, east=east, north=north)).drift is None


def test_two_heights_flown_one_after_the_other_are_no_drift():
    east, north = grid()
    heights = np.concatenate([np.full(60, 300.0), np.full(60, 340.0)]) + noise(120, 1.5)
    twice = {"east": np.tile(east, 2), "north": np.tile(north, 2)}
    assert judge(flight(heights, seconds=1.0, **twice)).drift is None


def test_a_single_strip_up_a_slope_is_no_drift():
    count = 30
    heights = 300 + np.linspace(0, 100, count) + noise(count, 1.5)
    strip = {"east": np.zeros(count), "north": 20.0 * np.arange(count)}
    assert judge(flight(heights, **strip)).drift is None


def test_a_climb_that_the_barometer_saw_is_no_drift_and_one_that_it_did_not_is():
    climb = np.linspace(0, 60, 40)
    assert judge(flight(300 + climb, 50 + climb), altitude_variance=0.5).drift is None
    judged = judge(flight(300 + climb, np.full(40, 50.0)))
    assert judged.drift is not None
    assert "less the relative altitude, they put the take-off point anywhere from 253.0 m to 307.0 m" in (
        judged.drift.reason
    )


def test_two_take_off_points_are_no_drift():
    photos = flight(np.full(20, 350.0), np.full(20, 50.0), seconds=5.0)
    later = flight(np.full(20, 410.0), np.full(20, 50.0), seconds=5.0)
    again = [photo(20 + k, p.position, time_s=600 + 5.0 * k) for k, p in enumerate(later)]
    judged = judge([*photos, *again])
    assert judged.drift is None
    assert judged.is_used.all()


def test_a_receiver_that_states_a_good_fix_is_believed():
    east, north = grid(lines=4)
    flown = {"heights": 300 + np.linspace(0, 60, 40), "east": east, "north": north}
    assert judge(flight(**flown, fix="rtk_fixed")).drift is None
    assert judge(flight(**flown, std_v_m=0.5)).drift is None
    assert judge(flight(**flown, std_v_m=5.0)).drift is not None
