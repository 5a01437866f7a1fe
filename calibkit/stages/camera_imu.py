"""A recording of cameras and an IMU before a board, as the joint estimate needs it, and the tests of one that is known."""

from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

import numpy as np

from calibkit.data.observations import BoardViews, ImuSamples
from calibkit.data.progress import Progress
from calibkit.data.rig import Camera, Imu, Rig
from calibkit.errors import BadInputError, one_line
from calibkit.estimation.joint import CameraInput, ImuGiven, ImuNoise, Joint, Settings, calibrate_joint
from calibkit.estimation.joint_imu import ImuInput, imu_input
from calibkit.estimation.joint_problem import GravityPrior
from calibkit.estimation.stamps import StampReport, check_stamps
from calibkit.estimation.time_offset import called
from calibkit.io.imu_options import ImuOptions
from calibkit.io.recording import Recording, open_recording
from calibkit.io.target_file import load_target
from calibkit.models.board import Board
from calibkit.models.imu import STANDARD_GRAVITY, Gravity
from calibkit.stages.intrinsics import Options as LensOptions
from calibkit.stages.intrinsics import name_cameras, observe

_DEFAULT = ImuOptions()
_IN_G = (0.7, 1.4)  # median |a|
_GRAVITY_SIGMA = 1e-4  # m/s^2; a |g| that was given is no better known, tides alone move it by 1e-6 of it


@dataclass(frozen=True)
class Sensors:
    """Which sensors, and how to read them."""

    cameras: tuple[str, ...] = ()  # topics, or NAME=/topic
    imus: tuple[str, ...] = ()  # topics, or NAME=/topic; the first is the one that the others are beside
    reading: ImuOptions = _DEFAULT
    gravity: Gravity = STANDARD_GRAVITY
    cache: bool = True
    ros_distro: str | None = None


@dataclass(frozen=True)
class ImuRead:
    """One IMU: what was read, and what the rig file says of it."""

    name: str
    topic: str
    known: Imu
    input: ImuInput


@dataclass(frozen=True)
class CamerasRead:
    """What was read of cameras, and what the rig file says of them."""

    recording: Recording
    board: Board
    views: tuple[BoardViews, ...]
    lenses: tuple[Camera, ...]  # in the order of views

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(each.camera for each in self.views)

    @property
    def warnings(self) -> list[str]:
        return [*self.recording.warnings, *(text for each in self.views for text in each.warnings)]


@dataclass(frozen=True)
class CameraImu(CamerasRead):
    """What was read, and what the rig file says of it."""

    imus: tuple[ImuRead, ...]
    gravity: GravityPrior
    inputs: tuple[tuple[str, str | None], ...]

    @property
    def imu(self) -> ImuRead:
        return self.imus[0]

    @property
    def stamps(self) -> dict[str, StampReport]:
        imus = {each.name: check_stamps(each.input.samples.t_ns, "sample") for each in self.imus}
        return imus | {each.camera: check_stamps(each.t_ns, "frame") for each in self.views}

    def settings(self, extras: Sequence[str] = (), spacing: float | None = None) -> Settings:
        """Return how to fit, beside what is free of the IMU's model."""
        imu = self.imu.input
        return Settings(self.gravity, spacing, imu.model, imu.information, (*imu.extras, *extras))

    def fitted(self, cameras: Sequence[CameraInput], settings: Settings, progress: Progress) -> Joint:
        """Return the joint estimate; BadInputError names the recording and the sensors."""
        seen, imu = ", ".join(self.names), ", ".join(each.name for each in self.imus)
        beside = [
            ImuGiven(each.input.samples, _noise(each.known), each.input.model, each.input.information, each.input.extras, each.name)
            for each in self.imus[1:]
        ]
        try:
            with called(seen, imu):
                return calibrate_joint(cameras, self.imu.input.samples, _noise(self.imu.known), settings, progress, beside)
        except BadInputError as error:
            damaged = "".join(f" ({text})" for text in self.recording.warnings)  # what was not read may be why
            raise BadInputError(f"{self.recording.name}: {seen} and {imu}: {error}{damaged}") from None


def read_camera_imu(
    sources: Sequence[Path], target: Path, base: Rig, sensors: Sensors, progress: Progress, free: Sequence[str] = ()
) -> CameraImu:
    """Return the corners of all cameras and the IMUs' samples; `free` is what the rig file's IMU models are not to tell.

    BadInputError names the file, topic or option that is wrong.
    """
    board = load_target(target)
    recording = open_recording(list(sources), sensors.ros_distro, sensors.reading)
    topics = name_cameras(recording, _known(base, sensors.cameras))
    named = name_imus(recording, base, sensors.imus)
    lenses = {camera: _lens(base, camera, stream) for camera, stream in topics.items()}
    imus = tuple(_imu(recording, base, name, topic, free, progress) for name, topic in named.items())
    views = _views(recording, topics, board, lenses, sensors, progress)
    gravity = GravityPrior(sensors.gravity.value, max(sensors.gravity.sigma, _GRAVITY_SIGMA))
    inputs = (*recording.inputs(), (target.name, sha256(target.read_bytes()).hexdigest()))
    return CameraImu(recording, board, views, tuple(lenses[each.camera] for each in views), imus, gravity, inputs)


def read_cameras(sources: Sequence[Path], target: Path, base: Rig, sensors: Sensors, progress: Progress) -> CamerasRead:
    """Return the corners of all cameras, of a recording without an IMU or of one whose IMU does not matter.

    BadInputError names the file, topic or option that is wrong.
    """
    board = load_target(target)
    recording = open_recording(list(sources), sensors.ros_distro, sensors.reading)
    topics = name_cameras(recording, _known(base, sensors.cameras))
    lenses = {camera: _lens(base, camera, stream) for camera, stream in topics.items()}
    views = _views(recording, topics, board, lenses, sensors, progress)
    return CamerasRead(recording, board, views, tuple(lenses[each.camera] for each in views))


def has_imu(sources: Sequence[Path], sensors: Sensors) -> bool:
    """Whether an IMU is asked for or recorded."""
    topics = open_recording(list(sources), sensors.ros_distro, sensors.reading).topics
    return bool(sensors.imus) or any(topic.kind == "imu" for topic in topics)


def _views(
    recording: Recording, topics: dict[str, str], board: Board, lenses: dict[str, Camera], sensors: Sensors, progress: Progress
) -> tuple[BoardViews, ...]:
    resolution = next(iter(lenses.values())).resolution
    return tuple(observe(recording, topics, board, LensOptions(resolution=resolution, cache=sensors.cache), progress))


def _imu(recording: Recording, base: Rig, name: str, topic: str, free: Sequence[str], progress: Progress) -> ImuRead:
    known = base.imus.get(name) or Imu(topic=one_line(topic))
    imu = imu_input(name, recording.imu(topic, progress), known.intrinsics, free)
    _refuse_imu(imu.samples, name, topic)
    return ImuRead(name, topic, known, imu)


def _known(base: Rig, asked: tuple[str, ...]) -> tuple[str, ...]:
    """Return the cameras asked for, else those that the rig file knows by topic."""
    if asked:
        return asked
    return tuple(f"{name}={camera.topic}" for name, camera in base.cameras.items() if camera.topic) if len(base.cameras) > 1 else ()


def name_imus(recording: Recording, base: Rig, asked: Sequence[str]) -> dict[str, str]:
    """Return the topics by name of the IMUs asked for (topic, or NAME=/topic), else of the only one; named as the rig file has the topic.

    BadInputError where two are of one name, or one topic is asked for twice.
    """
    by_topic = {imu.topic: key for key, imu in base.imus.items() if imu.topic}
    out: dict[str, str] = {}
    for each in asked or ("",):
        name, _, topic = each.rpartition("=")
        chosen = recording.choose("imu", topic or None)
        name = name or by_topic.get(chosen) or f"imu{len(out)}"
        if chosen in out.values():
            raise BadInputError(f"--imu: the topic {one_line(chosen)} is given twice: drop one of them")
        if name in out:
            raise BadInputError(f"two IMUs of the name {one_line(name)}: give each its own, --imu imu0=/a --imu imu1=/b")
        out[name] = chosen
    return out


def _lens(base: Rig, name: str, topic: str) -> Camera:
    if name not in base.cameras:
        raise BadInputError(f"{name} ({one_line(topic)}) has no lens: run calibkit intrinsics, then add --rig RIG.yaml")
    camera = base.cameras[name]
    unknown = [key for key, value in camera.parameters.items() if value.value is None]
    if unknown:
        raise BadInputError(
            f"{name}: {', '.join(unknown)} of its lens {'is' if len(unknown) == 1 else 'are'} not known: calibrate it first"
        )
    return camera


def _refuse_imu(samples: ImuSamples, name: str, topic: str) -> None:
    """Refuse what cannot be an IMU in SI units."""
    where = f"{name} ({one_line(topic)})"
    if not (samples.has_gyro and samples.has_accel):
        raise BadInputError(f"{where} has no {'accelerometer' if samples.has_gyro else 'gyroscope'}: the joint estimate needs both")
    if samples.unit != "SI":
        raise BadInputError(f"{where} is in counts: say --gyro-unit and --accel-unit, or correct it by its intrinsics first")
    size = float(np.median(np.linalg.norm(samples.accel, axis=1))) if len(samples.t_ns) else 0.0
    if _IN_G[0] < size < _IN_G[1]:
        raise BadInputError(f"{where}: its accelerometer's median is {size:.3g}, not 9.8: it is in g; say --accel-unit g")


def _noise(imu: Imu) -> ImuNoise:
    known = (imu.gyro_noise_density, imu.gyro_random_walk, imu.accel_noise_density, imu.accel_random_walk)
    return ImuNoise(*(None if each is None or not each.value else each.value for each in known))
