"""What jaxba/io/README.md says is true: its examples are read, its tables of columns are those of the readers."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import pytest

import jaxba.io
from jaxba.io import (
    BAR_COLUMNS,
    BAR_RESULT_COLUMNS,
    CLOUD_COLUMNS,
    CONTROL_COLUMNS,
    SITE_COLUMNS,
    _gcp,
    _geotags,
    _list_cells,
    parse_bars,
    parse_control,
    parse_geotags,
    schema_markdown,
)

README = (Path(jaxba.io.__file__).parent / "README.md").read_text(encoding="utf-8")


def section(title: str) -> str:
    """Return what stands below a title, up to the next one."""
    found = re.search(rf"^## {re.escape(title)}\n(.*?)(?=^## |\Z)", README, re.M | re.S)
    assert found, title
    return found[1]


def examples(title: str) -> list[str]:
    return re.findall(r"^```\n(.*?)^```", section(title), re.M | re.S)


def spellings(columns: Mapping[str, Sequence[str]]) -> str:
    rows = [f"| `{name}` | {', '.join(f'`{title}`' for title in titles)} |\n" for name, titles in columns.items()]
    return "| column | accepted titles |\n| --- | --- |\n" + "".join(rows)


def test_geo_txt_is_read_as_described():
    (text,) = examples("geo.txt")
    first, second = parse_geotags(text).entries
    assert (first.name, first.position.crs) == ("DJI_0028.JPG", "EPSG:4326")
    assert (first.position.x, first.position.y, first.position.z_m) == (-91.9942096, 46.8425212, 198.609)
    assert (first.yaw_pitch_roll_deg, first.position.std_h_m) == (None, None)
    assert (second.yaw_pitch_roll_deg, second.position.std_h_m, second.position.std_v_m) == (
        (12.5, 0.0, 0.0),
        0.02,
        0.04,
    )
    assert parse_geotags(text).is_nadir_zero


def test_positions_as_csv_are_read_as_described():
    degrees, reference, metres = (parse_geotags(text, "positions.csv") for text in examples("Positions as CSV"))
    (entry,) = reference.entries
    assert (entry.name, entry.position.x, entry.position.z_m) == ("DJI_0028", -91.9942096, 198.609)
    assert (entry.position.std_h_m, entry.position.std_v_m) == (0.03, 0.03)
    first, second = degrees.entries
    assert (first.position.crs, first.position.x, first.position.y) == ("EPSG:4326", -91.9942096, 46.8425212)
    assert (first.yaw_pitch_roll_deg, first.position.std_h_m, first.position.std_v_m) == (
        (12.5, -90.0, 0.0),
        0.02,
        0.04,
    )
    assert (second.yaw_pitch_roll_deg, second.position.std_h_m) == (None, None)
    assert not degrees.is_nadir_zero and not any("not used" in note for note in (*degrees.notes, *metres.notes))
    (entry,) = metres.entries
    assert (entry.name, entry.position.crs) == ("DJI_0028.JPG", "EPSG:32615")
    assert (entry.position.x, entry.position.y, entry.position.z_m) == (576690.12, 5188170.55, 198.609)


def test_gcp_list_is_read_as_described():
    (text,) = examples("gcp_list.txt")
    first, second = parse_control(text).points
    assert (first.name, first.crs, first.x, first.y, first.z_m) == ("gcp01", "EPSG:32615", 576308.6, 5183424.7, 198.25)
    marks = [(mark.image, mark.x_px, mark.y_px) for mark in first.marks]
    assert marks == [("DJI_0028.JPG", 1200.5, 900.0), ("DJI_0032.JPG", 310.0, 905.0)]
    assert (second.name, len(second.marks), second.is_check) == ("gcp02", 1, False)


def test_control_points_as_csv_are_read_as_described():
    (text,) = examples("Control points as CSV")
    found = parse_control(text, "points.csv")
    first, second = found.points
    assert (first.name, first.crs, first.z_m, len(first.marks)) == ("gcp01", "EPSG:32615", 198.25, 2)
    assert (first.std_h_m, first.std_v_m, first.is_check) == (0.01, 0.02, False)
    assert (second.name, second.z_m, second.std_h_m, second.is_check) == ("gcp02", None, None, True)
    assert found.notes == ()


def test_check_list_is_read_as_described():
    (text,) = examples("Check points")
    (point,) = parse_control(text, "check_list.txt", "check").points
    assert (point.name, len(point.marks), point.z_m) == ("check01", 2, 198.9)


def test_scale_bars_are_read_as_described():
    (text,) = examples("Scale bars")
    first, second = parse_bars(text)
    assert (first.first, first.second, first.length_m, first.std_m) == ("gcp01", "gcp02", 28.819, 0.002)
    assert (second.first, second.std_m) == ("target03", None)


@pytest.mark.parametrize(
    ("title", "columns"),
    [
        ("Positions as CSV", _geotags._COLUMNS),
        ("Control points as CSV", _gcp._COLUMNS),
        ("Scale bars", BAR_COLUMNS),
    ],
)
def test_titles_of_columns_are_those_that_the_reader_takes(title: str, columns: Mapping[str, Sequence[str]]):
    assert spellings(columns) in section(title)


def test_roles_are_those_that_the_reader_takes():
    check, control = (
        ", ".join(f"`{role}`" if role else "empty" for role in roles) for roles in (_gcp._CHECK, _gcp._CONTROL)
    )
    assert f"| check | {check} |\n| control | {control} |\n" in section("Control points as CSV")


def test_heights_that_are_none_are_the_readers():
    low, high = _list_cells.HEIGHTS
    common = section("What all lists have in common")
    assert f"below {low:,.0f} or above {high:,.0f}" in common
    first, *others = _list_cells.FILLERS
    assert f"a {first:g} (or {', '.join(f'{value:g}' for value in others)}) that lies apart" in common
    assert f"more than {_list_cells._FAR:g}, or by more than {_list_cells._NEAR:g} and three times" in common


def test_threshold_of_pitch_is_the_readers():
    assert f"median pitch is below {_geotags._GIMBAL_PITCH_DEG:g} degrees" in section("geo.txt")


def test_table_of_the_tile_is_the_schema():
    assert schema_markdown() in README, "paste the output of jaxba.io.schema_markdown() into jaxba/io/README.md"


def test_columns_of_exported_tables_are_those_that_are_written():
    exported = section("What a run exports")
    for columns in (CLOUD_COLUMNS, CONTROL_COLUMNS, BAR_RESULT_COLUMNS, SITE_COLUMNS):
        assert "".join(f"| `{name}` | {meaning} |\n" for name, meaning in columns.items()) in exported
