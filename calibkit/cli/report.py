"""`calibkit report`: the verdict on a rig file, and its report as pages."""

from pathlib import Path
from typing import Annotated

import typer


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command(name="report")(report)


def report(
    rig: Annotated[Path, typer.Argument(metavar="RIG.yaml", help="The rig file; its residual files lie beside it.")],
    out: Annotated[
        Path | None, typer.Option("-o", "--report", metavar="DIR", help="Write report.html, its pictures and report.json here.")
    ] = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Write the verdict, parameters and signals as JSON.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite an earlier report.")] = False,
    strict: Annotated[bool, typer.Option("--strict", help="Exit with 1 on CHECK, too.")] = False,
) -> None:
    """Judge a rig file: verdict with reasons, every parameter with its sigma, the signals in its residuals.

    Exit code 1 on FAIL, which includes parameters that are not observable; 2 when a file is missing or was changed.
    """
    from calibkit.cli.paths import refuse_clashes
    from calibkit.data.verdict import Verdict
    from calibkit.errors import one_line
    from calibkit.report.summary import text
    from calibkit.stages import report as stage

    refuse_clashes([rig], [out, json_file])
    summary = stage.report(rig, out, json_file, force)
    typer.echo(text(summary))
    if out is not None:
        typer.echo(f"report: {one_line(out / stage.FILES[0])}")
    if json_file is not None:
        typer.echo(f"json: {one_line(json_file)}")
    if summary.verdict is Verdict.FAIL or (strict and summary.verdict is Verdict.CHECK):
        raise typer.Exit(1)
