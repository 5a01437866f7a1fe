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
    camera: options.CamerasOfRig = None,
    imu: options.Imu = None,
    temperature: options.Temperature = None,
    report: options.Report = None,
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
    """Ask a camera-IMU calibration what it says of a recording.

    The recording is before a board, and the calibration was not made from it. Residuals by the rig file and at best, against the rate
    of turn, each half by itself, gravity and the board's size; and what calibkit diagnose finds. Exit code 0: PASS or CHECK; 1: FAIL;
    2: bad input.
    """
    from calibkit.cli.progress import bar
    from calibkit.cli.shown import tell
    from calibkit.stages.diagnose import Options
    from calibkit.stages.validate import validate

    known = options.tested([*sources, target, *([temperature] if temperature else [])], [rig], json_file, force, report)
    read = options.sensors(
        camera, [imu] if imu else None, (rate, gyro_unit, accel_unit), options.gravity_of(gravity, latitude, altitude), no_cache, ros_distro
    )
    asked = Options(**read, temperature=temperature)
    found = validate(sources, target, known, asked, bar)
    if report is not None:
        from calibkit.stages.validate_report import write_validation

        write_validation(found, report, options.command())
    tell(found, json_file, force, report)
