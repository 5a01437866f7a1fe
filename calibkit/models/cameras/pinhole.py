"""Pinhole without distortion: rectified images, and the lens that every other model starts from."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from calibkit.models.cameras.base import Array, Mask, Projection, planes

_MAX_RADIUS = 20.0  # tan(87 deg): beyond it a pinhole is no model of anything


@dataclass(frozen=True)
class Pinhole:
    """u = fx X/Z + cx, v = fy Y/Z + cy; valid in front of the camera."""

    name: str = "pinhole-none"
    parameter_names: tuple[str, ...] = ("fx", "fy", "cx", "cy")
    equation: ClassVar[str] = "u = fx X/Z + cx; v = fy Y/Z + cy"

    def project(self, points: Array, params: Array, jacobians: bool = False) -> Projection:
        X, Y, Z = points[..., 0], points[..., 1], points[..., 2]
        fx, fy, cx, cy = params
        front = Z > 1e-9
        inverse_z = 1 / np.where(front, Z, 1.0)
        x, y = X * inverse_z, Y * inverse_z
        valid = front & (x * x + y * y < _MAX_RADIUS**2)
        uv = np.stack([fx * x + cx, fy * y + cy], axis=-1)
        if not jacobians:
            return Projection(uv, valid)

        point, J_point = planes(x.shape, 3)
        point[0, 0], point[1, 1] = fx * inverse_z, fy * inverse_z
        point[0, 2], point[1, 2] = -point[0, 0] * x, -point[1, 1] * y
        par, J_params = planes(x.shape, 4)
        par[0, 0], par[1, 1], par[0, 2], par[1, 3] = x, y, 1, 1
        return Projection(uv, valid, J_point, J_params)

    def unproject(self, uv: Array, params: Array) -> tuple[Array, Mask]:
        fx, fy, cx, cy = params
        x, y = (uv[..., 0] - cx) / fx, (uv[..., 1] - cy) / fy
        r2 = x * x + y * y
        return np.stack([x, y, np.ones_like(x)], axis=-1) / np.sqrt(1 + r2)[..., None], r2 < _MAX_RADIUS**2

    def seed(self, focal: float, centre: tuple[float, float]) -> Array:
        return np.array([focal, focal, *centre], float)

    def prior(self, params: Array, reach: float) -> tuple[Array, Array]:
        return np.zeros(0), np.zeros((0, 4))
