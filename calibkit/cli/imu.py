"""`calibkit imu`: from an IMU put down in many attitudes to its scale, axes and biases."""

from pathlib import Path
from typing import Annotated

import typer

from calibkit.cli import options


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("imu")(run)


def run(
    sources: Annotated[
        list[Path],
        typer.Argument(
            metavar="SOURCE...",
            help="Bags or CSV files: 10 s at rest, then 12 or more attitudes, still for 3 s each. Files acc... and gyr... make one IMU.",
        ),
    ],
    imu: options.Imu = None,
    out: options.Out = None,
    rig: options.Rigs = None,
    report: options.Report = None,
    json_file: options.Json = None,
    gravity: options.LocalGravity = None,
    latitude: options.Latitude = None,
    altitude: options.Altitude = None,
    turntable: Annotated[
        Path | None,
        typer.Option("--turntable", metavar="RATES.csv", help="Known rates on the IMU's clock: columns t, rate [deg/s], run, nx, ny, nz."),
    ] = None,
    sensitivity: Annotated[
        bool, typer.Option("--g-sensitivity", help="Estimate the gyroscope's sensitivity to acceleration, too.")
    ] = False,
    rate: options.Rate = None,
    gyro_unit: options.GyroUnit = None,
    accel_unit: options.AccelUnit = None,
    ros_distro: options.RosDistro = None,
    force: options.Force = False,
    strict: options.Strict = False,
) -> None:
    """Find scale, axes and biases of an IMU from its attitudes.

    It was put down in many, a few seconds each; all is one joint estimate with sigmas. Exit code 0: PASS or CHECK; 1: FAIL; 2: bad
    input; 3: the attitudes do not tell everything, and what to add is said; 4: no solution.
    """
    from calibkit.cli.progress import bar
    from calibkit.cli.shown import show
    from calibkit.io.imu_options import ImuOptions
    from calibkit.stages.imu import Options
    from calibkit.stages.imu import imu as stage

    asked = Options(
        imu=imu,
        reading=ImuOptions(rate, gyro_unit, accel_unit),
        gravity=options.gravity_of(gravity, latitude, altitude),
        sensitivity=sensitivity,
        turntable=turntable,
        ros_distro=ros_distro,
    )
    outputs = options.outputs_of([*sources, *([turntable] if turntable else [])], out, report, json_file, rig, force)
    show(stage(sources, outputs, asked, bar), strict)
