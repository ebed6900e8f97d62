"""The control stage: roles, scale of marks, heights, places; what cannot be used is named, what is wrong is refused."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import ExifTags, Image, ImageOps

from jaxba._errors import JaxbaError
from jaxba.geo import projected_from_local
from jaxba.pipeline import control, crs, metadata
from jaxba.pipeline._mark_turn import TURNS, expected_px
from jaxba.pipeline.control import Inputs, Outputs, Params
from jaxba.report import Told
from jaxba.scene import Attitude, Photo, PhotoFile, Position, Reference

LON, LAT = -92.0, 46.8
X, Y = 576308.6, 5183424.7


def photos(*, with_positions: bool = True, **changes: Any) -> tuple[Photo, ...]:
    return tuple(
        Photo(
            name=f"{name}.jpg", path=Path(), sha256="0", width_px=1600, height_px=1200, camera="c",
            position=Position(x=LON + 1e-4 * k, y=LAT, z_m=260.0) if with_positions else None, **changes,
        )
        for k, name in enumerate("abcd")
    )  # fmt: skip


def reference(of: tuple[Photo, ...], **params: Any) -> Reference:
    return crs.run(crs.Inputs(photos=of), crs.Params(**params)).reference


def gcp_list(
    *, scale: float = 1.0, z: float | None = None, header: str = "EPSG:32615", dx: float = 0.0, swap: bool = False
) -> str:
    """Four points in all four photos."""
    lines = [header]
    for k in range(4):
        x, y = X + 20 * k + dx, Y + 15 * (k % 2)
        x, y = (y, x) if swap else (x, y)
        height = 198.0 + k if z is None else z
        lines += [f"{x} {y} {height} {scale * (300 + 350 * k)} {scale * 700} {photo}.jpg gcp{k}" for photo in "abcd"]
    return "\n".join(lines)


def run(text: str | None = None, *, check: str | None = None, of: tuple[Photo, ...] | None = None, **params) -> Outputs:
    of = photos() if of is None else of
    inputs = Inputs(
        photos=of,
        reference=reference(of),
        gcp=("gcp_list.txt", gcp_list() if text is None else text),
        check=None if check is None else ("check_list.txt", check),
    )
    return control.run(inputs, Params(**params))


def test_without_a_list_the_reference_passes_through():
    given = reference(photos())
    made = control.run(Inputs(photos=photos(), reference=given), Params())
    assert made.reference is given and made.control.num_points == 0 and made.notes == ()


def test_points_lie_where_they_were_surveyed():
    made = run(std_h=0.05)
    frame = made.reference.frame
    assert frame is not None
    back = projected_from_local(frame, made.control.xyz_m)
    np.testing.assert_allclose(back[:, :2], [[X + 20 * k, Y + 15 * (k % 2)] for k in range(4)], atol=1e-4)
    np.testing.assert_allclose(back[:, 2], [198, 199, 200, 201], atol=1e-4)
    np.testing.assert_allclose(made.control.std_m, [[0.05, 0.05, 0.03]] * 4)
    assert made.control.mark_point.tolist() == [0] * 4 + [1] * 4 + [2] * 4 + [3] * 4
    assert made.control.mark_image.tolist() == [0, 1, 2, 3] * 4


def test_check_points_come_from_a_list_a_role_or_a_parameter():
    names = lambda made: [name for name, is_check in zip(made.control.names, made.control.is_check) if is_check]  # noqa: E731, B905
    assert names(run(check=gcp_list())) == ["gcp0", "gcp1", "gcp2", "gcp3"]
    lines = gcp_list().splitlines()
    only_first = "\n".join(lines[:5])
    both = run(check=only_first)  # the name stands in both lists, with the same marks
    assert names(both) == ["gcp0"] and len(both.control.mark_point) == 16
    of = photos()
    made = control.run(Inputs(photos=of, reference=reference(of), gcp=("g", gcp_list())), Params(check="gcp1, gcp3"))
    assert names(made) == ["gcp1", "gcp3"]
    csv = "# EPSG:32615\nname,x,y,z,px,py,image,role\n" + "\n".join(
        f"{row[6]},{row[0]},{row[1]},{row[2]},{row[3]},{row[4]},{row[5]},{'check' if row[6] == 'gcp2' else ''}"
        for row in (line.split() for line in lines[1:])
    )
    assert names(run(csv)) == ["gcp2"]
    with pytest.raises(JaxbaError, match=r"no point is called gcp9; the points are gcp0, gcp1"):
        control.run(Inputs(photos=of, reference=reference(of), gcp=("g", gcp_list())), Params(check="gcp9"))
    with pytest.raises(JaxbaError, match=r"gcp0 has z_m 199.0, and 198.0 in gcp_list.txt line 2"):
        run(check=only_first.replace(" 198.0 ", " 199.0 "))


def test_marks_of_the_original_photos_are_scaled_by_what_exif_says():
    made = run(gcp_list(scale=2.5), of=photos(original_size_px=(4000, 3000)))
    np.testing.assert_allclose(made.control.mark_xy_px, run().control.mark_xy_px)
    assert any(
        "16 of 16 marks lie outside" in note and "0.40000" in note and "4000 x 3000" in note for note in made.notes
    )


def test_marks_whose_scale_nothing_tells_are_refused_with_the_cure():
    for of in (photos(), photos(original_size_px=(4000, 2250)), photos(original_size_px=(1700, 1275))):
        with pytest.raises(JaxbaError, match=r"16 of 16 marks lie outside.*control.mark_width_px"):
            run(gcp_list(scale=2.5), of=of)
    made = run(gcp_list(scale=2.5), mark_width_px=4000)
    np.testing.assert_allclose(made.control.mark_xy_px, run().control.mark_xy_px)


def test_marks_inside_the_files_are_taken_as_they_are():
    made = run(of=photos(original_size_px=(4000, 3000)))
    assert np.array_equal(made.control.mark_xy_px, run().control.mark_xy_px)
    assert any("on the pixel grid of the files" in note for note in made.notes)


def test_a_single_mark_outside_and_photos_that_are_not_there_are_named():
    text = gcp_list().replace("300.0 700.0 a.jpg", "3000 700.0 a.jpg").replace("d.jpg gcp3", "x.jpg gcp3")
    made = run(text)
    left = {entry.name: entry.reason for entry in made.left_out}
    assert "3000 700 (gcp_list.txt line 2) lies outside the photo of 1600 x 1200" in left["gcp0 in a.jpg"]
    assert "is marked (gcp3), but is none of the photos" in left["x.jpg"]
    assert len(made.control.mark_point) == 14
    with pytest.raises(JaxbaError, match=r"marks none of the photos: it names q.jpg"):
        run(f"EPSG:32615\n{X} {Y} 1 2 3 q.jpg")
    with pytest.raises(JaxbaError, match=r"gcp0 is marked in a.jpg twice"):
        run(gcp_list() + f"\n{X} {Y} 198.0 5 6 A.JPG gcp0")
    once = run(gcp_list() + f"\n{X + 5} {Y} 198.0 5 6 a.jpg lone")
    assert [entry.name for entry in once.left_out] == ["lone"] and "in 1 of the photos" in once.left_out[0].reason


def test_heights_that_are_all_zero_were_not_measured():
    made = run(gcp_list(z=0.0))
    assert np.isinf(made.control.std_m[:, 2]).all() and np.isfinite(made.control.xyz_m).all()
    assert any("all heights are 0" in note and "control.heights=use" in note for note in made.notes)
    assert np.isfinite(run(gcp_list(z=0.0), heights="use").control.std_m).all()
    assert np.isinf(run(heights="ignore").control.std_m[:, 2]).all()
    assert any("all 4 heights are 3" in note for note in run(gcp_list(z=3.0)).notes)


@pytest.mark.parametrize("none", ["NaN", "-9999", "0"])
def test_a_point_without_a_height_is_horizontal_control_and_named(none: str):
    made = run(gcp_list().replace(" 199.0 ", f" {none} "))
    assert np.isinf(made.control.std_m[:, 2]).tolist() == [False, True, False, False]
    assert np.isfinite(made.control.std_m[:, :2]).all() and np.isfinite(made.control.xyz_m).all()
    (note,) = (note for note in made.notes if "no height" in note)
    assert note.startswith("gcp_list.txt: 1 of 4 points has no height (") and "gcp1): horizontal control only" in note
    kept = run(gcp_list().replace(" 199.0 ", f" {none} "), heights="use").control.std_m[1, 2]
    assert np.isfinite(kept) == (none == "0") and ("control.heights=use" in note) == (none == "0")


def test_points_named_chk_are_check_points_and_said():
    text = gcp_list().replace("gcp1", "CHK-1").replace("gcp3", "chk-3").replace("gcp2", "CHK2")
    made = run(text)
    assert made.control.is_check.tolist() == [False, True, False, True]
    assert "Check points by their names, CHK-...: CHK-1, chk-3." in made.notes
    assert any(note.startswith("CHK2: used as control.") and "control.check" in note for note in made.notes)
    told = Told(photos=(), left_out=())
    assert control.lines(made, told)[0].startswith("2 control points, 2 check points; 16 marks")


def test_photos_with_blanks_in_their_names_are_found_and_those_that_are_not_are_likened():
    of = tuple(replace(photo, name=f"{photo.name[0]} (2).jpg") for photo in photos())
    made = run(
        gcp_list().replace("a.jpg", "a (2).jpg").replace("b.jpg", '"b (2).JPG"').replace("c.jpg", "c(2).jpg"), of=of
    )
    assert len(made.control.mark_point) == 8
    left = {entry.name: entry.reason for entry in made.left_out}
    assert "(c (2).jpg, but for blanks or marks? Write it so)" in left["c(2).jpg"] and "(" not in left["d.jpg"][60:]


def test_a_list_found_among_the_photos_is_said_and_its_fault_has_a_way_round():
    of = photos()
    inputs = Inputs(photos=of, reference=reference(of), gcp=("gcp_list.txt", gcp_list()), is_gcp_found=True)
    made = control.run(inputs, Params())
    assert made.notes[0].startswith("gcp_list.txt was found among the photos, and is used as control")
    assert np.array_equal(made.control.xyz_m, run().control.xyz_m)
    with pytest.raises(JaxbaError, match=r"line 1: 'no list' is no CRS.*found among the photos.* --gcp none"):
        control.run(replace(inputs, gcp=("gcp_list.txt", "no list")), Params())


def test_control_far_from_the_photos_is_refused_with_what_would_bring_it_there():
    with pytest.raises(JaxbaError, match=r"control lies 457.5 km from the photos.*With UTM zone 15N \(EPSG:32615\)"):
        run(gcp_list(header="WGS84 UTM 14N"), max_distance_km=5.0)
    with pytest.raises(JaxbaError, match=r"does not contain the survey.*Swap x and y"):
        run(gcp_list(swap=True))
    with pytest.raises(JaxbaError, match=r"lies 7\.\d km from the photos' positions, over 5 km"):
        run(gcp_list(dx=7000.0))


def test_photos_without_positions_are_placed_by_control_in_its_crs():
    of = photos(with_positions=False)
    made = run(of=of)
    frame = made.reference.frame
    assert frame is not None and frame.crs == "EPSG:32615" and not made.reference.is_used.any()
    np.testing.assert_allclose(projected_from_local(frame, made.control.xyz_m)[0], [X, Y, 198], atol=1e-4)
    other = control.run(
        Inputs(photos=of, reference=reference(of), target_crs="EPSG:26915", gcp=("g", gcp_list())), Params()
    ).reference.frame
    assert other is not None and other.crs == "EPSG:26915"
    with pytest.raises(JaxbaError, match=r"does not contain the survey"):
        control.run(
            Inputs(photos=of, reference=reference(of), target_crs="EPSG:32633", gcp=("g", gcp_list())), Params()
        )
    all_check = run("EPSG:32615\n" + f"{X} {Y} 1 2 3 a.jpg p", of=of, check="EPSG:32615\n" + f"{X} {Y} 1 2 3 a.jpg p")
    assert all_check.reference.frame is None and any("nothing places the block" in note for note in all_check.notes)


def test_a_fit_with_too_few_points_is_refused_before_anything_is_matched():
    two = "\n".join(gcp_list().splitlines()[:9])
    with pytest.raises(JaxbaError, match=r"control.method=helmert needs 3 control points.*has 2"):
        run(two, method="helmert")
    assert run(two).control.num_points == 2


def test_drifting_gnss_altitudes_cast_no_doubt_on_heights_that_control_holds():
    from jaxba.geo import UNTRUSTED

    of = photos()
    given = reference(of)
    assert given.frame is not None
    doubted = replace(given, frame=replace(given.frame, height_note=f"Heights are metres. {UNTRUSTED}"))
    made = control.run(Inputs(photos=of, reference=doubted, gcp=("g", gcp_list())), Params()).reference.frame
    assert made is not None and UNTRUSTED not in made.height_note and "Control points hold them" in made.height_note


def test_real_marks_in_original_pixels_are_noticed(data_dir: Path):
    """41 photos scaled from 4272 to 1600 px, 27 marks in the original's pixels, no GNSS, all heights 0."""
    folder = data_dir / "images" / "copr"
    files = tuple(PhotoFile(name=p.name, path=p, sha256=p.name) for p in sorted(folder.glob("*.jpg")))
    of = metadata.run(metadata.Inputs(files=files), metadata.Params()).photos
    text = (folder / "gcp_list.txt").read_text()
    made = control.run(
        Inputs(photos=of, reference=reference(of), gcp=("gcp_list.txt", text)), Params(check="gcp03, gcp05, gcp08")
    )
    assert len(of) == 41 and made.control.num_points == 10 and made.control.is_check.sum() == 3
    assert any("22 of 27 marks lie outside" in n and "0.37453" in n and "4272 x 2848" in n for n in made.notes)
    np.testing.assert_allclose(made.control.mark_xy_px[0], [3609.3727839973 * 1600 / 4272, 2293.7951481 * 1067 / 2848])
    frame = made.reference.frame
    assert frame is not None and frame.crs == "EPSG:32611" and np.isinf(made.control.std_m[:, 2]).all()
    assert [entry.name for entry in made.left_out] == ["gcp00"]
    assert (
        "gcp04 and gcp00 are marked at one pixel of IMG_0031.jpg and lie apart: one of the marks is wrong."
        in made.notes
    )
    with pytest.raises(JaxbaError, match=r"EXIF does not tell an original size"):
        control.run(
            Inputs(photos=tuple(replace(p, original_size_px=None) for p in of), reference=reference(of),
                   gcp=("gcp_list.txt", text)),
            Params(),
        )  # fmt: skip


def test_points_without_names_keep_apart_in_two_lists_and_one_place_is_one_point():
    def unnamed(text: str) -> str:
        return "\n".join(line.rsplit(" ", 1)[0] if " " in line else line for line in text.splitlines())

    made = run(unnamed(gcp_list()), check=unnamed(gcp_list(dx=7.0))).control
    assert made.names == tuple(f"{kind}{k}" for kind in ("point", "check") for k in range(1, 5))
    assert made.is_check.tolist() == [False] * 4 + [True] * 4
    lines = gcp_list().splitlines()
    both = run(unnamed(gcp_list()), check="\n".join(lines[:5])).control  # the first of them has a name there
    assert both.is_check.tolist() == [True, False, False, False] and len(both.mark_point) == 16


def shown_marks(orientation: int, of: tuple[Photo, ...], xy_px: np.ndarray) -> np.ndarray:
    """Return marks as Pillow shows them: where the one white pixel of a photo comes to lie."""
    found = []
    for x, y in xy_px:
        stored = Image.new("L", (of[0].width_px // 10, of[0].height_px // 10))
        stored.putpixel((int(x // 10), int(y // 10)), 255)
        exif = Image.Exif()
        exif[ExifTags.Base.Orientation] = orientation
        stored.getexif().update(exif)
        row, column = np.argwhere(np.asarray(ImageOps.exif_transpose(stored)))[0]
        found.append([10 * column + 5, 10 * row + 5])
    return np.array(found, float)


def looking_down(orientation: int, **changes: Any) -> tuple[Photo, ...]:
    """Photos 62 m above the points, whose gimbal and focal length are known."""
    down = Attitude(yaw_deg=20.0, pitch_deg=-90.0, roll_deg=0.0)
    return photos(orientation=orientation, attitude=down, focal_px=1400.0, focal_source="given", **changes)


def marked_down(orientation: int, of: tuple[Photo, ...], turn: int | None = None) -> tuple[str, np.ndarray]:
    """Return a list with the marks of points near the photos as they are shown, and those on the stored grid."""
    given = reference(of)
    frame = given.frame
    assert frame is not None
    points = given.xyz_m[:, None] + [[5, -9, -62], [-8, 7, -62], [11, 3, -62], [-4, -11, -62]]
    point, image = np.arange(16), np.repeat(np.arange(4), 4)
    stored = expected_px(of, given, points.reshape(-1, 3), point, image)
    stored = 10 * np.floor(stored / 10) + 5
    shown = shown_marks(orientation if turn is None else turn, of, stored)
    xyz = projected_from_local(frame, points.reshape(-1, 3))
    rows = [f"{x} {y} {z} {u} {v} {of[k].name} p{j}" for j, k, (x, y, z), (u, v) in zip(point, image, xyz, shown)]  # noqa: B905
    return "\n".join([frame.crs, *rows]), stored


@pytest.mark.parametrize("orientation", range(2, 9))
def test_marks_set_in_photos_that_a_viewer_turned_are_refused_by_name_and_turned_back_as_asked(orientation: int):
    of = looking_down(orientation)
    text, stored = marked_down(orientation, of)
    with pytest.raises(JaxbaError) as error:
        run(text, of=of)
    words = f"a.jpg: {orientation}, {TURNS[orientation]} by viewers"
    assert words in str(error.value) and "marks count on the photos' stored pixel grid" in str(error.value)
    assert "Set control.mark_orientation=exif to turn them back" in str(error.value)
    for asked in ("exif", str(orientation)):
        made = run(text, of=of, mark_orientation=asked)
        np.testing.assert_allclose(made.control.mark_xy_px, stored)
        assert f"control.mark_orientation={asked}" in " ".join(made.notes)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_marks_on_the_stored_grid_are_taken_whatever_the_orientation(orientation: int):
    of = looking_down(orientation)
    text, stored = marked_down(1, of)
    made = run(text, of=of)
    np.testing.assert_allclose(made.control.mark_xy_px, stored)
    assert ("marks count on the stored pixel grid" in " ".join(made.notes)) == (orientation > 1)


def test_photos_turned_each_in_its_own_way_are_told_from_a_turn_in_common():
    of = tuple(replace(photo, orientation=o) for photo, o in zip(looking_down(1), (3, 6, 8, 1), strict=True))
    texts = [marked_down(1, of, photo.orientation)[0].splitlines() for photo in of]
    text = "\n".join([texts[0][0], *(texts[k // 4][1 + k] for k in range(16))])
    with pytest.raises(JaxbaError, match=r"control\.mark_orientation=exif"):
        run(text, of=of)
    made = run(text, of=of, mark_orientation="exif")
    np.testing.assert_allclose(made.control.mark_xy_px, marked_down(1, of)[1])


@pytest.mark.parametrize("turn", range(2, 9))
def test_a_turn_that_no_tag_states_is_named_with_its_number(turn: int):
    """A yaw that is off looks like a turn, so that the marks are taken as they are where they lie inside."""
    made = run(marked_down(1, looking_down(1), turn)[0], of=looking_down(1))
    (note,) = [note for note in made.notes if "They fit if they were set in photos that were turned" in note]
    assert TURNS[turn] in note and f"Set control.mark_orientation={turn} to turn them back" in note
    assert "the attitudes may be wrong instead" in note


def test_marks_outside_photos_that_a_program_has_untagged_are_refused_with_the_turn():
    of = looking_down(1)
    text, _ = marked_down(1, of, 6)
    rows = [line.split() for line in text.splitlines()[1:]]
    low = [
        [*row[:4], str(float(row[4]) + 350), *row[5:]] for row in rows
    ]  # up to 1400 of 1600 px, where 1200 are stored
    with pytest.raises(
        JaxbaError, match=r"EXIF orientation 6, turned by 90 degrees clockwise.*unturned, they lie outside"
    ):
        run("\n".join(["EPSG:32615", *map(" ".join, low)]), of=of)


def test_without_attitudes_a_turn_shows_by_marks_outside():
    of = photos(orientation=6)
    tall = gcp_list().replace(" 700.0 ", " 1500.0 ").replace("1350.0", "1150.0")
    with pytest.raises(JaxbaError, match=r"as their EXIF orientation says; unturned, they lie outside"):
        run(tall, of=of)
    assert len(run(tall, of=of, mark_orientation="exif").control.mark_point) == 16
    assert "4 marked photos have an EXIF orientation other than 1" in " ".join(run(of=of).notes)


def test_marks_of_larger_photos_are_turned_and_scaled():
    of = looking_down(6, original_size_px=(4000, 3000))
    text, stored = marked_down(6, of)
    rows = [line.split() for line in text.splitlines()[1:]]
    large = [[*row[:3], str(2.5 * float(row[3])), str(2.5 * float(row[4])), *row[5:]] for row in rows]
    made = run("\n".join(["EPSG:32615", *map(" ".join, large)]), of=of, mark_orientation="exif")
    np.testing.assert_allclose(made.control.mark_xy_px, stored)
    made = run("\n".join(["EPSG:32615", *map(" ".join, large)]), of=of, mark_orientation="exif", mark_width_px=3000)
    np.testing.assert_allclose(made.control.mark_xy_px, stored)


@pytest.mark.parametrize("factor", [0.25, 0.5])
def test_marks_set_in_smaller_photos_are_refused_with_their_width(factor: float):
    # breaks where marks within the edges are taken for good
    of = looking_down(1)
    text, stored = marked_down(1, of)
    rows = [line.split() for line in text.splitlines()[1:]]
    small = [[*row[:3], str(factor * float(row[3])), str(factor * float(row[4])), *row[5:]] for row in rows]
    given = "\n".join(["EPSG:32615", *map(" ".join, small)])
    width = of[0].width_px
    with pytest.raises(JaxbaError, match=r"in photos of some \d+ px width they would lie") as error:
        run(given, of=of)
    (found,) = re.findall(r"of some (\d+) px width", str(error.value))
    assert float(found) == pytest.approx(factor * width, rel=0.05)
    made = run(given, of=of, mark_width_px=round(factor * width))
    np.testing.assert_allclose(made.control.mark_xy_px, stored)
    made = run(given, of=of, mark_orientation="stored")
    np.testing.assert_allclose(made.control.mark_xy_px, factor * stored)


def with_bars(bars: str | None, gcp: str | None, *, check: str | None = None, of: Any = None, **params: Any) -> Outputs:
    of = photos() if of is None else of
    inputs = Inputs(
        photos=of,
        reference=reference(of),
        gcp=None if gcp is None else ("gcp_list.txt", gcp),
        check=None if check is None else ("check_list.txt", check),
        bars=None if bars is None else ("bars.csv", bars),
    )
    return control.run(inputs, Params(**params))


MARKED = "".join(f"\nNaN NaN NaN {400 + 50 * k} 600 {photo}.jpg t{k}" for k in range(2) for photo in "abc")


def test_bars_end_at_points_of_the_lists_with_coordinates_or_without() -> None:
    made = with_bars("gcp0 t1 31.5 0.01\nt0 t1 12.25", gcp_list() + MARKED, bar_std=0.02)
    bars = made.bars
    assert bars.names == ("gcp0-t1", "t0-t1") and bars.length_m.tolist() == [31.5, 12.25]
    assert bars.std_m.tolist() == [0.01, 0.02] and not bars.is_check.any()
    assert bars.ends.names == ("gcp0", "t0", "t1") and np.bincount(bars.ends.mark_point).tolist() == [4, 3, 3]
    assert made.control.names == ("gcp0", "gcp1", "gcp2", "gcp3") and len(made.control.mark_point) == 16
    assert made.notes[0] != "" and not [note for note in made.notes if "t0" in note]
    told = control.lines(made, Told(photos=()))
    assert told[0] == "4 control points, 0 check points, 2 scale bars; 22 marks in 4 photos"
    assert [bar["first"] for bar in control.facts(made, Told(photos=()))["bars"]] == ["gcp0", "t0"]


def test_bars_alone_need_neither_coordinates_nor_positions() -> None:
    of = photos(with_positions=False)
    made = with_bars("t0 t1 12.25", "EPSG:32615" + MARKED, of=of)
    assert made.control.num_points == 0 and made.reference.frame is None and made.bars.num == 1


def test_a_bar_at_a_check_point_is_a_check_and_marks_for_nothing_are_told() -> None:
    check = "EPSG:32615\n" + "\n".join(f"{X + 30} {Y} 199 500 {500 + k} {p}.jpg check1" for k, p in enumerate("ab"))
    made = with_bars("gcp0 check1 30.2\ngcp0 t0 9", gcp_list() + MARKED, check=check)
    assert made.bars.is_check.tolist() == [True, False]
    assert "t1: marked without coordinates, and no scale bar ends there: not used." in made.notes


def test_bars_whose_ends_nothing_marks_are_refused() -> None:
    with pytest.raises(JaxbaError, match=r"bars.csv line 1: no list marks a point t7; the points are gcp0"):
        with_bars("gcp0 t7 12", gcp_list())
    with pytest.raises(JaxbaError, match=r"bars.csv: no list marks the ends of scale bars in photos"):
        with_bars("gcp0 gcp1 12", None)
    once = "\nNaN NaN NaN 400 600 a.jpg t0"
    found = with_bars("gcp0 t0 12", gcp_list() + once)
    assert "t0, an end of a scale bar, is marked in 1 of the photos; two or more fix a point." in found.notes
