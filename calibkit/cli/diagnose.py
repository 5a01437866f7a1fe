"""`calibkit diagnose`: is a calibration still right, and what is wrong with it."""

from pathlib import Path
from typing import Annotated

import typer

from calibkit.cli import options


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("diagnose")(run)


def run(
    sources: options.BoardAndImu,
    target: options.Target,
    rig: Annotated[list[Path], typer.Option("--rig", metavar="RIG.yaml", help="The calibration to test; repeatable, merged.")],
    camera: options.CamerasOfRig = None,
    imu: options.Imu = None,
    no_imu: Annotated[bool, typer.Option("--no-imu", help="Test lenses and places of cameras alone, though there is an IMU.")] = False,
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
    """Test a calibration on a new recording; say what is wrong.

    Is it still right before a board, and if not, what is wrong and by how much? The recording asks for a calibration of its own; the
    fewest causes that explain its difference to the rig file's, both uncertainties paid for, are named with size and sigma: clock,
    mount, lens, board, IMU, and what drifts; without an IMU lenses, the places of cameras beside each other, and the board. By chance
    alone one is named in 1 of 100 recordings. Exit code 0: it fits; 1: a cause is found; 2: bad input.
    """
    from calibkit.cli.progress import bar
    from calibkit.cli.shown import tell
    from calibkit.errors import BadInputError
    from calibkit.stages.camera_imu import has_imu
    from calibkit.stages.diagnose import Options, examine
    from calibkit.stages.diagnose_cameras import diagnose_cameras

    known = options.tested([*sources, target, *([temperature] if temperature else [])], rig, json_file, force, report)
    read = options.sensors(
        camera, [imu] if imu else None, (rate, gyro_unit, accel_unit), options.gravity_of(gravity, latitude, altitude), no_cache, ros_distro
    )
    asked = Options(**read, temperature=temperature)
    alone = no_imu or not has_imu(sources, asked)
    if alone and (temperature or imu):
        raise BadInputError(
            f"{'--temperature' if temperature else '--imu'} is for cameras with an IMU: leave it out, or give the IMU's recording"
        )
    if alone:
        cameras = diagnose_cameras(sources, target, known, asked, bar)
        if report is not None:
            from calibkit.stages.diagnose_report import write_cameras

            write_cameras(cameras, report, options.command())
        diagnosed = cameras.diagnosed
    else:
        found = examine(sources, target, known, asked, bar)
        if report is not None:
            from calibkit.stages.diagnose_report import write_diagnosis

            write_diagnosis(found, report, options.command())
        diagnosed = found.diagnosed
    tell(diagnosed, json_file, force, report)
