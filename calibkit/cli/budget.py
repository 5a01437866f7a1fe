"""`calibkit budget`: what a rig's uncertainties cost whoever uses it."""

from pathlib import Path
from typing import Annotated

import typer

from calibkit.cli import options


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("budget")(run)


def run(
    rig: Annotated[Path, typer.Argument(metavar="RIG.yaml", help="The rig file.")],
    rate: Annotated[str, typer.Option("--rate", metavar="RATE", help="How fast the rig turns, in rad/s or deg/s.")] = "1rad/s",
    distance: Annotated[str, typer.Option("--range", metavar="RANGE", help="How far what it sees is, in m, cm or mm.")] = "10m",
    speed: Annotated[str, typer.Option("--speed", metavar="SPEED", help="How fast it moves, in m/s, cm/s, mm/s or km/h.")] = "1m/s",
    json_file: options.Json = None,
    force: options.Force = False,
) -> None:
    """Say what today's uncertainties cost in pixels and metres.

    Pixels, metres at range, phantom velocity, the largest first and what would lessen it. Exit code 1 when something has no bound
    because it is not observable.
    """
    from calibkit.cli.paths import refuse_clashes
    from calibkit.errors import one_line
    from calibkit.estimation.error_budget import Use
    from calibkit.stages import budget as stage

    refuse_clashes([rig], [json_file])
    use = Use(
        rate=options.quantity("--rate", rate, options.RATES),
        range_m=options.quantity("--range", distance, options.LENGTHS, positive=True),
        speed=options.quantity("--speed", speed, options.SPEEDS),
    )
    costs = stage.cost_of(rig, use, json_file, force)
    typer.echo(stage.text(costs, use))
    if json_file is not None:
        typer.echo(f"json: {one_line(json_file)}")
    if stage.unbounded(costs):
        raise typer.Exit(1)
