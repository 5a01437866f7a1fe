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
from calibkit.estimation.joint_places import Places
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
        by_knot[..., :3] = (so3.hat(force) @ at.dR.reshape(n, 3, -1)).reshape(at.dR.shape)
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
    """Return what some samples of IMU j's gyroscope and accelerometer say.

    Jacobians are smooth along a segment: of many samples they are taken at a few places and interpolated between (`Places`).
    """
    imu, own, t, accel = x.imus[j], biases(j), rows.t[some], rows.accel[some]
    model, clock, of = imu.model, imu.dt if j else 0.0, imu if j else None
    measured = _measured_force(model, accel)
    i, u = knots.locate(t + clock)
    places = Places.of(knots, i, u, many=not _by_sample(model, border.free_of(j)))
    _, felt = feel(x, knots, steps, of, t, jacobians=places.at is None)
    if places.at is None:
        columns = _columns(border, j, model, felt, measured)
    else:
        _, there = feel(x, knots, steps, of, places.at - clock)
        columns = _columns(border, j, model, there, np.zeros((len(places.at), 3)))
    bias, turns, sensitive = imu.bias[i], model.M_g @ model.C_g_i, model.A_g @ model.C_g_i
    left_gyro = rows.gyro[some] - felt.omega @ turns.T - measured @ sensitive.T - bias[:, :3]
    left_accel = accel - felt.force @ model.M_a.T - bias[:, 3:]

    def part(kind: str, K: Array, left: Array, sigma: Array, keep: NDArray[np.bool_], offsets: Index) -> Part:
        left = left / sigma
        loss, down = cauchy(np.sum(left**2, axis=1), loss_scale)
        N = places.products(K / sigma[:, None], left, down * keep)
        t_s, cost, count = knots.middle(places.segment), float(np.sum(loss[keep])), 3 * int(keep.sum())
        return Part(of_imu(kind, j), t_s, border.knot * places.segment, offsets, columns.touch, N, cost, count)

    knot = border.knot * np.arange(knots.order)[:, None]
    rotation, motion = knot + np.arange(3), knot + np.arange(6)
    offsets = np.concatenate([rotation[0], np.arange(own.start, own.start + 3), rotation[1:].ravel()])
    gyro = part("gyro", columns.gyro, left_gyro, rows.sigma[:3], rows.keep[some, 0], offsets)
    offsets = np.concatenate([motion[0], np.arange(own.start + 3, own.stop), motion[1:].ravel()])
    return gyro, part("accel", columns.accel, left_accel, rows.sigma[3:], rows.keep[some, 1], offsets)


def _by_sample(model: ImuModel, free: tuple[str, ...]) -> bool:
    """Whether Jacobians go with the samples' own noise: those of a gyroscope that feels accelerations, as measured."""
    return A_G in free or (bool(np.any(model.A_g)) and (PHI in free or M_A in free))


@dataclass(frozen=True)
class _Columns:
    """How readings go with the unknowns: [first knot | bias | other knots | border]."""

    gyro: Array  # (n, 3, q)
    accel: Array
    touch: Index  # of the border


def _columns(border: Border, j: int, model: ImuModel, felt: Felt, force: Array) -> _Columns:
    """Return the Jacobians of IMU j's readings from those of what it feels, and the force (n, 3) that was measured."""
    n, turns, sensitive = len(force), model.M_g @ model.C_g_i, model.A_g @ model.C_g_i
    by = {name: columns for name, columns in felt.by.items() if name != SCALE or SCALE in border.extras}
    of_gyro = {name: turns @ a for name, (a, _) in by.items()}
    of_accel = {name: model.M_a @ b for name, (_, b) in by.items()}
    free = border.free_of(j)
    for columns in (of_gyro, of_accel):
        columns |= {name: np.zeros((n, 3, EXTRAS[name])) for name in free}
    if M_G in free:
        of_gyro[M_G] = by_lower(felt.omega @ model.C_g_i.T)
    if PHI in free:
        of_gyro[PHI] = -turns @ so3.hat(felt.omega) - sensitive @ so3.hat(force)
    if M_A in free:
        of_gyro[M_A] = -sensitive @ np.linalg.inv(model.M_a) @ by_lower(force)
        of_accel[M_A] = by_lower(felt.force)
    if A_G in free:
        of_gyro[A_G] = np.einsum("rs,nc->nrsc", np.eye(3), force @ model.C_g_i.T).reshape(n, 3, 9)
    shared = ("gravity", SCALE)
    touch = border.at(name if name in shared else of_imu(name, j) if name in free else f"{name} {j}" for name in of_gyro)
    eyes = np.broadcast_to(np.eye(3), (n, 3, 3))
    by_knot = turns @ felt.omega_by_knot.reshape(n, 3, -1)
    gyro = np.concatenate([by_knot[..., :3], eyes, by_knot[..., 3:], *of_gyro.values()], axis=2)
    by_knot = model.M_a @ felt.force_by_knot.reshape(n, 3, -1)
    accel = np.concatenate([by_knot[..., :6], eyes, by_knot[..., 6:], *of_accel.values()], axis=2)
    return _Columns(gyro, accel, touch)


def by_lower(v: Array) -> Array:
    """Return d(M v) / d(M's six values) (n, 3, 6) for v (n, 3) and M lower triangular, row by row."""
    out = np.zeros((len(v), 3, 6))
    rows, columns = np.tril_indices(3)
    out[:, rows, np.arange(6)] = v[:, columns]
    return out
