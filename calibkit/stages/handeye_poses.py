"""The two sides' poses of `calibkit handeye`, wherever they come from: pairs, a robot's file beside images, streams of a recording."""

from collections.abc import Sequence
from functools import partial
from hashlib import sha256
from pathlib import Path

import numpy as np

from calibkit.data.progress import Progress
from calibkit.data.rig import Rig
from calibkit.errors import BadInputError, one_line
from calibkit.estimation.board_poses import board_poses
from calibkit.estimation.intrinsics import CameraRequest, calibrate_cameras
from calibkit.geometry import se3
from calibkit.geometry.so3 import Array
from calibkit.io.folder import NO_STAMPS
from calibkit.io.pose_files import PoseTable, load_pose_pairs, load_poses
from calibkit.io.pose_match import match_images
from calibkit.io.recording import Recording, open_recording
from calibkit.io.target_file import load_target
from calibkit.models.cameras import ALIASES, CAMERAS
from calibkit.stages.handeye_sides import ROBOT, Options, Seen, Sides, arm_names, only
from calibkit.stages.handeye_streams import beside_board, of_file, robot_stream, two_streams
from calibkit.stages.intrinsics import AUTO, name_cameras, observe
from calibkit.stages.intrinsics import Options as LensOptions

_NEEDLESS = (NO_STAMPS, "is not recognised: ")


def gather(sources: Sequence[Path], rig: Rig, options: Options, progress: Progress) -> Sides:
    """Return both sides' poses; BadInputError names what is missing."""
    if options.pairs:
        return _pairs(sources, options)
    recording = open_recording(list(sources), options.ros_distro)
    if options.target is not None:
        return _robot(recording, rig, options, progress)
    if options.poses is not None:
        raise BadInputError("--poses belongs to images of a board: add --target T.yaml (two files of poses: --pairs A --pairs B)")
    return two_streams(recording, rig, options, progress)


def _pairs(sources: Sequence[Path], options: Options) -> Sides:
    """Return ready-made pairs."""
    if sources or options.poses is not None or options.target is not None or len(options.pairs) > 2:
        raise BadInputError("--pairs is all there is: one file of two poses a row, or two files; leave out SOURCE, --poses and --target")
    second = options.pairs[1] if len(options.pairs) == 2 else None
    tables = load_pose_pairs(options.pairs[0], second, options.pose_format, options.pose_unit, options.angle_unit)
    inverse = (options.inverse_poses, options.inverse_second)
    first, other = (_turned(table.poses, way) for table, way in zip(tables, inverse, strict=True))
    motion = options.motions or options.setup == "motion"
    base, gripper = arm_names(options)
    t_ns = next((table.t_ns for table in tables if table.t_ns is not None), None)
    how = f"{len(first)} pairs of {' and '.join(one_line(path.name) for path in options.pairs)}"
    return Sides(
        first,
        other,
        ("sensor1", "sensor2", "world1", "world2") if motion else (gripper, "cam", base, "target"),
        ("motion",) if motion else (*ROBOT, "motion"),
        tuple(tables[0].named(row) for row in range(len(first))),
        t_ns,
        lines=(how, *_notes(*tables)),
        inputs=tuple(_hashed(path) for path in options.pairs),
    )


def _robot(recording: Recording, rig: Rig, options: Options, progress: Progress) -> Sides:
    """Return a robot's poses beside the board's in its images: by name or order, or by time where both have stamps."""
    assert options.target is not None
    if options.setup == "motion":
        raise BadInputError("--setup motion is for two streams of poses: of a camera and a robot it is eye-in-hand or eye-to-hand")
    topics = name_cameras(recording, options.cameras)
    if len(topics) > 1:
        raise BadInputError("handeye takes one camera at a time: give one --camera, then the next with --rig OUT.yaml")
    [(name, topic)] = topics.items()
    base, gripper = arm_names(options)
    inputs = [*recording.inputs(), _hashed(options.target)]
    if options.poses is None:
        stream = robot_stream(recording, options)  # before the images: it is soon read
        board = _look(recording, rig, name, topic, options, progress)
        return beside_board(stream, board, recording, rig, options, inputs, progress)
    table = load_poses(options.poses, options.pose_format, options.pose_unit, options.angle_unit, base, gripper)
    board = _look(recording, rig, name, topic, options, progress)
    inputs.append(_hashed(table.path))
    if table.t_ns is not None and table.labels is None and board.views.t_ns.any():
        return beside_board(of_file(table), board, recording, rig, options, inputs, progress, _notes(table))
    return _beside(table, board, recording, topic, options, inputs)


def _look(recording: Recording, rig: Rig, name: str, topic: str, options: Options, progress: Progress) -> Seen:
    """Return the board's poses, by the rig file's lens, else by one that is calibrated from the same images."""
    assert options.target is not None
    known, images = rig.cameras.get(name), None
    if any(t.name == topic and t.kind == "image" for t in recording.topics):
        images = partial(recording.images, topic)
    asked = LensOptions(resolution=options.resolution or (known.resolution if known else None), cache=options.cache)
    views = observe(recording, {name: topic}, load_target(options.target), asked, progress)[0]
    if known is not None:
        return Seen(views, board_poses(views, known), known, None, images)
    lens = calibrate_cameras([CameraRequest(views, _model(options.model), one_line(topic))], progress=progress)
    camera = lens.rig.cameras[name]
    unknown = [key for key, value in camera.parameters.items() if value.value is None]
    if unknown:
        raise BadInputError(
            f"{name}: these images do not tell its lens ({', '.join(unknown)}): add --rig RIG.yaml of calibkit intrinsics, "
            "or images of the board tilted by 30 to 45 deg"
        )
    return Seen(views, board_poses(views, camera), camera, lens, images)


def _model(name: str) -> str | None:
    known = ALIASES.get(name, name)
    if known != AUTO and known not in CAMERAS:
        raise BadInputError(f"--model {one_line(name)} is not known: choose {AUTO}, {', '.join([*CAMERAS, *ALIASES])}")
    return None if known == AUTO else known


def _beside(
    table: PoseTable, board: Seen, recording: Recording, topic: str, options: Options, inputs: list[tuple[str, str | None]]
) -> Sides:
    """Return the poses of a file beside the images that they belong to."""
    info = next(t for t in recording.topics if t.name == topic)
    images = [image.label for image in recording.images(topic)] if info.kind == "image" else list(board.views.labels)
    if len(set(images)) < len(images):
        raise BadInputError(f"{recording.name}: {topic} has images of one stamp, so a pose cannot be given to each: correct the stamps")
    matches = match_images(table, images)
    row_of = {images[i]: int(row) for row, i in zip(matches.pose, matches.image, strict=True)}
    chosen = np.array([k for k, label in enumerate(board.poses.labels) if label in row_of], np.intp)
    if len(chosen) < 2:
        raise BadInputError(
            f"{one_line(table.path)}: {len(chosen)} of its poses have an image that tells the board's pose: hand-eye needs 10 or more"
        )
    rows = np.array([row_of[board.poses.labels[k]] for k in chosen], np.intp)
    return Sides(
        _turned(table.poses[rows], options.inverse_poses),
        board.poses.T_cam_board[chosen],
        (table.child, board.views.camera, table.parent, "target"),
        ROBOT,
        tuple(board.poses.labels[k] for k in chosen),
        board.poses.t_ns[chosen] if board.poses.t_ns.any() else None,
        board.poses.cov[chosen],
        only(board, chosen),
        (matches.how.replace(one_line(table.path), one_line(table.path.name)), *_unseen(board, len(images)), *_notes(table)),
        (*_of_account(recording.warnings, table), *board.views.warnings),
        tuple(inputs),
    )


def _of_account(warnings: Sequence[str], table: PoseTable) -> list[str]:
    """Return warnings without those that say nothing here: of stamps where images go by name or order, of a folder's pose files."""
    return [text for text in warnings if not text.startswith(table.path.name) and not any(part in text for part in _NEEDLESS)]


def _unseen(board: Seen, images: int) -> list[str]:
    """Return in how many images there is no board, or none with a pose."""
    seen, lost = board.views.n_frames, board.poses.dropped
    lines = [f"the board is in {seen} of {images} images"] if seen < images else []
    if lost:
        named = ", ".join(f"{one_line(view.label, 60)} ({view.why})" for view in lost[:5])
        lines.append(f"no pose of the board in {len(lost)} of them: {named}{', ...' if len(lost) > 5 else ''}")
    return lines


def _turned(T: Array, inverse: bool) -> Array:
    return se3.inverse(T) if inverse else T


def _notes(*tables: PoseTable) -> list[str]:
    return [f"{one_line(table.path.name)}: {note}" for table in tables for note in table.notes]


def _hashed(path: Path) -> tuple[str, str | None]:
    return path.name, sha256(path.read_bytes()).hexdigest()
