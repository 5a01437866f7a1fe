"""From samples to the fitted problem: first guess, robust fit, what is dropped, weights by likelihood, final fit."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from calibkit.data.progress import Progress, silent
from calibkit.estimation.imu_problem import StandProblem, State, Weights
from calibkit.estimation.imu_seed import AccelSeed, seed_accel, seed_gyro
from calibkit.estimation.imu_turns import Turns
from calibkit.estimation.imu_weights import USUAL, find_weights
from calibkit.estimation.static_intervals import Stands
from calibkit.solver.levenberg_marquardt import minimise

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_ROBUST = 3.0  # sigmas, Cauchy
_OUTLIER = 5.0  # sigmas
_ROUNDS = 4
_RESTLESS = 25.0  # times the median stand's variance
_ROUGHLY, _EXACTLY = 1e-4, 1e-7  # of the cost: what another step must promise
_FIRST = replace(USUAL, misfit=1e-3, wobble=1e-3, turn=5e-3)
_GAP = 5.0  # median intervals: a turn is not integrated across
_PRIOR = np.array([0.1] * 6 + [3.0] * 3 + [0.3] * 9 + [1.0] * 3 + [0.3] * 9)


@dataclass(frozen=True)
class Samples:
    """What is calibrated from."""

    t: Array  # (n,) s
    gyro: Array  # (n, 3)
    accel: Array  # (n, 3)
    gravity: float


@dataclass(frozen=True)
class Guess:
    """The point about which the problem's unknowns are small."""

    M_a: Array
    b_a: Array
    K: Array  # omega = K (gyro - b_g)
    b_g: Array


@dataclass(frozen=True)
class ImuFit:
    """A solved problem over the stands that were kept."""

    problem: StandProblem
    state: State
    converged: bool  # False also where a direction is open: there is no one minimum then
    guess: Guess
    stands: Stands
    used: Mask  # (all stands,)
    why: dict[int, str]  # stand -> why it was dropped
    dropped_turns: tuple[tuple[int, int], ...]  # between which stands


def fit_imu(samples: Samples, stands: Stands, sensitivity: bool, progress: Progress = silent) -> ImuFit:
    """Return the joint maximum likelihood estimate; stands and turns that contradict the others by 5 sigma are left out."""
    with threadpool_limits(1, user_api="blas"):  # the matrices are small: threads cost more than they bring
        return deque(progress(_fits(samples, stands, sensitivity), "fits to the stands"), maxlen=1).pop()


def _fits(samples: Samples, stands: Stands, sensitivity: bool) -> Iterator[ImuFit]:
    """Yield fit after fit, the last of them the estimate; how many there are hangs on what is left out."""

    def fitted(converged: bool) -> ImuFit:
        return ImuFit(problem, x, converged, guess, stands, used, why, tuple(sorted(bad_turns)))

    guess = _guess(samples, stands)
    why = _restless(stands)
    used = ~np.isin(np.arange(len(stands)), list(why))
    bad_turns: set[tuple[int, int]] = set()
    problem = _problem(samples, stands, guess, used, bad_turns, sensitivity)
    x = _first_fit(problem)
    yield fitted(False)
    problem = problem.weighted(_robust_weights(problem, x))
    for _ in range(_ROUNDS):
        robust = replace(problem, robust=_ROBUST)
        robust = robust.weighted(find_weights(robust, x))
        x = minimise(robust, x, tolerance=_ROUGHLY).x
        moved, bad = _outliers(robust, x, np.flatnonzero(used))
        problem = replace(robust, robust=np.inf)
        yield fitted(False)
        if not moved and not bad:
            break
        why.update(moved)
        used[list(moved)] = False
        bad_turns |= bad
        problem = _problem(samples, stands, guess, used, bad_turns, sensitivity).weighted(problem.weights)
        x = _start(problem, x.theta)
    problem = problem.weighted(find_weights(problem, x))
    solution = minimise(problem, x, tolerance=_EXACTLY)
    x = solution.x
    yield fitted(solution.converged)


def _guess(samples: Samples, stands: Stands) -> Guess:
    seed: AccelSeed = seed_accel(stands.accel, samples.gravity)
    moving = np.ones(len(samples.t), bool)
    for first, last in zip(stands.first, stands.last, strict=True):
        moving[first:last] = False
    b_g = np.average(stands.gyro, axis=0, weights=stands.end_s - stands.start_s)
    up = seed.directions(samples.accel)
    K = seed_gyro(samples.t, samples.gyro - b_g, up, moving)
    return Guess(seed.M, seed.b, K, b_g)


def _problem(
    samples: Samples, stands: Stands, guess: Guess, used: Mask, bad_turns: set[tuple[int, int]], sensitivity: bool
) -> StandProblem:
    kept = stands.select(used)
    names = np.flatnonzero(used)
    to_accel, K = np.linalg.inv(guess.M_a), guess.K
    rate = (samples.gyro - guess.b_g) @ K.T
    accel = (samples.accel - guess.b_a) @ to_accel.T
    gap = np.concatenate([[0], np.cumsum(np.diff(samples.t) > _GAP * np.median(np.diff(samples.t)))])
    first, last = kept.last[:-1] - 1, kept.first[1:]
    good = gap[first] == gap[last]
    good &= [(int(a), int(b)) not in bad_turns for a, b in pairwise(names)]
    start = np.flatnonzero(good)
    signal = np.column_stack([rate, np.ones(len(rate)), *([accel / samples.gravity] if sensitivity else [])])
    turns = Turns.between(samples.t, signal, first[good], last[good])
    way = np.linalg.norm(turns.rate[:, :3], axis=1) * turns.dt
    angle = np.add.reduceat(way, turns.offset) if len(way) else np.zeros(0)
    return StandProblem(
        gravity=samples.gravity,
        time_s=kept.middle_s,
        accel=(kept.accel - guess.b_a) @ to_accel.T,
        cov_accel=to_accel @ kept.cov_accel @ to_accel.T,
        gyro=(kept.gyro - guess.b_g) @ K.T,
        cov_gyro=K @ kept.cov_gyro @ K.T,
        turns=turns,
        start=start,
        end=start + 1,
        white_gyro=float(np.sqrt(np.trace(K @ kept.white_gyro @ K.T) / 3)),
        angle=angle,
        weights=_FIRST,
        size=30 if sensitivity else 21,
        prior=_PRIOR[: 30 if sensitivity else 21],
    )


def _restless(stands: Stands) -> dict[int, str]:
    """Return the stands whose own samples scatter far more than the others' do."""
    density = np.trace(stands.cov_accel, axis1=1, axis2=2) * (stands.end_s - stands.start_s)
    return {int(i): "it was moved while it stood" for i in np.flatnonzero(density > _RESTLESS * np.median(density))}


def _first_fit(problem: StandProblem) -> State:
    """Return a robust fit with constant biases: twice, the second time with what the first leaves over for weights."""
    problem = replace(problem, robust=_ROBUST, walking=False)
    x = minimise(problem, _start(problem, np.zeros(problem.size)), tolerance=_ROUGHLY).x
    return minimise(problem.weighted(_robust_weights(problem, x)), x, tolerance=_ROUGHLY).x


def _start(problem: StandProblem, theta: Array) -> State:
    """Return where to begin: attitudes as measured, biases constant."""
    steps = np.zeros((problem.stands - 1, 3))
    return State(theta, problem.accel / np.linalg.norm(problem.accel, axis=1, keepdims=True), steps, steps)


def _robust_weights(problem: StandProblem, x: State) -> Weights:
    """Return weights from the medians of what is left, so that a few wrong stands do not raise them (a normal's median is 0.674 sigma)."""
    rows = problem.rows(x)
    along = np.median(np.linalg.norm(rows.accel, axis=1)) / 0.674 / np.sqrt(max(1 - 9 / problem.stands, 0.1))
    wobble = np.median(np.abs(rows.gyro)) / 0.674
    turn = np.median(np.linalg.norm(rows.turn, axis=1) / np.sqrt(problem.angle)) / 1.18 if len(problem.start) else _FIRST.turn
    found = {"misfit": along, "wobble": wobble, "turn": turn}
    return replace(_FIRST, **{name: max(float(value), getattr(USUAL, name)) for name, value in found.items()})


def _outliers(problem: StandProblem, x: State, names: NDArray[np.intp]) -> tuple[dict[int, str], set[tuple[int, int]]]:
    """Return the stands and turns that lie beyond 5 sigma, a stand rather than both its turns."""
    r, _ = problem.whitened(x)
    n, m = problem.stands, len(problem.start)
    size = np.linalg.norm(r[: 3 * (2 * n + m)].reshape(-1, 3), axis=1)
    wrong_turn = size[2 * n :] > _OUTLIER
    before, after = np.zeros(n, bool), np.zeros(n, bool)
    before[problem.end[wrong_turn]] = True
    after[problem.start[wrong_turn]] = True
    moved = before & after
    wrong = size[:n] > _OUTLIER
    turned = size[n : 2 * n] > _OUTLIER
    why = {int(names[i]): "its |a| is not gravity's" for i in np.flatnonzero(wrong)}
    why |= {int(names[i]): "it was turning slowly" for i in np.flatnonzero(turned & ~wrong)}
    why |= {
        int(names[i]): "the turns before and after it do not lead there: it was moved" for i in np.flatnonzero(moved & ~wrong & ~turned)
    }
    turns = {
        (int(names[a]), int(names[b]))
        for a, b in zip(problem.start[wrong_turn], problem.end[wrong_turn], strict=True)
        if int(names[a]) not in why and int(names[b]) not in why
    }
    return why, turns
