"""The pictures of a report as a table: what each needs, how it is drawn, and what to look for.

A new picture is one function (Figure, View) and one line in PICTURES. Dark on white, told apart by shape as well as by colour.
"""

import io
import textwrap
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from calibkit.report.field import cells, grid, over_image, over_radius
from calibkit.report.hand_eye_figures import cross_sections, pose_residuals, poses_in_space, rotation_axes
from calibkit.report.imu_figures import allan, stands
from calibkit.report.joint_figures import biases, imu_fit, way, whiteness
from calibkit.report.lens_uncertainty import uncertainty
from calibkit.report.look import ACCENT, INK, PALE
from calibkit.report.over_images import image_axes, round_down
from calibkit.report.rotation_figures import rates, residual_rate
from calibkit.report.signals import frame_tilts
from calibkit.report.time_figures import over_time
from calibkit.report.time_offset_figures import offset_over_time, v_curve
from calibkit.report.view import View, given

MAX_BARS = 120
MAX_POINTS = 20000  # of a scatter
STYLE: dict[Any, Any] = {
    "svg.hashsalt": "calibkit",  # ids that do not change from run to run
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 9,
    "axes.axisbelow": True,
    "text.parse_math": False,  # names come from files: a $ in them is a $
}


@dataclass(frozen=True)
class Plate:
    """A picture that knows what it shows."""

    key: str
    title: str
    caption: str
    height: float  # inches
    draw: Callable[[Figure], None]


@dataclass(frozen=True)
class Picture:
    """One kind of picture of a view."""

    key: str
    title: str
    caption: str
    needs: frozenset[str]
    height: float  # inches
    draw: Callable[[Figure, View], None]

    def of(self, view: View) -> Plate:
        return Plate(self.key, self.title, self.caption, self.height, lambda figure: self.draw(figure, view))


@dataclass(frozen=True)
class Chapter:
    """Pictures under one heading."""

    name: str
    plates: tuple[Plate, ...]
    note: str = ""


@dataclass(frozen=True)
class Drawn:
    """A picture, drawn."""

    plate: Plate
    svg: bytes
    files: Mapping[str, bytes]  # by format


FORMATS: dict[str, dict[str, str | None]] = {  # and what keeps the time of the day out of each
    "png": {"Software": "calibkit"},
    "pdf": {"Creator": "calibkit", "Producer": "calibkit", "CreationDate": None},
    "svg": {"Creator": "calibkit", "Date": None},
}


def plates(view: View) -> list[Plate]:
    """Return every picture that the view has the data for, in the table's order."""
    return [picture.of(view) for picture in PICTURES if view.has(picture.needs)]


def draw(shown: Sequence[Plate], formats: Sequence[str] = ()) -> list[Drawn]:
    """Return the plates drawn; the same data give the same bytes."""
    return [_render(plate, formats) for plate in shown]


def _render(plate: Plate, formats: Sequence[str]) -> Drawn:
    files = rendered(plate.height, plate.draw, ("svg", *formats))
    return Drawn(plate, files["svg"], {form: files[form] for form in formats})


def rendered(height: float, draw: Callable[[Figure], None], formats: Sequence[str]) -> dict[str, bytes]:
    """Return a picture, `height` inches high, in each of FORMATS that is asked for; the same drawing gives the same bytes."""
    # From the defaults up: a user's own matplotlibrc would change the bytes. No backend is chosen: Figure draws on its own.
    defaults: dict[Any, Any] = {key: value for key, value in matplotlib.rcParamsDefault.items() if not key.startswith("backend")}
    with matplotlib.rc_context(defaults | STYLE), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing", category=UserWarning)  # a name in a script that the font lacks
        figure = Figure(figsize=(9, height), layout="constrained")
        draw(figure)
        figure.draw_without_rendering()  # lay out once, not at each saving
        figure.set_layout_engine("none")
        return {form: _saved(figure, form) for form in dict.fromkeys(formats)}


def _saved(figure: Figure, form: str) -> bytes:
    out = io.BytesIO()
    figure.savefig(out, format=form, dpi=130, metadata=FORMATS[form])
    return out.getvalue()


def _scatter(figure: Figure, view: View) -> None:
    left, right = figure.subplots(1, 2, width_ratios=[1, 1.2])
    kept, dropped = view.raw[view.kept], view.raw[~view.kept]
    sigma = float(np.sqrt(np.mean(kept**2)))
    reach = 5 * sigma if sigma > 0 else 1.0
    few = kept[:: 1 + len(kept) // MAX_POINTS]
    left.plot(*few.T, ".", color=INK, ms=2.5, alpha=float(np.clip(3000 / len(few), 0.15, 0.7)), mew=0, rasterized=True)
    near = dropped[np.all(np.abs(dropped) < reach, axis=1)]
    left.plot(*near.T, "x", color=ACCENT, ms=4, rasterized=True)
    for k in (1, 2, 3):
        turn = np.linspace(0, 2 * np.pi, 100)
        left.plot(k * sigma * np.cos(turn), k * sigma * np.sin(turn), color="black", lw=0.7, ls=(0, (4, 3)))
    left.set(xlim=(-reach, reach), ylim=(reach, -reach), aspect="equal", xlabel=f"du ({view.unit})", ylabel=f"dv ({view.unit})")
    outside = len(dropped) - len(near)
    note = f"× dropped{f' ({outside} more outside)' if outside else ''}" if len(dropped) else "none dropped"
    left.set_title(f"kept corners, circles at 1, 2, 3 sigma; {note}")
    bins = np.linspace(-reach, reach, 61)
    x = np.linspace(-reach, reach, 200)
    for values, name, line, fill in ((kept[:, 0], "du", "-", PALE), (kept[:, 1], "dv", "--", None)):
        right.hist(values, bins, density=True, histtype="stepfilled" if fill else "step", color=fill or INK, ls=line, lw=1.2, label=name)
    if sigma > 0:
        normal = np.exp(-0.5 * (x / sigma) ** 2) / (sigma * np.sqrt(2 * np.pi))
        right.plot(x, normal, color=ACCENT, lw=1.4, label="normal")
    right.set(xlabel=f"residual ({view.unit})", xlim=(-reach, reach), yticks=[])
    right.set_title(f"sigma {sigma:.3g} {view.unit} a coordinate, mean ({kept[:, 0].mean():+.2g}, {kept[:, 1].mean():+.2g})")
    right.legend(frameon=False)


def _field(figure: Figure, view: View) -> None:
    width, height = given(view.image_size)
    left, right = figure.subplots(1, 2, width_ratios=[1.35, 1])
    found, (columns, rows) = over_image(view)
    x, y = np.meshgrid((np.arange(columns) + 0.5) * width / columns - 0.5, (np.arange(rows) + 0.5) * height / rows - 0.5)
    seen = np.all(np.isfinite(found.sigma), axis=1)
    sure = seen & (np.linalg.norm(found.mean, axis=1) > 3 * np.linalg.norm(np.nan_to_num(found.sigma), axis=1))
    longest = float(np.max(np.linalg.norm(found.mean[seen], axis=1), initial=0))
    scale = (longest or 1.0) / (1.1 * width / columns)  # px of residual per px of image
    for chosen, colour in ((seen & ~sure, PALE), (sure, INK)):
        at = x.ravel()[chosen], y.ravel()[chosen]
        arrows = left.quiver(*at, *found.mean[chosen].T, angles="xy", scale_units="xy", scale=scale, color=colour, width=0.004, pivot="mid")
    key = round_down(longest) if longest > 0 else 1.0
    left.quiverkey(arrows, 0.92, -0.13, key, f"{key:g} {view.unit}", labelpos="W", color=INK)
    left.plot(*given(view.centre), "+", color=ACCENT, ms=9)
    image_axes(left, given(view.image_size))
    left.set_title("mean residual of each cell; dark: beyond 3 sigma of zero")
    radial, tangential, edges = over_radius(view)
    middle = (edges[1:] + edges[:-1]) / 2
    lines = ((radial, "radial (outwards)", "o-", INK, -0.06), (tangential, "tangential", "s--", ACCENT, 0.06))
    for part, name, mark, colour, shift in lines:
        some = np.isfinite(part.sigma[:, 0])
        at = middle[some] + shift * (edges[1] - edges[0])
        right.errorbar(at, part.mean[some, 0], 2 * part.sigma[some, 0], fmt=mark, color=colour, ms=4, lw=1, capsize=2, label=name)
    right.axhline(0, color="black", lw=0.7)
    right.set(xlabel="distance from the principal point (px)", ylabel=f"mean residual ({view.unit})", title="by distance, bars of 2 sigma")
    right.legend(frameon=False)


def _coverage(figure: Figure, view: View) -> None:
    width, height = size = given(view.image_size)
    columns, rows = grid(size)
    both = view.has(frozenset({"tilt", "frame"})) and len(frame_tilts(view)) > 0
    axes = figure.subplots(1, 2 if both else 1, width_ratios=[1.7, 1] if both else None, squeeze=False)[0]
    counts = np.bincount(cells(given(view.uv)[view.kept], size, (columns, rows)), minlength=columns * rows).reshape(rows, columns)
    axes[0].imshow(np.sqrt(counts), cmap="Greys", vmin=0, extent=(-0.5, width - 0.5, height - 0.5, -0.5), aspect="equal")
    for row, column in np.ndindex(rows, columns):
        many = np.sqrt(counts[row, column]) > 0.6 * np.sqrt(counts.max())
        text, colour = (str(counts[row, column]), "white" if many else "black") if counts[row, column] else ("–", ACCENT)
        at = (column + 0.5) * width / columns, (row + 0.5) * height / rows
        axes[0].text(*at, text, color=colour, ha="center", va="center", fontsize=7)
    image_axes(axes[0], size)
    axes[0].set_title("kept corners in each cell of the image")
    if both:
        axes[1].hist(np.degrees(frame_tilts(view)), np.arange(0, 91, 5), color=PALE, edgecolor=INK)
        axes[1].set(xlabel="tilt of the board (deg)", ylabel="frames", title="how the boards were tilted")
        axes[1].yaxis.set_major_locator(MaxNLocator(integer=True))


def _frames(figure: Figure, view: View) -> None:
    axes = figure.subplots()
    values = view.frame_rms
    n = len(values)
    worst = np.argsort(np.where(np.isfinite(values), -values, np.inf), kind="stable")[: min(3, n)]
    if n <= MAX_BARS:
        bars = axes.bar(np.arange(n), np.nan_to_num(values), color=PALE, edgecolor=INK, lw=0.5)
        for i in worst:
            bars[i].set(facecolor=ACCENT, hatch="///")
    else:
        axes.plot(np.arange(n), values, color=INK, lw=0.8)
        axes.plot(worst, values[worst], "x", color=ACCENT, ms=7, mew=2)
    middle = float(np.nanmedian(values))
    axes.axhline(middle, color="black", lw=0.8, ls="--")
    axes.set(xlabel="frame, in the order of the recording", ylabel=f"rms ({view.unit})", xlim=(-0.7, n - 0.3), ylim=(0, None))
    named = ", ".join(f"{view.labels[i]} ({values[i]:.3g})" for i in worst if np.isfinite(values[i]))
    axes.set_title(textwrap.fill(f"median {middle:.3g} {view.unit} (dashed); worst: {named}", 105))


_PIXELS = frozenset({"uv"})
_IMAGE = frozenset({"uv", "frame", "image_size", "centre"})
PICTURES = (
    Picture("scatter", "Residual scatter",
            "A round cloud around zero and histograms that follow the normal curve are good; an off-centre, stretched or heavy-tailed "
            "cloud is not noise.",
            _PIXELS, 3.9, _scatter),
    Picture("field", "Residual field over the image",
            "Pale arrows in random directions are good; dark arrows that form a swirl, a ring or a stream are what the lens model "
            "leaves over.",
            _IMAGE, 3.6, _field),
    Picture("coverage", "Coverage of the image and of tilt",
            "Every cell should hold corners and the tilts should reach past 30 deg; where a cell shows a dash, the lens is extrapolated.",
            _PIXELS | {"image_size"}, 3.4, _coverage),
    Picture("frames", "Rms of each frame",
            "About one height from frame to frame is good; a frame that stands out is blurred or holds a wrong board, a slope is a lens or "
            "mount that drifts.",
            _PIXELS | {"frame"}, 2.6, _frames),
    Picture("uncertainty", "How well a point's pixel is known",
            "By the lens's covariance; what a turn and a shift of the camera make up for over the corners that were seen (dots) is taken "
            "out. Small and even is good; where it climbs, no board was: bring it there, and to the distances of use.",
            _IMAGE | {"lens", "distance"}, 3.2, uncertainty),
    Picture("over_time", "Residuals over time",
            "Level lines around zero are good; a frame's rms that grows, or means that creep, is a mount, a lens or a clock that drifts: "
            "outwards alone is the focal length.",
            _PIXELS | {"frame", "centre", "moments"}, 3.8, over_time),
    Picture("allan", "Allan deviation",
            "Points on the line, within their band, are good: the noise is white (falling), flicker (flat) and a random walk (rising); "
            "dotted: their slopes. A bump is something else: vibration, temperature, a filter.",
            frozenset({"axis", "tau", "deviation", "fitted", "low", "high"}), 4.2, allan),
    Picture("stands", "Stands",
            "Residuals of one size without a trend are good, and attitudes all over both discs: where none is, scale and misalignment "
            "hang on the others.",
            frozenset({"attitude"}), 3.2, stands),
    Picture("v_curve", "The V: cost over the time offset",
            "One narrow bottom between steep sides is good (the numbers are what an offset there costs); a flat bowl cannot tell the "
            "offset, and a second bottom may be the true one.",
            frozenset({"delay"}), 3.4, v_curve),
    Picture("rates", "Rotation rates before and after",
            "After alignment the two lie on each other and their difference is noise around zero; a difference that swings with every "
            "rise and fall of the rates is time offset.",
            frozenset({"rate", "of_rate", "t"}), 4.4, rates),
    Picture("residual_rate", "Residual against rotation",
            "Once aligned both are flat, at the height of the noise; what rises with the change of rate is time offset, with the rate "
            "itself a wrong scale of a gyroscope, blur or stamps that jitter.",
            frozenset({"rate", "t"}), 3.4, residual_rate),
    Picture("offset_over_time", "Time offset over time",
            "Windows on the line, within their bars, are good; a slope is a clock that runs fast or slow, a step is frames or stamps that "
            "were lost, and scatter beyond the bars is more than their sigma says.",
            frozenset({"window_offset", "window_sigma", "t"}), 3.6, offset_over_time),
    Picture("pose_residuals", "Residual of each pose",
            "About one height from pose to pose is good; a pose that stands out belongs to another image or a moved board, a slope is "
            "a mount or a board that creeps.",
            frozenset({"turn", "frame"}), 4.4, pose_residuals),
    Picture("rotation_axes", "Axes of rotation",
            "Points all over the disc are good, far turns above all; points in one place are turns about one axis, which leave the "
            "translation along it open.",
            frozenset({"motion"}), 3.8, rotation_axes),
    Picture("cross_sections", "Translation, from three sides",
            "A small round ellipse with the methods inside is good; along a long one p is known less well. A cloud in two heaps is a board "
            "or a mount that moved.",
            frozenset({"turn", "hand_eye"}), 3.9, cross_sections),
    Picture("poses_in_space", "The poses in space",
            "Cameras that look at the board from many sides, turned and tilted, are good; a wrong setup or direction of the poses shows as "
            "cameras that look elsewhere.",
            frozenset({"place", "rotation", "hand_eye"}), 5.2, poses_in_space),
    Picture("imu_fit", "Measured and predicted",
            "Squares on the line, and a level band of points of one height within the dashed lines, are good; a band that swells with the "
            "motion is a wrong scale, axis or time, one that drifts a bias that moves more than its random walk says.",
            frozenset({"measured", "t"}), 4.8, imu_fit),
    Picture("whiteness", "Whiteness of what is left",
            "Points within the band and a level spectrum are good (dips at low frequencies are what the trajectory took along); a peak is "
            "vibration, a rise towards low frequencies motion or a bias that the model does not follow.",
            frozenset({"measured", "t"}), 3.4, whiteness),
    Picture("biases", "Biases over time",
            "Lines that stay level within their bands, or wander slowly, are good; a bias that swings with the motion stands for something "
            "else: scale, a wrong axis, gravity.",
            frozenset({"bias", "bias_sigma", "t"}), 3.2, biases),
    Picture("way", "The way",
            "Turns and moves in all three directions are good; a way along one line or in one plane leaves parts of the calibration open.",
            frozenset({"bias", "place", "t"}), 3.3, way),
)  # fmt: skip
