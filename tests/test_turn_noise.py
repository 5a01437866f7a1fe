"""The noise of turns: its bands against dense matrices and against draws, and how much of each kind there is."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from calibkit.data.observations import ImuSamples, PoseSamples
from calibkit.estimation.turn_noise import NoiseLevels, TurnNoise, estimate_levels, turn_noise
from calibkit.estimation.turns import Turns, in_order, turns_of_gyro, turns_of_orientations, turns_of_poses
from calibkit.geometry import so3

Array = NDArray[np.float64]
RNG = np.random.default_rng
LEVELS = NoiseLevels(2e-6, 3e-6, 4e-6)


def random_cov(n: int, rng: np.random.Generator) -> Array:
    """Covariances (n, 3, 3), up to 30 times longer than wide."""
    A = rng.standard_normal((n, 3, 3)) * [1.0, 0.3, 0.1]
    out: Array = A @ np.swapaxes(A, 1, 2) + 0.01 * np.eye(3)
    return out


def some_turns(seed: int, n: int = 40, size: float = 1.0, covariances: bool = True, gaps: bool = True) -> Turns:
    """Turns of up to `size` rad at 20 Hz, one in ten missing."""
    rng = RNG(seed)
    angle = rng.standard_normal((n, 3))
    angle *= size * rng.uniform(0.0, 1.0, (n, 1)) / np.linalg.norm(angle, axis=1, keepdims=True)
    keep = np.flatnonzero(rng.random(n) > 0.1) if gaps else np.arange(n)
    t_ns = np.arange(n + 1) * 50_000_000 + rng.integers(0, 5_000_000, n + 1)
    end, own = (random_cov(n + 1, rng), random_cov(len(keep), rng)) if covariances else (None, None)
    return Turns(t_ns, keep, keep + 1, angle[keep], end, own)


def dense(turns: Turns, levels: NoiseLevels, omega: Array, shape: Array) -> Array:
    """The covariance of all turns (3 n, 3 n), by the linear map from the errors of stamps to those of turns."""
    n, m = len(turns.first), len(turns.t_ns)
    G = np.linalg.inv(so3.right_jacobian(turns.angle))
    J = np.zeros((n, 3, m, 3))
    k = np.arange(n)
    J[k, :, turns.last] = G
    J[k, :, turns.first] = -np.swapaxes(G, 1, 2)
    J = J.reshape(3 * n, 3 * m)
    P, own = np.zeros((m, 3, m, 3)), np.zeros((n, 3, n, 3))
    ends = np.tile(np.diag(shape), (m, 1, 1)) if turns.end_cov is None else turns.end_cov
    i = np.arange(m)
    P[i, :, i] = levels.end * ends + levels.jitter * omega[:, :, None] * omega[:, None]
    white = turns.duration[:, None, None] * (np.diag(shape) if turns.end_cov is None else np.eye(3))
    own[k, :, k] = levels.own * (white if turns.own_cov is None else turns.own_cov)
    out: Array = J @ P.reshape(3 * m, 3 * m) @ J.T + own.reshape(3 * n, 3 * n)
    return out


def full(band: Array) -> Array:
    """A symmetric matrix from its lower band."""
    out = np.zeros((band.shape[1], band.shape[1]))
    for k, diagonal in enumerate(band):
        out += np.diag(diagonal[: len(diagonal) - k], -k)
    lower = np.tril(out, -1)
    return out + lower.T


@pytest.mark.parametrize("covariances", [True, False])
@pytest.mark.parametrize("axes", [(True, True, True), (False, False, True), (True, False, True)])
@pytest.mark.parametrize("size", [1e-9, 1e-3, 1.0, 2.3])
def test_bands_are_those_of_the_dense_covariance(covariances: bool, axes: tuple[bool, bool, bool], size: float) -> None:
    turns = replace(some_turns(1, size=size, covariances=covariances), axes=axes)
    omega, shape = RNG(2).standard_normal((len(turns.t_ns), 3)), np.array([0.5, 1.0, 1.5])
    rows = np.flatnonzero(np.tile(axes, len(turns.first)))
    expected = dense(turns, LEVELS, omega, shape)[np.ix_(rows, rows)]
    noise = turn_noise(turns, omega, shape)
    np.testing.assert_allclose(full(noise.band(LEVELS)), expected, rtol=1e-9, atol=1e-12 * np.abs(expected).max())
    d = sum(axes)
    blocks = expected.reshape(len(turns.first), d, len(turns.first), d)
    k = np.arange(len(turns.first))
    np.testing.assert_allclose(noise.blocks(LEVELS, d), blocks[k, :, k], rtol=1e-9, atol=1e-12 * np.abs(expected).max())


def test_whitening_is_that_of_the_dense_covariance() -> None:
    turns = some_turns(3)
    omega = RNG(4).standard_normal((len(turns.t_ns), 3))
    V = dense(turns, LEVELS, omega, np.ones(3))
    whiten = turn_noise(turns, omega, np.ones(3)).whitener(LEVELS)
    x = RNG(5).standard_normal((len(V), 4))
    np.testing.assert_allclose(whiten(x), np.linalg.solve(np.linalg.cholesky(V), x), rtol=1e-9, atol=1e-6)
    assert whiten.log_determinant == pytest.approx(np.linalg.slogdet(V)[1], rel=1e-12)
    for _ in range(100):  # without columns, LAPACK's wrapper writes out of bounds
        assert whiten(np.zeros((len(V), 0))).shape == (len(V), 0)


def test_covariance_is_that_of_draws() -> None:
    """Three turns of up to a radian with ends of anisotropic noise, their own noise, and stamps that jitter: 40 000 draws."""
    rng, draws = RNG(6), 40_000
    turns = some_turns(7, n=3, size=1.0, gaps=False)
    omega = rng.standard_normal((4, 3))
    levels = NoiseLevels(1e-6, 5e-7, 8e-7)
    R = [np.eye(3)]
    for angle in turns.angle:
        R.append(R[-1] @ so3.exp(angle))
    assert turns.end_cov is not None
    assert turns.own_cov is not None
    e = np.einsum("mij,dmj->dmi", np.linalg.cholesky(levels.end * turns.end_cov), rng.standard_normal((draws, 4, 3)))
    e += omega * (np.sqrt(levels.jitter) * rng.standard_normal((draws, 4, 1)))
    seen = np.array(R) @ so3.exp(e)
    error = so3.log(np.swapaxes(seen[:, :-1], 2, 3) @ seen[:, 1:]) - turns.angle
    error += np.einsum("nij,dnj->dni", np.linalg.cholesky(levels.own * turns.own_cov), rng.standard_normal((draws, 3, 3)))
    measured = np.cov(error.reshape(draws, 9).T)
    expected = full(turn_noise(turns, omega, np.ones(3)).band(levels))
    chance = np.sqrt((expected**2 + np.outer(np.diag(expected), np.diag(expected))) / draws)
    assert np.abs((measured - expected) / chance).max() < 4.5, (measured, expected)


def draw(noise: TurnNoise, levels: NoiseLevels, rng: np.random.Generator) -> Array:
    out: Array = np.linalg.cholesky(full(noise.band(levels))) @ rng.standard_normal(noise.end.shape[1])
    return out


def fisher(noises: Sequence[TurnNoise], biases: Sequence[Array], levels: NoiseLevels, kinds: Sequence[str]) -> Array:
    """What the residuals can tell of the logarithms of the levels: tr(P V_a P V_b) / 2, P without the biases."""
    out = np.zeros((len(kinds), len(kinds)))
    for noise, B in zip(noises, biases, strict=True):
        W = np.linalg.inv(full(noise.band(levels)))
        if B.shape[1]:
            W = W - W @ B @ np.linalg.solve(B.T @ W @ B, B.T @ W)
        parts = [W @ full(getattr(levels, kind) * getattr(noise, kind)) for kind in kinds]
        out += np.array([[0.5 * np.trace(a @ b) for b in parts] for a in parts])
    return out


CASES = {
    "all three": (NoiseLevels(1e-8, 3e-8, 4e-6), ("end", "own", "jitter")),
    "no jitter": (NoiseLevels(1e-8, 3e-8), ("end", "own")),
    "ends alone": (NoiseLevels(1e-8, 0.0), ("end",)),
}


def level_errors(name: str, biased: bool, seed: int) -> tuple[Array, NoiseLevels]:
    """ln(estimate / truth) of each level over what it can be known to."""
    truth, kinds = CASES[name]
    rng = RNG((seed, 8))
    noises, residuals, biases = [], [], []
    for _ in range(12):
        turns = replace(some_turns(int(rng.integers(1_000_000)), n=60, size=0.05, covariances=False), end_cov=None, own_cov=None)
        noises.append(turn_noise(turns, rng.standard_normal((len(turns.t_ns), 3)), np.ones(3)))
        B = (turns.duration[:, None, None] * np.eye(3)).reshape(-1, 3)
        r = draw(noises[-1], truth, rng)
        if biased:  # what is left once the bias is fitted
            W = np.linalg.inv(full(noises[-1].band(truth)))
            r = r - B @ np.linalg.solve(B.T @ W @ B, B.T @ W @ r)
        residuals.append(r)
        biases.append(B if biased else B[:, :0])
    found = estimate_levels(noises, residuals, biases)
    sigma = np.sqrt(np.diag(np.linalg.inv(fisher(noises, biases, truth, kinds))))
    z = np.array([np.log(getattr(found, kind) / getattr(truth, kind)) for kind in kinds]) / sigma
    return z, found


def check_levels(name: str, biased: bool, seeds: int) -> None:
    z = np.array([level_errors(name, biased, seed)[0] for seed in range(seeds)])
    low, high = np.sqrt(chi2.ppf([0.0005, 0.9995], seeds) / seeds)
    rms = np.sqrt(np.mean(z**2, axis=0))
    told = f"{name}, biased {biased}: rms {rms.round(2)}, mean {z.mean(axis=0).round(2)} of {seeds} seeds; {low:.2f} to {high:.2f}"
    print(told)
    assert np.all((rms > low) & (rms < high)), told


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("biased", [False, True])
def test_levels_are_recovered_within_chance(name: str, biased: bool) -> None:
    check_levels(name, biased, 3)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("biased", [False, True])
def test_levels_are_recovered_within_chance_over_many_seeds(name: str, biased: bool) -> None:
    check_levels(name, biased, 30)


def test_jitter_is_not_invented() -> None:
    assert [level_errors("no jitter", True, seed)[1].jitter for seed in range(5)] == [0.0] * 5


# Where turns come from


def test_turns_share_the_ends_that_they_join_at() -> None:
    turns = some_turns(0)
    assert turns.joined.tolist() == [False, *(turns.first[1:] == turns.last[:-1]).tolist()]
    part = turns.select(slice(5, 12))
    np.testing.assert_array_equal(part.t_ns[part.first], turns.t_ns[turns.first[5:12]])
    np.testing.assert_array_equal(part.t_ns[part.last], turns.t_ns[turns.last[5:12]])
    assert part.end_cov is not None
    assert turns.end_cov is not None
    np.testing.assert_array_equal(part.end_cov[part.last], turns.end_cov[turns.last[5:12]])
    assert len(turns.select(np.zeros(len(turns.first), bool)).first) == 0


def test_turns_that_do_not_go_forward_are_refused() -> None:
    turns = some_turns(0)
    for changes in ({"last": turns.first}, {"first": turns.first[::-1]}, {"angle": turns.angle[:-1]}, {"end_cov": np.zeros((3, 3, 3))}):
        with pytest.raises(ValueError, match="Turns"):
            replace(turns, **changes)  # type: ignore[arg-type]


def test_order_repeats_and_stamps_that_are_not_set() -> None:
    t_ns = np.array([30, 10, 20, 10, 40], np.int64) + 1_700_000_000_000_000_000
    assert in_order(t_ns).tolist() == [1, 2, 0, 4]
    t_ns[2] = 0
    assert in_order(t_ns).tolist() == [1, 0, 4]
    assert in_order(np.zeros(0, np.int64)).tolist() == []
    assert in_order(np.array([0, 5, 10])).tolist() == [0, 1, 2]  # a clock that starts at zero


def test_orientations_turn_into_their_own_axes() -> None:
    R = so3.exp(RNG(0).uniform(-0.7, 0.7, (6, 3)))
    turns = turns_of_orientations(np.arange(6) * 100_000_000, so3.to_quat(R))
    np.testing.assert_allclose(so3.exp(turns.angle), np.swapaxes(R[:-1], 1, 2) @ R[1:], atol=1e-12)


def test_long_pauses_and_half_turns_are_no_turns() -> None:
    q = so3.quat_exp(np.array([[0.0, 0, 0], [0.1, 0, 0], [0.2, 0, 0], [2.9, 0, 0], [3.0, 0, 0]]))
    turns = turns_of_orientations(np.array([0, 1, 31, 32, 33]) * 100_000_000, q)
    assert turns.first.tolist() == [0, 3]


def test_a_pose_that_is_repeated_to_the_last_digit_is_none() -> None:
    q = so3.quat_exp(np.array([[0.0, 0, 0], [0.1, 0, 0], [0.1, 0, 0], [0.2, 0, 0]]))
    turns = turns_of_poses(PoseSamples(np.arange(4) * 10_000_000, q, np.zeros((4, 3)), "w", "b"))
    assert turns.duration.tolist() == pytest.approx([0.01, 0.02])


def test_a_gyroscopes_turns_add_up_and_stop_at_gaps() -> None:
    t_ns = np.arange(101) * 5_000_000
    rate = np.array([0.0, 0.0, 2.0]) + np.zeros((101, 1))
    turns = turns_of_gyro(ImuSamples(t_ns, rate, np.zeros((101, 0))))
    assert turns.axes == (False, False, True)
    np.testing.assert_allclose(turns.angle, [[0, 0, 0.04]] * 25, atol=1e-14)
    late = t_ns + np.where(np.arange(101) >= 50, 30_000_000, 0)
    parted = turns_of_gyro(ImuSamples(late, rate, np.zeros((101, 0))))
    assert len(parted.first) == 24
    np.testing.assert_allclose(parted.angle, [[0, 0, 0.04]] * 24, atol=1e-14)
