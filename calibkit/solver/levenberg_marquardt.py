"""One Levenberg-Marquardt driver for every problem (Marquardt 1963, damping after Nielsen 1999)."""

from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np

from calibkit.solver.arrowhead import Array, Arrowhead

X = TypeVar("X")

_FIRST_DAMPING = 1e-6
_MAX_DAMPING = 1e12
_NOTHING = 1e-22  # squared sigmas: the cost of perfect data is rounding alone, and no step lowers it


class Problem(Protocol[X]):
    """What a least-squares problem must answer."""

    def linearize(self, x: X) -> tuple[float, Arrowhead]:
        """Return the cost (robust r^T W r) and the normal equations at x."""
        ...

    def retract(self, x: X, core: Array, border: Array) -> X:
        """Return x moved by the step of the nuisances (m, k) and of the calibration (p,)."""
        ...


@dataclass(frozen=True)
class Solution(Generic[X]):
    """Where the driver stopped."""

    x: X
    cost: float  # before the last step, which changes it by less than the tolerance
    steps: int
    converged: bool


def minimise(problem: Problem[X], x: X, max_steps: int = 60, tolerance: float = 1e-9, damping: float = _FIRST_DAMPING) -> Solution[X]:
    """Return a local minimum of the problem's cost from x; `damping` is the first.

    Converged when a step that damping has not shortened promises to lower the cost by less than `tolerance` of it, or by nothing.
    That step is still taken, unchecked: near the minimum its error is of second order. A cost that is not finite at the start gives
    an unconverged solution; the caller names the cause.
    """
    cost, system = problem.linearize(x)
    growth = 2.0
    for steps in range(max_steps):
        if not np.isfinite(cost) or damping > _MAX_DAMPING:
            return Solution(x, cost, steps, False)
        try:
            core, border, promised = system.step(damping)
        except np.linalg.LinAlgError:
            damping, growth = damping * growth, growth * 2
            continue
        if promised <= tolerance * cost + _NOTHING:
            return Solution(problem.retract(x, core, border), cost, steps, damping <= 1)
        trial = problem.retract(x, core, border)
        trial_cost, trial_system = problem.linearize(trial)
        gain = (cost - trial_cost) / promised
        if gain > 0 and np.isfinite(trial_cost):
            x, cost, system = trial, trial_cost, trial_system
            damping, growth = max(damping * max(1 / 3, 1 - (2 * gain - 1) ** 3), 1e-15), 2.0
        else:
            damping, growth = damping * growth, growth * 2
    return Solution(x, cost, max_steps, False)
