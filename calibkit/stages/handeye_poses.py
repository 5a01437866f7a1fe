"""The two sides' poses of `calibkit handeye`, wherever they come from: pairs, a robot's file beside images, streams of a recording."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from hashlib import sha256
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibkit.data.observations import BoardViews, PoseSamples
from calibkit.data.progress import Progress
from calibkit.data.result import Result
from calibkit.data.rig import Camera, Rig
from calibkit.errors import BadInputError, one_line
from calibkit.estimation.board_poses import BoardPoses, board_poses
from calibkit.estimation.intrinsics import CameraRequest, calibrate_cameras
from calibkit.geometry import se3, so3
from calibkit.geometry.so3 import Array
from calibkit.io.pose_files import PoseTable, load_pose_pairs, load_poses
from calibkit.io.pose_match import match_images
from calibkit.io.recording import Recording, open_recording
from calibkit.io.target_file import load_target
from calibkit.models.cameras import ALIASES, CAMERAS
from calibkit.stages.intrinsics import AUTO, name_cameras, observe
from calibkit.stages.intrinsics import Options as LensOptions

ROBOT = ("eye-in-hand", "eye-to-hand")
Times = NDArray[np.int64]


@dataclass(frozen=True)
class Options:
    """Which poses, and how to look."""

    poses: Path | None = None  # a robot's
    pose_format: str | None = None
    pose_unit: str | None = None
    angle_unit: str | None = None
    pairs: tuple[Path, ...] = ()
    motions: bool = False  # the pairs are motions, no poses
    pose: tuple[str, ...] = ()  # topics, NAME=/topic, or tf:PARENT/CHILD
    cameras: tuple[str, ...] = ()
    target: Path | None = None
    model: str = AUTO  # of a lens that is calibrated on the way
    resolution: tuple[int, int] | None = None
    base: str | None = None  # what to call the poses' frames
    gripper: str | None = None
    inverse_poses: bool = False
    inverse_second: bool = False
    setup: str | None = None
    predict: int = 0
    method: str = "refined"
    cache: bool = True
    ros_distro: str | None = None

    @property
    def pose_files(self) -> list[Path]:
        return [path for path in (self.poses, *self.pairs) if path is not None]


@dataclass(frozen=True)
class Seen:
    """A camera's boards, and the lens that they were seen through."""

    views: BoardViews
    poses: BoardPoses
    camera: Camera
    lens: Result | None  # where it was calibrated on the way


@dataclass(frozen=True)
class Sides:
    """n poses of each side that belong together."""

    first: Array  # (n, 4, 4) T_base_gripper, or T_world1_sensor1
    second: Array  # (n, 4, 4) T_cam_target, or T_world2_sensor2
    frames: tuple[str, str, str, str]  # gripper, cam, base, target, or sensor1, sensor2, world1, world2
    candidates: tuple[str, ...]  # setups that it may be
    labels: tuple[str, ...]
    t_ns: Times | None = None  # (n,)
    cov_second: Array | None = None  # (n, 6, 6)
    board: Seen | None = None  # with one pose a row
    lines: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    inputs: tuple[tuple[str, str | None], ...] = field(default=())

    def words(self, setup: str) -> tuple[str, str, str, str]:
        """Return the frames 1, 2, w1, w2 of a setup."""
        one, two, w1, w2 = self.frames
        return (w1, two, one, w2) if setup == "eye-to-hand" else (one, two, w1, w2)


def gather(sources: Sequence[Path], rig: Rig, options: Options, progress: Progress) -> Sides:
    """Return both sides' poses; BadInputError names what is missing."""
    if options.pairs:
        return _pairs(sources, options)
    recording = open_recording(list(sources), options.ros_distro)
    if options.target is None:
        if options.poses is not None:
            raise BadInputError("--poses belongs to images of a board: add --target T.yaml (two files of poses: --pairs A --pairs B)")
        return _streams(recording, options)
    return _robot(recording, rig, options, progress)


def _pairs(sources: Sequence[Path], options: Options) -> Sides:
    """Return ready-made pairs."""
    if sources or options.poses is not None or options.target is not None or len(options.pairs) > 2:
        raise BadInputError("--pairs is all there is: one file of two poses a row, or two files; leave out SOURCE, --poses and --target")
    second = options.pairs[1] if len(options.pairs) == 2 else None
    tables = load_pose_pairs(options.pairs[0], second, options.pose_format, options.pose_unit, options.angle_unit)
    first, other = (
        _turned(table.poses, inverse) for table, inverse in zip(tables, (options.inverse_poses, options.inverse_second), strict=True)
    )
    labels = tuple(tables[0].named(row) for row in range(len(first)))
    motion = options.motions or options.setup == "motion"
    base, gripper = _arm(options)
    frames = ("sensor1", "sensor2", "world1", "world2") if motion else (gripper, "cam", base, "target")
    t_ns = next((table.t_ns for table in tables if table.t_ns is not None), None)
    how = f"{len(first)} pairs of {' and '.join(one_line(path.name) for path in options.pairs)}"
    return Sides(
        first,
        other,
        frames,
        ("motion",) if motion else (*ROBOT, "motion"),
        labels,
        t_ns,
        lines=(how, *_notes(*tables)),
        inputs=tuple(_hashed(path) for path in options.pairs),
    )


def _robot(recording: Recording, rig: Rig, options: Options, progress: Progress) -> Sides:
    """Return a robot's poses beside the board's in its images."""
    assert options.target is not None
    topics = name_cameras(recording, options.cameras)
    if len(topics) > 1:
        raise BadInputError("handeye takes one camera at a time: give one --camera, then the next with --rig OUT.yaml")
    [(name, topic)] = topics.items()
    table = None
    if options.poses is not None:
        base, gripper = _arm(options)
        table = load_poses(options.poses, options.pose_format, options.pose_unit, options.angle_unit, base, gripper)
    stream = _stream(recording, options.pose[0] if options.pose else None, options) if table is None else None
    board = _look(recording, rig, name, topic, options, progress)
    if table is not None:
        return _beside(table, board, recording, topic, options)
    assert stream is not None
    raise BadInputError(f"{recording.name}: {stream.parent}")


def _look(recording: Recording, rig: Rig, name: str, topic: str, options: Options, progress: Progress) -> Seen:
    """Return the board's poses, by the rig file's lens, else by one that is calibrated from the same images."""
    assert options.target is not None
    known = rig.cameras.get(name) or next((camera for camera in rig.cameras.values() if camera.topic and camera.topic == topic), None)
    size = options.resolution or (known.resolution if known else None)
    asked = LensOptions(resolution=size, cache=options.cache)
    views = observe(recording, {name: topic}, load_target(options.target), asked, progress)[0]
    if known is not None:
        return Seen(views, board_poses(views, known), known, None)
    lens = calibrate_cameras([CameraRequest(views, _model(options.model), one_line(topic))], progress=progress)
    camera = lens.rig.cameras[name]
    unknown = [key for key, value in camera.parameters.items() if value.value is None]
    if unknown:
        raise BadInputError(
            f"{name}: these images do not tell its lens ({', '.join(unknown)}): add --rig RIG.yaml of calibkit intrinsics, "
            "or images of the board tilted by 30 to 45 deg"
        )
    return Seen(views, board_poses(views, camera), camera, lens)


def _model(name: str) -> str | None:
    known = ALIASES.get(name, name)
    if known != AUTO and known not in CAMERAS:
        raise BadInputError(f"--model {one_line(name)} is not known: choose {AUTO}, {', '.join([*CAMERAS, *ALIASES])}")
    return None if known == AUTO else known


def _beside(table: PoseTable, board: Seen, recording: Recording, topic: str, options: Options) -> Sides:
    """Return the poses of a file beside the images that they belong to."""
    info = next(t for t in recording.topics if t.name == topic)
    images = [image.label for image in recording.images(topic)] if info.kind == "image" else list(board.views.labels)
    matches = match_images(table, images)
    row_of = {images[i]: int(row) for row, i in zip(matches.pose, matches.image, strict=True)}
    if len(set(images)) < len(images):
        raise BadInputError(
            f"{recording.name}: {topic} has images with equal stamps, so a pose cannot be given to each: correct the stamps"
        )
    chosen = [k for k, label in enumerate(board.poses.labels) if label in row_of]
    if len(chosen) < 2:
        raise BadInputError(
            f"{one_line(table.path)}: {len(chosen)} of its poses have an image that shows the board; hand-eye needs 10 or more"
        )
    rows = np.array([row_of[board.poses.labels[k]] for k in chosen], np.intp)
    board = _only(board, np.array(chosen, np.intp))
    lost = [f"{view.label} ({view.why})" for view in board.poses.dropped]
    unseen = len(images) - len(board.views.labels)
    lines = [
        matches.how.replace(one_line(table.path), one_line(table.path.name)),
        f"the board is in {len(board.views.labels)} of {len(images)} images",
    ]
    lines += [f"no pose of the board in {', '.join(lost[:5])}{' ...' if len(lost) > 5 else ''}"] if lost else []
    moving = bool(board.poses.t_ns.any())
    return Sides(
        _turned(table.poses[rows], options.inverse_poses),
        board.poses.T_cam_board,
        (table.child, board.views.camera, table.parent, "target"),
        ROBOT,
        board.poses.labels,
        board.poses.t_ns if moving else None,
        board.poses.cov,
        board,
        lines=(*lines[: 2 if unseen or lost else 1], *lines[2:], *_notes(table)),
        warnings=(*(w for w in recording.warnings if not w.startswith(table.path.name)), *board.views.warnings),
        inputs=(*recording.inputs(), _hashed(table.path), *([_hashed(options.target)] if options.target else [])),
    )


def _only(board: Seen, rows: NDArray[np.intp]) -> Seen:
    """Return some of a camera's board poses."""
    p = board.poses
    kept = p.kept & np.isin(board.views.frame, p.frame[rows])
    some = replace(
        p,
        t_ns=p.t_ns[rows],
        labels=tuple(p.labels[i] for i in rows),
        frame=p.frame[rows],
        T_cam_board=p.T_cam_board[rows],
        cov=p.cov[rows],
        rms=p.rms[rows],
        n_corners=p.n_corners[rows],
        kept=kept,
    )
    return replace(board, poses=some)


def _streams(recording: Recording, options: Options) -> Sides:
    raise BadInputError(f"{recording.name}: two streams of poses are not read yet: give --pairs")


def _stream(recording: Recording, asked: str | None, options: Options) -> PoseSamples:
    """Return a stream of poses by its topic or its tf frames, else the only one."""
    if asked is None:
        return recording.poses(recording.choose("pose"))
    topic = asked if asked.startswith("tf:") else asked.rpartition("=")[2]
    if topic.startswith("tf:"):
        parent, _, child = topic.removeprefix("tf:").partition("/")
        return recording.tf(parent, child)
    return recording.poses(recording.choose("pose", topic))


def _arm(options: Options) -> tuple[str, str]:
    """Return what to call the poses' parent and child."""
    names = (options.base or "base", options.gripper or "gripper")
    for name in names:
        if not (name.isascii() and name.isalnum() and name[0].isalpha()) or names[0] == names[1]:
            raise BadInputError(f"--base {one_line(names[0])} --gripper {one_line(names[1])}: give two names of letters and digits")
    return names


def _turned(T: Array, inverse: bool) -> Array:
    return se3.inverse(T) if inverse else T


def _matrices(poses: PoseSamples) -> Array:
    return se3.make(so3.from_quat(poses.q), poses.p)


def _notes(*tables: PoseTable) -> list[str]:
    return [f"{one_line(table.path.name)}: {note}" for table in tables for note in table.notes]


def _hashed(path: Path) -> tuple[str, str | None]:
    return path.name, sha256(path.read_bytes()).hexdigest()
