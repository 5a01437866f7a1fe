"""`calibkit allan`: from hours of an IMU at rest to its noise."""

import shlex
import sys
from pathlib import Path
from typing import Annotated

import typer


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("allan")(run)


def run(
    sources: Annotated[list[Path], typer.Argument(metavar="SOURCE...", help="Bags or CSV files (.gz too) of an IMU at rest, for hours.")],
    imu: Annotated[str | None, typer.Option("--imu", metavar="TOPIC", help="IMU topic, or imu0=/topic. [default: the only one]")] = None,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", metavar="OUT.yaml", help="Write the rig file, the report's data beside it.")
    ] = None,
    rig: Annotated[list[Path] | None, typer.Option("--rig", metavar="IN.yaml", help="Rig files to add the noise to; repeatable.")] = None,
    report: Annotated[Path | None, typer.Option("--report", metavar="DIR", help="Write the report (HTML, pictures, JSON) here.")] = None,
    json_file: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write everything as JSON.")] = None,
    table: Annotated[
        Path | None, typer.Option("--table", metavar="FILE.csv", help="Write the deviations with their 95 % intervals.")
    ] = None,
    kind: Annotated[str, typer.Option("--kind", help="Of the table's deviations: overlapping, modified or hadamard.")] = "overlapping",
    exact: Annotated[
        bool, typer.Option("--exact", help="Every overlapping term at long averaging times, too: slower, the same within 1e-3.")
    ] = False,
    no_cut: Annotated[bool, typer.Option("--no-cut", help="Keep what spoils the recording (motion, steps); gaps always part it.")] = False,
    rate: Annotated[float | None, typer.Option("--rate", metavar="HZ", help="Samples per second of a file without times.")] = None,
    gyro_unit: Annotated[
        str | None, typer.Option("--gyro-unit", help="Unit of a file that does not say it: rad/s, deg/s, ... [default: rad/s]")
    ] = None,
    accel_unit: Annotated[
        str | None, typer.Option("--accel-unit", help="Unit of a file that does not say it: m/s^2, g, ... [default: m/s^2]")
    ] = None,
    ros_distro: Annotated[
        str | None, typer.Option("--ros-distro", help="ROS 2 distribution of bags that do not say it (humble, jazzy, ...).")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite outputs.")] = False,
    strict: Annotated[bool, typer.Option("--strict", help="Exit with 1 on CHECK, too.")] = False,
) -> None:
    """Noise of an IMU at rest: N, B, K of each axis by maximum likelihood with sigma, and Kalibr's four densities.

    Exit code 0: PASS or CHECK; 1: FAIL; 2: bad input; 3: the recording is too short for one of N, B, K, and says how long it would take.
    """
    from calibkit.cli.paths import refuse_clashes
    from calibkit.cli.progress import bar
    from calibkit.cli.shown import show
    from calibkit.io.imu_options import ImuOptions
    from calibkit.stages.allan import Options, allan
    from calibkit.stages.outputs import Outputs

    refuse_clashes(sources, [out, report, json_file, table])
    refuse_clashes(rig or (), [report, json_file, table])  # OUT may be a rig: it is then updated
    options = Options(
        imu=imu,
        reading=ImuOptions(rate, gyro_unit, accel_unit),
        kind=kind,
        exact=exact,
        cut=not no_cut,
        table=table,
        ros_distro=ros_distro,
    )
    outputs = Outputs(out, report, json_file, tuple(rig or ()), force, command=shlex.join(["calibkit", *sys.argv[1:]]))
    show(allan(sources, outputs, options, bar), strict)
