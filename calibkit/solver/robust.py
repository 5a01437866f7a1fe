"""Robust losses as weights: rho(s) of the squared normalised residual s and w = drho/ds (Triggs et al. 2000)."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def cauchy(s: Array, scale: float) -> tuple[Array, Array]:
    """Return rho = c^2 log(1 + s/c^2) and w = 1 / (1 + s/c^2), c = scale in sigmas; scale inf is plain least squares."""
    if np.isinf(scale):
        return s, np.ones_like(s)
    c2 = scale * scale
    return c2 * np.log1p(s / c2), 1 / (1 + s / c2)


def scale_of_norms(norms: Array) -> float:
    """Return sigma per coordinate from the median of 2-vectors' lengths: Rayleigh's median is sigma sqrt(2 ln 2)."""
    return float(np.median(norms) / np.sqrt(2 * np.log(2))) if len(norms) else 0.0


def scales_of_norms(norms: Array, seen: NDArray[np.bool_]) -> Array:
    """Return `scale_of_norms` of each row of norms (f, n), of what is seen there (f, n); inf where nothing is."""
    count, row = seen.sum(axis=1), np.arange(len(norms))
    in_order = np.sort(np.where(seen, norms, np.inf), axis=1)
    middle = (in_order[row, np.maximum(count - 1, 0) // 2] + in_order[row, np.minimum(count // 2, norms.shape[1] - 1)]) / 2
    out: Array = middle / np.sqrt(2 * np.log(2))
    return out
