"""Numbers with their nouns."""

import numpy as np
import pytest

from calibkit.data.plural import counted
from calibkit.estimation import doctor


@pytest.mark.parametrize(("n", "text"), [(0, "0 views"), (1, "1 view"), (2, "2 views")])
def test_one_is_singular(n: int, text: str) -> None:
    assert counted(n, "view") == text


def test_a_plural_of_its_own() -> None:
    assert [counted(n, "stamp goes", "stamps go") for n in (1, 2)] == ["1 stamp goes", "2 stamps go"]


def test_one_dark_image_is_dark() -> None:
    one, two = (doctor.check_images(np.array([0.01] * n + [0.5] * (3 - n)), np.ones(3))[0].text for n in (1, 2))
    assert one.startswith("1 of 3 sampled images is dark")
    assert two.startswith("2 of 3 sampled images are dark")
