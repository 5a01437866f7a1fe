"""The normal matrix of every batch problem: a large sparse core of nuisances and a small border of calibration parameters.

[ A    B ] [dx]   [g_x]      A: core, B: coupling, C: corner (p, p)
[ B^T  C ] [dc] = [g_c]      S = C - B^T A^-1 B is the information about the calibration once the nuisance is paid for
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Core(Protocol):
    """The nuisance part A of the normal matrix, kept in its own storage."""

    def damped(self, factor: float) -> "Core":
        """Return A + factor diag(A)."""
        ...

    def solve(self, right: Array) -> Array:
        """Return A^-1 right for right of shape (m, k, q)."""
        ...


@dataclass(frozen=True)
class BlockDiagonal:
    """m independent k x k blocks: poses that share nothing but the calibration."""

    blocks: Array  # (m, k, k)

    def damped(self, factor: float) -> "BlockDiagonal":
        diagonal = np.einsum("mii->mi", self.blocks)
        return BlockDiagonal(self.blocks + factor * diagonal[:, :, None] * np.eye(self.blocks.shape[-1]))

    def solve(self, right: Array) -> Array:
        return np.asarray(np.linalg.solve(self.blocks, right), np.float64)


@dataclass(frozen=True)
class Arrowhead:
    """Normal equations H d = g with g = J^T W r, so that d is the Gauss-Newton step."""

    core: Core
    border: Array  # B (m, k, p)
    corner: Array  # C (p, p)
    gradient_core: Array  # (m, k)
    gradient_border: Array  # (p,)

    def step(self, damping: float = 0.0) -> tuple[Array, Array, float]:
        """Return (dx, dc, at least this decrease of the cost r^T W r predicted) of H + damping diag(H) (Marquardt 1963)."""
        core = self.core.damped(damping) if damping else self.core
        corner = self.corner + damping * np.diag(np.diag(self.corner))
        solved = core.solve(np.concatenate([self.border, self.gradient_core[:, :, None]], axis=2))
        A_B, A_g = solved[:, :, :-1], solved[:, :, -1]
        S = corner - np.tensordot(self.border, A_B, axes=([0, 1], [0, 1]))
        right = self.gradient_border - np.tensordot(self.border, A_g, axes=([0, 1], [0, 1]))
        # By C and not by S: what the core wholly stands in for has rounding alone in S, which would be scaled up to 1.
        scale = 1 / np.sqrt(np.maximum(np.diag(corner), np.finfo(float).tiny))
        dc = scale * np.linalg.lstsq(S * scale[:, None] * scale, right * scale, rcond=1e-15)[0]
        dx = A_g - A_B @ dc
        # 2 g.d - d.H d = g.d + damping d.diag(H) d; the last term is left out: a lower bound.
        decrease = float(np.sum(self.gradient_core * dx) + self.gradient_border @ dc)
        return dx, dc, decrease
