"""`calibkit observability`: can this motion tell the calibration?"""

from pathlib import Path
from typing import Annotated

import typer

from calibkit.cli import options


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("observability")(run)


def run(
    sources: options.BoardAndImu,
    target: options.Target,
    rig: Annotated[list[Path], typer.Option("--rig", metavar="RIG.yaml", help="Rig files with the lenses; repeatable, merged.")],
    camera: Annotated[
        list[str] | None,
        typer.Option("--camera", metavar="TOPIC", help="Camera topic, or cam0=/topic; repeatable. [default: as the rig file]"),
    ] = None,
    imu: options.Imu = None,
    json_file: options.Json = None,
    gravity: options.LocalGravity = None,
    latitude: options.Latitude = None,
    altitude: options.Altitude = None,
    rate: options.Rate = None,
    gyro_unit: options.GyroUnit = None,
    accel_unit: options.AccelUnit = None,
    no_cache: options.NoCache = False,
    ros_distro: options.RosDistro = None,
    force: options.Force = False,
) -> None:
    """Say what a recording of cameras and an IMU before a board can determine.

    The sigma that each number would have, what stays open, and which simple motion to add, the most useful first. For between two takes: no
    calibration is written. Exit code 0: all is observable; 2: bad input; 3: something is not.
    """
    from calibkit.cli.paths import refuse_clashes
    from calibkit.cli.progress import bar
    from calibkit.errors import one_line
    from calibkit.io.atomic import refuse_unwritable, write_json
    from calibkit.io.imu_options import ImuOptions
    from calibkit.io.rig_file import load_rig, merge_rigs
    from calibkit.stages.camera_imu import Sensors
    from calibkit.stages.observability import observability

    refuse_clashes([*sources, target, *rig], [json_file])
    if json_file is not None:
        refuse_unwritable(json_file, force)
    asked = Sensors(
        cameras=tuple(camera or ()),
        imu=imu,
        reading=ImuOptions(rate, gyro_unit, accel_unit),
        gravity=options.gravity_of(gravity, latitude, altitude),
        cache=not no_cache,
        ros_distro=ros_distro,
    )
    found = observability(sources, target, merge_rigs([(path, load_rig(path)) for path in rig]), asked, bar)
    for warning in found.warnings:
        typer.echo(f"warning: {one_line(warning)}", err=True)
    typer.echo(found.text)
    if json_file is not None:
        write_json(json_file, found.as_json(), force)
        typer.echo(f"written: {one_line(json_file)}")
    raise typer.Exit(found.exit_code)
