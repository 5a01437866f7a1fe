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
    """Test a camera-IMU calibration against a new recording before a board: is it still right, and if not, what is wrong and by how much.

    The recording asks for a calibration of its own; the fewest causes that explain its difference to the rig file's, both uncertainties
    paid for, are named with size and sigma: clock, mount, lens, board, IMU, and what drifts. By chance alone one is named in 1 of 100
    recordings. Exit code 0: it fits; 1: a cause is found; 2: bad input.
    """
    from calibkit.cli.progress import bar
    from calibkit.cli.shown import tell
    from calibkit.io.imu_options import ImuOptions
    from calibkit.stages.diagnose import Options, run_diagnosis

    known = options.tested([*sources, target, *([temperature] if temperature else [])], rig, json_file, force)
    asked = Options(
        cameras=tuple(camera or ()),
        imu=imu,
        reading=ImuOptions(rate, gyro_unit, accel_unit),
        gravity=options.gravity_of(gravity, latitude, altitude),
        cache=not no_cache,
        ros_distro=ros_distro,
        temperature=temperature,
    )
    tell(run_diagnosis(sources, target, known, asked, bar), json_file, force)
