"""How the size of residuals grows with something, such as the rotation rate: medians in bins and the line through them."""

from dataclasses import dataclass

import numpy as np

from calibkit.report.view import Array

MAX_BINS = 12
MIN_ROWS = 20  # in a bin, so that its spread is known


@dataclass(frozen=True)
class Growth:
    """Medians of a size over bins of equal numbers of rows along x, and the line at_rest + slope * x through them."""

    x: Array  # (b,) median of each bin
    median: Array  # (b,)
    sigma: Array  # (b,) standard error of the median
    at_rest: float
    slope: float
    slope_sigma: float


def growth(x: Array, size: Array) -> Growth | None:
    """Return how size (n,) >= 0 grows with x (n,); None for fewer than three bins of MIN_ROWS rows or an x that does not vary.

    A median of n values has the standard error 1.253 s / sqrt(n), s = 1.483 times the median distance from it. Where the medians lie off
    the line by more than that, the slope's sigma grows with them.
    """
    known = np.isfinite(x) & np.isfinite(size)
    x, size = x[known], size[known]
    many = min(MAX_BINS, len(x) // MIN_ROWS)
    if many < 3:
        return None
    bins = np.array_split(np.argsort(x, kind="stable"), many)
    at = np.array([np.median(x[rows]) for rows in bins])
    median = np.array([np.median(size[rows]) for rows in bins])
    spread = np.array([np.median(np.abs(size[rows] - m)) for rows, m in zip(bins, median, strict=True)])
    sigma = 1.253 * 1.483 * spread / np.sqrt([len(rows) for rows in bins])
    sigma_safe = np.maximum(sigma, max(1e-6 * float(median.max()), 1e-150))  # of a perfect fit
    unit = float(sigma_safe.min())
    weight = (unit / sigma_safe) ** 2
    x_mean, mean = np.average(at, weights=weight), np.average(median, weights=weight)
    squares = float(np.sum(weight * (at - x_mean) ** 2))
    if squares <= 1e-18 * float(np.max(at**2)):
        return None
    slope = float(np.sum(weight * (at - x_mean) * (median - mean))) / squares
    at_rest = float(mean - slope * x_mean)
    scatter = float(np.sum(weight * (median - at_rest - slope * at) ** 2)) / (many - 2)
    return Growth(at, median, sigma, at_rest, slope, float(np.sqrt(max(scatter, unit**2) / squares)))
