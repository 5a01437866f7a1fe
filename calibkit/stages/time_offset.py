"""`calibkit timeoffset`: how far the clocks of two sensors are apart, by how they turn."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path

import numpy as np

from calibkit.data.observations import ImuSamples, PoseSamples
from calibkit.data.plural import counted
from calibkit.data.progress import Progress, silent
from calibkit.data.rig import Rig
from calibkit.data.transforms import find_transform
from calibkit.data.verdict import Reason, Verdict
from calibkit.errors import BadInputError, one_line
from calibkit.estimation.stamps import check_stamps
from calibkit.estimation.time_offset import Settings, bootstrap_sigma, fit_time_offset
from calibkit.estimation.time_offset_delay import Delays
from calibkit.estimation.time_offset_result import Pair, time_offset_result
from calibkit.estimation.turns import Turns
from calibkit.io.imu_options import ImuOptions
from calibkit.io.recording import open_recording
from calibkit.stages.outputs import Outputs, Saved, save
from calibkit.stages.sensor_turns import Reader, look
from calibkit.stages.sensors import Sensor, choose_pair, find_sensors

_DEFAULT = ImuOptions()
_NO_DELAYS = Delays()
_RECORDED = "are zero in the header and times of recording are used for them: td holds how late those are"
_STAMPED = {"image": "frame", "corners": "frame", "pose": "pose", "tf": "pose"}  # what has a stamp
_FEWEST_DRAWN = 9  # stretches; the spread over draws of fewer says more of chance than of td


@dataclass(frozen=True)
class Options:
    """Which sensors, and how to look."""

    of: str | None = None  # name or topic
    to: str | None = None
    sensors: tuple[str, ...] = ()  # topics, NAME=/topic, or tf:PARENT/CHILD; () takes all that the recording has
    target: Path | None = None
    reading: ImuOptions = _DEFAULT
    plain: bool = False
    inverse_poses: bool = False
    fix_rotation: bool = False
    reach_s: float = Settings.reach_s
    step_s: float = Settings.step_s
    bootstrap: int = 0
    delays: Delays = _NO_DELAYS
    cache: bool = True
    ros_distro: str | None = None


def time_offset(
    sources: Sequence[Path], outputs: Outputs | None = None, options: Options | None = None, progress: Progress = silent
) -> Saved:
    """Estimate the time offset of two sensors of a recording: t_to = t_of + td.

    BadInputError names the file, topic or option that is wrong, or that the two share no time.
    """
    outputs, options = outputs or Outputs(), options or Options()
    base = outputs.open()
    recording = open_recording(list(sources), options.ros_distro, options.reading)
    reader = Reader(recording, base, progress, options.target, options.plain, options.inverse_poses, options.cache)
    of, to = choose_pair(find_sensors(recording, base, options.sensors), options.of, options.to)
    _refuse_idle(options, of, to)
    if to.kind == "image" and options.target is None:
        raise BadInputError(f"--to {to.name}: a camera without a board has turns between images only; swap --of and --to, or give --target")
    seen_to, seen_of = look(reader, to), look(reader, of)  # in this order: an IMU is soon read, and what is wrong with it told
    assert seen_to.samples is not None
    rotation = _rotation(base, of, to) if options.fix_rotation else None
    pair = Pair(of.name, to.name, one_line(of.topic), one_line(to.topic), seen_of.method, seen_of.focal_px)
    turns = seen_of.turns()
    _refuse_lifeless(of, to, turns, seen_to.samples)
    try:
        settings = Settings(options.reach_s, options.step_s, rotation)
        fit = fit_time_offset(turns, seen_to.samples, settings, progress)
    except BadInputError as error:
        damaged = "".join(f" ({text})" for text in recording.warnings)  # what was not read may be why
        raise BadInputError(f"{recording.name}: {of.name} and {to.name}: {error}{damaged}") from None
    few = len(fit.alignment.parts) < _FEWEST_DRAWN
    spread = bootstrap_sigma(fit, options.bootstrap) if options.bootstrap and not few else None
    stamps = {sensor.name: check_stamps(seen.t_ns, _STAMPED.get(sensor.kind, "sample")) for sensor, seen in ((of, seen_of), (to, seen_to))}
    result = time_offset_result(pair, fit, base, stamps, options.delays, spread)
    warnings = [*recording.warnings, *reader.warnings]
    if options.bootstrap and few:
        there = counted(len(fit.alignment.parts), "stretch", "stretches")
        warnings.append(
            f"--bootstrap: {there} of 5 s are too few to draw from, {_FEWEST_DRAWN} are needed: record {5 * _FEWEST_DRAWN} s or more"
        )
    doubts = [
        Reason(Verdict.CHECK, f"dt_{to.name}_{of.name}: {counted(many, 'stamp')} of {sensor.name} {_RECORDED}")
        for sensor in (of, to)
        if (many := recording.recorded.get(sensor.topic))
    ]
    result = replace(result, reasons=(*result.reasons, *doubts), facts={**result.facts, "warnings": warnings})
    read = [*outputs.rigs, *([options.target] if options.target else [])]  # the lens, and the board
    inputs = [*recording.inputs(), *((path.name, sha256(path.read_bytes()).hexdigest()) for path in read)]
    return save(result, base, outputs, inputs, _told(options, of, to))


def _refuse_idle(options: Options, of: Sensor, to: Sensor) -> None:
    """Refuse options that say nothing about this pair: a person who gives one expects it to count."""
    camera, poses, delays = ("image", "corners"), ("pose", "tf"), options.delays
    board, both = options.target is not None, (of.kind, to.kind)
    idle = {
        "--target": board and not set(camera) & set(both) and "neither is a camera",
        "--plain": options.plain and (board or "image" not in both) and "it is for a camera's images without --target",
        "--inverse-poses": options.inverse_poses and not set(poses) & set(both) and "neither gives poses",
        "--gyro-bandwidth": delays.gyro_bandwidth_hz is not None and to.kind != "imu" and f"{to.name} is no IMU; give the IMU as --to",
        "--exposure and --readout": bool(delays.camera_s) and of.kind not in camera and f"{of.name} is no camera; give the camera as --of",
    }
    for name, why in idle.items():
        if why:
            raise BadInputError(f"{name} does not fit {of.name} and {to.name}: {why}")


def _refuse_lifeless(of: Sensor, to: Sensor, turns: Turns, samples: ImuSamples | PoseSamples) -> None:
    """Refuse what has no turns at all; a sensor at rest has some, of noise."""
    same = "gives one and the same value throughout: is it frozen? it must turn"
    if isinstance(samples, PoseSamples) and len(samples.q) and not np.any(samples.q != samples.q[0]):
        raise BadInputError(f"{to.name} ({one_line(to.topic)}) {same}")
    if len(turns.t_ns) == 1 or not any(turns.axes):
        raise BadInputError(f"{of.name} ({one_line(of.topic)}) {same}")
    if not len(turns.first):
        raise BadInputError(
            f"{of.name} ({one_line(of.topic)}) has no turns: its samples lie more than 1 s apart, or each is half a turn on"
        )


def _rotation(base: Rig, of: Sensor, to: Sensor) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    found = find_transform(base, of.name, to.name)
    if found is None:
        raise BadInputError(f"--fix-rotation: no --rig file has T_{of.name}_{to.name}, nor a chain of transforms between them")
    return found[0][:3, :3]


def _told(options: Options, of: Sensor, to: Sensor) -> dict[str, str | float | int | bool | None]:
    return {
        "of": f"{of.name}={one_line(of.topic)}",
        "to": f"{to.name}={one_line(to.topic)}",
        "target": None if options.target is None else options.target.name,
        "plain": options.plain,
        "inverse_poses": options.inverse_poses,
        "fix_rotation": options.fix_rotation,
        "reach_s": options.reach_s,
        "step_s": options.step_s,
        "bootstrap": options.bootstrap,
    }
