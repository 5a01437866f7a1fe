"""Maps of the board's plane to the image, from the corners already found: homographies, and what a lens bends on top of them."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_NEAR = 0.75  # steps of the board over which neighbours tell where a corner is
_STIFFNESS = 1e-3  # of the bending, so that few neighbours bend nothing
_STIFF = np.diag([1e-9, 1e-6, 1e-6, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3])  # a lone tag's map bends as little as it can
_NEIGHBOURS = 40  # that a local map is made of: further ones would hardly weigh


def apply(H: Array, xy: Array) -> Array:
    """Return homographies (n, 3, 3) of points (m, 2), or of each its own (n, m, 2), as (n, m, 2)."""
    p = xy @ np.swapaxes(H[:, :, :2], 1, 2) + H[:, None, :, 2]
    out: Array = p[..., :2] / np.where(np.abs(p[..., 2:]) < 1e-12, 1e-12, p[..., 2:])
    return out


def middling(values: Array) -> float:
    """Return the upper median, ten times faster than np.median for a few hundred values."""
    k = len(values) // 2
    return float(np.partition(values, k)[k])


def centred(points: Array) -> tuple[Array, Array, float]:
    """Return points (n, 2) about their mean in units of their spread, the mean and the spread."""
    mean = points.sum(0) / len(points)
    d = points - mean
    spread = max(float(np.sqrt(np.vdot(d, d) / d.size)), 1e-6)
    return d / spread, mean, spread


def square_to(corners: Array) -> Array:
    """Return the homographies (n, 3, 3) of the unit square (0,0) (1,0) (1,1) (0,1) to corners (n, 4, 2) (Heckbert 1989)."""
    p0, p1, p2, p3 = np.moveaxis(corners, 1, 0)
    a, b, s = p1 - p2, p3 - p2, p0 - p1 + p2 - p3
    det = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    det = np.where(np.abs(det) < 1e-9, 1e-9, det)
    g = (s[:, 0] * b[:, 1] - s[:, 1] * b[:, 0]) / det
    h = (a[:, 0] * s[:, 1] - a[:, 1] * s[:, 0]) / det
    H = np.ones((len(corners), 3, 3))
    H[:, :2, 0], H[:, :2, 1], H[:, :2, 2] = p1 - p0 + g[:, None] * p1, p3 - p0 + h[:, None] * p3, p0
    H[:, 2, 0], H[:, 2, 1] = g, h
    return H


def homographies(xy: Array, uv: Array, weight: Array) -> Array:
    """Return H (m, 3, 3) with uv ~ H xy by weighted direct linear transformation; xy, uv (n, 2), weight (m, n)."""
    image, shift, scale = centred(uv)
    u, v = image.T
    board, origin, size = centred(xy)
    p = np.concatenate([board, np.ones((len(xy), 1))], axis=1)
    zero = np.zeros_like(p)
    rows = np.stack([np.concatenate([p, zero, -u[:, None] * p], axis=1), np.concatenate([zero, p, -v[:, None] * p], axis=1)], axis=1)
    products = (np.swapaxes(rows, 1, 2) @ rows).reshape(len(xy), 81)
    normal = (weight @ products).reshape(-1, 9, 9) + 1e-12 * np.eye(9)
    # The last element may be 1: the centroid of what is seen never lies on the plane's horizon
    H = np.concatenate([np.linalg.solve(normal[:, :8, :8], -normal[:, :8, 8:])[..., 0], np.ones((len(normal), 1))], axis=1).reshape(
        -1, 3, 3
    )
    back = np.array([[scale, 0, shift[0]], [0, scale, shift[1]], [0, 0, 1]])
    there = np.array([[1 / size, 0, -origin[0] / size], [0, 1 / size, -origin[1] / size], [0, 0, 1]])
    out: Array = back @ H @ there
    return out


def predict(xy: Array, uv: Array, ask: Array, step: float) -> Array:
    """Return where groups of board points `ask` (m, k, 2) are in the image, from known points xy, uv (n, 2) around each group.

    A homography weighted towards the group, and a weighted quadratic through its residuals for what the lens bends;
    `step` is the board's period.
    """
    middle = ask.mean(1, keepdims=True)
    d = (xy - middle) / step
    weight = np.exp(-0.5 * (d**2).sum(-1) / _NEAR**2) + 1e-7
    H = homographies(xy, uv, weight)
    terms = _quadratic(d)
    weighted = np.swapaxes(terms * weight[..., None], 1, 2)
    normal = weighted @ terms + _STIFFNESS * np.eye(6) * weight.sum(1)[:, None, None]
    bend = _quadratic((ask - middle) / step) @ np.linalg.solve(normal, weighted @ (uv - apply(H, xy)))
    out: Array = np.clip(apply(H, ask) + bend, -1e5, 1e5)
    return out


def _quadratic(d: Array) -> Array:
    x, y = d[..., 0], d[..., 1]
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)


@dataclass(frozen=True)
class LocalMaps:
    """Second-order board -> image maps around each corner, in px per unit of the board's coordinates."""

    J: Array  # (n, 2, 2)
    Q: Array  # (n, 3, 2): d2/dx2, d2/dxdy, d2/dy2


@dataclass(frozen=True)
class _Neighbours:
    """What local maps around some corners are made of, whatever image they are in."""

    near: NDArray[np.intp]  # (n, k) corners around each, itself included
    gain: Array  # (n, 6, k) from their uv to the map's J and Q, and to where a stiffer map has the corner
    misfit: Array  # (n,) from a corner's distance to that place, to its distance from where its neighbours alone have it


@lru_cache(maxsize=32)  # most images of a recording show all corners, or those that the one before has shown
def _neighbours(points: bytes, reach: float) -> _Neighbours:
    xy = np.frombuffer(points).reshape(-1, 2)
    near = _nearest(xy, min(_NEIGHBOURS, len(xy)))
    x, y = (xy[near, axis] - xy[:, axis, None] for axis in (0, 1))
    x, y = x / reach, y / reach
    xx, yy = x * x, y * y
    terms = np.stack([np.ones_like(x), x, y, xx / 2, x * y, yy / 2, x * xx / 6, xx * y / 2, x * yy / 2, y * yy / 6], axis=1)
    weighted = terms * np.exp(-(xx + yy) / 2)[:, None]
    normal = weighted @ np.swapaxes(terms, 1, 2)
    units = np.repeat(1 / reach ** np.arange(1, 3), [2, 3])[:, None]
    # A wrong corner at the board's rim would bend a cubic to itself: whether it belongs is asked of the first six terms
    first = _columns(normal[:, :6, :6] + _STIFF[:6, :6], slice(0, 1))
    leverage = np.minimum(first[:, 0, 0], 1 - 1e-6)  # a corner's weight in its own map is 1, its terms are 1, 0, 0, ...
    gain = np.concatenate([units * (_columns(normal + _STIFF, slice(1, 6)) @ weighted), first @ weighted[:, :6]], axis=1)
    return _Neighbours(near, gain, 1 / np.sqrt(1 - leverage))


def _columns(matrix: Array, which: slice) -> Array:
    """Return some columns (n, c, k) of the inverses of symmetric matrices (n, k, k)."""
    k = matrix.shape[-1]
    some = np.eye(k)[:, which]
    return np.swapaxes(np.linalg.solve(matrix, np.broadcast_to(some, (len(matrix), *some.shape))), 1, 2)


def _nearest(xy: Array, k: int) -> NDArray[np.intp]:
    """Return the k points nearest to each of xy (n, 2), itself included, as (n, k)."""
    squares = (xy**2).sum(1)
    near = [np.argpartition(squares - 2 * some @ xy.T, k - 1, axis=1)[:, :k] for some in np.array_split(xy, 1 + len(xy) // 1000)]
    return np.concatenate(near)


def local_maps(xy: Array, uv: Array, reach: float) -> tuple[LocalMaps, Array]:
    """Fit `uv = c + J d + Q(d, d) / 2 + C(d, d, d) / 6` around each corner by least squares with weights exp(-|d|^2 / (2 reach^2)).

    xy (n, 2) in the board's plane, uv (n, 2) px. C is there so that one-sided neighbours at the board's rim do not bend Q: without it
    corners err by 0.001 px together, which is 0.03 px of focal length. Also returns each corner's distance (n,) px to where its
    neighbours alone have it, scaled by how well they can tell: large where a corner does not belong to the pattern.
    """
    around = _neighbours(np.ascontiguousarray(xy, float).tobytes(), reach)
    c = around.gain @ uv[around.near]
    misfit: Array = np.linalg.norm(uv - c[:, 5], axis=-1) * around.misfit
    return LocalMaps(np.swapaxes(c[:, :2], 1, 2), c[:, 2:5]), misfit


def in_line(misfit: Array, allowed_px: Array) -> NDArray[np.bool_]:
    """Return which corners belong to the pattern, from local_maps' misfit (n,) px: a strong lens bends them all, a wrong one stands out."""
    out: NDArray[np.bool_] = misfit < np.maximum(np.maximum(allowed_px, 1), 5 * middling(misfit))
    return out
