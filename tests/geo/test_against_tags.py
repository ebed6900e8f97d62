"""A list of positions is held against the photos' own tags: what is refused, with which cure, and what is not."""

import numpy as np
import pytest
from geo_photos import photo
from hypothesis import given, settings, strategies as st
from pyproj import Transformer

from jaxba._errors import JaxbaError
from jaxba.geo import hold_against_tags, utm_zone
from jaxba.scene import Photo, Position

EAST_M, NORTH_M = np.array([0.0, 30, 60, 0, 30, 60, 0, 30]), np.array([0.0, 0, 0, 40, 40, 40, 80, 80])
MINNESOTA, ZURICH, SYDNEY = (-93.2, 44.9), (8.5, 47.4), (151.2, -33.9)
FOOT_M, US_FOOT_M = 0.3048, 1200 / 3937


def flight(place: tuple[float, float]) -> np.ndarray:
    """Return longitude, latitude and height of eight photos."""
    lon = place[0] + EAST_M / (111_200 * np.cos(np.radians(place[1])))
    return np.stack([lon, place[1] + NORTH_M / 111_200, 320 + 0.1 * EAST_M], axis=1)


def projected(place: tuple[float, float], code: int) -> np.ndarray:
    lon, lat, height = flight(place).T
    return np.stack([*Transformer.from_crs(4326, code, always_xy=True).transform(lon, lat), height], axis=1)


def listed(crs: str, xyz: np.ndarray, tags: np.ndarray) -> list[Photo]:
    """Return photos that a list replaces the positions of; NaN where their tags have none."""
    photos = []
    for k, (x, y, z) in enumerate(xyz):
        of_list = photo(k, Position(crs=crs, x=x, y=y, z_m=z, source=f"geo.txt line {k + 2}", list_name="geo.txt"))
        lon, lat, height = tags[k]
        own = None if np.isnan(lon) else Position(x=lon, y=lat, z_m=height)
        photos.append(Photo(**{**vars(of_list), "tag_position": own}))
    return photos


def held(photos: list[Photo], max_distance_m: float = 5000.0) -> list[str]:
    return hold_against_tags(photos, max_distance_m)


SWAP = [1, 0, 2]
MISTAKES = {
    "axes of a UTM zone": (MINNESOTA, "EPSG:32615", projected(MINNESOTA, 32615)[:, SWAP], "x and y swapped"),
    "latitude first": ((38.9, 45.1), "EPSG:4326", flight((38.9, 45.1))[:, SWAP], "x and y swapped"),
    "axes of a state plane": (MINNESOTA, "EPSG:26851", projected(MINNESOTA, 26851)[:, SWAP], "x and y swapped"),
    "degrees under UTM": (ZURICH, "EPSG:32632", flight(ZURICH), "x and y read as degrees of longitude and latitude"),
    "degrees under UTM, latitude first": (
        ZURICH, "EPSG:32632", flight(ZURICH)[:, SWAP], "x and y read as degrees of latitude and longitude",
    ),
    "degrees under the Swiss grid": (ZURICH, "EPSG:2056", flight(ZURICH), "x and y read as degrees of longitude"),
    "the zone before": (MINNESOTA, "EPSG:32614", projected(MINNESOTA, 32615), "UTM zone 15N (EPSG:32615)"),
    "the zone after": (SYDNEY, "EPSG:32757", projected(SYDNEY, 32756), "UTM zone 56S (EPSG:32756)"),
    "a zone without a code": (
        MINNESOTA, "+proj=utm +zone=16 +ellps=GRS80 +towgs84=0,0,0", projected(MINNESOTA, 32615), "UTM zone 15N",
    ),
    "a zone far off": (ZURICH, "EPSG:32635", projected(ZURICH, 32632), "UTM zone 32N (EPSG:32632)"),
    "the northern hemisphere": (SYDNEY, "EPSG:32656", projected(SYDNEY, 32756), "UTM zone 56S (EPSG:32756)"),
    "the southern hemisphere": (ZURICH, "EPSG:32732", projected(ZURICH, 32632), "UTM zone 32N (EPSG:32632)"),
    "feet under UTM": (
        MINNESOTA, "EPSG:32615", projected(MINNESOTA, 32615) / [FOOT_M, FOOT_M, 1], "x and y read as feet",
    ),
    "US feet under a state plane in metres": (
        MINNESOTA, "EPSG:26993", projected(MINNESOTA, 26993) / [US_FOOT_M, US_FOOT_M, 1], "x and y read as feet",
    ),
    "metres under a state plane in feet": (
        MINNESOTA, "EPSG:26851", projected(MINNESOTA, 26993), "x and y read as metres",
    ),
    "UTM under a state plane": (MINNESOTA, "EPSG:26993", projected(MINNESOTA, 32615), "UTM zone 15N (EPSG:32615)"),
    "another state plane": (MINNESOTA, "EPSG:26992", projected(MINNESOTA, 26993), "Minnesota South"),
    "another Gauss-Krueger strip": ((9.5, 50.0), "EPSG:31468", projected((9.5, 50.0), 31467), "Gauss-Kruger zone 3"),
    "metres under degrees": (MINNESOTA, "EPSG:4269", projected(MINNESOTA, 32615), "UTM zone 15N (EPSG:32615)"),
    "west without its sign": (MINNESOTA, "EPSG:4326", flight(MINNESOTA) * [-1, 1, 1], "the other sign of x"),
    "south without its sign": (SYDNEY, "EPSG:4326", flight(SYDNEY) * [1, -1, 1], "the other sign of y"),
    "axes of the zone before": (
        MINNESOTA, "EPSG:32614", projected(MINNESOTA, 32615)[:, SWAP], "UTM zone 15N (EPSG:32615) and x and y swapped",
    ),
}  # fmt: skip


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_list_that_is_read_wrongly_is_refused_with_the_reading_that_fits(mistake: str):
    place, crs, xyz, words = MISTAKES[mistake]
    with pytest.raises(JaxbaError) as error:
        held(listed(crs, xyz, flight(place)))
    said = str(error.value)
    assert said.startswith("geo.txt: positions lie ") and "(crs.max_distance_km)" in said
    assert "geo.txt line 2, p000.jpg: x " in said
    assert words in said and " it would be 0." in said and "km: correct the list" in said


def test_a_list_that_no_mistake_explains_is_refused_with_both_cures():
    with pytest.raises(JaxbaError, match=r"lie 111\.1 km from .*No usual mistake.*or raise crs.max_distance_km if"):
        held(listed("EPSG:4326", flight((-93.2, 45.9)), flight(MINNESOTA)))
    said = held(listed("EPSG:4326", flight((-93.2, 45.9)), flight(MINNESOTA)), max_distance_m=2e5)
    assert said == ["geo.txt: positions lie 111.1 km from those of the photos' own tags (median of 8)."]


def test_a_mistake_of_less_than_the_limit_is_refused_where_it_explains_the_distance():
    place = (45.0, 45.01)  # 1.3 km from its own mirror image
    with pytest.raises(JaxbaError, match=r"lie 1\.\d km from .*With x and y swapped it would be 0\.00 km"):
        held(listed("EPSG:4326", flight(place)[:, SWAP], flight(place)))


@settings(max_examples=15)
@given(
    st.floats(-179, 179), st.floats(-75, 75), st.floats(0, 90), st.integers(0, 3), st.integers(0, 4),
    st.sampled_from(["UTM", "EPSG:4326", "EPSG:3857"]),
)  # fmt: skip
def test_a_list_that_is_right_passes_whatever_its_tags_are_worth(lon, lat, off_m, bad, missing, crs):
    """PPK beside a plain receiver's tags, some of them nonsense or missing."""
    place, tags = (lon, lat), flight((lon, lat))
    crs = utm_zone(lon, lat).to_string() if crs == "UTM" else crs
    xyz = projected(place, int(crs.removeprefix("EPSG:")))
    tags[:, :2] += off_m / 111_200 / np.sqrt(2) * np.sign(np.sin(np.arange(16).reshape(8, 2)))
    tags[:bad, :2] = np.array([[12.0, 1.0], [0.0, 0.0], [-170.0, -80.0]])[:bad]
    tags[8 - missing :] = np.nan
    if missing == 4:
        tags[:bad] = np.nan  # of four, not three are nonsense
    (said, *rest) = held(listed(crs, xyz, tags))
    assert "geo.txt" in said and all("too few" in note for note in rest)


def test_one_tag_of_many_photos_judges_nothing_and_the_area_of_use_does():
    tags = np.full((8, 3), np.nan)
    tags[3] = [2.0, 2.0, 0.0]
    (said,) = held(listed("EPSG:32615", projected(MINNESOTA, 32615), tags))
    assert "1 of its 8 photos have a position in their tags, too few" in said
    for without in (tags, np.full((8, 3), np.nan)):
        for crs, xyz in (
            ("EPSG:32632", flight(ZURICH)),
            ("EPSG:32632", projected(ZURICH, 32632)[:, SWAP]),
            ("+proj=utm +zone=32 +datum=WGS84 +units=us-ft", projected(ZURICH, 32632)[:, SWAP]),
        ):
            with pytest.raises(JaxbaError, match=r"geo.txt: .*(does not contain|has no place).*Swap x and y"):
                held(listed(crs, xyz, without))
    assert held(listed("EPSG:4326", flight(ZURICH), np.full((8, 3), np.nan))) == []


@pytest.mark.parametrize(
    ("crs", "code", "factor", "words"),
    [
        ("EPSG:26851", 26851, US_FOOT_M, "224.5 m below those of the photos' own tags (median). Read as metres they"),
        ("EPSG:32615", 32615, 1 / FOOT_M, "736.7 m above those of the photos' own tags (median). Read as feet they"),
        ("EPSG:32615", 32615, 2.0, "Check their unit, and what they are above"),
        ("EPSG:32615", 32615, 1.3, ""),  # 97 m: a geoid's
    ],
)
def test_heights_of_another_unit_are_said(crs: str, code: int, factor: float, words: str):
    said = held(listed(crs, projected(MINNESOTA, code) * [1, 1, factor], flight(MINNESOTA)))
    assert len(said) == 1 + bool(words) and words in said[-1]
