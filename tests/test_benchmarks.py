"""The peers of the speed benchmark solve the same problem as jaxba does."""

import argparse
from pathlib import Path

import numpy as np
import pytest

import jaxba
from benchmarks.cases import speed_cases
from benchmarks.cost import cost_of, reprojection
from benchmarks.record import Values
from benchmarks.run import run_case


def test_cost_of_gtsam_is_that_of_its_values(data_dir: Path) -> None:
    pytest.importorskip("gtsam", reason="gtsam has no wheel for this machine")
    from benchmarks.peers.gtsam_lm import solve_with_gtsam

    problem, loss = jaxba.read_bal(data_dir / "bal/problem-49-7776-pre.txt"), jaxba.Huber(1.0)
    assert np.sum(reprojection(problem, Values.of(problem))[1] <= 0) == 31  # behind their camera
    record = solve_with_gtsam(problem, loss, max_num_iterations=2)
    assert record.initial_cost == pytest.approx(cost_of(problem, loss, Values.of(problem)), rel=1e-12)
    assert record.final_cost == pytest.approx(cost_of(problem, loss, record.values), rel=1e-12)
    assert record.final_cost < 0.2 * record.initial_cost  # 120651 to 7976


def test_points_behind_cameras_pull_on_gtsam_by_the_derivatives_of_bal() -> None:
    gtsam = pytest.importorskip("gtsam", reason="gtsam has no wheel for this machine")
    from benchmarks.peers.gtsam_lm import _Behind, _factor_behind

    point_key = gtsam.symbol_shorthand.P(7)
    pose = gtsam.Pose3(gtsam.Rot3.Ypr(0.3, 0.2, 0.1), np.array([1.0, 2.0, 3.0]))
    camera = gtsam.PinholeCameraCal3Bundler(pose, gtsam.Cal3Bundler(500.0, 1e-2, 1e-3, 0.0, 0.0))
    point, xy_px, std_px = pose.transformFrom(np.array([0.3, -0.5, -4.0])), np.array([3.0, 4.0]), 2.0

    def residual(step: np.ndarray) -> np.ndarray:
        moved = camera.retract(step[:9])
        in_cam = moved.pose().transformTo(point + step[9:])
        xy, intrinsics = in_cam[:2] / in_cam[2], moved.calibration()
        r2 = xy @ xy
        return (intrinsics.fx() * (1 + intrinsics.k1() * r2 + intrinsics.k2() * r2**2) * xy - xy_px) / std_px

    values = gtsam.Values()
    values.insert(0, camera)
    values.insert(point_key, point)
    loss = jaxba.Huber(10.0)
    factor = _factor_behind([_Behind(xy_px, std_px, 0, point_key)], loss)
    jacobian, right = factor.linearize(values).jacobian()
    at = residual(np.zeros(12))
    weight = float(loss.f_scale) / np.linalg.norm(at)
    steps = 1e-6 * np.eye(12)
    central = np.stack([(residual(step) - residual(-step)) / 2e-6 for step in steps], axis=1)
    np.testing.assert_allclose(right, -np.sqrt(weight) * at, rtol=1e-12)
    np.testing.assert_allclose(jacobian, np.sqrt(weight) * central, rtol=0, atol=1e-6)  # central difference, up to 250


def test_case_that_gtsam_cannot_do_is_left_out_with_the_reason() -> None:
    options = argparse.Namespace(solvers="gtsam", max_nfev=1, scipy_seconds=1.0, repeats=1, no_memory=True, cores=1)
    result = run_case(speed_cases([10])["uav10"], options)
    assert result["solvers"] == []
    assert result["left_out"]["gtsam"].startswith(("GTSAM's factors have BAL's camera", "gtsam cannot be imported"))
