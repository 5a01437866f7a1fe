"""What every stage does with its result: outputs checked before the work, then residuals, rig file, report and JSON, in that order."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from calibkit.data.result import Result
from calibkit.data.rig import InputFile, Rig, StageRun
from calibkit.data.verdict import worst
from calibkit.errors import one_line
from calibkit.io.atomic import refuse_unwritable, write_json
from calibkit.io.residual_file import save_residuals
from calibkit.io.rig_file import load_rig, merge_rigs, save_rig, updated
from calibkit.report.signals import measure, not_good
from calibkit.report.summary import Summary, as_json, summarise
from calibkit.report.view import views
from calibkit.stages.report import FILES, check_out_dir, write_report
from calibkit.version import __version__


@dataclass(frozen=True)
class Outputs:
    """Where a stage's outcome goes, and the rig files that it builds on."""

    out: Path | None = None
    report: Path | None = None
    json: Path | None = None
    rigs: tuple[Path, ...] = ()
    force: bool = False
    command: str = ""

    def open(self) -> Rig:
        """Return the merged rigs; BadInputError where an output is in the way, before any work is done."""
        own = self.out is not None and any(self.out.exists() and rig.exists() and self.out.samefile(rig) for rig in self.rigs)
        if self.out is not None:
            refuse_unwritable(self.out, self.force or own)
        if self.json is not None:
            refuse_unwritable(self.json, self.force)
        if self.report is not None:
            check_out_dir(self.report, self.force)
        return merge_rigs([(path, load_rig(path)) for path in self.rigs])


@dataclass(frozen=True)
class Saved:
    """What a stage leaves to be shown."""

    result: Result
    summary: Summary
    files: tuple[Path, ...]


def with_signals(result: Result) -> Result:
    """Return the result with the signals of its residuals that are not good among its reasons, the cameras' own included."""
    rig, reasons = result.rig, list(result.reasons)
    for view in views(result):
        found = not_good(measure(view))
        reasons += found
        camera = rig.cameras.get(view.sensor)
        if camera is not None and found:
            order = [*found, *([] if camera.verdict is None else [replace(found[0], verdict=camera.verdict)])]
            texts = [*camera.reasons, *(reason.text for reason in found)]
            updated_camera = camera.model_copy(update={"verdict": worst(order), "reasons": texts})
            rig = rig.model_copy(update={"cameras": {**rig.cameras, view.sensor: updated_camera}})
    return replace(result, rig=rig, reasons=tuple(dict.fromkeys(reasons)))


def save(
    result: Result,
    base: Rig,
    outputs: Outputs,
    inputs: Sequence[tuple[str, str | None]],
    options: dict[str, str | float | int | bool | None],
) -> Saved:
    """Write everything that was asked for; the rig file last but for the report, so that it never names what is not there."""
    result = with_signals(result)
    files: list[Path] = []
    run = StageRun(
        stage=result.stage,
        command=one_line(outputs.command, 2000),
        calibkit=__version__,
        inputs=[InputFile(name=one_line(name), sha256=digest) for name, digest in inputs],
        options=options,
    )
    if outputs.out is not None:
        name, digest = save_residuals(result, outputs.out)
        run = run.model_copy(update={"residual_file": name, "residual_sha256": digest})
        files.append(outputs.out.parent / name)
    result = replace(result, rig=result.rig.model_copy(update={"provenance": [run]}))
    summary = summarise(result.rig, [result])
    if outputs.out is not None:
        save_rig(updated(base, result.rig), outputs.out, force=True)  # `open` has refused what may not be replaced
        files.append(outputs.out)
    if outputs.json is not None:
        write_json(outputs.json, as_json(summary), outputs.force)
        files.append(outputs.json)
    if outputs.report is not None:
        write_report(result, outputs.report, outputs.force)
        files.append(outputs.report / FILES[0])
    return Saved(result, summary, tuple(files))
