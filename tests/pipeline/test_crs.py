"""Stage crs on real photos' tags and on broken ones: what is used, what goes to review, where it stops."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from pyproj import Transformer

from jaxba._errors import JaxbaError
from jaxba.pipeline import crs
from jaxba.report import Told
from jaxba.scene import Attitude, Photo, Position, Reference


def reference(photos: list[Photo], **params: Any) -> Reference:
    return crs.run(crs.Inputs(photos=tuple(photos)), crs.Params(**params)).reference


def tagged(folder: Path) -> list[Photo]:
    """Photos of a folder with position, time and DJI's angles, read here so that the test hangs on this stage alone."""

    def degrees(dms) -> float:
        return float(dms[0]) + float(dms[1]) / 60 + float(dms[2]) / 3600

    photos = []
    for path in sorted(folder.glob("*.[jJ][pP]*[gG]")):
        with Image.open(path) as image:
            exif = image.getexif()
        gps, data = exif.get_ifd(0x8825), path.read_bytes()
        xmp = {key.decode(): float(value) for key, value in re.findall(rb"<drone-dji:(\w+)>([-+.\d]+)<", data)}
        position = attitude = None
        if 4 in gps:
            position = Position(
                x=degrees(gps[4]) * (-1 if gps[3] == "W" else 1), y=degrees(gps[2]), z_m=float(gps[6]),
                relative_altitude_m=xmp.get("RelativeAltitude"),
            )  # fmt: skip
        if "GimbalYawDegree" in xmp:
            yaw, pitch, roll = (xmp[f"Gimbal{name}Degree"] for name in ("Yaw", "Pitch", "Roll"))
            attitude = Attitude(yaw_deg=yaw, pitch_deg=pitch, roll_deg=roll)
        time = exif.get_ifd(0x8769).get(0x9003)
        photos.append(simple(len(photos), position, attitude=attitude, time=time, name=path.name))
    return photos


def simple(index: int, position: Position | None, **fields) -> Photo:
    name = fields.pop("name", f"p{index:03d}.jpg")
    return Photo(
        name=name, path=Path(name), sha256="", width_px=100, height_px=100, camera="c", position=position, **fields
    )


def at(index: int, **fields) -> Position:
    return Position(x=-92.0 + 1e-4 * (index % 3), y=46.8 + 1e-4 * index, **{"z_m": 300.0, **fields})


def survey(count: int = 12, **fields) -> list[Photo]:
    """Photos along a line north of 46.8 north, 92 west, at 300 m."""
    return [simple(k, at(k, **fields)) for k in range(count)]


def test_brighton_is_used_whole_with_its_gimbal_and_height_above_ground(data_dir: Path):
    found = reference(tagged(data_dir / "images" / "brighton"))
    assert found.is_used.all() and found.review == ()
    assert found.frame is not None and found.frame.crs == "EPSG:32615"
    assert "proposed, since none was given" in found.notes[0]
    assert np.median(found.height_above_ground_m) == pytest.approx(40.1, abs=0.2)
    assert np.isfinite(found.quaternion).all() and np.isfinite(found.std_m).all()
    # tags from 36.439" to 40.416" west, of 21.19 m a second, and from 32.214" to 34.937" north, of 30.88 m
    assert np.ptp(found.xyz_m, axis=0) == pytest.approx([84.3, 84.1, 0.4], abs=0.15)


def test_seneca_is_used_whole_though_no_tag_tells_its_height(data_dir: Path):
    found = reference(tagged(data_dir / "images" / "seneca40"))
    assert found.is_used.all() and found.review == ()
    assert found.frame is not None and found.frame.crs == "EPSG:32617"
    assert np.isnan(found.height_above_ground_m).all() and np.isnan(found.quaternion).all()
    assert (found.std_m == [3, 3, 5]).all()
    assert any("crs.altitude_variance has no measure" in note for note in found.notes)


def test_contradicting_altitudes_of_caliterra_are_said_and_no_height_is_used(data_dir: Path):
    found = reference(tagged(data_dir / "images" / "caliterra"))
    assert found.is_used.all()
    assert np.isinf(found.std_m[:, 2]).all() and (found.std_m[:, :2] == 3).all()
    # the origin's height stands in: nothing is left but the earth's curvature over 100 m
    np.testing.assert_allclose(found.xyz_m[:, 2], 0, rtol=0, atol=0.01)
    said = [note for note in found.notes if "contradict each other: from 317.3 m (IMG_9354.jpg) to 395.1 m" in note]
    assert len(said) == 1 and "climb with time by 81 m" in said[0]
    assert found.frame is not None and "all may be wrong by tens of metres" in found.frame.height_note
    assert any("missed an update, 1: IMG_9371.jpg" in note for note in found.notes)


def test_without_positions_there_is_no_frame_and_it_is_said(data_dir: Path):
    found = reference(tagged(data_dir / "images" / "copr"))
    assert found.frame is None
    assert not found.is_used.any()
    assert len(found.review) == 41
    assert "adjusted without a place on earth" in found.notes[0]


def test_a_target_crs_without_positions_has_no_effect_and_it_is_said():
    found = reference([simple(k, None) for k in range(3)], target_crs="EPSG:32615")
    assert "EPSG:32615 (WGS 84 / UTM zone 15N) has no effect without positions" in found.notes[1]
    with pytest.raises(JaxbaError, match="is geographic"):
        reference([simple(0, None)], target_crs="EPSG:4326")
    assert reference([]).xyz_m.shape == (0, 3)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("EPSG:4326", "is geographic: its axes are degrees, not lengths. Give a projected CRS. EPSG:32615"),
        ("EPSG:32633", "does not contain the survey"),
        ("EPSG:32615+5773", "Declare them with crs.height_datum=EPSG:5773"),
    ],
)
def test_a_target_that_does_not_fit_stops_the_stage(text: str, words: str):
    with pytest.raises(JaxbaError, match=words):
        reference(survey(), target_crs=text)


def test_the_local_frame_and_the_target_agree_with_proj_point_by_point():
    from jaxba.geo import projected_from_local

    photos = survey(relative_altitude_m=50.0)
    found = reference(photos, target_crs="EPSG:32615")
    lon, lat = np.array([(p.position.x, p.position.y) for p in photos if p.position]).T
    x, y = Transformer.from_crs("EPSG:4326", "EPSG:32615", always_xy=True).transform(lon, lat)
    assert found.frame is not None
    expected = np.stack([x, y, np.full(len(x), 300.0)], axis=1)
    # 1e-6 m: doubles at a northing of 5e6 m keep 1e-9 m, the earth-centred inverse 1e-7 m
    np.testing.assert_allclose(projected_from_local(found.frame, found.xyz_m), expected, rtol=0, atol=1e-6)


def test_a_declared_datum_passes_and_a_missing_grid_is_named():
    found = reference(survey(), target_crs="EPSG:32615+5773", height_datum="EPSG:5773")
    assert found.frame is not None and found.frame.height_datum == "EPSG:5773"
    with pytest.raises(JaxbaError, match=r"us_nga_egm96_15\.tif"):
        reference(survey(), target_crs="EPSG:32615+5773", height_datum="ellipsoidal")
    with pytest.raises(JaxbaError, match=r"crs.height_datum='?msl'? is no CRS"):
        reference(survey(), height_datum="msl")


def test_photos_without_position_or_height_stay_in_their_rows():
    photos = survey()
    photos[2] = simple(2, None)
    photos[4] = simple(4, at(4, z_m=None))
    found = reference(photos)
    assert np.isnan(found.xyz_m[2]).all() and np.isnan(found.std_m[2]).all() and not found.is_used[2]
    assert [left.name for left in found.review] == ["p002.jpg"]
    assert np.isfinite(found.xyz_m[4]).all() and found.is_used[4]
    assert found.std_m[4].tolist() == [3, 3, np.inf]
    assert "Heights: 1 of 11 positions have no height" in " ".join(found.notes)


def test_gated_positions_keep_their_coordinates_but_are_not_used():
    photos = survey(relative_altitude_m=50.0)
    photos[3] = simple(3, at(3, relative_altitude_m=65.0))
    found = reference(photos)
    assert np.isfinite(found.xyz_m[3]).all()
    assert np.flatnonzero(~found.is_used).tolist() == [3]


@pytest.mark.parametrize("stated_m", [2.5, 7.65, 10.0, 40.0])
@pytest.mark.parametrize("params", [{}, {"h_accuracy_threshold": 10.0}, {"h_accuracy_threshold": 100.0}])
def test_positions_of_any_stated_accuracy_are_used_with_it(stated_m: float, params: dict[str, float]):
    outputs = crs.run(crs.Inputs(photos=tuple(survey(std_h_m=stated_m))), crs.Params(**params))
    found, limit_m = outputs.reference, params.get("h_accuracy_threshold", 2.0)
    assert found.is_used.all()
    assert found.std_m.tolist() == [[stated_m, stated_m, 2 * stated_m]] * 12
    told = Told(photos=tuple(f"p{k:03d}.jpg" for k in range(12)))
    said = f"12 photos (p000.jpg, p001.jpg, p002.jpg, ...): states a horizontal accuracy of {stated_m:.2f} m, over"
    assert any(line.startswith(said) for line in crs.lines(outputs, told)) == (stated_m > limit_m)


def test_too_few_positions_stop_the_stage_with_counts_and_cures():
    photos = [*survey(2), *[simple(2 + k, None) for k in range(3)]]
    photos.append(simple(5, Position(x=92.0, y=46.8, z_m=300.0)))
    with pytest.raises(JaxbaError) as error:
        reference(photos)
    text = str(error.value)
    assert text.startswith("only 2 of 6 photos have a position that can be used, and crs.min_positions=3.")
    assert "missing coordinates: 3; far from the others: 1 (first: p002.jpg has no usable coordinates" in text
    assert "loosen crs.altitude_variance or crs.min_positions" in text
    assert reference(photos, min_positions=2).is_used.sum() == 2


def test_one_place_for_all_is_said():
    photos = [simple(k, Position(x=-92.0, y=46.8, z_m=300.0)) for k in range(4)]
    assert "one and the same place" in " ".join(reference(photos).notes)


def test_a_projection_that_stretches_is_said():
    notes = " ".join(reference(survey(), target_crs="EPSG:3857").notes)
    assert "A metre on the ground is 1.46" in notes and "measure no lengths in it" in notes


@pytest.mark.parametrize(
    ("name", "value"), [("h_accuracy_threshold", 101.0), ("altitude_variance", 0.005), ("min_positions", 0)]
)
def test_gates_outside_their_range_are_refused(name: str, value: float):
    with pytest.raises(JaxbaError, match=rf"crs\.{name}={value} is out of range"):
        reference(survey(), **{name: value})


def test_the_same_photos_give_the_same_bytes():
    one, other = reference(survey()), reference(survey())
    assert one.xyz_m.tobytes() == other.xyz_m.tobytes()
    assert one.frame == other.frame and one.notes == other.notes
