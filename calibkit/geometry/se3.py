"""Rigid motions SE(3) as 4x4 matrices, batch-first (..., 4, 4): `p_a = T_a_b p_b`.

The retraction perturbs on the right and keeps the parts apart: R <- R exp(phi), p <- p + R rho, tangent order (rho, phi).
"""

import numpy as np

from calibkit.geometry import so3
from calibkit.geometry.so3 import Array


def make(R: Array, p: Array) -> Array:
    """Return T = [R p; 0 1] from (..., 3, 3) and (..., 3), broadcast against each other."""
    R, p = np.asarray(R, float), np.asarray(p, float)
    T = np.zeros((*np.broadcast_shapes(R.shape[:-2], p.shape[:-1]), 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, p, 1
    return T


def inverse(T: Array) -> Array:
    """Return T_b_a = [R^T, -R^T p; 0 1] from T_a_b."""
    T = np.asarray(T, float)
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)
    return make(Rt, -(Rt @ T[..., :3, 3, None])[..., 0])


def transform(T: Array, points: Array) -> Array:
    """Return p_a = R p_b + p for points (..., n, 3) under T_a_b (..., 4, 4)."""
    T = np.asarray(T, float)
    out: Array = np.asarray(points, float) @ np.swapaxes(T[..., :3, :3], -1, -2) + T[..., None, :3, 3]
    return out


def retract(T: Array, step: Array) -> Array:
    """Return T [exp(phi) rho; 0 1] for step (..., 6) = (rho in m, phi in rad), both in T's right-hand frame."""
    T, step = np.asarray(T, float), np.asarray(step, float)
    out: Array = T @ make(so3.exp(step[..., 3:]), step[..., :3])
    return out


def local(T: Array, other: Array) -> Array:
    """Return the step (..., 6) with retract(T, step) = other."""
    T, other = np.asarray(T, float), np.asarray(other, float)
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)
    rho = Rt @ (other[..., :3, 3] - T[..., :3, 3])[..., None]
    return np.concatenate([rho[..., 0], so3.log(Rt @ other[..., :3, :3])], axis=-1)


def adjoint(T: Array) -> Array:
    """Return Ad with T retract(I, d) T^-1 = retract(I, Ad d) to first order, tangent order (rho, phi), (..., 6, 6)."""
    T = np.asarray(T, float)
    R = T[..., :3, :3]
    out = np.zeros((*T.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = R
    out[..., :3, 3:] = so3.hat(T[..., :3, 3]) @ R
    return out
