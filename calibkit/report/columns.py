"""Tables of text, and sizes with their units, as the terminal shows them."""

from collections.abc import Sequence

from calibkit.data.plural import plain
from calibkit.errors import one_line


def columns(cells: Sequence[Sequence[str]]) -> str:
    """Return rows of cells as aligned columns."""
    clean = [[one_line(cell, 80) for cell in row] for row in cells]
    widths = [max(len(cell) for cell in column) for column in zip(*clean, strict=True)]
    return "\n".join("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in clean)


def sized(value: float | None, unit: str) -> str:
    """Return a size in two digits, below 1 in thousandths of the unit (m, rad, s): "12 mm", "3 m/s"; px as they are."""
    if value is None:
        return ""
    milli = abs(value) < 1 and unit != "px"
    return f"{plain(value * 1e3 if milli else value)} {'m' if milli else ''}{unit}"


def range_text(range_m: float) -> str:
    """Return a distance in m, "far" without an end."""
    return f"{range_m:g} m" if range_m < float("inf") else "far"
