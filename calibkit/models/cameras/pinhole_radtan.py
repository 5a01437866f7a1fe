"""Pinhole with radial-tangential distortion: Brown (1966) with 4 or 5 coefficients, the rational model of OpenCV with 8."""

from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import numpy as np
from numpy.polynomial import polynomial

from calibkit.models.cameras.base import Array, Mask, Projection, first_turning_point, planes

_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_MAX_RADIUS = 20.0  # tan(87 deg): beyond it a pinhole is no model of anything
_NEWTON_STEPS = 12
_PRIOR_NODES, _PRIOR_SIGMA = 24, 0.5
_PRIOR_REACH = 1.25  # of r2: the image goes on behind its outermost corners
_LEAST_DENOMINATOR = 0.02


@dataclass(frozen=True)
class PinholeRadtan:
    """u = fx x' + cx with x = X/Z, r2 = x^2 + y^2, q = (1 + k1 r2 + k2 r2^2 + k3 r2^3) / (1 + k4 r2 + k5 r2^2 + k6 r2^3),

    x' = q x + 2 p1 x y + p2 (r2 + 2 x^2), y' = q y + p1 (r2 + 2 y^2) + 2 p2 x y (OpenCV's order k1 k2 p1 p2 k3 k4 k5 k6).
    Valid in front of the camera and inside the radius where the radial map stops growing.
    """

    name: str
    coefficients: int  # 4, 5 or 8
    equation: ClassVar[str] = (
        "x = X/Z, y = Y/Z, r2 = x^2 + y^2; q = (1 + k1 r2 + k2 r2^2 + k3 r2^3) / (1 + k4 r2 + k5 r2^2 + k6 r2^3); "
        "u = fx (q x + 2 p1 x y + p2 (r2 + 2 x^2)) + cx; v = fy (q y + p1 (r2 + 2 y^2) + 2 p2 x y) + cy; absent k are 0"
    )

    @property
    def parameter_names(self) -> tuple[str, ...]:
        return _NAMES[: 4 + self.coefficients]

    def seed(self, focal: float, centre: tuple[float, float]) -> Array:
        return np.array([focal, focal, *centre] + [0.0] * self.coefficients)

    def prior(self, params: Array, reach: float) -> tuple[Array, Array]:
        """Return (1/d - 1) / sigma of the denominator d at r2 evenly up to beyond the reach, together worth three measurements.

        Where corners do not tell its coefficients, a root of d otherwise settles beside one of the numerator: they cancel but for a
        spike between the corners or behind them, and the sigmas of a linearised fit mean nothing. 1/d lets a d that grows be.
        """
        p = 4 + self.coefficients
        if self.coefficients < 8:
            return np.zeros(0), np.zeros((0, p))
        powers = np.linspace(0, min(_PRIOR_REACH * reach, _MAX_RADIUS**2), _PRIOR_NODES + 1)[1:, None] ** [1, 2, 3]
        d = 1 + powers @ params[9:]
        inside = np.maximum(d, _LEAST_DENOMINATOR)  # below, the tangent goes on: finite, and it pulls back
        share = np.sqrt(3 / _PRIOR_NODES) / _PRIOR_SIGMA
        J = np.zeros((_PRIOR_NODES, p))
        J[:, 9:] = -share * powers / inside[:, None] ** 2
        return share * (1 / inside + (inside - d) / inside**2 - 1), J

    def _radial(self, params: Array) -> tuple[Array, Array]:
        """Return numerator and denominator coefficients of q in ascending powers of r2."""
        full = np.zeros(12)
        full[: len(params)] = params
        return np.array([1, full[4], full[5], full[8]]), np.array([1, full[9], full[10], full[11]])

    def project(self, points: Array, params: Array, jacobians: bool = False) -> Projection:
        X, Y, Z = points[..., 0], points[..., 1], points[..., 2]
        fx, fy, cx, cy, *_ = params
        front = Z > 1e-9
        inverse_z = 1 / np.where(front, Z, 1.0)
        x, y = X * inverse_z, Y * inverse_z
        r2 = x * x + y * y
        valid = front & (r2 < _max_r2(self, params.tobytes()))
        q, inverse_bottom = self._radial_gain(r2, params)
        xd, yd = _tangential(x, y, r2, q, params)
        uv = np.empty((*x.shape, 2))
        uv[..., 0], uv[..., 1] = fx * xd + cx, fy * yd + cy
        if not jacobians:
            return Projection(uv, valid)

        a, cross, b = self._slopes(x, y, r2, q, inverse_bottom, params)
        point, J_point = planes(x.shape, 3)
        point[0, 0], point[0, 1] = fx * a * inverse_z, fx * cross * inverse_z
        point[1, 0], point[1, 1] = fy * cross * inverse_z, fy * b * inverse_z
        point[0, 2] = -(point[0, 0] * x + point[0, 1] * y)
        point[1, 2] = -(point[1, 0] * x + point[1, 1] * y)

        par, J_params = planes(x.shape, 4 + self.coefficients)
        par[0, 0], par[1, 1], par[0, 2], par[1, 3] = xd, yd, 1, 1
        xy = 2 * x * y
        par[0, 6], par[1, 6] = fx * xy, fy * (r2 + 2 * y * y)
        par[0, 7], par[1, 7] = fx * (r2 + 2 * x * x), fy * xy
        fxx, fyy = fx * x * inverse_bottom, fy * y * inverse_bottom
        power = r2
        for order in range(3):  # k1, k2, k3 with the power of r2; k4.. the same times -q
            for column, factor in ((((4, 5, 8)[order]), 1.0), (9 + order, -q)):
                if column < 4 + self.coefficients:
                    par[0, column], par[1, column] = fxx * power * factor, fyy * power * factor
            power = power * r2
        return Projection(uv, valid, J_point, J_params)

    def _radial_gain(self, r2: Array, params: Array) -> tuple[Array, Array | float]:
        """Return q and 1 / its denominator."""
        n, d = self._radial(params)
        top = 1 + r2 * (n[1] + r2 * (n[2] + r2 * n[3]))
        if self.coefficients < 8:
            return top, 1.0
        inverse_bottom = 1 / (1 + r2 * (d[1] + r2 * (d[2] + r2 * d[3])))
        return top * inverse_bottom, inverse_bottom

    def _slopes(self, x: Array, y: Array, r2: Array, q: Array, inverse_bottom: Array | float, params: Array) -> tuple[Array, Array, Array]:
        """Return dx'/dx, dx'/dy = dy'/dx and dy'/dy."""
        n, d = self._radial(params)
        p1, p2 = params[6:8]
        dq = n[1] + r2 * (2 * n[2] + r2 * (3 * n[3]))  # dq/dr2
        if self.coefficients == 8:
            dq = (dq - q * (d[1] + r2 * (2 * d[2] + r2 * (3 * d[3])))) * inverse_bottom
        cross = 2 * (dq * x * y + p1 * x + p2 * y)
        return q + 2 * dq * x * x + 2 * p1 * y + 6 * p2 * x, cross, q + 2 * dq * y * y + 6 * p1 * y + 2 * p2 * x

    def unproject(self, uv: Array, params: Array) -> tuple[Array, Mask]:
        fx, fy, cx, cy, *_ = params
        tx, ty = (uv[..., 0] - cx) / fx, (uv[..., 1] - cy) / fy
        n, d = self._radial(params)
        # Start on the radial map, inverted by a table up to its turning point; Newton then settles the tangential part.
        max_r2 = _max_r2(self, params.tobytes())
        radius = np.linspace(0, np.sqrt(max_r2) * (1 - 1e-9), 400)  # not at a pole, beyond which the map has the other sign
        image = radius * polynomial.polyval(radius**2, n) / polynomial.polyval(radius**2, d)
        distorted = np.hypot(tx, ty)
        scale = np.where(distorted > 0, np.interp(distorted, image, radius) / np.where(distorted > 0, distorted, 1.0), 1.0)
        x, y = tx * scale, ty * scale
        for _ in range(_NEWTON_STEPS):
            r2 = x * x + y * y
            q, inverse_bottom = self._radial_gain(r2, params)
            xd, yd = _tangential(x, y, r2, q, params)
            ex, ey = tx - xd, ty - yd
            inside = r2 < max_r2
            if np.all(~inside | ((np.abs(ex) < 1e-12) & (np.abs(ey) < 1e-12))):
                break
            a, cross, b = self._slopes(x, y, r2, q, inverse_bottom, params)
            det = a * b - cross * cross
            gain = np.where(inside & (np.abs(det) > 1e-12), 1 / np.where(np.abs(det) > 1e-12, det, 1.0), 0.0)
            x, y = x + (b * ex - cross * ey) * gain, y + (a * ey - cross * ex) * gain
        r2 = x * x + y * y
        xd, yd = _tangential(x, y, r2, self._radial_gain(r2, params)[0], params)
        valid = (r2 < max_r2) & (np.abs(tx - xd) < 1e-9) & (np.abs(ty - yd) < 1e-9)
        inverse_length = 1 / np.sqrt(1 + r2)
        return np.stack([x * inverse_length, y * inverse_length, inverse_length], axis=-1), valid


def _tangential(x: Array, y: Array, r2: Array, q: Array, params: Array) -> tuple[Array, Array]:
    """Return x', y' = q (x, y) with the tangential part added."""
    p1, p2 = params[6:8]
    shift = 2 * (p1 * y + p2 * x)  # of both; what is left is p2 r2, p1 r2
    return x * (q + shift) + p2 * r2, y * (q + shift) + p1 * r2


@lru_cache(maxsize=16)  # asked for again for every chunk of points under the same lens
def _max_r2(model: PinholeRadtan, params: bytes) -> float:
    """Return r2 where the radial map stops growing, or meets a pole.

    d(r q)/dr has the sign of (n + 2 s n') d - 2 s n d', with s = r2 and q = n(s) / d(s).
    """
    n, d = model._radial(np.frombuffer(params))
    dn, dd = n[1:] * [1, 2, 3], d[1:] * [1, 2, 3]
    growth = polynomial.polymul(n, d)
    growth = polynomial.polyadd(growth, 2 * np.concatenate([[0.0], polynomial.polymul(dn, d)]))
    growth = polynomial.polysub(growth, 2 * np.concatenate([[0.0], polynomial.polymul(n, dd)]))
    return min(first_turning_point(growth, _MAX_RADIUS**2), first_turning_point(d, _MAX_RADIUS**2))
