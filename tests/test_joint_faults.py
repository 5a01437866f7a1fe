"""Faulty recordings: each is survived, right within 3 sigma, or named with its cause and a code other than 0; never wrong with code 0."""

import re
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from joint_samples import Recording, error_of, of_camera, recorded
from numpy.typing import NDArray

from calibkit.data.result import Result
from calibkit.data.verdict import Verdict
from calibkit.errors import BadInputError
from calibkit.estimation.joint import CameraInput, Joint, calibrate_joint
from calibkit.estimation.joint_trust import joint_trust

Change = Callable[[Recording], Recording]


def fault(name: str) -> Callable[[int], Recording]:
    """One of the simulation's faults."""
    return lambda seed: recorded(seed, faults=(name,))


def changed(change: Change) -> Callable[[int], Recording]:
    return lambda seed: change(recorded(seed))


def only_frames(recording: Recording, keep: slice | NDArray[np.intp]) -> Recording:
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


def frozen(recording: Recording, sensors: tuple[str, ...], start: float, end: float) -> Recording:
    """Sensors of the IMU that keep one value from start to end, s."""
    t, imu = (recording.imu.t_ns - recording.imu.t_ns[0]) * 1e-9, recording.imu
    rows = np.flatnonzero((t >= start) & (t < end))
    values = {sensor: getattr(imu, sensor).copy() for sensor in sensors}
    for value in values.values():
        value[rows] = value[rows[0]]
    return replace(recording, imu=replace(imu, **values))


def dead_axis(recording: Recording) -> Recording:
    gyro = recording.imu.gyro * [1.0, 1.0, 0.0]
    return replace(recording, imu=replace(recording.imu, gyro=gyro))


def one_in_fifty_lost(recording: Recording) -> Recording:
    return only_frames(recording, np.flatnonzero(np.random.default_rng(recording.session.seed).random(recording.views.n_frames) > 0.02))


def without_images(recording: Recording, start: float, end: float) -> Recording:
    t = (recording.views.t_ns - recording.imu.t_ns[0]) * 1e-9
    return only_frames(recording, np.flatnonzero((t < start) | (t > end)))


SWAP: list[list[float]] = [[0, 1, 0], [1, 0, 0], [0, 0, 1]]
FLIP: list[list[float]] = [[1, 0, 0], [0, 1, 0], [0, 0, -1]]
EYE: list[list[float]] = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]

STUCK = "gave one and the same value, 1 time of up to 2 s, the longest 10 s in: frozen"

# What a recording suffers, and what may be said beside the right answer ("" nothing).
SURVIVED: dict[str, tuple[Callable[[int], Recording], tuple[str, ...]]] = {
    "5 s late": (changed(partial(late, seconds=5.0)), ("clocks of different origins",)),
    "half a second late": (changed(partial(late, seconds=0.5)), ()),
    "an hour late": (changed(partial(late, seconds=3600.0)), ("clocks of different origins",)),
    "one acceleration of 400": (fault("accel-spike"), ()),
    "one stamp 50 ms off": (fault("image-stamp"), ("stamp",)),
    "one zero stamp": (fault("zero-stamp"), ("stamp of zero", "outside of what imu0 recorded")),
    "3 s without images": (fault("image-gap"), ("cam0 has 1 gap of up to 3 s, the longest 13.47 s in", "of the frames are missing")),
    "1.2 s without images": (changed(partial(without_images, start=20, end=21.2)), ("cam0 has 1 gap of up to 1.2 s, the longest 19.9",)),
    "0.8 s without images": (changed(partial(without_images, start=20, end=20.8)), ()),
    "one frame in fifty lost": (changed(one_in_fifty_lost), ()),
    "half a second without IMU": (fault("imu-gap"), ()),
    "a second without both": (changed(gap_of_both), ("imu0 has 1 gap of up to 1 s", "cam0 has 1 gap of up to 1.1 s")),
    "a large bias": (changed(partial(gyro, M=EYE, bias=(0.5, -0.4, 0.3))), ()),
    "4 Hz": (changed(partial(only_frames, keep=slice(None, None, 5))), ()),
    "lost frames": (fault("image-drops-30"), ("of the frames are missing",)),
    "2 ms of jitter": (fault("image-jitter-2"), ("jitter",)),
    "IMU frozen for 2 s": (
        changed(partial(frozen, sensors=("gyro", "accel"), start=10, end=12)),
        (f"imu0's gyroscope and accelerometer {STUCK}",),
    ),
    "gyroscope frozen for 2 s": (changed(partial(frozen, sensors=("gyro",), start=10, end=12)), (f"imu0's gyroscope {STUCK}",)),
    "accelerometer frozen for 2 s": (changed(partial(frozen, sensors=("accel",), start=10, end=12)), (f"imu0's accelerometer {STUCK}",)),
    "IMU frozen for 0.3 s": (changed(partial(frozen, sensors=("gyro", "accel"), start=10, end=10.3)), ()),
}
# What it suffers, and how the first reason names it.
NAMED: dict[str, tuple[Callable[[int], Recording], str]] = {
    "10 ms of jitter": (fault("image-jitter"), "cam0: its stamps jitter by"),
    "accelerometer in g": (fault("accel-in-g"), r"imu0's accelerometer reads 0\.(1|09)"),
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
    "3 s without images",
    "one zero stamp",
    "5 s late",
    "10 ms of jitter",
    "one acceleration of 400",
    "one stamp 50 ms off",
    "half a second without IMU",
    "a large bias",
    "a second without both",
    "accelerometer's axis flipped",
    "accelerometer in g",
    "half a second late",
    "an hour late",
    "4 Hz",
    "2 ms of jitter",
    "lost frames",
    "tag spacing",
    "gyroscope's axes swapped",
    "gyroscope's axis flipped",
    "accelerometer's axes swapped",
    "1.2 s without images",
    "0.8 s without images",
    "one frame in fifty lost",
    "gyroscope frozen for 2 s",
    "accelerometer frozen for 2 s",
    "IMU frozen for 0.3 s",
}
REFUSED: dict[str, tuple[Callable[[int], Recording], str]] = {
    "gyroscope in deg/s": (fault("gyro-in-deg"), "--gyro-unit deg/s"),
    "4 images": (changed(partial(only_frames, keep=slice(0, None, 150))), "4 of .* images of cam0 show the board"),
    "all stamps zero": (fault("zero-stamps"), "no stamps"),
    "gyroscope frozen": (
        changed(partial(frozen, sensors=("gyro",), start=0, end=99)),
        "the gyroscope gives one and the same value throughout",
    ),
    "accelerometer frozen": (
        changed(partial(frozen, sensors=("accel",), start=0, end=99)),
        "the accelerometer gives one and the same value",
    ),
    "IMU frozen but for 3 s": (
        changed(partial(frozen, sensors=("gyro", "accel"), start=3, end=99)),
        "gyroscope and the accelerometer repeat one value through 90 % of the recording",
    ),
    "an axis that is not filled": (changed(dead_axis), "the gyroscope's z axis gives one and the same value throughout"),
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


def lens_of_fronto_parallel_views(seed: int, sigmas: float = 3.0) -> None:
    """Where images alone do not tell the lens, accelerations do: from a focal length that is 11 % too long, all are right."""
    recording = recorded(seed, motion="fronto-parallel")
    camera = recording.camera.camera
    parameters = {
        name: each.model_copy(update={"value": (each.value or 0) * 1.11}) for name, each in camera.parameters.items() if name[0] == "f"
    }
    wrong = camera.model_copy(update={"parameters": {**camera.parameters, **parameters}})
    joint = calibrate_joint([CameraInput(recording.views, wrong)], recording.imu, recording.noise)
    where, cov = of_camera(joint, joint_trust(joint.fit))
    z, sigma = error_of(recording, joint)[where] / np.sqrt(np.diag(cov)), np.sqrt(np.diag(cov))
    assert np.abs(z).max() < sigmas, z.round(2)
    assert sigma[7:9].max() < 0.5  # px
    assert all("is weak" in reason.text for reason in recording.result(joint).reasons)


@pytest.mark.slow
def test_nearly_fronto_parallel_views_tell_the_lens_by_the_imu() -> None:
    lens_of_fronto_parallel_views(0)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 10))
def test_nearly_fronto_parallel_views_over_many_seeds(seed: int) -> None:
    lens_of_fronto_parallel_views(seed, 3.7)


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
