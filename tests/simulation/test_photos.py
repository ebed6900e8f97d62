"""The simulated survey: its photos, tags, lists and truth agree, by OpenCV's projection and PROJ's transformations."""

import dataclasses
import io
from pathlib import Path

import cv2
import numpy as np
import pytest
from pyproj import Transformer
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial.transform import Rotation

from jaxba._errors import JaxbaError
from jaxba.cli._surveys import simulate as run
from jaxba.scene import Photo, PhotoFile, cam_from_enu
from jaxba.simulation.photos import Params, simulate, write_survey
from jaxba.vision._photo import read_photo

SMALL = Params(num_images=8, num_oblique=2, width_px=320, num_control=2, num_check=1, seed=3)
LARGE = Params(num_images=7, num_oblique=3, mark_std_px=0.0, num_control=3, num_check=3)
MANY = Params(width_px=320, mark_std_px=0.5)

Files = dict[str, bytes]


@pytest.fixture(scope="module")
def large() -> Files:
    return dict(simulate(LARGE))


@pytest.fixture(scope="module")
def many() -> Files:
    return dict(simulate(MANY))


@pytest.fixture(scope="module")
def photos(many: Files, tmp_path_factory: pytest.TempPathFactory) -> list[Photo]:
    folder = tmp_path_factory.mktemp("photos")
    found = []
    for name, content in many.items():
        if name.endswith(".JPG"):
            path = folder / Path(name).name
            path.write_bytes(content)
            found.append(read_photo(PhotoFile(name=path.name, path=path, sha256="")))
    return found


def truth_of(files: Files) -> dict[str, np.ndarray]:
    return dict(np.load(io.BytesIO(files["truth.npz"])))


def marks_of(files: Files, name: str = "gcp_list.txt") -> list[tuple[np.ndarray, np.ndarray, str, str]]:
    """Return place, pixel, photo and name of each mark in a list."""
    rows = [line.split() for line in files[name].decode().splitlines()[1:]]
    return [(np.array(row[:3], float), np.array(row[3:5], float), row[5], row[6]) for row in rows]


def opencv_pixel(truth: dict[str, np.ndarray], photo: str, target: str) -> np.ndarray:
    image, index = list(truth["image_name"]).index(photo), list(truth["target_name"]).index(target)
    fx, fy, cx, cy, *distortion = truth["camera_parameters"]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    turn = Rotation.from_quat(truth["pose_quaternion_wxyz"][image], scalar_first=True).as_rotvec()
    place = truth["target_xyz_m"][index]
    return cv2.projectPoints(place[None], turn, truth["pose_translation_m"][image], matrix, np.array(distortion))[0][
        0, 0
    ]


def to_geodetic(truth: dict[str, np.ndarray], xyz_m: np.ndarray) -> np.ndarray:
    """Return longitude, latitude, height of local points, by PROJ alone."""
    lat, lon, height = truth["frame_latitude_longitude_height"]
    topocentric = Transformer.from_pipeline(
        f"+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 +lat_0={lat} +lon_0={lon} +h_0={height} "
        "+step +inv +proj=cart +ellps=WGS84 +step +proj=unitconvert +xy_in=rad +xy_out=deg"
    )
    return np.stack(topocentric.transform(*xyz_m.T), axis=1)


def test_survey_has_photos_lists_and_truth_and_the_truth_comes_last(many: Files):
    names = list(many)
    assert names[0] == "README.txt" and names[-3:] == ["gcp_list.txt", "check_list.txt", "truth.npz"]
    assert names[1:-3] == [f"photos/SIM_{i:04d}.JPG" for i in range(1, 25)]
    assert many["gcp_list.txt"].startswith(b"EPSG:32615\n") and many["check_list.txt"].startswith(b"EPSG:32615\n")
    assert {mark[3] for mark in marks_of(many)} == {f"gcp{i:02d}" for i in range(1, 6)}
    assert {mark[3] for mark in marks_of(many, "check_list.txt")} == {f"check{i:02d}" for i in range(1, 6)}


def test_same_parameters_give_the_same_bytes_and_another_seed_others():
    first, second = dict(simulate(SMALL)), dict(simulate(SMALL))
    assert first == second
    other = dict(simulate(dataclasses.replace(SMALL, seed=4)))
    assert all(other[name] != content for name, content in first.items() if name != "README.txt")


def test_noise_of_positions_changes_no_pixel_and_no_truth():
    fine, coarse = (dict(simulate(dataclasses.replace(SMALL, gnss_std_h_m=std))) for std in (0.02, 1.5))
    for name in fine:
        if name.endswith(".JPG"):
            pixels = [cv2.imdecode(np.frombuffer(files[name], np.uint8), cv2.IMREAD_COLOR) for files in (fine, coarse)]
            assert np.array_equal(*pixels)
    a, b = truth_of(fine), truth_of(coarse)
    assert [name for name in a if not np.array_equal(a[name], b[name])] == ["measured_position_m"]


def test_marks_without_noise_are_where_opencv_projects_their_targets(large: Files):
    truth = truth_of(large)
    marks = marks_of(large) + marks_of(large, "check_list.txt")
    assert len(marks) > 15
    for _, xy_px, photo, target in marks:
        np.testing.assert_allclose(xy_px, opencv_pixel(truth, photo, target), atol=6e-4)  # lists have three decimals


def test_targets_are_seen_in_the_photos_where_the_truth_projects_them(large: Files):
    truth = truth_of(large)
    errors = []
    for _, _, photo, target in marks_of(large) + marks_of(large, "check_list.txt"):
        grey = cv2.imdecode(np.frombuffer(large[f"photos/{photo}"], np.uint8), cv2.IMREAD_GRAYSCALE)
        expected = opencv_pixel(truth, photo, target)
        start = (expected - 0.5).astype(np.float32).reshape(1, 1, 2)  # OpenCV: first pixel's centre at 0
        stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
        errors.append(cv2.cornerSubPix(grey, start, (3, 3), (-1, -1), stop)[0, 0] + 0.5 - expected)
    # the corner finder scatters by 0.05 px; no shift of half a pixel, or of the texture, hides in that
    assert np.sqrt(np.mean(np.square(errors))) < 0.08
    assert np.abs(np.mean(errors, axis=0)).max() < 0.025


def test_mark_noise_is_the_one_asked_for(many: Files):
    truth = truth_of(many)
    marks = marks_of(many) + marks_of(many, "check_list.txt")
    errors = [xy_px - opencv_pixel(truth, photo, target) for _, xy_px, photo, target in marks]
    assert np.std(errors) == pytest.approx(0.5, rel=3 / np.sqrt(4 * len(errors)))  # three sigmas of a sigma


def test_tags_hold_the_measured_position_in_wgs84(many: Files, photos: list[Photo]):
    truth = truth_of(many)
    expected = to_geodetic(truth, truth["measured_position_m"])
    for photo, (lon, lat, height) in zip(photos, expected, strict=True):
        position = photo.position
        assert photo.notes == () and position is not None and position.z_m is not None
        assert abs(position.x - lon) < 2e-9 and abs(position.y - lat) < 2e-9  # 0.2 mm
        assert abs(position.z_m - height) < 2e-4
        assert (position.fix, position.height_kind) == ("rtk_fixed", "ellipsoidal")
        assert (position.std_h_m, position.std_v_m) == (0.03, 0.05)
    errors = (truth["measured_position_m"] - truth["center_m"]) / [0.03, 0.03, 0.05]
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(1.0, abs=3 / np.sqrt(2 * errors.size))


def test_tags_hold_the_attitude_with_its_noise(many: Files, photos: list[Photo]):
    true = Rotation.from_quat(truth_of(many)["pose_quaternion_wxyz"], scalar_first=True)
    tagged = Rotation.from_matrix([cam_from_enu(photo.attitude) for photo in photos if photo.attitude])
    errors = np.rad2deg((true * tagged.inv()).as_rotvec())
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(1.5, rel=3 / np.sqrt(2 * errors.size))


def test_lines_reverse_and_the_last_photos_look_at_the_middle(many: Files, photos: list[Photo]):
    nadir, oblique = photos[:20], photos[20:]
    yaws = [photo.attitude.yaw_deg for photo in nadir if photo.attitude]
    assert all(photo.attitude and photo.attitude.pitch_deg < -85 for photo in nadir)
    assert {round(yaw / 180) % 2 for yaw in yaws} == {0, 1}
    truth = truth_of(many)
    axes = Rotation.from_quat(truth["pose_quaternion_wxyz"], scalar_first=True).as_matrix()[20:, 2]
    centers = truth["center_m"][20:]
    aim = centers - axes * (centers[:, 2:] / axes[:, 2:])
    assert len(oblique) == 4 and np.abs(aim[:, :2]).max() < 12
    assert all(photo.attitude and -70 < photo.attitude.pitch_deg < -55 for photo in oblique)


def test_focal_length_in_the_tags_is_off_by_what_is_said(many: Files, photos: list[Photo]):
    true = truth_of(many)["camera_parameters"][0]
    for photo in photos:
        assert photo.focal_source == "focal_plane" and photo.focal_px is not None
        assert true / photo.focal_px == pytest.approx(1.0075, rel=1e-6)


def test_surveyed_targets_are_near_the_true_ones_in_utm(many: Files):
    truth = truth_of(many)
    lon, lat, height = to_geodetic(truth, truth["target_xyz_m"]).T
    x, y = Transformer.from_crs("EPSG:4326", "EPSG:32615", always_xy=True).transform(lon, lat)
    np.testing.assert_allclose(truth["target_in_crs_m"], np.column_stack([x, y, height]), atol=1e-5)
    errors = (truth["target_surveyed_m"] - truth["target_in_crs_m"]) / [0.01, 0.01, 0.015]
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(1.0, abs=3 / np.sqrt(2 * errors.size))
    surveyed = dict(zip(truth["target_name"], truth["target_surveyed_m"], strict=True))
    for place, _, _, name in marks_of(many):
        np.testing.assert_allclose(place, surveyed[name], atol=6e-5)  # four decimals
    lon, lat, height = to_geodetic(truth, truth["center_m"]).T
    x, y = Transformer.from_crs("EPSG:4326", "EPSG:32615", always_xy=True).transform(lon, lat)
    np.testing.assert_allclose(truth["center_in_crs_m"], np.column_stack([x, y, height]), atol=1e-5)


def test_targets_stand_on_the_height_grid(many: Files):
    truth = truth_of(many)
    grid = (truth["terrain_north_m"], truth["terrain_east_m"])
    height = RegularGridInterpolator(grid, truth["terrain_height_m"].astype(float))
    target = truth["target_xyz_m"]
    # linear between heights every 0.25 m on hills that bend by 0.1 a metre
    np.testing.assert_allclose(height(target[:, 1::-1]), target[:, 2], atol=2e-3)
    assert 6 < np.ptp(truth["terrain_height_m"]) < 15


def test_plain_gps_states_no_fix():
    files = dict(simulate(dataclasses.replace(SMALL, gnss_std_h_m=1.5, gnss_std_v_m=3.0)))
    assert b"RtkFlag" not in files["photos/SIM_0001.JPG"]


def test_photos_have_enough_features_that_match_to_the_true_epipolar_line(large: Files):
    truth = truth_of(large)
    sift = cv2.SIFT_create(8000, 3, 0.04, 10, 1.6, True)  # without the shift of its first octave
    fx, fy, cx, cy, *distortion = truth["camera_parameters"]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    rays, descriptors = [], []
    for name in truth["image_name"][:2]:
        grey = cv2.imdecode(np.frombuffer(large[f"photos/{name}"], np.uint8), cv2.IMREAD_GRAYSCALE)
        keypoints, found = sift.detectAndCompute(grey, None)
        assert len(keypoints) > 3000
        at = np.array([k.pt for k in keypoints]) + 0.5
        plane = cv2.undistortPoints(at[:, None], matrix, np.array(distortion))[:, 0]
        rays.append(np.column_stack([plane, np.ones(len(at))]))
        descriptors.append(found)
    pairs = [a for a, b in cv2.BFMatcher().knnMatch(*descriptors, k=2) if a.distance < 0.75 * b.distance]
    first, second = rays[0][[m.queryIdx for m in pairs]], rays[1][[m.trainIdx for m in pairs]]
    rotation = Rotation.from_quat(truth["pose_quaternion_wxyz"], scalar_first=True).as_matrix()
    relative = rotation[1] @ rotation[0].T
    base = truth["pose_translation_m"][1] - relative @ truth["pose_translation_m"][0]
    lines = first @ (np.cross(np.eye(3), base) @ relative).T
    error_px = fx * np.sum(second * lines, axis=1) / np.hypot(lines[:, 0], lines[:, 1])
    fits = np.abs(error_px) < 1.0
    assert fits.sum() > 1000 and fits.mean() > 0.95
    assert np.abs(error_px[fits].mean()) < 0.02


def test_writing_makes_the_folder_and_replaces_an_older_survey(tmp_path: Path):
    folder = tmp_path / "new" / "survey"
    written = write_survey(folder, SMALL)
    assert written.photos == folder / "photos" and written.image_size_px == (320, 240)
    assert written.num_bytes == sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    write_survey(folder, dataclasses.replace(SMALL, num_images=6))
    assert sorted(path.name for path in (folder / "photos").iterdir()) == [f"SIM_{i:04d}.JPG" for i in range(1, 7)]
    assert len(np.load(folder / "truth.npz")["image_name"]) == 6


def test_a_folder_with_other_files_is_refused_and_left_alone(tmp_path: Path):
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(JaxbaError, match="holds no simulated survey"):
        write_survey(tmp_path, SMALL)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]
    with pytest.raises(JaxbaError, match="is a file"):
        write_survey(tmp_path / "mine.txt", SMALL)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"num_oblique": 5}, "num_oblique=5 leaves fewer than 4 of 8 photos"),
        ({"forward_overlap": 0.3, "side_overlap": 0.2, "num_oblique": 0, "num_check": 20}, "photos, fewer than 2"),
    ],
)
def test_surveys_that_cannot_be_are_refused(changes: dict, message: str):
    with pytest.raises(JaxbaError, match=message):
        dict(simulate(dataclasses.replace(SMALL, **changes)))


def test_command_says_what_it_wrote(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    code = run(
        tmp_path / "survey",
        images=6,
        oblique=0,
        width=320,
        height=70.0,
        forward_overlap=0.75,
        side_overlap=0.6,
        gnss_std=(0.03, 0.05),
        attitude_std=1.5,
        control=1,
        check=1,
        mark_std=0.3,
        seed=0,
    )
    assert code == 0
    text = capsys.readouterr().out
    assert "6 photos of 320 x 240 pixels" in text and "1 control point and 1 check point" in text
