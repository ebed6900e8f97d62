"""Rotations against scipy, jaxlie and central differences, with the angles at which formulas break."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxba import geometry

hat = jax.jit(geometry.hat)
matrix_from_quaternion = jax.jit(geometry.matrix_from_quaternion)
quaternion_conjugate = jax.jit(geometry.quaternion_conjugate)
quaternion_exp = jax.jit(geometry.quaternion_exp)
quaternion_from_matrix = jax.jit(geometry.quaternion_from_matrix)
quaternion_log = jax.jit(geometry.quaternion_log)
quaternion_multiply = jax.jit(geometry.quaternion_multiply)
so3_exp = jax.jit(geometry.so3_exp)
so3_left_jacobian_inverse = jax.jit(geometry.so3_left_jacobian_inverse)
so3_log = jax.jit(geometry.so3_log)

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
    quaternion = np.asarray(quaternion_exp(jnp.asarray(vectors)))
    sign = np.sign(np.sum(quaternion * expected.as_quat(scalar_first=True), axis=1, keepdims=True))
    np.testing.assert_allclose(sign * quaternion, expected.as_quat(scalar_first=True), atol=EXACT)
    np.testing.assert_allclose(so3_exp(jnp.asarray(vectors)), expected.as_matrix(), atol=EXACT)
    lie = jax.jit(jax.vmap(lambda v: jaxlie.SO3.exp(v).as_matrix()))(jnp.asarray(vectors))
    np.testing.assert_allclose(so3_exp(jnp.asarray(vectors)), lie, atol=1e-14)


def test_logarithms_invert_exponentials_up_to_half_a_turn():
    vectors = jnp.asarray(VECTORS)
    np.testing.assert_allclose(quaternion_log(quaternion_exp(vectors)), VECTORS, atol=EXACT)
    np.testing.assert_allclose(so3_log(so3_exp(vectors)), VECTORS, atol=EXACT)
    # small vectors keep their relative precision through the quaternion: nothing cancels
    small = jnp.asarray(1e-9 * _AXES)
    np.testing.assert_allclose(quaternion_log(quaternion_exp(small)), small, rtol=1e-14)


def test_logarithms_equal_scipy_and_jaxlie():
    rotation = Rotation.from_quat(QUATERNIONS, scalar_first=True)
    np.testing.assert_allclose(quaternion_log(jnp.asarray(QUATERNIONS)), rotation.as_rotvec(), atol=EXACT)
    np.testing.assert_allclose(so3_log(jnp.asarray(rotation.as_matrix())), rotation.as_rotvec(), atol=1e-14)
    lie = jax.jit(jax.vmap(lambda q: jaxlie.SO3(q).log()))(jnp.asarray(QUATERNIONS))
    np.testing.assert_allclose(quaternion_log(jnp.asarray(QUATERNIONS)), lie, atol=1e-14)


@pytest.mark.parametrize("w", [0.0, -0.0])
def test_half_a_turn_has_the_angle_pi_and_finite_derivatives(w):
    quaternions = jnp.asarray(np.concatenate([np.full((len(_AXES), 1), w), _AXES], axis=1))
    np.testing.assert_allclose(quaternion_log(quaternions), np.pi * _AXES, atol=EXACT)
    angles = jnp.linalg.norm(so3_log(matrix_from_quaternion(quaternions)), axis=-1)
    np.testing.assert_allclose(angles, np.pi, atol=EXACT)
    # the formula 2 atan2(|v|, w) v/|v|, differentiated by hand at w = 0 and |v| = 1
    outer = _AXES[:, :, None] * _AXES[:, None, :]
    expected = np.concatenate([-2 * _AXES[:, :, None], np.pi * (np.eye(3) - outer)], axis=2)
    for jacobian in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(jax.jit(jax.vmap(jacobian(quaternion_log)))(quaternions), expected, atol=1e-14)


def test_opposite_quaternions_have_one_logarithm():
    quaternions = jnp.asarray(QUATERNIONS)
    np.testing.assert_array_equal(quaternion_log(quaternions), quaternion_log(-quaternions))


def test_products_and_inverses_equal_scipy():
    left, right = QUATERNIONS[:30], QUATERNIONS[30:]
    expected = Rotation.from_quat(left, scalar_first=True) * Rotation.from_quat(right, scalar_first=True)
    product = quaternion_multiply(jnp.asarray(left), jnp.asarray(right))
    np.testing.assert_allclose(matrix_from_quaternion(product), expected.as_matrix(), atol=EXACT)
    inverse = matrix_from_quaternion(quaternion_conjugate(jnp.asarray(left)))
    np.testing.assert_allclose(inverse, Rotation.from_quat(left, scalar_first=True).inv().as_matrix(), atol=EXACT)
    a, b = _AXES[:5], _AXES[5:10]
    np.testing.assert_allclose(jnp.einsum("nij,nj->ni", hat(jnp.asarray(a)), b), np.cross(a, b), atol=EXACT)


def test_quaternion_from_matrix_equals_scipy_whichever_component_is_largest():
    half_turns = np.concatenate([np.zeros((len(_AXES), 1)), _AXES], axis=1)
    quaternions = np.concatenate([QUATERNIONS, half_turns, np.eye(4)])
    matrix = Rotation.from_quat(quaternions, scalar_first=True).as_matrix()
    result = np.asarray(quaternion_from_matrix(jnp.asarray(matrix)))
    sign = np.sign(np.sum(result * quaternions, axis=1, keepdims=True))
    np.testing.assert_allclose(sign * result, quaternions, atol=EXACT)
    assert np.all(result[:, 0] >= 0)


@pytest.mark.parametrize("function", [quaternion_exp, so3_exp], ids=lambda f: f.__name__)
def test_derivative_of_the_exponential_matches_central_difference(function, assert_derivative):
    assert_derivative(function, np.concatenate([VECTORS, np.pi * _AXES]))


def test_derivative_of_the_logarithm_matches_central_difference(assert_derivative):
    # w >= 0.05: a difference across half a turn, where the vector jumps to its opposite, is no derivative
    near_zero = Rotation.from_rotvec(VECTORS[: 7 * len(_AXES)]).as_quat(scalar_first=True)
    ordinary = QUATERNIONS[np.abs(QUATERNIONS[:, 0]) > 0.05]
    assert_derivative(quaternion_log, np.concatenate([near_zero, ordinary]))


@pytest.mark.parametrize("jacobian", [jax.jacfwd, jax.jacrev], ids=lambda f: f.__name__)
def test_derivative_of_log_after_exp_is_the_identity_from_zero_to_half_a_turn(jacobian):
    function = jax.jit(jax.vmap(jacobian(lambda v: so3_log(so3_exp(v)))))
    expected = np.broadcast_to(np.eye(3), (len(VECTORS), 3, 3))
    np.testing.assert_allclose(function(jnp.asarray(VECTORS)), expected, atol=1e-14)


def test_left_jacobian_inverse_is_the_derivative_of_log_of_a_turn_on_the_left():
    def turned(d, v):
        return quaternion_log(quaternion_multiply(quaternion_exp(d), quaternion_exp(v)))

    expected = jax.jit(jax.vmap(jax.jacfwd(turned), (None, 0)))(jnp.zeros(3), jnp.asarray(VECTORS))
    np.testing.assert_allclose(so3_left_jacobian_inverse(jnp.asarray(VECTORS)), expected, atol=1e-13)


def test_left_jacobian_inverse_has_a_derivative_that_matches_central_difference(assert_derivative):
    near = VECTORS[: 10 * len(_AXES)]  # towards 2 pi its fifth derivative outgrows what the difference resolves
    assert_derivative(lambda v: so3_left_jacobian_inverse(v).ravel(), near)


def test_second_derivatives_are_finite_at_zero_and_at_half_a_turn():
    vectors = jnp.asarray(np.concatenate([np.zeros((1, 3)), VECTORS, np.pi * _AXES]))
    for function in (quaternion_exp, lambda v: quaternion_log(quaternion_exp(v))):
        assert np.all(np.isfinite(jax.jit(jax.vmap(jax.hessian(function)))(vectors)))


def test_float32_keeps_its_precision():
    vectors = VECTORS[np.linalg.norm(VECTORS, axis=1) < 3].astype(np.float32)
    result = quaternion_exp(jnp.asarray(vectors))
    assert result.dtype == jnp.float32
    np.testing.assert_allclose(quaternion_log(result), vectors, atol=2e-6)  # some roundings of numbers up to 3
    exact = so3_left_jacobian_inverse(jnp.asarray(vectors, jnp.float64))
    np.testing.assert_allclose(so3_left_jacobian_inverse(jnp.asarray(vectors)), exact, atol=2e-6)
