"""How a stage ends on the terminal: warnings, the numbers, the verdict, the files; then the exit code."""

from pathlib import Path
from typing import TYPE_CHECKING, NoReturn, Protocol

import typer

if TYPE_CHECKING:
    from calibkit.stages.outputs import Saved


def show(saved: "Saved", strict: bool) -> None:
    """Print a stage's outcome and leave with its exit code."""
    from calibkit.data.verdict import Verdict
    from calibkit.errors import one_line
    from calibkit.report.summary_text import text

    warnings = saved.result.facts.get("warnings")
    for warning in warnings if isinstance(warnings, list) else []:
        typer.echo(f"warning: {one_line(warning)}", err=True)
    typer.echo(text(saved.summary))
    for path in saved.files:
        typer.echo(f"written: {one_line(path)}")
    code = saved.result.exit_code
    if strict and code == 0 and saved.summary.verdict is Verdict.CHECK:
        code = 1
    raise typer.Exit(code)


class Told(Protocol):
    """What a command found that writes no rig file."""

    @property
    def text(self) -> str: ...

    @property
    def warnings(self) -> tuple[str, ...]: ...

    @property
    def exit_code(self) -> int: ...

    def as_json(self) -> dict[str, object]: ...


def tell(found: Told, json_file: Path | None, force: bool, report: Path | None = None) -> NoReturn:
    """Print what was found and which report was written, write it as JSON where that is asked for, and leave with its exit code."""
    from calibkit.errors import one_line
    from calibkit.io.atomic import write_json

    for warning in found.warnings:
        typer.echo(f"warning: {one_line(warning)}", err=True)
    typer.echo(found.text)
    if json_file is not None:
        write_json(json_file, found.as_json(), force)
        typer.echo(f"written: {one_line(json_file)}")
    if report is not None:
        typer.echo(f"written: {one_line(report / 'report.html')}")
    raise typer.Exit(found.exit_code)
