"""Simulated photos' tags read back, by Pillow and by jaxba's own reader."""

import hashlib
import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image

from jaxba.scene import Attitude, PhotoFile
from jaxba.simulation import PhotoTags, jpeg_with_tags
from jaxba.vision._photo import read_photo

TAGS = PhotoTags(
    make="jaxba",
    model="simulated",
    time="2024:06:01 10:00:00",
    focal_mm=11.06,
    focal_35mm=29,
    sensor_width_mm=13.2,
    latitude_deg=44.900123456789,
    longitude_deg=-93.200987654321,
    altitude_m=319.98765,
    relative_altitude_m=70.123,
    gimbal=Attitude(yaw_deg=-179.5, pitch_deg=-89.25, roll_deg=0.0),
    flight=Attitude(yaw_deg=178.25, pitch_deg=1.5, roll_deg=-2.5),
    std_h_m=0.03,
    std_v_m=0.05,
    is_rtk=True,
)
PICTURE = np.random.default_rng(0).integers(0, 256, size=(90, 120, 3), dtype=np.uint8)
MM_IN_DEGREES = 0.001 / 111_000


def read_back(folder: Path, tags: PhotoTags):
    content = jpeg_with_tags(PICTURE, tags)
    path = folder / "SIM_0001.JPG"
    path.write_bytes(content)
    return read_photo(PhotoFile(name=path.name, path=path, sha256=hashlib.sha256(content).hexdigest()))


@pytest.mark.parametrize("latitude", [44.900123456789, -33.99999999999, 0.0, 59.999999999999])
@pytest.mark.parametrize("longitude", [-93.200987654321, 179.9999999, 0.0000001])
def test_position_in_exif_is_true_to_a_tenth_of_a_millimetre(latitude: float, longitude: float):
    content = jpeg_with_tags(PICTURE, replace(TAGS, latitude_deg=latitude, longitude_deg=longitude))
    gps = Image.open(io.BytesIO(content)).getexif().get_ifd(ExifTags.IFD.GPSInfo)
    for value, parts, letter, letters in (
        (latitude, gps[ExifTags.GPS.GPSLatitude], gps[ExifTags.GPS.GPSLatitudeRef], "NS"),
        (longitude, gps[ExifTags.GPS.GPSLongitude], gps[ExifTags.GPS.GPSLongitudeRef], "EW"),
    ):
        assert all(0 <= part < 60 for part in parts[1:])
        angle = sum(float(part) / 60**power for power, part in enumerate(parts))
        assert abs((-angle if letter == letters[1] else angle) - value) < 0.1 * MM_IN_DEGREES


def test_height_below_zero_has_its_reference():
    content = jpeg_with_tags(PICTURE, replace(TAGS, altitude_m=-12.3456))
    gps = Image.open(io.BytesIO(content)).getexif().get_ifd(ExifTags.IFD.GPSInfo)
    assert gps[ExifTags.GPS.GPSAltitudeRef] == b"\x01"
    assert float(gps[ExifTags.GPS.GPSAltitude]) == pytest.approx(12.3456, abs=1e-4)


def test_reader_finds_what_was_written(tmp_path: Path):
    photo = read_back(tmp_path, TAGS)
    assert photo.notes == ()
    assert (photo.width_px, photo.height_px, photo.orientation) == (120, 90, 1)
    assert (photo.make, photo.model, photo.time) == ("jaxba", "simulated", "2024-06-01T10:00:00")
    assert photo.focal_source == "focal_plane"
    assert photo.focal_px == pytest.approx(11.06 / 13.2 * 120, rel=1e-6)
    assert photo.attitude == TAGS.gimbal
    assert photo.flight_attitude == TAGS.flight
    position = photo.position
    assert position is not None and position.z_m is not None
    assert abs(position.x - TAGS.longitude_deg) < 0.1 * MM_IN_DEGREES
    assert abs(position.y - TAGS.latitude_deg) < 0.1 * MM_IN_DEGREES
    assert abs(position.z_m - TAGS.altitude_m) < 1e-4
    assert (position.height_kind, position.fix) == ("ellipsoidal", "rtk_fixed")
    assert (position.std_h_m, position.std_v_m) == (0.03, 0.05)
    assert position.relative_altitude_m == 70.123


def test_without_rtk_no_fixed_solution_is_claimed(tmp_path: Path):
    position = read_back(tmp_path, replace(TAGS, is_rtk=False, std_h_m=1.5)).position
    assert position is not None
    assert position.fix == "unknown"
    assert position.std_h_m == pytest.approx(1.5)


def test_names_with_marks_of_xml_survive(tmp_path: Path):
    photo = read_back(tmp_path, replace(TAGS, model='a<b&c"d'))
    assert photo.notes == ()
    assert photo.model == 'a<b&c"d'


def test_picture_keeps_its_colours_and_bytes_repeat():
    patches = np.zeros((64, 64, 3), np.uint8)
    patches[:, :32] = [200, 40, 20]  # blue, green, red
    content = jpeg_with_tags(patches, TAGS)
    red_first = np.asarray(Image.open(io.BytesIO(content)))
    assert np.abs(red_first[32, 8].astype(int) - [20, 40, 200]).max() < 6  # what JPEG loses
    assert jpeg_with_tags(patches, TAGS) == content
