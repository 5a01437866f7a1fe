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
from calibkit.estimation.joint import CameraInput, ImuNoise, Joint, Settings, calibrate_joint
from calibkit.estimation.joint_imu import ImuInput, imu_input
from calibkit.estimation.joint_problem import GravityPrior
from calibkit.estimation.stamps import StampReport, check_stamps
from calibkit.io.imu_options import ImuOptions
from calibkit.io.recording import Recording, open_recording
from calibkit.io.target_file import load_target
from calibkit.models.board import Board
from calibkit.models.imu import STANDARD_GRAVITY, Gravity
from calibkit.stages.intrinsics import Options as LensOptions
from calibkit.stages.intrinsics import name_cameras, observe

_DEFAULT = ImuOptions()
_IN_G = (0.7, 1.4)  # median |a|
_IMU_NAME = "imu0"
_GRAVITY_SIGMA = 1e-4  # m/s^2; a |g| that was given is no better known, tides alone move it by 1e-6 of it


@dataclass(frozen=True)
class Sensors:
    """Which sensors, and how to read them."""

    cameras: tuple[str, ...] = ()  # topics, or NAME=/topic
    imu: str | None = None  # topic, or NAME=/topic
    reading: ImuOptions = _DEFAULT
    gravity: Gravity = STANDARD_GRAVITY
    cache: bool = True
    ros_distro: str | None = None


@dataclass(frozen=True)
class CameraImu:
    """What was read, and what the rig file says of it."""

    recording: Recording
    board: Board
    views: tuple[BoardViews, ...]
    lenses: tuple[Camera, ...]  # in the order of views
    imu_name: str
    imu_topic: str
    known_imu: Imu
    imu: ImuInput
    gravity: GravityPrior
    inputs: tuple[tuple[str, str | None], ...]

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(each.camera for each in self.views)

    @property
    def stamps(self) -> dict[str, StampReport]:
        imu = {self.imu_name: check_stamps(self.imu.samples.t_ns, "sample")}
        return imu | {each.camera: check_stamps(each.t_ns, "frame") for each in self.views}

    @property
    def warnings(self) -> list[str]:
        return [*self.recording.warnings, *(text for each in self.views for text in each.warnings)]

    def settings(self, extras: Sequence[str] = (), spacing: float | None = None) -> Settings:
        """Return how to fit, beside what is free of the IMU's model."""
        return Settings(self.gravity, spacing, self.imu.model, self.imu.information, (*self.imu.extras, *extras))

    def fitted(self, cameras: Sequence[CameraInput], settings: Settings, progress: Progress) -> Joint:
        """Return the joint estimate; BadInputError names the recording and the sensors."""
        try:
            return calibrate_joint(cameras, self.imu.samples, _noise(self.known_imu), settings, progress)
        except BadInputError as error:
            damaged = "".join(f" ({text})" for text in self.recording.warnings)  # what was not read may be why
            seen, imu = ", ".join(self.names), self.imu_name
            text = str(error).replace("the first", seen).replace("the second", imu)  # as the time offset calls them
            raise BadInputError(f"{self.recording.name}: {seen} and {imu}: {text}{damaged}") from None


def read_camera_imu(
    sources: Sequence[Path], target: Path, base: Rig, sensors: Sensors, progress: Progress, free: Sequence[str] = ()
) -> CameraImu:
    """Return the corners of all cameras and the IMU's samples; `free` is what the rig file's IMU model is not to tell.

    BadInputError names the file, topic or option that is wrong.
    """
    board = load_target(target)
    recording = open_recording(list(sources), sensors.ros_distro, sensors.reading)
    topics = name_cameras(recording, _known(base, sensors.cameras))
    name, topic = name_imu(recording, base, sensors.imu)
    lenses = {camera: _lens(base, camera, stream) for camera, stream in topics.items()}
    samples = recording.imu(topic, progress)
    known = base.imus.get(name) or Imu(topic=one_line(topic))
    imu = imu_input(name, samples, known.intrinsics, free)
    _refuse_imu(imu.samples, name, topic)
    resolution = next(iter(lenses.values())).resolution
    views = tuple(observe(recording, topics, board, LensOptions(resolution=resolution, cache=sensors.cache), progress))
    gravity = GravityPrior(sensors.gravity.value, max(sensors.gravity.sigma, _GRAVITY_SIGMA))
    inputs = (*recording.inputs(), (target.name, sha256(target.read_bytes()).hexdigest()))
    of_views = tuple(lenses[each.camera] for each in views)
    return CameraImu(recording, board, views, of_views, name, topic, known, imu, gravity, inputs)


def _known(base: Rig, asked: tuple[str, ...]) -> tuple[str, ...]:
    """Return the cameras asked for, else those that the rig file knows by topic."""
    if asked:
        return asked
    return tuple(f"{name}={camera.topic}" for name, camera in base.cameras.items() if camera.topic) if len(base.cameras) > 1 else ()


def name_imu(recording: Recording, base: Rig, asked: str | None) -> tuple[str, str]:
    """Return name and topic of the IMU asked for (topic, or NAME=/topic), else of the only one; named as the rig file has its topic."""
    name, _, topic = (asked or "").rpartition("=")
    chosen = recording.choose("imu", topic or None)
    by_topic = {imu.topic: key for key, imu in base.imus.items() if imu.topic}
    return name or by_topic.get(chosen, _IMU_NAME), chosen


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
