"""The report of any result: from the stage that just made it, or later from the rig file and its residual files, without the recording."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from calibkit.data.result import Result
from calibkit.data.rig import Rig, StageRun
from calibkit.errors import BadInputError, one_line
from calibkit.io.atomic import refuse_existing, refuse_unwritable, write_atomic, write_json
from calibkit.io.residual_file import entry_hashes, load_result
from calibkit.io.rig_file import load_rig
from calibkit.report.summary import Summary, as_json, summarise

FILES = ("report.html", "report.json")


def report(rig_path: Path, out_dir: Path | None = None, json_path: Path | None = None, force: bool = False) -> Summary:
    """Judge a rig file by its own verdicts and its residual files, and write the report where one is asked for.

    BadInputError, with nothing written, for a missing or changed file and for outputs that exist already.
    """
    if out_dir is not None:
        check_out_dir(out_dir, force)
    if json_path is not None:
        refuse_unwritable(json_path, force)
    rig = load_rig(rig_path)
    results, earlier = _current([load_result(rig_path, rig, run) for run in _latest_runs(rig)], rig_path)
    summary = summarise(rig, results, earlier)
    if out_dir is not None:
        _write_pages(summary, out_dir)
    if json_path is not None:
        write_json(json_path, as_json(summary), force)
    return summary


def write_report(result: Result, out_dir: Path, force: bool = False) -> Summary:
    """Write the report of one stage's result: for every stage's `--report DIR`."""
    check_out_dir(out_dir, force)
    summary = summarise(result.rig, [result])
    _write_pages(summary, out_dir)
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


def _write_pages(summary: Summary, out_dir: Path) -> None:
    from calibkit.report.page import build  # matplotlib and jinja2: not needed where only the verdict is asked for

    files: Mapping[str, bytes] = build(summary)
    try:
        out_dir.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadInputError(f"{one_line(out_dir)}: cannot be made ({one_line(error.strerror or error)}); choose another folder") from None
    for name, content in files.items():
        write_atomic(out_dir / name, content, overwrite=True)
