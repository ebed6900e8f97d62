"""`jaxba partition`, and `jaxba solve` of several files."""

import dataclasses
import errno
import json
import os
import signal
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np
import pytest
from commands import Cli
from PIL import Image

import jaxba
from jaxba import Problem, Solution
from jaxba._atomic import cannot_write
from jaxba.cli import _solve_batch
from jaxba.io import read_tiles, write_tiles


@pytest.fixture
def cli(cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Cli:
    """Run a command in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return cli


@pytest.fixture(scope="module")
def block() -> Problem:
    return jaxba.synthetic.uav_block(36, num_lines=4, points_per_image=40.0).problem


@pytest.fixture(scope="module")
def problems() -> list[Problem]:
    """Three problems of one shape, that of the survey in `test_cli.py`."""
    problem = jaxba.synthetic.uav_block(6, seed=3, points_per_image=40.0, outlier_fraction=0.02).problem
    moved = [problem.observations.xy_px + shift for shift in (0.0, 0.25, 0.5)]
    return [eqx.tree_at(lambda p: p.observations.xy_px, problem, xy_px) for xy_px in moved]


@pytest.fixture
def files(tmp_path: Path, problems: list[Problem]) -> list[Path]:
    paths = [tmp_path / f"{name}.npz" for name in "abc"]
    for path, problem in zip(paths, problems, strict=True):
        jaxba.write_tile(path, problem)
    return paths


def test_partition_writes_tiles_a_picture_and_a_table(cli: Cli, tmp_path: Path, block: Problem) -> None:
    jaxba.write_tile(tmp_path / "block.npz", block)
    code, out, err = cli("partition", "block.npz", "--max-images", 9, "--overlap", 3)
    assert (code, err) == (0, "")
    found = jaxba.partition(block, max_images=9, overlap=3)
    tiles = read_tiles(sorted((tmp_path / "tiles").glob("tile_*.npz")), block)
    assert [tile.tile.images.tolist() for tile in tiles] == [tile.images.tolist() for tile in found.tiles]
    with Image.open(tmp_path / "tiles" / "tiles.png") as picture:
        assert picture.size == (1600, 900)
    assert "4 by space, with at most 9 images of their own" in out
    assert f"{found.is_separator.sum()} of 36 images are in more than one tile" in out
    assert f"{found.is_cut.sum()} of {block.num_points} points are seen by own images of several tiles" in out
    assert "written     tiles/tile_000.npz to tile_003.npz, and tiles/tiles.png" in out
    rows = [line.split() for line in out.splitlines()[-4:]]
    expected = [(k, len(t.own), 9, len(t.points), t.problem.num_observations) for k, t in enumerate(found.tiles)]
    assert rows == [[str(value) for value in row] for row in expected]

    code, out, _ = cli("partition", "block.npz", "--max-observations", "3e3", "--overlap", 2, "--by", "flight-line",
                       "--json", "--out", "other/place")  # fmt: skip
    found = jaxba.partition(block, max_observations=3e3, overlap=2, by="flight-line")
    told = json.loads(out)
    assert code == 0 and told["num_tiles"] == len(found.tiles) and told["by"] == "flight-line"
    assert told["num_separators"] == found.is_separator.sum() and told["num_points_cut"] == found.is_cut.sum()
    assert told["num_points_left_out"] == found.is_left_out.sum()
    assert [tile["num_own"] for tile in told["tiles"]] == [int(tile.own.sum()) for tile in found.tiles]
    assert [Path(path).parent.as_posix() for path in told["output"]] == ["other/place"] * len(found.tiles)
    assert Path(told["picture"]).is_file()


def test_tiles_keep_the_loss_of_the_block_and_a_batch_solves_each_under_its_own(
    cli: Cli, tmp_path: Path, block: Problem, problems: list[Problem]
) -> None:
    jaxba.write_tile(tmp_path / "block.npz", block, loss=jaxba.Huber(1.5))
    cli("partition", "block.npz", "--max-images", 9, "--overlap", 3)
    assert {repr(jaxba.read_loss(path)) for path in (tmp_path / "tiles").glob("*.npz")} == {"Huber(f_scale=1.5)"}
    jaxba.write_tile(tmp_path / "a.npz", problems[0])
    jaxba.write_tile(tmp_path / "b.npz", problems[0], loss=jaxba.Cauchy(2.0))
    _, out, _ = cli("solve", "a.npz", "b.npz", "--json")
    first, second = json.loads(out)["files"]
    assert [(told["loss"], told["f_scale"]) for told in (first, second)] == [("linear", 1.0), ("cauchy", 2.0)]
    for told, loss in ((first, None), (second, jaxba.Cauchy(2.0))):
        assert told["final_cost"] == float(jaxba.solve(problems[0], loss=loss).final_cost)
    assert eqx.tree_equal(jaxba.read_loss(tmp_path / "b.solved.npz"), jaxba.Cauchy(2.0))


def test_partition_takes_sizes_from_the_settings_of_the_project(cli: Cli, tmp_path: Path, block: Problem) -> None:
    # breaks where a project's own settings are not looked at, or its export is written into
    project = tmp_path / "project"
    (project / "export").mkdir(parents=True)
    (project / "run.json").touch()
    (project / "jaxba.toml").write_text("[tiles]\nmax_observations = 1e4\noverlap = 10\n")
    code, _, err = cli("partition", project)
    assert code == 2 and "the project has no export/tile.npz yet" in err
    jaxba.write_tile(project / "export" / "tile.npz", block)
    for given in ("project", "project/export/tile.npz"):
        told = json.loads(cli("partition", given, "--json")[1])
        assert (told["max_observations"], told["max_images"], told["by"]) == (1e4, None, "space")
        assert {path.name for path in (project / "export").iterdir()} == {"tile.npz"}
        assert (project / "tiles" / "tiles.png").is_file() and told["num_tiles"] == 1
    told = json.loads(cli("partition", project, "--json", "--max-images", 18)[1])
    assert (told["max_images"], told["num_tiles"], told["tiles"][0]["num_images"]) == (18, 2, 28)

    (tmp_path / "jaxba.toml").write_text('[tiles]\nchunk_size = 100\nby = "flight-line"\n')
    jaxba.write_tile(tmp_path / "block.npz", block)
    told = json.loads(cli("partition", "block.npz", "--json")[1])
    assert (told["max_images"], told["by"], told["num_tiles"]) == (100, "flight-line", 1)
    assert "1: the block fits in one tile, with at most 100 images" in cli("partition", "block.npz")[1]
    assert cli("partition", "block.npz", "--quiet") == (0, "", "")


def test_a_second_partition_leaves_nothing_that_could_be_mixed_up(cli: Cli, tmp_path: Path, block: Problem) -> None:
    jaxba.write_tile(tmp_path / "block.npz", block)
    cli("partition", "block.npz", "--max-images", 9, "--overlap", 3)
    tiles = tmp_path / "tiles"
    (tiles / "tile_003.solved.npz").write_bytes((tiles / "tile_003.npz").read_bytes())
    _, out, _ = cli("partition", "block.npz", "--max-images", 18, "--overlap", 3)
    assert "to delete   solved tiles of another partition: tiles/tile_003.solved.npz" in out
    names = ["tile_000.npz", "tile_001.npz", "tile_003.solved.npz", "tiles.png"]
    assert sorted(os.listdir(tiles)) == names
    assert "to delete" not in cli("partition", "block.npz", "--max-images", 9, "--overlap", 3)[1]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["partition", "absent.npz"], "no such file"),
        (["partition", "a.npz", "--max-images", "4", "--max-observations", "1e4"], "a tile has one size; give one"),
        (["partition", "a.npz", "--max-images", "1"], "max_images is 1; give a whole number of images, 2 or more"),
        (["partition", "a.npz", "--max-images", "3"], "overlap 50: the tiles have 3 images of their own"),
        (["partition", "a.npz", "--by", "time"], 'Invalid value "time" for --by'),
        (["partition", "a.npz", "--out", "b.npz"], "b.npz: not written, File exists"),
        (["partition", "."], ".: a folder, and not that of a project"),
        (["solve", "a.npz", "b.npz", "--tiled"], "--tiled: is for one file, and several are solved at a time here"),
        (["solve", "a.npz", "b.npz", "--verbose"], "--verbose: is for one file"),
        (["solve", "a.npz", "b.npz", "--linear-solver", "dense"], "--linear-solver dense: is for one file"),
        (["solve", "a.npz", "b.npz", "--max-memory", "4GB"], "--max-memory 4GB: only a solve in tiles"),
        (["solve", "a.npz", "b.npz", "--f-scale", "0"], "--f-scale 0: give a positive number"),
        (["solve", "a.npz", "b.npz", "--bounds", "k1"], "--bounds k1: give a name"),
        (["solve", "a.npz", "b.npz", "--out", "out.npz"], "--out out.npz: several files are solved; name a folder"),
        (["solve", "a.npz", "b.npz", "--out", "c.npz/d"], "not written, Not a directory"),
        (["solve", "a.npz", "b.npz", "./a.npz"], "a.npz: is named twice; name it once"),
        (["solve", "a.npz", "b.npz", "other/a.npz", "--out", "o"], "would be that of a.npz, too; solve them into two"),
        (["solve", "a.npz", "."], ".: a folder, and not that of a project"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused_before_anything_is_done(
    cli: Cli, files: list[Path], tmp_path: Path, arguments: list[str], message: str
) -> None:
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "a.npz").write_bytes(files[0].read_bytes())
    code, out, err = cli(*arguments)
    assert (code, out) == (2, "") and err.startswith("jaxba: ") and message in err
    assert {"a.npz", "b.npz", "c.npz", "other"} <= set(os.listdir(tmp_path)) <= {*"abc", "a.npz", "b.npz", "c.npz",
                                                                               "other", "o"}  # fmt: skip


def _result(path: Path) -> tuple[np.ndarray, np.ndarray]:
    solved = jaxba.read_tile(path)
    with np.load(path) as arrays:
        return np.asarray(solved.points), arrays["extra_is_used"]


def test_several_files_are_each_solved_as_alone_and_once(
    cli: Cli, files: list[Path], problems: list[Problem], monkeypatch: pytest.MonkeyPatch
) -> None:
    # breaks where results change places, options get lost, or what is done already is done again
    solved: list[int] = []

    def counted(given: list[Problem], **options: Any) -> list[Solution]:
        solved.append(len(given))
        return jaxba.solve_batch(given, **options)

    monkeypatch.setattr(_solve_batch, "solve_batch", counted)
    options = ("--loss", "huber", "--reject", "mad")
    code, out, err = cli("solve", *files, *options)
    assert (code, err) == (0, "") and "files       3: 3 solved\nconverged   3 of 3\n" in out
    assert len([line for line in out.splitlines() if " of 3  " in line and ": ftol, cost" in line]) == 3
    for path, problem in zip(files, problems, strict=True):
        alone = jaxba.solve_and_reject(problem, loss=jaxba.Huber(1.0))
        points, used = _result(path.with_name(f"{path.stem}.solved.npz"))
        # padded to the others' sizes after the first round, so not the same bytes
        np.testing.assert_allclose(points, alone.solution.points, rtol=1e-9, atol=1e-7)
        np.testing.assert_array_equal(used, alone.used)
    assert solved == [3, 3, 3]

    before = {path: path.read_bytes() for path in files[0].parent.glob("*.solved.npz")}
    code, out, _ = cli("solve", *files, *before, *options)
    assert code == 0 and "3 done already" in out and "passed over 3 results of other files" in out and solved[3:] == []
    jaxba.write_tile(files[1], problems[0])
    files[2].with_name("c.solved.npz").write_bytes(b"PK and then nothing")
    code, out, _ = cli("solve", *files, *options, "--json")
    told = {Path(entry["input"]).stem: entry["state"] for entry in json.loads(out)["files"]}
    assert code == 0 and told == {"a": "done already", "b": "solved", "c": "solved"}
    assert files[0].with_name("a.solved.npz").read_bytes() == before[files[0].with_name("a.solved.npz")]
    cli("solve", *files, "--quiet", *options[:-2])
    assert solved[-1] == 3  # other options, other results


def test_what_fails_is_named_and_the_others_are_solved(cli: Cli, files: list[Path], problems: list[Problem]) -> None:
    files[0].write_bytes(files[0].read_bytes()[:2000])
    jaxba.write_tile(files[1], dataclasses.replace(problems[1], image_names=("one.jpg",) * 6).bound(k1=(1.0, 2.0)))
    code, out, err = cli("solve", "absent.npz", *files)
    assert code == 2 and "4: 1 solved, 3 failed" in out and "converged   1 of 1" in out
    assert len(err.splitlines()) == 3 and all(line.startswith("jaxba: ") for line in err.splitlines())
    assert "absent.npz: no such file" in err and f"{files[0]}: is truncated or damaged" in err
    assert f"{files[1]}: k1 of camera 0 starts at 0, outside its bounds 1,2" in err
    assert sorted(path.name for path in files[0].parent.glob("*.solved.npz")) == ["c.solved.npz"]
    told = json.loads(cli("solve", files[0], files[2], "--json", "--quiet")[1])
    assert [entry["state"] for entry in told["files"]] == ["failed", "done already"]
    assert "truncated" in told["files"][0]["error"] and told["files"][1]["converged"]


def test_options_that_fit_no_camera_are_said_of_each_file(cli: Cli, files: list[Path]) -> None:
    code, _, err = cli("solve", *files, "--fix", "zoom")
    assert code == 2
    assert [line.partition(": --fix zoom: choose from")[0] for line in err.splitlines()] == [
        f"jaxba: {file}" for file in files
    ]


def test_not_converged_exits_with_1_also_when_done_already(cli: Cli, files: list[Path]) -> None:
    for state in ("solved", "done already"):
        code, out, _ = cli("solve", *files, "--max-nfev", 1)
        assert code == 1 and f"3 {state}" in out and "converged   0 of 3" in out
        assert f"{files[0]} (max_nfev), " in out


def test_after_ctrl_c_the_same_command_goes_on(cli: Cli, files: list[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    # breaks where what is finished is lost, what is half done is written, or threads go on to the end
    def interrupted(path: Path, *args: Any, **options: Any) -> None:
        jaxba.write_tile(path, *args, **options)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(_solve_batch, "write_tile", interrupted)
    code, out, err = cli("solve", *files)
    written = sorted(path.name for path in files[0].parent.glob("*.solved.npz"))
    assert code == 130 and err == "jaxba: interrupted; the same command goes on with the files that are left.\n"
    assert written == ["a.solved.npz"] and "3: 1 solved, 2 left" in out  # the first one, whose program the others share
    monkeypatch.undo()
    monkeypatch.chdir(files[0].parent)
    code, out, _ = cli("solve", *files)
    assert code == 0 and "3: 2 solved, 1 done already" in out


def test_a_full_disk_ends_the_batch_and_keeps_what_is_written(
    cli: Cli, files: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, *args: Any, **options: Any) -> None:
        if path.name != "a.solved.npz":
            raise cannot_write(path, OSError(errno.ENOSPC, ""))
        jaxba.write_tile(path, *args, **options)

    monkeypatch.setattr(_solve_batch, "write_tile", full)
    code, _, err = cli("solve", *files)
    assert code == 2 and ".solved.npz: not written, No space left on device: free some space" in err
    assert sorted(path.name for path in files[0].parent.glob("*.solved.npz")) == ["a.solved.npz"]


def test_files_are_solved_so_many_at_a_time_as_fit(
    cli: Cli, files: list[Path], problems: list[Problem], monkeypatch: pytest.MonkeyPatch
) -> None:
    at_a_time: list[int] = []

    def counted(given: list[Problem], **options: Any) -> list[Solution]:
        at_a_time.append(len(given))
        return jaxba.solve_batch(given, **options)

    monkeypatch.setattr(_solve_batch, "solve_batch", counted)
    monkeypatch.setattr(_solve_batch, "_AT_A_TIME", 2 * problems[0].num_observations)
    code, out, _ = cli("solve", *files, "--out", "new/folder")
    assert code == 0 and at_a_time == [2, 1] and "3: 3 solved" in out
    assert sorted(os.listdir("new/folder")) == ["a.solved.npz", "b.solved.npz", "c.solved.npz"]


@pytest.mark.parametrize("several", [False, True])
def test_solved_tiles_keep_their_place(
    cli: Cli, files: list[Path], problems: list[Problem], tmp_path: Path, several: bool
) -> None:
    (tile,) = write_tiles(tmp_path / "tiles", jaxba.partition(problems[0], max_images=6))
    assert cli("solve", tile, *(files[1:] if several else []), "--max-nfev", 2)[0] == 1
    (found,) = read_tiles([tmp_path / "tiles" / "tile_000.solved.npz"], problems[0])
    np.testing.assert_array_equal(found.tile.points, np.arange(problems[0].num_points))
    assert not np.array_equal(found.tile.problem.points, problems[0].points)
