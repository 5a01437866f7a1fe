"""`calibkit calibrate`: from a recording to a calibrated rig in one go."""

from pathlib import Path
from typing import Annotated

import typer

from calibkit.cli import options


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("calibrate")(run)


def run(
    sources: options.BoardAndImu,
    target: options.Target,
    out: Annotated[Path, typer.Option("-o", "--out", metavar="OUT.yaml", help="Write the rig file, the report's data beside it.")],
    camera: options.Cameras = None,
    imu: options.Imus = None,
    model: Annotated[
        list[str] | None, typer.Option("--model", help="Lens model, as for intrinsics; once or per camera. [default: by held-out error]")
    ] = None,
    rig: options.Rigs = None,
    report: options.Report = None,
    json_file: options.Json = None,
    resolution: options.Resolution = None,
    gravity: options.LocalGravity = None,
    latitude: options.Latitude = None,
    altitude: options.Altitude = None,
    rate: options.Rate = None,
    gyro_unit: options.GyroUnit = None,
    accel_unit: options.AccelUnit = None,
    ros_distro: options.RosDistro = None,
    force: options.Force = False,
    strict: options.Strict = False,
) -> None:
    """Calibrate all that a recording allows, in one go.

    The lens (intrinsics) and, with an IMU, clocks (timeoffset) and the whole rig (joint). One rig file, updated by each stage, and one
    report at the end. Where --rig has a lens already, it is refined, not found anew; add the IMU's noise (calibkit allan) by --rig,
    too. What earlier stages found is kept where a later one fails. Exit code 0: PASS or CHECK; 1: FAIL; 2: bad input; 3: something is
    not observable in this recording; 4: no solution.
    """
    from calibkit.cli.progress import bar
    from calibkit.data.verdict import Verdict
    from calibkit.errors import one_line
    from calibkit.io.imu_options import ImuOptions
    from calibkit.report.summary_text import text
    from calibkit.stages.calibrate import Options, calibrate
    from calibkit.stages.intrinsics import AUTO

    asked = Options(
        cameras=tuple(camera or ()),
        models=tuple(model or (AUTO,)),
        imus=tuple(imu or ()),
        reading=ImuOptions(rate, gyro_unit, accel_unit),
        gravity=options.gravity_of(gravity, latitude, altitude),
        resolution=options.size_of(resolution),
        ros_distro=ros_distro,
    )
    outputs = options.outputs_of([*sources, target], out, report, json_file, rig, force)
    found = calibrate(sources, target, outputs, asked, bar)
    for note in found.notes:
        typer.echo(f"warning: {one_line(note)}", err=True)
    typer.echo(text(found.summary))
    for path in found.files:
        typer.echo(f"written: {one_line(path)}")
    if found.failed is not None:
        stage, error = found.failed
        typer.echo(f"calibkit: {stage}: {one_line(error, 1000)}; {one_line(out)} holds what the stages before it found", err=True)
    code = found.exit_code
    raise typer.Exit(1 if strict and code == 0 and found.summary.verdict is Verdict.CHECK else code)
