"""Rows of numbers that grow in place, for streams whose length is known only at their end."""

from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

S = TypeVar("S", bound=np.generic)


class Rows(Generic[S]):
    """An array that grows at its end: it is reallocated, which moves pages and not bytes, so no second copy is ever held."""

    def __init__(self, shape: tuple[int, ...], dtype: type[S]) -> None:
        self._shape = shape  # of one row
        self._array: NDArray[S] = np.empty((0, *shape), dtype)
        self._n = 0

    def add(self, rows: NDArray[S]) -> None:
        """Append rows (n, *shape)."""
        wanted = self._n + len(rows)
        if wanted > len(self._array):
            self._array.resize((max(wanted, wanted * 9 // 8), *self._shape), refcheck=False)
        self._array[self._n : wanted] = rows
        self._n = wanted

    def take(self) -> NDArray[S]:
        """Return the rows; nothing may be added afterwards."""
        self._array.resize((self._n, *self._shape), refcheck=False)
        return self._array
