"""`calibkit joint`: cameras and an IMU on one trajectory."""

from typing import Annotated, Literal

import typer

from calibkit.cli import options


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("joint")(run)


def run(
    sources: options.BoardAndImu,
    target: options.Target,
    camera: options.CamerasOfRig = None,
    imu: options.Imus = None,
    out: options.Out = None,
    rig: options.Rigs = None,
    report: options.Report = None,
    json_file: options.Json = None,
    hold_lens: Annotated[
        bool,
        typer.Option("--hold-lens", help="Keep the lens near the rig file's, by its covariance: where that is from another recording."),
    ] = False,
    imu_model: Annotated[
        Literal["known", "scale-misalignment"],
        typer.Option("--imu-model", help="The IMU's scale and axes: as known (the rig file's, by their covariance, else ideal), or free."),
    ] = "known",
    g_sensitivity: Annotated[bool, typer.Option("--g-sensitivity", help="Free, too: how the gyroscope feels acceleration.")] = False,
    line_delay: Annotated[
        bool, typer.Option("--line-delay", help="Free, too: a rolling shutter's time from row to row; stamps are the middle row's.")
    ] = False,
    knots: Annotated[
        float | None, typer.Option("--knots", metavar="MS", help="Between the trajectory's knots. [default: as the IMU's samples ask for]")
    ] = None,
    gravity: options.LocalGravity = None,
    latitude: options.Latitude = None,
    altitude: options.Altitude = None,
    no_halves: Annotated[bool, typer.Option("--no-halves", help="Do not calibrate each half by itself as a check.")] = False,
    rate: options.Rate = None,
    gyro_unit: options.GyroUnit = None,
    accel_unit: options.AccelUnit = None,
    no_cache: options.NoCache = False,
    ros_distro: options.RosDistro = None,
    force: options.Force = False,
    strict: options.Strict = False,
) -> None:
    """Calibrate cameras and IMUs together, on one trajectory.

    T_cam_imu, the offset of their clocks, the lens, gravity and biases. Starts from a rig file with the lenses (calibkit intrinsics)
    and, where there is one, the IMU's noise (calibkit allan); everything else is found by itself. Move and turn the rig before the
    board for 30 s or more, about all axes. What the motion does not tell is named, and not given as a number. Exit code 0: PASS or
    CHECK; 1: FAIL; 2: bad input; 3: something is not observable in this recording.
    """
    from calibkit.cli.progress import bar
    from calibkit.cli.shown import show
    from calibkit.errors import BadInputError
    from calibkit.stages.joint import Options, joint

    if knots is not None and not 2 <= knots <= 500:
        raise BadInputError(f"--knots {knots:g}: give 2 to 500 ms")
    read = options.sensors(
        camera, imu, (rate, gyro_unit, accel_unit), options.gravity_of(gravity, latitude, altitude), no_cache, ros_distro
    )
    asked = Options(
        **read,
        knots_s=None if knots is None else knots * 1e-3,
        hold_lens=hold_lens,
        imu_model=imu_model,
        g_sensitivity=g_sensitivity,
        line_delay=line_delay,
        halves=not no_halves,
    )
    show(joint(sources, target, options.outputs_of([*sources, target], out, report, json_file, rig, force), asked, bar), strict)
