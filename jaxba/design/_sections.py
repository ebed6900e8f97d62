"""The tables of a flight's plan: each parameter with its default, range and meaning, as those of a run."""

from dataclasses import dataclass
from typing import ClassVar

from jaxba.engine import Parameters, parameter

_GNSS_STD_M = {"rtk": (0.03, 0.06), "plain": (0.5, 0.8), "none": (100.0, 100.0)}
_COMMON_STD_M = {"rtk": (0.02, 0.03), "plain": (3.0, 5.0), "none": (0.0, 0.0)}


@dataclass(frozen=True, kw_only=True)
class Camera(Parameters):
    """The camera: a pinhole with distortion to be calibrated in flight."""

    section: ClassVar[str] = "camera"
    width_px: int = parameter(5472, low=100, high=100_000, help="columns of a photo, across the line of flight")
    height_px: int = parameter(3648, low=100, high=100_000, help="rows of a photo")
    focal_px: float | None = parameter(None, low=10, high=1e6, help="focal length in pixels, in place of that in mm")
    focal_mm: float = parameter(8.8, low=0.5, high=2000, help="focal length")
    sensor_width_mm: float = parameter(13.2, low=1, high=100, help="width of the sensor, along the columns")

    @property
    def focal(self) -> float:
        """Focal length in pixels."""
        return self.focal_px or self.focal_mm / self.sensor_width_mm * self.width_px


@dataclass(frozen=True, kw_only=True)
class Flight(Parameters):
    """Lines over the area, and what is flown beside them."""

    section: ClassVar[str] = "flight"
    height_m: float = parameter(100.0, low=5, high=10_000, help="above the mean ground")
    forward_overlap: float = parameter(0.8, low=0.3, high=0.97, help="share of a photo seen again along the line")
    side_overlap: float = parameter(0.7, low=0.1, high=0.97, help="share of a photo seen again on the next line")
    heading_deg: float = parameter(0.0, low=-360, high=360, help="of the lines, clockwise from north")
    crossing: bool = parameter(False, help="fly lines across the first ones, too")
    second_height_m: float | None = parameter(None, low=5, high=10_000, help="fly lines at a second height, too")
    oblique: int = parameter(0, low=0, high=1000, help="photos around the area that look at its middle")
    oblique_tilt_deg: float = parameter(30.0, low=5, high=60, help="of these, from straight down")


@dataclass(frozen=True, kw_only=True)
class Gnss(Parameters):
    """Positions of the photos: what each errs by on its own, and what all have in common."""

    section: ClassVar[str] = "gnss"
    kind: str = parameter("plain", choices=("rtk", "plain", "none"), help="receiver, which the sigmas follow from")
    std_h_m: float | None = parameter(None, low=0.001, high=1000, help="sigma of each position, east and north")
    std_v_m: float | None = parameter(None, low=0.001, high=1000, help="sigma of each height")
    common_std_h_m: float | None = parameter(None, low=0, high=1000, help="sigma of what all have in common")
    common_std_v_m: float | None = parameter(None, low=0, high=1000, help="likewise, up")

    @property
    def std_m(self) -> tuple[float, float, float]:
        """Sigma of each position, east, north, up."""
        return _three(self.std_h_m, self.std_v_m, _GNSS_STD_M[self.kind])

    @property
    def common_std_m(self) -> tuple[float, float, float]:
        """Sigma of what all positions have in common, east, north, up; zero: nothing."""
        return _three(self.common_std_h_m, self.common_std_v_m, _COMMON_STD_M[self.kind])


@dataclass(frozen=True, kw_only=True)
class Ties(Parameters):
    """Tie points, by which photos hold together."""

    section: ClassVar[str] = "ties"
    points_per_image: float = parameter(200.0, low=20, high=5000, help="tie points over photos")
    mean_track_length: float = parameter(4.0, low=2, high=50, help="photos that see a tie point, on average")
    std_px: float = parameter(0.5, low=0.05, high=10, help="sigma of an image coordinate")


@dataclass(frozen=True, kw_only=True)
class Ground(Parameters):
    """The ground: gentle hills, since the plan knows no better."""

    section: ClassVar[str] = "ground"
    relief_m: float = parameter(10.0, low=0, high=5000, help="highest minus lowest ground")


@dataclass(frozen=True, kw_only=True)
class Control(Parameters):
    """Control points and their marks; where they lie is a list of its own."""

    section: ClassVar[str] = "control"
    std_h_m: float = parameter(0.01, low=0.0005, high=10, help="sigma of surveyed coordinates, east and north")
    std_v_m: float = parameter(0.015, low=0.0005, high=10, help="sigma of surveyed heights")
    mark_std_px: float = parameter(0.5, low=0.05, high=20, help="sigma of a mark in a photo, also of check points")


def _three(across: float | None, up: float | None, of_kind: tuple[float, float]) -> tuple[float, float, float]:
    horizontal = of_kind[0] if across is None else across
    return horizontal, horizontal, of_kind[1] if up is None else up
