"""Position, accuracy, heights and attitudes from the tags of each maker."""

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from PIL import ExifTags
from PIL.TiffImagePlugin import IFDRational
from tagged_photos import NORTH_EAST, file_of, tagged

from jaxba.scene import Attitude, cam_from_enu
from jaxba.vision import attitude_from_nadir_body, read_photo
from jaxba.vision._position import parse_angle

GPS = ExifTags.GPS
ALTITUDE = {GPS.GPSAltitude: 431.5, GPS.GPSAltitudeRef: b"\x00"}
DJI = {
    "drone-dji:AbsoluteAltitude": "+431.50",
    "drone-dji:RelativeAltitude": "+80.10",
    "drone-dji:GimbalYawDegree": "-127.10",
    "drone-dji:GimbalPitchDegree": "-89.90",
    "drone-dji:GimbalRollDegree": "+0.00",
    "drone-dji:FlightYawDegree": "-97.00",
    "drone-dji:FlightPitchDegree": "+0.90",
    "drone-dji:FlightRollDegree": "-3.20",
}


def degrees(yaw: float, pitch: float, roll: float) -> Attitude:
    return Attitude(yaw_deg=yaw, pitch_deg=pitch, roll_deg=roll)


def test_tags_of_a_real_dji_are_those_that_stand_in_its_file(data_dir: Path):
    for path in sorted((data_dir / "images" / "brighton").glob("*.JPG")):
        content = path.read_bytes().decode("latin-1")

        def written(name: str, content: str = content) -> float:
            found = re.search(rf"<drone-dji:{name}>([^<]*)</", content)
            assert found is not None
            return float(found[1])

        photo = read_photo(file_of(path))
        assert photo.attitude == degrees(*(written(f"Gimbal{a}Degree") for a in ("Yaw", "Pitch", "Roll")))
        assert photo.flight_attitude == degrees(*(written(f"Flight{a}Degree") for a in ("Yaw", "Pitch", "Roll")))
        assert photo.position is not None
        assert photo.position.relative_altitude_m == written("RelativeAltitude")
        assert photo.position.z_m == pytest.approx(written("AbsoluteAltitude"), abs=0.01)
        assert photo.position.height_kind == "unknown"  # of a DJI without RTK


def test_real_position_in_degrees(data_dir: Path):
    photo = read_photo(file_of(data_dir / "images" / "brighton" / "DJI_0018.JPG"))
    assert photo.position is not None
    # 46 deg 50' 33.3855" N, 91 deg 59' 40.4156" W
    assert photo.position.y == pytest.approx(46 + 50 / 60 + 33.3855 / 3600, abs=1e-12)
    assert photo.position.x == pytest.approx(-(91 + 59 / 60 + 40.4156 / 3600), abs=1e-12)
    assert (photo.position.crs, photo.time) == ("EPSG:4326", "2016-06-23T16:31:59")


def test_height_that_exif_rounds_has_the_digits_of_xmp(data_dir: Path):
    position = read_photo(file_of(data_dir / "exif" / "issue-exifr-13.jpg")).position
    assert position is not None
    assert (position.z_m, position.relative_altitude_m) == (1252.12, 125.3)  # EXIF: 1252


def test_altitude_type_speaks_for_a_photo_without_a_flag(tmp_path: Path):
    xmp = {**DJI, "drone-dji:AltitudeType": "RtkAlt"}
    with_type = tagged(tmp_path, gps={**NORTH_EAST, **ALTITUDE}, xmp=xmp).position
    failed = tagged(tmp_path, gps={**NORTH_EAST, **ALTITUDE}, xmp={**xmp, "drone-dji:RtkFlag": "0"}).position
    assert with_type is not None and with_type.height_kind == "ellipsoidal"
    assert failed is not None and failed.height_kind == "unknown"


@pytest.mark.parametrize(
    ("flag", "fix", "kind"),
    [
        ("50", "rtk_fixed", "ellipsoidal"),
        ("34", "rtk_float", "ellipsoidal"),
        ("16", "single", "ellipsoidal"),
        ("0", "unknown", "unknown"),
    ],
)
def test_rtk_flag_tells_fix_and_height_system(tmp_path: Path, flag: str, fix: str, kind: str):
    rtk = {"RtkFlag": flag, "RtkStdLon": "0.01102", "RtkStdLat": "0.01213", "RtkStdHgt": "0.02441"}
    xmp = {**DJI, **{f"drone-dji:{name}": value for name, value in rtk.items()}}
    photo = tagged(tmp_path, make="DJI", model="FC6310R", gps={**NORTH_EAST, **ALTITUDE}, xmp=xmp)
    assert photo.position is not None
    assert (photo.position.fix, photo.position.height_kind) == (fix, kind)
    assert photo.position.std_h_m == pytest.approx(np.sqrt((0.01102**2 + 0.01213**2) / 2))
    assert photo.position.std_v_m == 0.02441
    assert photo.position.relative_altitude_m == 80.1 and photo.position.z_m == 431.5
    assert ("RtkFlag 0" in " ".join(photo.notes)) == (flag == "0")


def test_finer_position_of_xmp_is_taken_only_where_exif_agrees(tmp_path: Path):
    finer = {"drone-dji:GpsLatitude": "47.5100000123", "drone-dji:GpsLongitude": "8.2500000321"}
    photo = tagged(tmp_path, gps=NORTH_EAST, xmp=finer)
    assert photo.position is not None
    assert (photo.position.y, photo.position.x, photo.position.source) == (47.5100000123, 8.2500000321, "XMP")
    older = {"drone-dji:GpsLatitude": "47.512", "drone-dji:GpsLongtitude": "8.25"}
    photo = tagged(tmp_path, gps=NORTH_EAST, xmp=older)
    assert photo.position is not None
    assert (photo.position.y, photo.position.source) == (pytest.approx(47.51), "EXIF")
    assert "XMP 47.5120000" in " ".join(photo.notes)


@pytest.mark.parametrize(
    ("seconds", "in_xmp", "y", "words"),
    [
        ((36.0, 0.0), "47.5101200000", 47.51012, ""),  # whole seconds, 15 m
        ((36.2, 0.3), "47.510053", 47.510053, ""),
        ((36.0, 0.0), "47.5103", 47.51, "XMP 47.5103000"),
        ((36.1234, 0.4321), "47.5100643", 47.5100342778, "XMP 47.5100643"),  # 3 m, as after post-processing
        ((36.1234, 0.4321), "47.510034", 47.510034, ""),
        ((36.1234, 0.4321), "47.5100", 47.5100342778, ""),  # XMP's own digits explain it
        ((36.1234, 0.4321), "47.51", 47.5100342778, ""),
        ((36.1234, 0.4321), "47.52", 47.5100342778, "XMP 47.5200000"),
    ],
)
def test_positions_of_exif_and_xmp_differ_by_no_more_than_their_digits_or_are_named(
    tmp_path: Path, seconds: tuple[float, float], in_xmp: str, y: float, words: str
):
    angles = {GPS.GPSLatitude: (47.0, 30.0, seconds[0]), GPS.GPSLongitude: (8.0, 15.0, seconds[1])}
    digits = len(in_xmp.partition(".")[2])
    xmp = {"drone-dji:GpsLatitude": in_xmp, "drone-dji:GpsLongitude": f"{8.25 + seconds[1] / 3600:.{digits}f}"}
    photo = tagged(tmp_path, gps={**NORTH_EAST, **angles}, xmp=xmp)
    assert photo.position is not None and photo.position.y == pytest.approx(y, abs=1e-9)
    notes = [note for note in photo.notes if "XMP" in note]
    assert (words in " ".join(notes)) if words else not notes, notes


def test_position_in_xmp_alone(tmp_path: Path):
    xmp = {"drone:GpsLatitude": "-33.5", "drone:GpsLongtitude": "-70.25", "drone:RelativeAltitude": "60"}
    photo = tagged(tmp_path, make="Autel Robotics", model="XT705", xmp=xmp)
    assert photo.position is not None
    assert (photo.position.y, photo.position.x, photo.position.relative_altitude_m) == (-33.5, -70.25, 60.0)


@pytest.mark.parametrize(
    ("ref", "z_m", "kind"),
    [
        (b"\x00", 431.5, "mean_sea_level"),
        (b"\x01", -431.5, "mean_sea_level"),
        (b"\x02", 431.5, "ellipsoidal"),
        (b"\x03", -431.5, "ellipsoidal"),
        (None, 431.5, "unknown"),
    ],
)
def test_altitude_reference_tells_sign_and_height_system(tmp_path: Path, ref: bytes | None, z_m: float, kind: str):
    altitude = {GPS.GPSAltitude: 431.5} | ({} if ref is None else {GPS.GPSAltitudeRef: ref})
    photo = tagged(tmp_path, gps={**NORTH_EAST, **altitude})
    assert photo.position is not None
    assert (photo.position.z_m, photo.position.height_kind) == (z_m, kind)


def test_south_and_west_are_negative_and_decimal_minutes_are_read(tmp_path: Path):
    gps = {
        GPS.GPSLatitudeRef: "S",
        GPS.GPSLatitude: (IFDRational(33), IFDRational(30303, 1000), IFDRational(0)),
        GPS.GPSLongitudeRef: "W",
        GPS.GPSLongitude: (IFDRational(70), IFDRational(15), IFDRational(0)),
    }
    position = tagged(tmp_path, gps=gps).position
    assert position is not None
    assert (position.y, position.x) == (pytest.approx(-(33 + 30.303 / 60)), -70.25)


@pytest.mark.parametrize(
    ("change", "note"),
    [
        ({GPS.GPSLatitude: (IFDRational(0, 0), IFDRational(0, 0), IFDRational(0, 0))}, "GPSLatitude (nan, nan, nan)"),
        ({GPS.GPSLatitude: (IFDRational(97), IFDRational(0), IFDRational(0))}, "position 97, 8.25 is out of range"),
        (
            {GPS.GPSLatitude: (IFDRational(0),) * 3, GPS.GPSLongitude: (IFDRational(0),) * 3},
            "position 0, 0 is what a receiver without a fix writes",
        ),
    ],
)
def test_impossible_position_counts_as_absent_and_is_named(tmp_path: Path, change: dict, note: str):
    photo = tagged(tmp_path, gps={**NORTH_EAST, **change})
    assert photo.position is None
    assert note in " ".join(photo.notes)


@pytest.mark.parametrize(
    ("letter", "in_xmp", "x", "words"),
    [
        (None, {}, 8.25, "EXIF has no GPSLongitudeRef, and nothing else states it: E is assumed"),
        ("", {}, 8.25, "E is assumed"),
        ("?", {}, 8.25, "GPSLongitudeRef '?' is neither E nor W"),
        (None, {"drone-dji:GpsLongitude": "-8.25"}, -8.25, "EXIF has no GPSLongitudeRef: W is taken from XMP"),
        (None, {"drone-dji:GpsLongtitude": "-8.2503"}, -8.25, "W is taken from XMP"),
        (None, {"drone:GpsLongtitude": "8.25"}, 8.25, "E is taken from XMP"),
        (None, {"exif:GPSLongitude": "8,15.0W"}, -8.25, "W is taken from XMP's exif tags"),
        ("E", {"drone-dji:GpsLongitude": "-8.25"}, -8.25, "EXIF says E (GPSLongitudeRef) and XMP says W"),
        ("W", {"drone-dji:GpsLongitude": "+8.25"}, 8.25, "EXIF says W (GPSLongitudeRef) and XMP says E"),
        ("W", {"drone:Longitude": "8.25"}, -8.25, ""),  # a maker that leaves signs out
        ("E", {"drone-dji:GpsLongitude": "-9.5"}, 8.25, "XMP 47.5100000, -9.5000000; EXIF is used"),
        ("W", {"drone-dji:GpsLongitude": "-8.25"}, -8.25, ""),
    ],
)
def test_a_hemisphere_is_taken_from_where_it_is_stated(
    tmp_path: Path, letter: str | None, in_xmp: dict[str, str], x: float, words: str
):
    gps = {**NORTH_EAST, GPS.GPSLongitudeRef: letter}
    latitude = {"exif:GPSLatitude": "47,30.6N"} if "exif:GPSLongitude" in in_xmp else {"drone:GpsLatitude": "47.51"}
    xmp = {**latitude, **in_xmp} if in_xmp else None
    photo = tagged(tmp_path, gps={tag: value for tag, value in gps.items() if value is not None}, xmp=xmp)
    assert photo.position is not None and photo.position.x == pytest.approx(x)
    assert (words in " ".join(photo.notes)) if words else photo.notes[1:] == (), photo.notes


def test_a_southern_latitude_is_taken_from_xmp_too(tmp_path: Path):
    xmp = {"drone-dji:GpsLatitude": "-47.51", "drone-dji:GpsLongitude": "8.25"}
    gps = {tag: value for tag, value in NORTH_EAST.items() if tag not in (GPS.GPSLatitudeRef, GPS.GPSLongitudeRef)}
    photo = tagged(tmp_path, gps=gps, xmp=xmp)
    assert photo.position is not None and (photo.position.y, photo.position.x) == (-47.51, 8.25)
    assert "S is taken from XMP" in " ".join(photo.notes) and "E is taken from XMP" in " ".join(photo.notes)


@pytest.mark.parametrize(
    ("z_m", "ref", "in_xmp", "height_m", "words"),
    [
        (320.55, 1, {"drone-dji:AbsoluteAltitude": "+320.55"}, 320.55, "below sea level (GPSAltitudeRef 1), XMP's"),
        (320.55, 1, {"drone:AbsoluteAltitude": "320.55"}, 320.55, "below sea level (GPSAltitudeRef 1), XMP's"),
        (320.0, 1, {"drone-dji:AbsoluteAltitude": "+320.55"}, 320.55, "below sea level"),
        (320.5, 3, {"drone-dji:AbsoluteAltitude": "+320.55"}, 320.55, "GPSAltitudeRef 3"),
        (2.5, 0, {"drone-dji:AbsoluteAltitude": "-2.50"}, -2.5, "above sea level (GPSAltitudeRef 0), XMP's"),
        (2.5, None, {"drone-dji:AbsoluteAltitude": "-2.50"}, -2.5, "EXIF has no GPSAltitudeRef: the sign"),
        (320.55, 1, {"drone-dji:AbsoluteAltitude": "+352.55"}, 320.55, "32.00 m below that of XMP's AbsoluteAltitude"),
        (12.0, 1, {"drone-dji:AbsoluteAltitude": "+35.00"}, -12.0, "47.00 m below that of XMP's AbsoluteAltitude"),
        (431.5, 0, {"drone-dji:AbsoluteAltitude": "+431.70"}, 431.5, "0.20 m below that of XMP's AbsoluteAltitude"),
        (431.52, 0, {"drone-dji:AbsoluteAltitude": "+399.17"}, 431.52, "32.35 m above that of XMP's AbsoluteAltitude"),
        (431.0, 0, {"drone-dji:AbsoluteAltitude": "+431.70"}, 431.7, ""),
        (0.0, 0, {"drone-dji:AbsoluteAltitude": "+431.70"}, 431.7, "EXIF is 0, that of XMP's AbsoluteAltitude 431.7 m"),
        (0.0, 0, {"drone-dji:AbsoluteAltitude": "+30.00"}, 0.0, "30.00 m below that of XMP's AbsoluteAltitude: they"),
        (
            320.55,
            0,
            {"drone-dji:AbsoluteAltitude": "+1051.67"},
            320.55,
            "XMP's AbsoluteAltitude: one is wrong; that of",
        ),
        (431.5, 1, {"exif:GPSAltitude": "863/2", "exif:GPSAltitudeRef": "0"}, 431.5, "XMP's exif:GPSAltitude puts it"),
        (431.5, None, {"exif:GPSAltitude": "863/2", "exif:GPSAltitudeRef": "1"}, -431.5, "the sign of its height"),
        (431.5, 1, {"exif:GPSAltitude": "863/2"}, -431.5, ""),
        (431.5, 0, {"drone-dji:RelativeAltitude": "+80.10"}, 431.5, ""),  # another thing
    ],
)
def test_heights_of_exif_and_xmp_are_compared_and_a_sign_is_taken_from_where_it_is_stated(
    tmp_path: Path, z_m: float, ref: int | None, in_xmp: dict[str, str], height_m: float, words: str
):
    altitude = {GPS.GPSAltitude: z_m} | ({} if ref is None else {GPS.GPSAltitudeRef: bytes([ref])})
    photo = tagged(tmp_path, gps={**NORTH_EAST, **altitude}, xmp=in_xmp)
    assert photo.position is not None and photo.position.z_m == pytest.approx(height_m)
    notes = [note for note in photo.notes if "focal" not in note]
    assert (words in " ".join(notes)) if words else notes == [], notes


def as_degrees(deg: float, axis: str) -> dict[str, str]:
    """Return an angle in each of the forms in which programs write it into XMP."""
    size, letter = abs(deg), ("NS" if axis == "Latitude" else "EW")[deg < 0]
    whole, minutes = int(size), 60 * (size - int(size))
    seconds = 60 * (minutes - int(minutes))
    return {
        "decimal minutes": f"{whole},{minutes:.9f}{letter}",
        "whole seconds": f"{whole},{int(minutes)},{seconds:.6f}{letter}",
        "letter first": f"{letter} {whole} {minutes:.9f}",
        "decimal": f"{size:.10f}{letter}",
        "signed": f"{deg:+.10f}",
        "words": f"{whole} deg {int(minutes)}' {seconds:.6f}\" {letter}",
        "degree signs": f"{whole}\u00b0{int(minutes)}\u2032{seconds:.6f}\u2033{letter.lower()}",
        "ratios": f"{whole}/1, {int(minutes)}/1, {round(seconds * 1e6)}/1000000 {letter}",
    }


@given(
    st.floats(-89.9, 89.9).filter(lambda deg: abs(deg) > 1e-6),
    st.floats(-179.9, 179.9).filter(lambda deg: abs(deg) > 1e-6),
)
@settings(max_examples=40)
def test_every_form_of_an_angle_in_plain_xmp_is_read(latitude: float, longitude: float):
    for deg, axis, letters in ((latitude, "Latitude", "NS"), (longitude, "Longitude", "EW")):
        for form, words in as_degrees(deg, axis).items():
            found = parse_angle(words, letters)
            assert found is not None, (form, words)
            assert found[0] == pytest.approx(deg, abs=2e-9) and found[1], (form, words)  # 1e-6 seconds are 3e-10


@pytest.mark.parametrize(
    "words",
    ["", "N", "north", "44,8999N", "44,53,60.1N", "44,-53N", "44,53,59,1N", "44/0,53N", "-44,53N", "nan", "4 4e"],
)
def test_what_is_no_angle_counts_as_absent(tmp_path: Path, words: str):
    assert parse_angle(words, "NS") is None
    photo = tagged(tmp_path, xmp={"exif:GPSLatitude": words, "exif:GPSLongitude": "93,12.0W"})
    assert photo.position is None
    assert (f"exif:GPSLatitude {words!r} is no angle" in " ".join(photo.notes)) == bool(words)


@pytest.mark.parametrize(
    ("change", "y", "z_m", "kind"),
    [
        ({}, 44.8999, 320.4, "mean_sea_level"),
        ({"exif:GPSAltitudeRef": "1"}, 44.8999, -320.4, "mean_sea_level"),
        ({"exif:GPSAltitudeRef": "2", "exif:GPSAltitude": "320.4"}, 44.8999, 320.4, "ellipsoidal"),
        ({"exif:GPSLatitude": "44.8999", "exif:GPSLatitudeRef": "S"}, -44.8999, 320.4, "mean_sea_level"),
        ({"exif:GPSAltitude": "n/a"}, 44.8999, None, "mean_sea_level"),
    ],
)
def test_position_in_plain_xmp_alone(tmp_path: Path, change: dict[str, str], y: float, z_m: float | None, kind: str):
    xmp = {
        "exif:GPSLatitude": "44,53.994N", "exif:GPSLongitude": "93,11.98687482W", "exif:GPSAltitude": "1602/5",
        "exif:GPSAltitudeRef": "0", "exif:GPSHPositioningError": "5/2",
    }  # fmt: skip
    position = tagged(tmp_path, xmp={**xmp, **change}).position
    assert position is not None
    assert (position.y, position.x) == (pytest.approx(y), pytest.approx(-93.199781247))
    assert (position.z_m, position.height_kind, position.std_h_m) == (z_m, kind, 2.5)
    assert position.source == "XMP"


def test_height_with_a_zero_denominator_counts_as_absent(tmp_path: Path):
    photo = tagged(tmp_path, gps={**NORTH_EAST, GPS.GPSAltitude: IFDRational(5, 0)})
    assert photo.position is not None
    assert (photo.position.z_m, photo.position.height_kind) == (None, "unknown")
    assert "GPSAltitude" in " ".join(photo.notes)


def test_stated_accuracy_of_plain_cameras_and_of_pix4ds_tags(tmp_path: Path):
    plain = tagged(tmp_path, gps={**NORTH_EAST, GPS.GPSHPositioningError: 3.5, GPS.GPSDOP: 1.5}).position
    assert plain is not None and (plain.std_h_m, plain.std_v_m) == (3.5, None)
    pix4d = tagged(
        tmp_path, gps=NORTH_EAST, xmp={"Camera:GPSXYAccuracy": "1/50", "Camera:GPSZAccuracy": "0.05"}
    ).position
    assert pix4d is not None and (pix4d.std_h_m, pix4d.std_v_m) == (0.02, 0.05)


def test_differential_correction_and_poor_dilution_are_told(tmp_path: Path):
    photo = tagged(tmp_path, gps={**NORTH_EAST, GPS.GPSDifferential: 1, GPS.GPSDOP: 12.0})
    assert photo.position is not None and photo.position.fix == "differential"
    assert "GPSDOP 12" in " ".join(photo.notes)


def test_attitudes_of_dji_autel_and_parrot(tmp_path: Path):
    dji = tagged(tmp_path, xmp=DJI)
    assert (dji.attitude, dji.flight_attitude) == (degrees(-127.1, -89.9, 0.0), degrees(-97.0, 0.9, -3.2))
    autel = {name.replace("drone-dji", "drone"): value for name, value in DJI.items()}
    assert tagged(tmp_path, xmp=autel).attitude == dji.attitude
    parrot = {
        "drone-parrot:CameraYawDegree": "176.310745",
        "drone-parrot:CameraPitchDegree": "-78.362686",
        "drone-parrot:CameraRollDegree": "-0.322913",
    }
    assert tagged(tmp_path, xmp=parrot).attitude == degrees(176.310745, -78.362686, -0.322913)


def test_gimbal_that_knows_nothing_writes_zeros(tmp_path: Path):
    zeros = {f"drone-dji:Gimbal{angle}Degree": "+0.00" for angle in ("Yaw", "Pitch", "Roll")}
    photo = tagged(tmp_path, xmp=zeros)
    assert photo.attitude is None
    assert "all 0" in " ".join(photo.notes)


@pytest.mark.parametrize("space", ["Camera", "sensefly"])
def test_camera_tags_are_turned_to_the_gimbals_convention(tmp_path: Path, space: str):
    # an Autel whose camera looks 24 degrees under the horizon writes 66
    xmp = {f"{space}:Yaw": "2.42", f"{space}:Pitch": "66.04", f"{space}:Roll": "0.00"}
    attitude = tagged(tmp_path, xmp=xmp).attitude
    assert attitude is not None
    assert (attitude.yaw_deg, attitude.pitch_deg, attitude.roll_deg) == pytest.approx((2.42, -23.96, 0.0))


@pytest.mark.parametrize("yaw", [0.0, 35.0, -120.0])
@pytest.mark.parametrize(("pitch", "roll"), [(0.0, 0.0), (5.0, 0.0), (-7.0, 12.0), (60.0, -20.0), (0.0, 8.0)])
def test_axes_of_a_camera_under_a_body_are_the_bodys(yaw: float, pitch: float, roll: float):
    enu_from_cam = cam_from_enu(attitude_from_nadir_body(yaw, pitch, roll)).T
    y, p, r = np.radians([yaw, pitch, roll])
    # the nose, in east, north, up: by yaw from north, lifted by pitch; the photo's top points there
    nose = np.array([np.sin(y) * np.cos(p), np.cos(y) * np.cos(p), np.sin(p)])
    np.testing.assert_allclose(-enu_from_cam[:, 1], nose, atol=1e-8)
    # the right wing, level before the roll, sinks with a positive one; the photo's right side points there
    level = np.array([np.cos(y), -np.sin(y), 0.0])
    below = np.cross(nose, level)
    np.testing.assert_allclose(enu_from_cam[:, 0], np.cos(r) * level + np.sin(r) * below, atol=1e-8)
