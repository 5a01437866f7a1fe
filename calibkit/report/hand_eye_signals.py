"""The signals of a hand-eye calibration: what its poses leave over, how many were left out, how far they turned (numpy only)."""

import numpy as np

from calibkit.data.plural import counted
from calibkit.report.probe import Measured
from calibkit.report.view import View, given

TURNED = np.radians(1.0)  # least turn between two poses that has an axis to speak of


def pose_turn(view: View) -> Measured:
    """Return the rms turn that kept poses leave, deg."""
    return _left(view, np.degrees(np.linalg.norm(given(view.turn), axis=1)), "deg")


def pose_shift(view: View) -> Measured:
    """Return the rms shift that kept poses leave, mm."""
    return _left(view, 1e3 * np.linalg.norm(view.raw, axis=1), "mm")


def _left(view: View, size: "np.ndarray[tuple[int, ...], np.dtype[np.float64]]", unit: str) -> Measured:
    kept = size[view.kept]
    worst = int(np.argmax(np.where(view.kept, size, -1)))
    name = view.labels[given(view.frame)[worst]] if view.frame is not None else f"pose {worst + 1}"
    return Measured(float(np.sqrt(np.mean(kept**2))), f"worst of those kept: {name}, {size[worst]:.3g} {unit}")


def poses_dropped(view: View) -> Measured:
    """Return the share of poses that were left out, %."""
    n, kept = len(view.kept), int(view.kept.sum())
    return Measured(100 * (n - kept) / n, f"{n - kept} of {counted(n, 'pose')}")


def second_axis(view: View) -> Measured:
    """Return the rms turn about the second principal axis of the motions, deg: with one axis alone it is the noise."""
    motion = given(view.motion)[view.kept]
    if not np.any(np.linalg.norm(motion, axis=1) > TURNED):
        return Measured(0.0, "the poses hardly turn")
    rms = np.degrees(np.sqrt(np.maximum(np.linalg.eigvalsh(motion.T @ motion / len(motion))[::-1], 0)))
    return Measured(float(rms[1]), f"about the principal axes {rms[0]:.3g}, {rms[1]:.3g}, {rms[2]:.3g} deg rms between two poses")
