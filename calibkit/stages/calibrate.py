"""`calibkit calibrate`: every stage that a recording allows, in order, on one rig file, and the report over all of them."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

from calibkit.data.progress import Progress, silent
from calibkit.data.rig import Rig
from calibkit.data.verdict import Verdict
from calibkit.errors import CalibkitError
from calibkit.io.imu_options import ImuOptions
from calibkit.io.recording import Recording, open_recording
from calibkit.models.imu import STANDARD_GRAVITY, Gravity
from calibkit.report.summary import Summary
from calibkit.stages.camera_imu import name_imus
from calibkit.stages.intrinsics import AUTO, intrinsics, name_cameras
from calibkit.stages.intrinsics import Options as LensOptions
from calibkit.stages.joint import Options as JointOptions
from calibkit.stages.joint import joint
from calibkit.stages.outputs import Outputs, Saved
from calibkit.stages.report import FILES, Files, report
from calibkit.stages.time_offset import Options as OffsetOptions
from calibkit.stages.time_offset import time_offset

T = TypeVar("T")
_DEFAULT = ImuOptions()


@dataclass(frozen=True)
class Options:
    """Which sensors, and how to calibrate them."""

    cameras: tuple[str, ...] = ()  # topics, or NAME=/topic
    models: tuple[str, ...] = (AUTO,)  # one for all cameras, or one each
    imus: tuple[str, ...] = ()  # topics, or NAME=/topic
    reading: ImuOptions = _DEFAULT
    gravity: Gravity = STANDARD_GRAVITY
    resolution: tuple[int, int] | None = None  # of corner files, which do not say it
    ros_distro: str | None = None


@dataclass(frozen=True)
class Calibrated:
    """What all stages leave to be shown."""

    summary: Summary
    files: tuple[Path, ...]
    notes: tuple[str, ...]  # what was not run, and why; warnings
    failed: tuple[str, CalibkitError] | None = None  # the stage that ended the run: what those before it found is kept

    @property
    def exit_code(self) -> int:
        """SPEC section 6: what ended the run, 3 something is not observable, 1 FAIL, 0 otherwise."""
        if self.failed is not None:
            return self.failed[1].exit_code
        if any(result.not_observable for result in self.summary.results):
            return 3
        return 1 if self.summary.verdict is Verdict.FAIL else 0


@dataclass(frozen=True)
class Step:
    """One stage, ready to be run."""

    stage: str
    run: Callable[[Outputs, Progress], Saved]


def calibrate(
    sources: Sequence[Path], target: Path, outputs: Outputs, options: Options | None = None, progress: Progress = silent
) -> Calibrated:
    """Calibrate everything that a recording of cameras before a board, with or without an IMU, allows.

    BadInputError and NotConvergedError of the first stage, with nothing written; those of later ones end the run.
    """
    options = options or Options()
    base = outputs.open()
    assert outputs.out is not None
    recording = open_recording(list(sources), options.ros_distro, options.reading)
    steps, notes = _plan(sources, target, recording, base, options)
    done: list[Saved] = []
    failed = None
    for step in steps:
        try:
            done.append(step.run(_next(outputs, done), _named(progress, step.stage)))
        except CalibkitError as error:
            if not done:
                raise
            failed = step.stage, error
            break
        if unknown := _unknown_lens(done[-1].result.rig):
            notes += [f"{later.stage} was not run: {unknown} is not observable" for later in steps[len(done) :]]
            break
    summary = report(outputs.out, Files(outputs.report, outputs.json, force=outputs.force))
    files = [*dict.fromkeys(file for saved in done for file in saved.files)]
    files += [file for file in (outputs.json, outputs.report and outputs.report / FILES[0]) if file is not None]
    return Calibrated(summary, tuple(files), tuple(dict.fromkeys([*notes, *_warnings(done)])), failed)


def _plan(sources: Sequence[Path], target: Path, recording: Recording, base: Rig, options: Options) -> tuple[list[Step], list[str]]:
    """Return the stages that the recording allows, and why others are left out."""
    topics = name_cameras(recording, options.cameras)
    cameras = tuple(f"{name}={topic}" for name, topic in topics.items())
    steps, notes = [], []
    if all(name in base.cameras for name in topics):
        notes.append(f"intrinsics was not run: the rig file has {'the lens' if len(topics) == 1 else 'the lenses'} already")
    else:
        lens = LensOptions(cameras, options.models, options.resolution, ros_distro=options.ros_distro)
        steps.append(Step("intrinsics", lambda out, progress: intrinsics(sources, target, out, lens, progress)))
    if not options.imus and not any(topic.kind == "imu" for topic in recording.topics):
        notes.append("timeoffset and joint were not run: the recording has no IMU")
        return steps, notes
    imus = name_imus(recording, base, options.imus)
    name, imu = next(iter(imus.items()))
    for camera, topic in topics.items():
        pair = OffsetOptions(camera, name, (f"{camera}={topic}", f"{name}={imu}"), target, options.reading, ros_distro=options.ros_distro)
        steps.append(Step("timeoffset", partial(_offset, sources, pair)))
    both = JointOptions(
        cameras, tuple(f"{name}={imu}" for name, imu in imus.items()), options.reading, options.gravity, ros_distro=options.ros_distro
    )
    steps.append(Step("joint", lambda out, progress: joint(sources, target, out, both, progress)))
    return steps, notes


def _offset(sources: Sequence[Path], pair: OffsetOptions, outputs: Outputs, progress: Progress) -> Saved:
    return time_offset(sources, outputs, pair, progress)


def _next(outputs: Outputs, done: list[Saved]) -> Outputs:
    """Return where the next stage reads and writes: the one rig file, once the first has written it."""
    rigs = (outputs.out,) if done and outputs.out is not None else outputs.rigs
    return Outputs(outputs.out, rigs=rigs, force=outputs.force, command=outputs.command)


def _named(progress: Progress, stage: str) -> Progress:
    def shown(items: Iterable[T], what: str, total: int | None = None) -> Iterator[T]:
        return progress(items, f"{stage}: {what}", total)

    return shown


def _unknown_lens(rig: Rig) -> str:
    """Name the parameters of lenses that are not known: later stages could only guess."""
    return ", ".join(
        f"{name} {key}" for name, camera in rig.cameras.items() for key, value in camera.parameters.items() if value.value is None
    )


def _warnings(done: list[Saved]) -> list[str]:
    found = [saved.result.facts.get("warnings") for saved in done]
    return [str(text) for texts in found if isinstance(texts, list) for text in texts]
