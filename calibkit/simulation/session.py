"""One run of a scenario: where everything was, when each sensor looked, and what its stamps say."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibkit.data.observations import BoardViews, ImuSamples, Times
from calibkit.geometry import se3
from calibkit.models.board import Board
from calibkit.simulation.camera import SimCamera, place_board
from calibkit.simulation.corners import ViewsTruth, views_of_poses
from calibkit.simulation.imu import ImuTruth, simulate_imu
from calibkit.simulation.scenarios import Scenario
from calibkit.simulation.trajectory import MOTIONS, R_WORLD_CAM_AT_REST, Trajectory, make_trajectory

Array = NDArray[np.float64]

START_NS = 1_700_000_000_000_000_000  # what the IMU's clock shows when the trajectory's time is 0
_CAMERA_LATENCY_NS = 12_000_000  # from exposure to record
_IMU_LATENCY_NS = 1_000_000

# Independent random streams, so that a change in one part leaves the others as they were.
_MOTION, _IMU, _FAULTS, _CORNERS, _IMAGES = range(5)


@dataclass(frozen=True)
class Track:
    """What one camera took: when it truly looked, what its stamps say, when the frames were recorded."""

    camera: SimCamera
    t_true_ns: Times  # (f,) on the IMU's clock
    stamp_ns: Times  # (f,) on the camera's own clock, faults included
    record_ns: Times  # (f,)


@dataclass(frozen=True)
class Session:
    """A simulated recording before anything is rendered or written."""

    scenario: Scenario
    seed: int
    trajectory: Trajectory
    T_world_board: Array  # (4, 4)
    tracks: tuple[Track, ...]
    imu: ImuSamples | None
    imu_record_ns: Times  # (n,)
    imu_truth: ImuTruth | None
    board_told: Board  # the board as target.yaml describes it

    def T_cam_board(self, track: Track) -> Array:
        """Return where the board was for each frame of a track, (f, 4, 4)."""
        T_world_imu = self.trajectory.at((track.t_true_ns - START_NS) * 1e-9).T_world_imu
        return se3.inverse(T_world_imu @ track.camera.T_imu_cam) @ self.T_world_board

    def rng(self, part: int, index: int = 0) -> np.random.Generator:
        """Return the random numbers of one part of this run."""
        return np.random.default_rng((self.seed, part, index))

    def fault_rng(self, index: int) -> np.random.Generator:
        """Return the random numbers of the fault at this place in the list."""
        return self.rng(_FAULTS, index)

    def image_rng(self, camera: int) -> np.random.Generator:
        """Return the random numbers of one camera's sensor noise."""
        return self.rng(_IMAGES, camera)


def _times(start_ns: int, duration_s: float, rate_hz: float) -> Times:
    return start_ns + np.round(np.arange(round(duration_s * rate_hz)) * (1e9 / rate_hz)).astype(np.int64)


def simulate_session(scenario: Scenario, seed: int = 0) -> Session:
    """Return the scenario's run with this seed, without its faults (`faults.apply_faults`)."""
    rngs = [np.random.default_rng((seed, part, 0)) for part in (_MOTION, _IMU)]
    T_imu_cam = scenario.cameras[0].T_imu_cam
    trajectory = make_trajectory(MOTIONS[scenario.motion].at_speed(scenario.speed), scenario.distance, T_imu_cam, rngs[0])
    T_cam_board = place_board(scenario.board, np.eye(3), np.array([0, 0, scenario.distance]))
    imu, imu_truth, imu_times = None, None, np.zeros(0, np.int64)
    if scenario.imu is not None:
        imu_times = _times(START_NS, scenario.duration_s, scenario.imu.rate_hz)
        imu, imu_truth = simulate_imu(scenario.imu, trajectory.at((imu_times - START_NS) * 1e-9), imu_times, rngs[1])
    return Session(
        scenario=scenario,
        seed=seed,
        trajectory=trajectory,
        T_world_board=se3.make(R_WORLD_CAM_AT_REST, np.zeros(3)) @ T_cam_board,
        tracks=tuple(_track(camera, scenario.duration_s) for camera in scenario.cameras),
        imu=imu,
        imu_record_ns=imu_times + _IMU_LATENCY_NS,
        imu_truth=imu_truth,
        board_told=scenario.board,
    )


def _track(camera: SimCamera, duration_s: float) -> Track:
    # Half a period in, and off the IMU's own instants.
    first = START_NS + round(0.5e9 / camera.rate_hz) + 1_234_567
    true = _times(first, duration_s, camera.rate_hz)
    return Track(camera, true, true - round(camera.dt_imu_cam * 1e9), true + _CAMERA_LATENCY_NS)


def simulate_views(session: Session, noise_px: float = 0.2, camera: int = 0) -> tuple[BoardViews, ViewsTruth]:
    """Return the corners that one camera of the run would find, with its stamps, and the truth: no images needed."""
    track = session.tracks[camera]
    return views_of_poses(
        track.camera, session.scenario.board, session.T_cam_board(track), session.rng(_CORNERS, camera), noise_px, track.stamp_ns
    )
