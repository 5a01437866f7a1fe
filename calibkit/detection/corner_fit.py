"""Sub-pixel corners where black and white squares meet, all corners of a frame at once.

Windows are discs in the board's plane, carried to the image by each corner's local map `p(d) = c + J d + Q(d, d) / 2`, so that they stay
inside the squares however the board is tilted or the lens bends it. Two fits share them: a quadratic saddle finds the corner from
afar, and the point symmetry of the pattern, I(c + d) = I(c - d) for every d in the window, pins it down: it uses every edge pixel, needs
no model of blur or contrast, and its residual is the honest noise. (Saddle: Lucchese & Mitra 2002; symmetry: the property that
Duda & Frese 2018 build on.)
"""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from calibkit.detection.found import Image
from calibkit.detection.plane_maps import LocalMaps, centred, middling
from calibkit.opencv import cv2

Array = NDArray[np.float64]
Smoothed = NDArray[np.float32]

SMOOTHING_PX = 0.85  # Gaussian, before every fit: bilinear sampling of a sharper image errs by 0.01 px
_BLUR_PX2 = SMOOTHING_PX**2 + 0.35  # with what optics and pixels usually add
FLOOR_PX = 0.005  # sampling error that stays without any noise
_KERNEL = cv2.getGaussianKernel(7, SMOOTHING_PX, cv2.CV_32F)
_MUCH_WORSE = 12.0  # than the frame's typical sigma: something else is in the window
_STILL_PX = 0.03  # a longer last step: there the derivatives are not those of the place where it began
_MAX_WINDOW_PX = 8.0  # samples of wider windows would lie too far apart for the smoothing
_MIN_WINDOW_PX = 2.0
_SHRINK = 0.5  # of a saddle window wider than that, each iteration
_LIGHT_STIFF = np.diag([1e-9, 1.0, 1.0, 3.0, 3.0, 3.0])  # of few corners' light: it is even until they say otherwise


def smooth(image: Image) -> Smoothed:
    """Return the image as the fits want it: float32, Gaussian-smoothed."""
    return np.asarray(cv2.sepFilter2D(image, cv2.CV_32F, _KERNEL, _KERNEL), np.float32)


def sample(image: Smoothed, uv: Array) -> Smoothed:
    """Return the image's values (n,) or (n, m) at pixels (n, 2) or (n, m, 2), rounded to 1/32 px, bilinear, the border repeated."""
    u, v = np.moveaxis(uv, -1, 0)
    return _near(image, u, v) if u.ndim == 2 else _near(image, u[:, None], v[:, None])[:, 0]


def _near(image: Smoothed, u: Array, v: Array) -> Smoothed:
    if not u.size:
        return np.zeros(u.shape, np.float32)
    return np.asarray(cv2.remap(image, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def _at(image: Smoothed, u: Array, v: Array) -> Smoothed:
    """Return what `_near` does at places that are not rounded."""
    h, w = image.shape
    x, y = np.minimum(np.maximum(u, 0), w - 1.001), np.minimum(np.maximum(v, 0), h - 1.001)
    column, row = x.astype(np.intp), y.astype(np.intp)
    x -= column
    y -= row
    right, down = x.astype(np.float32), y.astype(np.float32)
    row *= w
    row += column
    flat = image.ravel()
    top, bottom = flat.take(row), flat.take(row + w)
    row += 1
    top += right * (flat.take(row) - top)
    row += w
    bottom += right * (flat.take(row) - bottom)
    out: Smoothed = top + down * (bottom - top)
    return out


def _to_border(image: Smoothed, uv: Array) -> Array:
    out: Array = np.minimum(uv, np.array(image.shape[::-1]) - 1 - uv).min(-1)
    return out


def _disc(n: int) -> Array:
    axis = np.linspace(-1, 1, n)
    points = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    inside: Array = points[(points**2).sum(1) <= 1 + 1e-9]
    return inside


_WINDOW = _disc(9)
_HALF = _WINDOW[(_WINDOW[:, 1] > 1e-9) | ((np.abs(_WINDOW[:, 1]) < 1e-9) & (_WINDOW[:, 0] > 1e-9))]  # one of each pair d, -d
_SQUARES = np.stack([_HALF[:, 0] ** 2 / 2, _HALF[:, 0] * _HALF[:, 1], _HALF[:, 1] ** 2 / 2], axis=-1)
_WEIGHT = np.exp(-0.5 * (_HALF**2).sum(1))  # square root of the pair's weight
_QUADRATIC = np.linalg.pinv(
    np.stack([np.ones(len(_WINDOW)), *_WINDOW.T, _WINDOW[:, 0] ** 2, _WINDOW[:, 0] * _WINDOW[:, 1], _WINDOW[:, 1] ** 2], axis=1)
)
_CURVATURE = np.linalg.pinv(np.stack([np.ones(len(_HALF)), _HALF[:, 0] ** 2, _HALF[:, 0] * _HALF[:, 1], _HALF[:, 1] ** 2], axis=1))


def saddle(image: Smoothed, uv: Array, J: Array, bright: Array | float = 0.0, iterations: int = 3) -> tuple[Array, NDArray[np.bool_]]:
    """Return corners (n, 2) at the saddle of a quadratic fitted to the window uv + J d, |d| <= 1, and where there is one.

    J (n, 2, 2) carries the unit disc to pixels; a start up to about one window radius off converges. `bright` (n,) is the sign of x y
    where the squares are white, 0 for either.
    """
    uv = uv.copy()
    long, _ = _extent(np.swapaxes(J, 1, 2) @ J)
    size = np.clip(_to_border(image, uv) / long, 0.3, 1)
    smallest = np.minimum(size, _MAX_WINDOW_PX / long)
    found = np.ones(len(uv), bool)
    for k in range(iterations):
        window = np.maximum(size * _SHRINK**k, smallest)[:, None, None] * J
        u, v = (uv[:, axis, None] + window[:, axis] @ _WINDOW.T for axis in (0, 1))
        _, gx, gy, a, b, c = (_near(image, u, v) @ _QUADRATIC.T).T
        det = 4 * a * c - b * b
        found = (det < 0) & (b * bright >= 0)
        det = np.where(found, det, -np.inf)
        step = np.stack([b * gy - 2 * c * gx, b * gx - 2 * a * gy], axis=-1) / det[:, None]
        step /= np.maximum(1, np.abs(step).max(1, keepdims=True))
        uv += (window @ step[..., None])[..., 0]
    return uv, found


@dataclass(frozen=True)
class CornerFit:
    """Corners by point symmetry."""

    uv: Array  # (n, 2) px
    sigma_px: Array  # (n,) px per coordinate
    ok: NDArray[np.bool_]  # (n,) a symmetric pattern with contrast in both directions, near the start


def symmetry(image: Smoothed, uv: Array, maps: LocalMaps, radius: float, bright: Array | float = 0.0, iterations: int = 2) -> CornerFit:
    """Minimise sum_d w(d) [I(c + d) - I(c - d)]^2 over c by Gauss-Newton, d over half a disc of `radius` in the board's plane.

    `bright` as for `saddle`. The covariance is propagated from the image noise through the same weights, the noise from the residuals:
    N^-1 (J^T W C W J) N^-1 with C the correlation that smoothing leaves between samples.
    """
    metric = np.swapaxes(maps.J, 1, 2) @ maps.J
    long, short = _extent(metric)
    room = np.clip(_to_border(image, uv), _MIN_WINDOW_PX, _MAX_WINDOW_PX)
    scale = np.minimum(np.clip(_MIN_WINDOW_PX / short, radius, 1.5 * radius), room / long)
    odd = scale[:, None] * (np.swapaxes(maps.J, 0, 1) @ _HALF.T)
    even = scale[:, None] ** 2 * (np.moveaxis(maps.Q, 2, 0) @ _SQUARES.T)
    points = np.concatenate([even + odd, even - odd], axis=2)  # d and then -d of each pair, px from the corners
    fit = _descend(image, uv, points, None, iterations)
    far = np.abs(fit.step).max(1) > _STILL_PX
    if far.any():
        again = _descend(image, fit.uv[far], points[:, far], fit.light[far], iterations)
        for field in fields(fit):
            getattr(fit, field.name)[far] = getattr(again, field.name)

    first, second = fit.values[:, : len(_HALF)], fit.values[:, len(_HALF) :]
    mean = ((first + second) @ _WEIGHT**2 / (2 * (_WEIGHT**2).sum()))[:, None]
    signal = ((first - mean) ** 2 + (second - mean) ** 2) @ _WEIGHT**2
    _, a, b, c = ((first + second) @ _CURVATURE.T).T
    ok = (
        (4 * a * c < b * b) & (b * bright >= 0) & (fit.residual < 0.5 * signal) & np.isfinite(fit.uv).all(1)
    )  # a dark square's middle is symmetric too, but no saddle
    ok &= (_to_border(image, fit.uv) > _MIN_WINDOW_PX) & (np.linalg.norm(fit.uv - uv, axis=1) < 0.5 * scale * long + 1)
    sigma = _sigma(fit.residual / (_WEIGHT**2).sum() / 2, fit.gain, scale[:, None, None] ** 2 * metric, ok)
    if ok.any():
        ok &= sigma < _MUCH_WORSE * middling(sigma[ok])
    corner = fit.uv - _drawn_by_blur(maps)
    return CornerFit(corner, sigma, ok & np.isfinite(corner).all(1))


@dataclass(frozen=True)
class _Descent:
    """Where the descent has led each corner."""

    uv: Array  # (n, 2) px
    step: Array  # (n, 2) px, the last one
    values: Smoothed  # (n, 2 pairs) of the windows in even light, before that step
    residual: Array  # (n,) weighted sum of squares
    gain: Array  # (n, 2, pairs) from differences to steps
    light: Array  # (n, 2 pairs) factors that make it even


def _descend(image: Smoothed, uv: Array, points: Array, light: Array | None, iterations: int) -> _Descent:
    """Move corners uv (n, 2) by Gauss-Newton; points (2, n, 2 pairs) px are the windows, `light` is found where it is None."""
    u, v = uv.T[:, :, None] + points
    # OpenCV's samples, rounded to 1/32 px, are good enough to steer by; the last step's are not rounded
    right, left, below, above = (_near(image, u + x, v + y) for x, y in ((0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5)))
    if light is None:
        slope = _light_slope(uv, (right + left + below + above).sum(1) / len(_HALF))
        light = 1 - points[0] * slope[:, :1] - points[1] * slope[:, 1:]
    x, y = (_WEIGHT * _difference(ahead - behind) for ahead, behind in ((right, left), (below, above)))
    xx, xy, yy = ((a * b).sum(1)[:, None] for a, b in ((x, x), (x, y), (y, y)))
    stiff = np.maximum(1e-9, 1e-6 * (xx + yy))
    xx, yy = xx + stiff, yy + stiff
    gain = np.stack([yy * x - xy * y, xx * y - xy * x], axis=1) / (xx * yy - xy**2)[:, None]
    uv = uv.copy()
    for to_come in reversed(range(iterations)):
        values = (_near if to_come else _at)(image, uv[:, :1] + points[0], uv[:, 1:] + points[1]) * light
        odd_part = _difference(values) * _WEIGHT
        step = np.clip((gain @ odd_part[..., None])[..., 0], -1, 1)
        uv -= step
    residual = ((odd_part - x * step[:, :1] - y * step[:, 1:]) ** 2).sum(1)
    return _Descent(uv, step, values, residual, gain, light)


def _difference(values: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return what the first point of each pair has more than the second, of values (n, 2 pairs)."""
    return values[:, : len(_HALF)] - values[:, len(_HALF) :]


def _light_slope(uv: Array, level: Array) -> Array:
    """Return the relative slope (n, 2) per px of the light, from the mean gray level (n,) of each corner's window.

    A slope breaks the symmetry: it draws corners by some 0.004 px, along the edges and with the sign of the pattern.
    """
    d, _, spread = centred(uv)
    terms = np.stack([np.ones(len(d)), *d.T, d[:, 0] ** 2, d[:, 0] * d[:, 1], d[:, 1] ** 2], axis=1)
    _, x, y, xx, xy, yy = np.linalg.solve(terms.T @ terms + _LIGHT_STIFF, terms.T @ level)
    rise = np.stack([x + 2 * xx * d[:, 0] + xy * d[:, 1], y + xy * d[:, 0] + 2 * yy * d[:, 1]], axis=-1)
    out: Array = rise / spread / np.maximum(level, 1e-9)[:, None]
    return out


def _drawn_by_blur(maps: LocalMaps) -> Array:
    """Return by how much (n, 2) px blur has moved the corners: it draws a bent edge towards its centre of curvature by s^2 / 2 |bend|.

    The edges run along the board's axes; an edge p(d) bends by n . p'' / |p'|^2 along its normal n, and both shifts hold at the corner.
    """
    along, bend = np.swapaxes(maps.J, 1, 2), maps.Q[:, [0, 2]]  # (n, edge, 2)
    normal = np.stack([-along[..., 1], along[..., 0]], axis=-1)
    shift = _BLUR_PX2 / 2 * np.sum(bend * normal, axis=-1, keepdims=True) / np.sum(along**2, axis=-1, keepdims=True)
    (a, b), (c, d), (p, q) = normal[:, 0].T, normal[:, 1].T, shift[..., 0].T
    out: Array = np.stack([d * p - b * q, a * q - c * p], axis=-1) / (a * d - b * c)[:, None]
    return out


def _extent(metric: Array) -> tuple[Array, Array]:
    """Return the long and short half axes (n,) px of the ellipses that J makes of the unit disc, from J^T J."""
    mean = (metric[:, 0, 0] + metric[:, 1, 1]) / 2
    spread = np.hypot((metric[:, 0, 0] - metric[:, 1, 1]) / 2, metric[:, 0, 1])
    return np.sqrt(np.maximum(mean + spread, 1e-12)), np.sqrt(np.maximum(mean - spread, 1e-12))


def _pair_terms(sign: int) -> Array:
    difference = (_HALF[:, None] + sign * _HALF[None]).reshape(-1, 2)
    return np.stack([difference[:, 0] ** 2, 2 * difference[:, 0] * difference[:, 1], difference[:, 1] ** 2]).astype(np.float32)


_APART, _ACROSS = _pair_terms(-1), _pair_terms(1)  # |J (d_k -+ d_l)|^2 is linear in J^T J


def _sigma(variance: Array, gain: Array, metric: Array, ok: NDArray[np.bool_]) -> Array:
    """Return sigma per coordinate (n,) from the smoothed image's noise variance per corner, shrunk towards the frame's own.

    Samples at a distance r share exp(-r^2 / 4 s^2) of their noise, s the smoothing; `metric` is J^T J of the window.
    """
    typical = middling(variance[ok]) if ok.any() else 0.0
    noise = 0.5 * (variance + typical)
    shape = (len(gain), len(_HALF), len(_HALF))
    decay = np.stack([metric[:, 0, 0], metric[:, 0, 1], metric[:, 1, 1]], axis=-1).astype(np.float32) / -(4 * (SMOOTHING_PX**2 + 0.15))
    correlation = (np.exp(decay @ _APART) - np.exp(decay @ _ACROSS)).reshape(shape)
    weighted = (gain * _WEIGHT).astype(np.float32)
    covariance = ((weighted @ correlation) * weighted).sum((1, 2))  # its trace
    out: Array = np.sqrt(noise * covariance + FLOOR_PX**2)  # 2 (samples of a pair) / 2 (coordinates)
    return out
