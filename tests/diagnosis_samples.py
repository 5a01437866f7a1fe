"""What diagnoses of many seeds must say."""

from collections import Counter
from collections.abc import Sequence

import numpy as np

from calibkit.estimation.diagnosis import Cause, Diagnosis


def seeds_of(cause: str) -> int:
    """Return how many recordings to try: of noise alone more, since chance is rare."""
    return 20 if cause else 100


def right_size(cause: Cause, size: tuple[float, ...], sigmas: float) -> bool:
    off = np.abs(cause.theta - np.array(size)) / np.sqrt(np.diag(cause.cov))
    return bool(np.all(off < sigmas))


def check_many(name: str, cause: str, size: tuple[float, ...], found: Sequence[Diagnosis]) -> None:
    """The first cause is the injected one in 19 of 20, its size within 3 sigma; where none was, none is named in 99 of 100."""
    first = Counter(each.causes[0].key if each.causes else "" for each in found)
    sized = sum(right_size(each.causes[0], size, 3) for each in found if cause and each.causes and each.causes[0].key == cause)
    more = sum(len(each.causes) > 1 for each in found)
    print(f"{name}: {dict(first)}, {more} with others beside it, {sized} sized within 3 sigma")
    if cause:
        assert first[cause] >= 0.95 * len(found)
        assert sized >= 0.95 * first[cause]
    else:
        assert first[""] >= 0.99 * len(found) - 1  # 1 in 100 is the chance that was asked for
