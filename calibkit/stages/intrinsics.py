"""`calibkit intrinsics`: images or corners of a board to calibrated cameras."""

from collections import Counter
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path

import numpy as np

from calibkit.data.observations import BoardViews
from calibkit.data.plural import counted
from calibkit.data.progress import Progress, silent
from calibkit.data.result import Result, Thumbnail
from calibkit.detection.cache import CornerCache
from calibkit.detection.find import find_boards
from calibkit.detection.thumbnails import draw_corners
from calibkit.errors import BadInputError, one_line
from calibkit.estimation.intrinsics import CameraRequest, calibrate_cameras
from calibkit.io.recording import Recording, open_recording
from calibkit.io.target_file import load_target
from calibkit.models.board import Board
from calibkit.models.cameras import ALIASES, CAMERAS
from calibkit.stages.outputs import Outputs, Saved, save

AUTO = "auto"
_WORST_FRAMES = 10


@dataclass(frozen=True)
class Options:
    """How to calibrate."""

    cameras: tuple[str, ...] = ()  # topics, or NAME=/topic
    models: tuple[str, ...] = (AUTO,)  # one for all cameras, or one each
    resolution: tuple[int, int] | None = None  # of corner files, which do not say it
    robust: bool = True
    max_views: int = 1500
    cache: bool = True
    ros_distro: str | None = None


def intrinsics(
    sources: Sequence[Path], target: Path, outputs: Outputs | None = None, options: Options | None = None, progress: Progress = silent
) -> Saved:
    """Calibrate the cameras of a recording from its views of a board.

    BadInputError names the file, topic or option that is wrong; NotConvergedError the camera without a solution.
    """
    outputs, options = outputs or Outputs(), options or Options()
    base = outputs.open()
    board = load_target(target)
    recording = open_recording(list(sources), options.ros_distro)
    topics = name_cameras(recording, options.cameras)
    models = _models(options.models, len(topics))
    if options.resolution and not any(t.kind == "corners" and t.name in topics.values() for t in recording.topics):
        raise BadInputError("--resolution is for corner files, which do not say it; images do: leave it out")
    views = observe(recording, topics, board, options, progress)
    requests = [CameraRequest(v, model, topics[v.camera]) for v, model in zip(views, models, strict=True)]
    result = calibrate_cameras(requests, options.robust, options.max_views, progress)
    warnings = [*recording.warnings, *(w for v in views for w in v.warnings)]
    held_out = {name: camera.reprojection.held_out_rms_px for name, camera in result.rig.cameras.items() if camera.reprojection}
    result = replace(result, facts={**result.facts, "warnings": warnings, "held_out_px": held_out})
    if outputs.out is not None or outputs.report is not None:
        result = replace(result, thumbnails=tuple(_worst_frames(result, recording, topics, progress)))
    told: dict[str, str | float | int | bool | None] = {
        "target": board.key(),
        "model": " ".join(options.models),
        "robust": options.robust,
        "max_views": options.max_views,
    }
    return save(result, base, outputs, [*recording.inputs(), *_hashed(target)], told)


def name_cameras(recording: Recording, asked: Sequence[str]) -> dict[str, str]:
    """Return topic by camera name: cam0, cam1, ... in the order asked for, or as NAME=/topic says; the only one where none is."""
    if not asked:
        kinds = [kind for kind in ("image", "corners") if any(topic.kind == kind for topic in recording.topics)]
        return {"cam0": recording.choose(kinds[0] if kinds else "image")}
    named: dict[str, str] = {}
    for i, text in enumerate(asked):
        name, _, topic = text.rpartition("=") if "=" in text else (f"cam{i}", "", text)
        if name in named or not name.isalnum() or not name[0].isalpha():
            raise BadInputError(f"--camera {one_line(text)}: {one_line(name)} is not a new name of letters and digits; write cam0=/topic")
        kind = "corners" if any(t.name == topic and t.kind == "corners" for t in recording.topics) else "image"
        chosen = recording.choose(kind, topic)
        if chosen in named.values():
            raise BadInputError(f"--camera {one_line(text)}: topic {one_line(chosen)} is given twice; name each camera's own topic")
        named[name] = chosen
    return named


def _models(asked: Sequence[str], cameras: int) -> list[str | None]:
    """Return the model of each camera, None for one to be chosen."""
    if len(asked) not in (1, cameras):
        raise BadInputError(f"--model is given {len(asked)} times for {counted(cameras, 'camera')}: give it once for all, or once for each")
    models: list[str | None] = []
    for name in asked:
        known = ALIASES.get(name, name)
        if known != AUTO and known not in CAMERAS:
            raise BadInputError(f"--model {one_line(name)} is not known: choose {AUTO}, {', '.join([*CAMERAS, *ALIASES])}")
        models.append(None if known == AUTO else known)
    return models * cameras if len(models) == 1 else models


def observe(recording: Recording, topics: dict[str, str], board: Board, options: Options, progress: Progress) -> list[BoardViews]:
    """Return the board's corners in each camera, found in its images or read from its corner file."""
    with CornerCache() if options.cache else nullcontext() as cache:
        return [_observe_one(recording, name, topic, board, options, cache, progress) for name, topic in topics.items()]


def _observe_one(
    recording: Recording, name: str, topic: str, board: Board, options: Options, cache: CornerCache | None, progress: Progress
) -> BoardViews:
    info = next(t for t in recording.topics if t.name == topic)
    if info.kind == "corners":
        if options.resolution is None:
            raise BadInputError(f"{one_line(topic)}: a corner file does not say the image size; add --resolution WIDTHxHEIGHT")
        views = replace(recording.board_views(board, options.resolution, topic), camera=name)
    else:
        views = find_boards(recording.images(topic), board, name, cache, progress, info.count)
    if not views.n_frames:
        looked = counted(views.n_images, "image") if info.kind == "image" else "its corner file"
        rows, columns = board.shape
        raise BadInputError(
            f"{one_line(topic)}: no {board.kind} {columns} x {rows} found in {looked}: "
            "check the target file against the board, and --camera"
        )
    return views


def _worst_frames(result: Result, recording: Recording, topics: dict[str, str], progress: Progress) -> list[Thumbnail]:
    """Draw the frames with the largest rms over all their corners, worst first, at most ten over all cameras."""
    labels = result.facts["frame_labels"]
    assert isinstance(labels, dict)
    ranked: list[tuple[float, str, int]] = []
    sets = {residuals.sensor: residuals for residuals in result.residuals}
    for name, residuals in sets.items():
        frame = residuals.context["frame"].astype(np.int64)
        worst = np.where(np.isfinite(residuals.raw).all(axis=1), np.sum(residuals.raw**2, axis=1), 1e4)
        counts = np.maximum(np.bincount(frame), 1)
        ranked += [(float(ms), name, i) for i, ms in enumerate(np.bincount(frame, worst) / counts)]
    ranked = sorted(ranked, reverse=True)[:_WORST_FRAMES]
    drawn: dict[tuple[str, int], Thumbnail] = {}
    for name, topic in topics.items():
        once: Counter[str] = Counter(labels[name])  # under a stamp that repeats, which image it was cannot be told
        wanted = {labels[name][i]: i for _, camera, i in ranked if camera == name and once[labels[name][i]] == 1}
        if not wanted or not any(t.name == topic and t.kind == "image" for t in recording.topics):
            continue
        residuals = sets[name]
        for image in progress(recording.images(topic), f"worst frames of {name}"):
            if image.label not in wanted:
                continue
            i = wanted.pop(image.label)
            rows = residuals.context["frame"] == i
            uv, raw = residuals.context["uv"][rows].astype(float), residuals.raw[rows]
            rms = next(ms for ms, camera, frame in ranked if (camera, frame) == (name, i)) ** 0.5
            caption = f"{name} {image.label}: rms {rms:.2f} px"
            kept = residuals.context["kept"][rows].astype(bool)
            drawn[name, i] = Thumbnail(f"{name} {image.label}", draw_corners(image.decode(), uv, uv - raw, kept, caption))
            if not wanted:
                break
    return [drawn[name, i] for _, name, i in ranked if (name, i) in drawn]


def _hashed(path: Path) -> list[tuple[str, str | None]]:
    return [(path.name, sha256(path.read_bytes()).hexdigest())]
