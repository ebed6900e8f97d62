"""Batches: many problems at once against each solved alone."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxba
from jaxba import JaxbaError, Problem, Solution
from jaxba.ba import _descend
from jaxba.geometry import Huber

_SIZES = (9, 10, 11, 12)


@pytest.fixture(scope="module")
def problems() -> list[Problem]:
    """Blocks of several sizes, and one with control points, which is of another kind."""
    made = [jaxba.synthetic.uav_block(n, seed=n, points_per_image=40.0, outlier_fraction=0.02).problem for n in _SIZES]
    made.append(jaxba.synthetic.uav_block(10, seed=5, points_per_image=40.0, num_control=3).problem)
    return made


def test_each_solution_is_the_one_of_solve_whatever_it_is_padded_to(
    problems: list[Problem], monkeypatch: pytest.MonkeyPatch
) -> None:
    # breaks where padding weighs something, programs are shared by what differs, or results change places
    compiled = []
    compile_one = _descend._compile.__wrapped__
    fresh = _descend.functools.lru_cache(maxsize=None)(lambda *a: compiled.append(a) or compile_one(*a))
    monkeypatch.setattr(_descend, "_compile", fresh)
    told: dict[int, Solution] = {}
    found = jaxba.solve_batch(problems, loss=Huber(1.0), callback=told.__setitem__)
    assert len(compiled) == 2  # one for the four sizes, one for the block with control points
    assert [told[k] is found[k] for k in range(5)] == [True] * 5
    for problem, solution in zip(problems, found, strict=True):
        alone = jaxba.solve(problem, loss=Huber(1.0))
        assert solution.num_steps == alone.num_steps and solution.result == alone.result
        np.testing.assert_allclose(solution.final_cost, alone.final_cost, rtol=1e-10)
        np.testing.assert_allclose(solution.poses.translation, alone.poses.translation, rtol=1e-10, atol=1e-7)
        np.testing.assert_allclose(solution.cameras.fx, alone.cameras.fx, rtol=1e-8)
        assert solution.points.shape == problem.points.shape
        assert solution.report.problem.num_images == problem.num_images
    again = jaxba.solve_batch(problems, loss=Huber(1.0), workers=1)
    for one, other in zip(found, again, strict=True):
        values, others = (jax.tree.leaves(eqx.tree_at(lambda s: s.status, s, 0)) for s in (one, other))
        for value, same in zip(values, others, strict=True):
            np.testing.assert_array_equal(value, same)


def test_a_bad_problem_is_named_before_anything_is_solved(problems: list[Problem]) -> None:
    broken = eqx.tree_at(lambda p: p.observations.std_px, problems[1], -np.ones(problems[1].num_observations))
    solved = []
    with pytest.raises(JaxbaError, match=r"solve_batch: problem 1 of 2: .*std_px"):
        jaxba.solve_batch([problems[0], broken], callback=lambda *one: solved.append(one))
    assert not solved


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"workers": 0}, "solve_batch: workers is 0"),
        ({"ftol": -1.0}, "solve_batch: ftol is -1"),
    ],
)
def test_options_out_of_range_are_refused(problems: list[Problem], options: dict[str, object], message: str) -> None:
    with pytest.raises(JaxbaError, match=message):
        jaxba.solve_batch(problems, **options)


def test_no_problems_have_no_solutions() -> None:
    assert jaxba.solve_batch([]) == []


def test_a_batch_is_differentiated_like_its_problems(problems: list[Problem]) -> None:
    # breaks where a traced batch takes values as known
    with jax.enable_x64(True):

        def cost(scale: jax.Array, solve: object) -> jax.Array:
            pixels = jnp.asarray(problems[0].observations.xy_px)
            pair = [
                eqx.tree_at(lambda p: p.observations.xy_px, problems[0], part * pixels) for part in (scale, scale**2)
            ]
            return sum(solution.cameras.fx[0] for solution in solve(pair))

        batch = jax.grad(cost)(jnp.asarray(1.0), jaxba.solve_batch)
        alone = jax.grad(cost)(jnp.asarray(1.0), lambda pair: [jaxba.solve(p) for p in pair])
    np.testing.assert_allclose(batch, alone, rtol=1e-12)
