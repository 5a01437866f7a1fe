"""`calibkit import`: other tools' calibration files into a rig file."""

from pathlib import Path
from typing import Annotated

import typer


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("import")(run)


def run(
    files: Annotated[list[Path], typer.Argument(help="Kalibr camchain or imu.yaml, ROS camera_info, OpenCV YAML; several are merged.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Rig file to write.")],
    force: Annotated[bool, typer.Option("--force", help="Overwrite the rig file.")] = False,
) -> None:
    """Turn other tools' calibration files into one rig file."""
    import shlex

    from calibkit.cli.paths import refuse_clashes
    from calibkit.errors import one_line
    from calibkit.stages.convert import import_files

    refuse_clashes(files, [out])
    command = shlex.join(["calibkit", "import", *map(str, files), "-o", str(out)])
    outcome = import_files(files, out, force, command)
    for note in outcome.notes:
        typer.echo(f"note: {note}", err=True)
    rig = outcome.rig
    counts = ((rig.cameras, "cameras"), (rig.imus, "IMUs"), (rig.transforms, "transforms"), (rig.time_offsets, "time offsets"))
    typer.echo(f"{', '.join(f'{what} {len(part)}' for part, what in counts if part)} written to {one_line(out)}")
