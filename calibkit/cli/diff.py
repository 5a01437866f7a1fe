"""`calibkit diff`: what changed between two calibrations of one rig."""

from pathlib import Path
from typing import Annotated

import typer

from calibkit.cli import options


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("diff")(run)


def run(
    old: Annotated[Path, typer.Argument(metavar="OLD.yaml", help="A rig file.")],
    new: Annotated[Path, typer.Argument(metavar="NEW.yaml", help="A later one of the same rig, from another recording.")],
    report: Annotated[Path | None, typer.Option("--report", metavar="DIR", help="Draw the pixel shift of each lens here.")] = None,
    json_file: options.Json = None,
    force: options.Force = False,
) -> None:
    """Compare two calibrations: what changed beyond chance.

    Each change with its sigma, the pixel shift over image and range, and which change is real. Exit code 1 when an entry changed by
    more than chance explains.
    """
    from calibkit.cli.paths import refuse_clashes
    from calibkit.errors import one_line
    from calibkit.stages import diff as stage
    from calibkit.stages.diff_text import text

    refuse_clashes([old, new], [report, json_file])
    outcome = stage.compare(old, new, report, json_file, force)
    typer.echo(text(outcome.difference, outcome.shifts))
    for path in outcome.files:
        typer.echo(f"written: {one_line(path)}")
    if outcome.difference.changed:
        raise typer.Exit(1)
