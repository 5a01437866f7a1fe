"""The report of any result: from the stage that just made it, or later from the rig file and its residual files, without the recording."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from calibkit.data.result import Result
from calibkit.data.rig import Rig, StageRun
from calibkit.errors import BadInputError, one_line
from calibkit.io.atomic import reason_of, refuse_existing, refuse_unwritable, write_atomic, write_json
from calibkit.io.residual_file import entry_hashes, load_result
from calibkit.io.rig_file import load_rig
from calibkit.report.junit import junit
from calibkit.report.markdown import markdown
from calibkit.report.summary import NOTHING, Demands, Summary, as_json, summarise

if TYPE_CHECKING:
    from calibkit.report.figures import Chapter

FILES = ("report.html", "report.json", "report.md")


@dataclass(frozen=True)
class Files:
    """Where a report goes; what is None is not written."""

    folder: Path | None = None  # report.html, report.md, report.json, pictures
    json: Path | None = None
    markdown: Path | None = None
    junit: Path | None = None
    pictures: tuple[str, ...] = ("png",)  # their formats, in the folder
    force: bool = False

    def check(self) -> None:
        """Raise BadInputError where one of them cannot be written."""
        if self.folder is not None:
            check_out_dir(self.folder, self.force)
        for path in (self.json, self.markdown, self.junit):
            if path is not None:
                refuse_unwritable(path, self.force)


NONE = Files()


def report(rig_path: Path, files: Files = NONE, demands: Demands = NOTHING, strict: bool = False) -> Summary:
    """Judge a rig file by its own verdicts, its residual files and what is asked for, and write the report where one is wanted.

    BadInputError, with nothing written, for a missing or changed file, for outputs that exist already and for a limit on nothing.
    """
    files.check()
    rig = load_rig(rig_path)
    results, earlier = _current([load_result(rig_path, rig, run) for run in _latest_runs(rig)], rig_path)
    summary = summarise(rig, results, earlier, demands)
    if files.folder is not None:
        write_pages(summary, files.folder, files.pictures)
    if files.markdown is not None:
        write_atomic(files.markdown, markdown(summary), files.force)
    if files.junit is not None:
        write_atomic(files.junit, junit(summary, strict), files.force)
    if files.json is not None:
        write_json(files.json, as_json(summary), files.force)
    return summary


def check_out_dir(out_dir: Path, force: bool = False) -> None:
    """Raise BadInputError where a report cannot be written into `out_dir`: to be asked before long work, too."""
    if out_dir.exists() and not out_dir.is_dir():
        raise BadInputError(f"{one_line(out_dir)}: is a file; give the name of a folder for the report")
    for name in FILES:
        refuse_existing(out_dir / name, force)


def _latest_runs(rig: Rig) -> list[StageRun]:
    """Return the runs whose residual files the rig still stands for: a later run of the same stage has replaced the earlier one's file."""
    return list({run.residual_file: run for run in rig.provenance if run.residual_file is not None}.values())


def _current(results: list[Result], rig_path: Path) -> tuple[list[Result], list[Result]]:
    """Return what the results, oldest first, say of entries that no later one has made anew, and the residuals of those that one has.

    BadInputError for an entry that was changed since it was made.
    """
    owner = {key: result for result in results for key in result.made}
    if not results:
        return [], []
    found = entry_hashes(results[0].rig)
    for key, result in owner.items():
        if key in found and found[key] != result.made[key]:
            stage = one_line(result.stage, 40)
            raise BadInputError(
                f"{rig_path.name}: {one_line(key, 80)} was changed since {stage} made it: "
                f"its residuals no longer belong to it; run {stage} again"
            )
    gone = [{key.split(".", 1)[-1] for key, made in result.made.items() if owner[key].made[key] != made} for result in results]
    pairs = list(zip(results, gone, strict=True))
    earlier = [replace(result, residuals=tuple(set_ for set_ in result.residuals if set_.sensor in parts)) for result, parts in pairs]
    return [_without(result, parts) for result, parts in pairs], earlier


def _without(result: Result, parts: set[str]) -> Result:
    """Return the result without what it says of these parts of the rig."""
    return replace(
        result,
        residuals=tuple(residuals for residuals in result.residuals if residuals.sensor not in parts),
        reasons=tuple(reason for reason in result.reasons if reason.text.split(":")[0] not in parts),
        not_observable=tuple(name for name in result.not_observable if name.split(".")[0] not in parts),
    )


def write_pages(summary: Summary, out_dir: Path, formats: Sequence[str] = Files.pictures, chapters: Sequence["Chapter"] = ()) -> None:
    """Write the report's files; pictures beside those of the residuals come from `chapters`."""
    from calibkit.report.page import build  # matplotlib and jinja2: not needed where only the verdict is asked for

    for name, content in build(summary, formats, chapters).items():
        path = out_dir / name
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise BadInputError(f"{one_line(path.parent)}: cannot be made ({reason_of(error)}); choose another folder") from None
        write_atomic(path, content, overwrite=True)
