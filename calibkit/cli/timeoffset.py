"""`calibkit timeoffset`: how far two sensors' clocks are apart."""

from pathlib import Path
from typing import Annotated

import typer

from calibkit.cli import options


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("timeoffset")(run)


def run(
    sources: Annotated[
        list[Path], typer.Argument(metavar="SOURCE...", help="Bags, folders or CSV files with both sensors, turning, for 30 s or more.")
    ],
    of: Annotated[
        str | None,
        typer.Option("--of", metavar="SENSOR", help="Name or topic of the sensor whose stamps td is added to. [default: the other one]"),
    ] = None,
    to: Annotated[
        str | None,
        typer.Option("--to", metavar="SENSOR", help="Name or topic of the sensor whose clock counts. [default: the IMU, else the faster]"),
    ] = None,
    camera: Annotated[list[str] | None, typer.Option("--camera", metavar="TOPIC", help="Camera topic, or cam0=/topic; repeatable.")] = None,
    imu: Annotated[list[str] | None, typer.Option("--imu", metavar="TOPIC", help="IMU topic, or imu0=/topic; repeatable.")] = None,
    pose: Annotated[
        list[str] | None,
        typer.Option("--pose", metavar="TOPIC", help="Poses, odometry or rates: topic, pose0=/topic or tf:PARENT/CHILD; repeatable."),
    ] = None,
    target: Annotated[
        Path | None, typer.Option("--target", metavar="T.yaml", help="The board that the camera sees. [default: features of the scene]")
    ] = None,
    out: options.Out = None,
    rig: options.Rigs = None,
    report: options.Report = None,
    json_file: options.Json = None,
    plain: Annotated[
        bool, typer.Option("--plain", help="Without a board: rotation alone moves features (f * gyro). Wrong by ms where things are near.")
    ] = False,
    inverse_poses: Annotated[
        bool, typer.Option("--inverse-poses", help="Poses are those of the world seen from the sensor (T_sensor_world).")
    ] = False,
    fix_rotation: Annotated[
        bool, typer.Option("--fix-rotation", help="Take the rotation between the sensors from the rig file. [default: found anew]")
    ] = False,
    reach: Annotated[
        float, typer.Option("--reach", metavar="MS", help="Offsets tried to either side of the rough one; more where that is too little.")
    ] = 50.0,
    step: Annotated[
        float, typer.Option("--step", metavar="MS", help="Between the offsets that are tried; td itself is finer than that.")
    ] = 0.5,
    bootstrap: Annotated[
        int, typer.Option("--bootstrap", metavar="N", help="Check sigma: draw the recording's stretches of 5 s anew N times, say 1000.")
    ] = 0,
    gyro_bandwidth: Annotated[
        float | None,
        typer.Option(
            "--gyro-bandwidth", metavar="HZ", help="-3 dB of the gyroscope's low-pass: says what of td is its delay, and leaves td."
        ),
    ] = None,
    exposure: Annotated[
        float | None, typer.Option("--exposure", metavar="MS", help="Of a camera whose stamps are the exposure's start: likewise.")
    ] = None,
    readout: Annotated[
        float | None,
        typer.Option("--readout", metavar="MS", help="First row to last, of a camera whose stamps are the first row's: likewise."),
    ] = None,
    rate: options.Rate = None,
    gyro_unit: options.GyroUnit = None,
    accel_unit: options.AccelUnit = None,
    no_cache: options.NoCache = False,
    ros_distro: options.RosDistro = None,
    force: options.Force = False,
    strict: options.Strict = False,
) -> None:
    """Find how far the clocks of two sensors are apart.

    Both are on one rigid body: t_to = t_of + td; add td to the stamps of the first, --of. Pairs: camera and IMU (by a board with
    --target, else by features of the scene; the lens comes from --rig), poses or odometry and IMU, two pose streams, two IMUs, wheel
    odometry and IMU. Two that are alone are found by themselves. Turn the rig back and forth about two or more axes, once or twice a
    second: at rest, or at a constant rate of turn, nothing tells td. Drifts and jumps of a clock are told. Exit code 0: PASS or CHECK;
    1: FAIL; 2: bad input; 3: the recording does not tell td.
    """
    from calibkit.cli.progress import bar
    from calibkit.cli.shown import show
    from calibkit.errors import BadInputError
    from calibkit.estimation.time_offset_delay import Delays
    from calibkit.io.imu_options import ImuOptions
    from calibkit.stages.time_offset import Options, time_offset

    for name, value, low, high in (("--reach", reach, 5, 800), ("--step", step, 0.05, 5)):
        if not low <= value <= high:
            raise BadInputError(f"{name} {value:g}: give {low} to {high} ms")
    for name, given in (("--gyro-bandwidth", gyro_bandwidth), ("--exposure", exposure), ("--readout", readout)):
        if given is not None and not 0 < given < 1e5:
            raise BadInputError(f"{name} {given:g}: give a number above 0")
    if not 0 <= bootstrap <= 10_000:
        raise BadInputError(f"--bootstrap {bootstrap}: give 0 to 10000")
    asked = Options(
        of=of,
        to=to,
        sensors=(*(camera or ()), *(imu or ()), *(pose or ())),
        target=target,
        reading=ImuOptions(rate, gyro_unit, accel_unit),
        plain=plain,
        inverse_poses=inverse_poses,
        fix_rotation=fix_rotation,
        reach_s=reach * 1e-3,
        step_s=step * 1e-3,
        bootstrap=bootstrap,
        delays=Delays(gyro_bandwidth, None if exposure is None else exposure * 1e-3, None if readout is None else readout * 1e-3),
        cache=not no_cache,
        ros_distro=ros_distro,
    )
    outputs = options.outputs_of([*sources, *([target] if target else [])], out, report, json_file, rig, force)
    show(time_offset(sources, outputs, asked, bar), strict)
