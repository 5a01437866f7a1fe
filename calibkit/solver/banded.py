"""A core whose unknowns stand in time order and meet only their neighbours: a banded matrix in LAPACK's lower storage."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve_banded, cholesky_banded, lapack

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Banded:
    """A symmetric (m k, m k) in lower storage: ab[d, j] = A[j + d, j]."""

    ab: Array  # (bandwidth + 1, m k)

    def damped(self, factor: float) -> "Banded":
        ab = self.ab.copy()
        ab[0] *= 1 + factor
        return Banded(ab)

    @cached_property
    def factor(self) -> Array:
        """Return L in lower storage, A = L L^T; LinAlgError where A is not positive definite."""
        found: Array = cholesky_banded(self.ab, lower=True, check_finite=False)
        return found

    def solve(self, right: Array) -> Array:
        """Return A^-1 right, (m, k, q)."""
        flat = right.reshape(-1, right.shape[-1])
        out: Array = cho_solve_banded((self.factor, True), flat, check_finite=False).reshape(right.shape)
        return out

    def draw(self, white: Array) -> Array:
        """Return L^-T white for white (m k,): a draw from N(0, A^-1) where white is one from N(0, I)."""
        out, _ = lapack.dtbtrs(self.factor, white[:, None], uplo="L", trans="T")
        return np.asarray(out[:, 0], np.float64)
