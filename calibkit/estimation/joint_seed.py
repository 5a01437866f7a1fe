"""Where the joint estimator starts: rotation, time offset and gyroscope's bias by how both turn, the trajectory by the board's poses."""

from dataclasses import replace

import numpy as np

from calibkit.estimation.board_poses import BoardPoses
from calibkit.estimation.joint_state import CameraState, JointState
from calibkit.estimation.time_offset import TimeOffsetFit
from calibkit.geometry import se3, so3
from calibkit.geometry.so3 import Array
from calibkit.geometry.spline import Knots, basis


def seed_trajectory(
    knots: Knots, poses: BoardPoses, lens: Array, fit: TimeOffsetFit, imu_t: Array, accel: Array, gravity: float
) -> JointState:
    """Return the start: the IMU in the camera's centre, as it is turned; g from the mean of all accelerations, which motion averages out.

    R_board_imu(t) = C(t) Q(t): Q is the gyroscope's orientation, C what joins it to the board's poses, linear between frames.
    """
    track, td = fit.alignment.track, fit.td
    R_cam_imu = fit.alignment.R
    T_board_cam = se3.inverse(poses.T_cam_board)
    t = np.asarray((poses.t_ns - track.origin_ns) * 1e-9 + td, np.float64)
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
    bias = np.tile(np.concatenate([fit.gyro_bias, np.zeros(3)]), (knots.controls, 1))
    camera = CameraState(se3.make(R_cam_imu, np.zeros(3)), td, lens)
    return JointState(oriented(centre), p, bias, (camera,), -gravity * up / np.linalg.norm(up))


def camera_beside(start: JointState, knots: Knots, poses: BoardPoses, lens: Array, fit: TimeOffsetFit, origin_ns: int) -> JointState:
    """Return the start with one more camera: as it is turned, and with the IMU where its frames have it (medians)."""
    i, u = knots.locate(np.asarray((poses.t_ns - origin_ns) * 1e-9 + fit.td, np.float64))
    p = np.einsum("nl,nlk->nk", basis(knots, u), start.p[i[:, None] + np.arange(knots.order)])
    seen = se3.transform(poses.T_cam_board, p[:, None])[:, 0]
    return replace(start, cameras=(*start.cameras, CameraState(se3.make(fit.alignment.R, np.median(seen, axis=0)), fit.td, lens)))
