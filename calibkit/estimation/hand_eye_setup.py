"""Which way round the poses are: camera on the gripper or beside the robot, poses or their inverses, by what fits far better."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calibkit.errors import BadInputError
from calibkit.estimation.hand_eye import HandEyeFit, Settings, calibrate_hand_eye, select
from calibkit.estimation.hand_eye_data import HandEyeData
from calibkit.estimation.hand_eye_doubts import CLEARLY, misfit
from calibkit.geometry import se3
from calibkit.geometry.so3 import Array

_TRIED_ON = 200  # poses
# Whether P and Q are what was recorded or their inverses (hand_eye_world.SETUPS).
SIGNS = {"eye-in-hand": (1, -1), "eye-to-hand": (-1, -1), "motion": (1, 1)}
_WHICH = {
    (-1, 1): "the first side's poses the other way round (--inverse-poses)",
    (1, -1): "the second side's poses the other way round (--inverse-second)",
    (-1, -1): "both sides' poses the other way round (--inverse-poses --inverse-second)",
}
_SETUP_WORDS = {
    "eye-in-hand": "eye-in-hand (the camera on the gripper)",
    "eye-to-hand": "eye-to-hand (the camera fixed, the board on the gripper)",
}


@dataclass(frozen=True)
class Choice:
    """The setup, how it was chosen, and what fits better still."""

    setup: str
    line: str = ""
    better: str = ""
    times: float = 1.0


def choose_setup(first: Array, second: Array, asked: str | None, candidates: Sequence[str]) -> Choice:
    """Return the setup asked for or the candidate that leaves far less, from T_base_gripper and T_cam_target (n, 4, 4).

    Of all four directions of the two sides that one is named which fits better still. BadInputError where none does clearly.
    """
    left = {(p, q): _left(first, second, p, q) for p in (1, -1) for q in (1, -1)}
    ranked = sorted(candidates, key=lambda setup: left[SIGNS[setup]])
    setup, line = asked or ranked[0], ""
    if asked is None and len(ranked) > 1:
        line = _clearly(ranked, left[SIGNS[ranked[1]]] / left[SIGNS[setup]])
        if set(candidates) <= set(_SETUP_WORDS):
            line += "; with the poses the other way round (T_gripper_base) it would be the other one"
    own = left[SIGNS[setup]]
    best = min(left, key=lambda signs: left[signs])
    times = own / left[best]
    if times < CLEARLY:
        return Choice(setup, line)
    flips = (best[0] * SIGNS[setup][0], best[1] * SIGNS[setup][1])
    better = _WHICH[flips]
    other = next((name for name in candidates if SIGNS[name] == best and name != setup), None)
    return Choice(setup, line, f"--setup {_SETUP_WORDS.get(other, other)}, or {better}," if other else better, times)


def choose_fit(fits: Mapping[str, HandEyeFit]) -> tuple[str, str]:
    """Return the setup whose own pairs leave far less, and how it was chosen; BadInputError where none does clearly."""
    left = {setup: misfit(fit) for setup, fit in fits.items()}
    ranked = sorted(left, key=lambda setup: left[setup])
    return ranked[0], _clearly(ranked, left[ranked[1]] / left[ranked[0]]) if len(ranked) > 1 else ""


def _clearly(ranked: Sequence[str], times: float) -> str:
    if times < CLEARLY:
        asked = " or ".join(ranked)
        raise BadInputError(f"the poses do not tell {' from '.join(ranked)} ({times:.2g} times better): give --setup {asked}")
    return f"{_SETUP_WORDS.get(ranked[0], ranked[0])}: it fits {times:.3g} times better than {ranked[1]}"


def _thinned(data: HandEyeData) -> HandEyeData:
    return select(data, np.unique(np.linspace(0, len(data.P) - 1, min(len(data.P), _TRIED_ON)).round().astype(np.intp)))


def _left(first: Array, second: Array, p: int, q: int) -> float:
    """Return what the poses leave, each side as it is (1) or inverted (-1)."""
    P, Q = (T if sign > 0 else se3.inverse(T) for T, sign in ((first, p), (second, q)))
    return misfit(calibrate_hand_eye(_thinned(HandEyeData("motion", P, Q)), Settings(drift=False, methods=False)))
