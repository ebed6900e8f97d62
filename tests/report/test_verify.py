"""Verification of exports: a clean project passes, and each fault planted in a file is named with file, value, cure."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import laspy
import numpy as np
import pytest
from pyogrio import raw
from small_survey import Survey

from jaxba import JaxbaError
from jaxba.cli import main
from jaxba.io import CrsText
from jaxba.io._read_cloud import read_csv_cloud, read_las, read_ply
from jaxba.pipeline import PIPELINE
from jaxba.report.verification import Params, verify


@pytest.fixture
def export(made: Survey, tmp_path: Path) -> Path:
    """The exports of a copy of the project, to be tampered with."""
    project = tmp_path / "project"
    shutil.copytree(made.project, project, ignore=shutil.ignore_patterns("features", "match"))
    return project / "export"


def failures(export: Path, **limits: float) -> dict[str, str]:
    return {
        check.name: check.text for check in verify(export.parent, PIPELINE, Params(**limits)) if check.state == "FAIL"
    }


def rewrite_csv(path: Path, change: Callable[[list[list[str]]], None]) -> None:
    rows = [line.split(",") for line in path.read_text().splitlines()]
    change(rows)
    path.write_text("\n".join([*(",".join(row) for row in rows), ""]))


def test_a_clean_project_passes_every_check(made: Survey):
    found = verify(made.project, PIPELINE, Params())
    assert {check.state for check in found} == {"ok"}
    names = [check.name for check in found]
    assert len(set(names)) == len(names) > 30 and all(check.text for check in found)
    median = next(check for check in found if check.name == "median error")
    summary = json.loads((made.project / "summary.json").read_text())
    assert float(median.text.split(" px")[0]) == pytest.approx(summary["adjust"]["median_px"], abs=1e-3)


def test_clouds_read_back_are_one(made: Survey):
    csv, ply, las = (
        read(made.project / "export" / f"cloud.{suffix}").cloud
        for read, suffix in ((read_csv_cloud, "csv"), (read_ply, "ply"), (read_las, "laz"))
    )
    for other in (ply, las):
        np.testing.assert_allclose(other.xyz, csv.xyz, atol=0.0015)  # thousandths, rounded twice
        assert (other.point_id == csv.point_id).all() and (other.rgb == csv.rgb).all()
        assert (other.track_length == csv.track_length).all()
        np.testing.assert_allclose(other.std_m, csv.std_m, rtol=1e-6, atol=6e-4)  # the CSV has millimetres


def test_a_nan_in_the_cloud(export: Path):
    rewrite_csv(export / "cloud.csv", lambda rows: rows[17].__setitem__(1, "nan"))
    found = failures(export)
    assert set(found) == {"numbers cloud.csv"}
    assert "Y of point 17 is nan (1 of" in found["numbers cloud.csv"] and "run again" in found["numbers cloud.csv"]


def test_a_binary_model_that_is_cut_off(export: Path):
    path = export / "colmap" / "binary" / "points3D.bin"
    path.write_bytes(path.read_bytes()[:200])
    found = failures(export)
    assert set(found) == {"files"} and "colmap/binary/points3D.bin changed since they were written" in found["files"]


def test_a_damaged_frame_does_not_blame_the_clouds(export: Path):
    (export / "colmap" / "frame.json").write_text('{"world"')
    assert set(failures(export)) == {"schema colmap/frame.json"}


def test_a_nan_in_colmap(export: Path):
    path = export / "colmap" / "text" / "points3D.txt"
    lines = path.read_text().splitlines()
    row = next(k for k, line in enumerate(lines) if line.startswith("5 "))
    lines[row] = " ".join(["5", "inf", *lines[row].split()[2:]])
    path.write_text("\n".join(lines))
    found = failures(export)
    assert f"points3D.txt, line {row + 1}: damaged (inf is not a finite number)" in found["schema colmap/text"]


def lose_las(export: Path) -> None:
    las = laspy.read(export / "cloud.laz")
    las.header.vlrs = laspy.vlrs.vlrlist.VLRList(
        [vlr for vlr in las.header.vlrs if not isinstance(vlr, laspy.vlrs.known.WktCoordinateSystemVlr)]
    )
    las.write(export / "cloud.laz")


def rewrite_geopackage(export: Path, crs: str | None) -> None:
    meta, _, geometry, columns = raw.read(export / "cameras.gpkg")
    (export / "cameras.gpkg").unlink()
    raw.write(
        export / "cameras.gpkg", geometry, columns, meta["fields"], layer="cameras", geometry_type="Point Z", crs=crs
    )  # fmt: skip


def rewrite_json(path: Path, change: Callable[[dict], None]) -> None:
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def without_code(rows: list[list[str]]) -> None:
    for row in rows[1:]:
        row[-1] = ""


LOST = {
    "cloud.laz": (lose_las, "its header says no CRS"),
    "cameras.gpkg": (lambda e: rewrite_geopackage(e, None), "its layer says no CRS"),
    "cloud.csv.json": (lambda e: rewrite_json(e / "cloud.csv.json", lambda c: c.update(wkt=None)), "says no CRS"),
    "cloud.csv": (lambda e: rewrite_csv(e / "cloud.csv", without_code), "column EPSG says no CRS"),
}


@pytest.mark.filterwarnings("ignore:'crs' was not provided")  # pyogrio's, on the file that the test writes
@pytest.mark.parametrize("file", LOST)
def test_a_lost_crs(export: Path, file: str):
    lose, message = LOST[file]
    lose(export)
    found = failures(export)
    assert set(found) == {f"CRS {file}"}
    assert message in found[f"CRS {file}"] and "EPSG:32615 (WGS 84 / UTM zone 15N)" in found[f"CRS {file}"]


def test_another_crs(export: Path):
    rewrite_geopackage(export, "EPSG:32616")
    found = failures(export)
    assert set(found) == {"CRS cameras.gpkg"}
    assert "says EPSG:32616, it must be EPSG:32615" in found["CRS cameras.gpkg"]


def test_a_compound_crs_survives_the_words_of_las():
    from pyproj import CRS

    from jaxba.report.verification._place import _same_crs

    text = "EPSG:32615+5773"
    wkt = CrsText(text=text, name="", unit="", height_unit="", height_note="").wkt1()
    assert _same_crs("CRS", "header", wkt, CRS(text), text).state == "ok"
    assert _same_crs("CRS", "header", wkt, CRS("EPSG:32615"), "").state == "FAIL"


def test_one_cloud_shifted_by_500_m(export: Path):
    def shift(rows: list[list[str]]) -> None:
        for row in rows[1:]:
            row[0] = f"{float(row[0]) + 500:.3f}"

    rewrite_csv(export / "cloud.csv", shift)
    found = failures(export)
    names = ("same points", "cloud at its cameras cloud.csv", "positions in the cloud's box cloud.csv")
    assert set(found) == set(names)
    assert "500.000 units of the CRS apart in cloud.csv and" in found["same points"]
    away_m = float(found["cloud at its cameras cloud.csv"].split(" m from")[0].split()[-1])
    assert away_m == pytest.approx(500, abs=30)  # a camera looks aside by some metres
    assert "0 of 8 measured positions" in found["positions in the cloud's box cloud.csv"]


def test_axes_swapped_leave_the_area_of_use(export: Path):
    def swap(rows: list[list[str]]) -> None:
        for row in rows[1:]:
            row[0], row[1] = row[1], row[0]

    rewrite_csv(export / "cloud.csv", swap)
    assert "X and Y may be swapped" in failures(export)["area of use cloud.csv"]


def test_shifted_cameras(export: Path):
    import shapely

    meta, _, geometry, columns = raw.read(export / "cameras.gpkg")
    moved = shapely.transform(shapely.from_wkb(geometry), lambda xyz: np.add(xyz, [0, 30, 0]), include_z=True)
    (export / "cameras.gpkg").unlink()
    raw.write(
        export / "cameras.gpkg", shapely.to_wkb(moved, output_dimension=3, flavor="iso"), columns, meta["fields"],
        layer="cameras", geometry_type="Point Z", crs=meta["crs"],
    )  # fmt: skip
    found = failures(export)
    assert set(found) == {"camera positions"} and "adjusted minus measured is 30.0" in found["camera positions"]


def test_a_median_over_one_pixel(export: Path):
    path = export / "colmap" / "text" / "images.txt"
    rng, lines = np.random.default_rng(0), path.read_text().splitlines()
    first = next(k for k, line in enumerate(lines) if not line.startswith("#"))
    for k in range(first + 1, len(lines), 2):
        numbers = lines[k].split()
        xy = np.array(numbers, dtype=object).reshape(-1, 3)
        xy[:, :2] = xy[:, :2].astype(float) + rng.normal(size=(len(xy), 2)) * 2
        lines[k] = " ".join(map(str, xy.ravel()))
    path.write_text("\n".join(lines))
    found = failures(export)
    assert set(found) == {"median error"}
    # of a normal error of 2 px an axis: 2 sqrt(2 ln 2)
    assert float(found["median error"].split(" px")[0]) == pytest.approx(2.355, abs=0.05)
    assert "over verify.max_median_px=1" in found["median error"]
    assert failures(export, max_median_px=2.5) == {}


def test_few_inliers(made: Survey):
    found = failures(made.project / "export", min_inlier_rate=1.0)
    assert set(found) == {"inlier rate"} and "under verify.min_inlier_rate=1" in found["inlier rate"]


def test_files_that_are_missing_or_empty(export: Path):
    (export / "cloud.ply").unlink()
    (export / "cloud.png").write_bytes(b"")
    found = failures(export)
    assert set(found) == {"files"}
    assert found["files"].startswith("cloud.ply is missing, cloud.png is empty, of 17 files; run again")


def extra_column(rows: list[list[str]]) -> None:
    for row in rows:
        row.append("slope")


def missing_column(rows: list[list[str]]) -> None:
    for row in rows:
        del row[4]


def short_row(rows: list[list[str]]) -> None:
    del rows[4][-1]


def word(rows: list[list[str]]) -> None:
    rows[4][4] = "good"


def endless_cell(rows: list[list[str]]) -> None:
    rows[4][4] = "1" * 200_000


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (extra_column, "column slope is not known; expected are X, Y"),
        (missing_column, "column error_px is missing"),
        (short_row, "line 5: 12 values in 13 columns"),
        (word, "column error_px: could not convert string to float: 'good'"),
        (endless_cell, "line 5: field larger than field limit"),
    ],
)
def test_a_csv_of_another_form(export: Path, change: Callable[[list[list[str]]], None], message: str):
    rewrite_csv(export / "cloud.csv", change)
    found = failures(export)
    assert set(found) == {"schema cloud.csv"} and message in found["schema cloud.csv"]


def cut_ply(export: Path) -> None:
    path = export / "cloud.ply"
    path.write_bytes(path.read_bytes()[:-39])


def rename_ply(export: Path) -> None:
    path = export / "cloud.ply"
    path.write_bytes(path.read_bytes().replace(b"float error_px", b"float error", 1))


def las_without_a_dimension(export: Path) -> None:
    las = laspy.read(export / "cloud.laz")
    las.remove_extra_dim("point_id")
    las.write(export / "cloud.laz")


def cut_laz(export: Path) -> None:
    path = export / "cloud.laz"
    path.write_bytes(path.read_bytes()[:-5000])


def geopackage_without_a_column(export: Path) -> None:
    meta, _, geometry, columns = raw.read(export / "cameras.gpkg")
    (export / "cameras.gpkg").unlink()
    raw.write(
        export / "cameras.gpkg", geometry, columns[:-1], meta["fields"][:-1],
        layer="cameras", geometry_type="Point Z", crs=meta["crs"],
    )  # fmt: skip


def shot_without_camera(export: Path) -> None:
    def change(content: list[dict]) -> None:
        next(iter(content[0]["shots"].values()))["camera"] = "other"

    rewrite_json(export / "reconstruction.json", change)


def colmap_without_point(export: Path) -> None:
    path = export / "colmap" / "text" / "points3D.txt"
    path.write_text("\n".join(line for line in path.read_text().splitlines() if not line.startswith("7 ")))


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("cloud.ply", cut_ply, "its header says"),
        ("cloud.ply", rename_ply, "column error_px is missing"),
        ("cloud.laz", las_without_a_dimension, "extra dimension point_id is missing"),
        ("cloud.laz", cut_laz, "cannot be read as LAS"),
        ("cameras.gpkg", geopackage_without_a_column, "column reason is missing"),
        ("reconstruction.json", shot_without_camera, "has camera 'other', which cameras lacks"),
        ("colmap/text", colmap_without_point, "sees point 7, which points3D.txt lacks"),
    ],
)
def test_a_file_of_another_form(export: Path, name: str, change: Callable[[Path], None], message: str):
    change(export)
    found = failures(export)
    assert set(found) == {f"schema {name}"} and message in found[f"schema {name}"]


def test_counts_that_disagree(export: Path):
    rewrite_csv(export / "cloud.csv", lambda rows: rows.pop())
    found = failures(export)
    assert {"counts points", "counts observations", "same points"} == set(found)
    assert "the files disagree: cloud.csv 3," in found["counts points"]


def test_a_block_without_positions_skips_what_needs_a_place(export: Path):
    """Its record and its frame say so; the files that need a CRS are not written then."""
    rewrite_json(export / "colmap" / "frame.json", lambda content: content.pop("origin"))
    states = {check.name: check for check in verify(export.parent, PIPELINE, Params())}
    assert states["CRS"].state == "skipped" and "no place on earth" in states["CRS"].text
    assert states["median error"].state == "ok"


def test_bad_input_is_told_from_failure(export: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    def code(*arguments: str) -> tuple[object, str, str]:
        with pytest.raises(SystemExit) as ended:
            main(arguments)
        return (ended.value.code, *capsys.readouterr())

    project = export.parent
    assert code("verify", str(project))[0] == 0
    assert code("verify", str(tmp_path))[0] == 2
    (export / "cloud.csv").unlink()
    status, out, _ = code("verify", str(project), "--json")
    facts = json.loads(out)
    assert status == 1 and not facts["passed"]
    assert [check["name"] for check in facts["checks"] if check["state"] == "FAIL"] == ["files"]
    assert code("verify", str(project))[1].splitlines()[-1].endswith("checks failed: files")
    shutil.rmtree(project / "stages" / "export")
    status, _, err = code("verify", str(project))
    assert status == 2 and "nothing was exported yet" in err


def test_a_folder_that_is_no_project_is_said(tmp_path: Path):
    with pytest.raises(JaxbaError, match="is no project"):
        verify(tmp_path, PIPELINE, Params())
