"""Rotations against scipy, jaxlie and central differences, with the angles at which formulas break."""

import jax
import jaxlie
import numpy as np
import pytest
from quick_jit import quick_jit
from scipy.spatial.transform import Rotation

from jaxba import geometry

hat = quick_jit(geometry.hat)
matrix_from_quaternion = quick_jit(geometry.matrix_from_quaternion)
quaternion_conjugate = quick_jit(geometry.quaternion_conjugate)
quaternion_exp = quick_jit(geometry.quaternion_exp)
quaternion_from_matrix = quick_jit(geometry.quaternion_from_matrix)
quaternion_log = quick_jit(geometry.quaternion_log)
quaternion_multiply = quick_jit(geometry.quaternion_multiply)
so3_exp = quick_jit(geometry.so3_exp)
so3_left_jacobian_inverse = quick_jit(geometry.so3_left_jacobian_inverse)
so3_log = quick_jit(geometry.so3_log)

_RNG = np.random.default_rng(0)
_AXES = _RNG.normal(size=(9, 3))
_AXES = np.concatenate([_AXES / np.linalg.norm(_AXES, axis=1, keepdims=True), np.eye(3), -np.eye(3)])
# zero, both sides of the switches to series (1e-4 and 1e-2 rad), ordinary, and up to half a turn
_ANGLES = [0.0, 1e-12, 1e-7, 0.99e-4, 1.01e-4, 0.99e-2, 1.01e-2, 0.7, 2.0, 3.1, np.pi - 1e-4, np.pi - 1e-8]
VECTORS = np.concatenate([angle * _AXES for angle in _ANGLES])
QUATERNIONS = Rotation.random(60, rng=1).as_quat(scalar_first=True)
EXACT = 4e-15  # some roundings of numbers up to pi


def test_exponentials_equal_scipy_and_jaxlie():
    vectors = np.concatenate([VECTORS, np.pi * _AXES, 5.0 * _AXES, 20.0 * _AXES])
    expected = Rotation.from_rotvec(vectors)
    quaternion = np.asarray(quaternion_exp(vectors))
    sign = np.sign(np.sum(quaternion * expected.as_quat(scalar_first=True), axis=1, keepdims=True))
    np.testing.assert_allclose(sign * quaternion, expected.as_quat(scalar_first=True), atol=EXACT)
    np.testing.assert_allclose(so3_exp(vectors), expected.as_matrix(), atol=EXACT)
    lie = quick_jit(jax.vmap(lambda v: jaxlie.SO3.exp(v).as_matrix()))(vectors)
    np.testing.assert_allclose(so3_exp(vectors), lie, atol=1e-14)


def test_logarithms_invert_exponentials_up_to_half_a_turn():
    np.testing.assert_allclose(quaternion_log(quaternion_exp(VECTORS)), VECTORS, atol=EXACT)
    np.testing.assert_allclose(so3_log(so3_exp(VECTORS)), VECTORS, atol=EXACT)
    # small vectors keep their relative precision through the quaternion: nothing cancels
    small = 1e-9 * _AXES
    np.testing.assert_allclose(quaternion_log(quaternion_exp(small)), small, rtol=1e-14)


def test_logarithms_equal_scipy_and_jaxlie():
    rotation = Rotation.from_quat(QUATERNIONS, scalar_first=True)
    np.testing.assert_allclose(quaternion_log(QUATERNIONS), rotation.as_rotvec(), atol=EXACT)
    np.testing.assert_allclose(so3_log(rotation.as_matrix()), rotation.as_rotvec(), atol=1e-14)
    lie = quick_jit(jax.vmap(lambda q: jaxlie.SO3(q).log()))(QUATERNIONS)
    np.testing.assert_allclose(quaternion_log(QUATERNIONS), lie, atol=1e-14)


derivatives_of_log = quick_jit(
    jax.vmap(lambda q: (jax.jacfwd(geometry.quaternion_log)(q), jax.jacrev(geometry.quaternion_log)(q)))
)


@pytest.mark.parametrize("w", [0.0, -0.0])
def test_half_a_turn_has_the_angle_pi_and_finite_derivatives(w):
    quaternions = np.concatenate([np.full((len(_AXES), 1), w), _AXES], axis=1)
    np.testing.assert_allclose(quaternion_log(quaternions), np.pi * _AXES, atol=EXACT)
    angles = np.linalg.norm(so3_log(matrix_from_quaternion(quaternions)), axis=-1)
    np.testing.assert_allclose(angles, np.pi, atol=EXACT)
    # the formula 2 atan2(|v|, w) v/|v|, differentiated by hand at w = 0 and |v| = 1
    outer = _AXES[:, :, None] * _AXES[:, None, :]
    expected = np.concatenate([-2 * _AXES[:, :, None], np.pi * (np.eye(3) - outer)], axis=2)
    for derivative in derivatives_of_log(quaternions):
        np.testing.assert_allclose(derivative, expected, atol=1e-14)


def test_opposite_quaternions_have_one_logarithm():
    np.testing.assert_array_equal(quaternion_log(QUATERNIONS), quaternion_log(-QUATERNIONS))


def test_products_and_inverses_equal_scipy():
    left, right = QUATERNIONS[:30], QUATERNIONS[30:]
    expected = Rotation.from_quat(left, scalar_first=True) * Rotation.from_quat(right, scalar_first=True)
    product = quaternion_multiply(left, right)
    np.testing.assert_allclose(matrix_from_quaternion(product), expected.as_matrix(), atol=EXACT)
    inverse = matrix_from_quaternion(quaternion_conjugate(left))
    np.testing.assert_allclose(inverse, Rotation.from_quat(left, scalar_first=True).inv().as_matrix(), atol=EXACT)
    a, b = _AXES[:5], _AXES[5:10]
    np.testing.assert_allclose(np.einsum("nij,nj->ni", hat(a), b), np.cross(a, b), atol=EXACT)


def test_quaternion_from_matrix_equals_scipy_whichever_component_is_largest():
    half_turns = np.concatenate([np.zeros((len(_AXES), 1)), _AXES], axis=1)
    quaternions = np.concatenate([QUATERNIONS, half_turns, np.eye(4)])
    matrix = Rotation.from_quat(quaternions, scalar_first=True).as_matrix()
    result = np.asarray(quaternion_from_matrix(matrix))
    sign = np.sign(np.sum(result * quaternions, axis=1, keepdims=True))
    np.testing.assert_allclose(sign * result, quaternions, atol=EXACT)
    assert np.all(result[:, 0] >= 0)


@pytest.mark.parametrize("function", [geometry.quaternion_exp, geometry.so3_exp], ids=lambda f: f.__name__)
def test_derivative_of_the_exponential_matches_central_difference(function, assert_derivative):
    assert_derivative(function, np.concatenate([VECTORS, np.pi * _AXES]))


def test_derivative_of_the_logarithm_matches_central_difference(assert_derivative):
    # w >= 0.05: a difference across half a turn, where the vector jumps to its opposite, is no derivative
    near_zero = Rotation.from_rotvec(VECTORS[: 7 * len(_AXES)]).as_quat(scalar_first=True)
    ordinary = QUATERNIONS[np.abs(QUATERNIONS[:, 0]) > 0.05]
    assert_derivative(geometry.quaternion_log, np.concatenate([near_zero, ordinary]))


@pytest.mark.parametrize("jacobian", [jax.jacfwd, jax.jacrev], ids=lambda f: f.__name__)
def test_derivative_of_log_after_exp_is_the_identity_from_zero_to_half_a_turn(jacobian):
    function = quick_jit(jax.vmap(jacobian(lambda v: geometry.so3_log(geometry.so3_exp(v)))))
    expected = np.broadcast_to(np.eye(3), (len(VECTORS), 3, 3))
    np.testing.assert_allclose(function(VECTORS), expected, atol=1e-14)


def test_left_jacobian_inverse_is_the_derivative_of_log_of_a_turn_on_the_left():
    def turned(d, v):
        product = geometry.quaternion_multiply(geometry.quaternion_exp(d), geometry.quaternion_exp(v))
        return geometry.quaternion_log(product)

    expected = quick_jit(jax.vmap(jax.jacfwd(turned), (None, 0)))(np.zeros(3), VECTORS)
    np.testing.assert_allclose(so3_left_jacobian_inverse(VECTORS), expected, atol=1e-13)


def test_left_jacobian_inverse_has_a_derivative_that_matches_central_difference(assert_derivative):
    near = VECTORS[: 10 * len(_AXES)]  # towards 2 pi its fifth derivative outgrows what the difference resolves
    assert_derivative(lambda v: geometry.so3_left_jacobian_inverse(v).ravel(), near)


def test_second_derivatives_are_finite_at_zero_and_at_half_a_turn():
    vectors = np.concatenate([np.zeros((1, 3)), VECTORS, np.pi * _AXES])
    for function in (geometry.quaternion_exp, lambda v: geometry.quaternion_log(geometry.quaternion_exp(v))):
        assert np.all(np.isfinite(quick_jit(jax.vmap(jax.hessian(function)))(vectors)))


def test_float32_keeps_its_precision():
    vectors = VECTORS[np.linalg.norm(VECTORS, axis=1) < 3].astype(np.float32)
    result = quaternion_exp(vectors)
    assert result.dtype == np.float32
    np.testing.assert_allclose(quaternion_log(result), vectors, atol=2e-6)  # some roundings of numbers up to 3
    exact = so3_left_jacobian_inverse(vectors.astype(np.float64))
    np.testing.assert_allclose(so3_left_jacobian_inverse(vectors), exact, atol=2e-6)
