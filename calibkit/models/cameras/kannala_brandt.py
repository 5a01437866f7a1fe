"""Kannala-Brandt equidistant fisheye with four coefficients (Kannala, Brandt, PAMI 2006), Kalibr's pinhole-equi."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from calibkit.models.cameras.base import Array, Mask, Projection, first_turning_point, planes

_NEWTON_STEPS = 8


@dataclass(frozen=True)
class KannalaBrandt:
    """u = fx d x/r + cx with r = |(X, Y)|, theta = atan2(r, Z), d = theta + k1 theta^3 + k2 theta^5 + k3 theta^7 + k4 theta^9.

    Valid up to the angle where d stops growing, behind the camera's plane included.
    """

    name: str = "pinhole-equi"
    equation: ClassVar[str] = (
        "r = sqrt(X^2 + Y^2), theta = atan2(r, Z); d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8); "
        "u = fx d X/r + cx; v = fy d Y/r + cy"
    )

    @property
    def parameter_names(self) -> tuple[str, ...]:
        return ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")

    def seed(self, focal: float, centre: tuple[float, float]) -> Array:
        return np.array([focal, focal, *centre, 0.0, 0.0, 0.0, 0.0])

    def prior(self, params: Array, reach: float) -> tuple[Array, Array]:
        return np.zeros(0), np.zeros((0, 8))

    def _max_theta(self, params: Array) -> float:
        return float(np.sqrt(first_turning_point(np.array([1.0, *(params[4:8] * [3, 5, 7, 9])]), np.pi**2)))

    def project(self, points: Array, params: Array, jacobians: bool = False) -> Projection:
        X, Y, Z = points[..., 0], points[..., 1], points[..., 2]
        fx, fy, cx, cy, k1, k2, k3, k4 = params
        r2 = X * X + Y * Y
        r = np.sqrt(r2)
        theta = np.arctan2(r, Z)
        t2 = theta * theta
        d = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
        near_axis = r < 1e-7 * np.abs(Z)  # there d/r = 1/Z to 1e-14
        safe_r = np.where(near_axis, 1.0, r)
        safe_z = np.where(Z == 0, 1.0, Z)
        s = np.where(near_axis, 1 / safe_z, d / safe_r)
        valid = (theta < self._max_theta(params)) & ((r > 0) | (Z > 0))
        uv = np.moveaxis(np.stack([fx * s * X + cx, fy * s * Y + cy]), 0, -1)
        if not jacobians:
            return Projection(uv, valid)

        rho2 = r2 + Z * Z
        rho2 = np.where(rho2 > 0, rho2, 1.0)
        slope = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))  # dd/dtheta
        ds_z = -slope / rho2
        g = np.where(near_axis, 0.0, (slope * Z / rho2 - s) / (safe_r * safe_r))  # ds/dX = g X
        point, J_point = planes(X.shape, 3)
        point[0, 0], point[0, 1], point[0, 2] = fx * (s + g * X * X), fx * g * X * Y, fx * ds_z * X
        point[1, 0], point[1, 1], point[1, 2] = fy * g * X * Y, fy * (s + g * Y * Y), fy * ds_z * Y

        par, J_params = planes(X.shape, 8)
        par[0, 0], par[1, 1], par[0, 2], par[1, 3] = s * X, s * Y, 1, 1
        power = np.where(near_axis, 0.0, theta * t2 / safe_r)
        for column in range(4, 8):
            par[0, column], par[1, column] = fx * X * power, fy * Y * power
            power = power * t2
        return Projection(uv, valid, J_point, J_params)

    def unproject(self, uv: Array, params: Array) -> tuple[Array, Mask]:
        fx, fy, cx, cy, k1, k2, k3, k4 = params
        m = (uv - np.array([cx, cy])) / np.array([fx, fy])
        d = np.linalg.norm(m, axis=-1)
        grid = np.linspace(0, self._max_theta(params), 400)
        powers = grid**2
        image = grid * (1 + powers * (k1 + powers * (k2 + powers * (k3 + powers * k4))))
        theta = np.interp(d, image, grid)
        for _ in range(_NEWTON_STEPS):
            t2 = theta * theta
            slope = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
            error = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) - d
            theta = np.clip(theta - error / np.where(np.abs(slope) > 1e-9, slope, 1.0), 0, grid[-1])
        t2 = theta * theta
        valid = np.abs(theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) - d) < 1e-9
        direction = m / np.where(d > 0, d, 1.0)[..., None]
        rays = np.concatenate([np.sin(theta)[..., None] * direction, np.cos(theta)[..., None]], axis=-1)
        return rays, valid
