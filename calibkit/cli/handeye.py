"""`calibkit handeye`: the transform between a robot and its camera, or between two sensors that move together."""

from pathlib import Path
from typing import Annotated

import typer

from calibkit.cli import options


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("handeye")(run)


def run(
    sources: Annotated[
        list[Path] | None,
        typer.Argument(metavar="SOURCE...", help="Images or bags with the board, or two streams of poses (bags, TUM, CSV)."),
    ] = None,
    poses: Annotated[Path | None, typer.Option("--poses", metavar="FILE", help="The robot's poses, one for each image.")] = None,
    pose_format: Annotated[
        str | None,
        typer.Option(
            "--pose-format", metavar="F", help="ros, tum, matrix, matrix-columns, rpy, kuka-abc, fanuc-wpr, ur-rotvec, abb-quat (wxyz)."
        ),
    ] = None,
    pose_unit: Annotated[str | None, typer.Option("--pose-unit", metavar="U", help="Unit of lengths in the file: m, cm or mm.")] = None,
    angle_unit: Annotated[str | None, typer.Option("--angle-unit", metavar="U", help="Unit of angles in the file: rad or deg.")] = None,
    pairs: Annotated[
        list[Path] | None, typer.Option("--pairs", metavar="FILE", help="Ready-made pairs: two poses a row, or two files of as many.")
    ] = None,
    motions: Annotated[bool, typer.Option("--motions", help="The pairs are motions A, B (A X = X B), no poses.")] = False,
    pose: Annotated[
        list[str] | None,
        typer.Option("--pose", metavar="TOPIC", help="Poses or odometry: topic, NAME=/topic or tf:PARENT/CHILD; repeatable."),
    ] = None,
    camera: Annotated[list[str] | None, typer.Option("--camera", metavar="TOPIC", help="Image topic, or cam0=/topic.")] = None,
    target: Annotated[Path | None, typer.Option("--target", metavar="T.yaml", help="The board that the camera sees.")] = None,
    setup: Annotated[
        str | None,
        typer.Option("--setup", help="eye-in-hand, eye-to-hand or motion. [default: what fits far better]"),
    ] = None,
    out: options.Out = None,
    rig: options.Rigs = None,
    report: options.Report = None,
    json_file: options.Json = None,
    base: Annotated[str | None, typer.Option("--base", metavar="NAME", help="What to call the poses' parent. [default: base]")] = None,
    gripper: Annotated[
        str | None, typer.Option("--gripper", metavar="NAME", help="What to call the frame that the poses name. [default: gripper]")
    ] = None,
    inverse_poses: Annotated[
        bool, typer.Option("--inverse-poses", help="The robot's (or the first) poses are the other way round: T_gripper_base.")
    ] = False,
    inverse_second: Annotated[bool, typer.Option("--inverse-second", help="The second side's poses are the other way round.")] = False,
    method: Annotated[
        str, typer.Option("--method", help="refined, or write the X of tsai, park, horaud, andreff, daniilidis, shah or li.")
    ] = "refined",
    robot_noise: Annotated[
        str,
        typer.Option(
            "--robot-noise",
            metavar="MM,DEG",
            help="Sigmas of the robot's poses, per coordinate, where you know them (0.1,0.02; more if the residuals have more); "
            "auto: told by the residuals; exact: none, "
            "the reprojection error alone decides, which a robot that is not pays for with an X that is wrong by much more than its sigma.",
        ),
    ] = "auto",
    free_intrinsics: Annotated[
        bool, typer.Option("--free-intrinsics", help="Estimate the lens together with X, and write it over the rig's; images only.")
    ] = False,
    predict: Annotated[int, typer.Option("--predict", metavar="N", help="Tell the sigma that N more good poses would bring.")] = 0,
    model: Annotated[str, typer.Option("--model", help="Of a lens that no rig file has, and is calibrated on the way.")] = "auto",
    resolution: options.Resolution = None,
    no_cache: options.NoCache = False,
    ros_distro: options.RosDistro = None,
    force: options.Force = False,
    strict: options.Strict = False,
) -> None:
    """Hand-eye, A X = X B: camera and robot, or two sensors.

    They move together; X with its covariance, every method, and what is wrong. Images with --target and --poses (a lens that no --rig
    file has is calibrated from them, too), or two streams of poses, or --pairs. Exit code 0: PASS or CHECK; 1: FAIL; 2: bad input; 3:
    the poses do not tell all of X; 4: no solution.
    """
    from calibkit.cli.progress import bar
    from calibkit.cli.shown import show
    from calibkit.stages.handeye import hand_eye
    from calibkit.stages.handeye_sides import Options

    asked = Options(
        poses=poses,
        pose_format=pose_format,
        pose_unit=pose_unit,
        angle_unit=angle_unit,
        pairs=tuple(pairs or ()),
        motions=motions,
        pose=tuple(pose or ()),
        cameras=tuple(camera or ()),
        target=target,
        model=model,
        resolution=options.size_of(resolution),
        base=base,
        gripper=gripper,
        inverse_poses=inverse_poses,
        inverse_second=inverse_second,
        setup=setup,
        predict=predict,
        method=method,
        robot_noise=robot_noise,
        free_intrinsics=free_intrinsics,
        cache=not no_cache,
        ros_distro=ros_distro,
    )
    inputs = [*(sources or ()), *asked.pose_files, *([target] if target else [])]
    outputs = options.outputs_of(inputs, out, report, json_file, rig, force)
    show(hand_eye(sources or (), outputs, asked, bar), strict)
