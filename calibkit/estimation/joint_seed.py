"""Where the joint estimator starts: rotation, offset and bias by how both turn, what that leaves open by how both accelerate."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibkit.data.observations import ImuSamples
from calibkit.data.verdict import Status
from calibkit.estimation.alignment_axes import open_axes
from calibkit.estimation.board_poses import BoardPoses
from calibkit.estimation.joint_accelerations import Accelerations, camera_accelerations, lag_of, rotation_of, turned_about
from calibkit.estimation.joint_state import CameraState, JointState
from calibkit.estimation.orientation_track import OrientationTrack
from calibkit.estimation.time_offset import Settings, TimeOffsetFit, called, fit_time_offset
from calibkit.estimation.time_offset_start import find_starts
from calibkit.estimation.time_offset_verdict import ALIKE, judge_time_offset
from calibkit.estimation.turns import Turns, turns_of_gyro
from calibkit.geometry import se3, so3
from calibkit.geometry.so3 import Array
from calibkit.geometry.spline import Knots, basis

TURNS, ACCELERATIONS, STAMPS = "turns", "accelerations", "stamps"
_APART_S, _RIVALS = 0.05, 3  # offsets that far apart are two; so many others are tried
_MOST = 0.5  # of the frames


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
    judged = judge_time_offset("dt", "cam", "imu", fit, {})
    axes = open_axes(fit.alignment)
    known = judged.status is not Status.NOT_OBSERVABLE or judged.coarse
    by_turns = CameraSeed(fit.alignment.R, fit.td, fit.gyro_bias, fit.alignment.track, TURNS)
    if known and not len(axes):
        return by_turns
    track = fit.alignment.track
    camera = camera_accelerations(poses, track.origin_ns, len(axes) < 3)
    td, td_by = fit.td, TURNS
    if not known:
        lag = None if camera is None else lag_of(camera, _seconds(imu, track), imu)
        td_by = STAMPS if lag is None else ACCELERATIONS
        td = lag if lag is not None else 0.0 if _overlap(poses, imu) else td
    return _turned(replace(by_turns, td=td, td_by=td_by), camera, axes, imu)


@dataclass(frozen=True)
class ImuSeed:
    """A further IMU's start."""

    R_imu_ref: Array  # (3, 3)
    td: float  # s, t_ref = t_imu + td
    turns: TimeOffsetFit  # of its gyroscope against the reference's


def seed_imu(imu: ImuSamples, name: str, reference: ImuSamples, poses: BoardPoses, turned: Turns, seed: CameraSeed) -> ImuSeed:
    """Return a further IMU's start: as both gyroscopes turn, or through a camera where those do not tell."""
    with called(name, "the reference IMU"):
        fit = fit_time_offset(turns_of_gyro(imu), reference, Settings())
    judged = judge_time_offset("dt", "ref", "imu", fit, {})
    if judged.status is not Status.NOT_OBSERVABLE and not len(open_axes(fit.alignment)):
        return ImuSeed(fit.alignment.R, fit.td, fit)
    with called("the first", name):
        through = seed_camera(poses, fit_time_offset(turned, imu, Settings()), imu)
    return ImuSeed(through.R_cam_imu.T @ seed.R_cam_imu, seed.td - through.td, fit)


def _turned(seed: CameraSeed, camera: Accelerations | None, axes: Array, imu: ImuSamples) -> CameraSeed:
    """Return a start whose rotation is, about the axes that turns leave open, that of the accelerations."""
    if camera is None or not len(axes):
        return seed
    t = _seconds(imu, seed.track)
    one = len(axes) == 1
    R = turned_about(camera, t, imu, seed.td, seed.R_cam_imu, axes[0]) if one else rotation_of(camera, t, imu, seed.td)
    return seed if R is None else replace(seed, R_cam_imu=R)


def _seconds(imu: ImuSamples, track: OrientationTrack) -> Array:
    return np.asarray((imu.t_ns - track.origin_ns) * 1e-9, np.float64)


def rival_seeds(
    poses: Sequence[BoardPoses], turned: Sequence[Turns], fits: Sequence[TimeOffsetFit], imu: ImuSamples, seeds: tuple[CameraSeed, ...]
) -> list[tuple[CameraSeed, ...]]:
    """Return other starts for all cameras at once, where motion repeats itself and turns alone do not tell which offset is right."""
    if not any(_doubtful(*each, imu) for each in zip(poses, fits, strict=True)):
        return []
    found = [_rivals(*each, imu) for each in zip(poses, turned, fits, strict=True)]
    first = seeds[0]
    shifts = [other for other in found[0] if abs(other.td - first.td) > _APART_S][:_RIVALS]
    beside = list(zip(seeds[1:], found[1:], strict=True))
    return [(other, *(_nearest([seed, *own], seed.td + other.td - first.td) for seed, own in beside)) for other in shifts]


def _nearest(seeds: list[CameraSeed], td: float) -> CameraSeed:
    return min(seeds, key=lambda seed: abs(seed.td - td))


def _rivals(poses: BoardPoses, turned: Turns, fit: TimeOffsetFit, imu: ImuSamples) -> list[CameraSeed]:
    """Return a start for each offset at which turns are alike, the best one first."""
    track, axes = fit.alignment.track, open_axes(fit.alignment)
    camera = camera_accelerations(poses, track.origin_ns, len(axes) < 3) if len(axes) else None
    out = [CameraSeed(fit.alignment.R, fit.td, fit.gyro_bias, track, TURNS)]
    for start in find_starts(turned, track, None):
        td = start.coarse_ns * 1e-9
        if len(start.R) == 3 and all(abs(td - other.td) > _APART_S for other in out) and _overlap(poses, imu, td):
            out.append(replace(out[0], R_cam_imu=start.R, td=td))
    return [_turned(each, camera, axes, imu) for each in out]


def _doubtful(poses: BoardPoses, fit: TimeOffsetFit, imu: ImuSamples) -> bool:
    """Whether turns fit at another offset, or lay streams that by their stamps lie side by side mostly apart."""
    apart = _overlap(poses, imu) and not _overlap(poses, imu, fit.td)
    return fit.gain >= ALIKE and (fit.second is not None or apart)


def _overlap(poses: BoardPoses, imu: ImuSamples, td: float = 0.0) -> bool:
    """Whether most frames lie within the IMU's samples at an offset."""
    t_ns = poses.t_ns + round(td * 1e9)
    return float(np.mean((t_ns > imu.t_ns[0]) & (t_ns < imu.t_ns[-1]))) > _MOST


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
