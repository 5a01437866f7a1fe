"""The signals of a residual set as a table: what is measured, what is good, what is bad (numpy only).

A new signal is one function View -> Measured and one line in PROBES.
"""

from collections.abc import Iterable
from math import inf, isfinite

import numpy as np

from calibkit.data.plural import counted
from calibkit.data.verdict import Reason, Verdict
from calibkit.report.field import Repeating, cells, neighbour_correlation, over_image, over_radius
from calibkit.report.hand_eye_signals import pose_shift, pose_turn, poses_dropped, second_axis
from calibkit.report.joint_signals import alike, corners_fast, samples_fast
from calibkit.report.probe import SIGNIFICANT, Measured, Probe, Signal
from calibkit.report.time_offset_signals import over_before, rate_growth, window_scatter
from calibkit.report.view import Array, View, given, rms

GOOD_RMS_PX = 0.3
COVERAGE_GRID = (8, 6)
MIN_CORNERS = 3  # in a cell that counts as covered


def measure(view: View) -> list[Signal]:
    """Return every signal that the view has the data for, in the table's order."""
    found = []
    for probe in PROBES:
        if not view.has(probe.needs):
            continue
        measured = probe.measure(view)
        if isfinite(measured.value):
            verdict = Verdict.PASS if measured.exempt else probe.judge(measured.value)
            found.append(Signal(probe, view.stage, view.sensor, measured.value, measured.note, verdict))
    return found


def not_good(signals: Iterable[Signal]) -> tuple[Reason, ...]:
    """Return the sentences of the signals that are not good."""
    return tuple(signal.reason for signal in signals if signal.verdict is not Verdict.PASS)


def _rms(view: View) -> Measured:
    every = rms(view.raw)
    return Measured(rms(view.raw[view.kept]), f"{every:.3g} {view.unit} with the dropped corners")


def _held_out(view: View) -> Measured:
    held_out = given(view.held_out_rms)
    ratio = held_out / max(rms(view.raw[view.kept]), 1e-12)
    return Measured(ratio, f"{held_out:.3g} px on frames that the solver did not see")


def _dropped(view: View) -> Measured:
    total = len(view.raw) + view.n_lost
    dropped = total - int(view.kept.sum())
    return Measured(100 * dropped / total, f"{dropped} of {counted(total, 'corner')}")


def _worst_frame(view: View) -> Measured:
    per_frame = view.frame_rms
    some = np.isfinite(per_frame)
    worst = int(np.argmax(np.where(some, per_frame, -1)))
    middle = float(np.median(per_frame[some]))
    note = f"{view.labels[worst]}: {per_frame[worst]:.3g} {view.unit}, median {middle:.3g}"
    harmless = some.sum() < 3 or per_frame[worst] <= GOOD_RMS_PX
    return Measured(float(per_frame[worst]) / max(middle, 1e-12), note, exempt=bool(harmless))


def _structure(found: Repeating, view: View) -> Measured:
    share = 100 * found.size**2 / max(rms(view.raw[view.kept]) ** 2, 1e-24)
    if found.significance < SIGNIFICANT:
        return Measured(found.size, "no more than chance", exempt=True)
    return Measured(found.size, f"{share:.0f} % of the variance")


def _field(view: View) -> Measured:
    return _structure(over_image(view)[0], view)


def _radial(view: View) -> Measured:
    return _structure(over_radius(view)[0], view)


def _swirl(view: View) -> Measured:
    return _structure(over_radius(view)[1], view)


def _neighbours(view: View) -> Measured:
    rho, pairs = neighbour_correlation(view)
    chance = abs(rho) * np.sqrt(2 * pairs) < SIGNIFICANT
    return Measured(rho, f"{counted(pairs, 'pair')}{', chance' if chance else ''}", exempt=bool(chance))


def _coverage(view: View) -> Measured:
    cell = cells(given(view.uv)[view.kept], given(view.image_size), COVERAGE_GRID)
    counts = np.bincount(cell, minlength=COVERAGE_GRID[0] * COVERAGE_GRID[1])
    empty = empty_regions(view)
    return Measured(100 * float(np.mean(counts >= MIN_CORNERS)), f"no corners {', '.join(empty)}" if empty else "")


REGIONS = (
    ("in the upper left", "at the top", "in the upper right"),
    ("on the left", "in the middle", "on the right"),
    ("in the lower left", "at the bottom", "in the lower right"),
)


def empty_regions(view: View) -> list[str]:
    """Name the ninths of the image that hold fewer than MIN_CORNERS kept corners."""
    counts = np.bincount(cells(given(view.uv)[view.kept], given(view.image_size), (3, 3)), minlength=9)
    names = [name for row in REGIONS for name in row]
    return [name for name, count in zip(names, counts, strict=True) if count < MIN_CORNERS]


def frame_tilts(view: View) -> Array:
    """Return the board's tilt (rad) in each frame that has kept corners."""
    tilt = given(view.tilt)
    rows = np.flatnonzero(view.kept & np.isfinite(tilt))
    _, first = np.unique(given(view.frame)[rows], return_index=True)
    return tilt[rows[first]]


def _tilt(view: View) -> Measured:
    tilts = np.degrees(frame_tilts(view))
    if not len(tilts):
        return Measured(float("nan"))
    low, high = np.percentile(tilts, [10, 90])
    return Measured(float(high), f"most boards between {low:.0f} and {high:.0f} deg")


_PIXELS = frozenset({"uv", "frame"})
_IMAGE = _PIXELS | {"image_size"}
PROBES = (
    Probe("reprojection_rms", "reprojection rms", "px", GOOD_RMS_PX, 1.0, frozenset({"uv"}), _rms,
          "corners are met badly: look for blur, a wrong board size or a wrong camera model"),
    Probe("held_out_ratio", "held-out rms over rms", "", 1.3, 3.0, frozenset({"uv", "held_out_rms"}), _held_out,
          "the model fits the frames it saw better than others: record more, and more varied, boards"),
    Probe("dropped_corners", "corners dropped", "%", 5, 30, frozenset({"uv"}), _dropped,
          "many corners disagree with the rest: look at the worst frames"),
    Probe("worst_frame_ratio", "worst frame over the median frame", "", 3, inf, _PIXELS, _worst_frame,
          "look at that frame: blur, a wrong board, a bent board"),
    Probe("field", "pattern over the image", "px", 0.1, 0.5, _IMAGE, _field,
          "the lens model does not fit this lens: try another --model"),
    Probe("radial_field", "radial pattern", "px", 0.1, 0.5, _PIXELS | {"centre"}, _radial,
          "a radial pattern is left: the lens needs more radial coefficients or another --model"),
    Probe("tangential_field", "swirl around the centre", "px", 0.1, 0.5, _PIXELS | {"centre"}, _swirl,
          "a swirl is left: a shifted sensor, a rolling shutter or a twisted board"),
    Probe("neighbour_correlation", "correlation of neighbouring corners", "", 0.5, inf, _PIXELS | {"corner"}, _neighbours,
          "neighbours share their error, so plain sigmas are too small: believe the corrected ones"),
    Probe("image_coverage", "image covered by corners", "%", 60, -inf, frozenset({"uv", "image_size"}), _coverage,
          "the lens is extrapolated where no corner was: bring the board there"),
    Probe("tilt_range", "tilt of the boards (90th percentile)", "deg", 20, -inf, frozenset({"tilt", "frame"}), _tilt,
          "boards facing the camera leave focal length and distance coupled: tilt the board by 30 to 45 deg"),
    Probe("rate_growth", "residual's growth with the rotation rate", "%", 3, inf, frozenset({"rate", "t"}), rate_growth,
          "stamps that jitter or clocks that drift (stamp in hardware), a wrong scale of a gyroscope (calibkit imu) or images that blur "
          "(shorten the exposure)"),
    Probe("over_before", "residual over that of the stamps as they are", "", 1.1, inf, frozenset({"before"}), over_before,
          "the time offset makes it worse: a wrong bottom, or a clock that jumps; look at the V and at the offset over time"),
    Probe("window_scatter", "scatter of the time offset between windows, over sigma", "", 2.5, inf,
          frozenset({"window_offset", "window_sigma"}), window_scatter,
          "stamps wander by more than the clock's line says: believe the time offset to that scatter, and stamp in hardware"),
    Probe("pose_turn", "turn that the poses leave", "deg", 0.3, 3.0, frozenset({"turn"}), pose_turn,
          "poses of different moments or read wrongly, blur, a robot or an odometry that errs, or a mount that gives"),
    Probe("pose_shift", "shift that the poses leave", "mm", 3.0, 50.0, frozenset({"turn"}), pose_shift,
          "poses of different moments or read wrongly, a board or lens that is off, a robot or odometry that errs, or a mount that gives"),
    Probe("poses_dropped", "poses left out", "%", 10, 40, frozenset({"turn"}), poses_dropped,
          "many poses do not fit the others: look at those left out"),
    Probe("second_axis", "turn about a second axis", "deg", 8, -inf, frozenset({"motion"}), second_axis,
          "turns about one axis leave the translation along it open: tilt the mover about another axis by 30 deg or more"),
    Probe("fast_corners", "frame's rms at the fastest turns over the slowest", "", 2, inf, frozenset({"uv", "frame", "rate"}), corners_fast,
          "blur (shorten the exposure), a rolling shutter, or stamps that jitter"),
    Probe("fast_samples", "residual at the fastest turns over the slowest", "", 1.5, inf, frozenset({"measured", "rate"}), samples_fast,
          "a wrong scale or misaligned axes (calibkit imu), or samples that are late or early"),
    Probe("autocorrelation", "autocorrelation of the residuals", "", 0.3, inf, frozenset({"measured", "t"}), alike,
          "vibration, a filter in the IMU, or motion that the knots are too coarse for: plain sigmas are too small, and see the spectrum"),
)  # fmt: skip
