"""`calibkit diagnose`: whether a calibration still fits a recording that it was not made from, and what is wrong with it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from calibkit.data.observations import Times
from calibkit.data.progress import Progress, silent
from calibkit.data.rig import Camera, Rig
from calibkit.errors import BadInputError, NotConvergedError
from calibkit.estimation.diagnosis import FAMILY_WISE, Cause, Diagnosis, Suspect, diagnose
from calibkit.estimation.diagnosis_words import About, Told, in_words, named
from calibkit.estimation.joint import CameraInput, Joint
from calibkit.estimation.joint_known import known_calibration
from calibkit.estimation.joint_problem import Drift
from calibkit.estimation.joint_state import JointState
from calibkit.estimation.joint_suspects import Known, evidence, rms_by_sensor, with_trajectory
from calibkit.geometry.so3 import Array
from calibkit.io.temperature_file import load_temperature
from calibkit.models.cameras import CAMERAS
from calibkit.solver.trust import WEAK
from calibkit.stages.camera_imu import CameraImu, Sensors, read_camera_imu

_A_MINUTE_S, _TEN_K = 60.0, 10.0
_NOISIER = 1.4  # than it was: twice the variance
_HIDES = 1.2  # times the noise: who sees it may raise R
_LEFT, _MOSTLY_LEFT = 0.2, 0.5  # of the excess, beside the causes
_QUIETER = 1 / 3  # than its density: what is so wrong is worth a word, though it harms little
_NO_FIT, _NO_FIT_PX = 4.0, 0.5  # times the rms at its calibration, and px
_LEAST_K = 1.0  # of temperature, that something may go with it


@dataclass(frozen=True)
class Options(Sensors):
    """Which sensors, how to read them, and what else was measured."""

    temperature: Path | None = None


@dataclass(frozen=True)
class Noise:
    """A sensor that scatters otherwise than the calibration has it."""

    text: str
    factor: float
    no_fit: bool = False  # so much that no calibration of this model fits


@dataclass(frozen=True)
class Rms:
    """A sensor's residuals by the calibration under test, its trajectory free, and by the recording's own."""

    sensor: str
    unit: str
    held: float
    best: float


@dataclass(frozen=True)
class Diagnosed:
    """What was found."""

    what: str
    diagnosis: Diagnosis
    told: tuple[Told, ...]  # of each cause
    noise: tuple[Noise, ...]
    untested: tuple[str, ...]
    rms: tuple[Rms, ...]
    warnings: tuple[str, ...]
    again: str = "joint"  # the command that calibrates anew
    beside: tuple[str, ...] = ()  # entries of the rig file that such a recording cannot test

    @property
    def left(self) -> float:
        """Return the share of the excess that is no single cause's."""
        return 1 - sum(cause.share for cause in self.diagnosis.causes)

    @property
    def text(self) -> str:
        """Return what is said on the terminal."""
        out = [self.what, "", f"{'residuals, rms':26}{'by the rig file':>16}{'at best':>12}"]
        out += [f"  {each.sensor:24}{each.held:>16.3g}{each.best:>12.3g} {each.unit}" for each in self.rms]
        for cause, told in zip(self.diagnosis.causes, self.told, strict=True):
            out += ["", f"  {told.text} ({100 * cause.share:.0f} % of the excess)", f"    {told.mend}"]
            out += [f"    this motion does not tell it from: {', '.join(told.alike)}"] if told.alike else []
        if self.told and self.left > _LEFT:
            out += [
                "",
                f"  {100 * self.left:.0f} % of the excess is no single cause's: these sizes are rough; run calibkit {self.again} again",
            ]
        usual = [f"  {noise.text}" for noise in self.noise if not noise.no_fit]
        out += ["", *usual] if usual else []
        out += ["", *(f"  {line}" for line in self.not_tested)] if self.not_tested else []
        return "\n".join([*out, "", self.verdict])

    @property
    def unexplained(self) -> bool:
        """Whether what the causes leave is more than chance."""
        return bool(self.diagnosis.unexplained_log_p < np.log(FAMILY_WISE))

    @property
    def not_tested(self) -> list[str]:
        """Return what was not tested, a sentence for each reason."""
        out = [f"not tested, the motion does not tell them: {', '.join(self.untested)}"] if self.untested else []
        return out + ([f"not tested without an IMU: {', '.join(self.beside)}"] if self.beside else [])

    @property
    def misfit(self) -> str:
        """Return what is wrong as a whole, which single causes do not tell; "" where they do."""
        if no_fit := [noise.text for noise in self.noise if noise.no_fit]:
            return no_fit[0]
        if self.told and self.left > _MOSTLY_LEFT:
            misses = f"the calibration misses this recording, and {100 * self.left:.0f} % of it is no single cause's"
            return f"{misses}: run calibkit {self.again} again; its causes may be blamed wrongly"
        return ""

    @property
    def verdict(self) -> str:
        """Return the answer in one line."""
        if self.misfit:
            return f"FAIL: {self.misfit}"
        if self.told:
            worst = max(self.rms, key=lambda rms: rms.held / rms.best)
            hide = f": noise of {worst.held:.2g} {worst.unit} for {worst.sensor} would hide it" if worst.held > _HIDES * worst.best else ""
            return f"FAIL: {self.told[0].text}; it is not noise{hide}"
        if self.unexplained:
            misses = "the calibration misses this recording by more than its sigmas, for no single cause"
            return f"CHECK: {misses}: run calibkit {self.again} again"
        return "PASS: the calibration fits this recording within its own uncertainty" + (", but for its noise" if self.noise else "")

    def as_json(self) -> dict[str, object]:
        """Return everything, for machines."""
        return {
            "schema": "calibkit-diagnosis-1",
            "verdict": self.verdict.split(":")[0],
            "causes": [
                {
                    "key": cause.key,
                    "text": told.text,
                    "mend": told.mend,
                    "size": list(told.theta),
                    "sigma": list(told.sigma),
                    "unit": told.unit,
                    "share": cause.share,
                    "log10_p": cause.log_p / float(np.log(10)),
                    "alike": list(told.alike),
                }
                for cause, told in zip(self.diagnosis.causes, self.told, strict=True)
            ],
            "unexplained": self.unexplained,
            "noise": [{"text": each.text, "factor": each.factor} for each in self.noise],
            "not_tested": [*self.untested, *self.beside],
            "rms": [{"sensor": each.sensor, "unit": each.unit, "by_rig": each.held, "at_best": each.best} for each in self.rms],
            "warnings": list(self.warnings),
        }

    @property
    def exit_code(self) -> int:
        """SPEC section 6: 1 where a cause is found, or nothing fits."""
        return 1 if self.told or self.misfit else 0


@dataclass(frozen=True)
class Examined:
    """A recording's own joint estimate beside the calibration under test."""

    read: CameraImu
    known: Known
    joint: Joint
    held: JointState  # the calibration under test with the trajectory that suits it best
    diagnosed: Diagnosed
    rig: Rig
    about: About
    suspects: tuple[Suspect, ...]
    drifts: tuple[Drift, ...]
    temperature: tuple[Array, Array] | None  # s of the recording, deg C

    @property
    def causes(self) -> tuple[Cause, ...]:
        return self.diagnosed.diagnosis.causes


def examine(sources: Sequence[Path], target: Path, rig: Rig, options: Options | None = None, progress: Progress = silent) -> Examined:
    """Test a rig file's cameras and IMU against a recording before a board.

    BadInputError names the file, topic or option that is wrong, or what the rig file lacks; NotConvergedError: nothing fits the recording.
    """
    options = options or Options()
    temperature = None if options.temperature is None else load_temperature(options.temperature)
    read = read_camera_imu(sources, target, rig, options, progress)
    known = known_calibration(rig, read.names, read.imu.name, read.imu.input.model)
    cameras = [CameraInput(views, lens) for views, lens in zip(read.views, read.lenses, strict=True)]
    joint = read.fitted(cameras, read.settings(), progress)
    if not joint.fit.converged:
        raise NotConvergedError(
            f"{read.recording.name}: cameras and IMU do not fit together at any calibration: run calibkit joint, which says why"
        )
    drifts = [Drift("time", *_ramp(joint)), *_of_temperature(joint, options.temperature, temperature)]
    problem, x = joint.fit.problem, joint.fit.x
    with threadpool_limits(1, user_api="blas"):
        found, suspects = evidence(joint.fit, known, drifts)
        diagnosis = diagnose(found, suspects)
        held = with_trajectory(problem, replace(x, cameras=known.cameras, imu=known.imu))
    rms = _rms(rms_by_sensor(problem, held), rms_by_sensor(problem, x), read)
    about = About(
        read.names,
        read.imu.name,
        tuple(CAMERAS[lens.model] for lens in read.lenses),
        tuple(camera.lens for camera in x.cameras),
        tuple(frames.views.uv[frames.views.weight > 0] for frames in problem.cameras),
    )
    diagnosed = Diagnosed(
        _what(joint, read),
        diagnosis,
        tuple(in_words(cause, about) for cause in diagnosis.causes),
        _noise(rms, joint, read),
        tuple(named(each.key, about) for each in suspects if diagnosis.sigmas[each.key] > WEAK),
        rms,
        tuple(read.warnings),
    )
    measured = None if temperature is None else (_seconds(joint, temperature[0]), temperature[1])
    return Examined(read, known, joint, held, diagnosed, rig, about, suspects, tuple(drifts), measured)


def _seconds(joint: Joint, t_ns: Times) -> Array:
    return np.asarray((t_ns - joint.origin_ns) * 1e-9, np.float64)


def _ramp(joint: Joint) -> tuple[Array, Array]:
    """Return minutes since the recording's start."""
    t = joint.fit.problem.imu.t[[0, -1]]
    return t, np.asarray((t - t[0]) / _A_MINUTE_S, np.float64)


def _of_temperature(joint: Joint, path: Path | None, read: tuple[Times, Array] | None) -> list[Drift]:
    if path is None or read is None:
        return []
    t_ns, celsius = read
    t = _seconds(joint, t_ns)
    first, last = joint.fit.problem.imu.t[[0, -1]]
    if t[-1] < first or t[0] > last:
        raise BadInputError(f"{path.name}: its times lie outside of the recording; they must be on the IMU's clock")
    inside = np.interp([first, last], t, celsius)
    spread = np.ptp(np.concatenate([celsius[(t > first) & (t < last)], inside]))
    if spread < _LEAST_K:
        raise BadInputError(
            f"{path.name}: the temperature changes by {spread:.2g} K within the recording: nothing can be told to go with it"
        )
    return [Drift("temperature", t, np.asarray((celsius - inside[0]) / _TEN_K, np.float64))]


def _rms(held: dict[str, float], best: dict[str, float], read: CameraImu) -> tuple[Rms, ...]:
    return tuple(Rms(*sensor, held[kind], best[kind]) for kind, sensor in sensors_of(read).items())


def sensors_of(read: CameraImu) -> dict[str, tuple[str, str]]:
    """Return what each kind of residual is called, and its unit."""
    names = {f"camera {c}": (f"{name}'s corners", "px") for c, name in enumerate(read.names)}
    return names | {"gyro": (f"{read.imu.name}'s gyroscope", "rad/s"), "accel": (f"{read.imu.name}'s accelerometer", "m/s^2")}


def _what(joint: Joint, read: CameraImu) -> str:
    corners = sum(int((frames.views.weight > 0).sum()) for frames in joint.fit.problem.cameras)
    span = joint.fit.problem.imu.t[-1] - joint.fit.problem.imu.t[0]
    return f"{', '.join(read.names)} and {read.imu.name}: {corners} corners, {len(joint.fit.problem.imu.t)} samples over {span:.4g} s"


def _noise(rms: Sequence[Rms], joint: Joint, read: CameraImu) -> tuple[Noise, ...]:
    """Return what scatters more than the rig file has it, with everything free, and IMUs that scatter far less."""
    found = list(noisier_corners(read.names, read.lenses, rms[: len(read.names)]))
    known = read.imu.known
    for kind, density, word in (
        ("gyro", known.gyro_noise_density, "gyroscope"),
        ("accel", known.accel_noise_density, "accelerometer"),
    ):
        if density is None or not density.value:
            continue
        factor, name = joint.fit.factors[kind], f"{read.imu.name}'s {word}"
        real = f"{factor * density.value:.2e} {density.unit}"
        if factor > _NOISIER:
            found.append(Noise(f"{name} is {factor:.1f} times noisier than its density in the rig file: {real}. Vibration?", factor))
        if factor < _QUIETER:
            text = f"{name} is {1 / factor:.1f} times less noisy than its density in the rig file: {real}. Another unit, or inflated?"
            found.append(Noise(text, factor))
    return tuple(found)


def noisier_corners(names: Sequence[str], lenses: Sequence[Camera], rms: Sequence[Rms]) -> tuple[Noise, ...]:
    """Return cameras whose corners scatter more than at their calibration, with everything free."""
    found = []
    for name, lens, each in zip(names, lenses, rms, strict=True):
        now = each.best
        if lens.reprojection is not None and lens.reprojection.rms_px > 0 and (factor := now / lens.reprojection.rms_px) > _NOISIER:
            text = f"{name}'s corners scatter by {now:.3g} px, {factor:.1f} times what they did at its calibration, whatever the motion"
            no_fit = factor > _NO_FIT and now > _NO_FIT_PX
            why = "no lens of its model fits them: another camera, board file, or blur? Run calibkit intrinsics"
            usual = f"noise; its R is {now:.2g} px now. Blur, light, or another lens or board?"
            found.append(Noise(f"{text}: {why if no_fit else usual}", factor, no_fit))
    return tuple(found)
