"""`calibkit validate`: a calibration on a recording that it was not made from."""

from pathlib import Path
from typing import Annotated

import typer

from calibkit.cli import options


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("validate")(run)


def run(
    rig: Annotated[Path, typer.Argument(metavar="RIG.yaml", help="The calibration to test.")],
    sources: options.BoardAndImu,
    target: options.Target,
    camera: Annotated[
        list[str] | None,
        typer.Option("--camera", metavar="TOPIC", help="Camera topic, or cam0=/topic; repeatable. [default: as the rig file]"),
    ] = None,
    imu: options.Imu = None,
    temperature: Annotated[
        Path | None,
        typer.Option("--temperature", metavar="FILE", help="CSV with t, temperature [C], on the IMU's clock: what goes with it is named."),
    ] = None,
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
    """Ask a camera-IMU calibration for what it says of a recording before a board that it was not made from.

    Residuals by the rig file and at best, against the rate of turn, each half by itself, gravity and the board's size; and what calibkit
    diagnose finds. Exit code 0: PASS or CHECK; 1: FAIL; 2: bad input.
    """
    from calibkit.cli.progress import bar
    from calibkit.cli.shown import tell
    from calibkit.io.imu_options import ImuOptions
    from calibkit.stages.diagnose import Options
    from calibkit.stages.validate import validate

    known = options.tested([*sources, target, *([temperature] if temperature else [])], [rig], json_file, force)
    asked = Options(
        cameras=tuple(camera or ()),
        imu=imu,
        reading=ImuOptions(rate, gyro_unit, accel_unit),
        gravity=options.gravity_of(gravity, latitude, altitude),
        cache=not no_cache,
        ros_distro=ros_distro,
        temperature=temperature,
    )
    tell(validate(sources, target, known, asked, bar), json_file, force)
