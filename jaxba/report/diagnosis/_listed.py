"""Positions of a list beside those of the photos' tags, and where both lie on earth."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from pyproj import Transformer
from pyproj.exceptions import ProjError

from jaxba.geo import distance_m
from jaxba.report._recorded import Recorded
from jaxba.scene import Photo, Position


@dataclass(frozen=True, kw_only=True, eq=False)
class Against:
    """Positions of a list beside those of the same photos' tags, WGS 84.

    - `listed`, `tagged`: as they are. `away_m`: horizontal distance. `up_m`: height of the list minus that of the tags.
    """

    photos: tuple[Photo, ...]
    listed: tuple[Position, ...]
    tagged: tuple[Position, ...]
    away_m: Float[np.ndarray, " photos"]
    up_m: Float[np.ndarray, " photos"]


def wgs84(position: Position) -> tuple[float, float]:
    """Return longitude and latitude; NaN where a position does not fit its CRS."""
    try:
        return Transformer.from_crs(position.crs, "EPSG:4326", always_xy=True).transform(position.x, position.y)
    except ProjError:
        return float("nan"), float("nan")


def against_tags(case: Recorded) -> Against | None:
    """Return positions of a list beside those of the tags; None where there is no list, or the tags have none."""
    pairs = [
        (photo, photo.position, photo.tag_position)
        for photo in (case.done.photos if case.done.metadata is not None else ())
        if photo.position is not None and photo.tag_position is not None
    ]
    if not pairs:
        return None
    photos, listed, tagged = zip(*pairs, strict=True)
    first, second = (np.array([wgs84(position) for position in entry]) for entry in (listed, tagged))
    up = [np.nan if a.z_m is None or b.z_m is None else a.z_m - b.z_m for a, b in zip(listed, tagged, strict=True)]
    return Against(
        photos=photos, listed=listed, tagged=tagged, away_m=distance_m(*first.T, *second.T), up_m=np.array(up, float)
    )  # fmt: skip
