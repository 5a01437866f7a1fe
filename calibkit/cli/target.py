"""`calibkit target`: boards to print."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from calibkit.models.board import Board

Out = Annotated[Path, typer.Option("-o", "--out", metavar="FILE.pdf", help="The page; the target YAML is written beside it.")]
Page = Annotated[str, typer.Option("--page", help="a4, a3, a2, a1, a0, letter, or WIDTHxHEIGHT in mm.")]
Force = Annotated[bool, typer.Option("--force", help="Overwrite existing files.")]


def register(app: typer.Typer) -> None:
    """Add the commands."""
    group = typer.Typer(name="target", help="Print a board to scale as a PDF, with its target YAML.")
    for run in (aprilgrid, checkerboard, charuco, circlegrid):
        group.command(run.__name__)(run)
    app.add_typer(group)


def aprilgrid(
    columns: Annotated[int, typer.Option(help="Tags along x.", min=1, max=600)],
    rows: Annotated[int, typer.Option(help="Tags along y.", min=1, max=600)],
    tag_size: Annotated[float, typer.Option(metavar="M", help="Edge of a tag's black square in metres.")],
    out: Out,
    spacing: Annotated[float, typer.Option(help="Gap between tags, in tag sizes.")] = 0.3,
    page: Page = "a4",
    force: Force = False,
) -> None:
    """Kalibr's AprilGrid: seen in part or upside down, every corner has its number."""
    from calibkit.models.board import AprilGrid

    _print(AprilGrid(columns, rows, tag_size, spacing), out, page, force)


def checkerboard(
    columns: Annotated[int, typer.Option(help="Inner corners along x: one less than squares.", min=3, max=1000)],
    rows: Annotated[int, typer.Option(help="Inner corners along y.", min=3, max=1000)],
    square: Annotated[float, typer.Option(metavar="M", help="Edge of a square in metres.")],
    out: Out,
    page: Page = "a4",
    force: Force = False,
) -> None:
    """A checkerboard; take columns + rows odd, or it looks the same upside down."""
    from calibkit.models.board import Checkerboard

    _print(Checkerboard(columns, rows, square, square), out, page, force)


def charuco(
    columns: Annotated[int, typer.Option(help="Squares along x.", min=3, max=1000)],
    rows: Annotated[int, typer.Option(help="Squares along y.", min=3, max=1000)],
    square: Annotated[float, typer.Option(metavar="M", help="Edge of a square in metres.")],
    marker: Annotated[float, typer.Option(metavar="M", help="Edge of a marker in metres, 0.6 to 0.8 of a square.")],
    out: Out,
    dictionary: Annotated[str, typer.Option(help="OpenCV's name of the marker dictionary.")] = "DICT_5X5_1000",
    legacy: Annotated[bool, typer.Option("--legacy", help="The pattern of OpenCV before 4.6.")] = False,
    page: Page = "a4",
    force: Force = False,
) -> None:
    """A ChArUco board as OpenCV draws it: may be seen in part."""
    from calibkit.models.board import Charuco

    _print(Charuco(columns, rows, square, marker, dictionary, legacy), out, page, force)


def circlegrid(
    columns: Annotated[int, typer.Option(help="Circles in a row.", min=2, max=1000)],
    rows: Annotated[int, typer.Option(help="Rows.", min=2, max=1000)],
    spacing: Annotated[float, typer.Option(metavar="M", help="Distance of neighbours in metres; asymmetric: half of it within a row.")],
    out: Out,
    asymmetric: Annotated[bool, typer.Option("--asymmetric", help="Shift every second row by half a distance.")] = False,
    page: Page = "a4",
    force: Force = False,
) -> None:
    """A grid of black discs; boards with corners are more exact."""
    from calibkit.models.board import CircleGrid

    _print(CircleGrid(columns, rows, spacing, asymmetric), out, page, force)


def _print(board: "Board", out: Path, page: str, force: bool) -> None:
    from calibkit.errors import one_line
    from calibkit.stages.target import print_target

    done = print_target(board, out, page, force)
    typer.echo(f"board: {done.board_mm[0]:.1f} x {done.board_mm[1]:.1f} mm on {done.page_mm[0]:g} x {done.page_mm[1]:g} mm")
    typer.echo("print at 100 %, measure the ruler bar and the board, and correct the YAML where they differ")
    for file in (done.pdf, done.yaml):
        typer.echo(f"written: {one_line(file)}")
