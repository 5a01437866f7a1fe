"""What is said of each cause that a diagnosis may find: what is wrong and by how much, with sigma, and what to do."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from calibkit.estimation.diagnosis import Cause
from calibkit.estimation.joint_state import LINE_SCALE
from calibkit.estimation.pixel_grid import bent
from calibkit.geometry.so3 import Array
from calibkit.models.cameras import CameraModel

_TURNS = {"x": "pitch", "y": "yaw", "z": "roll"}
# Right-handed turns about x to the right, y down and z forward, and those the other way, as seen from behind the camera.
_WAYS = {"x": ("up", "down"), "y": ("to the right", "to the left"), "z": ("clockwise", "counter-clockwise")}


@dataclass(frozen=True)
class About:
    """What the words are of."""

    cameras: tuple[str, ...]
    imu: str  # what the cameras sit beside: the IMU, or without one the first camera
    models: tuple[CameraModel, ...]
    lenses: tuple[Array, ...]
    corners: tuple[Array, ...]  # (n, 2) px where each camera saw the board
    again: str = "joint"  # the command that finds where they sit


@dataclass(frozen=True)
class Told:
    """A cause in words."""

    text: str
    mend: str
    theta: tuple[float, ...]  # in `unit`
    sigma: tuple[float, ...]
    unit: str
    alike: tuple[str, ...]  # what it is not told from


def in_words(cause: Cause, about: About) -> Told:
    """Return what is wrong, by how much, and what to do."""
    name, k, drift = _parts(cause.key)
    _, _, say, mend = _SAYINGS[name]
    unit, scale = unit_of(cause.key)
    theta, sigma = cause.theta * scale, np.sqrt(np.diag(cause.cov)) * scale
    size = ", ".join(number(abs(x) if len(theta) == 1 else x, s) for x, s in zip(theta, sigma, strict=True))
    said = say(about.cameras[k], about.imu, theta, f"{size} {unit}", bool(drift))
    if name == "distortion":
        off = np.linalg.norm(bending(cause.theta, about, k)[1], axis=1)
        said += f": corners are off by {np.sqrt(np.mean(off**2)):.2g} px rms, {off.max():.2g} px at most, focal length and centre set anew"
    cure = _DRIFTS[drift] if drift else mend
    then = "" if about.again == "intrinsics" else f", then {about.again}"
    mended = cure.format(camera=about.cameras[k], imu=about.imu, again=about.again, then=then)
    alike = tuple(named(key, about) for key in cause.alike)
    return Told(said, mended, tuple(theta.tolist()), tuple(sigma.tolist()), unit, alike)


def named(key: str, about: About) -> str:
    """Return what a suspect is called."""
    name, c, drift = _parts(key)
    called = _NAMES[name].format(camera=about.cameras[c], imu=about.imu)
    return f"{called} with {drift}" if drift else called


def unit_of(key: str) -> tuple[str, float]:
    """Return the unit that a suspect's size is told in, and its worth of one in SI."""
    name, _, drift = _parts(key)
    unit, scale, *_ = _SAYINGS[name]
    return f"{unit}{_PER.get(drift, '')}", scale


def base_of(key: str) -> str:
    """Return the suspect itself of one that goes with time or temperature."""
    return key.partition(" with ")[0]


def _parts(key: str) -> tuple[str, int, str]:
    """Return name, camera and what it goes with."""
    base, _, drift = key.partition(" with ")
    name, c = base.rsplit(" ", 1) if base[-1].isdigit() else (base, "0")
    return name, int(c), drift


def number(value: float, sigma: float) -> str:
    """Return a value with its sigma in two digits."""
    digits = int(np.clip(1 - np.floor(np.log10(sigma)), 0, 9)) if sigma > 0 else 3
    return f"{value:.{digits}f} +- {sigma:.{digits}f}"


def bending(theta: Array, about: About, c: int) -> tuple[Array, Array]:
    """Return pixels (n, 2) where camera c saw corners, and how far coefficients off by theta move them, all else set anew."""
    uv = about.corners[c]
    rays, valid = about.models[c].unproject(uv, about.lenses[c])
    return uv[valid], bent(about.models[c], about.lenses[c], rays[valid], theta)


Say = Callable[[str, str, Array, str, bool], str]


def _offset(camera: str, imu: str, theta: Array, size: str, drifts: bool) -> str:
    if drifts:
        return f"the offset of {camera}'s clock {'grows' if theta[0] > 0 else 'falls'} by {size}"
    return f"{camera}'s stamps are {size} {'earlier' if theta[0] > 0 else 'later'} than dt_{imu}_{camera} says"


def _turn(axis: str) -> Say:
    def say(camera: str, imu: str, theta: Array, size: str, drifts: bool) -> str:
        way = _WAYS[axis][0 if theta[0] > 0 else 1]
        return f"{camera} {'creeps' if drifts else 'is turned'} {way} by {size} about its own {axis} axis ({_TURNS[axis]})"

    return say


def _shift(axis: str) -> Say:
    def say(camera: str, imu: str, theta: Array, size: str, drifts: bool) -> str:
        return f"{camera} {'creeps' if drifts else 'sits'} {size} {'along' if theta[0] > 0 else 'against'} {imu}'s {axis} axis"

    return say


def _length(camera: str, imu: str, theta: Array, size: str, drifts: bool) -> str:
    verb = ("grows" if theta[0] > 0 else "shrinks") if drifts else ("is longer" if theta[0] > 0 else "is shorter")
    return f"{camera}'s focal length {verb} by {size}"


def _plain(text: str) -> Say:
    return lambda camera, imu, theta, size, drifts: text.format(camera=camera, imu=imu, size=size)


def _board(camera: str, imu: str, theta: Array, size: str, drifts: bool) -> str:
    return f"the board is {size} {'larger' if theta[0] > 0 else 'smaller'} than its file says"


_LENS, _MOUNT = "run calibkit intrinsics again{then}", "its mount has moved: run calibkit {again} again, and look at the mount"
# By name: unit, its worth of one in SI, what is said, what to do.
_SAYINGS: dict[str, tuple[str, float, Say, str]] = {
    "dt": ("ms", 1e3, _offset, "run calibkit timeoffset or joint again"),
    **{f"R_{axis}": ("deg", float(np.degrees(1)), _turn(axis), _MOUNT) for axis in "xyz"},
    **{f"p_{axis}": ("mm", 1e3, _shift(axis), _MOUNT) for axis in "xyz"},
    "focal": ("px", 1.0, _length, _LENS),
    "focal lengths": ("px", 1.0, _plain("{camera}'s fx and fy have changed by ({size}), each by its own"), _LENS),
    "centre": ("px", 1.0, _plain("the centre of {camera}'s lens has moved by ({size})"), _LENS),
    "distortion": ("", 1.0, _plain("{camera}'s lens bends otherwise than its distortion says"), _LENS),
    "line delay": (
        "us",
        1e6 * LINE_SCALE,
        _plain("{camera}'s rows are read {size} a row apart from what its line_delay says"),
        "run calibkit joint --line-delay",
    ),
    "board scale": ("%", 100.0, _board, "measure it, and write its size into the target file"),
    "gyroscope scale": (
        "%",
        100.0,
        _plain("{imu}'s gyroscope reads too much by ({size}) about its axes"),
        "run calibkit imu, or joint --imu-model scale-misalignment",
    ),
    "gyroscope axes": (
        "mrad",
        1e3,
        _plain("{imu}'s gyroscope has its axes askew"),
        "run calibkit imu, or joint --imu-model scale-misalignment",
    ),
    "accelerometer scale": (
        "%",
        100.0,
        _plain("{imu}'s accelerometer reads too much by ({size}) along its axes"),
        "run calibkit imu, or joint --imu-model scale-misalignment",
    ),
    "accelerometer axes": (
        "mrad",
        1e3,
        _plain("{imu}'s accelerometer has its axes askew"),
        "run calibkit imu, or joint --imu-model scale-misalignment",
    ),
}
_NAMES = {
    "dt": "dt_{imu}_{camera}",
    **{f"R_{axis}": f"{{camera}}'s {word}" for axis, word in _TURNS.items()},
    **{f"p_{axis}": f"{{camera}} along {{imu}}'s {axis} axis" for axis in "xyz"},
    "focal": "{camera}'s focal length",
    "focal lengths": "{camera}'s fx and fy",
    "centre": "{camera}'s centre",
    "distortion": "{camera}'s distortion",
    "line delay": "{camera}'s line delay",
    "board scale": "the board's size",
    "gyroscope scale": "{imu}'s gyroscope's scale",
    "gyroscope axes": "{imu}'s gyroscope's axes",
    "accelerometer scale": "{imu}'s accelerometer's scale",
    "accelerometer axes": "{imu}'s accelerometer's axes",
}
_PER = {"time": " a minute", "temperature": " per 10 K"}
_DRIFTS = {
    "time": "it drifts within the recording: let {camera} warm up, look at its mount or clock",
    "temperature": "it goes with the temperature: calibrate at the temperature of use, or hold {camera} at one",
}
