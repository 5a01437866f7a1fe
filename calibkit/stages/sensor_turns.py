"""How each kind of sensor is read to tell how it turns."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from calibkit.data.observations import ImuSamples, PoseSamples, Times
from calibkit.data.progress import Progress
from calibkit.data.rig import Camera, Rig
from calibkit.detection.tracks import track_features
from calibkit.errors import BadInputError, one_line
from calibkit.estimation.board_poses import board_poses
from calibkit.estimation.board_turns import turns_of_board
from calibkit.estimation.pose_jumps import TOLD, without_jumps
from calibkit.estimation.turns import Turns, turns_of_gyro, turns_of_poses
from calibkit.estimation.two_view import turns_of_tracks
from calibkit.geometry import so3
from calibkit.io.recording import Recording
from calibkit.io.target_file import load_target
from calibkit.stages.intrinsics import Options as LensOptions
from calibkit.stages.intrinsics import observe
from calibkit.stages.sensors import Sensor


@dataclass(frozen=True)
class Seen:
    """What a sensor saw: turns, and where it can be asked at any time, its samples."""

    turns: Callable[[], Turns]
    samples: ImuSamples | PoseSamples | None
    t_ns: Times
    method: str
    focal_px: float | None = None


@dataclass(frozen=True)
class Reader:
    """What sensors are read with."""

    recording: Recording
    rig: Rig
    progress: Progress
    target: Path | None = None
    plain: bool = False
    inverse_poses: bool = False
    cache: bool = True
    warnings: list[str] = field(default_factory=list)


def look(reader: Reader, sensor: Sensor) -> Seen:
    """Return what a sensor saw; BadInputError where it cannot tell turns, or needs a lens or a board that is not given."""
    readers: dict[str, Callable[[Reader, Sensor], Seen]] = {
        "image": _camera, "corners": _camera, "imu": _imu, "twist": _odometer, "pose": _poses, "tf": _tf,
    }  # fmt: skip
    return readers[sensor.kind](reader, sensor)


def _camera(reader: Reader, sensor: Sensor) -> Seen:
    camera = reader.rig.cameras.get(sensor.name)
    if camera is None:
        raise BadInputError(f"{sensor.name} ({one_line(sensor.topic)}) has no lens: run calibkit intrinsics, then add --rig RIG.yaml")
    if reader.target is None:
        return _features(reader, sensor, camera)
    lens = LensOptions(resolution=camera.resolution, cache=reader.cache)
    board = load_target(reader.target)
    views = observe(reader.recording, {sensor.name: sensor.topic}, board, lens, reader.progress)[0]
    poses = board_poses(views, camera)
    reader.warnings.extend(views.warnings)
    turns = turns_of_board(poses)
    q = so3.to_quat(np.swapaxes(poses.T_cam_board[:, :3, :3], 1, 2))
    p = -(np.swapaxes(poses.T_cam_board[:, :3, :3], 1, 2) @ poses.T_cam_board[:, :3, 3:])[:, :, 0]
    samples = PoseSamples(poses.t_ns, q, p, "board", sensor.name)
    return Seen(lambda: turns, samples, views.t_ns, "poses of the board", _focal(camera))


def _features(reader: Reader, sensor: Sensor, camera: Camera) -> Seen:
    if sensor.kind != "image":
        raise BadInputError(f"{sensor.name} ({one_line(sensor.topic)}) holds a board's corners: add --target T.yaml")
    tracks = track_features(reader.recording.images(sensor.topic), sensor.name, reader.progress, sensor.count)
    method = "features, rotation only (plain: biased beside near things)" if reader.plain else "features, two views"
    return Seen(lambda: turns_of_tracks(tracks, camera, reader.plain), None, tracks.t_ns, method, _focal(camera))


def _focal(camera: Camera) -> float | None:
    return camera.parameters["fx"].value if "fx" in camera.parameters else None


def _imu(reader: Reader, sensor: Sensor) -> Seen:
    samples = reader.recording.imu(sensor.topic, reader.progress, partial=True)
    if not samples.has_gyro:
        raise BadInputError(f"{sensor.name} ({one_line(sensor.topic)}) has no gyroscope: rates of turn are what is compared")
    return Seen(lambda: turns_of_gyro(samples), samples, samples.t_ns, "gyroscope")


def _odometer(reader: Reader, sensor: Sensor) -> Seen:
    samples = reader.recording.twist(sensor.topic)
    return Seen(lambda: turns_of_gyro(samples), samples, samples.t_ns, "rates of turn")


def _poses(reader: Reader, sensor: Sensor) -> Seen:
    return _of_poses(reader, sensor, reader.recording.poses(sensor.topic))


def _tf(reader: Reader, sensor: Sensor) -> Seen:
    parent, _, child = sensor.topic.removeprefix("tf:").removeprefix("/").partition("/")
    if not (sensor.topic.startswith("tf:") and parent and child):
        raise BadInputError(f"--pose {one_line(sensor.topic)}: of a tf tree name two frames, --pose tf:PARENT/CHILD")
    return _of_poses(reader, sensor, reader.recording.tf(parent, child))


def _of_poses(reader: Reader, sensor: Sensor, poses: PoseSamples) -> Seen:
    if reader.inverse_poses:
        R = np.swapaxes(so3.from_quat(poses.q), 1, 2)
        poses = PoseSamples(poses.t_ns, so3.to_quat(R), -(R @ poses.p[:, :, None])[:, :, 0], poses.child, poses.parent)
    steady, wrong = without_jumps(poses)
    if wrong > TOLD:
        reader.warnings.append(f"{sensor.name}: {wrong:.0%} of the poses jump away from their neighbours and back; they are left out")
    return Seen(lambda: turns_of_poses(steady), steady, poses.t_ns, "poses")
