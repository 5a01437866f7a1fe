"""`calibkit intrinsics`: from a recording of a board to calibrated cameras."""

from pathlib import Path
from typing import Annotated

import typer

from calibkit.cli import options


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("intrinsics")(run)


def run(
    sources: Annotated[
        list[Path], typer.Argument(metavar="SOURCE...", help="Bags, image folders, ASL folders or corner CSV files, on one clock.")
    ],
    target: options.Target,
    camera: options.Cameras = None,
    model: Annotated[
        list[str] | None,
        typer.Option(
            "--model",
            help="auto (by held-out error), pinhole-none (rectified images), pinhole-radtan, pinhole-radtan5, pinhole-radtan8, "
            "pinhole-equi (kb4); once or per camera.",
        ),
    ] = None,
    out: options.Out = None,
    rig: options.Rigs = None,
    report: options.Report = None,
    json_file: options.Json = None,
    resolution: options.Resolution = None,
    loss: Annotated[
        str, typer.Option("--loss", help="robust (outliers are found and given up) or plain (least squares over everything).")
    ] = "robust",
    max_views: Annotated[int, typer.Option("--max-views", min=10, help="Beyond this many, the most telling moments are chosen.")] = 1500,
    no_cache: options.NoCache = False,
    ros_distro: options.RosDistro = None,
    force: options.Force = False,
    strict: options.Strict = False,
) -> None:
    """Calibrate cameras from views of a board.

    Lens, sigma of every number, verdict with reasons; several cameras with the transforms between them. Exit code 0: PASS or CHECK; 1:
    FAIL; 2: bad input; 3: something is not observable in this recording; 4: no solution.
    """
    from calibkit.cli.progress import bar
    from calibkit.cli.shown import show
    from calibkit.errors import BadInputError
    from calibkit.stages.intrinsics import AUTO, Options, intrinsics

    if loss not in ("robust", "plain"):
        raise BadInputError("--loss is robust or plain")
    asked = Options(
        cameras=tuple(camera or ()),
        models=tuple(model or (AUTO,)),
        resolution=options.size_of(resolution),
        robust=loss == "robust",
        max_views=max_views,
        cache=not no_cache,
        ros_distro=ros_distro,
    )
    outputs = options.outputs_of([*sources, target], out, report, json_file, rig, force)
    show(intrinsics(sources, target, outputs, asked, bar), strict)
