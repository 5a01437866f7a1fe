"""Rotation and time offset of a camera and an IMU by how both accelerate, where turns do not tell: the board's poses give the camera's."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibkit.data.observations import ImuSamples
from calibkit.estimation.board_poses import BoardPoses
from calibkit.estimation.rough_offset import masked_correlation
from calibkit.estimation.turns import in_order
from calibkit.geometry import se3, so3
from calibkit.geometry.so3 import Array

_STEP_S = 0.02
_NEAR_S = 0.06  # about a lag of the grid
_PEAKS = 20
_LEAST_OVERLAP_S = 5.0
_TOLD = 0.25  # of the accelerations' variance in common at least; without motion it is a few per cent
_FEWEST = 20  # frames


@dataclass(frozen=True)
class Accelerations:
    """A camera's, as its poses before the board have them."""

    t: Array  # (f,) s on the camera's clock
    R_ref_cam: Array  # (f, 3, 3) out of the camera's axes into those of `a`
    a: Array  # (f, 3) m/s^2, gravity not included


def camera_accelerations(poses: BoardPoses, origin_ns: int, turns: bool) -> Accelerations | None:
    """Return the second derivative of smoothing splines through the camera's positions, their smoothness by cross-validation.

    In the board's frame; of a camera that does not turn in its own, where the board's tilt, hardly known before a board that is never
    tilted, does not matter.
    """
    from scipy.interpolate import make_smoothing_spline  # slow to import, and turns mostly suffice

    rows = in_order(poses.t_ns)
    if len(rows) < _FEWEST:
        return None
    t = np.asarray((poses.t_ns[rows] - origin_ns) * 1e-9, np.float64)
    T = se3.inverse(poses.T_cam_board[rows])
    p = T[:, :3, 3] if turns else -poses.T_cam_board[rows, :3, 3]
    splines = [make_smoothing_spline(t, p[:, axis]) for axis in range(3)]
    R: Array = T[:, :3, :3] if turns else np.broadcast_to(np.eye(3), (len(t), 3, 3))
    return Accelerations(t, R, np.stack([spline.derivative(2)(t) for spline in splines], axis=1))


def lag_of(camera: Accelerations, imu_t: Array, imu: ImuSamples) -> float | None:
    """Return td at which the accelerations are most alike, whatever the rotation; None where they are not.

    By the squared correlations of each axis with each, at every lag at once.
    """
    in_camera = (np.swapaxes(camera.R_ref_cam, 1, 2) @ camera.a[..., None])[..., 0]
    slow, has_slow = _on_grid(camera.t, in_camera)
    fast, has_fast = _on_grid(imu_t, imu.accel)
    alike = np.zeros(len(slow) + len(fast) - 1)
    for a in range(3):
        for b in range(3):
            rho, n = masked_correlation(fast[:, a], has_fast, slow[:, b], has_slow)
            alike += rho**2 / 3
    lags = (np.arange(len(alike)) - (len(slow) - 1)) * _STEP_S + imu_t[0] - camera.t[0]
    # Over a short overlap any two are alike by chance.
    alike = np.minimum(alike, 1.0) * np.where(n * _STEP_S < min(_LEAST_OVERLAP_S, 0.5 * _STEP_S * n.max()), 0.0, n)
    peaks = np.flatnonzero((alike[1:-1] > alike[:-2]) & (alike[1:-1] >= alike[2:])) + 1
    tried = [lags[k] + near for k in peaks[np.argsort(-alike[peaks])][:_PEAKS] for near in np.arange(-_NEAR_S, _NEAR_S, _STEP_S / 2)]
    found = [_rotation(camera, imu_t, imu, td) for td in tried]
    worth = [-each.frames * np.log(1 - np.clip(each.explained, 0.0, 1 - 1e-9)) for each in found]
    if not worth or found[best := int(np.argmax(worth))].explained < _TOLD:
        return None
    return float(tried[best])


def rotation_of(camera: Accelerations, imu_t: Array, imu: ImuSamples, td: float) -> Array | None:
    """Return R_cam_imu of a rig that does not turn: argmin sum |f_cam - R f_imu|^2 of both less their means (Wahba 1965)."""
    found = _rotation(camera, imu_t, imu, td)
    return found.R if found.explained > _TOLD else None


@dataclass(frozen=True)
class _Laid:
    R: Array
    explained: float  # of the variance felt
    frames: int


def _rotation(camera: Accelerations, imu_t: Array, imu: ImuSamples, td: float) -> _Laid:
    rows, felt = _felt(camera, imu_t, imu, td)
    if len(felt) < _FEWEST:
        return _Laid(np.eye(3), 0.0, 0)
    f = (np.swapaxes(camera.R_ref_cam[rows], 1, 2) @ camera.a[rows, :, None])[..., 0]
    f, felt = f - f.mean(axis=0), felt - felt.mean(axis=0)
    R: Array = so3.project(f.T @ felt)
    return _Laid(R, 1 - float(np.sum((felt - f @ R) ** 2) / max(float(np.sum(felt**2)), 1e-300)), len(felt))


def turned_about(camera: Accelerations, imu_t: Array, imu: ImuSamples, td: float, R: Array, axis: Array) -> Array | None:
    """Return exp(theta axis) R that lays the accelerations best, gravity and its direction free: what turns about one axis leave open.

    a + e = R_ref_cam exp(theta axis) R f_imu with e = -g constant: linear in sin theta and 1 - cos theta.
    """
    rows, felt = _felt(camera, imu_t, imu, td)
    if len(felt) < _FEWEST:
        return None
    N = so3.hat(axis)
    zero, first, second = (_centred((camera.R_ref_cam[rows] @ (turn @ R @ felt.T).T[..., None])[..., 0]) for turn in (np.eye(3), N, N @ N))
    a = _centred(camera.a[rows])
    theta = np.linspace(-np.pi, np.pi, 721)
    parts = np.stack([x.ravel() for x in (zero - a, first, second)])
    G, c = parts @ parts.T, np.stack([np.ones(len(theta)), np.sin(theta), 1 - np.cos(theta)])
    cost = np.sum(c * (G @ c), axis=0)
    if 1 - cost.min() / max(float(np.sum(a**2)), 1e-300) < _TOLD:
        return None
    out: Array = so3.exp(theta[int(np.argmin(cost))] * axis) @ R
    return out


def _felt(camera: Accelerations, imu_t: Array, imu: ImuSamples, td: float) -> tuple[NDArray[np.intp], Array]:
    """Return which frames lie within the IMU's samples, and what the accelerometer felt then."""
    at = camera.t + td
    rows = np.flatnonzero((at >= imu_t[0]) & (at <= imu_t[-1]))
    return rows, np.stack([np.interp(at[rows], imu_t, imu.accel[:, axis]) for axis in range(3)], axis=1)


def _centred(x: Array) -> Array:
    out: Array = x - x.mean(axis=0)
    return out


def _on_grid(t: Array, x: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return x (n, 3) at even times from the first one on, and where it is measured nearby."""
    grid = np.arange(t[0], t[-1], _STEP_S)
    there = np.abs(t[np.clip(np.searchsorted(t, grid), 0, len(t) - 1)] - grid) < 0.25
    return np.stack([np.interp(grid, t, x[:, axis]) for axis in range(x.shape[1])], axis=1), there
