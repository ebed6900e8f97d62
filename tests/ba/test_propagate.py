"""Covariances of functions equal those of a dense inverse, whatever the functions are of."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_covariance import CASES, dense_covariance, small_block

import jaxba
from jaxba import JaxbaError
from jaxba.ba import Problem, propagate


def several(problem: Problem) -> jax.Array:
    """Two distances, a camera's position and attitude, a pixel, intrinsics of the last camera, the antenna."""
    points, poses = jnp.asarray(problem.points), problem.poses
    focal = [jnp.asarray(getattr(problem.cameras, name))[-1] for name in ("fx", "k1")]
    return jnp.concatenate(
        [
            jnp.linalg.norm(points[jnp.array([40, 80])] - points[jnp.array([120, 150])], axis=1),
            poses.center[5],
            poses.rotation[6, 0],
            poses.transform(points[jnp.arange(12)])[2],
            jnp.stack(focal),
            jnp.ravel(jnp.asarray(problem.lever_arm)),
            jnp.ravel(jnp.asarray(problem.position_offset)),
        ]
    )


@pytest.mark.parametrize(("case", "num_tiles"), [(case, 1 + k % 2) for k, case in enumerate(CASES)])
def test_covariance_of_functions_equals_that_of_a_dense_inverse(case: str, num_tiles: int):
    make, loss = CASES[case]
    problem = make()
    found = propagate(several, problem, loss=loss, max_observations=problem.num_observations / num_tiles)
    dense = dense_covariance(problem, loss)

    def moved(step: object) -> jax.Array:
        unknowns = jaxba.ba.Unknowns(
            problem.poses, jnp.asarray(problem.cameras.parameters), jnp.asarray(problem.antenna), problem.points
        ).retract(step)
        values = unknowns.poses, type(problem.cameras).from_parameters(unknowns.intrinsics), unknowns.points
        values = *values, unknowns.lever_arm, unknowns.position_offset
        where = lambda p: (p.poses, p.cameras, p.points, p.lever_arm, p.position_offset)  # noqa: E731
        return several(eqx.tree_at(where, problem, values))

    zero = jax.tree.map(jnp.zeros_like, dense.step)
    by_step = jax.jacfwd(moved)(zero)
    flat = np.concatenate([np.asarray(leaf).reshape(len(found.value), -1) for leaf in jax.tree.leaves(by_step)], axis=1)
    expected = flat @ dense.matrix @ flat.T
    np.testing.assert_allclose(found.value, moved(zero), rtol=1e-12)
    sigma = np.sqrt(np.diagonal(expected))
    np.testing.assert_allclose(found.std, sigma, rtol=1e-7, atol=1e-12)
    unit = np.outer(sigma, sigma)
    known = unit > 1e-24  # what is fixed
    np.testing.assert_allclose(found.covariance[known] / unit[known], expected[known] / unit[known], rtol=0, atol=1e-7)


def test_function_without_a_number_and_without_a_derivative_is_refused():
    problem = small_block().fix(points=[20])
    with pytest.raises(JaxbaError, match="returns no number"):
        propagate(lambda p: jnp.zeros(0), problem)
    with pytest.raises(JaxbaError, match="not finite"):
        propagate(lambda p: jnp.linalg.norm(p.points[0] - p.points[0]), problem)


def test_what_took_no_part_is_told():
    problem = small_block()
    seen = problem.observations
    first = np.unique(seen.point_index, return_index=True)[1][20]
    keep = (seen.point_index != 20) | (np.arange(len(seen.point_index)) == first)
    once = dataclasses.replace(problem, observations=jax.tree.map(lambda values: values[keep], seen))
    found = propagate(lambda p: p.points[jnp.array([20, 21]), 2], once)
    assert found.dropped.points.tolist() == [20] and found.std[0] == 0 and found.std[1] > 0
