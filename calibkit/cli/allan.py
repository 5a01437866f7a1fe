"""`calibkit allan`: from hours of an IMU at rest to its noise."""

from pathlib import Path
from typing import Annotated

import typer

from calibkit.cli import options


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("allan")(run)


def run(
    sources: Annotated[list[Path], typer.Argument(metavar="SOURCE...", help="Bags or CSV files (.gz too) of an IMU at rest, for hours.")],
    imu: options.Imu = None,
    out: options.Out = None,
    rig: options.Rigs = None,
    report: options.Report = None,
    json_file: options.Json = None,
    table: Annotated[
        Path | None, typer.Option("--table", metavar="FILE.csv", help="Write the deviations with their 95 % intervals.")
    ] = None,
    kind: Annotated[str, typer.Option("--kind", help="Of the table's deviations: overlapping, modified or hadamard.")] = "overlapping",
    exact: Annotated[
        bool, typer.Option("--exact", help="Every overlapping term at long averaging times, too: slower, the same within 1e-3.")
    ] = False,
    no_cut: Annotated[bool, typer.Option("--no-cut", help="Keep what spoils the recording (motion, steps); gaps always part it.")] = False,
    rate: options.Rate = None,
    gyro_unit: options.GyroUnit = None,
    accel_unit: options.AccelUnit = None,
    ros_distro: options.RosDistro = None,
    force: options.Force = False,
    strict: options.Strict = False,
) -> None:
    """Find the noise of an IMU that lay at rest.

    N, B, K of each axis by maximum likelihood with sigma, and Kalibr's four densities. Exit code 0: PASS or CHECK; 1: FAIL; 2: bad
    input; 3: the recording is too short for one of N, B, K, and says how long it would take.
    """
    from calibkit.cli.progress import bar
    from calibkit.cli.shown import show
    from calibkit.io.imu_options import ImuOptions
    from calibkit.stages.allan import Options, allan

    asked = Options(
        imu=imu,
        reading=ImuOptions(rate, gyro_unit, accel_unit),
        kind=kind,
        exact=exact,
        cut=not no_cut,
        table=table,
        ros_distro=ros_distro,
    )
    outputs = options.outputs_of(sources, out, report, json_file, rig, force, [table])
    show(allan(sources, outputs, asked, bar), strict)
