"""Faulty recordings: each is survived, right within 3 sigma, or named with its cause and a code other than 0; never wrong with code 0."""

import re
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from joint_samples import Recording, error_of, recorded

from calibkit.data.result import Result
from calibkit.data.verdict import Verdict
from calibkit.errors import BadInputError
from calibkit.estimation.joint import Joint
from calibkit.estimation.joint_trust import joint_trust

Change = Callable[[Recording], Recording]


def fault(name: str) -> Callable[[int], Recording]:
    """One of the simulation's faults."""
    return lambda seed: recorded(seed, faults=(name,))


def changed(change: Change) -> Callable[[int], Recording]:
    return lambda seed: change(recorded(seed))


def only_frames(recording: Recording, keep: slice | list[int]) -> Recording:
    rows = np.arange(recording.views.n_frames)[keep]
    return replace(recording, views=recording.views.select(rows))


def gyro(recording: Recording, M: list[list[float]], bias: tuple[float, float, float] = (0, 0, 0)) -> Recording:
    return replace(recording, imu=replace(recording.imu, gyro=recording.imu.gyro @ np.array(M).T + np.array(bias)))


def accel(recording: Recording, M: list[list[float]]) -> Recording:
    return replace(recording, imu=replace(recording.imu, accel=recording.imu.accel @ np.array(M).T))


def late(recording: Recording, seconds: float) -> Recording:
    views = replace(recording.views, t_ns=recording.views.t_ns + round(seconds * 1e9))
    return replace(recording, views=views, td=recording.td - seconds)


def gap_of_both(recording: Recording) -> Recording:
    """A second without anything, but that the IMU's is not the images'."""
    t = (recording.imu.t_ns - recording.imu.t_ns[0]) * 1e-9
    frames = (recording.views.t_ns - recording.imu.t_ns[0]) * 1e-9
    imu = recording.imu.select(np.flatnonzero((t < 10) | (t > 11)))
    return replace(recording, imu=imu, views=recording.views.select(np.flatnonzero((frames < 10.2) | (frames > 11.2))))


SWAP: list[list[float]] = [[0, 1, 0], [1, 0, 0], [0, 0, 1]]
FLIP: list[list[float]] = [[1, 0, 0], [0, 1, 0], [0, 0, -1]]
EYE: list[list[float]] = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]

# What a recording suffers, and what may be said beside the right answer ("" nothing).
SURVIVED: dict[str, tuple[Callable[[int], Recording], tuple[str, ...]]] = {
    "5 s late": (changed(partial(late, seconds=5.0)), ("clocks of different origins",)),
    "half a second late": (changed(partial(late, seconds=0.5)), ()),
    "an hour late": (changed(partial(late, seconds=3600.0)), ("clocks of different origins",)),
    "one acceleration of 400": (fault("accel-spike"), ()),
    "one stamp 50 ms off": (fault("image-stamp"), ("stamp",)),
    "one zero stamp": (fault("zero-stamp"), ("stamp of zero", "outside of what imu0 recorded")),
    "3 s without images": (fault("image-gap"), ("of the frames are missing",)),
    "half a second without IMU": (fault("imu-gap"), ()),
    "a second without both": (changed(gap_of_both), ("gap of up to 1 s",)),
    "a large bias": (changed(partial(gyro, M=EYE, bias=(0.5, -0.4, 0.3))), ()),
    "4 Hz": (changed(partial(only_frames, keep=slice(None, None, 5))), ()),
    "lost frames": (fault("image-drops-30"), ("of the frames are missing",)),
    "2 ms of jitter": (fault("image-jitter-2"), ("jitter",)),
}
# What it suffers, and how the first reason names it.
NAMED: dict[str, tuple[Callable[[int], Recording], str]] = {
    "10 ms of jitter": (fault("image-jitter"), "cam0: its stamps jitter by"),
    "accelerometer in g": (fault("accel-in-g"), "imu0's accelerometer reads 0.1"),
    "board a tenth too small": (fault("board-size"), r"the board seems 1\.(09|10)"),
    "tag spacing": (fault("tag-spacing"), "the board seems"),
    "gyroscope's axes swapped": (changed(partial(gyro, M=SWAP)), "imu0's gyroscope has its axes wrong: its x, y, z are the rig's y, x, z"),
    "gyroscope's axis flipped": (changed(partial(gyro, M=FLIP)), "imu0's gyroscope has its axes wrong: its x, y, z are the rig's x, y, -z"),
    "accelerometer's axes swapped": (
        changed(partial(accel, M=SWAP)),
        "imu0's accelerometer has its axes wrong: its x, y, z are the rig's y, x, z",
    ),
    "accelerometer's axis flipped": (
        changed(partial(accel, M=FLIP)),
        "imu0's accelerometer has its axes wrong: its x, y, z are the rig's x, y, -z",
    ),
}
ALIKE = {
    "a large bias",
    "a second without both",
    "accelerometer's axis flipped",
    "accelerometer in g",
    "half a second late",
    "an hour late",
    "4 Hz",
    "2 ms of jitter",
    "lost frames",
    "3 s without images",
    "tag spacing",
    "gyroscope's axes swapped",
    "gyroscope's axis flipped",
    "accelerometer's axes swapped",
}
REFUSED: dict[str, tuple[Callable[[int], Recording], str]] = {
    "gyroscope in deg/s": (fault("gyro-in-deg"), "--gyro-unit deg/s"),
    "4 images": (changed(partial(only_frames, keep=slice(0, None, 150))), "4 of .* images of cam0 show the board"),
    "all stamps zero": (fault("zero-stamps"), "no stamps"),
}


def fitted(recording: Recording) -> tuple[Joint, Result]:
    joint = recording.fitted()
    return joint, recording.result(joint)


def survives(name: str, seed: int, sigmas: float = 3.0) -> None:
    make, words = SURVIVED[name]
    recording = make(seed)
    joint, result = fitted(recording)
    where = joint.fit.problem.border.camera(0)
    T_dt = slice(where.start, where.start + 7)
    z = error_of(recording, joint)[T_dt] / np.sqrt(np.diag(joint_trust(joint.fit).cov))[T_dt]
    texts = [reason.text for reason in result.reasons]
    assert np.abs(z).max() < sigmas, (z.round(2), texts)
    assert result.verdict is not Verdict.FAIL, texts
    assert all(any(word in text for text in texts) for word in words), texts
    assert all(any(word in text for word in words) for text in texts), texts


def names(name: str, seed: int) -> None:
    make, cause = NAMED[name]
    _, result = fitted(make(seed))
    assert result.exit_code != 0
    fails = [reason.text for reason in result.reasons if reason.verdict is Verdict.FAIL]
    assert re.match(cause, fails[0]), fails


def some(names: Iterable[str]) -> list[object]:
    """Return all faults, those that have a like among the others, or in test_cli_joint, for the slow run."""
    return [pytest.param(name, marks=pytest.mark.slow) if name in ALIKE else name for name in names]


@pytest.mark.parametrize("name", some(SURVIVED))
def test_a_fault_is_survived(name: str) -> None:
    survives(name, 0)


@pytest.mark.parametrize("name", some(NAMED))
def test_a_fault_is_named(name: str) -> None:
    names(name, 0)


@pytest.mark.parametrize("name", REFUSED)
def test_a_fault_is_refused(name: str) -> None:
    make, why = REFUSED[name]
    with pytest.raises(BadInputError, match=why):
        make(0).fitted()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 10))
@pytest.mark.parametrize("name", [*SURVIVED, *NAMED])
def test_faults_over_many_seeds(name: str, seed: int) -> None:
    if name in SURVIVED:
        survives(name, seed, 3.7)  # the greatest of 7 numbers in 117 recordings: beyond by chance in one run of six
    else:
        names(name, seed)
