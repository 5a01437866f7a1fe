"""The rotation of a gyroscope between stands and its derivatives: a tree of products, all turns at once."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibkit.geometry import so3

Array = NDArray[np.float64]
Index = NDArray[np.intp]


@dataclass(frozen=True)
class Turns:
    """Samples of all turns, one turn after the other, each step the mean of the samples at its two ends."""

    rate: Array  # (s, c) what omega is linear in: omega = A rate - walk
    dt: Array  # (s,) s
    offset: Index  # (m,) first step of each turn
    count: Index  # (m,) steps
    duration: Array  # (m,) s

    @classmethod
    def between(cls, t: Array, signal: Array, first: Index, last: Index) -> "Turns":
        """Return the turns over the samples first ... last (m,), both ends included, of signal (n, c)."""
        count = last - first
        offset = np.cumsum(count) - count
        at = np.arange(int(count.sum())) - np.repeat(offset - first, count)
        return cls(0.5 * (signal[at] + signal[at + 1]), t[at + 1] - t[at], offset, count, t[last] - t[first])


@dataclass(frozen=True)
class Rotations:
    """R_start_end of every turn, and d phi of R exp(phi) by theta."""

    R: Array  # (m, 3, 3)
    J: Array  # (m, 3, 3 c): row-major of the matrix A (3, c) in omega = A rate


def integrate(turns: Turns, A: Array, walk: Array) -> Rotations:
    """Return R = prod exp((A rate_k - walk) dt_k), walk (m, 3) each turn's own bias, and its derivative.

    d phi / d A = sum_k R_k^T J_r(phi_k) dt_k (x) rate_k^T, R_k from step k's end to the turn's.
    Neighbours are joined, R = R_1 R_2 and J = R_2^T J_1 + J_2, until one is left: twice the work of the leaves, and no loop over samples.
    """
    phi = (turns.rate @ A.T - np.repeat(walk, turns.count, axis=0)) * turns.dt[:, None]
    R = so3.exp(phi)
    lever = so3.right_jacobian(phi) * turns.dt[:, None, None]
    J = (lever[:, :, :, None] * turns.rate[:, None, None, :]).reshape(len(phi), 3, -1)
    count = turns.count
    while len(count) and count.max() > 1:
        offset = np.cumsum(count) - count
        halved = (count + 1) // 2
        begin = np.cumsum(halved) - halved
        place = np.arange(int(halved.sum())) - np.repeat(begin, halved)
        left = np.repeat(offset, halved) + 2 * place
        paired = 2 * place + 1 < np.repeat(count, halved)
        right = left[paired] + 1
        R_next, J_next = R[left], J[left]
        R_next[paired] = R_next[paired] @ R[right]
        J_next[paired] = np.swapaxes(R[right], 1, 2) @ J_next[paired] + J[right]
        R, J, count = R_next, J_next, halved
    return Rotations(R, J)
