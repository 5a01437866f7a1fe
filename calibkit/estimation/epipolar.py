"""Rotation between two views from matched rays, the translation eliminated: many pairs at once, padded to the same number of points.

With g = R f_2 (R = R_1_2), e = J g the displacement in px of image 1 (J = duv/dray at f_1, so J f_1 = 0) and d = J t, where the
epipolar line points, the residual is the displacement across that line, scaled to have one coordinate's noise in one image,
    s = (e_x d_y - e_y d_x) / (sqrt(2) |d|),
zero exactly where f_1, g and t are coplanar: the maximum likelihood of (R, t) for pixel noise (Sampson 1982; Kanatani 1996), depths free.
Shapes: p pairs, n points, s starts. Rays (p, 3, n), J (p, 2, 3, n), weights (p, n).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibkit.geometry import so3

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_SQRT2 = np.sqrt(2.0)
_TINY = 1e-300
_DIRECTIONS = 128  # of the translation, over half a sphere: 0.22 rad apart
_NEIGHBOURS = 6
_MEDIAN_OF_NORMAL = 0.6745  # of |x| for sigma 1
CUT = 3.0  # sigmas: what lies beyond is a wrong track
TRUNCATED = 0.9733  # variance of a normal variable cut there
_CAUCHY = 2.4  # sigmas
_FAITHFUL = 0.75  # of a track's pairs
_LONGEST = 0.3  # rad, of one step
_FLAT = 2.5  # times the noise's variance about a plane: not told from one
_LEVEL = 0.05  # of the parallax, or so near to a plane that a calibration's or a tracker's errors hide it
_EXCLUDED = 10.0  # sqrt(points) in chi-squared of points behind the cameras


@dataclass(frozen=True)
class Matches:
    """Rays of the same points in the two views of p pairs."""

    first: Array  # (p, 3, n) unit rays in view 1
    last: Array  # (p, 3, n) unit rays in view 2
    J: Array  # (p, 2, 3, n) px of view 1 per unit of its ray, J first = 0
    given: Array  # (p, n) 1 where there is a point, 0 where padded
    track: NDArray[np.intp]  # (p, n) which track it is of, numbered from 0


@dataclass(frozen=True)
class Residuals:
    """Residuals of matches at one (R, t), and what their derivatives are made of."""

    across: Array  # (p, n) px, s above
    along: Array  # (p, n) px, likewise along the line; positive where the point is before the cameras
    g: Array  # (p, 3, n)
    q: Array  # (p, 3, n), s = q . g, ds/dR = g x q for R <- exp(hat(w)) R
    depth: Array  # (p, n), ds/dt = depth q; the point's inverse distance from view 2 in units of the baseline
    length: Array  # (p, n) |d| px, along = depth |d| / sqrt(2)
    normal: Array  # (p, 2, n) unit vector across the line


def residuals(m: Matches, R: Array, t: Array) -> Residuals:
    """Return the residuals of each pair at its R (p, 3, 3), t (p, 3)."""
    g = R @ m.last
    e = np.einsum("pkcn,pcn->kpn", m.J, g)
    d = np.einsum("pkcn,pc->kpn", m.J, t)
    length = np.sqrt(d[0] ** 2 + d[1] ** 2) + _TINY
    d /= length
    across = (e[0] * d[1] - e[1] * d[0]) / _SQRT2
    along = -(e[0] * d[0] + e[1] * d[1]) / _SQRT2
    q = (m.J[:, 0] * d[1][:, None] - m.J[:, 1] * d[0][:, None]) / _SQRT2
    return Residuals(across, along, g, q, along * (_SQRT2 / length), length, np.stack([d[1], -d[0]], axis=1))


def _cross(a: Array, b: Array) -> Array:
    """Return a x b for planes (p, 3, n)."""
    out = np.empty_like(a)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[:, i] = a[:, j] * b[:, k] - a[:, k] * b[:, j]
    return out


def tangent_basis(t: Array) -> Array:
    """Return two unit vectors (p, 3, 2) perpendicular to each t (p, 3)."""
    least = np.eye(3)[np.argmin(np.abs(t), axis=-1)]
    a = np.cross(t, least)
    a /= np.linalg.norm(a, axis=-1, keepdims=True)
    return np.stack([a, np.cross(t, a)], axis=-1)


def jacobian(r: Residuals, basis: Array) -> Array:
    """Return d across / d(rotation, translation's direction), (p, 5, n)."""
    dt = np.swapaxes(basis, -1, -2) @ r.q
    return np.concatenate([_cross(r.g, r.q), dt * r.depth[:, None]], axis=1)


def scale(size: Array, given: Array) -> Array:
    """Return the median of sizes (p, n) over the points that are given, (p,)."""
    ordered = np.sort(np.where(given > 0, size, np.inf), axis=-1)
    middle = (given.sum(axis=-1).astype(int) // 2).clip(0, size.shape[1] - 1)
    out: Array = np.maximum(np.take_along_axis(ordered, middle[:, None], axis=-1)[:, 0], 1e-12)
    return out


def sigma_of(across: Array, given: Array) -> Array:
    """Return sigma in px of each pair (p,), wrong tracks in it or not."""
    return scale(np.abs(across), given) / _MEDIAN_OF_NORMAL


def _cauchy(across: Array, given: Array) -> Array:
    return given / (1 + (across / (_CAUCHY * sigma_of(across, given)[:, None])) ** 2)


def _solve(H: Array, b: Array) -> Array:
    """Return H^-1 b (p, k); what nothing determines stays put."""
    k = H.shape[-1]
    size = np.trace(H, axis1=-2, axis2=-1)[:, None, None] / k + _TINY
    out: Array = np.linalg.solve(H + 1e-12 * size * np.eye(k), b[..., None])[..., 0]
    return out


def _inverse(H: Array) -> Array:
    """Return H^-1 (p, k, k), no eigenvalue of H taken as less than a millionth of the largest."""
    values, vectors = np.linalg.eigh(H)
    out: Array = (vectors / np.maximum(values, 1e-6 * values[:, -1:] + _TINY)[:, None]) @ np.swapaxes(vectors, -1, -2)
    return out


def rotation_only(m: Matches, steps: int = 6) -> tuple[Array, Array, Array]:
    """Return R (p, 3, 3) that least squares gives when nothing translates, its covariance (p, 3, 3) and the points' weights (p, n).

    e = J g, de/dw = g x J, Cauchy weights on |e|; started at the rotation nearest to sum f_1 f_2^T (Arun 1987).
    """
    R = so3.project((m.first * m.given[:, None]) @ np.swapaxes(m.last, -1, -2))
    for step in range(steps + 1):
        g = R @ m.last
        e = np.einsum("pkcn,pcn->pkn", m.J, g)
        length = np.sqrt(np.sum(e * e, axis=1))
        w = m.given / (1 + (length / (2 * scale(length, m.given)[:, None])) ** 2)
        rows = [_cross(g, m.J[:, k]) for k in range(2)]
        H = sum((row * w[:, None]) @ np.swapaxes(row, -1, -2) for row in rows)
        scores = [row * (w * e[:, k])[:, None] for k, row in enumerate(rows)]
        if step < steps:
            R = so3.exp(-_solve(H, sum(score.sum(axis=-1) for score in scores))) @ R
    score = scores[0] + scores[1]
    # The mean derivative of a score w(|e|) e in two dimensions is w^2 for Cauchy's w.
    slope = sum((row * (w * w)[:, None]) @ np.swapaxes(row, -1, -2) for row in rows)
    inverse = _inverse(slope)
    return R, inverse @ (score @ np.swapaxes(score, -1, -2)) @ inverse, w


def _half_sphere(n: int) -> Array:
    """Return n directions (n, 3) spread evenly over half a sphere (Fibonacci's spiral)."""
    k = np.arange(n) + 0.5
    z, angle = k / n, np.pi * (1 + np.sqrt(5)) * k
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=-1)


_T: Array = _half_sphere(_DIRECTIONS)
_NEAREST = np.argsort(-np.abs(_T @ _T.T), axis=-1)[:, 1 : 1 + _NEIGHBOURS]  # t and -t are one


def starts(m: Matches, R: Array, weights: Array, n_starts: int) -> tuple[Array, Array]:
    """Return the best n_starts local minima over the translation's direction, R (s, p, 3, 3) and t (s, p, 3), R linearised about the given.

    sqrt(2) |d| s = t . n, n = k f_1 x (g + w x g), so sum (t . n)^2 is quadratic in w at each t: sums over the points once, then one 3 x 3
    solve a direction (as Heeger and Jepson 1992 search), over sum 2 |d|^2, its expectation for noise of 1 px.
    """
    p, f, g = len(R), m.first, R @ m.last
    k = np.sum(f * _cross(m.J[:, 0], m.J[:, 1]), axis=1)
    Z = np.empty((p, 3, 4, f.shape[-1]))
    Z[:, :, 0] = _cross(f, g)
    Z[:, :, 1:] = -g[:, :, None] * f[:, None, :]
    dot = np.sum(f * g, axis=1)
    for i in range(3):
        Z[:, i, 1 + i] += dot
    Z = (Z * k[:, None, None]).reshape(p, 12, -1)
    S = ((Z * weights[:, None]) @ np.swapaxes(Z, -1, -2)).reshape(p, 3, 4, 3, 4)
    TT = (_T[:, :, None] * _T[:, None, :]).reshape(-1, 9)
    Q = (TT @ S.transpose(0, 1, 3, 2, 4).reshape(p, 9, 16)).reshape(p, -1, 4, 4)
    lines = np.einsum("pkcn,pn,pkdn->pcd", m.J, weights, m.J, optimize=True).reshape(p, 9)
    w = -_solve(Q[..., 1:, 1:].reshape(-1, 3, 3), Q[..., 1:, 0].reshape(-1, 3)).reshape(p, -1, 3)
    cost = (Q[..., 0, 0] + np.sum(Q[..., 0, 1:] * w, axis=-1)) / (2 * lines @ TT.T + _TINY)
    lowest = np.where(cost <= cost[:, _NEAREST].min(axis=-1), cost, np.inf)
    chosen = np.argsort(lowest, axis=-1)[:, :n_starts].T
    return so3.exp(w[np.arange(p), chosen]) @ R, _T[chosen]


def refine(m: Matches, R: Array, t: Array, steps: int, keep: Array | None = None) -> tuple[Array, Array]:
    """Return (R, t) after Gauss-Newton steps: on the points to keep (p, n), or on all with Cauchy's weights."""
    for _ in range(steps):
        r, basis = residuals(m, R, t), tangent_basis(t)
        J = jacobian(r, basis)
        Jw = J * (_cauchy(r.across, m.given) if keep is None else keep)[:, None]
        step = -_solve(Jw @ np.swapaxes(J, -1, -2), (Jw @ r.across[..., None])[..., 0])
        step *= np.minimum(1, _LONGEST / (np.linalg.norm(step, axis=-1, keepdims=True) + _TINY))
        R = so3.exp(step[:, :3]) @ R
        t = t + (basis @ step[:, 3:, None])[..., 0]
        t /= np.linalg.norm(t, axis=-1, keepdims=True)
    return R, t


def choose(m: Matches, candidates: list[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Return each pair's best R and t, the sign of t such that the points lie before the cameras.

    The fit is chi-squared across the lines, and along them for points behind the cameras.
    """
    R, t = (np.stack(parts) for parts in zip(*candidates, strict=True))
    found = [residuals(m, *candidate) for candidate in candidates]
    sigma = np.min([sigma_of(r.across, m.given) for r in found], axis=0)[:, None]
    fit = np.array([[_chi_squared(r.across, side * r.along, m.given, sigma) for r in found] for side in (1.0, -1.0)])
    best, pairs = np.argmin(fit.min(axis=0), axis=0), np.arange(len(m.first))
    side = np.where(fit[0, best, pairs] <= fit[1, best, pairs], 1.0, -1.0)
    return R[best, pairs], t[best, pairs] * side[:, None]


def two_fold(m: Matches, R: Array, t: Array, keep: Array) -> Mask:
    """Return where (p,) another solution fits as well: on a plane, whose inverse distances are a . g, (a, t) and (t, a) make the same flow.

    The other rotation differs (Longuet-Higgins 1984), and only points that it puts behind the cameras, t . g < 0, tell it
    from the true one.
    """
    r = residuals(m, R, t)
    n = np.maximum(keep.sum(axis=-1), 6)
    variance = np.sum(keep * r.across**2, axis=-1) / (n - 5)
    columns = r.g * (r.length / _SQRT2)[:, None]
    weighted = columns * keep[:, None]
    a = _solve(weighted @ np.swapaxes(columns, -1, -2), (weighted @ r.along[..., None])[..., 0])
    off = r.along - (a[:, None] @ columns)[:, 0]
    bent = np.sum(keep * off**2, axis=-1)
    flat = (bent < _FLAT * n * variance) | (bent < _LEVEL**2 * np.sum(keep * r.along**2, axis=-1))
    mirrored = np.sum(r.g * t[..., None], axis=1) * np.linalg.norm(np.einsum("pkcn,pc->pkn", m.J, a), axis=1) / _SQRT2
    behind = [np.sum(keep * np.minimum(side * mirrored, 0) ** 2, axis=-1) for side in (1.0, -1.0)]
    out: Mask = flat & (np.minimum(*behind) < _EXCLUDED * np.sqrt(n) * variance)
    return out


def _chi_squared(across: Array, along: Array, given: Array, sigma: Array) -> Array:
    total: Array = np.sum(given * np.minimum((across**2 + np.minimum(along, 0) ** 2) / sigma**2, CUT**2), axis=-1)
    return total


def agreeing(m: Matches, R: Array, t: Array) -> Array:
    """Return 1 for points (p, n) within CUT sigmas of their epipolar line, no farther behind the cameras, as is most of their track."""
    r = residuals(m, R, t)
    sigma = sigma_of(r.across, m.given)[:, None]
    alone = m.given * (np.abs(r.across) < CUT * sigma) * (r.along > -CUT * sigma)
    # What slides along the line in one pair leaves it in another: a track is right or wrong as a whole.
    seen, agreed = (np.bincount(m.track.ravel(), weights.ravel()) for weights in (m.given, alone))
    out: Array = alone * (agreed > _FAITHFUL * seen)[m.track]
    return out


@dataclass(frozen=True)
class Trust:
    """How far the rotations of p pairs may be trusted."""

    cov: Array  # (p, 3, 3) rad^2, of R <- exp(hat(w)) R
    influence: Array  # (p, 3, n) rad per px of residual
    sigma: Array  # (p,) px
    parallax: Array  # (p,) px rms along the lines, without the noise
    across: Array  # (p, n) px
    normal: Array  # (p, 2, n)


def trust(m: Matches, R: Array, t: Array, keep: Array) -> Trust:
    """Return the covariance A^-1 B A^-1 sigma^2 and what it is made of, on the points kept.

    B = sum J J^T. Depths come from the same noisy points; the expected Hessian A lacks their noise in the translation's block,
    A = B - sigma^2 sum (d phi/dt)(d phi/dt)^T with phi the line's direction, for d^2 (s^2/2) / d phi^2 = along^2 - across^2
    (incidental parameters, Neyman and Scott 1948).
    """
    r, basis = residuals(m, R, t), tangent_basis(t)
    J = jacobian(r, basis)
    n = np.maximum(keep.sum(axis=-1), 6)
    variance = np.sum(keep * r.across**2, axis=-1) / (n - 5) / TRUNCATED
    JT = np.swapaxes(J, -1, -2)
    B = (J * keep[:, None]) @ JT
    turned = J[:, 3:] * (np.sqrt(variance)[:, None] * keep / np.where(np.abs(r.along) > _TINY, r.along, 1))[:, None]
    A = B.copy()
    A[:, 3:, 3:] -= turned @ np.swapaxes(turned, -1, -2)
    inverse = _inverse(A)
    cov = (inverse @ B @ inverse)[:, :3, :3] * variance[:, None, None]
    influence = inverse[:, :3] @ (J * keep[:, None])
    seen = np.sum(keep * r.along**2, axis=-1) / n
    return Trust(cov, influence, np.sqrt(variance), np.sqrt(np.maximum(seen - variance, 0)), r.across, r.normal)


def spread(m: Matches) -> Array:
    """Return the variance (p,) rad^2 of the rays about their main direction: without any, nothing tells a turn about it."""
    weighted = m.first * m.given[:, None]
    values = np.linalg.eigvalsh(weighted @ np.swapaxes(m.first, -1, -2))
    out: Array = 1 - values[:, -1] / np.maximum(m.given.sum(axis=-1), 1)
    return out


def parallax_cov(m: Matches, parallax: Array) -> Array:
    """Return the covariance (p, 3, 3) rad^2 of what a parallax (p,) px, neglected, does to a rotation: little about the mean ray."""
    n = np.maximum(m.given.sum(axis=-1), 1)
    mean = np.sum(m.first * m.given[:, None], axis=-1)
    mean /= np.linalg.norm(mean, axis=-1, keepdims=True) + _TINY
    focal2 = np.sum(m.J**2 * m.given[:, None, None], axis=(1, 2, 3)) / (2 * n) + _TINY  # px/rad, squared
    out: Array = (parallax**2 / focal2)[:, None, None] * (np.eye(3) - 0.95 * mean[:, :, None] * mean[:, None, :])
    return out
