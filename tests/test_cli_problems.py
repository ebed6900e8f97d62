"""`jaxba info`, `jaxba synthetic` and `jaxba gradcheck`: what they say of a problem."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from commands import Cli

import jaxba
from jaxba.cli import _gradcheck
from jaxba.cli._info import components


def test_info_tells_what_a_problem_holds(cli: Cli, tmp_path: Path):
    survey = jaxba.synthetic.uav_block(6, seed=3, points_per_image=40.0, outlier_fraction=0.02)
    tile = tmp_path / "tile.npz"
    jaxba.write_tile(tile, survey.problem)
    code, out, err = cli("info", tile, "--json")
    assert (code, err) == (0, "")
    found, problem = json.loads(out), survey.problem
    lengths = {int(n): count for n, count in found["track_lengths"].items()}
    assert sum(lengths.values()) == problem.num_points
    assert sum(n * count for n, count in lengths.items()) == problem.num_observations
    assert found["camera_model"] == "OPENCV"
    assert found["components"] == [[str(i) for i in range(6)]]
    assert found["free"]["intrinsics"]["k3"] == 0 and found["free"]["intrinsics"]["fx"] == 1
    assert found["free_gauge"] == []
    assert found["priors"] == [
        {"name": "position", "rows": 6, "loss": "linear", "median_std": {"std_m": [0.03, 0.03, 0.06]}}
    ]
    total = float(jaxba.solve(problem, max_nfev=1).initial_cost)
    assert sum(found["initial_costs"].values()) == pytest.approx(total, rel=1e-12)
    code, out, _ = cli("info", tile)
    assert code == 0
    assert all(word in out for word in ("connected", "all images hang together", "k3", "position: 6 rows"))


def test_images_that_share_no_point_are_told_apart_by_name():
    problem = jaxba.synthetic.uav_block(6, points_per_image=40.0).problem
    seen = problem.observations
    first_two = seen.image_index < 2
    sees_point = np.bincount(seen.point_index[first_two], minlength=problem.num_points) > 0
    keep = first_two | ~sees_point[seen.point_index]
    problem = dataclasses.replace(
        problem, observations=jax.tree.map(lambda values: values[keep], seen), image_names=tuple("abcdef")
    )
    groups = components(problem)
    assert sorted(name for group in groups for name in group) == list("abcdef")
    assert ["a", "b"] in groups


def test_synthetic_writes_the_same_survey_with_its_truth(cli: Cli, tmp_path: Path):
    paths = tmp_path / "a.npz", tmp_path / "b.npz"
    for path in paths:
        code, out, _ = cli("synthetic", path, "--images", 5, "--seed", 4, "--outliers", 0.05)
        assert code == 0 and "5 images" in out
    assert paths[0].read_bytes() == paths[1].read_bytes()
    survey = jaxba.synthetic.uav_block(5, seed=4, outlier_fraction=0.05)
    np.testing.assert_array_equal(jaxba.read_tile(paths[0]).points, survey.problem.points)
    with np.load(paths[0]) as arrays:
        np.testing.assert_array_equal(arrays["extra_truth_point_xyz_m"], survey.truth.points)
        np.testing.assert_array_equal(arrays["extra_truth_is_outlier"], survey.truth.is_outlier)


def test_gradcheck_prints_a_table_and_exits_by_its_tolerance(cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    checked: list[jaxba.GradientCheck] = []

    def once(*given: Any, tolerance: float, **options: Any) -> jaxba.GradientCheck:
        if not checked:
            checked.append(jaxba.check_gradients(*given, tolerance=tolerance, **options))
        return dataclasses.replace(checked[0], tolerance=tolerance)  # another tolerance is not another computation

    monkeypatch.setattr(_gradcheck, "check_gradients", once)
    path = tmp_path / "tile.npz"
    jaxba.write_tile(path, small_survey().problem)
    code, out, _ = cli("gradcheck", path, "--fix", "intrinsics", "--loss", "cauchy", "--f-scale", 2)
    assert code == 0 and "Derivatives of the optimum are within 1e-05 of central differences." in out
    rows = {line.split("  ")[0] for line in out.splitlines()}
    assert {"pixels", "pixel sigmas", "loss scale", "position xyz"} <= rows
    code, out, _ = cli("gradcheck", path, "--fix", "intrinsics", "--loss", "cauchy", "--tolerance", 1e-30, "--json")
    found = json.loads(out)
    assert code == 1 and not found["passed"] and found["rows"][0]["name"] == "pixels"


def test_gradcheck_refuses_a_block_without_gauge(cli: Cli, tmp_path: Path):
    path = tmp_path / "tile.npz"
    jaxba.write_tile(path, small_survey(gnss_std_m=None).problem)
    code, _, err = cli("gradcheck", path)
    assert code == 2 and "problem has no gauge" in err and "Add a position prior" in err


def small_survey(**options: object) -> jaxba.synthetic.Survey:
    return jaxba.synthetic.uav_block(4, seed=1, camera=jaxba.SimplePinhole(3600.0, 2736.0, 1824.0), **options)
