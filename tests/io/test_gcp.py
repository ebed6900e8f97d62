"""gcp_list.txt and CSV lists of control points."""

from pathlib import Path

import pytest
from pyproj import CRS

from jaxba._errors import JaxbaError
from jaxba.io import parse_control

LIST = """EPSG:32615
# a comment
576308.60 5183424.70 198.25 1200.5 900 a.jpg gcp01 surveyed on Monday

576308.60 5183424.70 198.25 310 905 b.jpg gcp01
576320.00\t5183430.00\t197.5\t20\t30\tflight 2/b.jpg\tgcp 02
"""


def test_documented_form_is_read():
    first, second = parse_control(LIST).points
    assert (first.name, first.crs, first.x, first.y, first.z_m) == ("gcp01", "EPSG:32615", 576308.6, 5183424.7, 198.25)
    assert [(m.image, m.x_px, m.y_px) for m in first.marks] == [("a.jpg", 1200.5, 900.0), ("b.jpg", 310.0, 905.0)]
    assert first.marks[1].source == "gcp_list.txt line 5"
    assert (second.name, second.marks[0].image) == ("gcp 02", "flight 2/b.jpg")  # tabs leave blanks in names
    assert not first.is_check and first.std_h_m is None


def test_a_crs_that_is_given_is_that_of_lists_that_name_none():
    mark = "576308.6 5183424.7 198.2 1200 900 a.jpg g1"
    table = "name,x,y,z,px,py,image\ng1,576308.6,5183424.7,198.2,1200,900,a.jpg"
    for text, expected in (
        (mark, "EPSG:32616"),
        (f"EPSG:32615\n{mark}", "EPSG:32615"),
        (table, "EPSG:32616"),
        (f"# EPSG:32615\n{table}", "EPSG:32615"),
    ):
        (point,) = parse_control(text, crs="EPSG:32616").points
        assert (point.crs, point.x, len(point.marks)) == (expected, 576308.6, 1)
    with pytest.raises(JaxbaError, match=r"gcp_list\.txt line 2: '5 6' has 2 columns"):
        parse_control(f"{mark}\n5 6", crs="EPSG:32616")


def test_points_without_names_are_told_apart_by_their_coordinates():
    text = "EPSG:32615\n1 2 3 10 20 a.jpg\n4 5 6 11 21 a.jpg point2\n7 8 9 12 22 a.jpg\n1 2 3 13 23 b.jpg\n"
    found = {point.name: [m.image for m in point.marks] for point in parse_control(text).points}
    assert found == {"point1": ["a.jpg", "b.jpg"], "point2": ["a.jpg"], "point3": ["a.jpg"]}


@pytest.mark.parametrize(
    ("name", "epsg", "points", "marks", "first"),
    [
        ("gcp/bellus_gcp_list.txt", 32617, 4, 4, (441024.15704911412, 4564001.8747091573, 345.1689312)),
        ("gcp/sheffield_cross_gcp_list.txt", 32617, 5, 25, (333158.20, 3102916.18, 3.0)),
        ("images/copr/gcp_list.txt", 32611, 10, 27, (235269.88, 3811198.11, 0.0)),
    ],
)
def test_real_lists_are_read_with_their_headers(data_dir: Path, name: str, epsg: int, points: int, marks: int, first):
    found = parse_control((data_dir / name).read_text()).points
    assert len(found) == points and sum(len(point.marks) for point in found) == marks
    assert (found[0].x, found[0].y, found[0].z_m) == first
    assert {CRS(point.crs).to_epsg(min_confidence=20) for point in found} == {epsg}
    assert len({point.name for point in found}) == points


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_csv_has_columns_by_name_in_any_order(separator: str):
    header = ["image", "px", "py", "Name", "Easting (m)", "northing", "height", "std_h", "std_v", "role"]
    rows = [
        ["a.jpg", "10", "20", "p1", "576308.6", "5183424.7", "198.2", "0.01", "0", "Check point"],
        ["b.jpg", "11", "21", "p1", "576308.6", "5183424.7", "198.2", "0.01", "0", "check"],
        ["a.jpg", "12", "22", "p2", "576300", "5183420", "", "", "", "control"],
    ]
    text = "\n".join(["# EPSG:32615", separator.join(header), *(separator.join(row) for row in rows)])
    one, two = parse_control(text, "points.csv").points
    assert (one.name, one.is_check, one.std_h_m, one.std_v_m, len(one.marks)) == ("p1", True, 0.01, None, 2)
    assert (two.name, two.is_check, two.z_m, two.crs) == ("p2", False, None, "EPSG:32615")


def test_csv_of_longitude_and_latitude_is_wgs_84():
    point = parse_control("name,lat,lon,alt,px,py,filename,colour\np,46.8,-92,198,1,2,a.jpg,red").points[0]
    assert (point.crs, point.x, point.y, point.z_m) == ("EPSG:4326", -92.0, 46.8, 198.0)
    assert "colour" in parse_control("name,lat,lon,alt,px,py,filename,colour\np,46.8,-92,198,1,2,a.jpg,red").notes[0]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty; give a CRS line"),
        ("EPSG:32615\n", "lists no mark"),
        ("EPSG:99999\n1 2 3 4 5 a.jpg", "line 1: 'EPSG:99999' is no CRS; give EPSG:4326"),
        ("WGS84 UTM 61N\n1 2 3 4 5 a.jpg", "line 1: 'WGS84 UTM 61N': UTM zone 61 does not exist"),
        ("1 2 3 4 5 a.jpg", "line 1: '1 2 3 4 5 a.jpg' is no CRS"),
        ("EPSG:32615\n1;2;3;4;5;a.jpg", r"has 1 column; .*Separate columns by blanks, or name"),
        (
            "EPSG:4326\n93\u00b012.02'W 44 3 4 5 a.jpg",
            "line 2: x '93.*' is no number; write it in degrees with decimals",
        ),
        ("EPSG:4326\n93.2W 44 3 4 5 a.jpg", "line 2: x '93.2W' is no number; write it in degrees with decimals, south"),
        (
            "EPSG:4326\n484201.5 4971853 3 4 5 a.jpg",
            "longitude 484202 is out of range; .*It looks like metres: write the",
        ),
        ("EPSG:32615\n1 2 3 4 a.jpg", r"line 2: '1 2 3 4 a.jpg' has 5 columns; give x y z px py image"),
        ("EPSG:32615\n1 2 3,5 4 5 a.jpg", "line 2: z '3,5' is no number; write it with a point"),
        ("EPSG:32615\n1 nan 3 4 5 a.jpg", "line 2: y 'nan' is no number"),
        (
            "EPSG:32615\n1 2 NaN 4 5 a.jpg p\n1 2 3 4 5 b.jpg p",
            "line 3: p has z_m 3.0, and none in gcp_list.txt line 2",
        ),
        ("p1,576308.6,5183424.7,198.2\n", "line 1: 'p1,576308.6,5183424.7,198.2' is no CRS; .*name, longitude and lat"),
        ("p1;576308.6;5183424.7;198.2\n", "header that names its columns: .* px, py, image, and if known std_h"),
        ("p1 576308.6 5183424.7 198.2\n", "has the CRS on its first line, then lines `x y z px py image name`"),
        (
            "label,x,y,z\np1,576308.6,5183424.7,198.2\n",
            "line 1: columns label, x, y, z lack px, py, image; .*Coordinates",
        ),
        (
            "EPSG:32615\n1,2,3,4,5,a.jpg",
            "line 2: '1,2,3,4,5,a.jpg' has 1 column; .*Separate columns by blanks, or name",
        ),
        (
            "# CoordinateSystem: EPSG:32615\n#Label,X/Easting,Y/Northing,Z/Altitude\np,1,2,3\n",
            "line 2: columns Label, X/Easting, Y/Northing, Z/Altitude lack px, py, image",
        ),
        ("EPSG:4326\n44.9 -93.2 1 4 5 a.jpg", "line 2: latitude -93.2 is out of range; x is the longitude"),
        ("EPSG:32615\n1 2 3 4 5 a.jpg p\n1 2.5 3 4 5 b.jpg p", "line 3: p has y 2.5, and 2.0 in gcp_list.txt line 2"),
        ("EPSG:32615\n1 2 3 4 5 a.jpg p\n1 2 3 6 7 a.jpg p", "line 3: p is marked in a.jpg twice, at 6 7 here and 4 5"),
        ("name,x,y,px,image\np,1,2,3,a.jpg", "lack py; name them x, y"),
        ("name,x,y,z,px,py,image\np,1,2,3,4,5,a.jpg", "x and y need a CRS; add a crs column"),
        ("# EPSG:32615\nname,x,y,px,py,image,role\np,1,2,4,5,a.jpg,maybe", "line 3: role 'maybe' is not known"),
        ("# EPSG:32615\nname,x,y,px,py,image,std_h\np,1,2,4,5,a.jpg,-1", "line 3: std_h -1 is negative"),
        ("# EPSG:32615\nname,x,y,px,py,image\np,1,2,4,5,", "line 3: image '' is empty"),
        ("# EPSG:32615\nname,x,y,px,py,image\np,1,,4,5,a.jpg", "line 3: y '' is no number"),
    ],
)
def test_bad_lists_are_refused_with_line_field_and_cure(text: str, message: str):
    with pytest.raises(JaxbaError, match=message):
        parse_control(text)


def test_a_file_of_one_endless_line_is_refused_in_a_short_message():
    with pytest.raises(JaxbaError, match=r"line 1: '\{\"type\".*\.\.\.' is no CRS") as caught:
        parse_control('{"type": "' + "x" * 200_000 + '"}')
    assert len(str(caught.value)) < 500


def test_a_cell_too_long_to_be_one_is_refused_with_its_line():
    text = "name,x,y,z,px,py,image,crs\na,1,2,3,4,5,a.jpg,EPSG:32615\n" + "x" * 200_000 + ",1,2,3,4,5,a.jpg,EPSG:32615"
    with pytest.raises(JaxbaError, match="line 3: has 1 columns where the header has 8"):
        parse_control(text)


@pytest.mark.parametrize("word", ["NaN", "nan", "-nan", "N/A", "null", "-", "inf"])
def test_a_height_that_is_none_is_none_in_both_forms(word: str):
    (point,) = parse_control(f"EPSG:32615\n1 2 {word} 4 5 a.jpg p\n1 2 {word} 6 7 b.jpg p").points
    (row,) = parse_control(f"# EPSG:32615\nname,x,y,z,px,py,image,std_v\np,1,2,{word},4,5,a.jpg,{word}").points
    (empty,) = parse_control("EPSG:32615\n1\t2\t\t4\t5\ta b.jpg\tp 1").points
    assert point.z_m is row.z_m is row.std_v_m is empty.z_m is None and len(point.marks) == 2
    assert (empty.name, empty.marks[0].image, empty.marks[0].x_px) == ("p 1", "a b.jpg", 4.0)


@pytest.mark.parametrize(
    ("name", "role", "is_check"),
    [
        ("CHK-1", "", True),
        ("chk-07", "", True),
        ("CHK_a", "", True),
        ("CHK-1", "control", False),
        ("gcp01", "check", True),
        ("GCP-CHK-1", "", False),
        ("CHK1", "", False),
        ("checker", "", False),
    ],
)
def test_role_is_that_of_the_column_else_of_the_name(name: str, role: str, is_check: bool):
    text = f"# EPSG:32615\nname,x,y,z,px,py,image,role\n{name},1,2,3,4,5,a.jpg,{role}"
    assert parse_control(text).points[0].is_check == is_check
    if not role:
        assert parse_control(f"EPSG:32615\n1 2 3 4 5 a.jpg {name}").points[0].is_check == is_check


def test_a_csv_may_stand_below_a_crs_and_its_header_in_a_comment():
    rows = "p,1,2,3,4,5,a.jpg"
    for head in ("EPSG:32615\nname,x,y,z,px,py,image", "# words\n# crs: 32615\n#Name,x,y,z,px,py,image"):
        (point,) = parse_control(f"{head}\n{rows}").points
        assert (point.name, point.crs, point.z_m) == ("p", "EPSG:32615", 3.0)


def test_one_accuracy_is_that_of_all_axes():
    (point,) = parse_control("# EPSG:32615\nname,x,y,z,px,py,image,Accuracy (m)\np,1,2,3,4,5,a.jpg,0.02").points
    assert (point.std_h_m, point.std_v_m) == (0.02, 0.02)


@pytest.mark.parametrize(
    "text",
    [
        "EPSG:32615\nNaN NaN NaN 10 20 a.jpg t1\nnan nan nan 11 21 b.jpg t1\n1 2 3 12 22 a.jpg gcp01\n",
        "# EPSG:32615\nname,x,y,z,px,py,image\nt1,,,,10,20,a.jpg\nt1,,,,11,21,b.jpg\ngcp01,1,2,3,12,22,a.jpg\n",
    ],
)
def test_a_point_without_coordinates_has_marks_alone(text: str) -> None:
    target, point = parse_control(text).points
    assert (target.name, target.is_surveyed, target.crs, len(target.marks)) == ("t1", False, "", 2)
    assert (point.name, point.is_surveyed, point.x, point.crs) == ("gcp01", True, 1.0, "EPSG:32615")


def test_a_list_of_marks_alone_needs_no_crs_and_each_point_a_name() -> None:
    (target,) = parse_control("name,x,y,px,py,image\nt1,,,10,20,a.jpg\n", "marks.csv").points
    assert not target.is_surveyed
    with pytest.raises(JaxbaError, match=r"line 2: a point without coordinates needs a name"):
        parse_control("name,x,y,px,py,image\n,,,10,20,a.jpg\n", "marks.csv")
    with pytest.raises(JaxbaError, match=r"line 2: y '' is no number"):
        parse_control("name,x,y,px,py,image,crs\nt1,5,,10,20,a.jpg,EPSG:32615\n", "marks.csv")
    with pytest.raises(JaxbaError, match=r"line 3: t1 has crs none, and EPSG:32615 in gcp_list.txt line 2; give one"):
        parse_control("EPSG:32615\n1 2 3 12 22 a.jpg t1\nNaN NaN NaN 10 20 b.jpg t1\n")
