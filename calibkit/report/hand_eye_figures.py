"""The pictures of a hand-eye calibration: what each pose leaves over, its axes of turning, how well p is known, poses in space."""

import textwrap
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from calibkit.data.plural import counted
from calibkit.geometry import se3, so3
from calibkit.report.hand_eye_view import HandEye
from calibkit.report.look import ACCENT, AXES, INK, PALE
from calibkit.report.view import Array, Index, View, given

MAX_BARS = 120
MAX_NAMES = 60
MAX_POINTS = 2000
MAX_TRIADS = 60
NAMED = 5
NEAR = 1.0  # times the poses' spread: a world's origin that is drawn
CLIPPED = 3.0  # times the largest kept residual; what is beyond is drawn at the top
ELLIPSE = 2.448  # sigmas of two dimensions that hold 95 %
_MARKS = "os^Dv<>ph*"
_SIDES = ((0, 1), (0, 2), (1, 2))


def pose_residuals(figure: Figure, view: View) -> None:
    """Draw how far each pose is turned and shifted from where the others put it, those that were left out marked."""
    order = np.argsort(given(view.frame), kind="stable")
    kept = view.kept[order]
    labels = [view.labels[i] for i in given(view.frame)[order]]
    panels = [("turn (deg)", np.degrees(np.linalg.norm(given(view.turn)[order], axis=1)), "deg")]
    panels.append(("shift (mm)", 1e3 * np.linalg.norm(view.raw[order], axis=1), "mm"))
    if view.px is not None:
        panels.append(("in the image (px)", view.px[order], "px"))
    axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    for panel, (label, values, unit) in zip(axes, panels, strict=True):
        _bars(panel, values, kept, labels, unit)
        panel.set_ylabel(label)
    axes[-1].set_xlim(-0.7, len(order) - 0.3)
    if len(order) <= MAX_NAMES:
        axes[-1].set_xticks(
            np.arange(len(order)), [textwrap.shorten(label, 24, placeholder="...") for label in labels], rotation=90, fontsize=6
        )
    axes[-1].set_xlabel("pose, in the order of the recording")


def _bars(panel: Axes, values: Array, kept: "np.ndarray[tuple[int, ...], np.dtype[np.bool_]]", labels: list[str], unit: str) -> None:
    n, good = len(values), np.nan_to_num(values)
    top = 1.15 * min(float(good.max()), CLIPPED * float(good[kept].max(initial=0)) or np.inf) or 1.0
    high = np.flatnonzero(good > top)
    shown = np.minimum(good, top)
    at = np.arange(n)
    if n <= MAX_BARS:
        panel.bar(at[kept], shown[kept], color=PALE, edgecolor=INK, lw=0.5)
        panel.bar(at[~kept], shown[~kept], color="white", edgecolor=ACCENT, hatch="///", lw=0.8)
    else:
        panel.plot(at[kept], shown[kept], ".", color=INK, ms=3, rasterized=True)
        panel.plot(at[~kept], shown[~kept], "x", color=ACCENT, ms=4, rasterized=True)
    if len(high):  # an empty line that is not clipped upsets the layout
        panel.plot(high, np.full(len(high), top), "^", color=ACCENT, ms=6, clip_on=False)
    for i in high[:NAMED] if n <= MAX_BARS else []:
        panel.annotate(f"{good[i]:.3g}", (i, top), (0, 5), textcoords="offset points", ha="center", color=ACCENT, fontsize=7)
    rms = float(np.sqrt(np.mean(good[kept] ** 2))) if kept.any() else 0.0
    panel.axhline(rms, color="black", lw=0.8, ls="--")
    panel.set_ylim(0, top)
    worst = np.argsort(-good, kind="stable")[: min(3, n)]
    named = ", ".join(f"{labels[i]} ({good[i]:.3g})" for i in worst)
    left = f"; {counted(int(np.sum(~kept)), 'pose')} left out ({'hatched' if n <= MAX_BARS else '×'})" if not kept.all() else ""
    panel.set_title(
        textwrap.shorten(f"rms {rms:.3g} {unit} (dashed){left}; worst: {named}", 120, placeholder=" ..."), pad=16 if len(high) else 6
    )


def rotation_axes(figure: Figure, view: View) -> None:
    """Draw the axes that the pairs of poses turn about, as points of a half sphere (equal area), and how far they turn."""
    motion = given(view.motion)[view.kept]
    hand_eye = view.hand_eye
    who = hand_eye.one if hand_eye else "sensor 1"
    angle = np.linalg.norm(motion, axis=1)
    turning = angle > np.radians(0.1)
    some = np.flatnonzero(turning)[:: 1 + int(turning.sum()) // MAX_POINTS]
    left, right = figure.subplots(1, 2, width_ratios=[1, 1.25])
    circle = np.linspace(0, 2 * np.pi, 181)
    for tilt in (30, 60, 90):
        r = np.sqrt(2) * np.sin(np.radians(tilt) / 2)
        left.plot(r * np.cos(circle), r * np.sin(circle), color="#bbbbbb" if tilt < 90 else "black", lw=0.7)
    axis = motion[some] / angle[some, None]
    axis *= np.where(axis[:, 2:] < 0, -1, 1)  # an axis has two ends
    at = axis[:, :2] / np.sqrt(1 + axis[:, 2:])
    size = 4 + 40 * (angle[some] / max(float(angle.max(initial=0)), 1e-9)) ** 2
    left.scatter(*at.T, s=size, color=INK, alpha=0.45, lw=0, rasterized=True)
    for name, (x, y) in {"x": (1.08, 0), "y": (0, 1.08)}.items():
        left.text(x, y, name, ha="center", va="center", fontweight="bold")
    left.text(0, 0, "z", ha="center", va="center", fontweight="bold", color=ACCENT)
    left.set(aspect="equal", xlim=(-1.2, 1.2), ylim=(-1.2, 1.2))
    left.set_axis_off()
    left.set_title(f"axes in {who}'s frame, seen along its z;\nlarger: turned farther; rings at 30, 60, 90 deg from z")
    degrees = np.degrees(angle)
    right.hist(degrees, np.linspace(0, max(10.0, 1.02 * float(degrees.max(initial=0))), 31), color=PALE, edgecolor=INK)
    share = _shares(motion)
    right.set(xlabel="turn between two poses (deg)", ylabel="pairs")
    right.set_title(f"turned about {who}'s principal axes: {', '.join(f'{np.degrees(s):.3g}' for s in share)} deg rms")


def _shares(motion: Array) -> Array:
    """Return the rms turn (3,) rad about the principal axes of rotation vectors (k, 3), the largest first."""
    if not len(motion):
        return np.zeros(3)
    out: Array = np.sqrt(np.maximum(np.linalg.eigvalsh(motion.T @ motion / len(motion))[::-1], 0))
    return out


def cross_sections(figure: Figure, view: View) -> None:
    """Draw p of X as each pose alone has it, the 95 % ellipse of the estimate, and where the other methods put it, from three sides."""
    hand_eye = given(view.hand_eye)
    each = -1e3 * view.raw @ hand_eye.X[:3, :3].T  # of P_i^-1 Z Q_i, from X's p
    kept = each[view.kept]
    reach = 1.25 * max(float(np.quantile(np.abs(kept), 0.98)) if len(kept) else 0.0, 1e-3)
    cov = None if hand_eye.cov is None else 1e6 * hand_eye.X[:3, :3] @ hand_eye.cov[:3, :3] @ hand_eye.X[:3, :3].T
    if cov is not None:
        reach = max(reach, 1.2 * ELLIPSE * float(np.sqrt(np.diag(cov).max())))
    others = {name: 1e3 * (p - hand_eye.X[:3, 3]) for name, p in hand_eye.methods.items()}
    outside = [name for name, p in others.items() if np.abs(p).max() > reach]  # where p is open their distance means nothing
    axes = figure.subplots(1, 3)
    few = slice(None, None, 1 + len(kept) // MAX_POINTS)
    for panel, (i, j) in zip(axes, _SIDES, strict=True):
        panel.plot(kept[few, i], kept[few, j], ".", color=PALE, ms=5, mew=0, rasterized=True)
        gone = each[~view.kept]
        panel.plot(gone[:, i], gone[:, j], "x", color=ACCENT, ms=5, rasterized=True)
        if cov is not None:
            panel.plot(*_ellipse(cov[np.ix_((i, j), (i, j))]), color=INK, lw=1.6, label="95 % of the estimate")
        panel.plot(0, 0, "+", color=INK, ms=9, mew=1.6, label=hand_eye.written)
        for (name, p), mark in zip(others.items(), _MARKS, strict=False):
            if name not in outside:
                panel.plot(p[i], p[j], mark, color="white", mec="black", ms=5.5, label=name)
        panel.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
        panel.set(xlabel=f"{'xyz'[i]} of {hand_eye.one} (mm)", ylabel=f"{'xyz'[j]} of {hand_eye.one} (mm)")
        panel.axhline(0, color="black", lw=0.3)
        panel.axvline(0, color="black", lw=0.3)
    axes[0].plot([], [], ".", color=PALE, ms=8, label="one pose alone")
    if not view.kept.all():
        axes[0].plot([], [], "x", color=ACCENT, ms=5, label="left out")
    handles, names = axes[0].get_legend_handles_labels()
    figure.legend(handles, names, frameon=False, ncols=min(len(names), 9), loc="outside lower center", fontsize=8)
    p = 1e3 * hand_eye.X[:3, 3]
    said = f"{hand_eye.two} in {hand_eye.one}: ({p[0]:.2f}, {p[1]:.2f}, {p[2]:.2f}) mm at the cross"
    if not hand_eye.known:
        said = f"{hand_eye.two} in {hand_eye.one}: not all of it is observable, so no ellipse is drawn"
    far = ", ".join(f"{name} {np.linalg.norm(others[name]):.3g} mm" for name in outside if hand_eye.known)
    figure.suptitle(textwrap.fill(said + (f"; outside the picture: {far} away" if far else ""), 125), fontsize=9)


def _ellipse(cov: Array) -> Array:
    """Return the outline (2, n) that holds 95 % of a normal distribution of covariance (2, 2)."""
    values, vectors = np.linalg.eigh(cov)
    turn = np.linspace(0, 2 * np.pi, 181)
    out: Array = ELLIPSE * (vectors * np.sqrt(np.maximum(values, 0))) @ np.stack([np.cos(turn), np.sin(turn)])
    return out


def poses_in_space(figure: Figure, view: View) -> None:
    """Draw where frame 1 and frame 2 were in world 1, and world 2 in it, from two sides; world 1's origin only where it is near."""
    hand_eye = given(view.hand_eye)
    order = np.argsort(given(view.frame), kind="stable") if view.frame is not None else np.arange(len(view.raw))
    T = se3.make(so3.from_quat(given(view.rotation)), given(view.place))[order]
    others = T @ hand_eye.X
    points = np.concatenate([T[:, :3, 3], others[:, :3, 3], *([] if hand_eye.Z is None else [hand_eye.Z[None, :3, 3]])])
    low, high = points.min(axis=0), points.max(axis=0)
    far = float(np.linalg.norm(np.clip(0, low, high)))
    near = far < NEAR * float(np.max(high - low))
    if near:
        low, high = np.minimum(low, 0), np.maximum(high, 0)
    middle, half = (high + low) / 2, 0.55 * (float(np.max(high - low)) or 1.0)
    for place, turn in enumerate((-60, 30)):
        panel: Any = figure.add_subplot(1, 2, place + 1, projection="3d", proj_type="ortho")
        _space(panel, hand_eye, T, others, view.kept[order], 0.12 * half, near)
        panel.set(**{f"{axis}lim": (middle[k] - half, middle[k] + half) for k, axis in enumerate("xyz")})
        panel.set_box_aspect((1, 1, 1), zoom=0.92)
        panel.view_init(20, turn)
        panel.set(xlabel="x (m)", ylabel="y (m)", zlabel="z (m)")
        panel.tick_params(labelsize=7)
        panel.locator_params(nbins=5)
    figure.axes[0].legend(frameon=False, loc="upper left", fontsize=8)
    figure.axes[0].set_title(f"in {hand_eye.w1}'s axes" + ("" if near else f"; its origin, {far:.2g} m away, is outside"))
    figure.axes[1].set_title("the same from its right; axes: x solid, y dashed, z dotted")


def _space(
    panel: Any,
    hand_eye: HandEye,
    T: Array,
    others: Array,
    kept: "np.ndarray[tuple[int, ...], np.dtype[np.bool_]]",
    length: float,
    near: bool,
) -> None:
    few = _few(len(T))
    panel.plot(*T[few, :3, 3].T, "o", color=INK, ms=3, label=hand_eye.one)
    panel.plot(*others[few, :3, 3].T, "s", color=ACCENT, ms=3, label=hand_eye.two)
    panel.plot(*_strokes(T[few, :3, 3], others[few, :3, 3]), color=PALE, lw=0.8)
    _triads(panel, others[few], length, 0.8)
    if not kept.all():
        panel.plot(*others[~kept][:MAX_TRIADS, :3, 3].T, "x", color="black", ms=7, label="left out")
    if near:
        _triads(panel, np.eye(4)[None], 2.5 * length, 1.8)
        panel.plot([0], [0], [0], "D", color="black", ms=5, label=hand_eye.w1)
    if hand_eye.Z is not None:
        _triads(panel, hand_eye.Z[None], 2.5 * length, 1.8)
        panel.plot(*hand_eye.Z[:3, 3, None], "P", color="black", ms=6, label=hand_eye.w2)


def _few(n: int) -> Index:
    return np.unique(np.linspace(0, n - 1, min(n, MAX_TRIADS)).round().astype(np.intp))


def _triads(panel: Any, T: Array, length: float, width: float) -> None:
    for axis, (_, colour, dash) in enumerate(AXES):
        panel.plot(*_strokes(T[:, :3, 3], T[:, :3, 3] + length * T[:, :3, axis]), color=colour, ls=dash, lw=width)


def _strokes(start: Array, end: Array) -> Array:
    """Return strokes from start to end (k, 3) as one line (3, 3 k) that NaNs interrupt: quicker than k lines."""
    out: Array = np.stack([start, end, np.full_like(start, np.nan)], axis=1).reshape(-1, 3).T
    return out
