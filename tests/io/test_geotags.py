"""geo.txt and CSV lists that replace positions."""

import pytest
from pyproj import CRS

from jaxba._errors import JaxbaError
from jaxba.io import match_geotags, parse_geotags

# the example of OpenDroneMap's documentation
DOCUMENTED = """EPSG:4326
DJI_0028.JPG -91.9942096111111 46.84252125 198.609
DJI_0032.JPG -91.9938293055556 46.8424584444444 198.609
"""


def test_documented_example_is_read():
    tags = parse_geotags(DOCUMENTED)
    assert [entry.name for entry in tags.entries] == ["DJI_0028.JPG", "DJI_0032.JPG"]
    position = tags.entries[0].position
    assert (position.crs, position.x, position.y, position.z_m) == (
        "EPSG:4326", -91.9942096111111, 46.84252125, 198.609,
    )  # fmt: skip
    assert (position.std_h_m, position.std_v_m, position.source) == (None, None, "geo.txt line 2")
    assert tags.entries[0].yaw_pitch_roll_deg is None


@pytest.mark.parametrize(
    ("header", "crs"),
    [
        ("WGS84 UTM 17N", "EPSG:32617"),
        ("WGS84 UTM 5S", "EPSG:32705"),
        ("epsg:32617", "EPSG:32617"),
        ("+proj=utm +zone=17 +ellps=WGS84 +datum=WGS84 +units=m +no_defs", "EPSG:32617"),
        ("+proj=utm +zone=17 +south +datum=WGS84", "EPSG:32717"),
        ("+init=epsg:32617", "EPSG:32617"),
        (CRS("EPSG:32617").to_wkt("WKT1_ESRI"), "EPSG:32617"),
        ("+proj=utm +zone=17 +datum=WGS84 +units=us-ft", "+proj=utm +zone=17 +datum=WGS84 +units=us-ft"),
    ],
)
def test_header_is_a_code_or_what_a_code_says(header: str, crs: str):
    position = parse_geotags(f"{header}\na.jpg 441024.157 4564001.875 345.17\n").entries[0].position
    assert position.crs == crs
    assert CRS.from_user_input(position.crs).is_projected
    assert (position.x, position.y) == (441024.157, 4564001.875)


@pytest.mark.parametrize(
    ("header", "kind"),
    [
        ("EPSG:4326", "unknown"),
        ("EPSG:4979", "ellipsoidal"),
        ("EPSG:32633", "unknown"),
        ("EPSG:32633+5773", "mean_sea_level"),
    ],
)
def test_height_system_is_that_of_the_crs(header: str, kind: str):
    assert parse_geotags(f"{header}\na.jpg 15 47 300\n").entries[0].position.height_kind == kind


def test_all_columns_comments_tabs_and_blank_lines():
    text = "# a comment\n\nEPSG:32633\na.jpg 1 2 3 10 5 -4 0.02 0.05 a label\n\n# more\nb c.jpg\t1\t2\n"
    first, second = parse_geotags(text).entries
    assert first.yaw_pitch_roll_deg == (10.0, 5.0, -4.0)
    assert (first.position.std_h_m, first.position.std_v_m, first.line) == (0.02, 0.05, 4)
    assert (second.name, second.position.z_m, second.position.height_kind) == ("b c.jpg", None, "unknown")


def test_zeros_mean_not_known():
    (entry,) = parse_geotags("EPSG:32633\na.jpg 1 2 3 0 0 0 0 0\n").entries
    assert entry.yaw_pitch_roll_deg is None
    assert (entry.position.std_h_m, entry.position.std_v_m) == (None, None)


@pytest.mark.parametrize(
    ("pitch", "is_nadir_zero", "words"), [(-89.9, False, "-90 looks down"), (1.5, True, "0 looks")]
)
def test_meaning_of_pitch_is_told_by_its_median(pitch: float, is_nadir_zero: bool, words: str):
    lines = "\n".join(f"{k}.jpg 1 2 3 40 {pitch + k} 0" for k in range(3))
    tags = parse_geotags(f"EPSG:32633\n{lines}\n")
    assert tags.is_nadir_zero == is_nadir_zero
    assert words in " ".join(tags.notes)


def test_csv_by_names_of_columns():
    text = (
        "Image,Latitude [deg],Longitude [deg],Altitude (m),Yaw,Pitch,Roll,Accuracy Horizontal,Accuracy Vertical,Speed\n"
        'a.jpg,46.8,-91.9,198.6,10,-90,0,0.02,0.04,3\n"b, c.jpg",46.9,-91.8,,,,,,,\n'
    )
    tags = parse_geotags(text, "positions.csv")
    first, second = tags.entries
    assert (first.position.crs, first.position.x, first.position.y, first.position.z_m) == (
        "EPSG:4326",
        -91.9,
        46.8,
        198.6,
    )
    assert (first.position.std_h_m, first.position.std_v_m) == (0.02, 0.04)
    assert first.yaw_pitch_roll_deg == (10.0, -90.0, 0.0)
    assert (second.name, second.position.z_m, second.yaw_pitch_roll_deg) == ("b, c.jpg", None, None)
    assert (second.line, second.position.source) == (3, "positions.csv line 3")
    assert "Speed" in " ".join(tags.notes) and "Latitude" not in " ".join(tags.notes)


@pytest.mark.parametrize(
    "text",
    [
        "# EPSG:32617\nname,x,y,z\na.jpg,441024.1,4564001.8,345\n",
        "#crs: 32617\nname;easting;northing;height\na.jpg;441024.1;4564001.8;345\n",
        "name\tx\ty\tz\tcrs\na.jpg\t441024.1\t4564001.8\t345\tEPSG:32617\n",
        "name,x,y,z,epsg\na.jpg,441024.1,4564001.8,345,32617\n",
    ],
)
def test_csv_in_a_projected_crs(text: str):
    position = parse_geotags(text, "a.csv").entries[0].position
    assert (position.crs, position.x, position.y, position.z_m) == ("EPSG:32617", 441024.1, 4564001.8, 345.0)


def test_ellipsoidal_height_by_its_column():
    position = parse_geotags("name,lat,lon,ellipsoidal_height\na.jpg,46,-91,198\n").entries[0].position
    assert (position.z_m, position.height_kind) == (198.0, "ellipsoidal")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "geo.txt: is empty"),
        ("EPSG:4326\n", "lists no photo"),
        ("EPSG:99999\na.jpg 1 2\n", "line 1: 'EPSG:99999' is no CRS"),
        ("WGS84 UTM 61N\na.jpg 1 2\n", "UTM zone 61 does not exist"),
        ("a.jpg 1 2 3\n", "line 1: 'a.jpg 1 2 3' is no CRS"),
        ("EPSG:4326\na.jpg 1\n", "line 2: 'a.jpg 1' has 2 columns"),
        ("EPSG:4326\na.jpg 1 2 3 4\n", "line 2: has 5 columns"),
        ("EPSG:4326\na.jpg 1 2,5 3\n", "line 2: y '2,5' is no number"),
        ("EPSG:4326\na.jpg 1 nan 3\n", "line 2: y 'nan' is no number"),
        ("a.jpg,441024.1,4564001.8,345\n", "a header that names its columns: name, longitude and latitude or x and y"),
        ("a.jpg;441024.1;4564001.8\n", "line 1: 'a.jpg;441024.1;4564001.8' is no CRS; give EPSG:4326"),
        ("label x y z\na.jpg 1 2 3\n", "line 1: 'label x y z' is no CRS; give EPSG:4326"),
        ("EPSG:4326\na.jpg,1,2,3\n", "Separate columns by blanks, or name them in a header line"),
        ("EPSG:4326\na.jpg 46.8 -91.9 198\n", "line 2: latitude -91.9 is out of range; x is the longitude"),
        ("EPSG:4326\na.jpg 1 2 3 0 0 0 -1 1\n", "line 2: horizontal accuracy -1 is negative"),
        ("EPSG:4326\na.jpg 1 2\n\na.jpg 1 2\n", "line 4: a.jpg is on line 2 already"),
        ("name,x,y\na.jpg,1,2\n", "x and y need a CRS"),
        ("name,lat,height\na.jpg,1,2\n", "hold no position"),
        ("name,lat,lon\na.jpg,1\n", "line 2: has 2 columns where the header has 3"),
        ("name,lat,lon\na.jpg,one,2\n", "line 2: latitude 'one' is no number"),
        ("name,lat,lon\na.jpg,,2\n", "line 2: name or position is empty"),
    ],
)
def test_error_names_file_line_value_and_cure(text: str, message: str):
    with pytest.raises(JaxbaError) as error:
        parse_geotags(text)
    assert message in str(error.value)
    assert str(error.value).startswith("geo.txt")


@pytest.mark.parametrize("word", ["NaN", "nan", "N/A", "none", "-"])
def test_what_is_not_known_may_be_said_by_a_word(word: str):
    text = f"EPSG:32633\na.jpg 1 2 {word} 0 0 0 {word} {word}\nb.jpg 1 2 320 10 {word} 0 0.1 0.2\n"
    tags = parse_geotags(text)
    first, second = tags.entries
    assert (first.position.z_m, first.position.std_h_m, first.position.height_kind) == (None, None, "unknown")
    assert (second.position.z_m, second.position.std_v_m, second.yaw_pitch_roll_deg) == (320.0, 0.2, None)
    assert "geo.txt: 1 of 2 photos has no height (NaN or empty: a.jpg)." in tags.notes
    csv = f"name,lat,lon,alt,ellipsoidal_height\na.jpg,46,-91,{word},198\n"
    assert parse_geotags(csv).entries[0].position.z_m == 198.0


@pytest.mark.parametrize(("z", "words"), [("-9999", "-9999"), ("0.000", "0 where the others are 320.5 to 322")])
def test_a_height_that_is_none_is_not_used_and_named(z: str, words: str):
    tags = parse_geotags(f"EPSG:4979\na.jpg 1 2 320.5\nb.jpg 1 2 {z}\nc.jpg 1 2 322\n")
    assert [entry.position.z_m for entry in tags.entries] == [320.5, None, 322.0]
    assert [entry.position.height_kind for entry in tags.entries] == ["ellipsoidal", "unknown", "ellipsoidal"]
    assert any(f"1 of 3 photos has no height ({words}: b.jpg)" in note for note in tags.notes)


def test_a_list_whose_heights_are_all_0_has_none():
    tags = parse_geotags("EPSG:4326\na.jpg 1 2 0\nb.jpg 1 2 0.0\n")
    assert [entry.position.z_m for entry in tags.entries] == [None, None]
    assert any("all heights are 0" in note and "write 0.001" in note for note in tags.notes)


WGS_84 = (
    'GEOGCS["WGS 84",DATUM["World Geodetic System 1984",SPHEROID["WGS 84",6378137,298.257223563]],'
    'PRIMEM["Greenwich",0],UNIT["degree",0.01745329251994328]]'
)
UTM = CRS.from_epsg(32615).to_wkt("WKT1_GDAL")


@pytest.mark.parametrize(
    ("text", "crs", "place", "stds"),
    [
        (
            f"# CoordinateSystem: {WGS_84}\n#Label,X/Longitude,Y/Latitude,Z/Altitude,Accuracy\n"
            "DJI_1.JPG,-93.2,44.9,319.9,0.03\n",
            4326, (-93.2, 44.9, 319.9), (0.03, 0.03),
        ),
        (
            f"# CoordinateSystem: {UTM}\n#Label,X/Easting,Y/Northing,Z/Altitude,Accuracy_X/Y_(m),Accuracy_Z_(m),"
            "Yaw,Pitch,Roll,Error_(m),X_error,Y_error,Z_error,X_est,Y_est,Z_est\n"
            "DJI_1,484201.5,4971853.9,319.9,0.02,0.05,12.0,1.5,0.2,0.3,0.1,0.1,0.1,1,2,3\n",
            32615, (484201.5, 4971853.9, 319.9), (0.02, 0.05),
        ),
        (
            "# Cameras (1)\n# CoordinateSystem: WGS 84 / UTM zone 15N (EPSG::32615)\n#Label;X/East;Y/North;Z/Altitude\n"
            "DJI_1.JPG;484201.5;4971853.9;319.9;\n",
            32615, (484201.5, 4971853.9, 319.9), (None, None),
        ),
        ("#Label,X/Longitude,Y/Latitude,Z/Altitude\nDJI_1,-93.2,44.9,9.5\n", 4326, (-93.2, 44.9, 9.5), (None, None)),
        ("EPSG:32615\nname,x,y,z\nDJI_1.JPG,484201.5,4971853.9,9.5\n", 32615, (484201.5, 4971853.9, 9.5), (None, None)),
    ],
)  # fmt: skip
def test_reference_csv_of_metashape_is_read(text: str, crs: int, place: tuple, stds: tuple):
    tags = parse_geotags(text, "reference.csv")
    (entry,) = tags.entries
    position = entry.position
    assert CRS.from_user_input(position.crs).equals(CRS.from_epsg(crs), ignore_axis_order=True)
    assert (position.x, position.y, position.z_m) == place
    assert (position.std_h_m, position.std_v_m) == stds
    assert entry.yaw_pitch_roll_deg == ((12.0, 1.5, 0.2) if "Yaw" in text else None)
    assert any("Error_(m)" in note and "X_est" in note for note in tags.notes) == ("Yaw" in text)
    found, _ = match_geotags(tags, ["flight/DJI_1.JPG", "flight/DJI_2.JPG"], "reference.csv")
    assert list(found) == ["flight/DJI_1.JPG"]


def test_photos_without_a_position_in_the_list_are_named_and_a_word_of_explanation_is_no_header():
    tags = parse_geotags("#Label,X/Longitude,Y/Latitude,Z/Altitude\na.jpg,-93.2,44.9,319.9\nb.jpg,,,\n", "ref.csv")
    assert [entry.name for entry in tags.entries] == ["a.jpg"]
    assert "ref.csv: rows without a position are passed over: b.jpg." in tags.notes
    assert len(parse_geotags("# image, x, y, z\nEPSG:4326\na.jpg 1 2 3\n").entries) == 1
