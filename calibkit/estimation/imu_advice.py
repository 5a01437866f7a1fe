"""Which attitudes an IMU was in, what they leave open, and which to add: in words."""

from itertools import product

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

NEEDED_POSITIONS = 9
_APART = np.deg2rad(20.0)
_VERTICAL = np.deg2rad(30.0)
_PLANE = 0.1  # rms of up out of the best plane
_MOST_ADDED = 12
_STAND_SIGMA = 1e-3  # of gravity, of a stand's |a|: what the advice reckons with
_KNOWN = 3e-3  # relative, of scale and axes: determined
_AXES = "xyz"


def positions(up: Array) -> list[int]:
    """Return the stands that count as positions: up differs by 20 deg or more from that of each other one."""
    kept: list[int] = []
    for i in range(len(up)):
        if all(up[i] @ up[k] < np.cos(_APART) for k in kept):
            kept.append(i)
    return kept


def what_is_missing(up: Array) -> list[str]:
    """Return what the attitudes leave out, each as a clause; none where they are well spread."""
    clauses = []
    never = [a for i, a in enumerate(_AXES) if np.max(np.abs(up[:, i])) < np.cos(_VERTICAL)]
    if never:
        which = f"the {never[0]} axis was" if len(never) == 1 else f"the axes {' and '.join(never)} were"
        clauses.append(f"{which} never within 30 deg of vertical")
    if plane_of(up) is not None:
        clauses.append("all positions lie in one plane, as if the device was turned about one axis only")
    for i, a in enumerate(_AXES):
        sides = [s for s, side in (("up", 1), ("down", -1)) if np.max(side * up[:, i]) >= np.cos(_VERTICAL)]
        if len(sides) == 1:
            clauses.append(f"the {a} axis pointed {sides[0]} but never {'down' if sides[0] == 'up' else 'up'}")
    count = len(positions(up))
    if count < NEEDED_POSITIONS:
        clauses.append(f"there are {count} different positions, and nine numbers need {NEEDED_POSITIONS} or more")
    return clauses


def plane_of(up: Array) -> Array | None:
    """Return the normal (3,) of the plane that all directions lie in, None where they do not."""
    deviations = up - up.mean(axis=0)
    values, vectors = np.linalg.eigh(deviations.T @ deviations / len(up))
    return vectors[:, 0] if np.sqrt(values[0]) < _PLANE else None


def _candidates() -> list[tuple[str, Array]]:
    """Return attitudes that a hand can find, in words and as up: an axis vertical, two at 45 deg, three alike."""
    out = []
    for signs in product((1, -1, 0), repeat=3):
        named = [f"{_AXES[i]} axis {'up' if s > 0 else 'down'}" for i, s in enumerate(signs) if s]
        if not named:
            continue
        tilt = {1: "", 2: " by 45 deg each", 3: " by 35 deg each"}[len(named)]
        out.append((" and ".join(named) + tilt, np.array(signs) / np.sqrt(len(named))))
    return sorted(out, key=lambda item: item[0].count("axis"))


def accel_rows(up: Array) -> Array:
    """Return d|a| / d(D, d) / g (n, 9) for scale and axes D (six, lower triangular) and bias d in g: u^T (dD u + dd)."""
    rows, columns = np.tril_indices(3)
    return np.column_stack([up[:, rows] * up[:, columns], up])


def positions_to_add(up: Array, sigma: float = _STAND_SIGMA) -> list[str]:
    """Return the attitudes to add, in words, each the one that lowers the accelerometer's variance most, until all nine are determined."""
    J = accel_rows(up[positions(up)])
    information = J.T @ J / sigma**2 + np.eye(9)  # one g of freedom where nothing is known
    choices = _candidates()
    rows = accel_rows(np.array([direction for _, direction in choices])) / sigma
    added: list[str] = []
    while len(added) < _MOST_ADDED:
        cov = np.linalg.inv(information)
        enough = len(positions(up)) + len(added) >= NEEDED_POSITIONS
        if enough and np.sqrt(np.max(np.diag(cov))) <= _KNOWN:
            break
        moved = rows @ cov
        gain = np.sum(moved**2, axis=1) / (1 + np.sum(moved * rows, axis=1))
        best = int(np.argmax(gain))
        added.append(choices[best][0])
        information += np.outer(rows[best], rows[best])
    return added


def turns_missing(R: Array) -> list[str]:
    """Return the axes about which the turns R (m, 3, 3) together bring less than 60 deg, as clauses."""
    way = np.zeros(3) if len(R) == 0 else np.sqrt(np.sum(R**2, axis=0))
    return [f"turns about the {a} axis are too few or too small" for a, w in zip(_AXES, way, strict=True) if w < np.deg2rad(60)]
