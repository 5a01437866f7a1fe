"""What the IMUs on a trajectory feel, and their samples' normal equations.

gyro   w_meas - (M_g C_g_i R omega(t) + A_g C_g_i f_meas + b_g)
accel  a_meas - (M_a R (R_world_ref^T (s p''(t) - g) + alpha x r + omega x (omega x r)) + b_a)
R = R_imu_ref, r the IMU's place in the reference IMU's axes, s the board's size over what its file says; of the reference R = I, r = 0.
(Furgale, Rehder, Siegwart 2013; several IMUs: Rehder et al., ICRA 2016.)
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibkit.estimation.joint_parts import Index, Part
from calibkit.estimation.joint_state import A_G, EXTRAS, M_A, M_G, PHI, SCALE, Border, ImuState, JointState, biases, of_imu
from calibkit.geometry import so3
from calibkit.geometry.so3 import Array
from calibkit.geometry.spline import Knots, Steps, Turning, basis, turning
from calibkit.models.imu import ImuModel
from calibkit.solver.robust import cauchy

# Of a segment: the rate's derivatives by time are differences of the segment's own curve, right to 1e-7 of them.
_NEAR = 1e-3


@dataclass(frozen=True)
class ImuRows:
    """One IMU's samples, and how each is weighed."""

    t: Array  # (n,) s on its clock
    gyro: Array  # (n, 3) rad/s
    accel: Array  # (n, 3) m/s^2
    sigma: Array  # (6,) of one sample: gyro, accel
    walk: Array  # (6,) rad/s^2/sqrt(Hz), m/s^3/sqrt(Hz)
    keep: NDArray[np.bool_]  # (n, 2) gyro, accel


@dataclass(frozen=True)
class ImuBeside:
    """A further IMU's samples, and what is free of its model."""

    rows: ImuRows
    extras: tuple[str, ...] = ()  # of joint_state.IMU_MODEL
    prior: tuple[ImuModel, Array] | None = None  # and information about these, in the order of IMU_MODEL


@dataclass(frozen=True)
class Felt:
    """Rate of turn and specific force in the IMU's own axes at n times, and how they go with the unknowns."""

    omega: Array  # (n, 3) rad/s
    force: Array  # (n, 3) m/s^2
    omega_by_knot: Array  # (n, 3, order, 3) by rotations
    force_by_knot: Array  # (n, 3, order, 6) by rotations and positions
    by: dict[str, tuple[Array, Array]]  # (n, 3, q) each, by the border's blocks


def feel(x: JointState, knots: Knots, steps: Steps, imu: ImuState | None, t: Array, jacobians: bool = True) -> tuple[Index, Felt]:
    """Return the segments of times (n,) s on the IMU's clock and what it feels then; the reference where it is None."""
    i, u = knots.locate(t if imu is None else t + imu.dt)
    value, rate, second = (basis(knots, u, r) for r in range(3))
    at = turning(x.R, steps, i, value, rate, jacobians)
    near = i[:, None] + np.arange(knots.order)
    RT = np.swapaxes(at.R, 1, 2)
    acceleration = np.einsum("nl,nlk->nk", second, x.p[near])
    force = (RT @ (x.board_scale * acceleration - x.gravity)[..., None])[..., 0]
    n = len(i)
    by_knot, by = np.empty((n, 3, knots.order, 6)), {}
    if jacobians:
        by_knot[..., :3] = np.einsum("nab,nbkc->nakc", so3.hat(force), at.dR)
        by_knot[..., 3:] = x.board_scale * second[:, None, :, None] * RT[:, :, None, :]
        none = np.zeros((n, 3, 1))
        by = {"gravity": (np.zeros((n, 3, 3)), -RT), SCALE: (none, RT @ acceleration[..., None])}
    felt = Felt(at.omega, force, at.domega, by_knot, by)
    if imu is None:
        return i, felt
    jerk = (x.board_scale * RT @ np.einsum("nl,nlk->nk", basis(knots, u, 3), x.p[near])[..., None])[..., 0]
    before, after = (turning(x.R, steps, i, basis(knots, u + side), basis(knots, u + side, 1), jacobians) for side in (-_NEAR, _NEAR))
    return i, _elsewhere(felt, imu, (before, at, after), _NEAR * knots.spacing, jerk)


def _elsewhere(felt: Felt, imu: ImuState, near: tuple[Turning, Turning, Turning], h: float, jerk: Array) -> Felt:
    """Return what an IMU feels that sits elsewhere on the rig, from what the reference feels and how it turns at t - h, t, t + h."""
    before, at, after = near
    R, r = imu.T_imu_ref[:3, :3], -imu.T_imu_ref[:3, :3].T @ imu.T_imu_ref[:3, 3]
    omega = at.omega
    alpha = (after.omega - before.omega) / (2 * h)
    beta = (after.omega - 2 * omega + before.omega) / h**2
    around = np.cross(omega, r)
    force = felt.force + np.cross(alpha, r) + np.cross(omega, around)
    if not felt.by:
        return Felt(omega @ R.T, force @ R.T, felt.omega_by_knot, felt.force_by_knot, {})
    dalpha = (after.domega - before.domega) / (2 * h)
    hat_omega, hat_r = so3.hat(omega), so3.hat(r)
    by_knot = felt.force_by_knot.copy()
    by_knot[..., :3] -= np.einsum("ab,nbkc->nakc", hat_r, dalpha)
    by_knot[..., :3] -= np.einsum("nab,nbkc->nakc", so3.hat(around) + hat_omega @ hat_r, at.domega)
    E = so3.hat(alpha) + hat_omega @ hat_omega  # of what the place r adds, E r; r moves by r x phi - rho
    of_T = np.concatenate([np.zeros_like(E), -hat_omega], axis=2), np.concatenate([-E, E @ hat_r - so3.hat(force)], axis=2)
    change = jerk - np.cross(omega, felt.force) + np.cross(beta, r) + np.cross(alpha, around) + np.cross(omega, np.cross(alpha, r))
    by = {name: (a, R @ b) for name, (a, b) in felt.by.items()}
    by |= {"T_imu": (R @ of_T[0], R @ of_T[1]), "dt_imu": ((alpha @ R.T)[..., None], (change @ R.T)[..., None])}
    return Felt(
        omega @ R.T,
        force @ R.T,
        np.einsum("ab,nbkc->nakc", R, felt.omega_by_knot),
        np.einsum("ab,nbkc->nakc", R, by_knot),
        by,
    )


def inertial_residuals(x: JointState, knots: Knots, rows: ImuRows, j: int) -> Array:
    """Return measured minus predicted of IMU j (n, 6): rad/s, m/s^2."""
    imu = x.imus[j]
    i, felt = feel(x, knots, Steps.of(x.R), imu if j else None, rows.t, jacobians=False)
    model = imu.model
    accel = felt.force @ model.M_a.T + imu.bias[i, 3:]
    gyro = felt.omega @ (model.M_g @ model.C_g_i).T + _measured_force(model, rows.accel) @ (model.A_g @ model.C_g_i).T + imu.bias[i, :3]
    return np.concatenate([rows.gyro - gyro, rows.accel - accel], axis=1)


def _measured_force(model: ImuModel, accel: Array) -> Array:
    """Return the specific force that samples felt (n, 3): as measured, its noise is nothing to A_g."""
    force: Array = accel @ np.linalg.inv(model.M_a).T
    return force


def inertial_parts(
    x: JointState, knots: Knots, steps: Steps, border: Border, rows: ImuRows, j: int, some: slice, loss_scale: float
) -> tuple[Part, Part]:
    """Return what some samples of IMU j's gyroscope and accelerometer say."""
    k, imu, own = knots.order, x.imus[j], biases(j)
    model, accel = imu.model, rows.accel[some]
    i, felt = feel(x, knots, steps, imu if j else None, rows.t[some])
    n, bias, omega = len(i), imu.bias[i], felt.omega
    turns, sensitive, force = model.M_g @ model.C_g_i, model.A_g @ model.C_g_i, _measured_force(model, accel)

    by = {name: columns for name, columns in felt.by.items() if name != SCALE or SCALE in border.extras}
    of_gyro = {name: turns @ a for name, (a, _) in by.items()}
    of_accel = {name: model.M_a @ b for name, (_, b) in by.items()}
    free = border.free_of(j)
    for columns in (of_gyro, of_accel):
        columns |= {name: np.zeros((n, 3, EXTRAS[name])) for name in free}
    if M_G in free:
        of_gyro[M_G] = by_lower(omega @ model.C_g_i.T)
    if PHI in free:
        of_gyro[PHI] = -turns @ so3.hat(omega) - sensitive @ so3.hat(force)
    if M_A in free:
        of_gyro[M_A] = -sensitive @ np.linalg.inv(model.M_a) @ by_lower(force)
        of_accel[M_A] = by_lower(felt.force)
    if A_G in free:
        of_gyro[A_G] = np.einsum("rs,nc->nrsc", np.eye(3), force @ model.C_g_i.T).reshape(n, 3, 9)
    shared = ("gravity", SCALE)
    touch = border.at(name if name in shared else of_imu(name, j) if name in free else f"{name} {j}" for name in of_gyro)

    def samples(kind: str, K: Array, sigma: Array, keep: NDArray[np.bool_], offsets: Index) -> Part:
        """Return the products of rows K (n, 3, q), weighed, by the segments that they fall into."""
        K /= sigma[:, None]
        loss, down = cauchy(np.sum(K[..., -1] ** 2, axis=1), loss_scale)
        K *= (np.sqrt(down) * keep)[:, None, None]
        segment, N = _by_segment(K, i)
        cost = float(np.sum(loss[keep]))
        return Part(of_imu(kind, j), knots.middle(segment), border.knot * segment, offsets, touch, N, cost, 3 * int(keep.sum()))

    knot = border.knot * np.arange(k)[:, None]
    by_knot = turns @ felt.omega_by_knot.reshape(n, 3, -1)
    left = rows.gyro[some] - omega @ turns.T - force @ sensitive.T - bias[:, :3]
    K = np.concatenate([by_knot[..., :3], _eyes(n), by_knot[..., 3:], *of_gyro.values(), left[..., None]], axis=2)
    rotation = knot + np.arange(3)
    offsets = np.concatenate([rotation[0], np.arange(own.start, own.start + 3), rotation[1:].ravel()])
    gyro = samples("gyro", K, rows.sigma[:3], rows.keep[some, 0], offsets)

    by_knot = model.M_a @ felt.force_by_knot.reshape(n, 3, -1)
    left = accel - felt.force @ model.M_a.T - bias[:, 3:]
    K = np.concatenate([by_knot[..., :6], _eyes(n), by_knot[..., 6:], *of_accel.values(), left[..., None]], axis=2)
    motion = knot + np.arange(6)
    offsets = np.concatenate([motion[0], np.arange(own.start + 3, own.stop), motion[1:].ravel()])
    return gyro, samples("accel", K, rows.sigma[3:], rows.keep[some, 1], offsets)


def _eyes(n: int) -> Array:
    return np.broadcast_to(np.eye(3), (n, 3, 3))


def by_lower(v: Array) -> Array:
    """Return d(M v) / d(M's six values) (n, 3, 6) for v (n, 3) and M lower triangular, row by row."""
    out = np.zeros((len(v), 3, 6))
    rows, columns = np.tril_indices(3)
    out[:, rows, np.arange(6)] = v[:, columns]
    return out


def _by_segment(K: Array, i: Index) -> tuple[Index, Array]:
    """Return the segments that rows K (n, 6, q) fall into, sorted, and K^T K of each."""
    segment, row = np.unique(i, return_inverse=True)
    count = np.bincount(row)
    start = np.cumsum(count) - count
    slot = np.arange(len(i)) - start[row]  # times are sorted
    padded = np.zeros((len(segment), int(count.max()), *K.shape[1:]))
    padded[row, slot] = K
    padded = padded.reshape(len(segment), -1, K.shape[-1])
    return segment, np.swapaxes(padded, 1, 2) @ padded
