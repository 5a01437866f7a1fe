"""Where the joint estimator starts: rotation, offset and bias by how both turn, what that leaves open by how both accelerate."""

from dataclasses import dataclass, replace

import numpy as np

from calibkit.data.observations import ImuSamples
from calibkit.data.verdict import Status
from calibkit.estimation.alignment_axes import open_axes
from calibkit.estimation.board_poses import BoardPoses
from calibkit.estimation.joint_accelerations import camera_accelerations, lag_of, rotation_of, turned_about
from calibkit.estimation.joint_state import CameraState, JointState
from calibkit.estimation.orientation_track import OrientationTrack
from calibkit.estimation.time_offset import TimeOffsetFit
from calibkit.estimation.time_offset_verdict import judge_time_offset
from calibkit.geometry import se3, so3
from calibkit.geometry.so3 import Array
from calibkit.geometry.spline import Knots, basis

TURNS, ACCELERATIONS, STAMPS = "turns", "accelerations", "stamps"


@dataclass(frozen=True)
class CameraSeed:
    """A camera's start."""

    R_cam_imu: Array  # (3, 3)
    td: float  # s
    gyro_bias: Array  # (3,) rad/s
    track: OrientationTrack  # of the gyroscope
    td_by: str  # what told the offset: turns, accelerations, or nothing but the stamps


def seed_camera(poses: BoardPoses, fit: TimeOffsetFit, imu: ImuSamples) -> CameraSeed:
    """Return rotation and offset by turns, and what those leave open by accelerations."""
    R, td, origin_ns = fit.alignment.R, fit.td, fit.alignment.track.origin_ns
    judged = judge_time_offset("dt", "cam", "imu", fit, {})
    axes = open_axes(fit.alignment)
    known = judged.status is not Status.NOT_OBSERVABLE or judged.coarse
    if known and not len(axes):
        return CameraSeed(R, td, fit.gyro_bias, fit.alignment.track, TURNS)
    imu_t = np.asarray((imu.t_ns - origin_ns) * 1e-9, np.float64)
    camera = camera_accelerations(poses, origin_ns, len(axes) < 3)
    td_by = TURNS
    if not known:
        lag = None if camera is None else lag_of(camera, imu_t, imu)
        td_by = STAMPS if lag is None else ACCELERATIONS
        td = lag if lag is not None else 0.0 if _overlap(poses, imu) else td
    found = None
    if camera is not None:
        found = turned_about(camera, imu_t, imu, td, R, axes[0]) if len(axes) == 1 else rotation_of(camera, imu_t, imu, td)
    return CameraSeed(R if found is None else found, td, fit.gyro_bias, fit.alignment.track, td_by)


def _overlap(poses: BoardPoses, imu: ImuSamples) -> bool:
    """Whether most frames lie within the IMU's samples by their stamps."""
    inside = (poses.t_ns > imu.t_ns[0]) & (poses.t_ns < imu.t_ns[-1])
    return float(np.mean(inside)) > 0.5


@dataclass(frozen=True)
class Posed:
    """A camera's frames that take part, in the order of time."""

    t: Array  # (f,) s, on the camera's clock
    T_cam_board: Array  # (f, 4, 4)
    lens: Array  # (l,)


def seed_trajectory(knots: Knots, posed: Posed, seed: CameraSeed, imu_t: Array, accel: Array, gravity: float) -> JointState:
    """Return the start: the IMU in the camera's centre, as it is turned; g from the mean of all accelerations, which motion averages out.

    R_board_imu(t) = C(t) Q(t): Q is the gyroscope's orientation, C what joins it to the board's poses, linear between frames.
    """
    track, td, R_cam_imu = seed.track, seed.td, seed.R_cam_imu
    T_board_cam, t = se3.inverse(posed.T_cam_board), posed.t + td
    joins: Array = T_board_cam[:, :3, :3] @ R_cam_imu @ np.swapaxes(so3.from_quat(track.orientation(t)), 1, 2)

    def oriented(at: Array) -> Array:
        j = np.clip(np.searchsorted(t, at) - 1, 0, len(t) - 2)
        share = np.clip((at - t[j]) / np.maximum(t[j + 1] - t[j], 1e-9), 0.0, 1.0)
        turn = so3.log(np.swapaxes(joins[j], 1, 2) @ joins[j + 1])
        out: Array = joins[j] @ so3.exp(share[:, None] * turn) @ so3.from_quat(track.orientation(at))
        return out

    centre = knots.centre()
    p = np.stack([np.interp(centre, t, T_board_cam[:, axis, 3]) for axis in range(3)], axis=1)
    up = np.mean((oriented(imu_t) @ accel[..., None])[..., 0], axis=0)
    bias = np.tile(np.concatenate([seed.gyro_bias, np.zeros(3)]), (knots.controls, 1))
    camera = CameraState(se3.make(R_cam_imu, np.zeros(3)), td, posed.lens)
    return JointState(oriented(centre), p, bias, (camera,), -gravity * up / np.linalg.norm(up))


def camera_beside(start: JointState, knots: Knots, posed: Posed, seed: CameraSeed) -> JointState:
    """Return the start with one more camera: as it is turned, and with the IMU where its frames have it (medians)."""
    i, u = knots.locate(posed.t + seed.td)
    p = np.einsum("nl,nlk->nk", basis(knots, u), start.p[i[:, None] + np.arange(knots.order)])
    seen = se3.transform(posed.T_cam_board, p[:, None])[:, 0]
    return replace(start, cameras=(*start.cameras, CameraState(se3.make(seed.R_cam_imu, np.median(seen, axis=0)), seed.td, posed.lens)))
