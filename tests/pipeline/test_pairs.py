"""Candidate pairs against the exact overlaps of simulated flights, and the ways taken where footprints are unknown."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import shapely
from scipy.spatial.transform import Rotation

from jaxba._errors import JaxbaError
from jaxba.pipeline import pairs
from jaxba.scene import Photo, Reference, components
from jaxba.simulation._flight import flight_plan

WIDTH, HEIGHT, FOCAL = 5472, 3648, 3650.0


@dataclasses.dataclass(frozen=True)
class Flight:
    """A flight 100 m above level ground, flown with jitter, and what was measured of it."""

    inputs: pairs.Inputs
    center_m: np.ndarray
    rotation: Rotation

    @property
    def true_overlap(self) -> dict[tuple[int, int], float]:
        """Overlaps of the smaller footprint, by the corners' rays and shapely's polygons."""
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [WIDTH / 2, HEIGHT / 2] / FOCAL
        rays = np.column_stack([corners, np.ones(4)])
        turn = self.rotation.inv()
        ground = []
        for k, center in enumerate(self.center_m):
            world = turn[k].apply(rays)
            ground.append((center - world * (center[2] / world[:, 2:]))[:, :2])
        polygons = np.array([shapely.Polygon(ring) for ring in ground])
        i, j = shapely.STRtree(polygons).query(polygons, predicate="intersects")
        i, j = i[i < j], j[i < j]
        shared = shapely.area(shapely.intersection(polygons[i], polygons[j]))
        share = shared / np.minimum(shapely.area(polygons[i]), shapely.area(polygons[j]))
        return {(a, b): s for a, b, s in zip(i.tolist(), j.tolist(), share.tolist(), strict=True)}


def make_photos(count: int, **fields) -> tuple[Photo, ...]:
    given = {"width_px": WIDTH, "height_px": HEIGHT, "camera": "a", "focal_px": FOCAL} | fields
    return tuple(Photo(name=f"{i:04d}.jpg", path=Path(f"{i:04d}.jpg"), sha256="", **given) for i in range(count))


def make_reference(
    xyz_m: np.ndarray,
    *,
    quaternion: np.ndarray | None = None,
    height_m: np.ndarray | float = np.nan,
    std_m: float = 0.05,
    is_used: np.ndarray | None = None,
) -> Reference:
    count = len(xyz_m)
    return Reference(
        frame=None,
        xyz_m=np.asarray(xyz_m, float),
        std_m=np.full((count, 3), float(std_m)),
        quaternion=np.full((count, 4), np.nan) if quaternion is None else quaternion,
        attitude_std_rad=np.full((count, 3), np.nan if quaternion is None else 0.03),
        is_used=np.ones(count, bool) if is_used is None else is_used,
        height_above_ground_m=np.broadcast_to(np.asarray(height_m, float), count).copy(),
    )


def fly(count: int, forward: float, side: float, *, gnss_m: float, attitude_deg: float, seed: int = 0) -> Flight:
    rng = np.random.default_rng(seed)
    height_m = 100.0
    footprint = np.array([WIDTH, HEIGHT]) / FOCAL * height_m
    plan, level = flight_plan(count, (1 - forward) * footprint[1], (1 - side) * footprint[0])
    center = np.column_stack([plan, np.full(count, height_m)]) + rng.normal(size=(count, 3))
    rotation = Rotation.from_rotvec(0.03 * rng.normal(size=(count, 3))) * level
    measured = center + gnss_m * np.array([1, 1, 1.5]) * rng.normal(size=(count, 3))
    tagged = Rotation.from_rotvec(np.deg2rad(attitude_deg) * rng.normal(size=(count, 3))) * rotation
    reference = make_reference(
        measured, quaternion=tagged.as_quat(scalar_first=True), height_m=measured[:, 2], std_m=gnss_m
    )
    return Flight(pairs.Inputs(photos=make_photos(count), reference=reference), center, rotation)


def found(outputs: pairs.Outputs) -> set[tuple[int, int]]:
    return set(map(tuple, outputs.pairs.tolist()))


@pytest.mark.parametrize(
    ("forward", "gnss_m", "attitude_deg"),
    [(0.8, 0.03, 0.5), (0.8, 0.5, 0.5), (0.75, 1.0, 1.0)],
)
def test_of_a_thousand_photos_all_pairs_that_overlap_are_among_few_candidates(forward, gnss_m, attitude_deg):
    flight = fly(1000, forward, 0.6, gnss_m=gnss_m, attitude_deg=attitude_deg)
    outputs = pairs.run(flight.inputs, pairs.Params())
    overlapping = {pair for pair, share in flight.true_overlap.items() if share > 0.3}
    assert len(overlapping) > 5000
    assert outputs.num_all == 499_500
    assert len(outputs.pairs) < 10_000
    assert not overlapping - found(outputs)
    assert f"{len(outputs.pairs):,} of 499,500 pairs" in outputs.notes[0]
    assert "at 100 m above ground" in outputs.notes[0]


def test_poor_tags_lose_few_pairs_and_none_that_overlaps_well():
    # two photos' tags are off by 4 m on the ground: 4% of overlap along the line, and 40% is five sigmas from the limit
    flight = fly(1000, 0.8, 0.6, gnss_m=1.5, attitude_deg=1.5)
    outputs = pairs.run(flight.inputs, pairs.Params())
    true, candidates = flight.true_overlap, found(outputs)
    missed = [share for pair, share in true.items() if share > 0.3 and pair not in candidates]
    assert len(outputs.pairs) < 10_000
    assert len(missed) < 0.003 * sum(share > 0.3 for share in true.values())
    assert max(missed, default=0.0) < 0.4


def test_overlap_is_that_of_the_footprints_and_pairs_rise():
    flight = fly(60, 0.8, 0.6, gnss_m=0.0, attitude_deg=0.0)
    outputs = pairs.run(flight.inputs, pairs.Params())
    assert outputs.pairs.tolist() == sorted(outputs.pairs.tolist())
    assert np.all(outputs.pairs[:, 0] < outputs.pairs[:, 1])
    true = flight.true_overlap
    expected = [true.get(pair, 0.0) for pair in map(tuple, outputs.pairs.tolist())]
    np.testing.assert_allclose(outputs.overlap, expected, atol=1e-9)


def test_positions_off_by_more_than_a_tenth_of_the_footprint_widen_the_search():
    flight = fly(300, 0.75, 0.6, gnss_m=12.0, attitude_deg=1.5)
    overlapping = {pair for pair, share in flight.true_overlap.items() if share > 0.4}
    outputs = pairs.run(flight.inputs, pairs.Params())
    missed = overlapping - found(outputs)
    assert len(missed) < 0.02 * len(overlapping)
    assert len(outputs.pairs) < 0.1 * outputs.num_all
    blind = dataclasses.replace(
        flight.inputs, reference=dataclasses.replace(flight.inputs.reference, std_m=np.full((300, 3), 0.05))
    )
    assert len(overlapping - found(pairs.run(blind, pairs.Params()))) > 3 * len(missed)


def test_without_attitude_nearly_all_overlapping_pairs_are_found():
    flight = fly(200, 0.8, 0.6, gnss_m=0.03, attitude_deg=0.0)
    reference = dataclasses.replace(
        flight.inputs.reference, quaternion=np.full((200, 4), np.nan), attitude_std_rad=np.full((200, 3), np.nan)
    )
    outputs = pairs.run(dataclasses.replace(flight.inputs, reference=reference), pairs.Params())
    overlapping = {pair for pair, share in flight.true_overlap.items() if share > 0.3}
    assert len(overlapping - found(outputs)) < 0.002 * len(overlapping)
    assert len(outputs.pairs) < 0.15 * outputs.num_all
    assert "200 without attitude" in outputs.notes[0]


def test_heights_unknown_pair_the_nearest_photos():
    flight = fly(400, 0.75, 0.6, gnss_m=0.03, attitude_deg=0.0)
    reference = dataclasses.replace(flight.inputs.reference, height_above_ground_m=np.full(400, np.nan))
    outputs = pairs.run(dataclasses.replace(flight.inputs, reference=reference), pairs.Params())
    assert outputs.method == "neighbours"
    assert np.isnan(outputs.overlap).all()
    assert len(outputs.pairs) <= 20 * 400 < 0.11 * outputs.num_all
    assert "heights above ground are unknown" in outputs.notes[0]
    overlapping = {pair for pair, share in flight.true_overlap.items() if share > 0.3}
    assert len(overlapping - found(outputs)) < 0.01 * len(overlapping)


def test_a_few_heights_stand_for_the_others_over_the_same_ground():
    flight = fly(100, 0.8, 0.6, gnss_m=0.03, attitude_deg=0.5)
    heights = np.full(100, np.nan)
    heights[:10] = flight.inputs.reference.height_above_ground_m[:10]
    reference = dataclasses.replace(flight.inputs.reference, height_above_ground_m=heights)
    some = pairs.run(dataclasses.replace(flight.inputs, reference=reference), pairs.Params())
    assert some.pairs.tolist() == pairs.run(flight.inputs, pairs.Params()).pairs.tolist()


def test_heights_that_cannot_be_right_are_named_and_neighbours_paired():
    flight = fly(200, 0.75, 0.6, gnss_m=0.03, attitude_deg=0.0)
    reference = dataclasses.replace(flight.inputs.reference, height_above_ground_m=np.full(200, 25.0))
    outputs = pairs.run(dataclasses.replace(flight.inputs, reference=reference), pairs.Params())
    assert "doubtful" in outputs.notes[1]
    assert len(outputs.pairs) < 0.15 * outputs.num_all
    overlapping = {pair for pair, share in flight.true_overlap.items() if share > 0.5}
    assert len(overlapping - found(outputs)) < 0.01 * len(overlapping)


def test_two_blocks_far_apart_are_joined_by_their_closest_pairs():
    flight = fly(80, 0.8, 0.6, gnss_m=0.03, attitude_deg=0.5)
    xyz_m = flight.inputs.reference.xyz_m.copy()
    east = xyz_m[:, 0] > 0
    xyz_m[east, 0] += 900
    reference = dataclasses.replace(flight.inputs.reference, xyz_m=xyz_m)
    outputs = pairs.run(dataclasses.replace(flight.inputs, reference=reference), pairs.Params())
    assert len(components(outputs.pairs, 80)) == 1
    across = outputs.pairs[east[outputs.pairs[:, 0]] != east[outputs.pairs[:, 1]]]
    assert 1 <= len(across) <= 5
    assert any("2 groups of photos that do not overlap are joined by" in note for note in outputs.notes)


@pytest.mark.parametrize(("count", "expected"), [(40, 39), (200, 40)])
def test_a_photo_without_position_meets_all_of_a_small_set_or_its_neighbours_in_time(count, expected):
    flight = fly(count, 0.8, 0.6, gnss_m=0.03, attitude_deg=0.5)
    xyz_m, is_used = flight.inputs.reference.xyz_m.copy(), np.ones(count, bool)
    xyz_m[30], is_used[30] = np.nan, False
    photos = tuple(dataclasses.replace(p, time=f"{9999 - i:04d}") for i, p in enumerate(flight.inputs.photos))
    reference = dataclasses.replace(flight.inputs.reference, xyz_m=xyz_m, is_used=is_used)
    outputs = pairs.run(pairs.Inputs(photos=photos, reference=reference), pairs.Params())
    assert np.sum(outputs.pairs == 30) == expected
    assert np.isnan(outputs.overlap[(outputs.pairs == 30).any(axis=1)]).all()
    assert any("without a usable position: 1;" in note for note in outputs.notes)
    assert outputs.by_order.tolist() == ([30] if count > 60 else [])


def test_without_positions_a_small_set_is_paired_in_full():
    inputs = pairs.Inputs(photos=make_photos(41), reference=make_reference(np.full((41, 3), np.nan)))
    outputs = pairs.run(inputs, pairs.Params())
    assert outputs.method == "exhaustive"
    assert len(outputs.pairs) == outputs.num_all == 41 * 40 // 2
    assert "no usable positions" in outputs.notes[0]


def test_without_positions_a_large_set_is_paired_in_sequence_and_told_the_cure():
    photos = tuple(dataclasses.replace(p, time=f"{i * 7 % 500:04d}") for i, p in enumerate(make_photos(500)))
    inputs = pairs.Inputs(photos=photos, reference=make_reference(np.full((500, 3), np.nan)))
    outputs = pairs.run(inputs, pairs.Params(window=3))
    assert outputs.method == "sequential"
    place = np.array([int(photo.time or 0) for photo in photos])[outputs.pairs]
    assert np.abs(place[:, 0] - place[:, 1]).max() == 3
    assert len(outputs.pairs) == 499 + 498 + 497
    assert "geo.txt" in outputs.notes[0] and "look alike" in outputs.notes[0]
    assert "by time" in outputs.notes[0]
    assert outputs.by_order.tolist() == list(range(500))
    chosen = pairs.run(inputs, pairs.Params(window=3, method="sequential"))  # it says so, and means it
    assert len(chosen.by_order) == 0 and "lines of a flight may not be joined" in chosen.notes[0]


@pytest.mark.parametrize("method", ["footprint", "neighbours"])
def test_a_method_that_lacks_what_it_needs_is_refused_with_the_cure(method):
    inputs = pairs.Inputs(photos=make_photos(5), reference=make_reference(np.full((5, 3), np.nan)))
    with pytest.raises(JaxbaError, match=f"pairs.method={method}: .* set pairs.method="):
        pairs.run(inputs, pairs.Params(method=method))


def test_a_photo_without_focal_length_is_taken_as_wide_and_named():
    flight = fly(20, 0.8, 0.6, gnss_m=0.03, attitude_deg=0.5)
    inputs = dataclasses.replace(flight.inputs, photos=make_photos(20, focal_px=None))
    assert "20 without focal length" in pairs.run(inputs, pairs.Params()).notes[0]


@pytest.mark.parametrize("count", [0, 1, 2])
def test_sets_too_small_for_a_graph(count):
    placed = make_reference(np.arange(3.0 * count).reshape(count, 3), height_m=50.0)
    outputs = pairs.run(pairs.Inputs(photos=make_photos(count), reference=placed), pairs.Params())
    assert len(outputs.pairs) == len(outputs.overlap) == outputs.num_all == count * (count - 1) // 2


def test_the_same_input_gives_the_same_bytes():
    flight = fly(200, 0.75, 0.6, gnss_m=1.5, attitude_deg=1.5)
    one, two = (pairs.run(flight.inputs, pairs.Params()) for _ in range(2))
    assert one.pairs.tobytes() == two.pairs.tobytes()
    assert one.overlap.tobytes() == two.overlap.tobytes()
