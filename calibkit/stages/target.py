"""A board to print, and its target YAML beside it."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibkit.detection.artwork import artwork
from calibkit.errors import BadInputError, one_line
from calibkit.io.atomic import refuse_unwritable, write_atomic
from calibkit.io.target_file import dump_target
from calibkit.models.board import AprilGrid, Board, Charuco
from calibkit.report.board_pdf import draw_board, page_size, pdf_bytes

_MAX_CELLS = 2500  # tags, squares or circles, as in target files


@dataclass(frozen=True)
class Printed:
    """What was written."""

    pdf: Path
    yaml: Path
    board_mm: tuple[float, float]
    page_mm: tuple[float, float]


def print_target(board: Board, out: Path, page: str = "a4", force: bool = False) -> Printed:
    """Write the board to scale as OUT.pdf and its target file as OUT.yaml."""
    if out.suffix.lower() != ".pdf":
        raise BadInputError(f"{one_line(out)}: a board is written as a PDF, give a name that ends in .pdf")
    yaml = out.with_suffix(".yaml")
    for path in (out, yaml):
        refuse_unwritable(path, force)
    _refuse_absurd(board)
    shapes = artwork(board)
    x0, y0, x1, y1 = (1000 * v for v in shapes.box)
    size = x1 - x0, y1 - y0
    page_mm = page_size(page, size)
    black, white, discs = (1000 * np.asarray(part) for part in (shapes.black, shapes.white, shapes.discs))
    if not shapes.y_up:
        black, white = black[:, [0, 3, 2, 1]] * (1, -1, 1, -1), white[:, [0, 3, 2, 1]] * (1, -1, 1, -1)
        discs = discs * (1, -1, 1)
    target = dump_target(board)
    caption = ", ".join(line.strip() for line in target.splitlines() if line.strip())
    write_atomic(out, pdf_bytes(draw_board(black, white, discs, page_mm, caption)), overwrite=force)
    write_atomic(yaml, target, overwrite=force)
    return Printed(out, yaml, size, page_mm)


def _refuse_absurd(board: Board) -> None:
    """Raise BadInputError before anything is drawn that no page could hold."""
    lengths = {name: value for name, value in vars(board).items() if isinstance(value, float)}
    for name, value in lengths.items():
        ratio = isinstance(board, AprilGrid) and name == "spacing"
        low, high = (1e-4, 100) if ratio else (0.005 if name == "tag_size" else 1e-4, 1)
        if not low <= value < high:
            remedy = (
                "it is in tag sizes, such as 0.3"
                if ratio
                else f"lengths are in metres, such as {value / 1000 if 1 <= value < 1000 else 0.03:g}"
            )
            raise BadInputError(f"{name.replace('_', ' ')} of {value:g} makes no board: {remedy}")
    if isinstance(board, Charuco) and board.marker_size >= board.square_size:
        raise BadInputError(
            f"a marker of {board.marker_size:g} m does not fit into a square of {board.square_size:g} m: give a smaller --marker"
        )
    if board.shape[0] * board.shape[1] > _MAX_CELLS:
        raise BadInputError(f"a board of {board.shape[1]} x {board.shape[0]} is more than {_MAX_CELLS}: take fewer --columns or --rows")
