"""One camera model in the terms of another: the parameters whose pixels agree best over the whole image."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from calibkit.models.cameras import CameraModel

Array = NDArray[np.float64]
_COLUMNS, _ROWS = 61, 47  # of the pixel grid, the image's border included


@dataclass(frozen=True)
class Conversion:
    """The nearest camera of another model, and how near it is."""

    model: CameraModel
    params: Array
    worst_px: float
    rms_px: float
    lost: float  # share of the image whose rays the other model cannot hold at all


def convert(source: CameraModel, params: Array, resolution: tuple[int, int], target: CameraModel) -> Conversion:
    """Fit `target`: min over its parameters of sum |project(unproject_source(uv)) - uv|^2, uv on a grid over the image."""
    width, height = resolution
    u, v = np.meshgrid(np.linspace(0, width - 1, _COLUMNS), np.linspace(0, height - 1, _ROWS))
    uv = np.stack([u.ravel(), v.ravel()], axis=-1)
    rays, valid = source.unproject(uv, params)
    uv, rays = uv[valid], rays[valid]
    return min((_fit(target, start, rays, uv) for start in _starts(source, params, target)), key=lambda c: (c.lost, c.worst_px))


def nearest(source: CameraModel, params: Array, resolution: tuple[int, int], targets: Iterable[CameraModel]) -> Conversion:
    """Return the best conversion into any of the models."""
    return min((convert(source, params, resolution, target) for target in targets), key=lambda c: (c.lost, c.worst_px))


def _starts(source: CameraModel, params: Array, target: CameraModel) -> list[Array]:
    """Return an undistorted start, and one with all parameters of the same name: right within a family, of no meaning across."""
    plain = target.seed(float(params[0]), (float(params[2]), float(params[3])))
    plain[1] = params[1]
    known = dict(zip(source.parameter_names, params, strict=True))
    named = np.array([known.get(name, value) for name, value in zip(target.parameter_names, plain, strict=True)])
    return [plain, named]


def _fit(target: CameraModel, start: Array, rays: Array, uv: Array) -> Conversion:
    def residual(x: Array) -> Array:
        p = target.project(rays, x)
        return np.where(p.valid[:, None], p.uv - uv, 0.0).ravel()

    def jacobian(x: Array) -> Array:
        p = target.project(rays, x, jacobians=True)
        assert p.J_params is not None
        return np.where(p.valid[:, None, None], p.J_params, 0.0).reshape(-1, len(x))

    with np.errstate(all="ignore"):  # a step may leave the model's domain; the result is judged below
        x: Array = least_squares(residual, start, jac=jacobian, x_scale="jac", method="lm", xtol=1e-14, ftol=1e-14, gtol=1e-14).x
        p = target.project(rays, x)
    error = np.linalg.norm(p.uv - uv, axis=-1)[p.valid]
    if not len(error) or not np.all(np.isfinite(error)):
        return Conversion(target, x, np.inf, np.inf, 1.0)
    return Conversion(target, x, float(error.max()), float(np.sqrt(np.mean(error**2))), float(np.mean(~p.valid)))
