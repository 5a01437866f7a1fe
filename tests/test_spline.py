"""B-splines against scipy's, and their Jacobians against differences."""

import numpy as np
import pytest
from scipy.interpolate import BSpline

from calibkit.geometry import so3
from calibkit.geometry.so3 import Array
from calibkit.geometry.spline import Knots, Steps, Turning, basis, blending, turning

ORDERS = pytest.mark.parametrize("order", [2, 3, 4, 5, 6])


def drawn(order: int, size: float = 0.3, segments: int = 7) -> tuple[Knots, Array, Array]:
    """Return knots, control rotations that wander, and times inside."""
    rng = np.random.default_rng(order)
    knots = Knots(2.0, 0.05, order, segments)
    R = [so3.exp(rng.standard_normal(3))]
    for _ in range(knots.controls - 1):
        R.append(R[-1] @ so3.exp(size * rng.standard_normal(3)))
    return knots, np.array(R), rng.uniform(2.0, 2.0 + 0.05 * segments, 40)


def at(knots: Knots, R: Array, t: Array) -> Turning:
    i, u = knots.locate(t)
    return turning(R, Steps.of(R), i, basis(knots, u), basis(knots, u, 1))


@ORDERS
@pytest.mark.parametrize("derivative", [0, 1, 2, 3])
def test_the_basis_is_scipys(order: int, derivative: int) -> None:
    knots, _, t = drawn(order)
    x = np.random.default_rng(1).standard_normal((knots.controls, 3))
    at_knots = knots.start + knots.spacing * (np.arange(knots.controls + order) - order + 1)
    i, u = knots.locate(t)
    ours = np.einsum("nl,nlk->nk", basis(knots, u, derivative), x[i[:, None] + np.arange(order)])
    if derivative >= order:
        np.testing.assert_array_equal(ours, 0)
        return
    np.testing.assert_allclose(ours, BSpline(at_knots, x, order - 1)(t, derivative), rtol=1e-9, atol=1e-9 / knots.spacing**derivative)


@ORDERS
def test_the_basis_sums_to_one(order: int) -> None:
    np.testing.assert_allclose(blending(order).sum(axis=0), np.eye(order)[0], atol=1e-12)


@ORDERS
def test_one_axis_is_a_spline_of_angles(order: int) -> None:
    knots, _, t = drawn(order)
    angle = np.cumsum(np.random.default_rng(3).uniform(-2.5, 2.5, knots.controls))
    axis = np.array([0.6, 0.0, 0.8])
    R = so3.exp(angle[:, None] * axis)
    got = at(knots, R, t)
    i, u = knots.locate(t)
    local = angle[i[:, None] + np.arange(order)]
    np.testing.assert_allclose(got.R, so3.exp(np.sum(basis(knots, u) * local, axis=1)[:, None] * axis), atol=1e-10)
    np.testing.assert_allclose(got.omega, np.sum(basis(knots, u, 1) * local, axis=1)[:, None] * axis, atol=1e-8)


@ORDERS
def test_the_rate_is_the_rotations_derivative(order: int) -> None:
    knots, R, t = drawn(order)
    inside = np.abs((t - knots.start) / knots.spacing % 1 - 0.5) < 0.49  # a difference may not reach over a knot
    t, h = t[inside], 1e-6
    before, after = at(knots, R, t - h).R, at(knots, R, t + h).R
    np.testing.assert_allclose(at(knots, R, t).omega, so3.log(np.swapaxes(before, 1, 2) @ after) / (2 * h), rtol=1e-5, atol=1e-4)


@ORDERS
@pytest.mark.parametrize("size", [1e-9, 0.01, 0.3, 0.8])
def test_jacobians_are_those_of_differences(order: int, size: float) -> None:
    knots, R, t = drawn(order, size)
    i, _ = knots.locate(t)
    got, h = at(knots, R, t), 1e-6
    for control in range(knots.controls):
        for axis in range(3):
            step = h * np.eye(3)[axis]
            moved = [at(knots, np.concatenate([R[:control], [R[control] @ so3.exp(sign * step)], R[control + 1 :]]), t) for sign in (-1, 1)]
            dR = so3.log(np.swapaxes(moved[0].R, 1, 2) @ moved[1].R) / (2 * h)
            domega = (moved[1].omega - moved[0].omega) / (2 * h)
            place = control - i
            here = (place >= 0) & (place < order)
            expected = np.where(here[:, None], got.dR[np.arange(len(t)), :, np.clip(place, 0, order - 1), axis], 0.0)
            np.testing.assert_allclose(dR, expected, atol=2e-8)
            expected = np.where(here[:, None], got.domega[np.arange(len(t)), :, np.clip(place, 0, order - 1), axis], 0.0)
            np.testing.assert_allclose(domega, expected, atol=3e-6 * (1 + 1 / knots.spacing))
