"""The optimum equals scipy's, on small problems of every camera model, loss, bound and prior.

scipy sees square-rooted residuals of the dense reference, whose plain squares sum to the robust cost: a loss belongs to
an observation's two components together. It starts beside the solver's optimum (some hundredths of a sigma off in every
unknown), so that both are in one basin where a loss is not convex.
"""

import dataclasses

import numpy as np
import pytest
import scipy.optimize
from dense_reference import Dense, Minimum, minimise, solver_view
from quick_jit import quick_jit
from small_problems import EVERY_CAMERA, RADIAL, bounded, one_of, small_problem

from jaxba.ba import Problem
from jaxba.ba._linearise import cost
from jaxba.ba._solvers import SchurDogleg, SchurLevenbergMarquardt
from jaxba.geometry import LOSSES, Cauchy, Huber, Linear, OpenCV, SimpleRadial

# the least that rounding in the cost allows: its sum of some hundred terms errs by 1e-15
EXACT = {"rtol": 1e-14, "atol": 1e-10, "xtol": 1e-14}


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


OPENCV = next(camera for camera in EVERY_CAMERA if isinstance(camera, OpenCV))
HUBER, TUKEY = 2, 5  # of `small_problems.LOSSES`


# of every other loss and camera the model is held to the dense one, in test_linearise.py and test_groups.py
@pytest.mark.parametrize(
    ("camera", "index"), [(RADIAL, HUBER), (RADIAL, TUKEY), (OPENCV, HUBER)], ids=["huber", "tukey", "opencv"]
)
def test_bounded_optimum_equals_scipy(camera, index):
    problem, loss = bounded(small_problem(camera, num_outliers=3), 0.01), one_of(index)
    found = minimise(problem, loss, SchurLevenbergMarquardt(**EXACT))
    dense = Dense(problem, loss)
    vector = assert_scipy_agrees(dense, found)
    assert ((vector == dense.lower) | (vector == dense.upper)).any()


def test_optimum_within_wide_bounds_equals_scipy():
    problem, loss = bounded(small_problem(RADIAL, num_outliers=3), 1e3), one_of(HUBER)
    found = minimise(problem, loss, SchurLevenbergMarquardt(**EXACT))
    dense = Dense(problem, loss)
    vector = assert_scipy_agrees(dense, found)
    assert not ((vector == dense.lower) | (vector == dense.upper)).any()


def free_network() -> Problem:
    return small_problem(RADIAL, lever_arm=True, position_offset=True, prior_loss=Cauchy(3.0), num_outliers=3)


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


def test_cost_equals_scipys_own_loss_of_the_norms():
    # scipy applies a loss to each residual by itself: one residual an observation, its norm, gives ours
    problem = small_problem(RADIAL, num_outliers=3)
    reprojection, *priors = Dense(problem).groups()
    norms = np.linalg.norm(reprojection.residual, axis=1)
    for index, name in enumerate(list(LOSSES)[:5]):  # the first five are scipy's, in the order of `one_of`
        loss = dataclasses.replace(one_of(index), f_scale=np.array(2.0))
        _, system, start = solver_view(problem, loss)
        oracle = scipy.optimize.least_squares(
            lambda x: norms + 0 * x[0], [0.0], jac=lambda x: np.zeros((len(norms), 1)), loss=name, f_scale=2.0
        )
        expected = oracle.cost + sum(np.sum(prior.residual**2) for prior in priors) / 2
        np.testing.assert_allclose(cost_of(system, start), expected, rtol=1e-12)


cost_of = quick_jit(cost)
