"""Places along a trajectory's segments where an IMU's Jacobians are taken, and what the samples between them make of these."""

from dataclasses import dataclass

import numpy as np

from calibkit.estimation.joint_parts import Index
from calibkit.geometry.so3 import Array
from calibkit.geometry.spline import Knots

_MORE = 1  # places than the order: right to 1e-9 of the normal equations on a hand-held minute, to 1e-5 where every knot jerks
_WORTH = 1.5  # samples a place: with fewer they are the places


@dataclass(frozen=True)
class Places:
    """Where along the segments Jacobians are taken: at the samples, or at fewer places that polynomials L go through.

    K(u) = sum_a L_a(u) K_a, and the samples' products sum_s w K^T K become sum_ab K_a^T (sum_s w L_a(u_s) L_b(u_s)) K_b, a segment's.
    """

    segment: Index  # (g,) sorted
    at: Array | None  # (g m,) s on the reference's clock, m to a segment; None: at the samples
    L: Array  # (n, m) of each sample
    row: Index  # (n,) which of the segments each sample is in
    slot: Index  # (n,) how many of it come before

    @classmethod
    def of(cls, knots: Knots, i: Index, u: Array, many: bool) -> "Places":
        segment, row, count = np.unique(i, return_inverse=True, return_counts=True)
        slot = np.arange(len(i)) - (np.cumsum(count) - count)[row]  # times are sorted
        m = knots.order + _MORE
        if not many or len(i) < _WORTH * m * len(segment):
            return cls(segment, None, np.empty((0, 0)), row, slot)
        nodes = (1 - np.cos((2 * np.arange(m) + 1) * np.pi / (2 * m))) / 2  # Chebyshev's
        L = np.vander(u, m) @ np.linalg.inv(np.vander(nodes))
        return cls(segment, (knots.start + (segment[:, None] + nodes) * knots.spacing).ravel(), L, row, slot)

    def products(self, K: Array, left: Array, weight: Array) -> Array:
        """Return each segment's [K | left]^T w [K | left] (g, q + 1, q + 1) of Jacobians K, residuals left (n, 3) and weights (n,)."""
        g, q = len(self.segment), K.shape[-1]
        N = np.zeros((g, q + 1, q + 1))
        weighted = weight[:, None] * left
        N[:, -1, -1] = np.bincount(self.row, np.sum(weighted * left, axis=1), g)
        if self.at is None:
            rows, w, r = self._padded(K), self._padded(weight[:, None]), self._padded(weighted)
            weighed = w[..., None] * rows
        else:
            L, rows = self._padded(self.L), K.reshape(g, self.L.shape[1], 3, q)
            LT = np.swapaxes(L, 1, 2)
            r = LT @ self._padded(weighted)
            weighed = (LT @ (self._padded(weight[:, None]) * L) @ rows.reshape(g, -1, 3 * q)).reshape(rows.shape)
        KT = np.swapaxes(rows.reshape(g, -1, q), 1, 2)
        N[:, :-1, :-1] = KT @ weighed.reshape(g, -1, q)
        N[:, :-1, -1:] = KT @ r.reshape(g, -1, 1)
        N[:, -1, :-1] = N[:, :-1, -1]
        return N

    def _padded(self, values: Array) -> Array:
        """Return what samples have (n, ...) by segment and slot, 0 where a segment has fewer."""
        out = np.zeros((len(self.segment), int(self.slot.max()) + 1, *values.shape[1:]))
        out[self.row, self.slot] = values
        return out
