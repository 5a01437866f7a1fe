"""Which way round the poses are: camera on the gripper or beside the robot, poses or their inverses, by what fits far better.

P X = Z Q with both sides inverted is P^-1 Z = X Q^-1, the same problem with X and Z exchanged: of the four directions of two sides only two
can be told apart.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calibkit.data.plural import counted, plain
from calibkit.errors import BadInputError, NotObservableError
from calibkit.estimation.hand_eye import HandEyeFit, Settings, calibrate_hand_eye, select
from calibkit.estimation.hand_eye_data import HandEyeData
from calibkit.estimation.hand_eye_doubts import misfit, strangers
from calibkit.estimation.hand_eye_lengths import CLEARLY
from calibkit.geometry import se3
from calibkit.geometry.so3 import Array

_TRIED_ON = 200  # poses
_FEW = 10  # poses, that more of are asked for
_COPY = 1e-6  # m and rad: files keep as many digits
_CHECK = "which pose belongs to which image, --pose-format, --angle-unit, and the board"
# Whether P and Q are what was recorded or their inverses (hand_eye_world.SETUPS).
SIGNS = {"eye-in-hand": (1, -1), "eye-to-hand": (-1, -1), "motion": (1, 1)}
_WORDS = {
    "eye-in-hand": "eye-in-hand (the camera on the gripper)",
    "eye-to-hand": "eye-to-hand (the camera fixed, the board on the gripper)",
    "motion": "motion (two sensors)",
}
_HINTS = {
    "eye-in-hand": "if the camera is on the gripper",
    "eye-to-hand": "if the camera is fixed beside the robot",
}
_OTHER = {
    "eye-in-hand": f"--setup {_WORDS['eye-to-hand']}, or the same poses the other way round (--inverse-poses),",
    "eye-to-hand": f"--setup {_WORDS['eye-in-hand']}, or the same poses the other way round (--inverse-poses),",
    "motion": "one side's poses the other way round (--inverse-poses or --inverse-second)",
}


@dataclass(frozen=True)
class Choice:
    """The setup, how it was chosen, and what fits better still."""

    setup: str
    line: str = ""
    unconfirmed: str = ""  # what other poses it would be, where it was not asked for
    better: str = ""
    times: float = 1.0


def refuse_copies(first: Array, second: Array) -> None:
    """Raise BadInputError where both sides are the same poses (n, 4, 4), or their inverses: no two sensors agree so well."""
    moves = np.ptp(first, axis=0).max(initial=0) > _COPY
    if moves and any(np.allclose(first, other, rtol=0, atol=_COPY) for other in (second, se3.inverse(second))):
        raise BadInputError(
            "both sides have the same poses, whose X would be the identity without any error: was one file or topic given twice? "
            "give the second sensor's poses, or the board's"
        )


def choose_setup(first: Array, second: Array, asked: str | None, candidates: Sequence[str]) -> Choice:
    """Return the setup asked for or the one candidate that leaves far less, from T_base_gripper and T_cam_target (n, 4, 4).

    NotObservableError where none does clearly; BadInputError where the sides do not belong together, or no poses tell candidates apart.
    """
    if strangers(first, second):
        check = "that both are of one body and one recording" if tuple(candidates) == ("motion",) else _CHECK
        raise BadInputError(
            "the turns between poses of the two sides are no more alike than chance: they do not belong together, or one side is read "
            f"wrongly; check {check}"
        )
    left = {sign: _left(first, second, sign) for sign in (1, -1)}
    sign_of = {setup: SIGNS[setup][0] * SIGNS[setup][1] for setup in SIGNS}
    best = 1 if left[1] < left[-1] else -1
    times = left[-best] / left[best]
    if asked is None:
        able = [setup for setup in candidates if sign_of[setup] == best] if len(candidates) > 1 else list(candidates)
        if len(candidates) > 1 and times < CLEARLY:
            able = list(candidates)
        if len(able) > 1:
            few = len(first) < _FEW
            who, more = (f"{counted(len(first), 'pose')} do", "10 or more are needed; or ") if few else ("the poses do", "")
            text = f"{who} not tell {' from '.join(able)}: {more}give --setup {' or '.join(able)}"
            raise NotObservableError(text) if times < CLEARLY else BadInputError(text)  # of the same sign no poses tell them apart
        asked = able[0]
        if len(candidates) > 1:
            others = [setup for setup in candidates if setup != asked]
            return Choice(asked, _chosen(asked, times, others), _unconfirmed(asked, others))
    if sign_of[asked] != best and times > CLEARLY:
        return Choice(asked, better=_OTHER[asked], times=times)
    return Choice(asked)


def choose_fit(fits: Mapping[str, HandEyeFit]) -> Choice:
    """Return the setup whose own pairs leave far less; NotObservableError where none does clearly."""
    left = {setup: misfit(fit) for setup, fit in fits.items()}
    ranked = sorted(left, key=lambda setup: left[setup])
    if len(ranked) == 1:
        return Choice(ranked[0])
    times = left[ranked[1]] / left[ranked[0]]
    if times < CLEARLY:
        raise NotObservableError(f"the poses do not tell {' from '.join(ranked)}: give --setup {' or '.join(ranked)}")
    return Choice(ranked[0], _chosen(ranked[0], times, ranked[1:2]), _unconfirmed(ranked[0], ranked[1:2]))


def _chosen(setup: str, times: float, others: Sequence[str]) -> str:
    return f"{_WORDS[setup]}: it fits {plain(times)} times better than {' or '.join(others)}"


def _unconfirmed(setup: str, others: Sequence[str]) -> str:
    """Return what a setup that was not asked for rests on: the poses the other way round make the other one fit as well."""
    other = next((other for other in others if other in _HINTS), "")
    if not other:
        return ""
    text = f"taken as {setup}, for poses T_base_gripper; no data tell them from the other way round: {_HINTS[other]}, the poses"
    return f"{text} are the other way round: --setup {other} --inverse-poses; else confirm it with --setup {setup}"


def _left(first: Array, second: Array, sign: int) -> float:
    """Return what the poses leave, the second side as it is (1) or inverted (-1)."""
    rows = np.unique(np.linspace(0, len(first) - 1, min(len(first), _TRIED_ON)).round().astype(np.intp))
    data = HandEyeData("motion", first, second if sign > 0 else se3.inverse(second))
    return misfit(calibrate_hand_eye(select(data, rows), Settings(drift=False, methods=False)))
