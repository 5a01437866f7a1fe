"""Recordings of two sensors on one rig whose clocks are apart by a known offset, for the tests of the time offset."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibkit.data.observations import ImuSamples, PoseSamples, Times
from calibkit.data.rig import Camera
from calibkit.data.verdict import Status, Verdict
from calibkit.estimation.board_poses import board_poses
from calibkit.estimation.board_turns import turns_of_board
from calibkit.estimation.stamps import check_stamps
from calibkit.estimation.time_offset import Settings, TimeOffsetFit, fit_time_offset
from calibkit.estimation.time_offset_verdict import Judged, judge_time_offset
from calibkit.estimation.turns import Turns, turns_of_gyro, turns_of_poses
from calibkit.estimation.two_view import turns_of_tracks
from calibkit.geometry import so3
from calibkit.simulation.faults import apply_faults
from calibkit.simulation.features import simulate_tracks
from calibkit.simulation.imu import SimImu, simulate_imu
from calibkit.simulation.scenarios import SCENARIOS
from calibkit.simulation.session import START_NS, Session, simulate_session, simulate_views
from calibkit.simulation.trajectory import MOTIONS, Motion, Trajectory, make_trajectory
from calibkit.simulation.truth import true_rig

Array = NDArray[np.float64]

R_OF_TO: Array = so3.exp(np.array([0.7, -1.9, 1.1]))  # of most pairs: far from identity, no entry zero
SILENT = SimImu(
    gyro_noise_density=0, gyro_random_walk=0, accel_noise_density=0, accel_random_walk=0, gyro_bias=(0, 0, 0), accel_bias=(0, 0, 0)
)
WEAK = "weak:"  # a reason that a good recording may have: it says no more than its sigma


@dataclass(frozen=True)
class Sample:
    """What two sensors saw: t_to = t_of + td."""

    turns: Turns
    of_t_ns: Times  # every stamp of `of`, in the recording's order
    reference: ImuSamples | PoseSamples
    td: float  # s, the truth

    @property
    def fitted(self) -> TimeOffsetFit:
        return fit_time_offset(self.turns, self.reference, Settings())


def any_offset(seed: int, most: float = 0.2) -> float:
    """An offset of this seed, uniform within +-`most` s."""
    return float(np.random.default_rng((seed, 77)).uniform(-most, most))


def judged(sample: Sample, fit: TimeOffsetFit) -> Judged:
    stamps = {"cam0": check_stamps(sample.of_t_ns), "imu0": check_stamps(sample.reference.t_ns)}
    return judge_time_offset("dt_imu0_cam0", "cam0", "imu0", fit, stamps)


def alarms(told: Judged) -> list[str]:
    """What a good recording must not be told: everything but that it is weak."""
    return [reason.text for reason in told.reasons if reason.verdict is not Verdict.PASS and WEAK not in reason.text]


def told(sample: Sample) -> tuple[TimeOffsetFit, Judged]:
    fit = sample.fitted
    return fit, judged(sample, fit)


def refused(sample: Sample) -> bool:
    """Whether the offset of this recording comes out as not observable."""
    return told(sample)[1].status is Status.NOT_OBSERVABLE


# A camera before a board, or before things, and an IMU of 200 Hz.


def camera_session(
    seed: int,
    td: float,
    speed: float = 1.0,
    faults: tuple[str, ...] = (),
    duration_s: float = 60.0,
    motion: str = "rich",
    imu: SimImu | None = None,
) -> Session:
    """A camera of 20 Hz on a rig that turns at about `speed` rad/s in the middle (measured: 0.97 times as fast)."""
    scenario = SCENARIOS["cam-imu"]
    camera = replace(scenario.cameras[0], rate_hz=20.0, dt_imu_cam=td)
    scenario = replace(scenario, cameras=(camera,), duration_s=duration_s, speed=speed, motion=motion, imu=imu or scenario.imu)
    return apply_faults(simulate_session(scenario, seed), faults)


def lens(session: Session) -> Camera:
    return true_rig(session, "test").cameras["cam0"]


def board_sample(session: Session, noise_px: float = 0.2) -> Sample:
    assert session.imu is not None
    views, _ = simulate_views(session, noise_px)
    turns = turns_of_board(board_poses(views, lens(session)))
    return Sample(turns, session.tracks[0].stamp_ns, session.imu, session.tracks[0].camera.dt_imu_cam)


def feature_sample(session: Session) -> Sample:
    assert session.imu is not None
    tracks = simulate_tracks(session)
    return Sample(turns_of_tracks(tracks, lens(session)), tracks.t_ns, session.imu, session.tracks[0].camera.dt_imu_cam)


# Sensors on a trajectory of their own: `of` is mounted by R_OF_TO, and its clock is td behind that of `to`.


def path(seed: int, motion: str | Motion = "rich", speed: float = 1.0) -> Trajectory:
    chosen = MOTIONS[motion] if isinstance(motion, str) else motion
    return make_trajectory(chosen.at_speed(speed), 1.0, np.eye(4), np.random.default_rng((seed, 11)))


def constant_rate(omega: Array) -> Trajectory:
    """A turn at one rate (rad/s) about one axis for ever."""
    return Trajectory(np.eye(4), np.zeros(0), np.zeros(0), np.zeros((0, 6)), np.concatenate([np.zeros(3), omega]))


def stamps(rate_hz: float, duration_s: float, first_s: float = 0.0) -> Times:
    return START_NS + np.round((first_s + np.arange(round(duration_s * rate_hz)) / rate_hz) * 1e9).astype(np.int64)


def seen_poses(
    trajectory: Trajectory, t_ns: Times, noise: float, rng: np.random.Generator, R_body: Array | None = None, td: float = 0.0
) -> PoseSamples:
    """Poses with `noise` rad per axis, of a body whose axes are R_body's and whose clock is td behind."""
    T = trajectory.at((t_ns - START_NS) * 1e-9).T_world_imu
    R = T[:, :3, :3] @ (np.eye(3) if R_body is None else R_body) @ so3.exp(noise * rng.standard_normal((len(t_ns), 3)))
    return PoseSamples(t_ns - round(td * 1e9), so3.to_quat(R), T[:, :3, 3], "world", "body")


def seen_gyro(
    trajectory: Trajectory, t_ns: Times, rng: np.random.Generator, imu: SimImu | None = None, R_body: Array | None = None, td: float = 0.0
) -> ImuSamples:
    """What a gyroscope on a body with axes R_body tells, its clock td behind."""
    state = trajectory.at((t_ns - START_NS) * 1e-9)
    state = state if R_body is None else replace(state, omega_i=state.omega_i @ R_body)
    return replace(simulate_imu(imu or SimImu(), state, t_ns, rng)[0], t_ns=t_ns - round(td * 1e9))


def pose_imu(trajectory: Trajectory, seed: int, td: float, noise: float, duration_s: float = 60.0, rate_hz: float = 20.0) -> Sample:
    rng = np.random.default_rng((seed, 1))
    poses = seen_poses(trajectory, stamps(rate_hz, duration_s - 2, 1.0123), noise, rng, R_OF_TO.T, td)
    return Sample(turns_of_poses(poses), poses.t_ns, seen_gyro(trajectory, stamps(200, duration_s), rng), td)


def pose_pose(trajectory: Trajectory, seed: int, td: float, noise: float = 1e-3, duration_s: float = 60.0) -> Sample:
    """Motion capture of 100 Hz, and poses of 22 Hz of which each has twice its noise."""
    rng = np.random.default_rng((seed, 2))
    slow = seen_poses(trajectory, stamps(22, duration_s - 10, 5.0123), 2 * noise, rng, R_OF_TO.T, td)
    return Sample(turns_of_poses(slow), slow.t_ns, seen_poses(trajectory, stamps(100, duration_s), noise, rng), td)


def imu_imu(trajectory: Trajectory, seed: int, td: float, duration_s: float = 60.0) -> Sample:
    rng = np.random.default_rng((seed, 3))
    second = replace(SimImu(), gyro_bias=(-0.02, 0.01, 0.015), gyro_noise_density=4e-4)
    slow = seen_gyro(trajectory, stamps(100, duration_s - 10, 5.0023), rng, second, R_OF_TO.T, td)
    return Sample(turns_of_gyro(slow), slow.t_ns, seen_gyro(trajectory, stamps(200, duration_s), rng), td)


def wheels_imu(seed: int, td: float, duration_s: float = 60.0) -> Sample:
    """A vehicle's yaw rate at 30 Hz with 5 mrad/s of noise; the IMU is mounted askew."""
    rng = np.random.default_rng((seed, 4))
    # In the planar motion the camera looks ahead and turns about its y axis, which points down.
    trajectory = path(seed, "planar")
    t_ns = stamps(30, duration_s - 10, 5.0023)
    yaw = -trajectory.at((t_ns - START_NS) * 1e-9).omega_i[:, 1] + 0.005 * rng.standard_normal(len(t_ns))
    wheels = ImuSamples(t_ns - round(td * 1e9), np.stack([0 * yaw, 0 * yaw, yaw], axis=1), np.zeros((len(t_ns), 0)))
    return Sample(turns_of_gyro(wheels), wheels.t_ns, seen_gyro(trajectory, stamps(200, duration_s), rng, R_body=R_OF_TO), td)
