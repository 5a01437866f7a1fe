"""How far the offset of an alignment is known: covariance, sigma and interval, with all that white noise would leave out."""

from collections.abc import Sequence

import numpy as np

from calibkit.estimation.alignment import Alignment, epochs, sweep
from calibkit.geometry.so3 import Array
from calibkit.solver.trust import SCALES, Covariance, covariance_in_time

_CHI2_95 = 3.841
_PROFILE = 41
_LEAST_SHARE = 1e-6  # of the information that is taken for real


def inflation(covariance: Covariance) -> float:
    """Return what chi-squared is too large by, for residuals that are larger or more correlated than their model."""
    return covariance.variance_factor * max(1.0, float(covariance.factors[0])) ** 2


def sigma_of(a: Alignment, covariance: Covariance, noise_share: float) -> float:
    """Return tau's standard deviation: with correlated residuals, noise in the reference's rates, and the sizes of a clock's jumps."""
    of_tau = _of_tau(covariance, noise_share)
    return max(of_tau, a.clock.sigma_s) if a.clock is not None and a.clock.jumps else of_tau


def _of_tau(covariance: Covariance, noise_share: float) -> float:
    return float(np.sqrt(covariance.corrected[0, 0] / max(1 - noise_share, _LEAST_SHARE)))


def covariance_of(a: Alignment, parts: Sequence[Array]) -> Covariance:
    """Return the covariance (1, 1) of tau."""
    S, g, t = epochs(a, parts)
    rows = sum(len(X) for X in parts)
    unknowns = 1 + 3 * a.free_rotation + sum(part.bias.shape[1] for part in a.parts)
    factor = sum(float(X[:, -1] @ X[:, -1]) for X in parts) / max(1, rows - unknowns)
    return covariance_in_time(S, g, t, factor, np.array([SCALES["s"]]))


def interval(a: Alignment, covariance: Covariance, noise_share: float) -> tuple[float, float]:
    """Return the 95 % interval of tau: where the V has risen by chi-squared's 3.84, for all that sigma holds."""
    wider = sigma_of(a, covariance, noise_share) / _of_tau(covariance, noise_share)
    larger = wider**2 * inflation(covariance) / max(1 - noise_share, _LEAST_SHARE)
    rise, middle = _CHI2_95 * larger, a.tau
    width = 4 * float(np.sqrt(covariance.plain[0, 0] * larger / covariance.variance_factor))
    tau = middle + np.linspace(-width, width, _PROFILE)
    above = sweep(a, tau)
    above = above - above.min() - rise
    centre = int(np.argmin(above))
    return (_crossing(tau, above, centre, -1), _crossing(tau, above, centre, 1))


def _crossing(x: Array, y: Array, start: int, step: int) -> float:
    """Return where y rises through 0 from x[start] on, the end where it does not."""
    k = start
    while 0 <= k + step < len(x) and y[k + step] < 0:
        k += step
    if not 0 <= k + step < len(x):
        return float(x[k])
    return float(x[k] + (x[k + step] - x[k]) * -y[k] / (y[k + step] - y[k]))
