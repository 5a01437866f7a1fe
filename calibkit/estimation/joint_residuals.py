"""The joint estimate's residuals as the report draws them: of corners, of samples, and the way with the biases on it."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calibkit.data.observations import BoardViews
from calibkit.data.result import ResidualSet
from calibkit.estimation.joint import Joint
from calibkit.estimation.joint_fit import corner_residuals
from calibkit.estimation.joint_noise import draw
from calibkit.estimation.joint_state import biases
from calibkit.geometry import se3
from calibkit.geometry.so3 import Array
from calibkit.geometry.spline import Steps, basis, turning

_BIAS_DRAWS = 32  # of the state: a sigma is then known to 13 %


def residual_sets(joint: Joint, cameras: Sequence[BoardViews], imus: Sequence[str]) -> list[ResidualSet]:
    """Return the residuals at the joint's state, of the cameras with their views and of the IMUs with their names."""
    of_cameras = [_corner_set(joint, views, c) for c, views in enumerate(cameras)]
    return [*of_cameras, *(each for j, name in enumerate(imus) for each in _imu_sets(joint, name, j))]


def _corner_set(joint: Joint, each: BoardViews, c: int) -> ResidualSet:
    """Return every corner's residual with the rate of turn and where the board was."""
    fit, frames = joint.fit, joint.fit.problem.cameras[c]
    px, valid = corner_residuals(fit.problem, fit.x, c)
    frame, corner = np.nonzero(fit.found[c])
    seen = fit.problem.seen(fit.x, Steps.of(fit.x.R), c)
    T = seen.T_cam_board
    points = se3.transform(T, fit.problem.points)
    weight = frames.views.weight[frame, corner]
    usual = float(np.median(weight[weight > 0])) if np.any(weight > 0) else 1.0
    return ResidualSet(
        sensor=each.camera,
        unit="px",
        t_ns=each.t_ns[joint.frames[c]][frame],
        raw=np.where(valid[..., None], px, np.nan)[frame, corner],
        sigma=1 / np.where(weight > 0, weight, usual),
        context={
            "uv": frames.views.uv[frame, corner],
            "corner": corner.astype(np.int32),
            "frame": frame.astype(np.int32),
            "kept": weight > 0,
            "distance": np.linalg.norm(points, axis=-1)[frame, corner],
            "tilt": np.arccos(np.clip(np.abs(T[:, 2, 2]), 0, 1))[frame],
            "rate": np.linalg.norm(seen.at.omega, axis=1)[frame],
        },
    )


def _imu_sets(joint: Joint, imu: str, j: int) -> list[ResidualSet]:
    """Return IMU j's gyroscope's and accelerometer's residuals with what was measured, and the way with the biases on it."""
    fit, rows = joint.fit, joint.fit.problem.imus[j]
    left = fit.problem.imu_residuals(fit.x, j)
    i, _ = fit.problem.knots.locate(rows.t + fit.x.imus[j].dt)
    rate = np.linalg.norm(rows.gyro - left[:, :3] - fit.x.imus[j].bias[i, :3], axis=1)
    sets = []
    for k, (name, unit, measured) in enumerate((("gyro", "rad/s", rows.gyro), ("accel", "m/s^2", rows.accel))):
        part = slice(3 * k, 3 * k + 3)
        sigma = np.full(len(rows.t), float(rows.sigma[part].mean()))
        context = {"measured": measured, "kept": rows.keep[:, k], "rate": rate}
        sets.append(ResidualSet(f"{imu}_{name}", unit, _stamps(joint, rows.t), left[:, part], sigma, context))
    return [*sets, _way(joint, imu, j)]


def _way(joint: Joint, imu: str, j: int) -> ResidualSet:
    """Return where IMU j was and its biases, once a segment; the residuals are the steps of the biases over their walk's sigma."""
    fit, knots, own = joint.fit, joint.fit.problem.knots, joint.fit.x.imus[j]
    i, half = np.arange(knots.segments), np.full(knots.segments, 0.5)
    value = basis(knots, half)
    at = turning(fit.x.R, Steps.of(fit.x.R), i, value, basis(knots, half, 1), jacobians=False)
    place = np.einsum("nl,nlk->nk", value, fit.x.p[i[:, None] + np.arange(knots.order)]) + at.R @ se3.inverse(own.T_imu_ref)[:3, 3]
    steps = (own.bias[i + 1] - own.bias[i]) / (fit.problem.imus[j].walk * np.sqrt(knots.spacing))
    drawn = draw(fit.system, _BIAS_DRAWS).core.reshape(knots.controls, fit.problem.border.knot, _BIAS_DRAWS)
    sigma = np.sqrt(np.mean(drawn[i, biases(j)] ** 2, axis=2))
    context = {"place": place, "bias": own.bias[i], "bias_sigma": sigma}
    return ResidualSet(imu, "sigma", _stamps(joint, knots.middle(i)), steps, np.ones(knots.segments), context)


def _stamps(joint: Joint, t: Array) -> NDArray[np.int64]:
    return np.asarray(joint.origin_ns + np.round(t * 1e9).astype(np.int64))
