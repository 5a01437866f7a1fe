"""What a settled alignment says of single axes: which of the rotation it leaves open, how far each turns, and each one's own offset."""

import numpy as np

from calibkit.estimation.alignment import PRIOR, Alignment, columns, gram
from calibkit.estimation.turn_comparison import linearised
from calibkit.geometry.so3 import Array

_OPEN = 1e-4  # of the best axis' information: a hundredth of the turns, which noise and a lens' errors are worth
_KNOWN, _WELL = 0.03, 0.01  # rad, or of an axis' length


def open_axes(a: Alignment) -> Array:
    """Return the axes (k, 3) in the frame of the turns about which they hardly tell the rotation: all turning is about another one."""
    if not a.free_rotation or len(a.R) != 3:
        return np.zeros((0, 3))
    values, vectors = np.linalg.eigh(gram(columns(a))[:3, :3])
    axes = vectors[:, (values < _OPEN * values[-1]) | (values < _KNOWN**-2)].T
    return np.asarray(axes * np.sign(axes[np.arange(len(axes)), np.argmax(np.abs(axes), axis=1)])[:, None], np.float64)


def length_of_axis(a: Alignment) -> float:
    """Return the length of the one axis R (1, 3): of all of it or of what is well known of it, whichever is nearer to 1.

    Where a vehicle stays level its turns tell one component of the axis; noise in the others would lengthen it.
    """
    values, vectors = np.linalg.eigh(gram(columns(a))[:3, :3])
    known = np.linalg.norm(a.R @ vectors[:, values > _WELL**-2])
    whole = np.linalg.norm(a.R)
    return 1.0 if (whole - 1) * (known - 1) < 0 else float(min(whole, known, key=lambda length: abs(length - 1)))


def turned_by(a: Alignment) -> tuple[Array, Array]:
    """Return the whitened turns (rows,), and those that the track predicts for them."""
    own = [part.own for part in a.parts]
    other = [part.clean(part.stretch.beta(a.track, a.shift(part.stretch.t)[:, None])[:, 0] @ a.R.T) for part in a.parts]
    return np.concatenate(own), np.concatenate(other)


def axis_offsets(a: Alignment) -> tuple[Array, Array]:
    """Return the offset of each measured axis less tau (d,) s, and their covariance (d, d) s^2, the rotation fitted anew with them.

    An axis about which nothing turns has 0 +- 1 s.
    """
    d = len(a.R)
    H = np.zeros((4 + d, 4 + d))
    for part in a.parts:
        X = linearised(part, a.track, a.R, a.shift(part.stretch.t), by_axis=True)
        H += X.T @ X
    H[:-1, :-1] += np.diag([*PRIOR[:3], *np.ones(d)])
    free = np.arange(0 if a.free_rotation else 3, 3 + d)
    scale = 1 / np.sqrt(np.diag(H)[free])
    cov = np.linalg.inv(H[np.ix_(free, free)] * scale[:, None] * scale) * scale[:, None] * scale
    return (cov @ H[free, -1])[-d:], cov[-d:, -d:]
