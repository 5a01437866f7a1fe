"""A board as a page to print: vector shapes to scale, a ruler bar to check the printer by, the parameters in small print."""

from io import BytesIO

import numpy as np
from matplotlib import rc_context
from matplotlib.collections import CircleCollection, PolyCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from calibkit.errors import BadInputError

Array = NDArray[np.float64]

PAGES = {"a4": (210, 297), "a3": (297, 420), "a2": (420, 594), "a1": (594, 841), "a0": (841, 1189), "letter": (216, 279)}  # mm
MARGIN = 8.0  # mm, white around the board; most printers need 5
FOOTER = 14.0  # mm below it for the ruler and the small print
_MM = 1 / 25.4  # inch
_METADATA = {"Creator": "calibkit", "Producer": "calibkit", "CreationDate": None}  # no dates: equal boards are equal bytes


def page_size(name: str, board: tuple[float, float]) -> tuple[float, float]:
    """Return width and height in mm of the named page (`a4` ... or `WxH` in mm), turned so that a board (w, h) in mm fits.

    A board too large for it is a BadInputError that names the smallest page that would do.
    """
    size = PAGES.get(name.lower()) or _own_size(name)
    for page in (size, size[::-1]):
        if _fits(board, page):
            return float(page[0]), float(page[1])
    larger = [known for known, page in PAGES.items() if _fits(board, page) or _fits(board, page[::-1])]
    needed = f"{np.ceil(board[0] + 2 * MARGIN):.0f}x{np.ceil(board[1] + 2 * MARGIN + FOOTER):.0f}"
    remedy = f"--page {larger[0]}" if larger else f"--page {needed}, or a smaller board"
    raise BadInputError(f"the board is {board[0]:.0f} x {board[1]:.0f} mm and does not fit on {name} with its margins: use {remedy}")


def _fits(board: tuple[float, float], page: tuple[float, float]) -> bool:
    return board[0] + 2 * MARGIN <= page[0] + 1e-6 and board[1] + 2 * MARGIN + FOOTER <= page[1] + 1e-6


def _own_size(name: str) -> tuple[float, float]:
    try:
        width, height = (float(part) for part in name.lower().removesuffix("mm").split("x"))
    except ValueError:
        width = height = 0.0
    if not (10 <= width <= 10_000 and 10 <= height <= 10_000):
        raise BadInputError(f"--page {name!r} is not known: use one of {', '.join(PAGES)}, or WIDTHxHEIGHT in mm such as 800x600")
    return width, height


def draw_board(black: Array, white: Array, discs: Array, page: tuple[float, float], caption: str) -> Figure:
    """Return the page: rectangles (n, 4) x0 y0 x1 y1 and discs (k, 3) x y radius in mm, y up, their box's centre above the footer's."""
    corners = np.concatenate([black.reshape(-1, 2), discs[:, :2] - discs[:, 2:], discs[:, :2] + discs[:, 2:]])
    low, high = corners.min(0), corners.max(0)
    shift = np.array([page[0] / 2, (page[1] + FOOTER) / 2]) - (low + high) / 2
    figure = Figure(figsize=(page[0] * _MM, page[1] * _MM))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, page[0]), ylim=(0, page[1]))
    axes.axis("off")
    for rectangles, colour in ((black, "black"), (white, "white")):
        polygons = (rectangles[:, [0, 1, 2, 1, 2, 3, 0, 3]].reshape(-1, 4, 2) + shift).astype(float)
        axes.add_collection(PolyCollection(list(polygons), facecolors=colour, edgecolors="none", linewidths=0), autolim=False)
    points = np.pi * (discs[:, 2] * _MM * 72) ** 2
    axes.add_collection(
        CircleCollection(
            points, offsets=discs[:, :2] + shift, offset_transform=axes.transData, facecolors="black", edgecolors="none", linewidths=0
        ),
        autolim=False,
    )
    _ruler(figure, page, caption)
    return figure


def _ruler(figure: Figure, page: tuple[float, float], caption: str) -> None:
    """Draw a bar of 100 mm, or of 50 on a narrow page, and the caption beside the words that say what it is for."""
    length = 100 if page[0] >= 100 + 2 * MARGIN else 50
    axes, left, base = figure.axes[0], MARGIN, 9.0
    axes.plot([left, left + length], [base, base], color="black", linewidth=0.6, solid_capstyle="butt")
    for mm in range(0, length + 1, 10):
        height = 3.0 if mm % 50 == 0 else 1.8
        axes.plot([left + mm] * 2, [base, base + height], color="black", linewidth=0.4, solid_capstyle="butt")
    axes.text(left, base - 1, f"{length} mm: print at 100 %, measure this bar and the board", fontsize=5, va="top")
    axes.text(left, base - 4, caption, fontsize=5, va="top")


def pdf_bytes(figure: Figure) -> bytes:
    """Return the page as a PDF, equal bytes for equal pages."""
    out = BytesIO()
    with rc_context({"pdf.fonttype": 42, "pdf.compression": 6}):
        figure.savefig(out, format="pdf", metadata=_METADATA)
    return out.getvalue()
