"""`solve` as users call it: published costs, Ceres, jit and vmap, interruption, what is left out."""

import dataclasses
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
import pytest
from quick_jit import quick_jit
from scipy.spatial.transform import Rotation
from small_problems import RADIAL, bounded, small_problem

import jaxba
from jaxba.ba import HistoryStep, Observations, _descend, _kept_programs

# one problem, with an optimum at bounds, and one loss, so that most solves share one program
PROBLEM = bounded(small_problem(RADIAL, num_outliers=3), 0.01)
LOSS = jaxba.Huber(1.0)


@pytest.mark.parametrize(("name", "most"), [("49-7776", 13345.0), ("21-11315", 30379.0)])
def test_cost_of_a_published_problem_is_reached(data_dir: Path, name: str, most: float) -> None:
    problem = jaxba.read_bal(data_dir / f"bal/problem-{name}-pre.txt")
    solution = jaxba.solve(problem)
    assert solution.converged
    assert solution.final_cost <= most
    assert len(solution.report.free_gauge) == 7


def test_robust_cost_is_that_of_ceres(data_dir: Path) -> None:
    pytest.importorskip("pyceres", reason="pyceres has no wheel for this machine")
    from benchmarks.peers.ceres import solve_with_ceres

    problem = jaxba.read_bal(data_dir / "bal/problem-21-11315-pre.txt")
    loss = jaxba.Huber(1.0)
    ceres = solve_with_ceres(problem, loss, max_num_iterations=100)
    solution = jaxba.solve(problem, loss=loss)
    # the promise is to be as good within 0.1%; lower is welcome
    assert solution.final_cost <= 1.001 * ceres.final_cost


@pytest.mark.parametrize("method", ["lm", "dogleg"])
def test_solve_inside_jit_equals_the_host_loop(method: str) -> None:
    host = jaxba.solve(PROBLEM, method=method, loss=LOSS)
    plan = jaxba.make_plan(PROBLEM)

    @quick_jit
    def final(problem: jaxba.Problem) -> tuple[jax.Array, ...]:
        found = jaxba.solve(problem, method=method, loss=LOSS, plan=plan)
        return found.num_steps, found.final_cost, found.cameras.f, found.points

    num_steps, final_cost, f, points = jax.device_get(final(_on_device(PROBLEM)))
    assert int(num_steps) == int(host.num_steps)
    np.testing.assert_allclose(final_cost, host.final_cost, rtol=1e-12)
    np.testing.assert_array_equal(f, host.cameras.f)
    assert f in (PROBLEM.lower[:, 0], PROBLEM.upper[:, 0])
    np.testing.assert_allclose(points, host.points, rtol=0, atol=1e-6)  # metres; rounding along weak directions


def test_vmap_over_pixels_equals_one_solve_each() -> None:
    plan = jaxba.make_plan(PROBLEM)
    xy_px = PROBLEM.observations.xy_px
    noise = 0.1 * np.random.default_rng(0).normal(size=(3, *xy_px.shape))

    def final_cost(xy_px: jax.Array) -> jax.Array:
        moved = eqx.tree_at(lambda p: p.observations.xy_px, PROBLEM, xy_px)
        return jaxba.solve(moved, loss=LOSS, plan=plan, max_nfev=30).final_cost

    together = quick_jit(jax.vmap(final_cost))(xy_px + noise)
    alone = [
        jaxba.solve(eqx.tree_at(lambda p: p.observations.xy_px, PROBLEM, xy_px + n), loss=LOSS).final_cost
        for n in noise
    ]
    np.testing.assert_allclose(together, np.stack(alone), rtol=1e-9)


@pytest.mark.parametrize("offset", [(5e5, 4.6e6, 300.0), (-3e3, 0.0, 0.0), (1e9, -1e9, 1e9)])
def test_the_origin_of_the_world_does_not_change_the_answer(offset: tuple[float, float, float]) -> None:
    here = jaxba.solve(PROBLEM, loss=LOSS)
    there = jaxba.solve(moved(PROBLEM, np.array(offset)), loss=LOSS)
    # of each coordinate given, times what the geometry makes of it, beside what rounding in the equations leaves in
    # weak directions: up to 1.7e-9 m over four offsets within 10 km and three tolerances of the solve
    rounding = 64 * np.spacing(np.abs(offset).max()) + 3e-9
    assert there.result == here.result
    assert there.num_steps == here.num_steps
    np.testing.assert_allclose(there.final_cost, here.final_cost, rtol=1e-9 + 100 * rounding)
    np.testing.assert_allclose(there.points - offset, here.points, rtol=0, atol=rounding)
    np.testing.assert_allclose(np.asarray(there.poses.center) - offset, here.poses.center, rtol=0, atol=rounding)


def test_a_group_that_says_nothing_of_the_world_keeps_its_coordinates() -> None:
    class OwnPosition(jaxba.PositionPrior):
        in_world = None

    position = PROBLEM.prior("position")
    own = OwnPosition(position.image_index, position.xyz + 1e4, position.std_m)
    problem = eqx.tree_at(lambda p: p.priors, moved(PROBLEM, np.full(3, 1e4)), (own, *PROBLEM.priors[1:2]))
    assert jaxba.solve(problem, loss=LOSS).final_cost < 1e3


@pytest.mark.parametrize("method", ["lm", "dogleg"])
@pytest.mark.parametrize("distance_m", [1e3, 1e6, 1e9])
@pytest.mark.parametrize("times", [1.0, 3.0])
def test_far_points_do_not_hold_up_the_others(method: str, distance_m: float, times: float) -> None:
    near = jaxba.solve(PROBLEM, method=method, loss=LOSS)
    problem = with_far_points(PROBLEM, distance_m, times)
    far = jaxba.solve(problem, method=method, loss=LOSS)
    assert far.converged
    assert far.num_steps <= near.num_steps + 15
    points = np.concatenate([near.points, problem.points[problem.num_points - 4 :]])
    elsewhere = eqx.tree_at(lambda p: (p.poses, p.points), problem, (near.poses, points))
    again = jaxba.solve(elsewhere, method=method, loss=LOSS)
    np.testing.assert_allclose(far.final_cost, again.final_cost, rtol=1e-6)


def test_one_wild_start_value_does_not_end_the_solve() -> None:
    points = np.array(PROBLEM.points)
    points[7] *= [1, 1, 0]
    points[7, 2] = -1e12  # below the cameras, where its rays meet 10 m below them
    wild = jaxba.solve(eqx.tree_at(lambda p: p.points, PROBLEM, points), loss=LOSS)
    np.testing.assert_allclose(wild.final_cost, jaxba.solve(PROBLEM, loss=LOSS).final_cost, rtol=1e-7)


def test_traced_values_without_a_plan_are_refused_with_the_cure() -> None:
    with pytest.raises(jaxba.JaxbaError, match=r"plan=jaxba\.make_plan"):
        jax.jit(lambda p: jaxba.solve(p).final_cost)(_on_device(PROBLEM))


def test_interrupt_keeps_what_was_reached() -> None:
    def stop(step: HistoryStep) -> None:
        if step.step == 2:
            raise KeyboardInterrupt

    solution = jaxba.solve(PROBLEM, loss=LOSS, callback=stop)
    assert solution.result == "interrupted"
    assert int(solution.num_steps) == 2
    assert solution.final_cost == solution.report.history[-1].cost < solution.initial_cost


def test_evaluation_limit_is_not_convergence() -> None:
    solution = jaxba.solve(PROBLEM, loss=LOSS, max_nfev=1)
    assert solution.result == "max_nfev"
    assert not solution.converged


def test_conjugate_gradients_that_give_up_are_not_convergence(monkeypatch: pytest.MonkeyPatch) -> None:
    # breaks where a short step of an unfinished linear solve passes for the optimum
    problem = jaxba.synthetic.uav_block(8, points_per_image=30.0).problem
    done = jaxba.solve(problem, linear_solver="cg")
    assert done.converged and max(step.linear_iterations for step in done.report.history) < 500
    for module in ("_factor", "_solution"):
        monkeypatch.setattr(f"jaxba.ba.{module}.CG_MAX_STEPS", 2)
    monkeypatch.setattr(_kept_programs, "_folder", lambda: None)
    _descend._compile.cache_clear()  # the limit is a constant of the program
    given_up = jaxba.solve(problem, linear_solver="cg", ftol=1e-3)
    _descend._compile.cache_clear()
    assert max(step.linear_iterations for step in given_up.report.history) == 2
    assert given_up.result == "cg_unconverged" and not given_up.converged
    assert "Solve in tiles" in given_up.advice


def test_too_little_memory_is_told_before_the_first_step(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("jaxba.ba._descend.free_memory", lambda: 1e4)
    monkeypatch.setattr("jaxba.ba._descend._SURELY_FREE", 1e4)
    with pytest.raises(jaxba.JaxbaError, match=r"a step needs .* of memory, and 10.0 kB are free. .*max_memory"):
        jaxba.solve(PROBLEM, loss=LOSS)


def test_point_behind_the_camera_is_left_out_and_named() -> None:
    points = PROBLEM.points.copy()
    points[3, 2] = 1e4  # far above the flight
    problem = eqx.tree_at(lambda p: p.points, PROBLEM, points)
    solution = jaxba.solve(problem, loss=LOSS)
    assert solution.converged
    assert "behind the camera" in " ".join(solution.report.dropped.summary())
    np.testing.assert_array_equal(solution.points[3], points[3])


def test_second_solve_gives_the_same_bytes() -> None:
    first, second = (jaxba.solve(PROBLEM, loss=LOSS) for _ in range(2))
    assert first.points.tobytes() == second.points.tobytes()
    assert first.poses.quaternion.tobytes() == second.poses.quaternion.tobytes()


def test_rejection_leaves_out_gross_errors_and_little_else() -> None:
    survey = jaxba.synthetic.uav_block(12, seed=2, outlier_fraction=0.05)
    cleaned = jaxba.solve_and_reject(survey.problem, rounds=2, loss=jaxba.Huber(1.0))
    outlier = survey.truth.is_outlier
    assert np.mean(cleaned.used[outlier]) < 0.1
    # a Rayleigh distribution has 7% beyond median + 2.5 MAD; residuals of points seen twice are smaller than the
    # others, which lowers the median and costs more of those, in both rounds
    assert np.mean(cleaned.used[~outlier]) > 0.7
    assert len(cleaned.solutions) == 3


def test_float32_comes_near_the_double_precision_cost() -> None:
    single = jaxba.solve(PROBLEM, loss=LOSS, dtype=np.float32, ftol=1e-6)
    double = jaxba.solve(PROBLEM, loss=LOSS)
    assert single.points.dtype == np.float32
    # pixels of 1000 have steps of 6e-5 in float32, beside a noise of 0.5
    np.testing.assert_allclose(single.final_cost, double.final_cost, rtol=1e-2)


def _on_device(problem: jaxba.Problem) -> jaxba.Problem:
    floats, rest = eqx.partition(problem, lambda a: isinstance(a, np.ndarray) and a.dtype.kind == "f")
    return eqx.combine(jax.tree.map(jax.numpy.asarray, floats), rest)


def moved(problem: jaxba.Problem, offset: np.ndarray) -> jaxba.Problem:
    """Return the problem in a world whose coordinates are larger by `offset`."""
    rotation = Rotation.from_quat(problem.poses.quaternion, scalar_first=True)
    poses = jaxba.Pose(problem.poses.quaternion, problem.poses.translation - rotation.apply(offset))
    priors = tuple(eqx.tree_at(lambda q: q.xyz, p, p.xyz + offset) if p.in_world else p for p in problem.priors)
    return eqx.tree_at(lambda p: (p.poses, p.points, p.priors), problem, (poses, problem.points + offset, priors))


def with_far_points(problem: jaxba.Problem, distance_m: float, times: float, count: int = 4) -> jaxba.Problem:
    """Return the problem with points this far ahead of the first image, whose start values are `times` as far.

    Three images see each. Pixels have 0.3 px of noise, so that the rays of some meet nowhere.
    """
    rng = np.random.default_rng(1)
    rotation = Rotation.from_quat(np.array(problem.poses.quaternion), scalar_first=True)
    centers = np.asarray(problem.poses.center)
    ahead = np.column_stack([rng.uniform(-0.1, 0.1, (count, 2)), np.ones(count)])
    points = centers[0] + distance_m * rotation[0].inv().apply(ahead)
    image, point = (a.ravel() for a in np.meshgrid(np.arange(3), np.arange(count), indexing="ij"))
    in_cam = rotation[image].apply(points[point] - centers[image])
    camera = jaxba.Radial(*(float(getattr(problem.cameras, n)[0]) for n in problem.cameras.parameter_names()))
    xy_px = np.asarray(quick_jit(lambda x: camera.project(x))(in_cam)) + 0.3 * rng.normal(size=(len(image), 2))
    seen = problem.observations
    observations = Observations(
        np.concatenate([seen.xy_px, xy_px]),
        np.concatenate([seen.std_px, np.full(len(image), 0.5)]),
        np.concatenate([seen.image_index, image]).astype(np.int32),
        np.concatenate([seen.point_index, problem.num_points + point]).astype(np.int32),
    )
    start = np.concatenate([problem.points, centers[0] + times * (points - centers[0])])
    free = np.concatenate([problem.free.points, np.ones(count, bool)])
    return eqx.tree_at(lambda p: (p.points, p.observations, p.free.points), problem, (start, observations, free))


@pytest.mark.parametrize("tolerances", [{"gtol": 1e-13}, {"gtol": 0.0}], ids=str)
def test_an_optimum_reached_to_rounding_is_called_one(tolerances: dict[str, float]) -> None:
    solution = jaxba.solve(PROBLEM, loss=LOSS, ftol=0.0, xtol=0.0, **tolerances)
    assert solution.result == "rounding" and solution.converged
    assert solution.advice.startswith("Converged: the optimum is reached to rounding")
    assert solution.final_cost == pytest.approx(float(jaxba.solve(PROBLEM, loss=LOSS).final_cost), rel=1e-7)


def test_a_solve_whose_first_refused_steps_are_long_is_stuck() -> None:
    solution = jaxba.solve(PROBLEM, loss=LOSS, ftol=0.0, xtol=0.0, gtol=0.0)
    report = solution.report
    last = max(step.step for step in report.history if step.accepted and step.change > 0)
    first = next(i for i, step in enumerate(report.history) if not step.accepted and i > last - 20)
    long = dataclasses.replace(report.history[first], accepted=False, step_norm=1e6, gradient=1.0)
    history = (*report.history[: first + 1], *[long] * 3, *report.history[-5:])
    stuck = dataclasses.replace(solution, report=dataclasses.replace(report, history=history))
    assert stuck.result == "stuck" and not stuck.converged and "points at infinity" in stuck.advice
