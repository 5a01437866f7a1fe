"""Cameras and an IMU on one trajectory: what is measured when, the start, and the fit."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibkit.data.observations import BoardViews, ImuSamples
from calibkit.data.progress import Progress, silent
from calibkit.data.rig import Camera
from calibkit.errors import BadInputError
from calibkit.estimation.board_poses import BoardPoses, board_poses
from calibkit.estimation.board_turns import turns_of_board
from calibkit.estimation.camera_problem import CameraViews
from calibkit.estimation.joint_fit import JointFit, fit_joint
from calibkit.estimation.joint_knots import ORDER, Fineness, fineness
from calibkit.estimation.joint_noise import sample_sigmas
from calibkit.estimation.joint_problem import Frames, GravityPrior, ImuRows, JointProblem
from calibkit.estimation.joint_seed import camera_beside, seed_trajectory
from calibkit.estimation.lens_fit import dense_views, rows_of
from calibkit.estimation.time_offset import Settings as TurnSettings
from calibkit.estimation.time_offset import TimeOffsetFit, fit_time_offset
from calibkit.estimation.turns import in_order
from calibkit.geometry.so3 import Array
from calibkit.geometry.spline import Knots
from calibkit.models.imu import STANDARD_GRAVITY

_STANDARD = GravityPrior(STANDARD_GRAVITY.value, STANDARD_GRAVITY.sigma)
_LEAST_S = 1.0
_MARGIN_S = 0.01  # frames so near an end of the IMU's samples are left out: td may move


@dataclass(frozen=True)
class ImuNoise:
    """White noise and bias walks of an IMU: densities as Kalibr has them, None where they are not known."""

    gyro_noise_density: float | None = None
    gyro_random_walk: float | None = None
    accel_noise_density: float | None = None
    accel_random_walk: float | None = None


# A consumer MEMS IMU's, where no `allan` told: what the walks are hardly changes the result (tests), and it is said that they are taken.
TYPICAL_WALKS = (2e-5, 1e-3)


@dataclass(frozen=True)
class CameraInput:
    """One camera's corners and its lens as known so far."""

    views: BoardViews
    camera: Camera
    lens_prior: tuple[Array, Array] | None = None  # lens and information, where these come from another recording


@dataclass(frozen=True)
class Settings:
    gravity: GravityPrior = _STANDARD
    spacing: float | None = None  # s, of the knots; None: chosen by the IMU's samples


@dataclass(frozen=True)
class Joint:
    """The fit with what it was made from."""

    fit: JointFit
    origin_ns: int
    poses: tuple[BoardPoses, ...]
    turns: tuple[TimeOffsetFit, ...]
    frames: tuple[Array, ...]  # per camera: rows of its views that took part
    fineness: Fineness
    rate_hz: float
    densities_told: tuple[bool, bool]  # white noise of gyroscope and accelerometer
    walks_told: tuple[bool, bool]

    @property
    def frames_left_out(self) -> int:
        """Return how many frames with a pose of the board lie outside of the IMU's samples."""
        return sum(len(pose.frame) - len(rows) for pose, rows in zip(self.poses, self.frames, strict=True))


def calibrate_joint(
    cameras: Sequence[CameraInput], imu: ImuSamples, noise: ImuNoise, settings: Settings | None = None, progress: Progress = silent
) -> Joint:
    """Return the joint maximum-likelihood estimate of T_cam_imu, dt, lenses, gravity and biases.

    BadInputError where cameras and IMU share no time or cannot be brought together.
    """
    settings = settings or Settings()
    order = in_order(imu.t_ns)
    imu = imu.select(order)
    poses = [board_poses(each.views, each.camera) for each in progress(cameras, "board poses", len(cameras))]
    turns = [fit_time_offset(turns_of_board(each), imu, TurnSettings()) for each in progress(poses, "time offset", len(poses))]
    origin = turns[0].alignment.track.origin_ns
    t = (imu.t_ns - origin) * 1e-9
    times = [(each.views.t_ns - origin) * 1e-9 for each in cameras]
    seen = [at[each.frame] + turn.td for at, each, turn in zip(times, poses, turns, strict=True)]
    low = max(t[0], min(each.min() for each in seen) - 2 * _MARGIN_S)
    high = min(t[-1], max(each.max() for each in seen) + 2 * _MARGIN_S)
    if high - low < _LEAST_S:
        raise BadInputError("cameras and IMU share too little time: record both at once, 10 s or more")
    inside = (t >= low) & (t <= high)
    rates = np.concatenate([imu.gyro, imu.accel], axis=1)[inside]
    fine = fineness(t[inside], rates)
    spacing = settings.spacing or fine.chosen
    knots = Knots(float(low), spacing, ORDER, int(np.ceil((high - low) / spacing)))
    rate_hz = float(1 / np.median(np.diff(t[inside])))
    rows = ImuRows(t[inside], rates[:, :3], rates[:, 3:], *_noise(noise, rates, rate_hz), np.ones((len(rates), 2), bool))

    start, grids, used = None, [], []
    for each, at, pose, turn in zip(cameras, times, poses, turns, strict=True):
        frames = pose.frame[(at[pose.frame] + turn.td > low + _MARGIN_S) & (at[pose.frame] + turn.td < high - _MARGIN_S)]
        lens = np.array([each.camera.parameters[name].value for name in each.camera.parameters], float)
        grids.append(Frames(at[frames], _grid(each, frames)))
        used.append(frames)
        start = (
            seed_trajectory(knots, pose, lens, turn, rows.t, rows.accel, settings.gravity.size)
            if start is None
            else camera_beside(start, knots, pose, lens, turn, origin)
        )
    assert start is not None
    problem = JointProblem(
        knots, cameras[0].views.board.points, rows, tuple(grids), settings.gravity, lens_priors=tuple(each.lens_prior for each in cameras)
    )
    fit = fit_joint(problem, start)
    told = (noise.gyro_noise_density is not None, noise.accel_noise_density is not None)
    walks = (noise.gyro_random_walk is not None, noise.accel_random_walk is not None)
    return Joint(fit, origin, tuple(poses), tuple(turns), tuple(used), fine, rate_hz, told, walks)


def _grid(each: CameraInput, frames: Array) -> CameraViews:
    grid = dense_views(each.views, each.camera.model, np.arange(each.views.n_frames))
    keep = np.zeros(each.views.n_frames, bool)
    keep[frames] = True
    return rows_of(grid, keep)


def _noise(noise: ImuNoise, rates: Array, rate_hz: float) -> tuple[Array, Array]:
    """Return sigma of one sample and walk of each axis (6,): as told, else by the samples themselves and as usual."""
    sigma, root = sample_sigmas(rates), np.sqrt(rate_hz)
    for part, density in ((slice(0, 3), noise.gyro_noise_density), (slice(3, 6), noise.accel_noise_density)):
        if density is not None:
            sigma[part] = density * root
    walks = [TYPICAL_WALKS[k] if walk is None else walk for k, walk in enumerate((noise.gyro_random_walk, noise.accel_random_walk))]
    return np.maximum(sigma, 1e-9), np.repeat(walks, 3)
