"""`calibkit imu`: from an IMU put down in many attitudes to its scale, axes and biases."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calibkit.cli import options

if TYPE_CHECKING:
    from calibkit.models.imu import Gravity


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
    gravity: Annotated[
        float | None, typer.Option("--gravity", metavar="M/S2", help="|g| where it was recorded. [default: 9.80665]")
    ] = None,
    latitude: Annotated[float | None, typer.Option("--latitude", metavar="DEG", help="Or where it was, for normal gravity.")] = None,
    altitude: Annotated[float | None, typer.Option("--altitude", metavar="M", help="With --latitude: above the sea.")] = None,
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
    """Scale, axes and biases of an IMU that was put down in many attitudes, in one joint estimate with sigmas.

    Exit code 0: PASS or CHECK; 1: FAIL; 2: bad input; 3: the attitudes do not tell everything, and what to add is said; 4: no solution.
    """
    from calibkit.cli.progress import bar
    from calibkit.cli.shown import show
    from calibkit.io.imu_options import ImuOptions
    from calibkit.stages.imu import Options
    from calibkit.stages.imu import imu as stage

    asked = Options(
        imu=imu,
        reading=ImuOptions(rate, gyro_unit, accel_unit),
        gravity=_gravity(gravity, latitude, altitude),
        sensitivity=sensitivity,
        turntable=turntable,
        ros_distro=ros_distro,
    )
    outputs = options.outputs_of([*sources, *([turntable] if turntable else [])], out, report, json_file, rig, force)
    show(stage(sources, outputs, asked, bar), strict)


def _gravity(value: float | None, latitude: float | None, altitude: float | None) -> "Gravity":
    from calibkit.errors import BadInputError
    from calibkit.models.imu import STANDARD_GRAVITY, Gravity, gravity_at

    if value is not None:
        if latitude is not None or altitude is not None:
            raise BadInputError("--gravity and --latitude say the same: give one of them")
        if not 0.1 <= value <= 100:
            raise BadInputError(f"--gravity {value:g} is no gravity: on Earth it is 9.78 to 9.83 m/s^2")
        return Gravity(value, 0.0, "given")
    if latitude is None:
        if altitude is not None:
            raise BadInputError("--altitude needs --latitude")
        return STANDARD_GRAVITY
    if not (abs(latitude) <= 90 and abs(altitude or 0) <= 10000):
        raise BadInputError("--latitude is from -90 to 90 deg, --altitude at most 10000 m")
    return gravity_at(latitude, altitude)
