"""Flights told by pauses and by cameras."""

import dataclasses
from pathlib import Path

import numpy as np

from jaxba.geo import flight_numbers, measured_positions
from jaxba.scene import Lens, Photo, Position


def photo(number: int, time: str | None, body: str = "one") -> Photo:
    return Photo(
        name=f"{number}.jpg", path=Path("."), sha256="", width_px=4, height_px=3, camera="c", time=time,
        position=Position(x=14.0, y=50.0, z_m=300.0), lens=Lens(body=body),
    )  # fmt: skip


def numbers(photos: list[Photo]) -> list[int]:
    measured = measured_positions(photos, height_datum="ellipsoidal", std_h_m=3.0, std_v_m=5.0)
    return flight_numbers(photos, measured).tolist()


def test_a_pause_ends_a_flight_whatever_the_order_of_photos() -> None:
    minutes = [0, 1, 2, 9, 10, 30]
    photos = [photo(k, f"2026-05-04T10:{minute:02d}:00") for k, minute in enumerate(minutes)]
    assert numbers(photos) == [0, 0, 0, 1, 1, 2]
    assert numbers(photos[::-1]) == [2, 1, 1, 0, 0, 0]


def test_cameras_fly_their_own_flights_at_the_same_time() -> None:
    photos = [photo(k, f"2026-05-04T10:{k:02d}:00", body) for k, body in enumerate(["a", "b", "a", "b"])]
    assert numbers(photos) == [0, 1, 0, 1]


def test_without_times_a_camera_has_one_flight() -> None:
    photos = [dataclasses.replace(photo(k, None), time=None) for k in range(3)]
    assert numbers(photos) == [0, 0, 0]
    assert np.array(numbers([])).size == 0
