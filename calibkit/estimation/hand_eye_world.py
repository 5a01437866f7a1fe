"""P X = Z Q from absolute poses: the hand-eye transform X and where the two worlds sit, Z, both at once.

P_i = T_w1_1(i), Q_i = T_w2_2(i), so that X = T_1_2 is the X of A X = X B for A = P_i^-1 P_j, B = Q_i^-1 Q_j, and Z = T_w1_w2:

| setup | P | Q | X | Z |
|---|---|---|---|---|
| eye-in-hand | T_base_gripper | T_cam_target^-1 | T_gripper_cam | T_base_target |
| eye-to-hand | T_base_gripper^-1 | T_cam_target^-1 | T_base_cam | T_gripper_target |
| motion | T_world1_sensor1 | T_world2_sensor2 | T_sensor1_sensor2 | T_world1_world2 |
"""

from collections.abc import Callable

import numpy as np

from calibkit.estimation.hand_eye_linear import check, rows, solve
from calibkit.estimation.hand_eye_methods import kron
from calibkit.geometry import se3, so3
from calibkit.geometry.so3 import Array

# From what people record, T_base_gripper and T_cam_target (or two trajectories), to P and Q.
SETUPS: dict[str, Callable[[Array, Array], tuple[Array, Array]]] = {
    "eye-in-hand": lambda T_base_gripper, T_cam_target: (T_base_gripper, se3.inverse(T_cam_target)),
    "eye-to-hand": lambda T_base_gripper, T_cam_target: (se3.inverse(T_base_gripper), se3.inverse(T_cam_target)),
    "motion": lambda T_world1_sensor1, T_world2_sensor2: (T_world1_sensor1, T_world2_sensor2),
}


def shah(P: Array, Q: Array, weights: Array | None = None) -> tuple[Array, Array]:
    """Return X and Z (..., 4, 4) by Shah 2013: vec R_X and vec R_Z are the first singular vectors of sum R_P (x) R_Q; then t_X and t_Z.

    (R_P (x) R_Q) vec R_X = vec R_Z, vec by rows. Poses that differ by an angle a give R_X to 1e-16 / a^2 only, as a gap of singular values.
    """
    P, Q, root = check(P, Q, weights)
    RP, RQ = P[..., :3, :3], Q[..., :3, :3]
    U, _, Vt = np.linalg.svd(np.einsum("...nij,...n->...ij", kron(RP, RQ), root**2))
    left, right = (m.reshape(*m.shape[:-1], 3, 3) for m in (U[..., :, 0], Vt[..., 0, :]))
    # The two vectors share one sign, which the determinant tells.
    sign = np.where(np.linalg.det(left) + np.linalg.det(right) < 0, -1.0, 1.0)[..., None, None]
    R_Z, R_X = so3.project(sign * left), so3.project(sign * right)
    M = np.concatenate([RP, np.broadcast_to(-np.eye(3), RP.shape)], axis=-1)
    y = Q[..., :3, 3] @ np.swapaxes(R_Z, -1, -2) - P[..., :3, 3]
    t = solve(rows(M, root), rows(y[..., None], root)[..., 0])
    return se3.make(R_X, t[..., :3]), se3.make(R_Z, t[..., 3:])


def li(P: Array, Q: Array, weights: Array | None = None) -> tuple[Array, Array]:
    """Return X and Z (..., 4, 4) by Li, Wang and Wu 2010, eq. 19: all 24 numbers at once, then the rotations made rotations.

    (R_P (x) I) vec R_X = (I (x) R_Q^T) vec R_Z and R_P t_X + t_P = (I (x) t_Q^T) vec R_Z + t_Z, vec by rows, unit m.
    """
    P, Q, root = check(P, Q, weights)
    RP, RQ = P[..., :3, :3], Q[..., :3, :3]
    M = np.zeros((*P.shape[:-2], 12, 24))
    M[..., :9, :9] = kron(RP, np.eye(3))
    M[..., :9, 9:18] = -kron(np.eye(3), np.swapaxes(RQ, -1, -2))
    M[..., 9:, 9:18] = kron(np.eye(3), Q[..., None, :3, 3])
    M[..., 9:, 18:21], M[..., 9:, 21:] = -RP, np.eye(3)
    y = np.concatenate([np.zeros((*P.shape[:-2], 9)), P[..., :3, 3]], axis=-1)
    x = solve(rows(M, root), rows(y[..., None], root)[..., 0])
    R_X, R_Z = (so3.project(part.reshape(*part.shape[:-1], 3, 3)) for part in (x[..., :9], x[..., 9:18]))
    return se3.make(R_X, x[..., 18:21]), se3.make(R_Z, x[..., 21:])


WorldSolver = Callable[[Array, Array, Array | None], tuple[Array, Array]]
WORLD_METHODS: dict[str, WorldSolver] = {"shah": shah, "li": li}
