"""Stands and turns as one least-squares problem: accelerometer, gyroscope, and each stand's attitude and walk of the biases.

About a first guess a0 = M_a0^-1 (a_meas - b_a0), w0 = K_0 (w_meas - b_g0), so that every unknown is small, whatever the units:

    a0_i  = (I + D) g u_i + d + walk_a,i                      stand i, D lower triangular, u_i its direction of up in the IMU's frame
    0     = (I + E) w0_i - k - H u_i - walk_g,i               stand i does not turn
    u_j   = R_ij^T u_i                                        R_ij = prod exp(((I + E) w0 - k - H a / g - walk_g) dt), turn i to j
    walk_i+1 - walk_i ~ N(0, K^2 (t_i+1 - t_i)), sum walk = 0     so that d and k are the mean biases of the stands

(Tedaldi, Pretto, Menegatti, "A robust and easy to implement method for IMU calibration", ICRA 2014, fits the first and the third line
one after the other, with constant biases.)
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibkit.estimation.imu_turns import Turns, integrate
from calibkit.geometry.so3 import hat
from calibkit.models.imu import lower
from calibkit.solver.arrowhead import Arrowhead, BlockDiagonal
from calibkit.solver.robust import cauchy

Array = NDArray[np.float64]
Index = NDArray[np.intp]

ACCEL, GYRO, SENSITIVITY = slice(0, 9), slice(9, 21), slice(21, 30)
_ROWS, _COLUMNS = np.tril_indices(3)


@dataclass(frozen=True)
class Weights:
    """What the recording itself says of its errors, beyond the sensors' white noise."""

    misfit: float  # m/s^2 per axis and stand
    wobble: float  # rad/s per axis and stand
    turn: float  # rad / sqrt(rad turned)
    walk_accel: float  # m/s^2 / sqrt(s)
    walk_gyro: float  # rad/s / sqrt(s)


@dataclass(frozen=True)
class State:
    """Where the estimate stands."""

    theta: Array  # (p,) D 6, d 3, E 9, k 3, H 9 where asked
    up: Array  # (n, 3)
    step_accel: Array  # (n - 1, 3) walk from stand to stand
    step_gyro: Array  # (n - 1, 3)


@dataclass(frozen=True)
class Rows:
    """Residuals h(x) and d h / d x, not yet whitened: accelerometer and gyroscope a stand, then turns, then the two walks."""

    accel: Array  # (n, 3)
    gyro: Array  # (n, 3)
    turn: Array  # (m, 3)
    J_accel: Array  # (n, 3, q), q = core then border
    J_gyro: Array  # (n, 3, q)
    J_turn: Array  # (m, 3, q)


@dataclass(frozen=True)
class StandProblem:
    """Satisfies solver.levenberg_marquardt.Problem."""

    gravity: float
    time_s: Array  # (n,)
    accel: Array  # (n, 3) a0
    cov_accel: Array  # (n, 3, 3)
    gyro: Array  # (n, 3) w0
    cov_gyro: Array  # (n, 3, 3)
    turns: Turns  # of (w0, 1), and a / g where H is asked for
    start: Index  # (m,) stand before the turn
    end: Index  # (m,)
    white_gyro: float  # rad/s/sqrt(Hz)
    angle: Array  # (m,) rad, the way turned
    weights: Weights
    size: int  # p
    prior: Array  # (p,) sigma about the first guess: only for what the recording leaves open
    robust: float = np.inf  # sigmas
    walking: bool = True  # False: constant biases, for the first fits

    @property
    def stands(self) -> int:
        return len(self.time_s)

    @property
    def core_size(self) -> int:
        return 8 * self.stands - 6

    def walk_of_steps(self) -> Array:
        """Return the matrix (n, n - 1) from steps to a walk of mean zero."""
        n = self.stands
        walk = np.tril(np.ones((n, n - 1)), -1)
        out: Array = walk - walk.mean(axis=0)
        return out

    def rows(self, x: State) -> Rows:
        """Return residuals and Jacobians at x."""
        n, m, g, core = self.stands, len(self.start), self.gravity, self.core_size
        q = core + self.size
        D, E = lower(x.theta[:6]), x.theta[9:18].reshape(3, 3)
        k = x.theta[18:21]
        H = x.theta[SENSITIVITY].reshape(3, 3) if self.size > 21 else np.zeros((3, 3))
        W, B = self.walk_of_steps(), tangent(x.up)
        walk_accel, walk_gyro = W @ x.step_accel, W @ x.step_gyro
        one, stand = np.eye(3), np.arange(n)

        J_accel = np.zeros((n, 3, q))
        up_columns = 2 * stand[:, None] + np.arange(2)
        np.put_along_axis(J_accel, np.broadcast_to(up_columns[:, None], (n, 3, 2)), g * (one + D) @ B, axis=2)
        into_accel, into_gyro = J_accel[:, :, 2 * n : 5 * n - 3], np.zeros((n, 3, 3 * (n - 1)))
        into_accel[:] = np.einsum("is,rc->irsc", W, one).reshape(n, 3, -1)
        J_accel[:, _ROWS, core + np.arange(6)] = g * x.up[:, _COLUMNS]
        J_accel[:, :, core + 6 : core + 9] = one
        accel = self.accel - (g * x.up @ (one + D).T + x.theta[6:9] + walk_accel)

        J_gyro = np.zeros((n, 3, q))
        into_gyro = J_gyro[:, :, 5 * n - 3 : core]
        into_gyro[:] = -np.einsum("is,rc->irsc", W, one).reshape(n, 3, -1)
        J_gyro[:, :, core + 9 : core + 18] = np.einsum("rk,ic->irkc", one, self.gyro).reshape(n, 3, 9)
        J_gyro[:, :, core + 18 : core + 21] = -one
        np.put_along_axis(J_gyro, np.broadcast_to(up_columns[:, None], (n, 3, 2)), -H @ B, axis=2)
        if self.size > 21:
            J_gyro[:, :, core + 21 :] = -np.einsum("rk,ic->irkc", one, x.up).reshape(n, 3, 9)
        gyro = -(self.gyro @ (one + E).T - k - x.up @ H.T - walk_gyro)

        A = np.column_stack([one + E, -k, -H] if self.size > 21 else [one + E, -k])
        W_turn = 0.5 * (W[self.start] + W[self.end])
        rotation = integrate(self.turns, A, 0.5 * (walk_gyro[self.start] + walk_gyro[self.end]))
        v = np.einsum("mji,mj->mi", rotation.R, x.up[self.start])
        J_A = (hat(v) @ rotation.J).reshape(m, 3, 3, A.shape[1])
        J_turn = np.zeros((m, 3, q))
        np.put_along_axis(
            J_turn, np.broadcast_to(up_columns[self.start][:, None], (m, 3, 2)), np.swapaxes(rotation.R, 1, 2) @ B[self.start], axis=2
        )
        np.put_along_axis(J_turn, np.broadcast_to(up_columns[self.end][:, None], (m, 3, 2)), -B[self.end], axis=2)
        J_turn[:, :, 5 * n - 3 : core] = -np.einsum("ms,mrc->mrsc", W_turn, J_A[..., 3]).reshape(m, 3, -1)
        J_turn[:, :, core + 9 : core + 18] = J_A[..., :3].reshape(m, 3, 9)
        J_turn[:, :, core + 18 : core + 21] = -J_A[..., 3]
        if self.size > 21:
            J_turn[:, :, core + 21 :] = -J_A[..., 4:].reshape(m, 3, 9)
        turn = -(v - x.up[self.end])
        return Rows(accel, gyro, turn, J_accel, J_gyro, J_turn)

    def turn_sigma(self) -> Array:
        """Return sigma (m,) rad of each turn's end: white noise integrated, and what grows with the way turned."""
        out: Array = np.sqrt(self.white_gyro**2 * self.turns.duration + self.weights.turn**2 * self.angle)
        return out

    def whitened(self, x: State) -> tuple[Array, Array]:
        """Return residuals (r,) and Jacobian (r, q) in sigmas: stands' accelerometer, gyroscope, turns, walks."""
        return self.whiten(self.rows(x), x)

    def whiten(self, rows: Rows, x: State) -> tuple[Array, Array]:
        """Return the rows in sigmas of the present weights, the walks' rows below them."""
        n, q = self.stands, self.core_size + self.size
        root_accel = np.linalg.inv(np.linalg.cholesky(self.cov_accel + self.weights.misfit**2 * np.eye(3)))
        root_gyro = np.linalg.inv(np.linalg.cholesky(self.cov_gyro + self.weights.wobble**2 * np.eye(3)))
        sigma = self.turn_sigma()[:, None]
        walk = np.concatenate([np.repeat(s * np.sqrt(np.diff(self.time_s)), 3) for s in (self.weights.walk_accel, self.weights.walk_gyro)])
        J_walk = np.zeros((len(walk), q))
        J_walk[np.arange(len(walk)), 2 * n + np.arange(len(walk))] = 1 / walk
        r = [
            np.einsum("nij,nj->ni", root_accel, rows.accel).ravel(),
            np.einsum("nij,nj->ni", root_gyro, rows.gyro).ravel(),
            (rows.turn / sigma).ravel(),
            -np.concatenate([x.step_accel.ravel(), x.step_gyro.ravel()]) / walk,
        ]
        J = [
            (root_accel @ rows.J_accel).reshape(-1, q),
            (root_gyro @ rows.J_gyro).reshape(-1, q),
            (rows.J_turn / sigma[..., None]).reshape(-1, q),
            J_walk,
        ]
        return np.concatenate(r), np.concatenate(J)

    def groups(self) -> Index:
        """Return the group of each row: accelerometer of stand i is i, gyroscope n + i, turn 2 n + k; walks -1."""
        measured = np.repeat(np.arange(2 * self.stands + len(self.start)), 3)
        return np.concatenate([measured, np.full(6 * (self.stands - 1), -1)])

    def robust_weights(self, r: Array) -> tuple[float, Array]:
        """Return the cost and the weight of each row; a group of three rows is down-weighted as one."""
        measured = r[: 3 * (2 * self.stands + len(self.start))].reshape(-1, 3)
        s = np.sum(measured**2, axis=1)
        rho, w = cauchy(s, self.robust)
        walks = r[measured.size :]
        return float(np.sum(rho) + walks @ walks), np.concatenate([np.repeat(w, 3), np.ones(len(walks))])

    def linearize(self, x: State) -> tuple[float, Arrowhead]:
        """Return the cost and the normal equations at x."""
        r, J = self.whitened(x)
        cost, w = self.robust_weights(r)
        c = self.core_size
        if not self.walking:
            c, measured = 2 * self.stands, len(r) - 6 * (self.stands - 1)
            J = np.concatenate([J[:measured, :c], J[:measured, self.core_size :]], axis=1)
            r, w = r[:measured], w[:measured]
        JW = J * w[:, None]
        normal, gradient = JW.T @ J, JW.T @ r
        about = 1 / self.prior**2
        return cost + float(about @ x.theta**2), Arrowhead(
            core=BlockDiagonal(normal[None, :c, :c]),
            border=normal[None, :c, c:],
            corner=normal[c:, c:] + np.diag(about),
            gradient_core=gradient[None, :c],
            gradient_border=gradient[c:] - about * x.theta,
        )

    def retract(self, x: State, core: Array, border: Array) -> State:
        """Return x moved by a step."""
        n = self.stands
        dx = core.ravel()
        up = x.up + np.einsum("nij,nj->ni", tangent(x.up), dx[: 2 * n].reshape(n, 2))
        steps = (dx[2 * n :] if self.walking else np.zeros(6 * (n - 1))).reshape(2, n - 1, 3)
        return State(x.theta + border, up / np.linalg.norm(up, axis=1, keepdims=True), x.step_accel + steps[0], x.step_gyro + steps[1])

    def weighted(self, weights: Weights) -> "StandProblem":
        return replace(self, weights=weights)


def tangent(up: Array) -> Array:
    """Return two unit vectors (n, 3, 2) across each direction (n, 3)."""
    helper = np.eye(3)[np.argmin(np.abs(up), axis=1)]
    first = np.cross(up, helper)
    first = first / np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(up, first)], axis=-1)
