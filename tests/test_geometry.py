"""Rotations and rigid motions against scipy, at every switch of formula and near pi (STYLE, tests 2 and 3)."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from calibkit.geometry import se3, so3

Array = NDArray[np.float64]
SWITCHES = (1e-9, 1e-4, 1e-2)  # angles where a formula gives way to its series
ANGLES = np.unique(
    [
        *10.0 ** np.arange(-12.0, -1.9, 0.5),
        *[s * factor for s in SWITCHES for factor in (0.5, 1 - 1e-9, 1.0, 1 + 1e-9, 2.0, 4.0)],
        *[0.1, 1.0, 2.0, 3.0],
        *[np.pi - d for d in (1e-2, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12)],
    ]
)


def axes(n: int = 12) -> Array:
    """Unit vectors: the coordinate axes, those with two equal parts, and random ones."""
    rng = np.random.default_rng(3)
    v = np.concatenate([np.eye(3), -np.eye(3), [[1, 1, 0], [0, 1, -1]], rng.normal(size=(n, 3))])
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def vectors() -> Array:
    return (ANGLES[:, None, None] * axes()).reshape(-1, 3)


def poses(n: int = 50) -> Array:
    rng = np.random.default_rng(5)
    return se3.make(so3.exp(rng.normal(size=(n, 3))), rng.normal(size=(n, 3)))


def test_exp_is_scipys() -> None:
    v = vectors()
    np.testing.assert_allclose(so3.exp(v), Rotation.from_rotvec(v).as_matrix(), rtol=0, atol=1e-15)
    np.testing.assert_array_equal(so3.exp(np.zeros(3)), np.eye(3))


def test_small_rotations_keep_their_digits() -> None:
    """The first-order part is exact relative to the angle, where I + 0 would pass an absolute test."""
    for v in vectors():
        R = so3.exp(v)
        odd = (R - R.T) / 2
        angle = np.linalg.norm(v)
        np.testing.assert_allclose(odd, so3.hat(v) * np.sinc(angle / np.pi), rtol=0, atol=max(4e-16, 1e-15 * angle))


def test_log_inverts_exp_up_to_pi() -> None:
    v = vectors()
    back = so3.log(so3.exp(v))
    angle = np.linalg.norm(v, axis=-1, keepdims=True)
    # Beyond pi - 1e-8 the matrix no longer says which of v and -v it was made of.
    back = np.where(np.sum(back * v, axis=-1, keepdims=True) < 0, np.where(angle > np.pi - 1e-7, -back, np.nan), back)
    np.testing.assert_allclose(back, v, rtol=0, atol=2e-15 * 4)
    assert np.all(np.linalg.norm(so3.log(so3.exp(v)), axis=-1) <= np.pi + 1e-15)


def test_log_at_pi_is_an_axis_of_length_pi() -> None:
    v = np.pi * axes()
    back = so3.log(so3.exp(v))
    np.testing.assert_allclose(np.abs(np.sum(back * v, axis=-1)), np.pi**2, rtol=1e-14)


def test_log_is_scipys_from_any_quaternion() -> None:
    q = np.random.default_rng(1).normal(size=(500, 4))
    q /= np.linalg.norm(q, axis=-1, keepdims=True)
    np.testing.assert_allclose(so3.quat_log(q), Rotation.from_quat(q).as_rotvec(), rtol=0, atol=2e-15)
    np.testing.assert_allclose(so3.quat_log(-q), so3.quat_log(q), rtol=0, atol=0)


def test_small_quaternions_keep_their_relative_digits() -> None:
    for v in vectors():
        q = Rotation.from_rotvec(v).as_quat()
        np.testing.assert_allclose(so3.quat_log(q), v, rtol=1e-13, atol=1e-30)


def test_quaternions_are_hamilton_xyzw_with_positive_w() -> None:
    np.testing.assert_allclose(so3.to_quat([[0, -1, 0], [1, 0, 0], [0, 0, 1]]), [0, 0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-16)
    R = so3.exp(np.concatenate([vectors(), np.pi * axes()]))
    q = so3.to_quat(R)
    assert np.all(q[:, 3] >= 0)
    np.testing.assert_allclose(np.linalg.norm(q, axis=-1), 1, rtol=1e-15)
    np.testing.assert_allclose(so3.from_quat(q), R, rtol=0, atol=2e-15)
    np.testing.assert_allclose(so3.from_quat(q), Rotation.from_quat(q).as_matrix(), rtol=0, atol=1e-15)
    np.testing.assert_allclose(so3.from_quat(-7 * q), so3.from_quat(q), rtol=0, atol=1e-15)


def test_right_jacobian_is_the_derivative_of_exp() -> None:
    """J_r(v) = integral over s in (0, 1) of exp(-s hat(v)): block exponential of Van Loan (1978), and by differences."""
    for v in vectors():
        block = np.zeros((6, 6))
        block[:3, :3], block[:3, 3:] = -so3.hat(v), np.eye(3)
        np.testing.assert_allclose(so3.right_jacobian(v), expm(block)[:3, 3:], rtol=0, atol=3e-14)
    v, h = np.array([0.3, -0.7, 0.4]), 1e-6
    steps = [so3.log(so3.exp(v).T @ so3.exp(v + h * e)) - so3.log(so3.exp(v).T @ so3.exp(v - h * e)) for e in np.eye(3)]
    np.testing.assert_allclose(so3.right_jacobian(v), np.stack(steps, axis=-1) / (2 * h), atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-6, 1e-3, 0.0999, 0.1001, 1.0, 3.1, np.pi, 4.0])
def test_right_jacobian_inverse_is_one(angle: float) -> None:
    v = angle * axes()
    np.testing.assert_allclose(so3.right_jacobian_inverse(v) @ so3.right_jacobian(v), np.broadcast_to(np.eye(3), (*v.shape, 3)), atol=2e-15)


def test_quaternions_multiply_and_add_up_as_matrices_do() -> None:
    v, w = 0.7 * axes(), np.array([3.0, -0.4, 0.2]) * np.ones_like(axes())
    p, q = so3.quat_exp(v), so3.quat_exp(w)
    np.testing.assert_allclose(so3.from_quat(p), so3.exp(v), atol=1e-15)
    np.testing.assert_allclose(so3.from_quat(so3.quat_multiply(p, q)), so3.exp(v) @ so3.exp(w), atol=1e-15)
    np.testing.assert_allclose(so3.quat_multiply(so3.quat_conjugate(p), p), np.broadcast_to([0, 0, 0, 1.0], p.shape), atol=1e-15)
    for tiny in (0.0, 1e-300, 1e-12, 1e-5):
        np.testing.assert_allclose(so3.quat_log(so3.quat_exp(tiny * axes())), tiny * axes(), rtol=1e-14, atol=0)


def test_right_jacobian_has_no_step_at_its_switch() -> None:
    for switch in SWITCHES:
        below, above = (so3.right_jacobian(switch * factor * axes()) for factor in (1 - 1e-14, 1 + 1e-14))
        np.testing.assert_allclose(below, above, rtol=0, atol=4e-16)


def test_project_finds_the_nearest_rotation() -> None:
    rng = np.random.default_rng(2)
    R = so3.exp(rng.normal(size=(100, 3)))
    noisy = R + 1e-3 * rng.normal(size=R.shape)
    nearest = so3.project(noisy)
    np.testing.assert_allclose(nearest @ np.swapaxes(nearest, -1, -2), np.broadcast_to(np.eye(3), R.shape), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(nearest), 1, rtol=1e-14)
    np.testing.assert_allclose(so3.project(R), R, atol=1e-14)
    for turn in (1e-3, -1e-3):
        other = nearest @ so3.exp(turn * axes(1)[:1])
        assert np.all(np.linalg.norm(other - noisy, axis=(-1, -2)) > np.linalg.norm(nearest - noisy, axis=(-1, -2)))


def arun(M: Array) -> Array:
    """The nearest rotation by singular values: U diag(1, 1, det(U V^T)) V^T."""
    U, _, Vt = np.linalg.svd(M)
    sign = np.linalg.det(U @ Vt)
    out: Array = U @ (np.stack([np.ones_like(sign), np.ones_like(sign), sign], axis=-1)[..., None] * Vt)
    return out


@pytest.mark.parametrize("off", [0.0, 1e-9, 1e-4, 1.9e-3, 2.1e-3, 5.9e-3, 0.03, 0.5, 5.0])  # on both sides of the switch of methods
def test_project_agrees_with_singular_values(off: float) -> None:
    rng = np.random.default_rng(3)
    turns = so3.exp(rng.normal(size=(2, 4, 50, 3)))
    stretch = 1 + off * np.array([[1, 1, 1], [-1, -1, -1], [1, -1, 0.5], [-1, 0.3, 0.7]])[:, None, :]
    M = turns[0] * stretch[..., None, :] @ turns[1]
    scale = 1 / np.abs(np.sum(np.sort(stretch, axis=-1)[..., :2], axis=-1)).min()  # how much rounding turns the nearest
    np.testing.assert_allclose(so3.project(M), arun(M), rtol=0, atol=1e-14 * max(1, scale))
    mirrored = M * np.array([1.0, 1.0, -1.0])
    if off:  # of a mirror image itself all turns of it are as near
        assert np.linalg.det(so3.project(mirrored)) == pytest.approx(1, abs=1e-13)


def test_project_takes_near_and_far_and_mirrored_together_one_or_none() -> None:
    rng = np.random.default_rng(4)
    R = so3.exp(rng.normal(size=(4, 3)))
    M = np.stack([R[0], R[1] + 1e-3, 3 * R[2] + 0.1 * rng.normal(size=(3, 3)), R[3] * np.array([1.0, 1.0, -1.0]) + 0.01])
    np.testing.assert_allclose(so3.project(M), arun(M), rtol=0, atol=1e-13)
    for one, all_at_once in zip(M, so3.project(M), strict=True):
        np.testing.assert_allclose(so3.project(one), all_at_once, rtol=0, atol=1e-14)
        assert so3.project(one).shape == (3, 3)
    assert so3.project(np.zeros((2, 0, 3, 3))).shape == (2, 0, 3, 3)
    for wrong in (np.nan, np.inf):
        with pytest.raises(np.linalg.LinAlgError):
            so3.project(np.where(np.eye(3) > 0, wrong, 0.0))
    np.testing.assert_allclose(so3.project(1e200 * R), R, atol=1e-14)


def test_hat_is_the_cross_product() -> None:
    a, b = np.random.default_rng(4).normal(size=(2, 20, 3))
    np.testing.assert_allclose((so3.hat(a) @ b[..., None])[..., 0], np.cross(a, b), atol=1e-15)


def test_a_transform_maps_points_and_back() -> None:
    T = se3.make(so3.exp(np.array([0, 0, np.pi / 2])), np.array([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(se3.transform(T, np.array([[1.0, 0.0, 0.0]])), [[1.0, 3.0, 3.0]], atol=1e-15)
    T, points = poses(), np.random.default_rng(6).normal(size=(50, 7, 3))
    np.testing.assert_allclose(se3.transform(se3.inverse(T), se3.transform(T, points)), points, atol=1e-13)
    np.testing.assert_allclose(T @ se3.inverse(T), np.broadcast_to(np.eye(4), T.shape), atol=1e-14)


@pytest.mark.parametrize("size", [1e-12, 1e-8, 1e-4, 1e-2, 0.5])
def test_local_inverts_retract(size: float) -> None:
    T = poses()
    step = size * np.random.default_rng(8).normal(size=(len(T), 6))
    np.testing.assert_allclose(se3.local(T, se3.retract(T, step)), step, rtol=0, atol=4e-15)


def test_retract_perturbs_on_the_right_with_parts_apart() -> None:
    T = se3.make(so3.exp(np.array([0, 0, np.pi / 2])), np.array([1.0, 2.0, 3.0]))
    moved = se3.retract(T, np.array([0.1, 0, 0, 0, 0, 0.2]))
    np.testing.assert_allclose(moved[:3, 3], [1.0, 2.1, 3.0], atol=1e-15)  # p + R rho, whatever phi is
    np.testing.assert_allclose(moved[:3, :3], Rotation.from_rotvec([0, 0, np.pi / 2 + 0.2]).as_matrix(), atol=1e-15)


def test_adjoint_moves_a_perturbation_to_the_left() -> None:
    T, d = poses(), 1e-6 * np.random.default_rng(9).normal(size=(50, 6))
    identity = np.broadcast_to(np.eye(4), T.shape)
    left = T @ se3.retract(identity, d) @ se3.inverse(T)
    moved = (se3.adjoint(T) @ d[..., None])[..., 0]
    np.testing.assert_allclose(se3.local(identity, left), moved, rtol=0, atol=2e-11)


def test_everything_takes_batches_of_any_shape() -> None:
    v = np.random.default_rng(10).normal(size=(2, 3, 3))
    for function in (so3.hat, so3.exp, so3.right_jacobian):
        np.testing.assert_array_equal(function(v)[1, 2], function(v[1, 2]))
    R = so3.exp(v)
    np.testing.assert_array_equal(so3.log(R)[1, 2], so3.log(R[1, 2]))
