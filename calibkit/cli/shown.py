"""How a stage ends on the terminal: warnings, the numbers, the verdict, the files; then the exit code."""

from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from calibkit.stages.outputs import Saved


def show(saved: "Saved", strict: bool) -> None:
    """Print a stage's outcome and leave with its exit code."""
    from calibkit.data.verdict import Verdict
    from calibkit.errors import one_line
    from calibkit.report.summary import text

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
