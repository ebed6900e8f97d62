"""Focal length in pixels and its source."""

import json
from pathlib import Path
from typing import Any

import pytest
from PIL import ExifTags
from tagged_photos import file_of, tagged, write_photo

from jaxba._errors import JaxbaError
from jaxba.vision import read_photo

BASE = ExifTags.Base
MM, FILM = BASE.FocalLength, BASE.FocalLengthIn35mmFilm
WIDTH, HEIGHT = BASE.ExifImageWidth, BASE.ExifImageHeight
PLANE_X, PLANE_UNIT = BASE.FocalPlaneXResolution, BASE.FocalPlaneResolutionUnit
P4RTK: dict[str, Any] = {"make": "DJI", "model": "FC6310R"}
CALIBRATED = {
    "drone-dji:CalibratedFocalLength": "3666.666504",
    "drone-dji:CalibratedOpticalCenterX": "2736.000000",
    "drone-dji:CalibratedOpticalCenterY": "1824.000000",
}


@pytest.mark.parametrize(
    ("photo", "film_mm", "source"),
    [
        # 35 mm equivalents of the makers' data sheets, at the focal length in the tags
        ("images/brighton/DJI_0018.JPG", 20, "sensor_table"),
        ("images/seneca40/IMG_0464.jpg", 24, "focal_plane"),
        ("images/caliterra/IMG_9354.jpg", 25, "focal_plane"),
        ("images/copr/IMG_0022.jpg", 30 * 1.62, "focal_plane"),
        ("exif/issue-exifr-13.jpg", 28, "sensor_table"),
        ("exif/tif-with-iptc-icc-xmp.tif", 200, "focal_plane"),
    ],
)
def test_focal_length_is_that_of_the_makers_35mm_equivalent(data_dir: Path, photo: str, film_mm: float, source: str):
    read = read_photo(file_of(data_dir / photo))
    diagonal = (read.width_px**2 + (read.width_px * (2 / 3 if film_mm in (28, 200) else 3 / 4)) ** 2) ** 0.5
    if "copr" in photo:
        diagonal = (read.width_px**2 + read.height_px**2) ** 0.5
    # data sheets round the equivalent to whole millimetres
    assert read.focal_px == pytest.approx(film_mm / 43.2666 * diagonal, rel=0.02)
    assert read.focal_source == source


@pytest.mark.parametrize(
    ("photo", "original_width"),
    [("seneca40/IMG_0464.jpg", 4000), ("caliterra/IMG_9354.jpg", 4000), ("copr/IMG_0022.jpg", 4272)],
)
def test_resized_photo_has_colmaps_focal_length_times_the_scale(data_dir: Path, photo: str, original_width: int):
    pycolmap = pytest.importorskip("pycolmap")
    path = data_dir / "images" / photo
    read = read_photo(file_of(path))
    # COLMAP trusts the focal-plane resolution as it stands, which belongs to the original size
    of_original = pycolmap.infer_camera_from_image(str(path)).focal_length
    assert read.focal_px == pytest.approx(of_original * read.width_px / original_width, rel=1e-4)


def test_phone_without_a_model_is_told_by_its_lens_and_near_to_the_adjusted_focal_length(data_dir: Path):
    folder = data_dir / "opensfm" / "berlin"
    adjusted = json.loads((folder / "reconstruction_example.json").read_text())[0]["cameras"]
    read = read_photo(file_of(folder / "images" / "01.jpg"))
    (camera,) = adjusted.values()
    assert read.model == "iPhone 4S"
    assert read.focal_px == pytest.approx(camera["focal"] * read.width_px, rel=0.1)


def test_sources_are_taken_in_their_order(tmp_path: Path):
    exif = {MM: 8.8, FILM: 24, WIDTH: 5472, HEIGHT: 3648, PLANE_X: 5472 / 13.0, PLANE_UNIT: 4}
    size_px = (1368, 912)
    all_of_them = tagged(tmp_path, size_px, **P4RTK, exif=exif, xmp=CALIBRATED)
    assert all_of_them.focal_source == "calibrated"
    assert all_of_them.focal_px == pytest.approx(3666.666504 / 4)
    no_calibration = tagged(tmp_path, size_px, **P4RTK, exif=exif)
    assert no_calibration.focal_source == "focal_plane"
    assert no_calibration.focal_px == pytest.approx(8.8 / 13.0 * 1368)
    exif = {MM: 8.8, FILM: 24}
    in_table = tagged(tmp_path, size_px, **P4RTK, exif=exif)
    assert (in_table.focal_source, in_table.focal_px) == ("sensor_table", pytest.approx(8.8 / 13.2 * 1368))
    unknown = tagged(tmp_path, size_px, make="Acme", model="One", exif=exif)
    assert unknown.focal_source == "equivalent_35mm"
    assert unknown.focal_px == pytest.approx(24 / 36 * 1368, rel=1e-3)  # on a 3:2 frame, as film's
    nothing = tagged(tmp_path, size_px, make="Acme", model="One")
    assert (nothing.focal_source, nothing.focal_px) == (None, None)
    assert any("--focal" in note for note in nothing.notes)


def test_given_focal_length_wins_and_a_contradicting_tag_is_noted(tmp_path: Path):
    file = write_photo(tmp_path / "a.jpg", (1368, 912), **P4RTK, exif={MM: 8.8}, xmp=CALIBRATED)
    near, far = read_photo(file, focal_px=950.0), read_photo(file, focal_px=1200.0)
    assert (near.focal_px, near.focal_source, near.notes) == (950.0, "given", ())
    assert (far.focal_px, far.focal_source) == (1200.0, "given")
    assert "1200 px, is used; the tags say 917 px" in " ".join(far.notes)


@pytest.mark.parametrize(
    "exif",
    [
        {WIDTH: 5472, HEIGHT: 3648},  # stale
        {WIDTH: 1000, HEIGHT: 667},  # rewritten
        {WIDTH: 4000, HEIGHT: 2667},  # neither
        {},
    ],
)
def test_calibrated_focal_length_follows_a_resize_whatever_exif_says(tmp_path: Path, exif: dict):
    photo = tagged(tmp_path, (1000, 667), **P4RTK, exif=exif, xmp=CALIBRATED)
    assert photo.focal_px == pytest.approx(3666.666504 * 1000 / 5472)


@pytest.mark.parametrize("exif", [{WIDTH: 5280, HEIGHT: 3956}, {WIDTH: 1320, HEIGHT: 989}])
def test_dewarp_data_belongs_to_the_sensors_grid(tmp_path: Path, exif: dict):
    words = "2022-06-09;3713.29,3713.29,7.02,-8.72,-0.11257524,0.01487443,-0.00008571,0.00000000,0.01"
    xmp = {"drone-dji:DewarpData": words, "drone-dji:DewarpFlag": "0"}
    photo = tagged(tmp_path, (1320, 989), make="DJI", model="M3E", exif={MM: 12.29, **exif}, xmp=xmp)
    assert (photo.focal_source, photo.focal_px) == ("calibrated", pytest.approx(3713.29 / 4, rel=1e-3))


def test_focal_plane_follows_a_resize_that_rewrote_the_size_alone(tmp_path: Path):
    exif = {MM: 24.0, WIDTH: 1000, HEIGHT: 667, PLANE_X: 6000 / 23.5, PLANE_UNIT: 4, FILM: 36}
    in_table = tagged(tmp_path, (1000, 667), make="SONY", model="ILCE-6000", exif=exif)
    assert (in_table.focal_source, in_table.focal_px) == ("focal_plane", pytest.approx(24 / 23.5 * 1000))
    assert "6000 x 4000" in " ".join(in_table.notes)
    unknown = tagged(tmp_path, (1000, 667), make="Acme", model="One", exif=exif)
    assert (unknown.focal_source, unknown.focal_px) == ("equivalent_35mm", pytest.approx(1000, rel=1e-2))
    assert "passed over" in " ".join(unknown.notes)


@pytest.mark.parametrize(("resolution", "unit"), [(6000 / 23.5 * 25.4, 2), (6000 / 23.5 * 10, 3), (6000 / 23.5, 4)])
def test_focal_plane_units(tmp_path: Path, resolution: float, unit: int):
    exif = {MM: 24.0, WIDTH: 6000, HEIGHT: 4000, PLANE_X: resolution, PLANE_UNIT: unit}
    photo = tagged(tmp_path, (600, 400), make="Acme", model="One", exif=exif)
    assert photo.focal_px == pytest.approx(24 / 23.5 * 600)


def test_photos_cropped_to_another_format_keep_the_scale(tmp_path: Path):
    wide = tagged(tmp_path, (1368, 770), **P4RTK, exif={MM: 8.8})  # 16:9, all columns
    narrow = tagged(tmp_path, (1216, 912), **P4RTK, exif={MM: 8.8})  # 4:3, all rows
    upright = tagged(tmp_path, (912, 1368), **P4RTK, exif={MM: 8.8})
    for photo in (wide, narrow, upright):
        assert photo.focal_px == pytest.approx(8.8 / 13.2 * 1368, rel=1e-3)


def test_digital_zoom_lengthens_the_focal_length(tmp_path: Path):
    photo = tagged(tmp_path, (1000, 750), make="DJI", model="FC220", exif={MM: 4.73, BASE.DigitalZoomRatio: 2.0})
    assert photo.focal_px == pytest.approx(2 * 4.73 / 6.2 * 1000)


@pytest.mark.parametrize("space", ["Camera", "sensefly"])
def test_pix4ds_focal_length_is_in_millimetres(tmp_path: Path, space: str):
    xmp = {f"{space}:PerspectiveFocalLength": "10.5", f"{space}:PrincipalPoint": "6.56,4.38"}
    unknown = tagged(tmp_path, (1368, 912), make="Acme", model="One", xmp=xmp)
    assert (unknown.focal_source, unknown.focal_px) == ("calibrated", pytest.approx(10.5 / 13.12 * 1368, rel=2e-3))
    known = tagged(tmp_path, (1368, 912), make="senseFly", model="S.O.D.A.", exif={MM: 10.6}, xmp=xmp)
    assert known.focal_px == pytest.approx(10.5 / 13.2 * 1368)


def test_lens_of_a_drone_with_several_is_told_by_its_focal_length(tmp_path: Path):
    wide = tagged(tmp_path, (1320, 989), make="DJI", model="M3E", exif={MM: 12.29, FILM: 24})
    tele = tagged(tmp_path, (1000, 750), make="DJI", model="M3E", exif={MM: 29.8, FILM: 162})
    assert wide.focal_px == pytest.approx(24 / 43.2666 * 1650, rel=0.05)
    assert tele.focal_px == pytest.approx(162 / 43.2666 * 1250, rel=0.05)
    assert wide.camera != tele.camera


@pytest.mark.parametrize(
    ("tags", "stated", "specified"),
    [
        # a Phantom 3's lens is 3.61 mm over 6.2 mm: 582 px at 1000 columns
        ({"make": "DJI", "model": "FC300S", "exif": {MM: 8.8}}, "8.8 mm gives 1419 px", "582 px"),
        # a Phantom 4's is 8.8 mm over 13.2 mm: 667 px
        ({"make": "DJI", "model": "FC6310", "exif": {FILM: 35}}, "gives 972 px", "667 px"),
        (
            {"make": "DJI", "model": "FC6310", "xmp": {**CALIBRATED, "drone-dji:CalibratedFocalLength": "4400"}},
            "gives 804 px",
            "667 px",
        ),
        (
            {"make": "Canon", "model": "Canon EOS 6D", "exif": {MM: 50, PLANE_X: 1000.0, WIDTH: 5472, HEIGHT: 3648}},
            "50 mm gives 360 px",
            "1397 px",
        ),
    ],
)
def test_focal_length_off_the_specification_rejects_the_photo_with_the_numbers(
    tmp_path: Path, tags: dict, stated: str, specified: str
):
    file = write_photo(tmp_path / "IMG_1.jpg", (1000, 667), **tags)
    with pytest.raises(JaxbaError, match="pass --focal or fix the tag") as error:
        read_photo(file)
    assert stated in str(error.value) and specified in str(error.value) and "IMG_1.jpg" in str(error.value)
    assert read_photo(file, focal_px=700.0).focal_source == "given"


def test_limit_of_the_deviation_is_a_parameter(tmp_path: Path):
    file = write_photo(tmp_path / "a.jpg", (1000, 667), make="DJI", model="FC6310", exif={FILM: 27})  # 12% long
    assert read_photo(file).focal_source == "equivalent_35mm"
    with pytest.raises(JaxbaError, match="where 10% is allowed"):
        read_photo(file, max_focal_deviation=0.10)


def test_lens_that_can_be_changed_is_not_checked_against_one(tmp_path: Path):
    for focal_mm in (16.0, 200.0):
        photo = tagged(tmp_path, (1000, 667), make="SONY", model="ILCE-6000", exif={MM: focal_mm})
        assert photo.focal_px == pytest.approx(focal_mm / 23.5 * 1000)
