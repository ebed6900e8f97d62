"""Stage metadata on folders as users have them."""

import hashlib
import pickle
import shutil
from pathlib import Path

import pytest
from PIL import ExifTags, Image

from jaxba._errors import JaxbaError
from jaxba.pipeline import metadata
from jaxba.scene import Attitude, PhotoFile

BASE, GPS = ExifTags.Base, ExifTags.GPS


def files_of(folder: Path) -> tuple[PhotoFile, ...]:
    return tuple(
        PhotoFile(
            name=path.relative_to(folder).as_posix(), path=path, sha256=hashlib.sha256(path.read_bytes()).hexdigest()
        )
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    )


def run(folder: Path, geotags: str | None = None, **params) -> metadata.Outputs:
    return metadata.run(metadata.Inputs(files=files_of(folder), geotags=geotags), metadata.Params(**params))


def write(path: Path, *, gray: int = 0, size_px: tuple[int, int] = (1000, 667), model: str = "FC6310", mm: float = 8.8):
    path.parent.mkdir(parents=True, exist_ok=True)
    exif = Image.Exif()
    exif[BASE.Make], exif[BASE.Model] = "DJI", model
    exif.get_ifd(ExifTags.IFD.Exif).update({BASE.FocalLength: mm})
    Image.new("L", size_px, gray).save(path, exif=exif)


@pytest.mark.parametrize(
    ("folder", "count", "source", "num_positions"),
    [
        ("images/brighton", 18, "sensor_table", 18),
        ("images/seneca40", 40, "focal_plane", 40),
        ("images/caliterra", 40, "focal_plane", 40),
        ("images/copr", 41, "focal_plane", 0),
        ("opensfm/berlin/images", 3, "sensor_table", 3),
    ],
)
def test_real_survey_is_read_whole(data_dir: Path, folder: str, count: int, source: str, num_positions: int):
    outputs = run(data_dir / folder)
    assert len(outputs.photos) == count
    assert outputs.left_out == ()
    assert {photo.focal_source for photo in outputs.photos} == {source}
    assert len({photo.camera for photo in outputs.photos}) == 1
    assert len({photo.focal_px for photo in outputs.photos}) == 1
    assert sum(photo.position is not None for photo in outputs.photos) == num_positions
    assert [photo.name for photo in outputs.photos] == sorted(photo.name for photo in outputs.photos)


def test_stale_size_is_said_once_for_all_photos(data_dir: Path):
    (note,) = [note for note in run(data_dir / "images" / "seneca40").notes if "4000 x 3000" in note]
    assert note.startswith("40 photos (IMG_0464.jpg, IMG_0465.jpg, IMG_0471.jpg, ...): ")


def test_awkward_files_are_all_accounted_for(data_dir: Path):
    outputs = run(data_dir / "exif")
    assert len(outputs.photos) + len(outputs.left_out) == 11
    notes = " ".join(outputs.notes)
    assert "broken1.jpg: GPSLatitude (nan, nan, nan)" in notes
    assert "10 cameras, each with its own intrinsics" in notes


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ((), "the folder holds 0 files; give one with JPEG or TIFF photos"),
        (("geo.txt", "flight.srt", "b.srt"), "holds 3 files: 2 .srt, 1 .txt"),
        (("a.dng",), "1 file: 1 .dng"),
    ],
)
def test_folder_without_photos_is_refused_with_its_contents(tmp_path: Path, names: tuple[str, ...], message: str):
    for name in names:
        (tmp_path / name).write_text("words")
    with pytest.raises(JaxbaError) as error:
        run(tmp_path)
    assert message in str(error.value)


def test_folder_without_usable_photos_is_refused_with_the_reasons(tmp_path: Path):
    (tmp_path / "a.jpg").write_bytes(b"no image")
    write(tmp_path / "b.jpg", mm=50.0)
    with pytest.raises(JaxbaError) as error:
        run(tmp_path)
    assert "none of the 2 photos can be used" in str(error.value)
    assert "a.jpg: is no image" in str(error.value) and "b.jpg: focal length 50 mm gives" in str(error.value)


def test_one_photo_passes(tmp_path: Path):
    write(tmp_path / "a.jpg")
    outputs = run(tmp_path)
    assert [photo.name for photo in outputs.photos] == ["a.jpg"]
    assert (outputs.left_out, outputs.notes) == ((), ())


def test_duplicates_are_left_out_by_name(tmp_path: Path):
    write(tmp_path / "b.jpg")
    for copy in ("a.jpg", "c.jpg", "sub/b.jpg"):
        (tmp_path / copy).parent.mkdir(exist_ok=True)
        shutil.copy(tmp_path / "b.jpg", tmp_path / copy)
    outputs = run(tmp_path)
    assert [photo.name for photo in outputs.photos] == ["a.jpg"]
    assert [left.name for left in outputs.left_out] == ["b.jpg", "c.jpg", "sub/b.jpg"]
    assert all("the same file as a.jpg" in left.reason for left in outputs.left_out)


def test_what_is_no_photo_is_left_out_or_counted(tmp_path: Path):
    write(tmp_path / "a.JPG")
    for name in ("a.DNG", "b.heic"):
        (tmp_path / name).write_bytes(name.encode())
    (tmp_path / "broken.jpg").write_bytes(b"\xff\xd8\xff\xe0")
    for name in ("gcp_list.txt", "a.srt", "b.srt", "noname"):
        (tmp_path / name).write_text(name)
    outputs = run(tmp_path)
    assert [photo.name for photo in outputs.photos] == ["a.JPG"]
    assert [left.name for left in outputs.left_out] == ["a.DNG", "b.heic", "broken.jpg"]
    assert "convert it to JPEG" in outputs.left_out[0].reason
    assert "4 files: 2 .srt, 1 .txt, 1 without a suffix" in " ".join(outputs.notes)


def test_lists_in_use_are_no_files_passed_over_and_others_are_named(tmp_path: Path):
    write(tmp_path / "a b.jpg")
    for name in ("GEO.TXT", "gcp_list.txt", "sub/geo.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(name)
    inputs = metadata.Inputs(
        files=files_of(tmp_path), geotags="EPSG:32615\na b.jpg 500000 5187000 250\n", geotags_name="GEO.TXT",
        is_geotags_found=True, own_lists=("GEO.TXT", "gcp_list.txt"),
    )  # fmt: skip
    notes = metadata.run(inputs, metadata.Params()).notes
    assert notes[0] == "Files that are no photos are passed over, 1 file: 1 .txt."
    assert notes[1].startswith("GEO.TXT was found among the photos")
    assert "not used: sub/geo.txt; give them with --geotags or --gcp" in notes[2]
    assert "GEO.TXT replaces the tags' positions of 1 of 1 photos." in notes


def test_reasons_and_outputs_do_not_depend_on_where_the_folder_lies(tmp_path: Path):
    for folder in ("one", "two"):
        write(tmp_path / folder / "a.jpg")
        write(tmp_path / folder / "b.jpg", mm=50.0)
        (tmp_path / folder / "c.jpg").write_bytes(b"none")
    one, two = run(tmp_path / "one"), run(tmp_path / "two")
    assert (one.left_out, one.notes) == (two.left_out, two.notes)
    assert "/" not in " ".join(left.reason for left in one.left_out)
    assert pickle.dumps(one) == pickle.dumps(run(tmp_path / "one"))


def test_two_cameras_are_told_apart_and_noted(tmp_path: Path):
    write(tmp_path / "a.jpg", gray=1)
    write(tmp_path / "b.jpg", gray=2)
    write(tmp_path / "c.jpg", gray=3, model="FC300S", mm=3.61, size_px=(800, 600))
    outputs = run(tmp_path)
    first, second, third = (photo.camera for photo in outputs.photos)
    assert first == second != third
    (note,) = outputs.notes
    assert note == (
        "2 cameras, each with its own intrinsics. Photos of each: DJI FC300S, 3.61 mm, 800x600: 1; "
        "DJI FC6310, 8.8 mm, 1000x667: 2."
    )
    assert "used for all of them" in " ".join(run(tmp_path, focal=640.0).notes)


def test_focal_length_off_the_specification_is_left_out_with_the_numbers(tmp_path: Path):
    write(tmp_path / "a.jpg")
    write(tmp_path / "b.jpg", mm=11.0)
    (left,) = run(tmp_path).left_out
    assert left.name == "b.jpg"
    for words in ("11 mm gives 833 px", "says 667 px", "+25%", "15%", "pass --focal or fix the tag"):
        assert words in left.reason
    assert run(tmp_path, max_focal_deviation=0.3).left_out == ()
    given = run(tmp_path, focal=650.0)
    assert given.left_out == () and {photo.focal_source for photo in given.photos} == {"given"}


def test_list_replaces_positions_and_names_what_does_not_match(data_dir: Path):
    lines = ["DJI_0018.JPG 500000 5187000 250 30 -60 0 0.02 0.04", "dji_0019.jpg 500010 5187000 251", "OTHER.JPG 1 2 3"]
    text = "\n".join(["EPSG:32615", *lines])
    plain, listed = run(data_dir / "images" / "brighton"), run(data_dir / "images" / "brighton", text)
    first, second, third = listed.photos[:3]
    assert first.position is not None and second.position is not None and plain.photos[0].position is not None
    assert (first.position.crs, first.position.x, first.position.z_m) == ("EPSG:32615", 500000.0, 250.0)
    assert (first.position.std_h_m, first.position.std_v_m) == (0.02, 0.04)
    assert first.position.relative_altitude_m == plain.photos[0].position.relative_altitude_m == 39.8
    assert first.attitude == Attitude(yaw_deg=30.0, pitch_deg=-60.0, roll_deg=0.0)
    assert second.position.source == "geo.txt line 3"
    assert second.attitude == plain.photos[1].attitude
    assert third == plain.photos[2]
    notes = " ".join(listed.notes)
    assert "replaces the tags' positions of 2 of 18 photos" in notes
    assert "does not list DJI_0020.JPG" in notes and "no usable photo: OTHER.JPG" in notes


def test_lists_angles_of_a_body_over_a_camera_that_looks_down(tmp_path: Path):
    write(tmp_path / "a.jpg")
    (photo,) = run(tmp_path, "EPSG:32615\na.jpg 500000 5187000 250 30 10 0\n").photos
    assert photo.attitude is not None
    assert (photo.attitude.yaw_deg, photo.attitude.pitch_deg) == pytest.approx((30.0, -80.0))


def test_list_that_fits_no_photo_or_two_is_refused(tmp_path: Path):
    write(tmp_path / "one" / "a.jpg", gray=1)
    write(tmp_path / "two" / "a.jpg", gray=2)
    with pytest.raises(JaxbaError, match=r"lists none of the photos: it names b\.jpg"):
        run(tmp_path, "EPSG:4326\nb.jpg 1 2\n")
    with pytest.raises(JaxbaError, match=r"line 2: a.jpg may be one/a.jpg or two/a.jpg"):
        run(tmp_path, "EPSG:4326\na.jpg 1 2\n")
    with pytest.raises(JaxbaError, match=r"lines 2 and 3: both are one/a.jpg"):
        run(tmp_path, "EPSG:4326\none/a.jpg 1 2\none/A.jpg 1 2\ntwo/a.jpg 1 2\n")
    assert len(run(tmp_path, "EPSG:4326\none/a.jpg 1 2\ntwo/a.jpg 1 2\n").photos) == 2


@pytest.mark.parametrize("header", ["EPSG:26851", "EPSG:26851+6360", "EPSG:4326+6360"])
def test_heights_of_a_list_in_feet_are_turned_into_metres_and_it_is_said(tmp_path: Path, header: str):
    write(tmp_path / "a.jpg")
    xy = "-93.2 44.9" if header.startswith("EPSG:4326") else "2831907.6 1021700.2"
    outputs = run(tmp_path, f"{header}\na.jpg {xy} 1050.87\n")
    position = outputs.photos[0].position
    assert position is not None and position.z_m == pytest.approx(1050.87 * 1200 / 3937)
    assert any("1050.87 US survey foot, is 320.31 m" in note for note in outputs.notes)


def test_tags_stay_beside_the_list_that_replaces_them(data_dir: Path):
    folder = data_dir / "images" / "brighton"
    plain, listed = run(folder), run(folder, "EPSG:32615\nDJI_0018.JPG 576690 5188170 250\n")
    assert listed.photos[0].tag_position == plain.photos[0].position
    assert all(photo.tag_position is None for photo in (*plain.photos, *listed.photos[1:]))


def test_one_finding_that_differs_in_its_figures_alone_is_one_line(tmp_path: Path):
    for name, mm in (("a.jpg", 300), ("b.jpg", 400), ("c.jpg", -500)):
        exif = Image.Exif()
        gps = {GPS.GPSLatitude: (47.0, 0.0, 0.0), GPS.GPSLongitude: (8.0, 0.0, 0.0)}
        gps |= {GPS.GPSLatitudeRef: "N", GPS.GPSLongitudeRef: "E", GPS.GPSAltitude: 300.0, GPS.GPSAltitudeRef: b"\0"}
        exif.get_ifd(ExifTags.IFD.GPSInfo).update(gps)
        height = f"<d:AbsoluteAltitude>{mm / 1000 + 310:+}</d:AbsoluteAltitude>"
        xmp = f'<a xmlns:d="http://www.dji.com/drone-dji/1.0/">{height}</a>'
        Image.new("L", (40, 30)).save(tmp_path / name, exif=exif, xmp=xmp.encode())
    (note,) = [note for note in run(tmp_path).notes if "AbsoluteAltitude" in note]
    assert note.startswith("a.jpg, b.jpg, c.jpg: the height of EXIF lies 9.50 to 10.40 m below that of XMP's Absolute")


@pytest.mark.parametrize(
    ("heights_m", "kept", "words"),
    [
        ((320.5, -9999.0, 321.0), (320.5, None, 321.0), "1 of 3 photos has no height (-9999: b.jpg)"),
        (
            (0.0, 319.0, 321.0),
            (None, 319.0, 321.0),
            "1 of 3 photos has no height (0 where the others are 319 to 321: a",
        ),
        (
            (0.0, 0.0, 321.0),
            (None, None, 321.0),
            "2 of 3 photos have no height (0 where the others are 321 to 321: a.jpg",
        ),
        ((-32768.0, 320.0, 9999.0), (None, 320.0, None), "2 of 3 photos have no height (-32768: a.jpg; 9999 where"),
        ((0.0, 0.0, 0.0), (None, None, None), "Tags: all heights are 0"),
        ((0.5, 0.0, -0.5), (0.5, 0.0, -0.5), "Tags: the height 0 of b.jpg is used"),
        ((-12.0, 40.0, 320.0), (-12.0, 40.0, 320.0), ""),
    ],
)
def test_heights_in_tags_that_are_none_are_named_and_the_place_stays(
    tmp_path: Path, heights_m: tuple[float, ...], kept: tuple[float | None, ...], words: str
):
    for name, z_m in zip(("a.jpg", "b.jpg", "c.jpg"), heights_m, strict=True):
        exif = Image.Exif()
        gps = {GPS.GPSLatitude: (47.0, 0.0, 0.0), GPS.GPSLongitude: (8.0, 0.0, 0.0)}
        gps |= {GPS.GPSAltitude: abs(z_m), GPS.GPSAltitudeRef: b"\1" if z_m < 0 else b"\0"}
        exif.get_ifd(ExifTags.IFD.GPSInfo).update(gps | {GPS.GPSLatitudeRef: "N", GPS.GPSLongitudeRef: "E"})
        Image.new("L", (40, 30), int(z_m) % 200).save(tmp_path / name, exif=exif, comment=name)
    outputs = run(tmp_path)
    positions = [photo.position for photo in outputs.photos]
    assert tuple(position and position.z_m for position in positions) == kept
    assert all(position and position.y == 47.0 for position in positions)
    notes = [note for note in outputs.notes if note.startswith("Tags: ")]
    assert words in notes[0] if words else not notes


@pytest.mark.parametrize(
    ("photo", "mask"),
    [
        ("a.jpg", "a_mask.png"),
        ("a.jpg", "A_MASK.JPG"),
        ("a.jpg", "a.jpg_mask.png"),
        ("a.jpg", "masks/a.jpg.png"),
        ("a.jpg", "Masks/a.png"),
        ("a.jpg", "masks/a_mask.tif"),
        ("a.jpg", "a.mask.png"),
        ("a.jpg", "a.jpg.mask.png"),
        ("a.jpg", "a-Mask.png"),
        ("a.jpg", "mask_a.png"),
        ("a.jpg", "_masks/a.png"),
        ("sub/a.jpg", "sub/flight1_masks/a.png"),
        ("sub/a.jpg", "masks/sub/a.jpg.png"),
        ("sub/a.jpg", "sub/masks/a.png"),
        ("images/a.jpg", "masks/a.jpg.png"),
    ],
)
def test_a_mask_belongs_to_its_photo_and_is_no_photo(tmp_path: Path, photo: str, mask: str):
    write(tmp_path / photo)
    write(tmp_path / "other.jpg", gray=9)
    (tmp_path / mask).parent.mkdir(parents=True, exist_ok=True)
    Image.new("L", (500, 333), 255).save(tmp_path / mask)
    outputs = run(tmp_path)
    assert {p.name: p.mask and p.mask.name for p in outputs.photos} == {photo: mask, "other.jpg": None}
    assert outputs.notes[0] == (f"1 of 2 photos has a mask ({photo}: {mask}): no features are taken where it is black.")


@pytest.mark.parametrize("mask", ["b_mask.png", "masks/b.jpg.png", "masks/readme.png", "mask.png", "b.mask.png"])
def test_a_mask_of_no_photo_is_passed_over_and_named(tmp_path: Path, mask: str):
    write(tmp_path / "a.jpg")
    (tmp_path / mask).parent.mkdir(parents=True, exist_ok=True)
    Image.new("L", (10, 10)).save(tmp_path / mask)
    outputs = run(tmp_path)
    assert [p.name for p in outputs.photos] == ["a.jpg"] and outputs.left_out == ()
    assert outputs.notes == (f"Masks of no photo are passed over, 1: {mask}.",)


def test_photos_that_are_called_like_masks_are_photos_where_there_are_no_others(tmp_path: Path):
    write(tmp_path / "a_mask.jpg")
    assert [p.name for p in run(tmp_path).photos] == ["a_mask.jpg"]


@pytest.mark.parametrize(
    ("size_px", "words"),
    [
        ((1000, 800), "a_mask.png has 1000 x 800 pixels and a.jpg 1000 x 667; draw it in the photo, or remove it"),
        ((667, 1000), "it is turned; masks count on the pixels as they are stored"),
    ],
)
def test_a_mask_of_another_format_is_refused_with_both_sizes(tmp_path: Path, size_px: tuple[int, int], words: str):
    write(tmp_path / "a.jpg")
    Image.new("L", size_px).save(tmp_path / "a_mask.png")
    with pytest.raises(JaxbaError, match=f"1 of 1 masks do not fit their photos: .*{words}"):
        run(tmp_path)


def test_two_masks_of_one_photo_are_refused(tmp_path: Path):
    write(tmp_path / "a.jpg")
    for name in ("a_mask.png", "a_mask.jpg"):
        Image.new("L", (1000, 667), 255).save(tmp_path / name)
    with pytest.raises(JaxbaError, match=r"a\.jpg has two masks, a_mask\.jpg and a_mask\.png; keep one"):
        run(tmp_path)
