"""Pieces of the joint estimator's normal equations: what a few neighbouring knots and some of the border say to each other."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from calibkit.geometry.so3 import Array
from calibkit.solver.arrowhead import Arrowhead
from calibkit.solver.banded import Banded

Index = NDArray[np.int64]


@dataclass(frozen=True)
class Part:
    """Products N = K^T K of columns K = [core | border | residual], whitened, of n epochs."""

    kind: str
    t_s: Array  # (n,) time of each epoch
    first: Index  # (n,) of the core's unknowns, that the offsets count from
    offsets: Index  # (q,) increasing, of the core's columns
    touch: Index  # (b,) the border's columns
    N: Array  # (n, q + b + 1, q + b + 1)
    cost: float
    rows: int  # residuals that count

    @property
    def columns(self) -> Index:
        """Return each epoch's unknowns of the core, (n, q)."""
        return self.first[:, None] + self.offsets


@lru_cache
def _lower(q: int) -> tuple[Index, Index]:
    return np.tril_indices(q)


def assemble(parts: Iterable[Part], knots: int, knot: int, width: int, p: int) -> tuple[float, Arrowhead]:
    """Return the cost and the normal equations of all parts; a knot has so many unknowns, and width knots meet in the core."""
    size, cost = knot * knots, 0.0
    band = np.zeros(knot * width * size)
    B, C, g_x, g_c = np.zeros((size, p)), np.zeros((p, p)), np.zeros(size), np.zeros(p)
    for part in parts:
        q, touch = len(part.offsets), part.touch
        column = part.columns
        rows, columns = _lower(q)  # lower storage: ab[row - column, column]
        place = part.first[:, None] + (part.offsets[columns] + (part.offsets[rows] - part.offsets[columns]) * size)
        np.add.at(band, place.ravel(), part.N[:, rows, columns].ravel())
        np.add.at(g_x, column.ravel(), part.N[:, :q, -1].ravel())
        if len(touch):
            np.add.at(B.reshape(-1), (column[:, :, None] * p + touch).ravel(), part.N[:, :q, q:-1].ravel())
            total = part.N[:, q:].sum(axis=0)
            C[np.ix_(touch, touch)] += total[:-1, q:-1]
            g_c[touch] += total[:-1, -1]
        cost += part.cost
    core = Banded(band.reshape(knot * width, size))
    return cost, Arrowhead(core, B.reshape(knots, knot, p), C, g_x.reshape(knots, knot), g_c)


def projected(part: Part, core_answer: Array) -> tuple[Array, Array]:
    """Return each epoch's information about the border (n, p, p) and its score (n, p), the core answering by dx = -core_answer dc.

    core_answer is A^-1 B (m knot, p): K_c - K_x A^-1 B are the border's columns once the core is eliminated.
    """
    p, q = core_answer.shape[1], len(part.offsets)
    P = np.empty((len(part.first), q + len(part.touch), p))
    P[:, :q] = -core_answer[part.columns]
    P[:, q:] = np.eye(p)[part.touch]
    PT = np.swapaxes(P, 1, 2)
    return PT @ part.N[:, :-1, :-1] @ P, (PT @ part.N[:, :-1, -1:])[..., 0]


@dataclass(frozen=True)
class Epochs:
    """What each epoch of the measurements says of the border, the core eliminated."""

    t_s: Array  # (n,)
    information: Array  # (n, p, p)
    score: Array  # (n, p)

    @classmethod
    def of(cls, parts: Iterable[Part], core_answer: Array) -> "Epochs":
        """Return the epochs of the parts but those that no measurement made."""
        measured = [part for part in parts if part.kind != "stays"]
        information, score = zip(*(projected(part, core_answer) for part in measured), strict=True)
        return cls(np.concatenate([part.t_s for part in measured]), np.concatenate(information), np.concatenate(score))
