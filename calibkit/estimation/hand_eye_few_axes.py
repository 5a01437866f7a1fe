"""First guesses of X where the motions turn about one axis or none (vehicles, gantries), from what their translations say."""

import numpy as np

from calibkit.estimation.hand_eye_linear import check, quaternions, rows, solve
from calibkit.estimation.hand_eye_methods import Solver, park
from calibkit.geometry import se3, so3
from calibkit.geometry.so3 import Array


def one_axis(A: Array, B: Array, weights: Array | None = None) -> Array:
    """Return X (..., 4, 4) from motions about one axis, a in frame 1, b in frame 2: t_X across a, its part along a is open and set to 0.

    R_X = exp(phi a) R_0 with R_0 b = a, and (R_A - I) E y - cos(phi) p - sin(phi) a x p = a (a . R_0 t_B) - t_A linear in cos, sin and y;
    p is the part of R_0 t_B across a, E (3, 2) spans the plane across a, t_X = E y. Pure translations count here.
    """
    A, B, root = check(A, B, weights)
    qa, qb = quaternions(A, B, root)
    va, vb = qa[..., :3] * root[..., None], qb[..., :3] * root[..., None]
    basis = np.linalg.eigh(np.swapaxes(va, -1, -2) @ va)[1]
    E, a = basis[..., :2], basis[..., 2]
    b = np.sum(np.sum(va * a[..., None, :], axis=-1, keepdims=True) * vb, axis=-2)
    R0 = _turn(b, a)
    turned = B[..., :3, 3] @ np.swapaxes(R0, -1, -2)
    along = np.sum(turned * a[..., None, :], axis=-1, keepdims=True) * a[..., None, :]
    across = turned - along
    M = np.concatenate(
        [-across[..., None], -np.cross(a[..., None, :], across)[..., None], (A[..., :3, :3] - np.eye(3)) @ E[..., None, :, :]], axis=-1
    )
    x = solve(rows(M, root), rows((along - A[..., :3, 3])[..., None], root)[..., 0])
    phi = np.arctan2(x[..., 1], x[..., 0])
    R = so3.exp(phi[..., None] * a) @ R0
    y = B[..., :3, 3] @ np.swapaxes(R, -1, -2) - A[..., :3, 3]
    t = solve(rows((A[..., :3, :3] - np.eye(3)) @ E[..., None, :, :], root), rows(y[..., None], root)[..., 0])
    return se3.make(R, (E @ t[..., None])[..., 0])


def no_axis(A: Array, B: Array, weights: Array | None = None) -> Array:
    """Return X (..., 4, 4) from pure translations: R_X of least sum |t_A - R_X t_B|^2 (Wahba 1965); t_X is open and set to 0."""
    A, B, root = check(A, B, weights)
    tA, tB = A[..., :3, 3] * root[..., None], B[..., :3, 3] * root[..., None]
    return se3.make(so3.project(np.swapaxes(tA, -1, -2) @ tB), np.zeros(3))


# By how many axes the motions turn about (Spectrum.rank).
SEEDS: dict[int, Solver] = {0: no_axis, 1: one_axis, 2: park, 3: park}


def _turn(b: Array, a: Array) -> Array:
    """Return a rotation that carries b's direction to a, for b of any length, 0 too, and a of length 1: a half turn about their middle.

    Where they point apart, b is first turned by 180 deg about an axis across a.
    """
    b = b / np.maximum(np.linalg.norm(b, axis=-1, keepdims=True), 1e-300)
    first = np.where(
        np.sum(a * b, axis=-1)[..., None, None] < 0, _half_turn(np.cross(a, np.eye(3)[np.argmin(np.abs(a), axis=-1)])), np.eye(3)
    )
    return _half_turn(a + (first @ b[..., None])[..., 0]) @ first


def _half_turn(v: Array) -> Array:
    """Return the rotation by 180 deg about v: 2 v v^T / |v|^2 - I."""
    out: Array = 2 * v[..., :, None] * v[..., None, :] / np.sum(v * v, axis=-1)[..., None, None] - np.eye(3)
    return out
