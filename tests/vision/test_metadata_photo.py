"""What is read of a photo beside focal length and position, and what broken files give."""

from pathlib import Path

import pytest
from PIL import ExifTags, Image
from tagged_photos import NORTH_EAST, file_of, tagged, write_photo, xmp_packet

from jaxba._errors import JaxbaError
from jaxba.vision import read_photo, shared_cameras
from jaxba.vision._sensors import _ROWS
from jaxba.vision._xmp import BrokenXmp, parse_xmp

BASE = ExifTags.Base


@pytest.mark.parametrize(
    ("name", "size_px", "orientation"),
    [
        ("RangeError_Invalid_typed_array_length.jpg", (60, 42), 1),
        ("RangeError_Offset_outside_bounds.jpg", (100, 63), 1),
        ("broken1.jpg", (600, 900), 1),
        ("f6t.jpg", (80, 48), 6),
        ("f8t.jpg", (80, 48), 8),
        ("img_1771.jpg", (480, 360), 1),
        ("img_1771_no_exif.jpg", (480, 360), 1),
        ("issue-exifr-13.jpg", (100, 67), 1),
        ("issue-exifr-41-Error_Segment_Unreachable.jpg", (297, 396), 1),
        ("noexif.jpg", (250, 188), 1),
        ("tif-with-iptc-icc-xmp.tif", (35, 23), 1),
    ],
)
def test_awkward_file_is_read_with_its_stored_size(
    data_dir: Path, name: str, size_px: tuple[int, int], orientation: int
):
    photo = read_photo(file_of(data_dir / "exif" / name))
    assert (photo.width_px, photo.height_px) == size_px
    assert photo.orientation == orientation


def test_awkward_files_are_all_covered(data_dir: Path):
    assert len(list((data_dir / "exif").iterdir())) == 11


def test_findings_of_a_damaged_file_are_named(data_dir: Path):
    photo = read_photo(file_of(data_dir / "exif" / "broken1.jpg"))
    notes = " ".join(photo.notes)
    assert photo.position is None
    assert "GPSLatitude (nan, nan, nan)" in notes and "XMP is damaged" in notes
    assert (photo.model, photo.time) == ("Canon EOS 30D", "2007-08-15T10:13:13")
    assert "3504 x 2336" in notes and "600 x 900" in notes


@pytest.mark.parametrize("cut", [12, 40, 90, 140, 200])
def test_photo_with_cut_tags_stays(tmp_path: Path, cut: int):
    path = tmp_path / "a.jpg"
    exif = Image.Exif()
    exif[BASE.Make] = "Acme"
    exif.get_ifd(ExifTags.IFD.Exif).update({BASE.FocalLength: 8.8, BASE.FocalLengthIn35mmFilm: 24})
    exif.get_ifd(ExifTags.IFD.GPSInfo).update(NORTH_EAST)
    Image.new("RGB", (40, 30)).save(path, exif=exif.tobytes()[:cut])
    photo = read_photo(file_of(path))
    assert (photo.width_px, photo.height_px) == (40, 30)
    assert any(word in " ".join(photo.notes) for word in ("damaged", "cannot be read", "holds nothing"))


@pytest.mark.parametrize(("content", "reason"), [(b"", "it is empty"), (b"hello", "5 bytes"), (b"\xff\xd8\xff", "3 b")])
def test_file_that_is_no_image_is_refused(tmp_path: Path, content: bytes, reason: str):
    path = tmp_path / "a.jpg"
    path.write_bytes(content)
    with pytest.raises(JaxbaError, match=reason):
        read_photo(file_of(path))


def test_tiff_and_png_are_photos(tmp_path: Path):
    for suffix in ("tif", "png"):
        file = write_photo(
            tmp_path / f"a.{suffix}", (1000, 667), make="DJI", model="FC6310", xmp={"drone:RtkFlag": "1"}
        )
        photo = read_photo(file)
        assert (photo.model, photo.width_px, photo.height_px) == ("FC6310", 1000, 667)


def test_photo_of_over_100_megapixels_is_read_without_a_warning(tmp_path: Path):
    path = tmp_path / "a.png"
    Image.new("1", (12_000, 9_000)).save(path)
    assert read_photo(file_of(path)).megapixels == 108


def test_time_is_iso_with_fraction_and_offset(tmp_path: Path):
    exif = {BASE.DateTimeOriginal: "2024:06:01 10:20:30", BASE.SubsecTimeOriginal: "25"}
    assert tagged(tmp_path, exif=exif).time == "2024-06-01T10:20:30.250000"
    exif = {BASE.DateTimeOriginal: "2024:06:01 10:20:30", BASE.OffsetTimeOriginal: "+02:00"}
    assert tagged(tmp_path, exif=exif).time == "2024-06-01T10:20:30+02:00"


def test_time_that_is_none_counts_as_absent(tmp_path: Path):
    assert tagged(tmp_path, exif={BASE.DateTimeOriginal: "0000:00:00 00:00:00"}).time is None
    photo = tagged(tmp_path, exif={BASE.DateTimeOriginal: "2024:13:01 10:20:30"})
    assert photo.time is None
    assert "2024:13:01" in " ".join(photo.notes)


def test_camera_is_told_by_model_serial_lens_zoom_and_size(tmp_path: Path):
    same = {"make": "Acme", "model": "One", "exif": {BASE.FocalLength: 24.0, BASE.BodySerialNumber: "17"}}
    first = tagged(tmp_path, **same).camera
    assert first == "Acme One, serial 17, 24 mm, 400x300" == tagged(tmp_path, gray=40, **same).camera
    for change in (
        {"make": "Acme", "model": "Two", "exif": same["exif"]},
        {**same, "exif": {**same["exif"], BASE.BodySerialNumber: "18"}},
        {**same, "exif": {**same["exif"], BASE.FocalLength: 35.0}},
        {**same, "exif": {**same["exif"], BASE.LensModel: "Prime"}},
    ):
        assert tagged(tmp_path, **change).camera != first
    assert tagged(tmp_path, (300, 400), **same).camera != first


ONE = {
    "make": "DJI", "model": "Multi", "base": {}, "xmp": {},
    "exif": {BASE.FocalLength: 4.5, BASE.BodySerialNumber: "17", BASE.LensModel: "5.0-25.0 mm"},
}  # fmt: skip
"""Tags of a camera that no table knows."""


def cameras(folder: Path, *changes: dict) -> tuple[list[str], list[str]]:
    """Return the cameras of photos with `ONE`'s tags changed by group, and the notes on them."""
    photos = []
    for change in changes:
        tags = {k: {**v, **change.get(k, {})} if isinstance(v, dict) else change.get(k, v) for k, v in ONE.items()}
        photos.append(tagged(folder, **tags))
    shared, notes = shared_cameras(photos)
    return [photo.camera for photo in shared], notes


@pytest.mark.parametrize(
    "change",
    [
        {"exif": {BASE.DigitalZoomRatio: 2.0}},
        {"exif": {BASE.DigitalZoomRatio: 1.1}},
        {"exif": {BASE.FocalLengthIn35mmFilm: 48}},
        {"exif": {BASE.FocalLength: 4.7}},
        {"exif": {BASE.FocalLength: 29.8}},
        {"exif": {BASE.LensModel: "5.0-25.5 mm"}},
        {"exif": {BASE.LensModel: ""}},
        {"exif": {0xA435: "0042"}},
        {"exif": {BASE.BodySerialNumber: "18"}},
        {"xmp": {"Camera:BandName": "NIR"}},
        {"xmp": {"sensefly:RigCameraIndex": "1"}},
        {"xmp": {"drone-dji:ImageSource": "ZoomCamera"}},
        {"xmp": {"drone-dji:DroneSerialNumber": "1581B"}, "exif": {BASE.BodySerialNumber: ""}},
        {"xmp": {"drone-parrot:SerialNumber": "PI0402"}, "exif": {BASE.BodySerialNumber: "000"}},
        {"xmp": {"Camera:PerspectiveFocalLength": "1500", "Camera:PerspectiveFocalLengthUnits": "pixel"}},
        {"model": "Multi 2"},
    ],
)
def test_whatever_tells_lenses_apart_makes_two_cameras(tmp_path: Path, change: dict):
    stated = {"exif": {BASE.FocalLengthIn35mmFilm: 24, BASE.ExifImageWidth: 400, BASE.ExifImageHeight: 300}}
    names, notes = cameras(tmp_path, stated, {**change, "exif": {**stated["exif"], **change.get("exif", {})}}, stated)
    assert names[0] == names[2] != names[1] and notes == []


@pytest.mark.parametrize(
    "change",
    [
        {"exif": {BASE.FocalLength: 4.49}},
        {"exif": {BASE.FocalLength: 4.52}},
        {"exif": {BASE.DigitalZoomRatio: 1.0}},
        {"exif": {BASE.DigitalZoomRatio: 0.0}},
        {"exif": {BASE.FocalLengthIn35mmFilm: 25}},
        {"exif": {BASE.LensModel: "5.0 - 25.0 mm"}},
        {"exif": {BASE.LensModel: "5-25MM"}},
        {"exif": {BASE.LensModel: "5.0 -25.0  mm\x00\x00"}},
        {"exif": {BASE.BodySerialNumber: " 17 \x00"}},
        {"make": "Dji", "model": "multi "},
    ],
)
def test_rounding_and_spelling_tell_no_cameras_apart(tmp_path: Path, change: dict):
    stated = {"exif": {BASE.FocalLengthIn35mmFilm: 24}}
    names, notes = cameras(tmp_path, stated, stated, {**change, "exif": {**stated["exif"], **change.get("exif", {})}})
    assert set(names) == {"DJI Multi, serial 17, 5.0-25.0 mm, 4.5 mm, 400x300"}
    assert all("written in 2 ways and counts as one: 'DJI Multi, serial 17, 5.0-25.0 mm' (2) and" in n for n in notes)


def test_two_drones_of_one_model_are_two_cameras_where_no_camera_has_a_serial_number(tmp_path: Path):
    drones = [{"xmp": {"drone-dji:DroneSerialNumber": serial}} for serial in ("1581A", "1581B", "1581A", "0")]
    unnamed = [{**drone, "exif": {BASE.BodySerialNumber: "0"}} for drone in drones]
    assert [name.split(", ")[1] for name in cameras(tmp_path, *unnamed)[0]] == [
        "drone 1581A", "drone 1581B", "drone 1581A", "5.0-25.0 mm"
    ]  # fmt: skip
    assert len(set(cameras(tmp_path, *drones)[0])) == 1  # one camera that two drones carried


def test_bands_of_a_rig_and_zooms_are_named_after_what_tells_them_apart(tmp_path: Path):
    rig = [{"xmp": {"Camera:BandName": band, "Camera:RigCameraIndex": str(k)}} for k, band in enumerate(("Red", "NIR"))]
    zoomed = {"exif": {BASE.DigitalZoomRatio: 2.0}}
    assert cameras(tmp_path, *rig, zoomed, {})[0] == [
        "DJI Multi, serial 17, 5.0-25.0 mm, band Red, rig camera 0, 4.5 mm, 400x300",
        "DJI Multi, serial 17, 5.0-25.0 mm, band NIR, rig camera 1, 4.5 mm, 400x300",
        "DJI Multi, serial 17, 5.0-25.0 mm, 4.5 mm, 2x digital zoom, 400x300",
        "DJI Multi, serial 17, 5.0-25.0 mm, 4.5 mm, 400x300",
    ]


def test_a_lens_that_creeps_is_no_chain_of_one_camera(tmp_path: Path):
    creeping = [{"exif": {BASE.FocalLength: 4.5 * 1.008**k}} for k in range(6)]
    assert len(set(cameras(tmp_path, *creeping)[0])) == 3


def test_orientation_out_of_range_is_noted(tmp_path: Path):
    photo = tagged(tmp_path, base={BASE.Orientation: 9})
    assert photo.orientation == 1 and "Orientation 9" in " ".join(photo.notes)


def test_make_and_model_of_xmp_stand_in(tmp_path: Path):
    photo = tagged(tmp_path, xmp={"tiff:Make": "DJI", "tiff:Model": "FC6310"})
    assert (photo.make, photo.model) == ("DJI", "FC6310")


def test_xmp_reads_elements_lists_and_attributes_under_any_prefix():
    packet = b"""<?xpacket begin='\xef\xbb\xbf' id='W5M0MpCehiHzreSzNTczkc9d'?>
    <x:xmpmeta xmlns:x='adobe:ns:meta/'><rdf:RDF xmlns:rdf='http://www.w3.org/1999/02/22-rdf-syntax-ns#'>
    <rdf:Description rdf:about='' xmlns:a='http://www.dji.com/drone-dji/1.0/' a:RtkFlag='50'>
    <a:RelativeAltitude>+39.80</a:RelativeAltitude></rdf:Description>
    <rdf:Description xmlns:b='http://pix4d.com/camera/1.0/'>
    <b:PrincipalPoint><rdf:Seq><rdf:li>2.4</rdf:li><rdf:li>1.8</rdf:li></rdf:Seq></b:PrincipalPoint>
    </rdf:Description></rdf:RDF></x:xmpmeta><?xpacket end='w'?>\x00"""
    assert parse_xmp(packet) == {
        "drone-dji:RtkFlag": "50",
        "drone-dji:RelativeAltitude": "+39.80",
        "Camera:PrincipalPoint": "2.4,1.8",
    }


def test_xmp_that_blows_up_is_refused_and_the_photo_stays(tmp_path: Path):
    bomb = b'<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;">]><x>&b;</x>'
    with pytest.raises(BrokenXmp):
        parse_xmp(bomb)
    assert "XMP is damaged" in " ".join(tagged(tmp_path, xmp=bomb).notes)


def test_malformed_xmp_still_gives_what_text_search_finds(tmp_path: Path):
    packet = xmp_packet({"drone-dji:RelativeAltitude": "+12.5"}).replace(b"</rdf:RDF>", b"")
    photo = tagged(tmp_path, gps=NORTH_EAST, xmp=packet)
    assert photo.position is not None and photo.position.relative_altitude_m == 12.5
    assert "XMP is damaged" in " ".join(photo.notes)


def test_sensor_table_is_plausible():
    assert len(_ROWS) > 60
    for name, width_mm, width_px, height_px, focal_mm in _ROWS:
        assert name == name.lower()
        assert 0.8e-3 <= width_mm / width_px <= 12e-3, name  # pixel pitch, mm
        assert 1.2 <= width_px / height_px <= 1.55, name
        assert focal_mm is None or 0.4 <= focal_mm / width_mm <= 5, name
