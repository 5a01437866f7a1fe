"""The solver against dense algebra, known minima, and residuals whose correlation is known."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pytest
from scipy.signal import lfilter

from calibkit.solver.arrowhead import Arrowhead, BlockDiagonal
from calibkit.solver.levenberg_marquardt import minimise
from calibkit.solver.robust import cauchy, scale_of_norms, scales_of_norms
from calibkit.solver.trust import Covariance, covariance, covariance_in_time, directions, grade

M, K, P, ROWS = 5, 6, 4, 20


def arrowhead(seed: int) -> tuple[Arrowhead, np.ndarray, np.ndarray]:
    """Normal equations of m blocks of random rows, as an arrowhead and dense: H (m k + p) and g."""
    rng = np.random.default_rng(seed)
    x, c, r = rng.normal(size=(M, ROWS, K)), rng.normal(size=(M, ROWS, P)), rng.normal(size=(M, ROWS))
    xt, ct = np.swapaxes(x, 1, 2), np.swapaxes(c, 1, 2)
    system = Arrowhead(BlockDiagonal(xt @ x), xt @ c, (ct @ c).sum(0), (xt @ r[..., None])[..., 0], (ct @ r[..., None])[..., 0].sum(0))
    J = np.zeros((M * ROWS, M * K + P))
    for i in range(M):
        J[i * ROWS : (i + 1) * ROWS, i * K : (i + 1) * K] = x[i]
        J[i * ROWS : (i + 1) * ROWS, M * K :] = c[i]
    return system, J.T @ J, J.T @ r.ravel()


@pytest.mark.parametrize("damping", [0.0, 1e-3, 2.0])
def test_a_step_is_the_dense_solution(damping):
    system, H, g = arrowhead(seed=0)
    dx, dc, promised = system.step(damping)
    dense = np.linalg.solve(H + damping * np.diag(np.diag(H)), g)
    step = np.concatenate([dx.ravel(), dc])
    np.testing.assert_allclose(step, dense, rtol=1e-10, atol=1e-12)
    decrease = 2 * g @ step - step @ H @ step
    assert 0 < promised <= decrease * (1 + 1e-12)
    if not damping:
        assert promised == pytest.approx(decrease, rel=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_what_nothing_is_known_of_stays_and_spoils_no_other_step(seed):
    """Two more parameters: one that no residual feels, and one that does what a common move of the first nuisance does."""
    system, _, _ = arrowhead(seed)
    _, alone, _ = system.step()
    unfelt, absorbed = np.zeros((M, K, 1)), system.core.blocks[:, :, :1]
    corner = np.zeros((P + 2, P + 2))
    corner[:P, :P] = system.corner
    corner[:P, -1] = corner[-1, :P] = system.border[:, 0].sum(axis=0)
    corner[-1, -1] = absorbed[:, 0].sum()
    gradient = np.concatenate([system.gradient_border, [0.0, system.gradient_core[:, 0].sum()]])
    wider = Arrowhead(system.core, np.concatenate([system.border, unfelt, absorbed], axis=2), corner, system.gradient_core, gradient)
    for damping in (0.0, 1e-15, 1e-12):
        _, dc, _ = wider.step(damping)
        np.testing.assert_allclose(dc[:P], alone, rtol=1e-9, atol=1e-9)
        assert dc[P] == 0
        assert abs(dc[-1]) < 1


@dataclass(frozen=True)
class Decay:
    """y_ij = a exp(-b t_j) + c_i: the offsets c_i are the nuisance, x is (c, (a, b))."""

    t: np.ndarray
    y: np.ndarray  # (m, n)

    def linearize(self, x):
        c, (a, b) = x
        with np.errstate(over="ignore", invalid="ignore"):
            decay = np.exp(-b * self.t)
            r = self.y - a * decay - c[:, None]
            J = np.stack([decay, -a * self.t * decay], axis=-1)
            ones = np.full((len(c), 1, 1), float(len(self.t)))
            border = np.tile(J.sum(axis=0), (len(c), 1, 1))
            system = Arrowhead(BlockDiagonal(ones), border, len(c) * J.T @ J, r.sum(axis=1)[:, None], np.einsum("np,mn->p", J, r))
            return float(np.sum(r * r)), system

    def retract(self, x, core, border):
        return x[0] + core[:, 0], x[1] + border


TRUE_C, TRUE_AB = np.array([1.0, -2.0, 0.3]), np.array([3.0, 0.7])


def decay(noise: float, seed: int = 0) -> Decay:
    t = np.linspace(0, 5, 40)
    y = TRUE_AB[0] * np.exp(-TRUE_AB[1] * t) + TRUE_C[:, None]
    return Decay(t, y + noise * np.random.default_rng(seed).normal(size=y.shape))


@pytest.mark.parametrize("start", [(1.0, 0.1), (0.1, 3.0), (20.0, 2.0)])
def test_a_known_minimum_is_found_and_said_to_be_one(start):
    solution = minimise(decay(noise=0.0), (np.zeros(3), np.array(start)))
    assert solution.converged
    np.testing.assert_allclose(solution.x[1], TRUE_AB, rtol=1e-9)
    np.testing.assert_allclose(solution.x[0], TRUE_C, rtol=1e-9)


def test_the_minimum_of_noisy_data_has_no_slope():
    problem = decay(noise=0.1)
    solution = minimise(problem, (np.zeros(3), np.array([1.0, 0.1])))
    cost, system = problem.linearize(solution.x)
    assert solution.converged
    assert cost == pytest.approx(solution.cost, rel=1e-9)
    size = np.sqrt(cost * np.diag(system.corner))
    assert np.abs(system.gradient_border / size).max() < 1e-6


@pytest.mark.parametrize("start", [(np.nan, 1.0), (1.0, -np.inf), (1.0, -1e6)])
def test_a_start_that_is_not_finite_ends_without_convergence(start):
    solution = minimise(decay(noise=0.1), (np.zeros(3), np.array(start)))
    assert not solution.converged
    assert solution.steps == 0


def test_a_step_into_nowhere_is_not_taken():
    refused = []

    class Cliff(Decay):
        def linearize(self, x):
            cost, system = super().linearize(x)
            if x[1][1] < TRUE_AB[1] + 0.1:
                return cost, system
            refused.append(x)
            return np.nan, system

    problem = Cliff(decay(0.0).t, decay(0.0).y)
    solution = minimise(problem, (np.zeros(3), np.array([1.0, 0.3])))
    assert refused
    assert solution.converged
    np.testing.assert_allclose(solution.x[1], TRUE_AB, rtol=1e-9)


def test_too_few_steps_are_not_convergence():
    assert not minimise(decay(noise=0.1), (np.zeros(3), np.array([1.0, 0.1])), max_steps=2).converged


# Trust: a linear model r = y - J theta with known J over time, so that the estimate's true covariance is known exactly.

RATE_HZ, SECONDS, COLUMNS, SIGMA = 5, 120, 3, 0.5
TIMES = np.arange(RATE_HZ * SECONDS) / RATE_HZ


@lru_cache
def noise_covariance(correlation_s: float) -> np.ndarray:
    """Covariance of AR(1) noise of sigma SIGMA at TIMES; correlation_s 0: white."""
    return SIGMA**2 * (np.exp(-np.abs(TIMES[:, None] - TIMES) / correlation_s) if correlation_s else np.eye(len(TIMES)))


def noise(rng: np.random.Generator, correlation_s: float) -> np.ndarray:
    a = np.exp(-1 / RATE_HZ / correlation_s) if correlation_s else 0.0
    white = SIGMA * rng.normal(size=len(TIMES)) * np.where(np.arange(len(TIMES)), np.sqrt(1 - a * a), 1.0)
    return lfilter([1.0], [1.0, -a], white)


def trust(seed: int, correlation_s: float) -> tuple[np.ndarray, Covariance, np.ndarray]:
    """Return error, claimed covariance and true covariance for columns with periods of 0.7 s, 5 s and 17 s."""
    rng = np.random.default_rng(seed)
    J = np.sin(2 * np.pi * np.array([1.5, 0.2, 0.06]) * TIMES[:, None] + rng.uniform(0, 2 * np.pi, COLUMNS)) * [1.0, 10.0, 0.1]
    e = noise(rng, correlation_s)
    S = J.T @ J
    error = np.linalg.solve(S, J.T @ e)
    r = e - J @ error
    claimed = covariance_in_time(J[:, :, None] * J[:, None], J * r[:, None], TIMES, float(r @ r) / (len(r) - COLUMNS), np.ones(COLUMNS))
    return error, claimed, np.linalg.solve(S, J.T @ noise_covariance(correlation_s) @ J) @ np.linalg.inv(S)


@pytest.mark.parametrize("correlation_s", [0.0, 0.2, 0.6])
def test_corrected_sigmas_are_honest_where_residuals_are_correlated(correlation_s):
    runs = [trust(seed, correlation_s) for seed in range(100)]
    z = np.array([error / np.sqrt(np.diag(claimed.corrected)) for error, claimed, _ in runs])
    z_plain = np.array([error / np.sqrt(np.diag(claimed.plain)) for error, claimed, _ in runs])
    ratio = np.array([np.sqrt(np.diag(claimed.corrected) / np.diag(true)) for _, claimed, true in runs])
    rms, rms_plain, typical = np.sqrt(np.mean(z**2, axis=0)), np.sqrt(np.mean(z_plain**2, axis=0)), np.median(ratio, axis=0)
    told = f"rms {rms}, plain {rms_plain}, claimed over true sigma {typical}"
    slow = slice(0 if correlation_s == 0 else 1, None)
    assert np.all((rms[slow] > 0.77) & (rms[slow] < 1.24)), told  # 99.9 % of chi with 100 seeds
    assert np.all((typical[slow] > 0.8) & (typical[slow] < 1.25)), told
    # A column faster than the noise gains from correlation; shrinking to the mean factor may keep that from it, never more.
    assert rms[0] < 1.24, told
    if correlation_s == 0:  # 120 blocks tell a factor to 1 / sqrt(240); the longest blocks with more than chance are taken
        factors = np.array([claimed.factors for _, claimed, _ in runs])
        assert 0.95 < np.mean(factors) < 1.15, np.mean(factors, axis=0)
        assert np.std(factors) < 0.2
    if correlation_s > 0.5:
        assert np.all(rms_plain[1:] > 2), told  # sqrt((1 + a) / (1 - a)) = 2.5 for the slowest: there is something to correct


def blocks(seed: int, count: int, p: int) -> tuple[np.ndarray, np.ndarray]:
    """Information and scores, at the optimum, of blocks with white noise of sigma 1."""
    rng = np.random.default_rng(seed)
    J = rng.normal(size=(count, 30, p)) * np.geomspace(1, 1e4, p)
    e = rng.normal(size=(count, 30))
    r = e - J @ np.linalg.solve(np.einsum("bni,bnj->ij", J, J), np.einsum("bni,bn->i", J, e))
    return np.swapaxes(J, 1, 2) @ J, np.einsum("bni,bn->bi", J, r)


@pytest.mark.parametrize("count", [3, 6, 12])
def test_with_fewer_blocks_than_can_tell_the_factors_are_shrunk_to_their_mean(count):
    p, seeds = 6, 200
    factors = np.array([covariance(*blocks(s, count, p), 1.0, np.geomspace(1, 1e-4, p)).factors for s in range(seeds)])
    assert np.sqrt(np.mean(factors**2)) == pytest.approx(1.0, abs=0.08)
    assert factors.min() > 0.3  # never a sigma near 0 because a few blocks happened to agree
    within = np.std(factors, axis=1).mean()
    assert within < 0.1 * count / 3  # between parameters of one run


@pytest.mark.parametrize("number", [3, 6, 10])
def test_few_blocks_never_claim_less_than_white_noise_does(number):
    """A sandwich of 3 to 6 blocks falls short by chance: pooled errors were 1.2 to 1.4 of it."""
    p = 6
    for seed in range(40):
        S, g = blocks(seed, number, p)
        found = covariance_in_time(S, g, np.arange(float(number)), 1.0, np.geomspace(1, 1e-4, p))
        assert found.blocks == number
        assert np.all(found.factors >= 1 - 1e-9)


def test_many_blocks_may_claim_less_than_white_noise_does():
    S, g = blocks(0, 100, 6)
    found = covariance_in_time(S, 0.5 * g, np.arange(100.0), 1.0, np.geomspace(1, 1e-4, 6))
    assert np.all(found.factors < 0.7)


def test_the_covariance_does_not_depend_on_units():
    S, g = blocks(0, 20, 4)
    units = np.array([1.0, 1e3, 1e-6, 1e2])
    plain = covariance(S, g, 2.0, np.ones(4))
    scaled = covariance(S / units[:, None] / units, g / units, 2.0, units)
    np.testing.assert_allclose(scaled.corrected, plain.corrected * units[:, None] * units, rtol=1e-6)
    np.testing.assert_allclose(plain.plain, 2.0 * np.linalg.inv(S.sum(0)), rtol=1e-9)


def test_a_direction_without_information_gets_a_huge_finite_variance():
    S, g = blocks(0, 20, 3)
    S[:, 1], S[:, :, 1], g[:, 1] = 0, 0, 0
    found = covariance(S, g, 1.0, np.ones(3))
    assert np.all(np.isfinite(found.corrected))
    assert directions(found.plain, np.ones(3))[0].grade == "not observable"
    assert np.argmax(np.abs(directions(found.plain, np.ones(3))[0].vector)) == 1


def test_grades_on_both_sides_of_their_limits():
    assert [grade(s) for s in (0.0, 3.0, 3.0001, 30.0, 30.0001, np.inf, np.nan)] == [
        *["determined"] * 2,
        *["weak"] * 2,
        *["not observable"] * 3,
    ]


def test_directions_are_in_units_of_the_scales_the_weakest_first():
    scales = np.array([1e-3, 1.0, 1e-3])
    found = directions(np.diag([4e-6, 25.0, 1e-6]), scales)
    assert [d.sigma for d in found] == pytest.approx([5.0, 2.0, 1.0])
    assert [d.grade for d in found] == ["weak", "determined", "determined"]
    assert [int(np.argmax(np.abs(d.vector))) for d in found] == [1, 0, 2]


@pytest.mark.parametrize("scale", [0.5, 2.5, np.inf])
def test_the_weight_of_a_loss_is_its_slope(scale):
    s, h = np.geomspace(1e-4, 1e4, 60), 1e-4
    slope = (cauchy(s * (1 + h), scale)[0] - cauchy(s * (1 - h), scale)[0]) / (2 * h * s)
    np.testing.assert_allclose(cauchy(s, scale)[1], slope, rtol=1e-6)
    np.testing.assert_allclose(cauchy(np.zeros(1), scale), [[0.0], [1.0]])


def test_the_noise_is_read_off_a_median_that_outliers_do_not_move():
    rng = np.random.default_rng(0)
    norms = np.linalg.norm(0.2 * rng.normal(size=(20000, 2)), axis=1)
    assert scale_of_norms(norms) == pytest.approx(0.2, rel=0.03)
    norms[:1000] = 50.0
    assert scale_of_norms(norms) == pytest.approx(0.2, rel=0.06)
    assert scale_of_norms(np.zeros(0)) == 0.0


def test_scales_by_row_are_those_of_each_row() -> None:
    rng = np.random.default_rng(0)
    norms = rng.random((40, 7))
    seen = rng.random(norms.shape) < np.linspace(0, 1, 40)[:, None]
    one_by_one = [scale_of_norms(row[mask]) if mask.any() else np.inf for row, mask in zip(norms, seen, strict=True)]
    np.testing.assert_allclose(scales_of_norms(norms, seen), one_by_one, rtol=1e-14)
