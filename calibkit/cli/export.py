"""`calibkit export`: a rig file as other tools' calibration files."""

from pathlib import Path
from typing import Annotated

import typer


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("export")(run)


def run(
    rig: Annotated[Path, typer.Argument(help="Rig file.")],
    to: Annotated[str, typer.Option("--to", help="kalibr, openvins, vins, ros or opencv.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder to write into; made where it is missing.")],
    lossy: Annotated[bool, typer.Option("--lossy", help="Accept a camera model that is off by more than 0.1 px.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Overwrite files.")] = False,
) -> None:
    """Write a rig file as another tool's calibration files."""
    from calibkit.errors import one_line
    from calibkit.stages.convert import export_rig

    outcome = export_rig(rig, to, out, lossy, force)
    for note in outcome.notes:
        typer.echo(f"note: {note}", err=True)
    for file in outcome.files:
        typer.echo(f"written: {one_line(file)}")
