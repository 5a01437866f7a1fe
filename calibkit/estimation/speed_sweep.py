"""Residuals against the rate of turn: rms in bins, and sigma(omega)^2 = a^2 + (b omega)^2: a is noise, b grows with wrong times or axes."""

from dataclasses import dataclass

import numpy as np

from calibkit.geometry.so3 import Array

_BINS = 6
_FEWEST = 30  # residuals of a bin


@dataclass(frozen=True)
class Sweep:
    """One sensor's residuals by the rate of turn."""

    rate: Array  # (k,) rad/s, the middle of each bin
    rms: Array  # (k,) of a residual's length
    at_rest: float  # a
    slope: float  # b, per rad/s; negative where it falls: sign(b^2) |b|
    slope_sigma: float  # of b, where it is larger than that, else what it may be at most


def sweep(rate: Array, left: Array) -> Sweep | None:
    """Return the sweep of residuals (n, d) at rates (n,) rad/s; None where there are too few, or all turn alike."""
    edges = np.unique(np.quantile(rate, np.linspace(0, 1, _BINS + 1))) if len(rate) else np.zeros(0)
    if len(edges) < 4 or len(rate) < _BINS * _FEWEST:
        return None
    square, bin_of = np.sum(left**2, axis=1), np.clip(np.searchsorted(edges, rate, side="right") - 1, 0, len(edges) - 2)
    count = np.bincount(bin_of, minlength=len(edges) - 1)
    mean, rate2 = (np.bincount(bin_of, values, len(edges) - 1) / count for values in (square, rate**2))
    scatter = np.sqrt((np.bincount(bin_of, square**2, len(edges) - 1) / count - mean**2) / count)  # of each bin's mean
    A = np.stack([np.ones_like(rate2), rate2], axis=1) / scatter[:, None]
    cov = np.linalg.inv(A.T @ A)
    a2, b2 = cov @ A.T @ (mean / scatter)
    b = float(np.sqrt(abs(b2)))
    sigma2 = float(np.sqrt(cov[1, 1]))
    sigma = sigma2 / (2 * b) if b2 > sigma2 else float(np.sqrt(sigma2))
    return Sweep(np.sqrt(rate2), np.sqrt(mean), float(np.sqrt(max(a2, 0.0))), b if b2 > 0 else -b, sigma)
