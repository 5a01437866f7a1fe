"""What makes thousands of poses fast: inverses, sums and least squares of whole batches, against one at a time."""

import numpy as np
import pytest

from calibkit.estimation.hand_eye_data import HandEyeData
from calibkit.estimation.hand_eye_linear import null_space, solve
from calibkit.estimation.hand_eye_normal import inverse


def test_inverses_of_covariances_are_lapacks_also_where_units_differ() -> None:
    A = np.random.default_rng(0).normal(size=(50, 6, 9)) * np.repeat([1.0, 1e-5], 3)[:, None]
    C = A @ np.swapaxes(A, 1, 2)
    units = 1 / np.sqrt(np.einsum("nii->ni", C))
    scaled = inverse(C) / units[:, :, None] / units[:, None, :]
    np.testing.assert_allclose(scaled, np.linalg.inv(C * units[:, :, None] * units[:, None, :]), rtol=1e-9, atol=1e-9)


def test_a_covariance_of_nothing_is_refused() -> None:
    with pytest.raises(np.linalg.LinAlgError):
        inverse(np.stack([np.eye(6), np.zeros((6, 6))]))


def test_sums_are_those_of_each_world_in_any_order() -> None:
    rng = np.random.default_rng(1)
    world = rng.permutation(np.repeat(np.arange(4), [1, 2, 3, 5]))
    poses, values = np.tile(np.eye(4), (11, 1, 1)), rng.normal(size=(11, 2, 3))
    sums = HandEyeData("motion", poses, poses, world=world).sum_by_world(values)
    np.testing.assert_allclose(sums, [values[world == w].sum(axis=0) for w in range(4)], rtol=0, atol=1e-14)


@pytest.mark.parametrize("n", [40, 511, 512, 1000])
def test_least_squares_of_many_rows_in_pieces_are_those_of_all(n: int) -> None:
    rng = np.random.default_rng(2)
    M, y = rng.normal(size=(3, n, 5)), rng.normal(size=(3, n))
    expected = [np.linalg.lstsq(a, b, rcond=None)[0] for a, b in zip(M, y, strict=True)]
    np.testing.assert_allclose(solve(M, y), expected, rtol=0, atol=1e-12)
    smallest = np.array([np.linalg.svd(a)[2][-1] for a in M])
    np.testing.assert_allclose(np.abs(np.sum(null_space(M, 1)[:, 0] * smallest, axis=1)), 1, rtol=0, atol=1e-10)
