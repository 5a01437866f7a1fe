"""What the closed-form hand-eye solvers share: the check at the door, weighted rows, batched least squares, quaternions that agree in sign.

Everything takes leading batch dimensions `...`: motions (..., n, 4, 4), weights (..., n).
"""

import numpy as np
from numpy.typing import NDArray

from calibkit.geometry import so3
from calibkit.geometry.so3 import Array

Index = NDArray[np.intp]

_EPS = float(np.finfo(float).eps)
# Quaternions' w_A + w_B below which noise may have turned the axis of one motion round: both angles within 6 deg of 180 deg.
_NEAR_HALF_TURN = 0.1
_PIECE = 256  # rows
_SIGNS = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])


def check(A: Array, B: Array, weights: Array | None) -> tuple[Array, Array, Array]:
    """Return two finite (..., n, 4, 4), n >= 1, and the roots of the weights over their mean (..., n); ValueError otherwise."""
    A, B = np.asarray(A, float), np.asarray(B, float)
    if A.ndim < 3 or A.shape != B.shape or A.shape[-2:] != (4, 4) or A.shape[-3] == 0:
        raise ValueError(f"hand-eye needs two equal arrays of shape (..., n, 4, 4), n >= 1, and got {A.shape} and {B.shape}")
    w = np.ones(A.shape[:-2]) if weights is None else np.broadcast_to(np.asarray(weights, float), A.shape[:-2])
    if not (np.isfinite(A).all() and np.isfinite(B).all() and np.isfinite(w).all() and (w >= 0).all()):
        raise ValueError("hand-eye needs finite poses and finite weights, none negative")
    mean = w.mean(axis=-1, keepdims=True)
    return A, B, np.sqrt(w / np.where(mean > 0, mean, 1.0))


def rows(blocks: Array, root: Array) -> Array:
    """Return blocks (..., n, k, c) scaled by root (..., n) and stacked to (..., n k, c)."""
    scaled = blocks * root[..., None, None]
    return scaled.reshape(*blocks.shape[:-3], -1, blocks.shape[-1])


def solve(M: Array, y: Array) -> Array:
    """Return the smallest x (..., c) of least |M x - y|: directions that rounding alone would determine stay 0, so that x is always finite.

    Rotation matrices carry an absolute error of eps, whatever the angle: hence the absolute part of the floor.
    """
    c = M.shape[-1]
    triangle = _triangle(np.concatenate([M, y[..., None]], axis=-1))  # far fewer rows, the same least squares
    U, s, Vt = np.linalg.svd(triangle[..., :c], full_matrices=False)
    floor = 4 * _EPS * (np.sqrt(M.shape[-2]) + s[..., :1])
    coordinates = (np.swapaxes(U, -1, -2) @ triangle[..., c:])[..., 0] * np.where(s > floor, 1 / np.maximum(s, floor), 0.0)
    out: Array = (np.swapaxes(Vt, -1, -2) @ coordinates[..., None])[..., 0]
    return out


def null_space(M: Array, dimension: int) -> Array:
    """Return the right singular vectors of the smallest singular values as rows (..., dimension, c), the smallest last."""
    Vt: Array = np.linalg.svd(_triangle(M), full_matrices=True)[2]
    return Vt[..., -dimension:, :]


def _triangle(M: Array) -> Array:
    """Return R of M = QR; many rows in pieces that the cache holds first (Demmel et al. 2012)."""
    n, c = M.shape[-2:]
    pieces = n // _PIECE
    if pieces > 1:
        whole = M[..., : pieces * _PIECE, :].reshape(*M.shape[:-2], pieces, _PIECE, c)
        small = np.asarray(np.linalg.qr(whole, mode="r"))
        M = np.concatenate([small.reshape(*M.shape[:-2], -1, c), M[..., pieces * _PIECE :, :]], axis=-2)
    return np.asarray(np.linalg.qr(M, mode="r"))


def near_half_turn(qa: Array, qb: Array) -> NDArray[np.bool_]:
    """Return for which motions (..., n) of quaternions xyzw with w >= 0 noise may have turned one of the axes round."""
    out: NDArray[np.bool_] = qa[..., 3] + qb[..., 3] < _NEAR_HALF_TURN
    return out


def quaternions(A: Array, B: Array, root: Array) -> tuple[Array, Array]:
    """Return q_A with w >= 0 and q_B in the sign with q_A = q_X q_B q_X^-1, xyzw (..., n, 4).

    At 180 deg q and -q are equally near, and q_B's sign is the axis's. Both signs of two motions are tried, the other motions near 180 deg
    follow the rotation that these give, and the likeliest set is kept, sigmas unknown: least 3 log sum |v_A - s R v_B|^2 + (w_A - s w_B)^2
    plus log sum (v_A . t_A - s v_B . t_B)^2. The last, the screws' translation, decides where only two axes were turned about: without
    any translation along them both answers are solutions.
    """
    qa, qb = so3.to_quat(A[..., :3, :3]), so3.to_quat(B[..., :3, :3])
    unsure = near_half_turn(qa, qb)
    if not unsure.any():
        return qa, qb
    va, vb = qa[..., :3] * root[..., None], qb[..., :3] * root[..., None]
    i, j = _two_axes(va, qa[..., 3])
    # A new axis for the four trials stands before the motions: (..., 4, n).
    pair = np.stack([i, j], axis=-1)[..., None]
    pa, pb = np.take_along_axis(va, pair, axis=-2), np.take_along_axis(vb, pair, axis=-2)
    free = np.take_along_axis(unsure, pair[..., 0], axis=-1)
    s = np.where(free[..., None, :], _SIGNS, 1.0)
    R = so3.project(np.swapaxes(pa, -1, -2)[..., None, :, :] @ (s[..., None] * pb[..., None, :, :]))
    along = np.einsum("...na,...hab,...nb->...hn", va, R, vb)
    signs = np.where(unsure[..., None, :] & (along < 0), -1.0, 1.0)
    R = so3.project(np.einsum("...na,...hn,...nb->...hab", va, signs, vb))  # of all motions, no more of two
    turned = signs[..., None] * np.einsum("...hab,...nb->...hna", R, vb)
    turn = np.sum((va[..., None, :, :] - turned) ** 2, axis=(-1, -2))
    turn += np.sum((root[..., None, :] * (qa[..., None, :, 3] - signs * qb[..., None, :, 3])) ** 2, axis=-1)
    da, db = np.sum(va * A[..., :3, 3], axis=-1), np.sum(vb * B[..., :3, 3], axis=-1)
    slide = np.sum((da[..., None, :] - signs * db[..., None, :]) ** 2, axis=-1)
    size = np.sum(A[..., :3, 3] ** 2 + B[..., :3, 3] ** 2, axis=(-1, -2))[..., None]
    # Nothing is known to better than 10 urad and a millionth of the way: below, agreement is no evidence.
    score = 3 * np.log(turn + 1e-10) + np.log(slide + 1e-12 * size + 1e-300)
    best = np.argmin(score, axis=-1)[..., None, None]
    return qa, qb * np.take_along_axis(signs, best, axis=-2)[..., 0, :, None]


def _two_axes(v: Array, w: Array) -> tuple[Index, Index]:
    """Return the indices of two motions with large rotations about axes that differ, away from 180 deg where there are such."""
    strength = w + 0.1
    i = np.argmax(np.linalg.norm(v, axis=-1) * strength, axis=-1)
    first = np.take_along_axis(v, i[..., None, None], axis=-2)
    j = np.argmax(np.linalg.norm(np.cross(first, v), axis=-1) * strength, axis=-1)
    return i, j
