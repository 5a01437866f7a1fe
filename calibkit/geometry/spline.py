"""Uniform B-splines of any order on R^3 and, in cumulative form, on SO(3), with analytic Jacobians; batch-first.

x(t) = sum_l B_l(u) x_{i+l},  R(t) = R_i prod_{j=1}^{k-1} exp(lambda_j(u) d_{i+j}),  d_j = log(R_{j-1}^T R_j),
t = t_0 + (i + u) h, lambda_j = sum_{l>=j} B_l (Kim, Kim, Shin 1995; Sommer, Usenko, Schubert, Demmel, Cremers, CVPR 2020). Perturbations
of control points and of what they make are on the right, R exp(d).
"""

from dataclasses import dataclass
from functools import lru_cache
from math import comb, factorial

import numpy as np
from numpy.typing import NDArray

from calibkit.geometry import so3
from calibkit.geometry.so3 import Array

Index = NDArray[np.int64]
_ONE = np.eye(3)


@dataclass(frozen=True)
class Knots:
    """A uniform grid: segment i holds times t_0 + (i + u) h, 0 <= u < 1, and is made by control points i to i + order - 1."""

    start: float  # s, t_0
    spacing: float  # s, h
    order: int  # degree + 1
    segments: int

    @property
    def controls(self) -> int:
        return self.segments + self.order - 1

    def locate(self, t: Array) -> tuple[Index, Array]:
        """Return segment i and u of times (n,) s; beyond either end the outermost segment is continued."""
        x: Array = (np.asarray(t, float) - self.start) / self.spacing
        i = np.clip(np.floor(x).astype(np.int64), 0, self.segments - 1)
        return i, x - i

    def middle(self, i: Index) -> Array:
        """Return the time in the middle of segments i, s."""
        return np.asarray(self.start + self.spacing * (i + 0.5), np.float64)

    def centre(self) -> Array:
        """Return the time (controls,) s about which each control point counts most."""
        return np.asarray(self.start + self.spacing * (np.arange(self.controls) + 1 - self.order / 2), np.float64)


@lru_cache
def blending(order: int) -> Array:
    """Return M (order, order), B_l(u) = sum_n M[l, n] u^n of a uniform B-spline (Qin 2000, eq. 13)."""
    k = order
    M = np.array(
        [
            [comb(k - 1, n) * sum((-1) ** (j - s) * comb(k, j - s) * (k - 1 - j) ** (k - 1 - n) for j in range(s, k)) for n in range(k)]
            for s in range(k)
        ],
        float,
    )
    out: Array = M / factorial(k - 1)
    return out


def basis(knots: Knots, u: Array, derivative: int = 0) -> Array:
    """Return d^r B_l / dt^r (n, order) at u (n,), 1/s^r."""
    powers = np.arange(knots.order)
    factor = np.array([factorial(n) / factorial(n - derivative) if n >= derivative else 0.0 for n in powers])
    u_n = np.where(powers >= derivative, u[:, None] ** np.maximum(powers - derivative, 0), 0.0)
    out: Array = (factor * u_n) @ blending(knots.order).T / knots.spacing**derivative
    return out


def cumulative(values: Array) -> Array:
    """Return lambda_j = sum_{l >= j} B_l (n, order) of basis values (n, order); lambda_0 is 1, or 0 for a derivative."""
    out: Array = np.cumsum(values[:, ::-1], axis=1)[:, ::-1]
    return out


@dataclass(frozen=True)
class Steps:
    """What lies between neighbouring control rotations, the same for every sample of a segment."""

    d: Array  # (m - 1, 3) rad, log(R_{j-1}^T R_j)
    right: Array  # (m - 1, 3, 3) J_r(d)^-1; J_l(d)^-1 is its transpose
    angle2: Array  # (m - 1,) |d|^2
    hat: Array  # (m - 1, 2, 3, 3) hat(d) and its square

    @classmethod
    def of(cls, R: Array) -> "Steps":
        d = so3.log(np.swapaxes(R[:-1], 1, 2) @ R[1:])
        k = so3.hat(d)
        return cls(d, so3.right_jacobian_inverse(d), np.sum(d * d, axis=1), np.stack([k, k @ k], axis=1))


@dataclass(frozen=True)
class Turning:
    """A rotation spline at n times, with its derivatives by the right perturbations of the segment's control rotations."""

    R: Array  # (n, 3, 3)
    omega: Array  # (n, 3) rad/s, body frame
    dR: Array  # (n, 3, order, 3) d(right perturbation of R) by control point; empty where not asked for
    domega: Array  # (n, 3, order, 3) 1/s


def turning(R: Array, steps: Steps, i: Index, value: Array, rate: Array, jacobians: bool = True) -> Turning:
    """Return the rotation and its body rate at samples in segments i (n,), from basis values and first derivatives (n, order).

    omega_j = A_j^T omega_{j-1} + lambda'_j d_j, A_j = exp(lambda_j d_j) (Sommer 2020, eq. 34), and by the chain rule
    d omega / d d_j = P_j^T ([A_j^T omega_{j-1}]x lambda_j J_r(lambda_j d_j) + lambda'_j I), P_j = A_{j+1} ... A_{k-1}; likewise
    d R / d d_j = P_j^T lambda_j J_r(lambda_j d_j).
    """
    n, order = value.shape
    lam, dlam = cumulative(value), cumulative(rate)
    out, omega = R[i], np.zeros((n, 3))
    A, by_step = [], []  # A_j, and of rotation and rate (n, 6, 3) their derivatives by d_j, before what follows
    for j in range(1, order):
        row, share = i + j - 1, lam[:, j]
        # A_j and lambda_j J_r(lambda_j d_j): of one axis, whose matrices are the segment's
        angle2, (k, kk) = share**2 * steps.angle2[row], steps.hat[row].transpose(1, 0, 2, 3)
        first, second = so3.sinc_terms(angle2)
        second *= share**2
        Aj = _ONE + (share * first)[:, None, None] * k + second[:, None, None] * kk
        out = out @ Aj
        omega = (omega[:, None] @ Aj)[:, 0]
        if jacobians:
            third = share**3 * so3.third_term(angle2)
            turned = share[:, None, None] * _ONE - second[:, None, None] * k + third[:, None, None] * kk
            A.append(Aj)
            by_step.append(np.concatenate([turned, so3.hat(omega) @ turned + dlam[:, j, None, None] * _ONE], axis=2))
        omega = omega + dlam[:, j, None] * steps.d[row]
    if not jacobians:
        return Turning(out, omega, np.zeros((0, 3, order, 3)), np.zeros((0, 3, order, 3)))
    # From the last factor back: P^T is what follows.
    both = np.zeros((n, order, 2, 3, 3))
    PT = np.broadcast_to(np.eye(3), (n, 3, 3))
    for j in range(order - 1, 0, -1):
        followed = PT @ by_step[j - 1]
        stacked = np.concatenate([followed[:, :, :3], followed[:, :, 3:]], axis=1)
        right = steps.right[i + j - 1]
        both[:, j] += (stacked @ right).reshape(n, 2, 3, 3)
        both[:, j - 1] -= (stacked @ np.swapaxes(right, 1, 2)).reshape(n, 2, 3, 3)
        PT = PT @ np.swapaxes(A[j - 1], 1, 2)
    both[:, 0, 0] += PT
    by_control = both.transpose(2, 0, 3, 1, 4)
    return Turning(out, omega, by_control[0], by_control[1])
