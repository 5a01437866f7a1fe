"""Two streams of poses, or one beside a board that a camera sees, made pairs for `calibkit handeye`."""

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calibkit.data.observations import PoseSamples
from calibkit.data.progress import Progress
from calibkit.data.rig import Estimate, Rig, TimeOffset
from calibkit.data.transforms import find_time_offset, make_time_offset
from calibkit.data.verdict import Status, worst
from calibkit.errors import BadInputError, one_line
from calibkit.estimation.hand_eye import HandEyeFit
from calibkit.estimation.hand_eye_setup import SIGNS, choose_fit
from calibkit.estimation.hand_eye_streams import calibrate_streams
from calibkit.estimation.pose_interpolation import PoseStream, inverted, stream_of, stream_of_board
from calibkit.estimation.pose_offset import Settings
from calibkit.estimation.pose_pairing import Pairing
from calibkit.geometry import se3
from calibkit.io.pose_files import PoseTable
from calibkit.io.recording import Recording
from calibkit.solver.trust import SCALES, grade
from calibkit.stages.handeye_sides import ROBOT, Options, Seen, Sides, arm_names, only, words

Found = tuple[Pairing, HandEyeFit]


def two_streams(recording: Recording, rig: Rig, options: Options, progress: Progress) -> Sides:
    """Return the pairs of two streams of poses."""
    if options.setup not in (None, "motion"):
        raise BadInputError(f"--setup {options.setup} is for a robot and a camera that sees a board: add --target T.yaml")
    asked = list(options.pose) or [topic.name for topic in recording.topics if topic.kind == "pose"]
    if len(asked) != 2:
        offered = ", ".join(one_line(topic, 60) for topic in asked) or "none"
        raise BadInputError(
            f"{recording.name}: two streams of poses are needed, it has {offered}: name two with --pose TOPIC or --pose tf:PARENT/CHILD "
            "(a camera needs --target T.yaml)"
        )
    names = [_name(text, f"pose{i}") for i, text in enumerate(asked)]
    if names[0] == names[1]:
        raise BadInputError(f"--pose: both streams would be called {names[0]}: write NAME=/topic")
    first, second = (stream_of(name, _samples(recording, text)) for name, text in zip(names, asked, strict=True))
    first = inverted(first) if options.inverse_poses else first
    second = inverted(second) if options.inverse_second else second
    frames = (*names, f"{names[0]}world", f"{names[1]}world")
    told = [f"{name} is {one_line(text.rpartition('=')[2], 100)}" for name, text in zip(names, asked, strict=True)]
    try:
        found = _calibrate(first, second, "motion", (frames[0], frames[1], frames[2], frames[3]), rig, progress)
    except BadInputError as error:
        raise BadInputError(f"{', '.join(told)}: {error}") from None
    sides = _sides(found, (first.name, second.name), (frames[0], frames[1], frames[2], frames[3]), ("motion",))
    return replace(sides, lines=(", ".join(told), *sides.lines), warnings=tuple(recording.warnings), inputs=tuple(recording.inputs()))


def robot_stream(recording: Recording, options: Options) -> tuple[PoseStream, tuple[str, str]]:
    """Return a robot's poses out of the recording, and what their parent and child are called."""
    if len(options.pose) > 1:
        raise BadInputError("--pose: one stream of poses goes with a camera's images: leave out the other")
    base, gripper = arm_names(options)
    if not options.pose:
        topics = [topic.name for topic in recording.topics if topic.kind == "pose"]
        if len(topics) != 1:
            offered = ", ".join(one_line(topic, 60) for topic in topics) or "none"
            raise BadInputError(
                f"{recording.name}: which are the robot's poses? it has {offered}: --poses FILE, --pose TOPIC or --pose tf:BASE/GRIPPER"
            )
        return stream_of(gripper, recording.poses(topics[0])), (base, gripper)
    text = options.pose[0]
    samples = _samples(recording, text)
    if text.startswith("tf:"):
        base, gripper = options.base or _letters(samples.parent) or base, options.gripper or _letters(samples.child) or gripper
    elif "=" in text:
        gripper = _name(text, gripper)
    return stream_of(gripper, samples), (base, gripper)


def of_file(table: PoseTable) -> tuple[PoseStream, tuple[str, str]]:
    """Return a file of poses with times as a stream."""
    assert table.t_ns is not None
    return PoseStream(table.child, table.t_ns, table.poses), (table.parent, table.child)


def beside_board(
    robot: tuple[PoseStream, tuple[str, str]],
    board: Seen,
    recording: Recording,
    rig: Rig,
    options: Options,
    inputs: Sequence[tuple[str, str | None]],
    progress: Progress,
    notes: Sequence[str] = (),
) -> Sides:
    """Return the pairs of a robot's stream and the board's poses, in the setup that fits far better or is asked for."""
    stream, (base, gripper) = robot
    stream = inverted(stream) if options.inverse_poses else stream
    seen = stream_of_board(board.poses)
    if not np.any(board.poses.t_ns):
        raise BadInputError(f"{recording.name}: the images have no stamps to find their poses by: give --poses FILE with one pose an image")
    frames = (gripper, board.views.camera, base, "target")
    found: dict[str, Found] = {}
    failed: list[BadInputError] = []
    for setup in [options.setup] if options.setup else ROBOT:
        P = stream if SIGNS[setup][0] > 0 else inverted(stream)
        try:
            found[setup] = _calibrate(P, seen, setup, words(frames, setup), rig, progress)
        except BadInputError as error:
            failed.append(error)
    if not found:
        raise failed[0]
    choice = choose_fit({key: fit for key, (_, fit) in found.items()})
    setup, line = choice.setup, choice.line
    sides = _sides(found[setup], (stream.name, seen.name), frames, ROBOT)
    order = np.argsort(board.poses.t_ns, kind="stable")
    rows = order[np.searchsorted(board.poses.t_ns[order], found[setup][0].t_Q_ns)]
    return replace(
        sides,
        board=only(board, rows),
        lines=(*sides.lines, *([line] if line else []), *notes),
        warnings=(*recording.warnings, *board.views.warnings),
        inputs=tuple(inputs),
        unconfirmed=choice.unconfirmed,
    )


def _calibrate(P: PoseStream, Q: PoseStream, setup: str, frames: tuple[str, str, str, str], rig: Rig, progress: Progress) -> Found:
    """Return pairs and X, by the rig file's time offset where it has one; where the streams do not tell it they are on one clock."""
    known = find_time_offset(rig, P.name, Q.name)
    settings = Settings(one_clock=True)
    if known is not None and known.value is not None:
        settings = Settings(known.value, known.sigma or 0.0)
    return calibrate_streams(P, Q, setup, settings, frames=frames, progress=progress)


def _sides(found: Found, names: tuple[str, str], frames: tuple[str, str, str, str], candidates: tuple[str, ...]) -> Sides:
    pairing, fit = found
    signs = SIGNS[fit.data.setup]
    return Sides(
        pairing.P if signs[0] > 0 else se3.inverse(pairing.P),
        pairing.Q if signs[1] > 0 else se3.inverse(pairing.Q),
        frames,
        candidates,
        pairing.labels,
        pairing.t_P_ns,
        lines=pairing.lines,
        fit=fit,
        offsets=_offsets(pairing, *names),
        reasons=pairing.reasons,
    )


def _offsets(pairing: Pairing, P: str, Q: str) -> dict[str, TimeOffset]:
    """Return the offset of the clocks as the rig has it, where it was estimated."""
    found = pairing.offset
    status = Status(grade(found.sigma / SCALES["s"]))
    if found.known not in ("turns", "poses") or status is Status.NOT_OBSERVABLE:
        return {}
    offset = Estimate(value=found.dt, unit="s", sigma=found.sigma, status=status)
    return {f"dt_{P}_{Q}": make_time_offset(P, Q, offset, verdict=worst(pairing.reasons), reasons=[r.text for r in pairing.reasons])}


def _samples(recording: Recording, text: str) -> PoseSamples:
    """Return the poses of a topic, NAME=/topic or tf:PARENT/CHILD."""
    if text.startswith("tf:"):
        parent, _, child = text.removeprefix("tf:").partition("/")
        return recording.tf(parent, child)
    return recording.poses(recording.choose("pose", text.rpartition("=")[2]))


def _name(text: str, otherwise: str) -> str:
    """Return what a stream is called: NAME of NAME=/topic, the child of tf:PARENT/CHILD."""
    if text.startswith("tf:"):
        return _letters(text.rpartition("/")[2]) or otherwise
    name = text.rpartition("=")[0] if "=" in text else otherwise
    if not re.fullmatch("[A-Za-z][A-Za-z0-9]{0,39}", name):
        raise BadInputError(f"--pose {one_line(text)}: write NAME=/topic with a name of letters and digits")
    return name


def _letters(frame: str) -> str:
    """Return a frame's name as rig files can hold it, or nothing."""
    return re.sub("[^A-Za-z0-9]", "", frame.lstrip("/0123456789_"))[:30]
