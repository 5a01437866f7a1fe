"""`calibkit info`: what a recording holds and what is wrong with it."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calibkit.cli import options

if TYPE_CHECKING:
    from calibkit.stages.info import Info


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("info")(run)


def run(
    sources: Annotated[
        list[Path], typer.Argument(metavar="SOURCE...", help="Bags, image folders, ASL folders or CSV files, on one clock.")
    ],
    json_file: options.Json = None,
    rate: options.Rate = None,
    gyro_unit: options.GyroUnit = None,
    accel_unit: options.AccelUnit = None,
    ros_distro: options.RosDistro = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite FILE.")] = False,
) -> None:
    """Show topics, rates and flaws of a recording.

    How long it is, what is wrong with it, and what each topic could be used for.
    """
    from calibkit.cli.paths import refuse_clashes
    from calibkit.cli.progress import bar
    from calibkit.errors import one_line
    from calibkit.io.imu_options import ImuOptions
    from calibkit.stages.info import info

    refuse_clashes(sources, [json_file])
    result = info(sources, ros_distro, json_file, force, bar, ImuOptions(rate, gyro_unit, accel_unit))
    _show(result)
    if json_file is not None:
        typer.echo(f"json: {one_line(json_file)}")


def _show(result: "Info") -> None:
    """Print the table and the findings; all text that comes from files is printed as it is, never as markup."""
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from calibkit.data.plural import counted

    console = Console(highlight=False)
    if not console.is_terminal:
        console.width = 200  # a log has no width to fit
    table = Table(box=box.SIMPLE, show_edge=False, pad_edge=False)
    for title, justify in (("topic", "left"), ("type", "left"), ("messages", "right"), ("Hz", "right"), ("seconds", "right")):
        table.add_column(title, justify=justify, overflow="fold")  # type: ignore[arg-type]
    table.add_column("image", overflow="fold")
    table.add_column("usable for", overflow="fold")
    for t in result.topics:
        count = str(t.held) if t.held == t.topic.count else f"{t.held} of {t.topic.count}"
        seconds = f"{(t.end_ns - t.start_ns) * 1e-9:.2f}" if t.start_ns is not None and t.end_ns is not None else "-"
        image = f"{t.image.width} x {t.image.height}, {t.image.bits} bit" if t.image else ""
        rate = f"{t.rate_hz:.2f}" if t.rate_hz else "-"
        table.add_row(*(Text(cell) for cell in (t.topic.name, t.topic.type, count, rate, seconds, image, t.topic.usable_for)))
    console.print(table)
    for t in result.topics:
        if t.image:
            images = counted(t.image.sampled, "image", "images")
            found = f"brightness {100 * t.image.brightness:.0f} % of white, sharpness {t.image.sharpness:.2f} (falls with blur)"
            console.print(Text(f"  note     {t.topic.name}: {found}, median of {images}"), soft_wrap=True)
    for name, finding in [(t.topic.name, f) for t in result.topics for f in t.findings] + [("recording", f) for f in result.findings]:
        console.print(Text(f"  {'PROBLEM' if finding.problem else 'note   '}  {name}: {finding.text}"), soft_wrap=True)
    for warning in result.warnings:
        console.print(Text(f"  reading  {warning}"), soft_wrap=True)
    topics, problems = counted(len(result.topics), "topic", "topics"), counted(result.problems, "problem", "problems")
    console.print(Text(f"{', '.join(result.sources)}: {topics}, {result.duration_s:.2f} s, {problems}"), soft_wrap=True)
