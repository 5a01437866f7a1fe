"""`calibkit joint`: cameras and an IMU on one continuous-time trajectory."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Literal

import numpy as np

from calibkit.data.observations import BoardViews, ImuSamples
from calibkit.data.progress import Progress, silent
from calibkit.data.rig import Camera, Imu, Rig
from calibkit.errors import BadInputError, one_line
from calibkit.estimation.joint import CameraInput, ImuNoise, Settings, calibrate_joint
from calibkit.estimation.joint_checks import check_joint
from calibkit.estimation.joint_imu import imu_input
from calibkit.estimation.joint_problem import GravityPrior
from calibkit.estimation.joint_result import joint_result
from calibkit.estimation.joint_state import A_G, LINE, M_A, M_G, PHI
from calibkit.estimation.joint_trust import joint_trust
from calibkit.estimation.stamps import check_stamps
from calibkit.io.imu_options import ImuOptions
from calibkit.io.recording import Recording, open_recording
from calibkit.io.target_file import load_target
from calibkit.models.imu import STANDARD_GRAVITY, Gravity
from calibkit.stages.intrinsics import Options as LensOptions
from calibkit.stages.intrinsics import name_cameras, observe
from calibkit.stages.outputs import Outputs, Saved, save

ImuModelChoice = Literal["known", "scale-misalignment"]
_IMU_EXTRAS: dict[str, tuple[str, ...]] = {"known": (), "scale-misalignment": (M_A, M_G, PHI)}
_DEFAULT = ImuOptions()
_IN_G = (0.7, 1.4)  # median |a|
_IMU_NAME = "imu0"
_GRAVITY_SIGMA = 1e-4  # m/s^2; a |g| that was given is no better known, tides alone move it by 1e-6 of it


@dataclass(frozen=True)
class Options:
    """Which sensors, and how to fit."""

    cameras: tuple[str, ...] = ()  # topics, or NAME=/topic
    imu: str | None = None  # topic, or NAME=/topic
    reading: ImuOptions = _DEFAULT
    gravity: Gravity = STANDARD_GRAVITY
    knots_s: float | None = None
    hold_lens: bool = False  # as the rig file has it, with its covariance
    imu_model: ImuModelChoice = "known"
    g_sensitivity: bool = False  # of the gyroscope, free
    line_delay: bool = False  # of rolling shutters, free
    halves: bool = True
    cache: bool = True
    ros_distro: str | None = None


def joint(
    sources: Sequence[Path], target: Path, outputs: Outputs | None = None, options: Options | None = None, progress: Progress = silent
) -> Saved:
    """Estimate T_cam_imu, dt_imu_cam and the lenses of a recording of cameras and an IMU before a board.

    BadInputError names the file, topic or option that is wrong.
    """
    outputs, options = outputs or Outputs(), options or Options()
    base = outputs.open()
    board = load_target(target)
    recording = open_recording(list(sources), options.ros_distro, options.reading)
    topics = name_cameras(recording, _known(base, options.cameras))
    name, topic = name_imu(recording, base, options.imu)
    lenses = {camera: _lens(base, camera, stream) for camera, stream in topics.items()}
    samples = recording.imu(topic, progress)
    known = base.imus.get(name) or Imu(topic=one_line(topic))
    of_imu = imu_input(name, samples, known.intrinsics, _IMU_EXTRAS[options.imu_model] + ((A_G,) if options.g_sensitivity else ()))
    samples = of_imu.samples
    _refuse_imu(samples, name, topic)
    resolution = next(iter(lenses.values())).resolution
    views = observe(recording, topics, board, LensOptions(resolution=resolution, cache=options.cache), progress)
    cameras = [_input(each, lenses[each.camera], options.hold_lens) for each in views]
    extras = (*of_imu.extras, *((LINE,) if options.line_delay else ()))
    gravity = GravityPrior(options.gravity.value, max(options.gravity.sigma, _GRAVITY_SIGMA))
    settings = Settings(gravity, options.knots_s, of_imu.model, of_imu.information, extras)
    try:
        found = calibrate_joint(cameras, samples, _noise(known), settings, progress)
    except BadInputError as error:
        damaged = "".join(f" ({text})" for text in recording.warnings)  # what was not read may be why
        raise BadInputError(f"{recording.name}: {', '.join(topics)} and {name}: {error}{damaged}") from None
    trust, checks = joint_trust(found.fit), check_joint(found.fit, options.halves)
    stamps = {name: check_stamps(samples.t_ns, "sample"), **{each.camera: check_stamps(each.t_ns, "frame") for each in views}}
    known = known if name in base.imus else known.model_copy(update={"rate_hz": round(found.rate_hz, 3)})
    result = joint_result(found, trust, checks, cameras, name, of_imu, stamps, known)
    result = replace(result, facts={**result.facts, "warnings": [*recording.warnings, *_warnings(views)]})
    told: dict[str, str | float | int | bool | None] = {
        "target": board.key(),
        "imu": f"{name}={one_line(topic)}",
        "hold_lens": options.hold_lens,
        "imu_model": options.imu_model,
        "g_sensitivity": options.g_sensitivity,
        "line_delay": options.line_delay,
        "knots_s": options.knots_s,
    }
    read = [*outputs.rigs, target]
    return save(result, base, outputs, [*recording.inputs(), *((path.name, sha256(path.read_bytes()).hexdigest()) for path in read)], told)


def _warnings(views: Sequence[BoardViews]) -> list[str]:
    return [text for each in views for text in each.warnings]


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


def _input(views: BoardViews, camera: Camera, held: bool) -> CameraInput:
    """Return what enters the fit; a lens that is held without a covariance is taken as good as certain."""
    if not held:
        return CameraInput(views, camera)
    lens = np.array([value.value for value in camera.parameters.values()], float)
    if camera.covariance is None:
        return CameraInput(views, camera, (lens, np.diag(1 / (1e-6 * np.maximum(np.abs(lens), 1e-3)) ** 2)), lens_given=True)
    return CameraInput(views, camera, (lens, np.linalg.inv(np.array(camera.covariance.matrix))))


def _refuse_imu(samples: ImuSamples, name: str, topic: str) -> None:
    """Refuse what cannot be an IMU in SI units."""
    where = f"{name} ({one_line(topic)})"
    if not (samples.has_gyro and samples.has_accel):
        raise BadInputError(f"{where} has no {'accelerometer' if samples.has_gyro else 'gyroscope'}: the joint estimate needs both")
    if samples.unit != "SI":
        raise BadInputError(f"{where} is in counts: say --gyro-unit and --accel-unit, or correct it by its intrinsics first")
    size = float(np.median(np.linalg.norm(samples.accel, axis=1))) if len(samples.t_ns) else 0.0
    if _IN_G[0] < size < _IN_G[1]:
        raise BadInputError(f"{where}: its accelerometer reads {size:.3g} in the middle: it is in g; say --accel-unit g")


def _noise(imu: Imu) -> ImuNoise:
    known = (imu.gyro_noise_density, imu.gyro_random_walk, imu.accel_noise_density, imu.accel_random_walk)
    return ImuNoise(*(None if each is None or not each.value else each.value for each in known))
