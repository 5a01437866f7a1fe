"""How noisy each sensor is, by what the fit leaves: one variance factor for each kind of measurement (Foerstner 1979)."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from calibkit.estimation.joint_parts import Part
from calibkit.geometry.so3 import Array
from calibkit.solver.arrowhead import Arrowhead
from calibkit.solver.banded import Banded

_THIRD = np.sqrt(20.0)  # sigma of a third difference of white noise
DRAWS = 3  # of the state; a trace of thousands is then known to 1 %


def sample_sigmas(rates: Array) -> Array:
    """Return the sigma of each axis (6,) by the median third difference of samples (n, 6), which motion hardly reaches."""
    differences = np.diff(rates, 3, axis=0)
    sigma: Array = np.median(np.abs(differences), axis=0) / (0.6745 * _THIRD)
    return sigma


@dataclass(frozen=True)
class Drawn:
    """The system at the optimum, and states drawn from N(0, H^-1) about it."""

    core: Array  # (m knot, s)
    border: Array  # (p, s)
    core_answer: Array  # A^-1 B (m knot, p)
    S: Array  # (p, p)


def schur(system: Arrowhead) -> tuple[Array, Array]:
    """Return A^-1 B (m knot, p) and S = C - B^T A^-1 B (p, p)."""
    p = system.corner.shape[0]
    answer = system.core.solve(system.border).reshape(-1, p)
    S: Array = system.corner - system.border.reshape(-1, p).T @ answer
    return answer, S


def draw(system: Arrowhead, draws: int, seed: int = 0) -> Drawn:
    """Return draws dc ~ N(0, S^-1), dx = L^-T white - A^-1 B dc."""
    core = system.core
    assert isinstance(core, Banded)
    rng = np.random.default_rng(seed)
    size, p = core.ab.shape[1], system.corner.shape[0]
    answer, S = schur(system)
    values, vectors = np.linalg.eigh(S)
    root = vectors / np.sqrt(np.maximum(values, values[-1] * 1e-15))
    border = root @ rng.standard_normal((p, draws))
    white = rng.standard_normal((size, draws))
    moved = np.stack([core.draw(white[:, s]) for s in range(draws)], axis=1) - answer @ border
    return Drawn(moved, border, answer, S)


@dataclass(frozen=True)
class Component:
    """One kind of measurement."""

    cost: float  # sum of squared normalised residuals
    rows: int
    spent: float  # of the rows, by the fit: tr(H^-1 H_kind)

    @property
    def factor(self) -> float:
        """Return the real sigma over the one that the weights state."""
        return float(np.sqrt(self.cost / max(self.rows - self.spent, 1.0)))


def components(parts: Iterable[Part], drawn: Drawn) -> dict[str, Component]:
    """Return each kind's component: E d^T H_kind d = tr(H^-1 H_kind) for d ~ N(0, H^-1)."""
    found: dict[str, Component] = {}
    for part in parts:
        d = np.concatenate(
            [drawn.core[part.columns], np.broadcast_to(drawn.border[part.touch], (len(part.first), len(part.touch), DRAWS))], axis=1
        )
        spent = float(np.sum(d * (part.N[:, :-1, :-1] @ d))) / d.shape[-1]
        known = found.get(part.kind, Component(0.0, 0, 0.0))
        found[part.kind] = Component(known.cost + part.cost, known.rows + part.rows, known.spent + spent)
    return found
