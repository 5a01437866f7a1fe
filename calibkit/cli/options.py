"""Options that stages have in common, and the outputs that they name."""

import re
import shlex
import sys
from collections.abc import Iterable
from math import pi
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from calibkit.data.rig import Rig
    from calibkit.models.imu import Gravity
    from calibkit.stages.outputs import Outputs

BoardAndImu = Annotated[
    list[Path], typer.Argument(metavar="SOURCE...", help="Bags, folders or CSV files with images or corners of a board, and an IMU.")
]
Target = Annotated[Path, typer.Option("--target", metavar="T.yaml", help="The board: Kalibr's target file, or calibkit target's.")]
Cameras = Annotated[
    list[str] | None,
    typer.Option("--camera", metavar="TOPIC", help="Camera topic, or cam0=/topic; repeatable. [default: the only one]"),
]
CamerasOfRig = Annotated[
    list[str] | None,
    typer.Option("--camera", metavar="TOPIC", help="Camera topic, or cam0=/topic; repeatable. [default: as the rig file]"),
]
Temperature = Annotated[
    Path | None,
    typer.Option("--temperature", metavar="FILE", help="CSV with t, temperature [C], on the IMU's clock: what goes with it is named."),
]
Imu = Annotated[str | None, typer.Option("--imu", metavar="TOPIC", help="IMU topic, or imu0=/topic. [default: the only one]")]
Imus = Annotated[
    list[str] | None, typer.Option("--imu", metavar="TOPIC", help="IMU topic, or imu0=/topic; repeatable. [default: the only one]")
]
Out = Annotated[Path | None, typer.Option("-o", "--out", metavar="OUT.yaml", help="Write the rig file, the report's data beside it.")]
Rigs = Annotated[list[Path] | None, typer.Option("--rig", metavar="IN.yaml", help="Rig files to add the result to; repeatable.")]
Report = Annotated[Path | None, typer.Option("--report", metavar="DIR", help="Write the report (HTML, pictures, JSON) here.")]
Json = Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write everything as JSON.")]
Rate = Annotated[float | None, typer.Option("--rate", metavar="HZ", help="Samples per second of an IMU's file without times.")]
GyroUnit = Annotated[
    str | None,
    typer.Option("--gyro-unit", help="Unit of an IMU's file that does not say it: rad/s, deg/s, counts, ... [default: rad/s]"),
]
AccelUnit = Annotated[
    str | None,
    typer.Option("--accel-unit", help="Unit of an IMU's file that does not say it: m/s^2, g, counts, ... [default: m/s^2]"),
]
LocalGravity = Annotated[float | None, typer.Option("--gravity", metavar="M/S2", help="|g| where it was recorded. [default: 9.80665]")]
Latitude = Annotated[float | None, typer.Option("--latitude", metavar="DEG", help="Or where it was, for normal gravity.")]
Altitude = Annotated[float | None, typer.Option("--altitude", metavar="M", help="With --latitude: above the sea.")]
Resolution = Annotated[str | None, typer.Option("--resolution", metavar="WxH", help="Image size of a corner file, such as 752x480.")]
NoCache = Annotated[bool, typer.Option("--no-cache", help="Find all corners anew, remember none.")]
RosDistro = Annotated[str | None, typer.Option("--ros-distro", help="ROS 2 distribution of bags that do not say it (humble, jazzy, ...).")]
Force = Annotated[bool, typer.Option("--force", help="Overwrite outputs.")]
Strict = Annotated[bool, typer.Option("--strict", help="Exit with 1 on CHECK, too.")]


def outputs_of(
    inputs: Iterable[Path],
    out: Path | None,
    report: Path | None,
    json_file: Path | None,
    rigs: list[Path] | None,
    force: bool,
    others: Iterable[Path | None] = (),
) -> "Outputs":
    """Return a stage's outputs; BadInputError where one of them, or of `others`, is an input or another output."""
    from calibkit.cli.paths import refuse_clashes
    from calibkit.stages.outputs import Outputs

    refuse_clashes(inputs, [out, report, json_file, *others])
    refuse_clashes(rigs or (), [report, json_file, *others])  # OUT may be a rig: it is then updated
    return Outputs(out, report, json_file, tuple(rigs or ()), force, command=command())


def command() -> str:
    """Return the command line as it was typed."""
    return shlex.join(["calibkit", *sys.argv[1:]])


def sensors(
    camera: list[str] | None,
    imus: list[str] | None,
    reading: tuple[float | None, str | None, str | None],
    gravity: "Gravity",
    no_cache: bool,
    ros_distro: str | None,
) -> dict[str, Any]:
    """Return what the stages on cameras and an IMU have in common; `reading` is --rate, --gyro-unit and --accel-unit."""
    from calibkit.io.imu_options import ImuOptions

    return {
        "cameras": tuple(camera or ()),
        "imus": tuple(imus or ()),
        "reading": ImuOptions(*reading),
        "gravity": gravity,
        "cache": not no_cache,
        "ros_distro": ros_distro,
    }


def tested(
    inputs: Iterable[Path],
    rigs: list[Path],
    json_file: Path | None,
    force: bool,
    report: Path | None,
) -> "Rig":
    """Return the merged rigs that are tested, before long work; BadInputError where an output is an input or exists."""
    from calibkit.cli.paths import refuse_clashes
    from calibkit.io.atomic import refuse_unwritable
    from calibkit.io.rig_file import load_rig, merge_rigs

    refuse_clashes([*inputs, *rigs], [json_file, report])
    if report is not None:
        from calibkit.stages.report import check_out_dir

        check_out_dir(report, force)
    if json_file is not None:
        refuse_unwritable(json_file, force)
    return merge_rigs([(path, load_rig(path)) for path in rigs])


def size_of(text: str | None) -> tuple[int, int] | None:
    """Return width and height of `--resolution WxH`."""
    from calibkit.errors import BadInputError, one_line

    if text is None:
        return None
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(part.isdecimal() and 0 < int(part[:7]) < 100000 for part in parts):
        raise BadInputError(f"--resolution {one_line(text)}: write WIDTHxHEIGHT in px, such as 752x480")
    return int(parts[0]), int(parts[1])


def gravity_of(value: float | None, latitude: float | None, altitude: float | None) -> "Gravity":
    """Return |g| as given, of a place on Earth, or the standard's."""
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


RATES = {"rad/s": 1.0, "deg/s": pi / 180}
LENGTHS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
SPEEDS = {"m/s": 1.0, "cm/s": 0.01, "mm/s": 0.001, "km/h": 1 / 3.6}
_QUANTITY = re.compile(r"\s*(\d+(?:\.\d*)?|\.\d+)(e[+-]?\d{1,2})?\s*([a-z/]+)\s*")
_MOST = 1e6  # of any unit


def quantity(option: str, text: str, units: dict[str, float], positive: bool = False) -> float:
    """Return a number with its unit in SI: "60deg/s", "0.5 m"; BadInputError for another unit, none, or a number out of reach."""
    from calibkit.errors import BadInputError, one_line

    found = _QUANTITY.fullmatch(text[:100])
    number, unit = (found[1] + (found[2] or ""), found[3]) if found else ("", "")
    if unit not in units:
        raise BadInputError(
            f"{option} {one_line(text, 40)}: write a number with its unit, such as 1{next(iter(units))} ({', '.join(units)})"
        )
    value = float(number) * units[unit]
    if value < 0 or (positive and value == 0) or value > _MOST:
        raise BadInputError(f"{option} {one_line(text, 40)}: must be {'above' if positive else 'at least'} 0 and at most {_MOST:.0e}")
    return value
