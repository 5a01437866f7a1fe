"""`calibkit simulate`: recordings of simulated rigs, with their truth."""

from pathlib import Path
from typing import Annotated

import typer


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("simulate")(run)


def run(
    scenario: Annotated[str | None, typer.Argument(help="Name of a scenario, see --list.", show_default=False)] = None,
    out: Annotated[Path | None, typer.Option("-o", "--out", metavar="DIR", help="Folder for the bag, target.yaml and truth.yaml.")] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Another seed, another motion and noise.")] = 0,
    storage: Annotated[str, typer.Option("--format", help="ros1, mcap or db3.")] = "ros1",
    duration: Annotated[float | None, typer.Option("--duration", metavar="S", help="Length in seconds instead of the scenario's.")] = None,
    fault: Annotated[list[str] | None, typer.Option("--fault", metavar="NAME", help="Spoil the recording; repeatable, see --list.")] = None,
    show: Annotated[bool, typer.Option("--list", help="List scenarios and faults.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Overwrite an earlier recording in DIR.")] = False,
) -> None:
    """Write a simulated rig's recording as a bag, with its truth.

    Beside the bag, its target.yaml, and the truth as a rig file.
    """
    from calibkit.cli.progress import bar
    from calibkit.errors import BadInputError, one_line
    from calibkit.simulation.faults import FAULTS
    from calibkit.simulation.scenarios import SCENARIOS
    from calibkit.stages.simulate import simulate

    if show:
        width = max(map(len, [*SCENARIOS, *FAULTS]))
        typer.echo("scenarios:")
        for name, entry in SCENARIOS.items():
            typer.echo(f"  {name:{width}}  {entry.summary} ({entry.duration_s:g} s)")
        typer.echo("faults:")
        for name, (summary, _) in FAULTS.items():
            typer.echo(f"  {name:{width}}  {summary}")
        return
    if scenario is None or out is None:
        raise BadInputError("simulate needs a scenario and a folder: calibkit simulate SCENARIO -o DIR (calibkit simulate --list)")
    done = simulate(scenario, out, seed, storage, duration, fault or (), force, bar)
    typer.echo(f"images: {', '.join(f'{len(t.t_true_ns)} of {t.camera.topic}' for t in done.session.tracks)}")
    for file in (done.bag, done.target, done.truth):
        typer.echo(f"written: {one_line(file)}")
