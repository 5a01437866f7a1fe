"""What may be wrong with hand-eye poses, guessed from what they leave over: for single poses, and for all of them."""

from dataclasses import dataclass, replace

import numpy as np

from calibkit.data.plural import counted
from calibkit.errors import one_line
from calibkit.estimation.hand_eye import HandEyeFit
from calibkit.estimation.hand_eye_data import HandEyeData, Index
from calibkit.estimation.hand_eye_lengths import CLEARLY
from calibkit.estimation.hand_eye_pairs import motions, screw_mismatch
from calibkit.geometry import se3, so3
from calibkit.geometry.so3 import Array

_NEAR = 5.0  # times what is left of the kept poses
_TURNS = {90: "a quarter", 180: "half"}  # deg, that a board looks alike after
_TURN_TOLERANCE = np.deg2rad(5.0)
_NORMAL = 0.95  # cosine to the board's normal
_FAST = 3.0  # times the middle speed
_FLOOR = 1e-9
_TOLD = 20  # wrong poses that are looked into
_ASKED, _FEW = 300, 6  # poses whose angles are compared, and fewer that tell nothing
_ORDERS = 9
_ALIKE = 0.5  # of what chance leaves
_TELLING = np.deg2rad(0.5)  # poses that turn less are alike in any order


@dataclass(frozen=True)
class Suspect:
    """A pose that was left out and why, perhaps."""

    row: int
    label: str
    angle: float  # rad
    distance: float  # m
    why: str


def misfit(fit: HandEyeFit) -> float:
    """Return the geometric mean of the median angle (rad) and distance (m) that all poses leave: to be compared between hypotheses."""
    phi, rho = (np.median(np.linalg.norm(fit.residual[:, part], axis=1)) for part in (slice(3, 6), slice(0, 3)))
    return float(np.sqrt((phi + _FLOOR) * (rho + _FLOOR)))


def suspects(fit: HandEyeFit) -> tuple[Suspect, ...]:
    """Return the poses that were left out, the worst first, each with a guess."""
    out = np.flatnonzero(~fit.kept)
    out = out[np.argsort(-fit.chi2[out], kind="stable")]
    guesses = _guesses(fit, out[:_TOLD]) if len(out) else {}
    size = np.linalg.norm(fit.residual.reshape(-1, 2, 3), axis=2)
    return tuple(Suspect(int(i), fit.data.labels[i], float(size[i, 1]), float(size[i, 0]), guesses.get(int(i), "")) for i in out)


def _guesses(fit: HandEyeFit, rows: Index) -> dict[int, str]:
    data = fit.data
    if not fit.kept.any() or fit.Z is None or not data.words.Q_at_world:  # of two moving sensors there is no more to be said
        return {}
    limit = _NEAR * np.maximum(np.median(np.abs(fit.residual[fit.kept]).reshape(-1, 2, 3).max(axis=2), axis=0), 1e-6)  # m, rad
    off = se3.inverse(fit.Z) @ data.P[rows] @ fit.X @ se3.inverse(data.Q[rows])  # in world 2, the board's frame
    expected = fit.Z @ data.Q[rows] @ se3.inverse(fit.X)
    speed = _speeds(data)
    middle = float(np.median(speed[fit.kept])) if speed is not None else 0.0
    turn = so3.log(off[:, :3, :3])
    angle = np.linalg.norm(turn, axis=1)
    found: dict[int, str] = {}
    for k, i in enumerate(rows):
        other = _near(expected[k], data.P, limit)
        same = [int(rows[j]) for j in _near(off[k], off, 2 * limit) if j != k]
        flat = angle[k] > 0 and abs(turn[k, 2]) > _NORMAL * angle[k]
        flips = [word for deg, word in _TURNS.items() if flat and abs(angle[k] - np.deg2rad(deg)) < _TURN_TOLERANCE]
        if len(other) and i not in other:
            found[int(i)] = f"it fits the pose of {_label(data, other[0])}: are poses and images paired wrongly?"
        elif flips:
            found[int(i)] = f"the board was read turned by {flips[0]} turn: use a board that looks the same from one side only"
        elif same:
            them = ", ".join(_label(data, j) for j in same[:3])
            found[int(i)] = f"moved as in {them}: was the board or the camera touched?"
        elif speed is not None and speed[i] > _FAST * middle > 0:
            found[int(i)] = "it moved fast there: a lag between the two, or a blurred image"
        elif np.linalg.norm(fit.residual[i, 3:]) < limit[1]:
            found[int(i)] = "the place is off, the turn is not: an axis off its reading, or wrong corners"
        else:
            found[int(i)] = "pose and image are not of one moment, or the corners are wrong"
    return found


def _near(T: Array, those: Array, limit: Array) -> Index:
    """Return which poses lie within limits (m, rad) of T, the nearest first."""
    apart = np.linalg.norm(se3.local(T, those).reshape(-1, 2, 3), axis=2) / limit
    worse = apart.max(axis=1)
    order: Index = np.argsort(worse, kind="stable")
    return order[: int(np.sum(worse < 1))]


def _label(data: HandEyeData, row: int) -> str:
    return one_line(data.labels[row], 60)


def _speeds(data: HandEyeData) -> Array | None:
    """Return how fast frame 1 moved at each pose (n,), m/s with 1 rad as 1 m; None without times."""
    if data.t_s is None or len(data.t_s) < 3 or np.ptp(data.t_s) == 0:
        return None
    order = np.argsort(data.t_s, kind="stable")
    step = np.linalg.norm(se3.local(data.P[order[:-1]], data.P[order[1:]]), axis=1) / np.maximum(np.diff(data.t_s[order]), 1e-3)
    out = np.empty(len(order))
    out[order] = np.minimum(np.append(step, step[-1]), np.append(step[0], step))
    return out


def out_of_step(data: HandEyeData) -> int:
    """Return by how many places side 1 is behind side 2 where that fits far better by angles alone (which no X changes), else 0."""
    n = len(data.P)
    if n < _FEW or data.n_worlds > 1:
        return 0
    left = {}
    for step in (-1, 0, 1):
        rows = np.arange(max(0, step), min(n, n + step))
        left[step] = _angles_apart(_beside(data, rows, rows - step))
    best = min(left, key=lambda step: left[step])
    return best if left[best] * CLEARLY < left[0] else 0


def strangers(first: Array, second: Array) -> bool:
    """Return whether the angles between poses (n, 4, 4) of two sides, which no X and no setup changes, are no more alike than in any order.

    The better quarter of them counts: with 40 % wrong poses it is still right. Sides that are one place out of step belong together.
    """
    a, b = (_turns(T[:_ASKED]) for T in (first, second))
    n = len(a)
    if n < _FEW:
        return False
    rng = np.random.default_rng(0)
    orders = [rng.permutation(n) for _ in range(_ORDERS)]
    by_chance = float(np.median([_unlike(a, b[np.ix_(order, order)]) for order in orders]))
    left = min(_unlike(a, b), _unlike(a[1:, 1:], b[:-1, :-1]), _unlike(a[:-1, :-1], b[1:, 1:]))
    return by_chance > _TELLING and left > _ALIKE * by_chance


def _turns(T: Array) -> Array:
    """Return the angle between every two poses (n, n)."""
    R = T[:, :3, :3]
    cosine = (np.einsum("iab,jab->ij", R, R) - 1) / 2
    out: Array = np.arccos(np.clip(cosine, -1, 1))
    return out


def _unlike(a: Array, b: Array) -> float:
    return float(np.quantile(np.abs(a - b)[np.triu_indices(len(a), 1)], 0.25))


def _beside(data: HandEyeData, first: Index, second: Index) -> HandEyeData:
    """Return the problem with side 1's rows `first` beside side 2's rows `second`."""
    t_s = None if data.t_s is None else data.t_s[second]
    labels = tuple(data.labels[i] for i in second)
    return replace(
        data, P=data.P[first], Q=data.Q[second], cov_P=None, cov_Q=None, t_s=t_s, labels=labels, world=np.zeros(len(first), np.intp)
    )


def _angles_apart(data: HandEyeData) -> float:
    """Return the median |angle_A - angle_B| over motions between poses 1, 2, 3, 5, 8 places apart."""
    n = len(data.P)
    pairs = np.concatenate([np.stack([np.arange(n - d), np.arange(d, n)], axis=1) for d in (1, 2, 3, 5, 8) if d < n])
    return float(np.median(np.abs(screw_mismatch(motions(data.P, pairs), motions(data.Q, pairs))[0]))) + 1e-6


def told_step(step: int) -> str:
    """Return an offset in the order of the poses in words."""
    where = "after" if step > 0 else "before"
    rows = counted(abs(step), "row")
    return f"the second side's poses fit the first side's {rows} {where} their own far better: the files are out of step"
