"""The closed-form solvers of A X = X B, each as published: motions A of frame 1 and B of frame 2 (SPEC section 1), X = T_1_2.

All take A and B (..., n, 4, 4) and weights (..., n) of the squared residuals, and return X (..., 4, 4): a leading batch dimension solves
many samples in one call. Motions without two rotation axes still give a finite X; hand_eye_pairs.spectrum tells that it means nothing.
Rounding alone leaves R_X to 1e-16 / a and t_X to 1e-16 / a^2 for motions of angle a.
"""

from collections.abc import Callable

import numpy as np

from calibkit.estimation.hand_eye_linear import check, null_space, quaternions, rows, solve
from calibkit.geometry import se3, so3
from calibkit.geometry.so3 import Array

# Half turns about x, y, z, and none, as diagonals: R_X times number k has q_X's component k (xyzw) as its scalar part, up to sign.
_HALF_TURNS = np.array([[1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0], [1.0, 1.0, 1.0]])


def tsai(A: Array, B: Array, weights: Array | None = None) -> Array:
    """Return X by Tsai and Lenz 1989: skew(a + b) x = b - a (eq. 12), then t (eq. 15); a, b = sin(angle / 2) axis.

    x, the Gibbs vector of R_X, is infinite at 180 deg: an R_X beyond 120 deg is solved for in a frame 2 turned by 180 deg about one of
    its axes, where it is below.
    """
    A, B, root = check(A, B, weights)
    qa, qb = quaternions(A, B, root)
    q = _null_quaternion(qa, qb, root)
    frame = np.where(np.abs(q[..., 3]) >= 0.5, 3, np.argmax(np.abs(q), axis=-1))
    turn = _HALF_TURNS[frame]
    a, b = qa[..., :3], qb[..., :3] * turn[..., None, :]
    x = solve(rows(so3.hat(a + b), root), rows((b - a)[..., None], root)[..., 0])
    R = so3.from_quat(np.concatenate([x, np.ones((*x.shape[:-1], 1))], axis=-1)) * turn[..., None, :]
    return se3.make(R, translation(A, B, R, root))


def park(A: Array, B: Array, weights: Array | None = None) -> Array:
    """Return X by Park and Martin 1994: R_X = (M^T M)^(-1/2) M^T, M = sum beta alpha^T, of least sum |alpha - R_X beta|^2; then t."""
    A, B, root = check(A, B, weights)
    qa, qb = quaternions(A, B, root)
    # so3's logarithm is that of the q with w >= 0.
    alpha, beta = so3.quat_log(qa) * root[..., None], so3.quat_log(qb) * np.where(qb[..., 3] < 0, -root, root)[..., None]
    R = so3.project(np.swapaxes(alpha, -1, -2) @ beta)
    return se3.make(R, translation(A, B, R, root))


def horaud(A: Array, B: Array, weights: Array | None = None) -> Array:
    """Return X by Horaud and Dornaika 1995, closed form: the unit quaternion of least sum |q_A q - q q_B|^2; then t."""
    A, B, root = check(A, B, weights)
    R = so3.from_quat(_null_quaternion(*quaternions(A, B, root), root))
    return se3.make(R, translation(A, B, R, root))


def andreff(A: Array, B: Array, weights: Array | None = None) -> Array:
    """Return X by Andreff, Horaud and Espiau 1999, eq. 10, R_X and t at once and R_X made a rotation afterwards.

    (I - R_A (x) R_B) vec R_X = 0 and (I (x) t_B^T) vec R_X + (I - R_A) t = t_A, vec by rows; rows of rad and of m count alike.
    It needs large rotations: noise shrinks vec R_X, and t makes up for the part of t_B that goes missing. Without any t_B, R_X is I.
    """
    A, B, root = check(A, B, weights)
    RA, RB, tA, tB = A[..., :3, :3], B[..., :3, :3], A[..., :3, 3], B[..., :3, 3]
    M = np.zeros((*A.shape[:-2], 12, 12))
    M[..., :9, :9] = np.eye(9) - kron(RA, RB)
    M[..., 9:, :9] = kron(np.eye(3), tB[..., None, :])
    M[..., 9:, 9:] = np.eye(3) - RA
    y = np.concatenate([np.zeros((*A.shape[:-2], 9)), tA], axis=-1)
    x = solve(rows(M, root), rows(y[..., None], root)[..., 0])
    return se3.make(so3.project(x[..., :9].reshape(*x.shape[:-1], 3, 3)), x[..., 9:])


def daniilidis(A: Array, B: Array, weights: Array | None = None) -> Array:
    """Return X by Daniilidis 1999: the unit dual quaternion (q, q') in the two-dimensional null space of his T (eqs. 31-35), unit m.

    T has the rows [a - b, skew(a + b), 0, 0] and [a' - b', skew(a' + b'), a - b, skew(a + b)] on (w, v, w', v'); a and a' are the
    vector parts of A's dual quaternion.
    """
    A, B, root = check(A, B, weights)
    qa, qb = quaternions(A, B, root)
    a, b, a_dual, b_dual = qa[..., :3], qb[..., :3], _dual(qa, A[..., :3, 3]), _dual(qb, B[..., :3, 3])
    real = np.concatenate([so3.hat(a + b), (a - b)[..., None]], axis=-1)
    dual = np.concatenate([so3.hat(a_dual + b_dual), (a_dual - b_dual)[..., None]], axis=-1)
    T = np.concatenate([np.concatenate([real, np.zeros_like(real)], axis=-1), np.concatenate([dual, real], axis=-1)], axis=-2)
    basis = null_space(rows(T, root), 2)
    u, v = basis[..., :4], basis[..., 4:]
    # (q, q') = l1 (u1, v1) + l2 (u2, v2) with q . q' = l^T S l = 0: of the two directions, that of the larger |q| (the other has q = 0).
    S = u @ np.swapaxes(v, -1, -2)
    e, axes = np.linalg.eigh((S + np.swapaxes(S, -1, -2)) / 2)
    low, high = np.sqrt(np.maximum(-e[..., 0], 0)), np.sqrt(np.maximum(e[..., 1], 0))
    trials = np.stack([np.stack([high, low], axis=-1), np.stack([high, -low], axis=-1)], axis=-2) @ np.swapaxes(axes, -1, -2)
    size = np.linalg.norm(trials @ u, axis=-1) / np.maximum(np.linalg.norm(trials, axis=-1), 1e-300)
    choice = np.argmax(size, axis=-1)[..., None, None]
    found = (np.take_along_axis(trials, choice, axis=-2) @ basis)[..., 0, :]
    length = np.linalg.norm(found[..., :4], axis=-1, keepdims=True)
    found = np.where(length > 1e-150, found / np.maximum(length, 1e-150), [0, 0, 0, 1.0, 0, 0, 0, 0])
    q, w, vector, vector_dual = found[..., :4], found[..., 3:4], found[..., :3], found[..., 4:7]
    t = 2 * (w * vector_dual - found[..., 7:] * vector - np.cross(vector_dual, vector))
    return se3.make(so3.from_quat(q), t)


Solver = Callable[[Array, Array, Array | None], Array]
METHODS: dict[str, Solver] = {"tsai": tsai, "park": park, "horaud": horaud, "andreff": andreff, "daniilidis": daniilidis}


def translation(A: Array, B: Array, R: Array, root: Array) -> Array:
    """Return t_X (..., 3) of least sum |(R_A - I) t_X - (R_X t_B - t_A)|^2, the smallest where the motions leave it open."""
    y = (B[..., :3, 3] @ np.swapaxes(R, -1, -2) - A[..., :3, 3])[..., None]
    return solve(rows(A[..., :3, :3] - np.eye(3), root), rows(y, root)[..., 0])


def kron(P: Array, Q: Array) -> Array:
    """Return the Kronecker products (..., a c, b d) of (..., a, b) and (..., c, d): vec(P M Q^T) = kron(P, Q) vec(M), vec by rows."""
    product: Array = np.einsum("...ab,...cd->...acbd", P, Q)
    return product.reshape(*product.shape[:-4], P.shape[-2] * Q.shape[-2], P.shape[-1] * Q.shape[-1])


def _null_quaternion(qa: Array, qb: Array, root: Array) -> Array:
    """Return the unit q (..., 4) of least sum |q_A q - q q_B|^2 by the singular vectors of the stacked 4x4 blocks."""
    a, b = qa[..., :3], qb[..., :3]
    blocks = np.zeros((*qa.shape, 4))
    blocks[..., :3, :3] = so3.hat(a + b) + (qa[..., 3] - qb[..., 3])[..., None, None] * np.eye(3)
    blocks[..., :3, 3], blocks[..., 3, :3] = a - b, b - a
    blocks[..., 3, 3] = qa[..., 3] - qb[..., 3]
    return null_space(rows(blocks, root), 1)[..., 0, :]


def _dual(q: Array, t: Array) -> Array:
    """Return the vector part of q' = (t, 0) q / 2."""
    out: Array = (q[..., 3:] * t + np.cross(t, q[..., :3])) / 2
    return out
