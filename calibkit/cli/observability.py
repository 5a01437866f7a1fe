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
    camera: options.CamerasOfRig = None,
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
    """Say what a recording of cameras and an IMU can determine.

    The sigma that each number would have, what stays open, and which simple motion to add, the most useful first. For between two takes: no
    calibration is written. Exit code 0: all is observable; 2: bad input; 3: something is not.
    """
    from calibkit.cli.progress import bar
    from calibkit.cli.shown import tell
    from calibkit.stages.camera_imu import Sensors
    from calibkit.stages.observability import observability

    known = options.tested([*sources, target], rig, json_file, force, None)
    read = options.sensors(
        camera, [imu] if imu else None, (rate, gyro_unit, accel_unit), options.gravity_of(gravity, latitude, altitude), no_cache, ros_distro
    )
    asked = Sensors(**read)
    tell(observability(sources, target, known, asked, bar), json_file, force)
