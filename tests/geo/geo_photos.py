"""Photos with nothing but what the geo layer reads."""

from pathlib import Path

from jaxba.scene import Attitude, Photo, Position


def photo(
    index: int, position: Position | None, attitude: Attitude | None = None, time_s: float | None = None
) -> Photo:
    time = None if time_s is None else f"2024:05:01 10:{int(time_s // 60):02d}:{time_s % 60:06.3f}"
    name = f"p{index:03d}.jpg"
    return Photo(
        name=name, path=Path(name), sha256="", width_px=100, height_px=100, camera="c", position=position,
        attitude=attitude, time=time,
    )  # fmt: skip


def place(east_m: float, north_m: float) -> tuple[float, float]:
    """Return longitude and latitude near 92 west, 46.8 north, to a percent."""
    return -92.0 + east_m / 76_000, 46.8 + north_m / 111_200
