import inspect
import json
import os
import subprocess
import sys
import typing
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
import pytest
from commands import Cli

import jaxba
from jaxba.cli import _progress, _solve
from jaxba.cli._options import LossName, SolveOptions
from jaxba.cli._text import to_json
from jaxba.engine._compile_cache import folder_name
from jaxba.geometry import BAL, LOSSES


@pytest.fixture(scope="module")
def survey() -> jaxba.synthetic.Survey:
    return jaxba.synthetic.uav_block(6, seed=3, points_per_image=40.0, outlier_fraction=0.02)


@pytest.fixture
def tile(tmp_path: Path, survey: jaxba.synthetic.Survey) -> Path:
    path = tmp_path / "tile.npz"
    jaxba.write_tile(path, survey.problem)
    return path


def test_help_answers_within_half_a_second_and_loads_nothing_heavy():
    code = (
        "import sys\nfrom jaxba.cli import main\ntry: main(['solve', '--help'])\nexcept SystemExit: pass\n"
        "print('HEAVY', *{'jax', 'numpy', 'scipy', 'equinox'} & set(sys.modules))"
    )
    seconds = []
    for _ in range(3):
        begin = os.times()
        run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        end = os.times()  # of the processor, since other programs may have it in between
        seconds.append(end.children_user + end.children_system - begin.children_user - begin.children_system)
        assert "--mad-factor" in run.stdout
        assert run.stdout.splitlines()[-1] == "HEAVY "[:-1]
    assert min(seconds) < 0.5


def test_version_is_that_of_the_package(cli: Cli):
    assert cli("--version") == (0, f"{jaxba.__version__}\n", "")


def test_defaults_and_names_are_those_of_the_python_functions():
    signature = inspect.signature(jaxba.solve).parameters
    options = SolveOptions()
    for name in ("method", "linear_solver", "max_nfev", "ftol", "xtol", "gtol"):
        assert getattr(options, name) == signature[name].default
    reject = inspect.signature(jaxba.solve_and_reject).parameters
    assert (options.mad_factor, _solve._ROUNDS) == (reject["mad_factor"].default, reject["rounds"].default)
    assert list(typing.get_args(LossName)) == list(LOSSES)
    assert options.loss is None  # least squares, as in `jaxba.solve(problem)`, where the file says nothing


def test_the_loss_is_that_of_the_options_and_else_that_of_the_file(
    cli: Cli, tmp_path: Path, survey: jaxba.synthetic.Survey
):
    path = tmp_path / "tile.npz"
    jaxba.write_tile(path, survey.problem, loss=jaxba.Barron(0.5, 2.0))
    costs = {}
    for given, expected in (
        ((), jaxba.Barron(0.5, 2.0)),
        (("--f-scale", 3), jaxba.Barron(0.5, 3.0)),
        (("--alpha", 1), jaxba.Barron(1.0, 2.0)),
        (("--loss", "linear"), jaxba.Linear()),
    ):
        told = json.loads(cli("solve", path, *given, "--max-nfev", 3, "--json")[1])
        solved = jaxba.read_loss(tmp_path / "tile.solved.npz")
        assert type(solved) is type(expected) and vars(solved) == vars(expected)
        assert told["f_scale"] == expected.f_scale
        costs[given] = told["final_cost"]
    assert len(set(costs.values())) == 4
    assert costs["--loss", "linear"] == float(jaxba.solve(survey.problem, max_nfev=3).final_cost)
    found = json.loads(cli("info", path, "--json")[1])
    assert found["loss"] == {"name": "barron", "alpha": 0.5, "f_scale": 2.0}
    assert "barron of scale 2, of shape 0.5" in cli("info", path)[1]


def test_json_tells_what_solve_returns(cli: Cli, tile: Path, survey: jaxba.synthetic.Survey):
    before = tile.read_bytes()
    code, out, err = cli("solve", tile, "--json")
    assert (code, err) == (0, "")
    assert tile.read_bytes() == before
    found = json.loads(out)
    solution = jaxba.solve(survey.problem)
    assert found["result"] == solution.result == "ftol"
    assert (found["initial_cost"], found["final_cost"]) == (solution.initial_cost, solution.final_cost)
    assert found["final_plain_cost"] == pytest.approx(found["final_cost"], rel=1e-14)  # the same in another order
    errors = jaxba.quality(solution.apply(survey.problem))
    assert (found["median_error_px"], found["inlier_rate"]) == (errors.median_px, errors.inlier_rate)
    assert found["num_images"] == 6
    assert found["num_points"] == survey.problem.num_points
    assert found["num_observations"] == survey.problem.num_observations
    assert min(found[f"seconds_{part}"] for part in ("setup", "compile", "solve")) >= 0
    assert [step["step"] for step in found["history"]] == list(range(found["num_steps"] + 1))
    assert set(found["history"][0]) == {"step", "seconds", "cost", "accepted"}
    assert found["history"][-1]["cost"] == found["final_cost"]
    assert found["history"][-1]["seconds"] <= found["seconds_solve"]
    assert found["intrinsics"]["fx"]["after"] == list(solution.cameras.fx)
    assert any("--loss huber" in hint for hint in found["hints"])  # 2% outliers under least squares


def test_solved_tile_holds_the_solution_and_masks(cli: Cli, tile: Path, survey: jaxba.synthetic.Survey):
    bounds, fixed = ("--bounds", "focal=0.995,1.1", "--bounds", "k1=-1,1"), ("--fix", "p1,p2")
    code, out, _ = cli("solve", tile, "--loss", "huber", "--reject", "mad", "--rounds", 1, *bounds, *fixed)
    path = tile.with_name("tile.solved.npz")
    assert (code, out.splitlines()[-1].split()) == (0, ["written", str(path)])
    assert "rejected" in out and "without the loss" in out
    assert "at bounds   fx at its lower bound 3670.08\n" in out  # 0.995 x 3688.52
    assert "fix them, add oblique images" in out
    problem = survey.problem.bound(focal=(0.995, 1.1), k1=(-1.0, 1.0)).fix(intrinsics=["p1", "p2"])
    expected = jaxba.solve_and_reject(problem, rounds=1, loss=jaxba.Huber(1.0))
    solved = jaxba.read_tile(path)
    np.testing.assert_array_equal(solved.points, expected.solution.points)
    np.testing.assert_array_equal(solved.cameras.p1, survey.problem.cameras.p1)
    np.testing.assert_array_equal(solved.free.intrinsics, problem.free.intrinsics)
    np.testing.assert_array_equal(solved.upper, problem.upper)
    with np.load(path) as arrays:
        np.testing.assert_array_equal(arrays["extra_is_used"], expected.used)
        np.testing.assert_array_equal(arrays["extra_is_inlier"], expected.quality.is_inlier)
        np.testing.assert_array_equal(arrays["extra_error_px"], expected.quality.error_px)


def test_not_converged_is_written_all_the_same_and_exits_with_1(cli: Cli, tile: Path):
    code, out, _ = cli("solve", tile, "--max-nfev", 1, "--verbose")
    assert code == 1
    assert "Not converged after max_nfev steps" in out
    assert out.split()[:3] == ["step", "cost", "change"]
    assert tile.with_name("tile.solved.npz").exists()


def test_quiet_prints_nothing(cli: Cli, tile: Path):
    assert cli("solve", tile, "--quiet") == (0, "", "")


def test_interrupt_writes_what_was_reached_and_exits_with_130(
    cli: Cli, tile: Path, survey: jaxba.synthetic.Survey, monkeypatch: pytest.MonkeyPatch
):
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(_progress, "print_step", interrupt)
    code, out, err = cli("solve", tile, "--json", "--verbose")
    found = json.loads(out)
    assert (code, found["result"], found["num_steps"]) == (130, "interrupted", 1)
    assert "holds the values reached so far" in err
    assert np.any(jaxba.read_tile(tile.with_name("tile.solved.npz")).points != survey.problem.points)


def test_an_interrupted_solve_in_tiles_goes_on(cli: Cli, tile: Path, monkeypatch: pytest.MonkeyPatch):
    # breaks where the second call begins anew, or leaves the checkpoint behind
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    whole = json.loads(cli("solve", tile, "--tiled", "--json")[1])
    adjusted = tile.with_name("tile.solved.npz").read_bytes()
    with monkeypatch.context() as patch:
        patch.setattr(_progress, "print_step", interrupt)
        code, out, err = cli("solve", tile, "--tiled", "--json", "--verbose")
    assert (code, json.loads(out)["num_steps"]) == (130, 1) and "the same command goes on from there" in err
    checkpoint = tile.with_name("tile.solved.npz.checkpoint")
    assert checkpoint.is_file()
    code, _, err = cli("solve", tile, "--tiled", "--loss", "cauchy")
    assert code == 2 and f"{checkpoint}: is the checkpoint of another problem or loss; remove it" in err
    code, out, err = cli("solve", tile, "--tiled", "--json")
    assert code == 0 and f"going on from {checkpoint}" in err
    assert json.loads(out)["num_steps"] == whole["num_steps"]
    assert tile.with_name("tile.solved.npz").read_bytes() == adjusted
    assert not checkpoint.exists()


def test_interrupt_before_the_first_step_writes_nothing(cli: Cli, tile: Path, monkeypatch: pytest.MonkeyPatch):
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(_solve, "problem_of_bytes", interrupt)
    assert cli("solve", tile) == (130, "", "jaxba: interrupted; nothing was written.\n")
    assert os.listdir(tile.parent) == ["tile.npz"]


def test_progress_line_is_shown_on_a_terminal_and_removed(cli: Cli, tile: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    _, out, err = cli("solve", tile)
    assert "\x1b" not in out
    assert "\x1b[Kstep 1 " in err and err.endswith("\r\x1b[K")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["solve", "absent.npz"], "absent.npz: no such file"),
        (["solve", "TILE", "--loss", "hubert"], 'Invalid value "hubert" for --loss'),
        (["solve", "TILE", "--lss", "huber"], "Unknown option"),
        (["solve"], 'Command "solve" parameter FILE requires an argument'),
        (["slove", "TILE"], 'Unknown command "slove"'),
        (["solve", "TILE", "--f-scale", "0"], "--f-scale 0: give a positive number"),
        (["solve", "TILE", "--f-scale", "nan"], "--f-scale nan: give a positive number"),
        (["solve", "TILE", "--alpha", "1"], "--alpha 1: only --loss barron"),
        (["solve", "TILE", "--max-nfev", "0"], "--max-nfev 0: give 1 or more"),
        (["solve", "TILE", "--ftol", "-1"], "--ftol -1: give 0"),
        (["solve", "TILE", "--bounds", "focal"], "--bounds focal: give a name, = and two numbers"),
        (["solve", "TILE", "--bounds", "focal=1,2,3"], "--bounds focal=1,2,3: give a name"),
        (["solve", "TILE", "--bounds", "focal=1.1,0.9"], "the lower bound must be below the upper"),
        (["solve", "TILE", "--bounds", "k9=0,1"], "OpenCV camera has focal, fx"),
        (["solve", "TILE", "--bounds", "k1=0,1", "--bounds", "k1=0,2"], "k1 has bounds already"),
        (["solve", "TILE", "--bounds", "focal=1.05,1.1"], "outside its bounds"),
        (["solve", "TILE", "--fix", "fx,zoom"], "--fix zoom: choose from intrinsics, poses, points"),
        (["solve", "TILE", "--fix", "poses,points,intrinsics"], "Nothing is free"),
        (["solve", "TILE", "--rounds", "2"], "Add --reject mad"),
        (["solve", "TILE", "--mad-factor", "0"], "--mad-factor 0: give a positive number"),
        (["solve", "TILE", "--max-memory", "4GB"], "--max-memory 4GB: only a solve in tiles keeps to a limit"),
        (["solve", "TILE", "--tiled", "--method", "dogleg"], "--method dogleg: --tiled solves by Levenberg-Marquardt"),
        (["solve", "TILE", "--tiled", "--linear-solver", "cg"], "--linear-solver cg: --tiled solves by"),
        (["solve", "TILE", "--tiled", "--max-memory", "much"], "max_memory 'much': give an amount from 100MB"),
        (["solve", ".", "--tiled"], ".: a folder, and not that of a project; name a tile.npz or a BAL file"),
        (["solve", "TILE", "--out", "TILE"], "the output is the input"),
        (["solve", "TILE", "--out", "absent/out.npz"], "no such file or directory: create the folder first"),
        (["solve", "TILE", "--out", "out.txt"], "BAL cannot hold OpenCV cameras"),
        (["solve", "TRUNCATED"], "truncated or damaged"),
        (["solve", "TEXT"], "'hello' is not a finite number"),
        (["info", "TEXT"], "'hello' is not a finite number"),
        (["synthetic", "out.npz", "--images", "1"], "num_images=1 is out of range"),
        (["synthetic", "absent/out.npz"], "no such file or directory"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    cli: Cli, tile: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], message: str
):
    monkeypatch.chdir(tile.parent)
    truncated, text = tile.with_name("truncated.npz"), tile.with_name("hello.txt")
    truncated.write_bytes(tile.read_bytes()[:3000])
    text.write_text("hello")
    names = {"TILE": tile.name, "TRUNCATED": truncated.name, "TEXT": text.name}
    before = sorted(os.listdir(tile.parent))
    code, out, err = cli(*(names.get(argument, argument) for argument in arguments))
    assert (code, out) == (2, "")
    assert err.startswith("jaxba: ") and err.count("\n") == 1
    assert message.lower() in err.lower()
    assert sorted(os.listdir(tile.parent)) == before


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["run", "nowhere", "--json"], "nowhere: there is no such folder"),
        (["run", "--json", "nowhere", "--log-json"], "nowhere: there is no such folder"),
        (["run", "nowhere", "--set", "match.ratoi=1", "--json"], "match.ratoi"),
        (["run", "--json"], "PHOTOS"),
        (["status", "nowhere", "--json"], "is no project"),
        (["verify", "nowhere", "--json"], "is no project"),
        (["diagnose", "nowhere", "--json"], "is no project"),
        (["config", "nowhere.toml", "--json"], "nowhere.toml"),
        (["solve", "absent.npz", "--json"], "no such file"),
        (["solve", "absent.npz", "--jason", "--json"], "Unknown option"),
        (["gradcheck", "absent.npz", "--json"], "no such file"),
        (["info", "absent.npz", "--json"], "no such file"),
    ],
)
def test_with_json_bad_input_is_an_object(
    cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], message: str
):
    monkeypatch.chdir(tmp_path)
    code, out, err = cli(*arguments)
    found = json.loads(out)
    assert code == 2 and set(found) == {"error", "exit_code"} and found["exit_code"] == 2
    assert message in found["error"]
    if "--log-json" in arguments:
        assert [json.loads(line)["event"] for line in err.splitlines()] == ["run_begin", "stopped"]
    else:
        assert err == f"jaxba: {found['error']}\n"
    assert list(tmp_path.iterdir()) == []


def test_a_project_is_solved_in_tiles_like_its_tile_in_one_piece(cli: Cli, tile: Path):
    # breaks where the options of one solver go to the other, or a project's own tile is not found or written over
    project = tile.parent / "project"
    (project / "export").mkdir(parents=True)
    (project / "run.json").touch()
    code, _, err = cli("solve", project, "--tiled")
    assert code == 2 and f"{project}: the project has no export/tile.npz yet" in err
    exported = project / "export" / "tile.npz"
    exported.write_bytes(tile.read_bytes())
    options = ("--loss", "huber", "--reject", "mad", "--json")
    code, out, _ = cli("solve", project, "--tiled", "--max-memory", "0.9", *options)
    tiled, whole = json.loads(out), json.loads(cli("solve", tile, *options)[1])
    assert code == 0 and tiled["linear_solver"] == "tiles" and len(tiled["rounds"]) == len(whole["rounds"])
    np.testing.assert_allclose(tiled["final_cost"], whole["final_cost"], rtol=1e-9)
    assert tiled["num_used"] == whole["num_used"]
    assert exported.read_bytes() == tile.read_bytes() and (project / "tile.solved.npz").is_file()


@pytest.mark.parametrize("given", ["project/export/tile.npz", "tile.npz", "../export/tile.npz", "export/tile.npz"])
def test_the_result_of_an_exported_tile_goes_beside_the_export(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given: str
):
    (tmp_path / "project" / "export").mkdir(parents=True)
    (tmp_path / "project" / "run.json").touch()
    here = {"project/export/tile.npz": ".", "export/tile.npz": "project"}.get(given, "project/export")
    monkeypatch.chdir(tmp_path / here)
    assert _solve.default_output(Path(given)).resolve() == tmp_path / "project" / "tile.solved.npz"
    (tmp_path / "project" / "run.json").unlink()  # a folder that is only named so
    assert _solve.default_output(Path(given)).resolve() == tmp_path / "project" / "export" / "tile.solved.npz"


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_read_only_folder_is_refused_before_the_solve(cli: Cli, tile: Path):
    tile.parent.chmod(0o500)
    code, _, err = cli("solve", tile)
    tile.parent.chmod(0o700)
    assert code == 2
    assert "may not be written to" in err


def test_bal_problem_is_written_as_bal_where_the_output_ends_in_txt(cli: Cli, tmp_path: Path):
    survey = jaxba.synthetic.uav_block(
        4, camera=BAL(3650.0, 0.0, 0.0), num_cameras=4, gnss_std_m=None, pixel_std_px=0.0, points_per_image=30.0
    )
    given = eqx.tree_at(lambda p: p.observations.std_px, survey.problem, np.ones(survey.problem.num_observations))
    problem, solved = tmp_path / "problem.txt", tmp_path / "solved.txt"
    jaxba.write_bal(problem, given)
    code, out, _ = cli("solve", problem, "--out", solved, "--fix", "intrinsics", "--max-nfev", 3, "--json")
    cost = 0.5 * np.sum(jaxba.reprojection_errors(jaxba.read_bal(solved)) ** 2)
    # BAL's text holds rotation vectors, which round-trip to a few ulp, and the adjusted residuals are differences
    assert cost == pytest.approx(json.loads(out)["final_cost"], rel=1e-6)
    assert len(json.loads(out)["free_gauge"]) == 7
    assert code in (0, 1)
    assert sorted(os.listdir(tmp_path)) == ["problem.txt", "solved.txt"]


def test_json_has_null_for_what_is_not_finite():
    assert to_json({"a": np.array([1.0, np.nan]), "b": float("inf"), 3: (np.int32(2), True)}) == (
        '{"a": [1.0, null], "b": null, "3": [2, true]}'
    )


@pytest.mark.parametrize("case", ["user's folder", "jax's own variable", "not writable"])
def test_compilation_cache_is_in_the_users_folder_if_that_can_be(tmp_path: Path, case: str):
    blocked = tmp_path / "file"
    blocked.write_text("")
    expected, changes = {
        "user's folder": (str(tmp_path / "jaxba" / folder_name()), {"XDG_CACHE_HOME": str(tmp_path)}),
        "jax's own variable": (str(tmp_path / "own"), {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "own")}),
        "not writable": ("None", {"XDG_CACHE_HOME": str(blocked)}),
    }[case]
    code = (
        "import jaxba, jax\nfrom jaxba.engine._compile_cache import use_compilation_cache as use\nimport jaxba.ba\n"
        "before = jax.config.jax_compilation_cache_dir\nuse()\n"
        "print(before, jax.config.jax_compilation_cache_dir)"
    )
    environment = {key: value for key, value in os.environ.items() if key != "JAX_COMPILATION_CACHE_DIR"}
    run = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment | changes
    )
    before, after = run.stdout.split()
    assert after == expected
    assert before == ("None" if case != "jax's own variable" else expected)  # imports alone set nothing


def test_a_solve_computes_on_the_device_that_it_is_told(cli: Cli, tile: Path):
    # breaks where --device is not heeded, or ends in jax's own error
    try:
        assert cli("solve", str(tile), "--max-nfev", "2", "--device", "cpu")[0] in (0, 1)
        with jax.enable_x64(True):
            assert jax.config.jax_default_device == jax.devices("cpu")[0]  # pyright: ignore[reportAttributeAccessIssue]
        if jax.default_backend() == "cpu":
            code, _, err = cli("solve", str(tile), "--device", "gpu")
            assert code == 2 and "--device gpu: jax sees no such device here (" in err and "jax[cuda12]" in err
    finally:
        jax.config.update("jax_default_device", None)
