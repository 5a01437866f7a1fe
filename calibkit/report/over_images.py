"""What pictures over an image have in common."""

from math import floor, log10

from matplotlib.axes import Axes


def image_axes(axes: Axes, size: tuple[int, int]) -> None:
    """Make the axes those of an image of width, height px."""
    width, height = size
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal", xlabel="u (px)", ylabel="v (px)")
    axes.spines[:].set_visible(True)


def round_down(value: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is not above value."""
    power = 10.0 ** floor(log10(value))
    return max(step * power for step in (1, 2, 5) if step * power <= value * (1 + 1e-12))
