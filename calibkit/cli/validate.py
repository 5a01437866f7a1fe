"""`calibkit validate`: a calibration on a recording that it was not made from."""

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calibkit.cli import options

if TYPE_CHECKING:
    from calibkit.stages.validate import Measured


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
    distance: Annotated[
        list[str] | None,
        typer.Option(
            "--distance", metavar="A:B=SIZE", help="Measured between two sensors, cam0:cam1=110mm+-1mm; repeatable. Without +-: 1 mm."
        ),
    ] = None,
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
    of turn, each half by itself, gravity, the board's size and measured distances; and what calibkit diagnose finds. Exit code 0: PASS
    or CHECK; 1: FAIL; 2: bad input.
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
    found = validate(sources, target, known, asked, bar, [_measured(each) for each in distance or ()])
    if report is not None:
        from calibkit.stages.validate_report import write_validation

        write_validation(found, report, options.command())
    tell(found, json_file, force, report)


def _measured(text: str) -> "Measured":
    from calibkit.errors import BadInputError, one_line
    from calibkit.stages.validate import Measured

    found = re.fullmatch(r"(\w+):(\w+)=([^+]+?)(?:\+-(.+))?", text)
    if found is None:
        raise BadInputError(f"--distance {one_line(text)}: write two sensors and their distance, cam0:cam1=110mm or cam0:cam1=110mm+-1mm")
    a, b, size, sigma = found.groups(default="1mm")
    return Measured(a, b, *(options.quantity("--distance", each, options.LENGTHS, positive=True) for each in (size, sigma)))
