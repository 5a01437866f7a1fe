"""`calibkit imu`: from an IMU put down in many attitudes to its scale, axes and biases."""

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

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
    imu: Annotated[str | None, typer.Option("--imu", metavar="TOPIC", help="IMU topic, or imu0=/topic. [default: the only one]")] = None,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", metavar="OUT.yaml", help="Write the rig file, the report's data beside it.")
    ] = None,
    rig: Annotated[list[Path] | None, typer.Option("--rig", metavar="IN.yaml", help="Rig files to add it to; repeatable.")] = None,
    report: Annotated[Path | None, typer.Option("--report", metavar="DIR", help="Write the report (HTML, pictures, JSON) here.")] = None,
    json_file: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write everything as JSON.")] = None,
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
    rate: Annotated[float | None, typer.Option("--rate", metavar="HZ", help="Samples per second of a file without times.")] = None,
    gyro_unit: Annotated[
        str | None, typer.Option("--gyro-unit", help="Unit of a file that does not say it: rad/s, deg/s, counts, ... [default: rad/s]")
    ] = None,
    accel_unit: Annotated[
        str | None, typer.Option("--accel-unit", help="Unit of a file that does not say it: m/s^2, g, counts, ... [default: m/s^2]")
    ] = None,
    ros_distro: Annotated[
        str | None, typer.Option("--ros-distro", help="ROS 2 distribution of bags that do not say it (humble, jazzy, ...).")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite outputs.")] = False,
    strict: Annotated[bool, typer.Option("--strict", help="Exit with 1 on CHECK, too.")] = False,
) -> None:
    """Scale, axes and biases of an IMU that was put down in many attitudes, in one joint estimate with sigmas.

    Exit code 0: PASS or CHECK; 1: FAIL; 2: bad input; 3: the attitudes do not tell everything, and what to add is said; 4: no solution.
    """
    from calibkit.cli.paths import refuse_clashes
    from calibkit.cli.progress import bar
    from calibkit.cli.shown import show
    from calibkit.io.imu_options import ImuOptions
    from calibkit.stages.imu import Options
    from calibkit.stages.imu import imu as stage
    from calibkit.stages.outputs import Outputs

    refuse_clashes([*sources, *([turntable] if turntable else [])], [out, report, json_file])
    refuse_clashes(rig or (), [report, json_file])  # OUT may be a rig: it is then updated
    options = Options(
        imu=imu,
        reading=ImuOptions(rate, gyro_unit, accel_unit),
        gravity=_gravity(gravity, latitude, altitude),
        sensitivity=sensitivity,
        turntable=turntable,
        ros_distro=ros_distro,
    )
    outputs = Outputs(out, report, json_file, tuple(rig or ()), force, command=shlex.join(["calibkit", *sys.argv[1:]]))
    show(stage(sources, outputs, options, bar), strict)


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
