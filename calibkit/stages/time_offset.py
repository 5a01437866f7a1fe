"""`calibkit timeoffset`: how far the clocks of two sensors are apart, by how they turn."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from hashlib import sha256
from pathlib import Path

import numpy as np

from calibkit.data.observations import ImuSamples, PoseSamples, Times
from calibkit.data.plural import counted
from calibkit.data.progress import Progress, silent
from calibkit.data.rig import Camera, Rig
from calibkit.data.transforms import find_transform
from calibkit.detection.tracks import track_features
from calibkit.errors import BadInputError, one_line
from calibkit.estimation.board_poses import board_poses
from calibkit.estimation.board_turns import turns_of_board
from calibkit.estimation.stamps import check_stamps
from calibkit.estimation.time_offset import Settings, bootstrap_sigma, fit_time_offset
from calibkit.estimation.time_offset_delay import Delays
from calibkit.estimation.time_offset_result import Pair, time_offset_result
from calibkit.estimation.turns import Turns, turns_of_gyro, turns_of_poses
from calibkit.estimation.two_view import turns_of_tracks
from calibkit.geometry import so3
from calibkit.io.imu_options import ImuOptions
from calibkit.io.recording import Recording, open_recording
from calibkit.io.target_file import load_target
from calibkit.stages.intrinsics import Options as LensOptions
from calibkit.stages.intrinsics import observe
from calibkit.stages.outputs import Outputs, Saved, save

_PREFIX = {"image": "cam", "corners": "cam", "imu": "imu", "pose": "pose", "twist": "odom", "tf": "pose"}
_DEFAULT = ImuOptions()
_NO_DELAYS = Delays()


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


@dataclass(frozen=True)
class Sensor:
    """One stream that may be compared."""

    name: str
    kind: str
    topic: str
    rate_hz: float = 0.0
    count: int = 0


@dataclass(frozen=True)
class Seen:
    """What a sensor saw: turns, and where it can be asked at any time, its samples."""

    turns: Callable[[], Turns]
    samples: ImuSamples | PoseSamples | None
    t_ns: Times
    method: str
    focal_px: float | None = None


@dataclass(frozen=True)
class _Job:
    recording: Recording
    rig: Rig
    options: Options
    progress: Progress
    warnings: list[str] = field(default_factory=list)


def time_offset(
    sources: Sequence[Path], outputs: Outputs | None = None, options: Options | None = None, progress: Progress = silent
) -> Saved:
    """Estimate the time offset of two sensors of a recording: t_to = t_of + td.

    BadInputError names the file, topic or option that is wrong, or that the two share no time.
    """
    outputs, options = outputs or Outputs(), options or Options()
    base = outputs.open()
    recording = open_recording(list(sources), options.ros_distro, options.reading)
    job = _Job(recording, base, options, progress)
    of, to = _pair(_sensors(recording, base, options), options)
    _refuse_idle(options, of, to)
    if to.kind == "image" and options.target is None:
        raise BadInputError(f"--to {to.name}: a camera without a board has turns between images only; swap --of and --to, or give --target")
    seen_to, seen_of = _look(job, to), _look(job, of)  # in this order: an IMU is soon read, and what is wrong with it told
    assert seen_to.samples is not None
    rotation = _rotation(base, of, to) if options.fix_rotation else None
    pair = Pair(of.name, to.name, one_line(of.topic), one_line(to.topic), seen_of.method, seen_of.focal_px)
    turns = seen_of.turns()
    _refuse_lifeless(of, to, turns, seen_to.samples)
    try:
        settings = Settings(options.reach_s, options.step_s, rotation)
        fit = fit_time_offset(turns, seen_to.samples, settings, progress)
    except BadInputError as error:
        raise BadInputError(f"{recording.name}: {of.name} and {to.name}: {error}") from None
    spread = bootstrap_sigma(fit, options.bootstrap) if options.bootstrap else None
    stamps = {sensor.name: check_stamps(seen.t_ns) for sensor, seen in ((of, seen_of), (to, seen_to))}
    result = time_offset_result(pair, fit, base, stamps, options.delays, spread)
    result = replace(result, facts={**result.facts, "warnings": [*recording.warnings, *job.warnings]})
    inputs = [*recording.inputs()]
    if options.target is not None:
        inputs.append((options.target.name, sha256(options.target.read_bytes()).hexdigest()))
    return save(result, base, outputs, inputs, _told(options, of, to))


def _sensors(recording: Recording, base: Rig, options: Options) -> list[Sensor]:
    """Return the streams to choose from, named as the rig file has their topics, else cam0, imu0, pose0, odom0 in order.

    Those asked for, or all; where one alone is asked for, those of other kinds too.
    """
    topics = {topic.name: topic for topic in recording.topics}
    asked = [text.rpartition("=") if "=" in text and not text.startswith("tf:") else ("", "", text) for text in options.sensors]
    if len(asked) < 2:  # the other one is found, if it is of another kind
        there = {_PREFIX.get(topics[topic].kind) if topic in topics else _PREFIX["tf"] for _, _, topic in asked}
        others = (topic for topic in recording.topics if topic.kind in _PREFIX and topic.kind != "tf")
        asked += [("", "", topic.name) for topic in others if _PREFIX[topic.kind] not in there]
    known = {entry.topic: name for part in (base.cameras, base.imus) for name, entry in part.items() if entry.topic}
    found: list[Sensor] = []
    for name, _, topic in asked:
        if topic.startswith("tf:"):
            kind, count = "tf", 0
        elif topic in topics:
            kind, count = topics[topic].kind, topics[topic].count
        else:
            raise BadInputError(f"{recording.name}: there is no topic {one_line(topic) or '(empty)'}; calibkit info lists what it has")
        if kind not in _PREFIX:
            recording.choose("pose", topic)  # says what it is instead
        prefix = _PREFIX[kind]
        given = name or known.get(topic) or f"{prefix}{sum(sensor.name.startswith(prefix) for sensor in found)}"
        if not given.isalnum() or not given[0].isalpha() or any(sensor.name == given for sensor in found):
            raise BadInputError(
                f"{one_line(given) or '(empty)'}={one_line(topic)}: write NAME=/topic with a new name of letters and digits"
            )
        found.append(Sensor(given, kind, topic, count=count))
    return found


def _pair(sensors: list[Sensor], options: Options) -> tuple[Sensor, Sensor]:
    """Return of and to: as asked for, else the only two there are, an IMU or the faster stream being `to`."""
    offered = ", ".join(f"{sensor.name} ({one_line(sensor.topic)})" for sensor in sensors) or "none"

    def one(asked: str) -> Sensor:
        match = [sensor for sensor in sensors if asked in (sensor.name, sensor.topic)]
        if not match:
            raise BadInputError(f"{one_line(asked)} is no sensor of this recording: it has {offered}")
        return match[0]

    if options.of is not None and options.to is not None:
        of, to = one(options.of), one(options.to)
    else:
        named = [one(asked) for asked in (options.of, options.to) if asked is not None]
        others = [sensor for sensor in sensors if sensor not in named]
        if len(named) + len(others) > 2:
            imus = [sensor for sensor in others if sensor.kind == "imu"]
            others = imus if named and len(imus) == 1 else others
        if len(sensors) < 2:
            raise BadInputError(
                f"two sensors that turn are needed, the recording has {offered}: give the other one's file too, or --pose tf:PARENT/CHILD"
            )
        if len(named) + len(others) != 2:
            raise BadInputError(
                f"which two? the recording has {counted(len(sensors), 'sensor')} that turn: {offered}; name them: --of NAME --to NAME"
            )
        both = [*named, *others]
        if options.to is not None:
            of, to = others[0], named[0]
        elif options.of is not None:
            of, to = named[0], others[0]
        else:
            of, to = sorted(both, key=lambda sensor: (sensor.kind == "imu", sensor.kind == "twist", sensor.count))
    if of == to:
        raise BadInputError(f"--of and --to are both {of.name}: name two sensors")
    return of, to


def _look(job: _Job, sensor: Sensor) -> Seen:
    readers: dict[str, Callable[[_Job, Sensor], Seen]] = {
        "image": _camera, "corners": _camera, "imu": _imu, "twist": _odometer, "pose": _poses, "tf": _tf,
    }  # fmt: skip
    return readers[sensor.kind](job, sensor)


def _camera(job: _Job, sensor: Sensor) -> Seen:
    camera = job.rig.cameras.get(sensor.name)
    if camera is None:
        raise BadInputError(f"{sensor.name} ({one_line(sensor.topic)}) has no lens: run calibkit intrinsics, then add --rig RIG.yaml")
    if job.options.target is None:
        return _features(job, sensor, camera)
    lens = LensOptions(resolution=camera.resolution, cache=job.options.cache)
    board = load_target(job.options.target)
    views = observe(job.recording, {sensor.name: sensor.topic}, board, lens, job.progress)[0]
    poses = board_poses(views, camera)
    job.warnings.extend(views.warnings)
    turns = turns_of_board(poses)
    q = so3.to_quat(np.swapaxes(poses.T_cam_board[:, :3, :3], 1, 2))
    p = -(np.swapaxes(poses.T_cam_board[:, :3, :3], 1, 2) @ poses.T_cam_board[:, :3, 3:])[:, :, 0]
    samples = PoseSamples(poses.t_ns, q, p, "board", sensor.name)
    return Seen(lambda: turns, samples, views.t_ns, "poses of the board", _focal(camera))


def _features(job: _Job, sensor: Sensor, camera: Camera) -> Seen:
    if sensor.kind != "image":
        raise BadInputError(f"{sensor.name} ({one_line(sensor.topic)}) holds a board's corners: add --target T.yaml")
    tracks = track_features(job.recording.images(sensor.topic), sensor.name, job.progress, sensor.count)
    method = "features, rotation only (plain: biased beside near things)" if job.options.plain else "features, two views"
    return Seen(lambda: turns_of_tracks(tracks, camera, job.options.plain), None, tracks.t_ns, method, _focal(camera))


def _focal(camera: Camera) -> float | None:
    return camera.parameters["fx"].value if "fx" in camera.parameters else None


def _imu(job: _Job, sensor: Sensor) -> Seen:
    samples = job.recording.imu(sensor.topic, job.progress, partial=True)
    if not samples.has_gyro:
        raise BadInputError(f"{sensor.name} ({one_line(sensor.topic)}) has no gyroscope: rates of turn are what is compared")
    return Seen(lambda: turns_of_gyro(samples), samples, samples.t_ns, "gyroscope")


def _odometer(job: _Job, sensor: Sensor) -> Seen:
    samples = job.recording.twist(sensor.topic)
    return Seen(lambda: turns_of_gyro(samples), samples, samples.t_ns, "rates of turn")


def _poses(job: _Job, sensor: Sensor) -> Seen:
    return _of_poses(job, job.recording.poses(sensor.topic))


def _tf(job: _Job, sensor: Sensor) -> Seen:
    parent, _, child = sensor.topic.removeprefix("tf:").removeprefix("/").partition("/")
    if not (sensor.topic.startswith("tf:") and parent and child):
        raise BadInputError(f"--pose {one_line(sensor.topic)}: of a tf tree name two frames, --pose tf:PARENT/CHILD")
    return _of_poses(job, job.recording.tf(parent, child))


def _of_poses(job: _Job, poses: PoseSamples) -> Seen:
    if job.options.inverse_poses:
        R = np.swapaxes(so3.from_quat(poses.q), 1, 2)
        poses = PoseSamples(poses.t_ns, so3.to_quat(R), -(R @ poses.p[:, :, None])[:, :, 0], poses.child, poses.parent)
    return Seen(lambda: turns_of_poses(poses), poses, poses.t_ns, "poses")


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
