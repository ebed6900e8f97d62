"""Poses against 4x4 matrices, scipy's matrix exponential, jaxlie and central differences."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import scipy.linalg
from quick_jit import quick_jit
from scipy.spatial.transform import Rotation

from jaxba import geometry
from jaxba.geometry import Pose, quaternion_exp

se3_exp, se3_log = quick_jit(geometry.se3_exp), quick_jit(geometry.se3_log)
retract, transform, inverse, compose = (
    quick_jit(f) for f in (Pose.retract, Pose.transform, Pose.inverse, Pose.compose)
)
rotation_and_center = quick_jit(lambda pose: (pose.rotation, pose.center))
from_matrix, from_center = quick_jit(Pose.from_matrix), quick_jit(Pose.from_center)

_RNG = np.random.default_rng(0)
_AXES = _RNG.normal(size=(6, 3))
_AXES /= np.linalg.norm(_AXES, axis=1, keepdims=True)
_ANGLES = [0.0, 1e-9, 0.99e-2, 1.01e-2, 0.8, 3.0, np.pi - 1e-7]  # series switch at 1e-2 rad
_TURNS = np.concatenate([angle * _AXES for angle in _ANGLES])
TWISTS = np.concatenate([_TURNS, 5 * _RNG.normal(size=_TURNS.shape)], axis=1)


def _pose(seed: int, count: int = 20) -> Pose:
    rng = np.random.default_rng(seed)
    quaternion = Rotation.random(count, rng=rng).as_quat(scalar_first=True)
    return Pose(quaternion, rng.normal(size=(count, 3)))


def _matrix(pose: Pose) -> np.ndarray:
    matrix = np.tile(np.eye(4), (pose.translation.shape[0], 1, 1))
    matrix[:, :3, :3] = Rotation.from_quat(np.asarray(pose.quaternion), scalar_first=True).as_matrix()
    matrix[:, :3, 3] = pose.translation
    return matrix


def test_transforms_equal_4x4_matrices():
    a, b = _pose(1), _pose(2)
    point = np.random.default_rng(3).normal(size=(20, 3))
    one = np.concatenate([point, np.ones((20, 1))], axis=1)[..., None]
    np.testing.assert_allclose(transform(a, point), (_matrix(a) @ one)[:, :3, 0], atol=1e-14)
    np.testing.assert_allclose(_matrix(inverse(a)), np.linalg.inv(_matrix(a)), atol=1e-14)
    np.testing.assert_allclose(_matrix(compose(a, b)), _matrix(a) @ _matrix(b), atol=1e-14)
    np.testing.assert_allclose(rotation_and_center(a)[1], np.linalg.inv(_matrix(a))[:, :3, 3], atol=1e-14)
    np.testing.assert_allclose(_matrix(quick_jit(lambda: Pose.identity(2))()), np.tile(np.eye(4), (2, 1, 1)))


def test_poses_are_rebuilt_from_rotation_and_translation_or_center():
    pose = _pose(4)
    rotation, center = rotation_and_center(pose)
    for again in (from_matrix(rotation, pose.translation), from_center(rotation, center)):
        np.testing.assert_allclose(_matrix(again), _matrix(pose), atol=1e-14)


def test_numpy_poses_stay_float64():
    pose = Pose(np.array([[0.6, 0.8, 0.0, 0.0]]), np.array([[1.0, 2.0, 3.0]]))
    assert pose.center.dtype == jnp.float64
    np.testing.assert_allclose(inverse(inverse(pose)).translation, pose.translation, atol=1e-15)


def test_exponential_equals_scipy_and_jaxlie():
    result = _matrix(se3_exp(TWISTS))
    algebra = np.zeros((len(TWISTS), 4, 4))
    algebra[:, :3, :3] = np.cross(np.eye(3), TWISTS[:, None, :3])
    algebra[:, :3, 3] = TWISTS[:, 3:]
    np.testing.assert_allclose(result, scipy.linalg.expm(algebra), atol=2e-13)  # expm squares what it scaled
    lie = quick_jit(jax.vmap(lambda t: jaxlie.SE3.exp(jnp.concatenate([t[3:], t[:3]])).as_matrix()))(TWISTS)
    np.testing.assert_allclose(result, lie, atol=1e-11)  # jaxlie's (1 - cos)/angle^2 cancels at small angles


def test_logarithm_inverts_the_exponential_up_to_half_a_turn():
    np.testing.assert_allclose(se3_log(se3_exp(TWISTS)), TWISTS, atol=1e-13)


def test_exponential_has_a_derivative_that_matches_central_difference(assert_derivative):
    def entries(twist):
        pose = geometry.se3_exp(twist)
        return jnp.concatenate([pose.quaternion, pose.translation])

    assert_derivative(entries, TWISTS)


def test_derivative_of_log_after_exp_is_the_identity_from_zero_to_half_a_turn():
    expected = np.broadcast_to(np.eye(6), (len(TWISTS), 6, 6))
    for jacobian in (jax.jacfwd, jax.jacrev):
        result = quick_jit(jax.vmap(jacobian(lambda t: geometry.se3_log(geometry.se3_exp(t)))))(TWISTS)
        np.testing.assert_allclose(result, expected, atol=1e-11)  # translations of 10, second derivatives of the series


def test_retraction_turns_about_the_camera_and_keeps_its_center():
    pose, step = _pose(5), np.random.default_rng(6).normal(size=(20, 6))
    moved = retract(pose, step)
    turn = Rotation.from_rotvec(step[:, :3]).as_matrix()
    rotation, center = rotation_and_center(pose)
    np.testing.assert_allclose(rotation_and_center(moved)[0], turn @ rotation, atol=1e-14)
    translation = np.einsum("nij,nj->ni", turn, pose.translation) + step[:, 3:]
    np.testing.assert_allclose(moved.translation, translation, atol=1e-14)
    turned = retract(pose, step * [1, 1, 1, 0, 0, 0])
    np.testing.assert_allclose(rotation_and_center(turned)[1], center, atol=1e-14)


def test_retraction_has_a_derivative_that_matches_central_difference(assert_derivative):
    pose = jax.tree.map(lambda a: a[0], _pose(7))

    def entries(step):
        moved = pose.retract(step)
        return jnp.concatenate([moved.quaternion, moved.translation])

    assert_derivative(entries, TWISTS)


def test_quaternions_stay_unit_over_many_steps():
    step = np.array([0.3, -0.2, 0.9, 0.0, 0.0, 0.0])

    @quick_jit
    def last(step: jax.Array) -> tuple[jax.Array, jax.Array]:
        pose, _ = jax.lax.scan(lambda pose, _: (pose.retract(step), None), Pose.identity(), None, length=2000)
        return pose.quaternion, pose.rotation

    quaternion, rotation = last(step)
    np.testing.assert_allclose(np.linalg.norm(quaternion), 1.0, atol=1e-15)
    turn = Rotation.from_rotvec(2000 * step[:3]).as_matrix()
    np.testing.assert_allclose(rotation, turn, atol=1e-11)  # 2000 roundings, each an angle


def test_poses_far_from_the_origin_keep_micrometres():
    # float64 resolves a northing to 1e-9 m; a turn of the camera must move its centre by some roundings alone
    center = np.array([5.0e5, 4.6e6, 300.0])
    rotation = Rotation.from_rotvec([0.3, 2.0, -1.0]).as_matrix()
    pose = retract(from_center(rotation, center), np.array([0.2, -0.1, 0.4, 0.0, 0.0, 0.0]))
    np.testing.assert_allclose(rotation_and_center(pose)[1], center, rtol=0, atol=1e-8)


def test_a_twist_without_translation_is_a_rotation():
    pose = se3_exp(np.array([0.1, 0.2, 0.3, 0.0, 0.0, 0.0]))
    np.testing.assert_array_equal(pose.quaternion, quick_jit(quaternion_exp)(np.array([0.1, 0.2, 0.3])))
    np.testing.assert_array_equal(pose.translation, np.zeros(3))
