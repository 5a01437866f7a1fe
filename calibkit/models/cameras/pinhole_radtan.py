"""Pinhole with radial-tangential distortion: Brown (1966) with 4 or 5 coefficients, the rational model of OpenCV with 8."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from calibkit.models.cameras.base import Array, Mask, Projection, first_turning_point, planes

_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_MAX_RADIUS = 20.0  # tan(87 deg): beyond it a pinhole is no model of anything
_NEWTON_STEPS = 12


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

    def _radial(self, params: Array) -> tuple[Array, Array]:
        """Return numerator and denominator coefficients of q in ascending powers of r2."""
        full = np.zeros(12)
        full[: len(params)] = params
        return np.array([1, full[4], full[5], full[8]]), np.array([1, full[9], full[10], full[11]])

    def _max_r2(self, params: Array) -> float:
        n, d = self._radial(params)
        # d(r q)/dr has the sign of (n + 2 s n') d - 2 s n d', s = r2; q must not meet a pole either.
        dn, dd = n[1:] * [1, 2, 3], d[1:] * [1, 2, 3]
        growth = np.polynomial.polynomial.polymul(n, d)
        growth = np.polynomial.polynomial.polyadd(growth, 2 * np.concatenate([[0.0], np.polynomial.polynomial.polymul(dn, d)]))
        growth = np.polynomial.polynomial.polysub(growth, 2 * np.concatenate([[0.0], np.polynomial.polynomial.polymul(n, dd)]))
        return min(first_turning_point(growth, _MAX_RADIUS**2), first_turning_point(d, _MAX_RADIUS**2))

    def project(self, points: Array, params: Array, jacobians: bool = False) -> Projection:
        X, Y, Z = points[..., 0], points[..., 1], points[..., 2]
        fx, fy, cx, cy, _, _, p1, p2 = params[:8]
        n, d = self._radial(params)
        front = Z > 1e-9
        inverse_z = 1 / np.where(front, Z, 1.0)
        x, y = X * inverse_z, Y * inverse_z
        xx, yy, xy = x * x, y * y, x * y
        r2 = xx + yy
        valid = front & (r2 < self._max_r2(params))
        top = 1 + r2 * (n[1] + r2 * (n[2] + r2 * n[3]))
        rational = self.coefficients == 8
        inverse_bottom = 1 / (1 + r2 * (d[1] + r2 * (d[2] + r2 * d[3]))) if rational else 1.0
        q = top * inverse_bottom
        xd = q * x + 2 * p1 * xy + p2 * (r2 + 2 * xx)
        yd = q * y + p1 * (r2 + 2 * yy) + 2 * p2 * xy
        uv = np.moveaxis(np.stack([fx * xd + cx, fy * yd + cy]), 0, -1)
        if not jacobians:
            return Projection(uv, valid)

        dq = n[1] + r2 * (2 * n[2] + r2 * (3 * n[3]))  # dq/dr2
        if rational:
            dq = (dq - q * (d[1] + r2 * (2 * d[2] + r2 * (3 * d[3])))) * inverse_bottom
        cross = 2 * (dq * xy + p1 * x + p2 * y)
        a = q + 2 * dq * xx + 2 * p1 * y + 6 * p2 * x
        b = q + 2 * dq * yy + 6 * p1 * y + 2 * p2 * x
        point, J_point = planes(x.shape, 3)
        point[0, 0], point[0, 1] = fx * a * inverse_z, fx * cross * inverse_z
        point[1, 0], point[1, 1] = fy * cross * inverse_z, fy * b * inverse_z
        point[0, 2] = -(point[0, 0] * x + point[0, 1] * y)
        point[1, 2] = -(point[1, 0] * x + point[1, 1] * y)

        par, J_params = planes(x.shape, 4 + self.coefficients)
        par[0, 0], par[1, 1], par[0, 2], par[1, 3] = xd, yd, 1, 1
        par[0, 6], par[1, 6] = 2 * fx * xy, fy * (r2 + 2 * yy)
        par[0, 7], par[1, 7] = fx * (r2 + 2 * xx), 2 * fy * xy
        fxx, fyy = fx * x * inverse_bottom, fy * y * inverse_bottom
        power = r2
        for order in range(3):  # k1, k2, k3 with the power of r2; k4.. the same times -q
            for column, factor in ((((4, 5, 8)[order]), 1.0), (9 + order, -q)):
                if column < 4 + self.coefficients:
                    par[0, column], par[1, column] = fxx * power * factor, fyy * power * factor
            power = power * r2
        return Projection(uv, valid, J_point, J_params)

    def unproject(self, uv: Array, params: Array) -> tuple[Array, Mask]:
        fx, fy, cx, cy = params[:4]
        target = (uv - np.array([cx, cy])) / np.array([fx, fy])
        n, d = self._radial(params)
        # Start on the radial map, inverted by a table up to its turning point; Newton then settles the tangential part.
        radius = np.linspace(0, np.sqrt(self._max_r2(params)), 400)
        s = radius**2
        image = radius * np.polynomial.polynomial.polyval(s, n) / np.polynomial.polynomial.polyval(s, d)
        distorted = np.linalg.norm(target, axis=-1)
        scale = np.interp(distorted, image, radius) / np.where(distorted > 0, distorted, 1.0)
        xy = target * np.where(distorted > 0, scale, 1.0)[..., None]
        unit = np.concatenate([[1.0, 1.0, 0.0, 0.0], params[4:]])
        inside = np.ones(xy.shape[:-1], bool)
        for _ in range(_NEWTON_STEPS):
            p = self.project(np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1), unit, jacobians=True)
            assert p.J_point is not None
            J, error = p.J_point[..., :2], target - p.uv
            det = J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] * J[..., 1, 0]
            inside = p.valid & (np.abs(det) > 1e-12)
            det = np.where(inside, det, 1.0)
            step = np.stack(
                [J[..., 1, 1] * error[..., 0] - J[..., 0, 1] * error[..., 1], J[..., 0, 0] * error[..., 1] - J[..., 1, 0] * error[..., 0]],
                axis=-1,
            )
            xy = xy + np.where(inside[..., None], step / det[..., None], 0.0)
            if np.all(np.abs(error[inside]) < 1e-15):
                break
        rays = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)
        back = self.project(rays, unit)
        valid = back.valid & (np.max(np.abs(back.uv - target), axis=-1) < 1e-9)
        rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        return rays, valid
