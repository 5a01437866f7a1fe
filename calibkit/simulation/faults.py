"""What goes wrong with real recordings, as a table: each fault turns a session into the one that would have been recorded."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calibkit.data.observations import ImuSamples
from calibkit.errors import BadInputError, one_line
from calibkit.models.board import AprilGrid, Charuco, Checkerboard, CircleGrid
from calibkit.models.imu import STANDARD_GRAVITY
from calibkit.simulation.session import Session, Track

Fault = Callable[[Session, np.random.Generator], Session]
Mask = NDArray[np.bool_]

# Which fields of a board are lengths that a person may have measured wrongly.
_LENGTHS = {
    AprilGrid.kind: ("tag_size",),
    Checkerboard.kind: ("column_spacing", "row_spacing"),
    Charuco.kind: ("square_size", "marker_size"),
    CircleGrid.kind: ("spacing",),
}


def _tracks(change: Callable[[Track, np.random.Generator], Track]) -> Fault:
    """Return the fault that changes every camera's track."""
    return lambda session, rng: replace(session, tracks=tuple(change(track, rng) for track in session.tracks))


def _imu(change: Callable[[ImuSamples, np.random.Generator], ImuSamples]) -> Fault:
    """Return the fault that changes the IMU's samples one by one; a rig without an IMU stays as it is."""
    return lambda session, rng: session if session.imu is None else replace(session, imu=change(session.imu, rng))


def _keep(track: Track, keep: Mask) -> Track:
    return replace(track, t_true_ns=track.t_true_ns[keep], stamp_ns=track.stamp_ns[keep], record_ns=track.record_ns[keep])


def _outside_gap(times: NDArray[np.int64], seconds: float) -> Mask:
    """Return which instants lie outside a gap in the middle."""
    middle = (times[0] + times[-1]) / 2
    out: Mask = np.abs(times - middle) > seconds / 2 * 1e9
    return out


def _one_stamp_off(track: Track, rng: np.random.Generator) -> Track:
    stamps = track.stamp_ns.copy()
    stamps[rng.integers(len(stamps))] += 50_000_000
    return replace(track, stamp_ns=stamps)


def _drops(share: float) -> Fault:
    return _tracks(lambda track, rng: _keep(track, rng.random(len(track.stamp_ns)) > share))


def _stamped(late_ns: Callable[[NDArray[np.int64], np.random.Generator], NDArray[np.float64]]) -> Fault:
    """Return the fault that makes every camera's stamps (f,) late by so many ns; td = t_imu - t_cam falls by as much."""
    return _tracks(lambda track, rng: replace(track, stamp_ns=track.stamp_ns + np.round(late_ns(track.stamp_ns, rng)).astype(np.int64)))


def _jitter(sigma_ns: float) -> Fault:
    return _stamped(lambda stamps, rng: rng.normal(0, sigma_ns, len(stamps)))


def _duplicate_stamps(track: Track, rng: np.random.Generator) -> Track:
    stamps = track.stamp_ns.copy()
    again = 1 + rng.choice(len(stamps) - 1, max(1, len(stamps) // 20), replace=False)
    stamps[again] = stamps[again - 1]
    return replace(track, stamp_ns=stamps)


def _one_zero_stamp(track: Track, rng: np.random.Generator) -> Track:
    stamps = track.stamp_ns.copy()
    stamps[rng.integers(len(stamps))] = 0
    return replace(track, stamp_ns=stamps)


def _imu_gap(session: Session, rng: np.random.Generator) -> Session:
    if session.imu is None or session.imu_truth is None:
        return session
    keep = _outside_gap(session.imu.t_ns, 0.5)
    return replace(
        session,
        imu=ImuSamples(session.imu.t_ns[keep], session.imu.gyro[keep], session.imu.accel[keep]),
        imu_record_ns=session.imu_record_ns[keep],
        imu_truth=replace(session.imu_truth, gyro_bias=session.imu_truth.gyro_bias[keep], accel_bias=session.imu_truth.accel_bias[keep]),
    )


def _accel_spike(imu: ImuSamples, rng: np.random.Generator) -> ImuSamples:
    accel = imu.accel.copy()
    accel[rng.integers(len(accel)), rng.integers(3)] = 400.0
    return replace(imu, accel=accel)


def _board_size(session: Session, rng: np.random.Generator) -> Session:
    board = session.board_told
    lengths = {name: getattr(board, name) * 10 / 11 for name in _LENGTHS[board.kind]}
    return replace(session, board_told=replace(board, **lengths))  # type: ignore[type-var]


def _tag_spacing(session: Session, rng: np.random.Generator) -> Session:
    if not isinstance(session.board_told, AprilGrid):
        raise BadInputError("the fault tag-spacing is for AprilGrids only: choose another fault or scenario")
    return replace(session, board_told=replace(session.board_told, spacing=session.board_told.spacing * 2 / 3))


FAULTS: dict[str, tuple[str, Fault]] = {
    "image-drops": ("a tenth of the images is lost", _drops(0.1)),
    "image-drops-30": ("three in ten images are lost", _drops(0.3)),
    "image-gap": (
        "3 s without images",
        _tracks(lambda track, rng: _keep(track, _outside_gap(track.t_true_ns, 3.0))),
    ),
    "image-jitter": ("image stamps with 10 ms of noise", _jitter(10e6)),
    "image-jitter-2": ("image stamps with 2 ms of noise", _jitter(2e6)),
    "image-late": ("images stamped 5 s late: td = t_imu - t_cam is 5 s less", _stamped(lambda stamps, rng: np.full(len(stamps), 5e9))),
    "image-skew": (
        "the camera's clock is 50 ppm fast: td = t_imu - t_cam is true at the first image and falls by 0.05 ms a second",
        _stamped(lambda stamps, rng: (stamps - stamps[0]) * 50e-6),
    ),
    "image-step": (
        "image stamps 33 ms late from half-way on: td = t_imu - t_cam falls by 33 ms there",
        _stamped(lambda stamps, rng: np.where(stamps < (stamps[0] + stamps[-1]) / 2, 0.0, 33e6)),
    ),
    "image-stamp": ("one image stamp 50 ms off", _tracks(_one_stamp_off)),
    "duplicate-stamps": ("one image in twenty repeats the stamp before", _tracks(_duplicate_stamps)),
    "zero-stamp": ("one image stamp is zero", _tracks(_one_zero_stamp)),
    "zero-stamps": ("all image stamps are zero", _tracks(lambda track, rng: replace(track, stamp_ns=np.zeros_like(track.stamp_ns)))),
    "imu-gap": ("0.5 s without IMU", _imu_gap),
    "accel-spike": ("one accelerometer value of 400 m/s^2", _imu(_accel_spike)),
    "accel-in-g": ("accelerometer in g", _imu(lambda imu, rng: replace(imu, accel=imu.accel / STANDARD_GRAVITY.value))),
    "gyro-in-deg": ("gyroscope in deg/s", _imu(lambda imu, rng: replace(imu, gyro=np.degrees(imu.gyro)))),
    "board-size": ("target.yaml has the board a tenth too small (0.080 m for 0.088 m)", _board_size),
    "tag-spacing": ("target.yaml has tagSpacing 0.2 for 0.3", _tag_spacing),
}


def apply_faults(session: Session, names: Sequence[str]) -> Session:
    """Return the session with the named faults, in that order; unknown names are a BadInputError."""
    for index, name in enumerate(names):
        if name not in FAULTS:
            raise BadInputError(f"there is no fault {one_line(name, 60)}: give one of {', '.join(FAULTS)}")
        session = FAULTS[name][1](session, session.fault_rng(index))
        if any(len(track.stamp_ns) < 2 for track in session.tracks) or (session.imu is not None and len(session.imu.t_ns) < 2):
            raise BadInputError(f"the recording is too short for the fault {name}: give a longer duration")
    return session
