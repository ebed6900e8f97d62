"""The optimum equals scipy's, on small problems of every camera model, loss, bound and prior.

scipy sees square-rooted residuals of the dense reference, whose plain squares sum to the robust cost: a loss belongs to
an observation's two components together. It starts beside the solver's optimum (some hundredths of a sigma off in every
unknown), so that both are in one basin where a loss is not convex.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
import scipy.optimize
from dense_reference import Dense, Minimum, minimise, solver_view
from jax import Array
from small_problems import EVERY_CAMERA, LOSSES, RADIAL, one_of, small_problem

from jaxba.ba import Problem, Unknowns
from jaxba.ba._linearise import cost
from jaxba.ba._solvers import SchurDogleg, SchurLevenbergMarquardt, residuals
from jaxba.geometry import LOSSES as LOSSES_BY_NAME, Cauchy, Huber, Linear, SimpleRadial

# the least that rounding in the cost allows: its sum of some hundred terms errs by 1e-15
EXACT = {"rtol": 1e-14, "atol": 1e-10, "xtol": 1e-14}


def bounded(problem: Problem, half_width: float) -> Problem:
    """Bound each camera's focal length and last parameter about its start values, by so many times 1 px or 0.01."""
    names = problem.cameras.parameter_names()
    lower, upper = problem.lower.copy(), problem.upper.copy()
    for column, width in ((0, 1.0), (len(names) - 1, 1.0 if names[-1].startswith("c") else 0.01)):
        start = np.asarray(getattr(problem.cameras, names[column]))
        lower[:, column], upper[:, column] = start - half_width * width, start + half_width * width
    return eqx.tree_at(lambda p: (p.lower, p.upper), problem, (lower, upper))


def assert_scipy_agrees(dense: Dense, found: Minimum, *, from_start: bool = False) -> np.ndarray:
    """Check the cost of an optimum, and return its tangent vector."""
    vector, reached = dense.tangent(found.unknowns), float(found.state.cost)
    np.testing.assert_allclose(dense.cost(vector), reached, rtol=1e-12)
    sigma = 1 / np.linalg.norm(dense.square_rooted_jacobian(vector), axis=0)
    beside = vector + 0.03 * sigma * np.random.default_rng(0).normal(size=dense.size)
    starts = [np.clip(beside, dense.lower, dense.upper), *([np.zeros(dense.size)] if from_start else [])]
    for start in starts:
        # 1e-8: scipy's Gauss-Newton creeps under strong losses, and stops that far above
        np.testing.assert_allclose(dense.cost(dense.scipy_optimum(start)), reached, rtol=1e-8)
    return vector


EVERY_LOSS_WITH_ONE_CAMERA = [(RADIAL, index) for index in range(len(LOSSES))]
TWO_LOSSES_WITH_THE_OTHERS = [(camera, index) for camera in EVERY_CAMERA if camera is not RADIAL for index in (0, 2)]
EVERY_LOSS_AND_CAMERA = pytest.mark.parametrize(
    ("camera", "index"),
    EVERY_LOSS_WITH_ONE_CAMERA + TWO_LOSSES_WITH_THE_OTHERS,
    ids=lambda value: repr(LOSSES[value]) if isinstance(value, int) else type(value).__name__,
)


@EVERY_LOSS_AND_CAMERA
def test_bounded_optimum_equals_scipy(camera, index):
    problem, loss = bounded(small_problem(camera, num_outliers=3), 0.01), one_of(index)
    found = minimise(problem, loss, SchurLevenbergMarquardt(**EXACT))
    dense = Dense(problem, loss)
    vector = assert_scipy_agrees(dense, found)
    assert ((vector == dense.lower) | (vector == dense.upper)).any()


@EVERY_LOSS_AND_CAMERA
def test_optimum_within_wide_bounds_equals_scipy(camera, index):
    problem, loss = bounded(small_problem(camera, num_outliers=3), 1e3), one_of(index)
    found = minimise(problem, loss, SchurLevenbergMarquardt(**EXACT))
    dense = Dense(problem, loss)
    vector = assert_scipy_agrees(dense, found)
    assert not ((vector == dense.lower) | (vector == dense.upper)).any()


def free_network() -> Problem:
    return small_problem(RADIAL, lever_arm=True, prior_loss=Cauchy(3.0), num_outliers=3)


def bounded_pair() -> Problem:
    return bounded(small_problem(RADIAL, num_cameras=2, num_outliers=3).fix(intrinsics=["k1"]), 0.5)


def own_cameras() -> Problem:
    camera = next(camera for camera in EVERY_CAMERA if isinstance(camera, SimpleRadial))
    return small_problem(camera, num_images=8, num_cameras=8, num_points=24).fix(poses=[3], points=[5, 6])


CASES = {
    "lm": (free_network, Huber(1.5), SchurLevenbergMarquardt(**EXACT), "dense"),
    "dogleg": (free_network, Linear(), SchurDogleg(**EXACT), "dense"),
    "dogleg_bounds": (bounded_pair, Huber(1.5), SchurDogleg(**EXACT), "dense"),
    "lm_bounds_cg": (bounded_pair, Linear(), SchurLevenbergMarquardt(**EXACT), "cg"),
    "lm_own_cameras_banded": (own_cameras, Linear(), SchurLevenbergMarquardt(**EXACT), "banded"),
}


@pytest.mark.parametrize("case", CASES)
def test_optimum_of_every_solver_equals_scipy(case):
    make, loss, solver, linear_solver = CASES[case]
    problem = make()
    found = minimise(problem, loss, solver, linear_solver)
    dense = Dense(problem, loss)
    # without bounds scipy gets there from the problem's own start as well
    assert_scipy_agrees(dense, found, from_start=not np.isfinite(dense.lower).any())


@pytest.mark.parametrize("name", ["linear", "soft_l1", "huber", "cauchy", "arctan"])
def test_cost_equals_scipys_own_loss_of_the_norms(name):
    # scipy applies a loss to each residual by itself: one residual an observation, its norm, gives ours
    problem = small_problem(RADIAL, num_outliers=3)
    _, system, start = solver_view(problem, LOSSES_BY_NAME[name](f_scale=2.0))
    reprojection, *priors = Dense(problem).groups()
    norms = np.linalg.norm(reprojection.residual, axis=1)
    oracle = scipy.optimize.least_squares(
        lambda x: norms + 0 * x[0], [0.0], jac=lambda x: np.zeros((len(norms), 1)), loss=name, f_scale=2.0
    )
    expected = oracle.cost + sum(np.sum(prior.residual**2) for prior in priors) / 2
    np.testing.assert_allclose(jax.jit(cost)(system, start), expected, rtol=1e-12)


@pytest.mark.parametrize("solver", [SchurLevenbergMarquardt(**EXACT), SchurDogleg(**EXACT)], ids=["lm", "dogleg"])
def test_optimistix_under_jit_and_vmap_finds_the_optima_of_the_host_loop(solver):
    problem = bounded(small_problem(RADIAL, num_outliers=3), 0.01)
    _, system, start = solver_view(problem, Huber(1.5))
    noise = np.random.default_rng(0).normal(size=(2, *problem.observations.xy_px.shape))
    problems = [eqx.tree_at(lambda p: p.observations.xy_px, problem, problem.observations.xy_px + n) for n in noise]
    loops = [minimise(p, Huber(1.5), solver) for p in problems]
    pixels = jnp.stack([solver_view(p, Huber(1.5))[1].reprojection.xy_px for p in problems])

    def optimum(xy_px: Array) -> tuple[Array, Unknowns]:
        perturbed = eqx.tree_at(lambda s: s.reprojection.xy_px, system, xy_px)
        solution = optx.least_squares(residuals, solver, start, args=perturbed, max_steps=300)
        return cost(perturbed, solution.value), solution.value

    if isinstance(solver, SchurDogleg):
        found = [jax.jit(optimum)(pixels[0])]
    else:
        costs, batch = jax.jit(jax.vmap(optimum))(pixels)
        found = [(costs[i], jax.tree.map(lambda leaf, i=i: leaf[i], batch)) for i in range(len(loops))]
    for (reached, unknowns), loop in zip(found, loops, strict=False):
        # the same algorithm, compiled otherwise: both stop where rounding in the cost hides what is left
        np.testing.assert_allclose(reached, loop.state.cost, rtol=1e-12)
        # the cost is flat at its minimum: the square root of its rounding, in pixels
        np.testing.assert_allclose(unknowns.intrinsics, loop.unknowns.intrinsics, rtol=0, atol=1e-4)
