"""Cameras and an IMU on one trajectory: what is measured when, the start, and the fit."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from threadpoolctl import threadpool_limits

from calibkit.data.observations import BoardViews, ImuSamples
from calibkit.data.plural import counted
from calibkit.data.progress import Progress, silent
from calibkit.data.rig import Camera
from calibkit.errors import BadInputError
from calibkit.estimation.board_poses import BoardPoses, board_poses
from calibkit.estimation.board_turns import turns_of_board
from calibkit.estimation.camera_problem import CameraViews
from calibkit.estimation.joint_fit import JointFit
from calibkit.estimation.joint_frozen import Frozen, without_frozen
from calibkit.estimation.joint_inertial import ImuBeside, ImuRows
from calibkit.estimation.joint_knots import ORDER, Fineness, fineness
from calibkit.estimation.joint_noise import sample_sigmas
from calibkit.estimation.joint_problem import Frames, GravityPrior, JointProblem
from calibkit.estimation.joint_rivals import Rival, fit_best
from calibkit.estimation.joint_seed import CameraSeed, ImuSeed, Posed, camera_beside, rival_seeds, seed_camera, seed_imu, seed_trajectory
from calibkit.estimation.joint_state import ImuState, JointState
from calibkit.estimation.lens_fit import dense_views, rows_of
from calibkit.estimation.time_offset import Settings as TurnSettings
from calibkit.estimation.time_offset import TimeOffsetFit, fit_time_offset
from calibkit.estimation.turns import in_order
from calibkit.geometry import se3
from calibkit.geometry.so3 import Array
from calibkit.geometry.spline import Knots
from calibkit.models.cameras import CAMERAS
from calibkit.models.imu import STANDARD_GRAVITY, ImuModel

_STANDARD = GravityPrior(STANDARD_GRAVITY.value, STANDARD_GRAVITY.sigma)
_LEAST_S = 1.0
_FEWEST_FRAMES = 20
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
    lens_given: bool = False  # it has no covariance and is held: no sigma holds its error


@dataclass(frozen=True)
class Settings:
    gravity: GravityPrior = _STANDARD
    spacing: float | None = None  # s, of the knots; None: chosen by the IMU's samples
    imu: ImuModel = field(default_factory=ImuModel)  # scale, misalignment and sensitivity as known so far; its biases are not used
    imu_information: Array | None = None  # about what is free of it, in the order of joint_state.IMU_MODEL; None: nothing is known
    extras: tuple[str, ...] = ()  # of joint_state.EXTRAS: what else is free


@dataclass(frozen=True)
class ImuGiven:
    """An IMU's samples, and what is known of it."""

    samples: ImuSamples
    noise: ImuNoise
    model: ImuModel = field(default_factory=ImuModel)  # as `Settings.imu`
    information: Array | None = None
    extras: tuple[str, ...] = ()  # of joint_state.IMU_MODEL
    name: str = "a further IMU"


@dataclass(frozen=True)
class ImuTold:
    """What an IMU's samples and the rig file told of it."""

    rate_hz: float
    densities: tuple[bool, bool]  # white noise of gyroscope and accelerometer
    walks: tuple[bool, bool]
    frozen: tuple[Frozen, ...] = ()  # left out


@dataclass(frozen=True)
class Joint:
    """The fit with what it was made from."""

    fit: JointFit
    origin_ns: int
    poses: tuple[BoardPoses, ...]
    turns: tuple[TimeOffsetFit, ...]
    seeds: tuple[CameraSeed, ...]
    frames: tuple[Array, ...]  # per camera: rows of its views that took part
    fineness: Fineness
    imus: tuple[ImuTold, ...]
    turns_of_imus: tuple[TimeOffsetFit, ...] = ()  # of further IMUs against the first one
    rival: Rival | None = None  # another solution that cannot be ruled out, where motion repeats itself

    @property
    def frames_left_out(self) -> int:
        """Return how many frames with a pose of the board lie outside of the IMU's samples."""
        return sum(len(pose.frame) - len(rows) for pose, rows in zip(self.poses, self.frames, strict=True))


def calibrate_joint(
    cameras: Sequence[CameraInput],
    imu: ImuSamples,
    noise: ImuNoise,
    settings: Settings | None = None,
    progress: Progress = silent,
    beside: Sequence[ImuGiven] = (),
) -> Joint:
    """Return the joint maximum-likelihood estimate of T_cam_imu, dt, lenses, gravity and biases, and T_imu_ref and dt of IMUs beside.

    BadInputError where cameras and IMUs share no time or cannot be brought together.
    """
    settings = settings or Settings()
    first = ImuGiven(imu, noise, settings.imu, settings.imu_information, settings.extras)
    with threadpool_limits(1, user_api="blas"):  # the matrices are small: threads of BLAS cost ten times what they bring
        return _calibrate(cameras, [_Measured.of(each) for each in (first, *beside)], settings, progress)


@dataclass(frozen=True)
class _Measured:
    """An IMU's samples in the order of time, without what was frozen."""

    samples: ImuSamples
    corrected: ImuSamples  # its scale and axes as known so far corrected: near enough for the start
    of_input: ImuGiven
    frozen: tuple[Frozen, ...]

    @classmethod
    def of(cls, each: ImuGiven) -> "_Measured":
        samples, frozen = without_frozen(each.samples.select(in_order(each.samples.t_ns)))
        accel, gyro = each.model.correct(samples.accel, samples.gyro)
        return cls(samples, replace(samples, accel=accel, gyro=gyro), each, frozen)

    @property
    def told(self) -> ImuTold:
        noise, rate_hz = self.of_input.noise, float(1e9 / np.median(np.diff(self.samples.t_ns)))
        densities = (noise.gyro_noise_density is not None, noise.accel_noise_density is not None)
        walks = (noise.gyro_random_walk is not None, noise.accel_random_walk is not None)
        return ImuTold(rate_hz, densities, walks, self.frozen)

    def rows(self, origin_ns: int, low: float, high: float) -> tuple[ImuRows, ImuSamples]:
        """Return the samples between two times on the IMU's own clock, s, and the same ones corrected."""
        t = np.asarray((self.samples.t_ns - origin_ns) * 1e-9, np.float64)
        inside = (t >= low) & (t <= high)
        rates = np.concatenate([self.samples.gyro, self.samples.accel], axis=1)[inside]
        rate_hz = float(1 / np.median(np.diff(t[inside])))
        noise = _noise(self.of_input.noise, rates, rate_hz)
        rows = ImuRows(t[inside], rates[:, :3], rates[:, 3:], *noise, np.ones((len(rates), 2), bool))
        return rows, self.corrected.select(inside)


def _calibrate(cameras: Sequence[CameraInput], imus: Sequence[_Measured], settings: Settings, progress: Progress) -> Joint:
    imu = imus[0].corrected
    poses = [_posed(each) for each in progress(cameras, "board poses", len(cameras))]
    turned = [turns_of_board(each) for each in poses]
    turns = [fit_time_offset(each, imu, TurnSettings()) for each in progress(turned, "time offset", len(poses))]
    seeds = tuple(seed_camera(pose, turn, imu) for pose, turn in zip(poses, turns, strict=True))
    others = progress(imus[1:], "time offset of IMUs", len(imus) - 1) if len(imus) > 1 else ()
    beside = tuple(seed_imu(each.corrected, each.of_input.name, imu, poses[0], turned[0], seeds[0]) for each in others)
    recorded = _Recorded(tuple(cameras), tuple(poses), turns[0].alignment.track.origin_ns, tuple(imus), beside, settings)
    begun = [_begin(recorded, seeds), *(_begin(recorded, each) for each in rival_seeds(poses, turned, turns, imu, seeds))]
    fit, best, rival = fit_best([(each.problem, each.start) for each in begun])
    chosen = begun[best]
    told, turns_of_imus = tuple(each.told for each in imus), tuple(each.turns for each in beside)
    return Joint(
        fit, recorded.origin_ns, recorded.poses, tuple(turns), chosen.seeds, chosen.used, chosen.fineness, told, turns_of_imus, rival
    )


@dataclass(frozen=True)
class _Recorded:
    """What was recorded, and where each camera had the board."""

    cameras: tuple[CameraInput, ...]
    poses: tuple[BoardPoses, ...]
    origin_ns: int
    imus: tuple[_Measured, ...]
    beside: tuple[ImuSeed, ...]
    settings: Settings


@dataclass(frozen=True)
class _Begun:
    """The problem of a start, and the start."""

    seeds: tuple[CameraSeed, ...]
    problem: JointProblem
    start: JointState
    used: tuple[Array, ...]  # per camera: rows of its views that take part
    fineness: Fineness


def _begin(recorded: _Recorded, seeds: tuple[CameraSeed, ...]) -> _Begun:
    cameras, settings = recorded.cameras, recorded.settings
    t = (recorded.imus[0].samples.t_ns - recorded.origin_ns) * 1e-9
    times = [np.asarray((each.t_ns - recorded.origin_ns) * 1e-9, np.float64) for each in recorded.poses]
    seen = [at + seed.td for at, seed in zip(times, seeds, strict=True)]
    low = max(t[0], min(each.min() for each in seen) - 2 * _MARGIN_S)
    high = min(t[-1], max(each.max() for each in seen) + 2 * _MARGIN_S)
    if high - low < _LEAST_S:
        raise BadInputError("cameras and IMU share too little time: record both at once, 10 s or more")
    rows, corrected = recorded.imus[0].rows(recorded.origin_ns, low, high)
    fine = fineness(rows.t, np.concatenate([rows.gyro, rows.accel], axis=1))
    spacing = settings.spacing or fine.chosen
    knots = Knots(float(low), spacing, ORDER, int(np.ceil((high - low) / spacing)))

    start, grids, used = None, [], []
    for each, pose, at, seed in zip(cameras, recorded.poses, times, seeds, strict=True):
        inner = (at + seed.td > low + _MARGIN_S) & (at + seed.td < high - _MARGIN_S)
        grids.append(Frames(at[inner], _grid(each, pose.frame[inner]), each.views.sigma_bias_px))
        used.append(pose.frame[inner])
        order = np.flatnonzero(inner)[np.argsort(at[inner], kind="stable")]
        posed = Posed(at[order], pose.T_cam_board[order], _lens(each.camera))
        start = (
            seed_trajectory(knots, posed, seed, rows.t, corrected.accel, settings.gravity.size)
            if start is None
            else camera_beside(start, knots, posed, seed)
        )
    assert start is not None
    problem = JointProblem(
        knots,
        cameras[0].views.board.points,
        rows,
        tuple(grids),
        settings.gravity,
        lens_priors=tuple(each.lens_prior for each in cameras),
        imu_prior=None if settings.imu_information is None else (settings.imu, settings.imu_information),
        extras=settings.extras,
        beside=tuple(_beside(*each, recorded.origin_ns, knots) for each in zip(recorded.imus[1:], recorded.beside, strict=True)),
    )
    delays = [0.0 if each.camera.line_delay is None else each.camera.line_delay.value or 0.0 for each in cameras]
    states = tuple(
        ImuState(se3.make(seed.R_imu_ref, np.zeros(3)), seed.td, np.zeros((knots.controls, 6)), each.of_input.model)
        for each, seed in zip(recorded.imus[1:], recorded.beside, strict=True)
    )
    shut = tuple(replace(x, line_delay=delay) for x, delay in zip(start.cameras, delays, strict=True))
    return _Begun(seeds, problem, replace(start, imu=settings.imu, cameras=shut, beside=states), tuple(used), fine)


def _beside(each: _Measured, seed: ImuSeed, origin_ns: int, knots: Knots) -> ImuBeside:
    """Return a further IMU's samples while the trajectory lasts."""
    end = knots.start + knots.segments * knots.spacing
    rows, _ = each.rows(origin_ns, knots.start + _MARGIN_S - seed.td, end - _MARGIN_S - seed.td)
    known = each.of_input
    return ImuBeside(rows, known.extras, None if known.information is None else (known.model, known.information))


def _posed(each: CameraInput) -> BoardPoses:
    poses = board_poses(each.views, each.camera)
    if len(poses.frame) < _FEWEST_FRAMES:
        of = f"{counted(each.views.n_images, 'image')} of {each.views.camera}"
        remedy = f"give {_FEWEST_FRAMES} or more, at 4 Hz or faster, and this board's target file"
        raise BadInputError(f"{len(poses.frame)} of {of} show the board well enough: {remedy}")
    return poses


def _lens(camera: Camera) -> Array:
    return np.array([camera.parameters[name].value for name in CAMERAS[camera.model].parameter_names], float)


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
