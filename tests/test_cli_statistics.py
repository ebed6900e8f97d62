"""`jaxba solve --statistics`: what it prints is what `jaxba.statistics` says of the written solution."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from commands import Cli

import jaxba


@pytest.fixture(scope="module")
def tile(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A block with control, of which one point is 0.3 m too high."""
    problem = jaxba.synthetic.uav_block(20, seed=3, points_per_image=30.0, num_control=14).problem
    control = problem.prior("control")
    xyz = np.array(control.xyz)  # type: ignore[union-attr]
    xyz[5, 2] += 0.3
    priors = tuple(dataclasses.replace(p, xyz=xyz) if p is control else p for p in problem.priors)  # type: ignore[call-arg]
    path = tmp_path_factory.mktemp("tile") / "tile.npz"
    jaxba.write_tile(path, dataclasses.replace(problem, priors=priors))
    return path


def test_statistics_are_those_of_the_written_solution(cli: Cli, tile: Path) -> None:
    out = tile.with_name("solved.npz")
    code, text, _ = cli("solve", tile, "--statistics", "--json", "--out", out)
    told = json.loads(text)["statistics"]
    found = jaxba.statistics(jaxba.read_tile(out))
    assert code == 0 and told["redundancy"] == found.covariance.redundancy
    assert told["variance_factor"] == pytest.approx(found.covariance.variance_factor, rel=1e-9)
    assert [row["name"] for row in told["components"]] == [component.name for component in found.components]
    assert told["largest"][0]["group"] == "control" and told["largest"][0]["row"] == 5
    assert told["largest"][0]["test"] == pytest.approx(np.abs(found.prior("control").test[5]).max(), rel=1e-6)
    assert np.array(told["correlation"]).shape == (len(told["unknowns"]),) * 2
    assert told["p_value"] == pytest.approx(found.p_value, rel=1e-6) and found.p_value < 0.01

    code, text, _ = cli("solve", tile, "--statistics", "--out", out)
    assert code == 0 and "largest: control of point 5" in text and "variance factor" in text
    assert "position horizontal: scatter by" in text and "k1 and k2 -0.9" in text


def test_a_block_without_gauge_is_solved_all_the_same(cli: Cli, tile: Path) -> None:
    free = tile.with_name("free.npz")
    jaxba.write_tile(free, dataclasses.replace(jaxba.read_tile(tile), priors=()))
    out = tile.with_name("free.solved.npz")
    code, text, _ = cli("solve", free, "--statistics", "--out", out)
    assert code == 0 and out.exists() and "There are none. Statistics: problem has no gauge" in text
    code, text, _ = cli("solve", free, "--statistics", "--datum", "inner", "--json", "--out", out)
    found = jaxba.statistics(jaxba.read_tile(out), datum="inner")
    told = json.loads(text)["statistics"]
    assert code == 0 and told["redundancy"] == found.covariance.redundancy
    assert told["variance_factor"] == pytest.approx(found.covariance.variance_factor, rel=1e-9)
    code, _, said = cli("solve", free, "--datum", "inner")
    assert code == 2 and "--datum inner: is that of the statistics. Add --statistics." in said
    code, text, _ = cli("solve", free, "--statistics", "--json", "--out", out)
    assert "no gauge" in json.loads(text)["statistics"]["why_not"]


def test_statistics_of_a_batch_are_refused(cli: Cli, tile: Path) -> None:
    code, _, error = cli("solve", tile, tile.with_name("other.npz"), "--statistics")
    assert code == 2 and "--statistics" in error and "one file" in error


def test_estimated_weights_are_told_and_written(cli: Cli, tile: Path) -> None:
    """Sigmas stated 4 times too large come back; the solved tile has them, so that another solve changes nothing."""
    problem = jaxba.read_tile(tile)
    seen = dataclasses.replace(problem.observations, std_px=4.0 * np.asarray(problem.observations.std_px))
    jaxba.write_tile(tile.with_name("wide.npz"), dataclasses.replace(problem, observations=seen))
    out = tile.with_name("weighed.npz")
    code, text, _ = cli("solve", tile.with_name("wide.npz"), "--estimate-weights", "--json", "--out", out)
    told = json.loads(text)["weights"]
    assert code == 0 and told["settled"] and told["times"]["tie points"] == pytest.approx(0.25, rel=0.1)
    std_px = np.asarray(jaxba.read_tile(out).observations.std_px)
    assert np.median(std_px) == pytest.approx(told["std"]["tie points"])
    code, text, _ = cli("solve", out, "--estimate-weights", "--out", out.with_name("again.npz"))
    assert code == 0 and "estimated" in text and "1.00 times what was stated" in text
    code, _, said = cli("solve", out, "--estimate-weights", "--reject", "mad")
    assert code == 2 and "--estimate-weights does not go with --reject" in said
