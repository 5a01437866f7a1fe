"""What every stage does with its result: outputs checked before the work, then residuals, rig file, report and JSON, in that order."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from calibkit.data.observations import Lost
from calibkit.data.plural import counted
from calibkit.data.result import Result
from calibkit.data.rig import Imu, InputFile, Rig, StageRun
from calibkit.data.verdict import Reason, Verdict, worst
from calibkit.errors import one_line
from calibkit.io.atomic import refuse_unwritable, write_json
from calibkit.io.residual_file import entry_hashes, save_residuals
from calibkit.io.rig_file import load_rig, merge_rigs, save_rig, updated
from calibkit.report.signals import not_good
from calibkit.report.summary import Look, Summary, as_json, look_at, summarise
from calibkit.stages.report import FILES, check_out_dir, write_pages
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


def with_signals(result: Result, look: Look) -> Result:
    """Return the result with the signals of its residuals that are not good among its reasons, the cameras' own included."""
    rig, reasons = result.rig, list(result.reasons)
    for sensor in dict.fromkeys(view.sensor for view in look.views):
        found = not_good(signal for signal in look.signals if signal.sensor == sensor)
        reasons += found
        camera = rig.cameras.get(sensor)
        if camera is not None and found:
            order = [*found, *([] if camera.verdict is None else [replace(found[0], verdict=camera.verdict)])]
            texts = [*camera.reasons, *(reason.text for reason in found)]
            updated_camera = camera.model_copy(update={"verdict": worst(order), "reasons": texts})
            rig = rig.model_copy(update={"cameras": {**rig.cameras, sensor: updated_camera}})
    return replace(result, rig=rig, reasons=tuple(dict.fromkeys(reasons)))


def with_losses(result: Result, base: Rig) -> Result:
    """Return the result with what its recording has lost among its reasons, and those of all that it made: what is left may look well."""
    warnings = result.facts.get("warnings")
    lost = [text for text in warnings if isinstance(text, Lost)] if isinstance(warnings, list) else []
    if not lost:
        return result
    more = f" (and {counted(len(lost) - 1, 'warning')} more)" if len(lost) > 1 else ""
    reason = Reason(Verdict.CHECK, f"{lost[0]}{more}: only what is left was calibrated from; record again if that is too little")
    rig = result.rig
    parts = {
        section: {name: _doubted(entry, getattr(base, section).get(name), reason) for name, entry in getattr(rig, section).items()}
        for section in ("cameras", "transforms", "time_offsets")
    }
    imus = {name: _doubted_imu(imu, base.imus.get(name) or Imu(), reason) for name, imu in rig.imus.items()}
    return replace(result, rig=rig.model_copy(update={**parts, "imus": imus}), reasons=(*result.reasons, reason))


def _doubted(entry: Any, old: Any, reason: Reason) -> Any:
    """Return the entry with the reason, where a stage has judged it and not taken it over as it was."""
    if entry is None or entry.verdict is None or entry == old:
        return entry
    verdict = worst((reason, Reason(entry.verdict, "")))
    return entry.model_copy(update={"verdict": verdict, "reasons": [*entry.reasons, one_line(reason.text, 1000)]})


def _doubted_imu(imu: Imu, old: Imu, reason: Reason) -> Imu:
    """Return the IMU: its noise and its intrinsics come from different stages."""
    noise, noise_was = (each.model_copy(update={"intrinsics": None}) for each in (imu, old))
    doubted: Imu = _doubted(noise, noise_was, reason)
    return doubted.model_copy(update={"intrinsics": _doubted(imu.intrinsics, old.intrinsics, reason)})


def _made(rig: Rig, base: Rig) -> list[str]:
    before = entry_hashes(base)
    return [key for key, digest in entry_hashes(rig).items() if before.get(key) != digest]


def save(
    result: Result,
    base: Rig,
    outputs: Outputs,
    inputs: Sequence[tuple[str, str | None]],
    options: dict[str, str | float | int | bool | None],
) -> Saved:
    """Write everything that was asked for; the rig file last but for the report, so that it never names what is not there."""
    look = look_at([result])
    result = with_losses(with_signals(result, look), base)
    files: list[Path] = []
    run = StageRun(
        stage=result.stage,
        command=one_line(outputs.command, 2000),
        calibkit=__version__,
        inputs=[InputFile(name=one_line(name), sha256=digest) for name, digest in inputs],
        options=options,
        made=_made(result.rig, base),
    )
    if outputs.out is not None:
        name, digest = save_residuals(result, outputs.out)
        run = run.model_copy(update={"residual_file": name, "residual_sha256": digest})
        files.append(outputs.out.parent / name)
    result = replace(result, rig=result.rig.model_copy(update={"provenance": [run]}))
    summary = summarise(result.rig, [result], look=look)
    if outputs.out is not None:
        save_rig(updated(base, result.rig), outputs.out, force=True)  # `open` has refused what may not be replaced
        files.append(outputs.out)
    if outputs.json is not None:
        write_json(outputs.json, as_json(summary), outputs.force)
        files.append(outputs.json)
    if outputs.report is not None:
        check_out_dir(outputs.report, outputs.force)
        write_pages(summary, outputs.report)
        files.append(outputs.report / FILES[0])
    return Saved(result, summary, tuple(files))
