"""The exports of an adjusted block: the same place on earth in every file, whole files, the same bytes."""

import contextlib
import csv
import json
import os
import resource
from collections.abc import Iterator
from dataclasses import replace
from decimal import Decimal
from pathlib import Path

import laspy
import numpy as np
import pyogrio
import pytest
import shapely
from blocks import Flown, flown_block, project
from PIL import Image
from pyproj import CRS, Transformer
from scipy.spatial.transform import Rotation

from jaxba import geo
from jaxba._errors import JaxbaError
from jaxba.io import CLOUD_COLUMNS, CONTROL_COLUMNS, SITE_COLUMNS, read_tile
from jaxba.pipeline import adjust, crs, export
from jaxba.scene import Control, ControlFit, LeftOut, Photo, Position, Reference

OPK = ("omega", "phi", "kappa")
LON, LAT, HEIGHT = -92.0, 46.8, 198.0
FILES = {
    "README.txt", "cameras.geojson", "cameras.gpkg", "cloud.csv", "cloud.csv.json", "cloud.laz", "cloud.ply",
    "cloud.png", "colmap/binary/cameras.bin", "colmap/binary/images.bin", "colmap/binary/points3D.bin",
    "colmap/frame.json", "colmap/text/cameras.txt", "colmap/text/images.txt", "colmap/text/points3D.txt",
    "reconstruction.json", "tile.npz",
}  # fmt: skip
NEED_A_CRS = {"cameras.geojson", "cameras.gpkg", "cloud.laz"}


def adjusted_outputs(flown: Flown, **changes) -> adjust.Outputs:
    block = replace(flown.block, **changes)
    for value in vars(block).values():
        if isinstance(value, np.ndarray):
            value.flags.writeable = False  # as the runner hands them over
    images, points = block.num_images, block.num_points
    return adjust.Outputs(
        block=block, error_px=flown.error_px, point_error_px=flown.point_error_px,
        position_std_m=np.full((images, 3), 0.02), point_std_m=np.full((points, 3), np.nan),
        intrinsics_std=np.full(block.camera_parameters.shape, np.nan), gnss_residual_m=np.full((images, 3), 0.5),
        gnss_rms_m=(0.5, 0.5, 0.5), num_gnss=images, median_px=float(np.median(flown.error_px)), inlier_rate=1.0,
        variance_factor=1.0, num_rejected=0, rounds=1, std_px=0.5, position_scale=np.ones(3),
    )  # fmt: skip


def referenced(photos: tuple[Photo, ...], **params) -> Reference:
    return crs.run(crs.Inputs(photos=photos), crs.Params(**params)).reference


def inputs(folder: Path, target: str | None = None, height_datum: str = "ellipsoidal") -> export.Inputs:
    """Photos in a grid around the place, whose positions are the block's cameras, roughly."""
    flown = flown_block()
    photos = tuple(
        replace(photo, position=Position(x=LON + 1e-4 * (i % 4), y=LAT + 1e-4 * (i // 4), z_m=HEIGHT + i % 3))
        for i, photo in enumerate(flown.photos)
    )
    reference = referenced(photos, target_crs=target, height_datum=height_datum)
    folder.mkdir(exist_ok=True)
    return export.Inputs(photos=photos, reference=reference, adjusted=adjusted_outputs(flown), folder=folder)


def local_inputs(folder: Path) -> export.Inputs:
    flown = flown_block()
    folder.mkdir(exist_ok=True)
    return export.Inputs(
        photos=flown.photos, reference=referenced(flown.photos), folder=folder,
        adjusted=adjusted_outputs(flown, is_georeferenced=False),
    )  # fmt: skip


def ellipsoidal_from_local(frame, xyz_m: np.ndarray, to: str) -> np.ndarray:
    """Local points in another CRS through earth-centred coordinates, the rotation of the origin written out."""
    lon, lat = np.radians([frame.longitude_deg, frame.latitude_deg])
    east = [-np.sin(lon), np.cos(lon), 0]
    north = [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)]
    up = [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)]
    to_ecef = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    origin = np.array(to_ecef.transform(frame.longitude_deg, frame.latitude_deg, frame.height_m))
    ecef = origin + xyz_m @ np.array([east, north, up])
    lon, lat, height = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True).transform(*ecef.T)
    x, y = Transformer.from_crs("EPSG:4326", to, always_xy=True).transform(lon, lat)
    return np.stack([x, y, height], axis=1)


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> tuple[export.Inputs, export.Outputs]:
    given = inputs(tmp_path_factory.mktemp("export") / "a")
    return given, export.run(given, export.Params())


def test_every_file_is_there_and_named(exported):
    given, outputs = exported
    assert set(outputs.files) == FILES
    assert all((given.folder / name).stat().st_size > 0 for name in outputs.files)
    assert any("EPSG:32615" in note and given.reference.frame.height_note in note for note in outputs.notes)
    assert any("line 2/späte Aufnahme.JPG" in note for note in outputs.notes)
    text = (given.folder / "README.txt").read_text(encoding="utf-8")
    readme = " ".join(text.split())
    assert all(note in readme for note in outputs.notes)
    assert all(name.split("/")[0] in readme for name in outputs.files if name != "README.txt")
    for name, meaning in {**CLOUD_COLUMNS, **SITE_COLUMNS}.items():
        assert f" {name} {meaning}" in readme
    assert "R = Rx(omega) Ry(phi) Rz(kappa)" in readme and "Grid north lies 0.7290 degrees clockwise" in readme
    assert "control.csv" not in readme and max(map(len, text.splitlines())) <= 120


def test_clouds_are_in_the_target_crs_point_by_point(exported):
    given, _ = exported
    block = given.adjusted.block
    expected = ellipsoidal_from_local(given.reference.frame, block.points_m, "EPSG:32615")
    las = laspy.read(given.folder / "cloud.laz")
    assert las.header.parse_crs().to_epsg() == 32615
    np.testing.assert_allclose(las.xyz, expected, rtol=0, atol=0.0005 + 1e-6)
    rows = np.loadtxt(given.folder / "cloud.csv", delimiter=",", skiprows=1, usecols=(0, 1, 2, 3, 12))
    np.testing.assert_allclose(rows[:, :3], expected, rtol=0, atol=0.0005 + 1e-6)
    assert np.array_equal(rows[:, 3], las["point_id"])
    assert set(rows[:, 4]) == {32615}
    assert np.array_equal(np.stack([las.red, las.green, las.blue], 1) // 257, block.rgb)


def test_cameras_lie_in_both_files_at_one_place(exported):
    given, _ = exported
    expected = ellipsoidal_from_local(given.reference.frame, given.adjusted.block.centers_m, "EPSG:32615")
    for name, code in (("cameras.gpkg", 32615), ("cameras.geojson", 4326)):
        meta, _, geometry, columns = pyogrio.raw.read(given.folder / name)
        assert CRS(meta["crs"]).to_2d() == CRS(code)
        xyz = shapely.get_coordinates(shapely.from_wkb(geometry), include_z=True)
        x, y = Transformer.from_crs(code, 32615, always_xy=True).transform(xyz[:, 0], xyz[:, 1])
        found = dict(zip(columns[0], np.stack([x, y, xyz[:, 2]], 1), strict=True))
        assert len(found) == 8
        names = [given.photos[i].name for i in given.adjusted.block.image_index]
        # 1e-3: nine decimals of a degree are 0.1 mm
        np.testing.assert_allclose([found[n] for n in names], expected, rtol=0, atol=1e-3)


@pytest.mark.parametrize("target", ["EPSG:32615", "EPSG:26849"])
def test_omega_phi_kappa_are_those_of_the_cameras_axes_in_the_grid(tmp_path: Path, target: str):
    """The tips of each camera's axes go point by point through earth-centred coordinates into the grid."""
    given = inputs(tmp_path / "a", target)
    export.run(given, export.Params())
    block, frame = given.adjusted.block, given.reference.frame
    _, _, _, columns = pyogrio.raw.read(tmp_path / "a" / "cameras.gpkg")
    fields = list(SITE_COLUMNS)
    rows = {name: k for k, name in enumerate(columns[0])}
    unit_m = CRS(target).axis_info[0].unit_conversion_factor
    axes = Rotation.from_quat(block.quaternion, scalar_first=True).as_matrix() * np.array([1, -1, -1])[:, None]
    for row, index in enumerate(block.image_index):
        ends = block.centers_m[row] + 0.5 * np.concatenate([axes[row], -axes[row]])  # right, top, backwards
        there = ellipsoidal_from_local(frame, ends, target) * [unit_m, unit_m, 1]
        dense = (there[:3] - there[3:]).T
        dense[:2] /= np.sqrt(abs(np.linalg.det(dense)))  # the grid's scale
        found = [columns[fields.index(f"{angle}_deg")][rows[given.photos[index].name]] for angle in OPK]
        again = Rotation.from_euler("XYZ", found, degrees=True).as_matrix()
        np.testing.assert_allclose(again, dense, rtol=0, atol=2e-6)  # coordinates of 5e6 m are rounded to 1e-9 m


@pytest.mark.parametrize("target", ["EPSG:26849", "EPSG:6344"])
def test_feet_and_other_datums_are_those_of_the_crs(tmp_path: Path, target: str):
    given = inputs(tmp_path / "a", target)
    export.run(given, export.Params())
    las = laspy.read(tmp_path / "a" / "cloud.laz")
    found = las.header.parse_crs()
    assert found.to_2d().to_epsg() == CRS(target).to_epsg()
    expected = ellipsoidal_from_local(given.reference.frame, given.adjusted.block.points_m, target)
    scale = CRS(target).axis_info[0].unit_conversion_factor
    # 2.5 m: what WGS 84 and NAD83 may be apart, by the operation chosen
    assert np.abs(las.xyz[:, :2] - expected[:, :2]).max() * scale < 2.5


def surveyed(given: export.Inputs, *, horizontal_only: bool) -> export.Inputs:
    """Five points, two of them check points, of which the last is not marked, beside the block's own."""
    block, rng = given.adjusted.block, np.random.default_rng(1)
    std_m = np.full((5, 3), 0.02)
    off_m = rng.normal(0, 0.3, (5, 3))
    points_std_m = np.full((block.num_points, 3), 0.01)
    fit = replace(
        ControlFit.nothing(5), adjusted_m=block.points_m[:5] + off_m, residual_m=off_m, std_m=std_m.copy(),
        num_marks=np.array([2, 3, 4, 5, 1]), method="adjust",
    )  # fmt: skip
    fit.adjusted_m[4], fit.residual_m[4], fit.std_m[4] = np.nan, np.nan, np.nan
    if horizontal_only:
        std_m[:, 2], fit.residual_m[:, 2], fit.std_m[:, 2], points_std_m[:, 2] = np.inf, np.nan, np.nan, np.nan
    control = replace(
        Control.nothing(), names=("g 1", "g2", "g3", "c1", "c2"), xyz_m=block.points_m[:5], std_m=std_m,
        is_check=np.array([False, False, False, True, True]),
    )  # fmt: skip
    adjusted = replace(given.adjusted, control=fit, point_std_m=points_std_m)
    return replace(given, control=control, adjusted=adjusted)


@pytest.mark.parametrize("horizontal_only", [False, True])
@pytest.mark.parametrize("target", ["EPSG:32615", "EPSG:26849", "EPSG:6344"])
def test_residuals_of_control_are_the_differences_of_its_coordinates(
    tmp_path: Path, target: str, horizontal_only: bool
):
    given = surveyed(inputs(tmp_path / "a", target), horizontal_only=horizontal_only)
    export.run(given, export.Params())
    with open(tmp_path / "a" / "control.csv", encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == list(CONTROL_COLUMNS)
    turn = geo.grid_from_local(given.reference.frame, given.control.xyz_m)
    unit_m = CRS(target).axis_info[0].unit_conversion_factor
    for k, row in enumerate(rows[:4]):
        for axis in "xyz"[: 2 if horizontal_only else 3]:
            adjusted, before = Decimal(row[f"adjusted_{axis}"]), Decimal(row[f"surveyed_{axis}"])
            assert adjusted - before == Decimal(row[f"residual_{axis}"])
        true = np.array([float(row[f"residual_true_{axis}_m"] or 0) for axis in ("east", "north", "up")])
        grid = unit_m * np.array([float(row["residual_x"]), float(row["residual_y"])])
        scale = np.linalg.norm(grid) / np.linalg.norm((turn[k] @ true)[:2])
        np.testing.assert_allclose(grid, scale * (turn[k] @ true)[:2], rtol=0, atol=2e-4)  # of four decimals each
        assert abs(scale - 1) < 2e-3
        assert (row["std_up_m"], row["residual_z"], row["surveyed_z"]) == ("", "", "") or not horizontal_only
        assert row["reason"] == (
            "no surveyed height; no sigma up: nothing measured holds heights" if horizontal_only else ""
        )
    assert rows[4]["adjusted_x"] == "" and rows[4]["reason"].endswith("used marks in fewer than two adjusted photos")
    text = " ".join((tmp_path / "a" / "README.txt").read_text(encoding="utf-8").split())
    assert all(f" {name} {meaning}" in text for name, meaning in CONTROL_COLUMNS.items())
    assert ("points have no sigma up: nothing measured holds heights" in text) == horizontal_only


@pytest.mark.parametrize(
    ("times", "day"),
    [
        (["2024-05-01T10:00:00", "2024-05-02T00:10:00"], "2024-05-02"),
        ([None, "2023-12-31T23:59:59.25+02:00"], "2023-12-31"),
        ([None, None], None),
    ],
)
def test_files_are_dated_by_the_last_photo(times: list[str | None], day: str | None):
    photos = [replace(flown_block().photos[0], time=time) for time in times]
    found = export._flight_date(photos)
    assert (None if found is None else found.isoformat()) == day


def test_same_inputs_give_the_same_bytes(exported, tmp_path: Path):
    given, outputs = exported
    export.run(replace(given, folder=tmp_path), export.Params())
    for name in outputs.files:
        assert (tmp_path / name).read_bytes() == (given.folder / name).read_bytes(), name


def test_tile_is_the_problem_of_the_block(exported):
    given, outputs = exported
    problem = read_tile(given.folder / "tile.npz")
    block = given.adjusted.block
    assert problem.num_images == block.num_images
    assert np.array_equal(problem.points, block.points_m)
    assert np.array_equal(problem.observations.xy_px, block.observation_xy_px)
    assert problem.prior("position") is not None
    assert any("tile.npz leaves out" in note for note in outputs.notes)


@pytest.mark.slow
def test_tile_solves_to_where_the_block_is(exported):
    from jaxba import solve

    given, _ = exported
    problem = read_tile(given.folder / "tile.npz")
    solution = solve(problem)
    rotation = Rotation.from_quat(np.asarray(solution.poses.quaternion), scalar_first=True)
    image, point = np.asarray(problem.observations.image_index), np.asarray(problem.observations.point_index)
    in_cam = rotation[image].apply(np.asarray(solution.points)[point]) + np.asarray(solution.poses.translation)[image]
    cameras = [np.asarray(getattr(solution.cameras, name)) for name in type(solution.cameras).parameter_names()]
    pixel = project("OPENCV", np.stack(cameras, axis=1)[np.asarray(problem.camera_index)[image]], in_cam)
    median = np.median(np.linalg.norm(pixel - problem.observations.xy_px, axis=1))
    # the block is at the truth: at the least cost errors are smaller by what its unknowns take up, half of all
    assert 0.6 * given.adjusted.median_px < median < given.adjusted.median_px


def test_block_without_a_place_has_no_crs_and_says_why(tmp_path: Path):
    given = local_inputs(tmp_path / "a")
    outputs = export.run(given, export.Params())
    assert set(outputs.files) == FILES - NEED_A_CRS
    assert any("no photo has a position" in note and "cloud.laz" in note for note in outputs.notes)
    rows = np.loadtxt(tmp_path / "a" / "cloud.csv", delimiter=",", skiprows=1, usecols=(0, 1, 2))
    np.testing.assert_allclose(rows, given.adjusted.block.points_m, rtol=0, atol=0.0005 + 1e-9)
    assert json.loads((tmp_path / "a" / "colmap" / "frame.json").read_text())["world"] == "arbitrary frame and scale"
    placed = inputs(tmp_path / "b")
    placed = replace(placed, adjusted=adjusted_outputs(flown_block(), is_georeferenced=False))
    notes = export.run(placed, export.Params()).notes
    assert any("could not be placed" in note for note in notes)


@contextlib.contextmanager
def file_size_limit(num_bytes: int) -> Iterator[None]:
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (num_bytes, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def test_full_disk_leaves_whole_files_only_and_says_so(tmp_path: Path, exported):
    given, _ = exported
    with file_size_limit(20_000), pytest.raises(JaxbaError, match=r"not written, File too large: free some space"):
        export.run(replace(given, folder=tmp_path), export.Params())
    written = [path.relative_to(tmp_path) for path in tmp_path.rglob("*") if path.is_file()]
    assert written and len(written) < len(FILES)
    for name in written:
        assert (tmp_path / name).read_bytes() == (given.folder / name).read_bytes(), name


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_read_only_folder_is_named(tmp_path: Path, exported):
    tmp_path.chmod(0o500)
    with pytest.raises(JaxbaError, match="may not be written to"):
        export.run(replace(exported[0], folder=tmp_path), export.Params())


def test_real_photos_lie_where_their_tags_say(data_dir: Path, tmp_path: Path):
    """Cameras at the measured positions: what pyogrio reads in the GeoPackage are the places in EXIF."""
    tags = {}
    for path in sorted((data_dir / "images" / "brighton").glob("*.JPG")):
        with Image.open(path) as image:
            gps = image.getexif().get_ifd(0x8825)
        degrees = [float(d + m / 60 + s / 3600) for d, m, s in (gps[2], gps[4])]
        signs = [-1 if gps[1] == "S" else 1, -1 if gps[3] == "W" else 1]
        tags[path.name] = (degrees[1] * signs[1], degrees[0] * signs[0], float(gps[6]))
    assert len(tags) == 18
    flown = flown_block()
    photos = tuple(
        replace(flown.photos[0], name=name, position=Position(x=x, y=y, z_m=z)) for name, (x, y, z) in tags.items()
    )
    reference = referenced(photos, h_accuracy_threshold=5.0)
    rows, block = slice(0, 6), flown.block
    turned = [np.eye(3)] * 6
    block = replace(
        block, image_index=np.arange(6), quaternion=np.tile([1.0, 0, 0, 0], (6, 1)), unregistered=(
            LeftOut(name=photos[7].name, reason="no overlap"),),
        translation_m=-np.einsum("nij,nj->ni", turned, reference.xyz_m[rows]),
    )  # fmt: skip
    adjusted = replace(adjusted_outputs(flown), block=block)
    export.run(export.Inputs(photos=photos, reference=reference, adjusted=adjusted, folder=tmp_path), export.Params())
    meta, _, geometry, columns = pyogrio.raw.read(tmp_path / "cameras.gpkg")
    assert CRS(meta["crs"]).to_2d().to_epsg() == 32615
    xyz = shapely.get_coordinates(shapely.from_wkb(geometry), include_z=True)
    lon, lat = Transformer.from_crs(32615, 4326, always_xy=True).transform(xyz[:, 0], xyz[:, 1])
    found = dict(zip(columns[0], np.stack([lon, lat, xyz[:, 2]], 1), strict=True))
    assert set(found) == set(tags)
    # 1e-9 degrees: 0.1 mm
    np.testing.assert_allclose([found[n][:2] for n in tags], [tags[n][:2] for n in tags], rtol=0, atol=1e-9)
