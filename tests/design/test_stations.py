"""Photos of a plan cover its area as its overlaps say, and look where they are said to."""

import dataclasses

import numpy as np
import pytest
import shapely
from small_plan import small_plan

from jaxba._errors import JaxbaError
from jaxba.design import stations_of
from jaxba.design._stations import level

CONCAVE = np.array([[-100.0, -60.0], [120.0, -80.0], [90.0, 90.0], [10.0, 0.0], [-90.0, 70.0]])


def footprints(plan, stations):
    """Return each photo's footprint on level ground, by intersecting its corners' rays."""
    half = np.array([plan.camera.width_px, plan.camera.height_px]) / 2 / plan.camera.focal
    corners = np.array([[i * half[0], j * half[1], 1.0] for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
    rays = np.einsum("nji,cj->nci", stations.cam_from_world, corners)
    reach = stations.center_m[:, None, 2:] / -rays[..., 2:]
    return [shapely.Polygon(ring) for ring in stations.center_m[:, None, :2] + reach * rays[..., :2]]


@pytest.mark.parametrize("heading_deg", [0.0, 37.0, 90.0, -120.0])
def test_every_spot_is_seen_as_often_as_the_overlaps_say(heading_deg: float):
    plan = dataclasses.replace(small_plan(heading_deg=heading_deg), area_m=CONCAVE)
    stations = stations_of(plan)
    seen = footprints(plan, stations)
    spots = np.random.default_rng(0).uniform(CONCAVE.min(axis=0), CONCAVE.max(axis=0), size=(400, 2))
    spots = spots[shapely.contains_xy(shapely.Polygon(CONCAVE), *spots.T)]
    count = sum(shapely.contains_xy(footprint, *spots.T).astype(int) for footprint in seen)
    along, across = 1 / (1 - plan.flight.forward_overlap), 1 / (1 - plan.flight.side_overlap)
    assert count.min() >= np.floor(along) * np.floor(across)
    assert np.median(count) >= along * across - 1
    assert len(stations.center_m) < 4 * shapely.Polygon(CONCAVE).buffer(60).area / seen[0].area * along * across


def test_neighbours_overlap_as_planned_and_lines_go_to_and_fro():
    plan = small_plan()
    stations = stations_of(plan)
    seen = footprints(plan, stations)
    first, second = seen[0], seen[1]
    assert first.intersection(second).area / first.area == pytest.approx(0.65)
    across = np.diff(np.unique(stations.center_m[:, 0].round(6)))
    width = plan.flight.height_m * plan.camera.width_px / plan.camera.focal
    np.testing.assert_allclose(across, width * (1 - plan.flight.side_overlap), atol=1e-5)
    ahead = -stations.cam_from_world[:, 1, :2]
    moved = np.diff(stations.center_m[:, :2], axis=0)
    along = np.einsum("ni,ni->n", moved, ahead[:-1]) / np.linalg.norm(moved, axis=1)
    assert np.sum(along > 0.999) == len(seen) - stations.num_lines  # all but the turns between lines


def test_a_level_photo_has_its_heading_at_the_top():
    rotation = level(30.0)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    np.testing.assert_allclose(rotation @ [np.sin(np.pi / 6), np.cos(np.pi / 6), 0.0], [0.0, -1.0, 0.0], atol=1e-15)


def test_oblique_photos_look_at_the_middle_and_a_second_height_is_flown_across():
    plan = small_plan(oblique=8, oblique_tilt_deg=40.0, second_height_m=90.0)
    stations = stations_of(plan)
    oblique = stations.cam_from_world[-8:]
    np.testing.assert_allclose(oblique @ np.swapaxes(oblique, 1, 2), np.broadcast_to(np.eye(3), (8, 3, 3)), atol=1e-12)
    np.testing.assert_allclose(oblique[:, 2, 2], -np.cos(np.deg2rad(40.0)))
    towards = -stations.center_m[-8:, :2]
    across = towards[:, 0] * oblique[:, 2, 1] - towards[:, 1] * oblique[:, 2, 0]
    np.testing.assert_allclose(across, 0.0, atol=1e-9)
    assert np.all(np.sum(towards * oblique[:, 2, :2], axis=1) > 0)
    assert np.all(oblique[:, 1, 2] < 0)  # the top of the photo is up
    high = stations.cam_from_world[stations.center_m[:, 2] > 80.0]
    np.testing.assert_allclose(np.abs(high[:, 1, 0]), 1.0)


@pytest.mark.parametrize(
    ("flight", "said"),
    [
        ({"height_m": 5.0, "forward_overlap": 0.97, "side_overlap": 0.97}, r"fly higher \(flight.height_m\)"),
        ({"height_m": 10.0, "forward_overlap": 0.9, "side_overlap": 0.85}, r"the plan has \d+ photos, over 1000"),
    ],
)
def test_too_many_photos_are_refused(flight: dict[str, float], said: str):
    with pytest.raises(JaxbaError, match=said):
        stations_of(small_plan(**flight))
