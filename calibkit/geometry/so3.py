"""Rotations SO(3), batch-first: vectors (..., 3), quaternions (..., 4) Hamilton xyzw, matrices (..., 3, 3).

Perturbations are on the right, R exp(hat(d)). Equations: Sola, Deray, Atchuthan, "A micro Lie theory", 2018.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Below this angle the closed forms lose digits to cancellation and the Taylor series is exact to machine precision.
_SMALL_ANGLE = 1e-4
_NEAR_ROTATION = 4e-3  # entries of M^T M - I: no singular value is off by more than 3 / 2 of it


def hat(v: Array) -> Array:
    """Return the skew matrix with hat(v) w = v x w, shapes (..., 3) -> (..., 3, 3)."""
    v = np.asarray(v, float)
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2] = -v[..., 2], v[..., 1]
    out[..., 1, 0], out[..., 1, 2] = v[..., 2], -v[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -v[..., 1], v[..., 0]
    return out


def sinc_terms(angle2: Array) -> tuple[Array, Array]:
    """Return sin(a)/a and (1 - cos(a))/a^2 from a^2, exact at every angle."""
    small = angle2 < _SMALL_ANGLE**2
    safe = np.where(small, 1.0, angle2)
    angle = np.sqrt(safe)
    first = np.where(small, 1 - angle2 / 6 * (1 - angle2 / 20), np.sin(angle) / angle)
    # 2 sin^2(a/2) has no cancellation where 1 - cos(a) has.
    second = np.where(small, 0.5 - angle2 / 24, 2 * np.sin(angle / 2) ** 2 / safe)
    return first, second


def third_term(angle2: Array) -> Array:
    """Return (a - sin(a))/a^3 from a^2, exact at every angle."""
    small = angle2 < 1e-4  # a wider switch than the others': it cancels as a^3
    safe = np.where(small, 1.0, angle2)
    angle = np.sqrt(safe)
    third: Array = np.where(small, 1 / 6 - angle2 / 120 + angle2**2 / 5040, (angle - np.sin(angle)) / (safe * angle))
    return third


def exp(v: Array) -> Array:
    """Return exp(hat(v)) = I + sin(a)/a hat(v) + (1 - cos(a))/a^2 hat(v)^2 (Rodrigues), (..., 3) rad -> (..., 3, 3)."""
    v = np.asarray(v, float)
    first, second = sinc_terms(np.sum(v * v, axis=-1))
    k = hat(v)
    rotation: Array = np.eye(3) + first[..., None, None] * k + second[..., None, None] * (k @ k)
    return rotation


def right_jacobian(v: Array) -> Array:
    """Return J_r with exp(v + d) = exp(v) exp(J_r(v) d) to first order (Sola 2018, eq. 143), (..., 3) -> (..., 3, 3)."""
    v = np.asarray(v, float)
    angle2 = np.sum(v * v, axis=-1)
    (_, second), third = sinc_terms(angle2), third_term(angle2)
    k = hat(v)
    jacobian: Array = np.eye(3) - second[..., None, None] * k + third[..., None, None] * (k @ k)
    return jacobian


def right_jacobian_inverse(v: Array) -> Array:
    """Return J_r(v)^-1 = I + hat(v)/2 + (1/a^2 - (1 + cos a) / (2 a sin a)) hat(v)^2 (Sola 2018, eq. 144) for |v| < 2 pi, (..., 3, 3).

    J_l^-1 is its transpose.
    """
    v = np.asarray(v, float)
    angle2 = np.sum(v * v, axis=-1)
    small = angle2 < 1e-2  # a wide switch: the closed form's two terms cancel as a^2
    safe = np.where(small, 1.0, angle2)
    half = np.sqrt(safe) / 2
    # (1 + cos a) / sin a = cot(a / 2), which has no pole at pi.
    third = np.where(small, 1 / 12 + angle2 / 720 + angle2**2 / 30240 + angle2**3 / 1209600, (1 - half / np.tan(half)) / safe)
    k = hat(v)
    inverse: Array = np.eye(3) + 0.5 * k + third[..., None, None] * (k @ k)
    return inverse


def to_quat(R: Array) -> Array:
    """Return unit quaternions xyzw with w >= 0 from rotation matrices (Shepperd 1978: the largest component first)."""
    (a, b, c), (d, e, f), (g, h, i) = np.moveaxis(np.asarray(R, float), (-2, -1), (0, 1))
    x, y, z = h - f, c - g, d - b
    # 4 q q^T, the batch behind: each row is q times one of its components.
    rows = np.array(
        [[1 + a - e - i, b + d, c + g, x], [b + d, 1 - a + e - i, f + h, y], [c + g, f + h, 1 - a - e + i, z], [x, y, z, 1 + a + e + i]]
    )
    largest = np.argmax(np.einsum("kk...->k...", rows), axis=0)
    q: Array = np.moveaxis(np.take_along_axis(rows, largest[None, None], axis=0)[0], 0, -1)
    q /= np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., 3:] < 0, -q, q)


def from_quat(q: Array) -> Array:
    """Return rotation matrices from quaternions xyzw of any length but zero, (..., 4) -> (..., 3, 3)."""
    q = np.asarray(q, float)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    k = hat(q[..., :3])
    return np.eye(3) + 2 * (q[..., 3, None, None] * k + k @ k)


def quat_log(q: Array) -> Array:
    """Return the rotation vector (|v| <= pi) of quaternions xyzw: 2 atan2(|q_v|, q_w) q_v / |q_v|."""
    q = np.asarray(q, float)
    q = np.where(q[..., 3:] < 0, -q, q)
    norm = np.linalg.norm(q[..., :3], axis=-1)
    small = norm < 1e-9
    scale = np.where(small, 2.0, 2 * np.arctan2(norm, q[..., 3]) / np.where(small, 1.0, norm))
    return scale[..., None] * q[..., :3]


def quat_exp(v: Array) -> Array:
    """Return unit quaternions xyzw of rotation vectors, (..., 3) rad -> (..., 4): (sin(a/2) v/a, cos(a/2))."""
    v = np.asarray(v, float)
    half2 = np.sum(v * v, axis=-1, keepdims=True) / 4
    sinc, _ = sinc_terms(half2)
    return np.concatenate([sinc / 2 * v, np.cos(np.sqrt(half2))], axis=-1)


def quat_multiply(p: Array, q: Array) -> Array:
    """Return p q, Hamilton's product of quaternions xyzw: the rotation q first, then p; shapes broadcast."""
    out = np.empty(np.broadcast_shapes(p.shape, q.shape))
    a, b, c, d = p[..., 0], p[..., 1], p[..., 2], p[..., 3]
    x, y, z, w = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    out[..., 0] = d * x + a * w + b * z - c * y
    out[..., 1] = d * y + b * w + c * x - a * z
    out[..., 2] = d * z + c * w + a * y - b * x
    out[..., 3] = d * w - a * x - b * y - c * z
    return out


def quat_conjugate(q: Array) -> Array:
    """Return the inverse rotation of unit quaternions xyzw."""
    conjugate: Array = q * np.array([-1.0, -1.0, -1.0, 1.0])
    return conjugate


def log(R: Array) -> Array:
    """Return the rotation vector of R, |v| <= pi, accurate up to pi (through the quaternion), (..., 3, 3) -> (..., 3)."""
    return quat_log(to_quat(R))


def project(M: Array) -> Array:
    """Return the rotation nearest to M in the Frobenius norm (Arun 1987), (..., 3, 3) -> (..., 3, 3).

    Near a rotation by three steps M <- M (3 I - M^T M) / 2 (Bjorck and Bowie 1971), a fourth of the time of singular values.
    """
    M = np.asarray(M, float)
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.swapaxes(M, -1, -2) @ M - np.eye(3)
        volume = np.sum(np.cross(M[..., 0, :], M[..., 1, :]) * M[..., 2, :], axis=-1)
    # Each step takes singular values from 1 + d to 1 - 1.5 d^2: three of them from here to 1e-16.
    near = (np.max(np.abs(off), axis=(-1, -2)) < _NEAR_ROTATION) & (volume > 0)
    if not near.all():
        out = np.empty(M.shape)
        out[near], out[~near] = _polar(M[near], off[near]), _arun(M[~near])
        return out
    return _polar(M, off)


def _polar(R: Array, off: Array) -> Array:
    """Return R (R^T R)^(-1/2) of R near an orthogonal matrix, off = R^T R - I."""
    R = R - 0.5 * (R @ off)
    for _ in range(2):
        R = 1.5 * R - 0.5 * (R @ (np.swapaxes(R, -1, -2) @ R))
    return R


def _arun(M: Array) -> Array:
    U, _, Vt = np.linalg.svd(M)
    U = U.copy()
    U[..., :, 2] *= np.sign(np.linalg.det(U @ Vt))[..., None]
    rotation: Array = U @ Vt
    return rotation
