"""From samples to the fitted problem: first guess, robust fit, what is dropped, weights by likelihood, final fit."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibkit.errors import NotConvergedError
from calibkit.estimation.imu_problem import State, StandProblem, Weights
from calibkit.estimation.imu_seed import AccelSeed, seed_accel, seed_gyro
from calibkit.estimation.imu_turns import Turns
from calibkit.estimation.imu_weights import find_weights
from calibkit.estimation.static_intervals import Stands
from calibkit.solver.levenberg_marquardt import minimise

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_ROBUST = 3.0  # sigmas, Cauchy
_OUTLIER = 5.0  # sigmas
_ROUNDS = 4
_FIRST = Weights(misfit=1e-3, wobble=1e-3, turn=5e-3, walk_accel=1e-5, walk_gyro=1e-7)
_GAP = 5.0  # median intervals: a turn is not integrated across
_PRIOR = np.array([0.3] * 6 + [3.0] * 3 + [1.0] * 9 + [1.0] * 3 + [0.3] * 9)


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
    guess: Guess
    stands: Stands
    used: Mask  # (all stands,)
    why: dict[int, str]  # stand -> why it was dropped
    dropped_turns: tuple[tuple[int, int], ...]  # between which stands


def fit_imu(samples: Samples, stands: Stands, sensitivity: bool) -> ImuFit:
    """Return the joint maximum likelihood estimate; stands and turns that contradict the others by 5 sigma are left out."""
    guess = _guess(samples, stands)
    used, why, bad_turns = np.ones(len(stands), bool), {}, set()
    x: State | None = None
    weights = _FIRST
    for _ in range(_ROUNDS):
        problem = replace(_problem(samples, stands, guess, used, bad_turns, sensitivity), weights=weights)
        x = _restart(problem, x, guess, stands, used)
        x = _solve(replace(problem, robust=_ROBUST), x)
        weights = _robust_weights(problem, x)
        x = _solve(replace(problem.weighted(weights), robust=_ROBUST), x)
        found = _outliers(problem.weighted(weights), x, np.flatnonzero(used))
        if not found[0] and not found[1]:
            break
        why.update(found[0])
        used[list(found[0])] = False
        bad_turns |= found[1]
    for _ in range(2):
        problem = problem.weighted(find_weights(problem, x))
        x = _solve(problem, x)
    return ImuFit(problem, x, guess, stands, used, why, tuple(sorted(bad_turns)))


def _solve(problem: StandProblem, x: State) -> State:
    solution = minimise(problem, x, tolerance=1e-7)
    if not solution.converged:
        raise NotConvergedError("the IMU's stands and turns fit no scale and axes: check that gyroscope and accelerometer are one device's")
    return solution.x


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
    good &= [(int(a), int(b)) not in bad_turns for a, b in zip(names[:-1], names[1:], strict=True)]
    start = np.flatnonzero(good)
    signal = np.column_stack([rate, np.ones(len(rate)), accel / samples.gravity])
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


def _restart(problem: StandProblem, x: State | None, guess: Guess, stands: Stands, used: Mask) -> State:
    """Return where to begin: attitudes as measured, parameters as they are."""
    up = problem.accel / np.linalg.norm(problem.accel, axis=1, keepdims=True)
    theta = np.zeros(problem.size) if x is None else x.theta
    steps = np.zeros((problem.stands - 1, 3))
    return State(theta, up, steps, steps)


def _robust_weights(problem: StandProblem, x: State) -> Weights:
    """Return weights from the medians of what is left, so that a few wrong stands do not raise them (a normal's median is 0.674 sigma)."""
    rows = problem.rows(x)
    along = np.median(np.linalg.norm(rows.accel, axis=1)) / 0.674 / np.sqrt(max(1 - 9 / problem.stands, 0.1))
    wobble = np.median(np.abs(rows.gyro)) / 0.674
    turn = np.median(np.linalg.norm(rows.turn, axis=1) / np.sqrt(problem.angle)) / 1.18 if len(problem.start) else _FIRST.turn
    return replace(_FIRST, misfit=max(float(along), 1e-5), wobble=max(float(wobble), 1e-7), turn=max(float(turn), 1e-5))


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
