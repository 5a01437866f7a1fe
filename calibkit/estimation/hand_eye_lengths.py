"""What the lengths of two sides' poses say against each other where their turns agree: a wrong unit, board or convention."""

import numpy as np

from calibkit.estimation.hand_eye import HandEyeFit
from calibkit.estimation.hand_eye_pairs import motions
from calibkit.geometry.so3 import Array

CLEARLY = 3.0  # times smaller: this fits and the other does not
_RESCALED = 0.005  # a length's error that is told
_PLAUSIBLE = (0.5, 2.0)  # of a board that was measured or printed wrongly
_UNIT = 0.1  # a unit's factor beside a board that is off, too
_ROUNDS = 10
_FLOOR = 1e-9
_FEWEST = 6  # motions
_TURNS_AGREE = np.deg2rad(1.0)
_PLACES_APART = 0.02  # m
_BEYOND_TURNS = 10.0  # times what the turns' residuals explain at the poses' reach
UNITS = (
    (1000.0, "the first side's poses are in mm, or the board's size is 1000 times too small: check --pose-unit and the target file"),
    (0.001, "the board's size is in mm, or the first side's poses are 1000 times too small: check the target file and --pose-unit"),
    (100.0, "the first side's poses are in cm: check --pose-unit"),
    (0.01, "the board's size is in cm: check the target file"),
    (1 / 0.0254, "the first side's poses are in inches: convert them to m"),
    (0.0254, "the board's size is in inches: check the target file"),
    (1 / 0.3048, "the first side's poses are in feet: convert them to m"),
    (0.3048, "the board's size is in feet: check the target file"),
)


def unit_of(s: float) -> str:
    """Return which unit a factor on side 2's lengths is that of, in words; nothing where it is none."""
    return next((text for factor, text in UNITS if abs(s / factor - 1) < _UNIT), "")


def length_ratio(fit: HandEyeFit) -> float | None:
    """Return s where side 2's lengths times s fit far better than as they are: (R_A - I) t_X = s R_X t_B - t_A; None where they fit.

    A board's wrong square, or millimetres taken for metres; no other s, and none where the turns do not agree. Least absolute values,
    by reweighting.
    """
    data = fit.data
    A, B = motions(data.P, fit.pairs), motions(data.Q, fit.pairs)
    M, t_A, t_B = A[:, :3, :3] - np.eye(3), A[:, :3, 3], B[:, :3, 3] @ fit.X[:3, :3].T
    if len(A) < _FEWEST or np.abs(t_B).max() < _FLOOR:
        return None
    as_is, _ = _least_absolute(M, t_B - t_A)
    free, x = _least_absolute(np.concatenate([M, -t_B[:, :, None]], axis=2), -t_A)
    s = float(x[3])
    told = _PLAUSIBLE[0] < s < _PLAUSIBLE[1] or unit_of(s) != ""
    return s if told and turns_agree(fit) and abs(s - 1) > _RESCALED and as_is > CLEARLY * free + _FLOOR else None


def turns_agree(fit: HandEyeFit) -> bool:
    """Return whether most turns are those of one X."""
    return bool(len(fit.pairs)) and bool(np.median(fit.pair_angle) < 2 * _TURNS_AGREE)


def places_disagree(fit: HandEyeFit) -> bool:
    """Return whether the turns are those of one X and the places are not, by far more than the turns' errors at the poses' reach."""
    if not fit.kept.any() or fit.n_worlds > 1:
        return False
    left = np.median(np.linalg.norm(fit.residual[fit.kept].reshape(-1, 2, 3), axis=2), axis=0)  # m, rad
    reach = float(np.median(np.linalg.norm(fit.data.P[fit.kept, :3, 3], axis=1)))
    return bool(left[1] < _TURNS_AGREE and left[0] > max(_PLACES_APART, _BEYOND_TURNS * left[1] * reach))


def _least_absolute(M: Array, y: Array) -> tuple[float, Array]:
    """Return the median residual and x of least sum |M_k x - y_k| for blocks M (k, 3, c) and y (k, 3)."""
    root: Array = np.ones(len(M))
    for _ in range(_ROUNDS):
        x = np.linalg.lstsq((M * root[:, None, None]).reshape(-1, M.shape[2]), (y * root[:, None]).ravel(), rcond=1e-9)[0]
        size = np.linalg.norm(M @ x - y, axis=1)
        root = 1 / np.sqrt(np.maximum(size, 1e-3 * np.median(size) + 1e-12))
    return float(np.median(size)), np.asarray(x, np.float64)
