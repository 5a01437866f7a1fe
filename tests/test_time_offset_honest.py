"""Time offsets whose sigmas mean what they say, over seeds 0, 1, 2, ...: errors, errors over sigma, intervals, false alarms.

`pytest -m slow -s tests/test_time_offset_honest.py` prints the figures of docs/figures.md.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.stats import binom, chi2
from time_offset_samples import (
    Sample,
    alarms,
    any_offset,
    board_sample,
    camera_session,
    feature_sample,
    imu_imu,
    path,
    pose_imu,
    pose_pose,
    told,
    wheels_imu,
)


@dataclass(frozen=True)
class Case:
    """How a seed makes its recording, and what the error may be."""

    make: Callable[[int], Sample]
    most_ms: float  # rms of errors
    seeds: int  # in the slow part


CASES = {
    "board at 0.3 rad/s": Case(lambda k: board_sample(camera_session(k, any_offset(k), speed=0.3)), 0.4, 100),
    "board at 1 rad/s": Case(lambda k: board_sample(camera_session(k, any_offset(k))), 0.03, 100),
    "board at 4 rad/s": Case(lambda k: board_sample(camera_session(k, any_offset(k), speed=4.0)), 0.03, 100),
    "features at 1 rad/s": Case(lambda k: feature_sample(camera_session(k, any_offset(k), duration_s=30.0)), 0.4, 30),
    "poses and IMU": Case(lambda k: pose_imu(path(k), k, any_offset(k), 1e-3), 0.1, 40),
    "poses and poses, minutes apart": Case(lambda k: pose_pose(path(k), k, any_offset(k) + 61.7 * (k + 1)), 0.2, 40),
    "IMU and IMU": Case(lambda k: imu_imu(path(k), k, any_offset(k)), 0.1, 40),
    "wheels and IMU": Case(lambda k: wheels_imu(k, any_offset(k)), 0.2, 40),
}


def band(n: int) -> tuple[float, float]:
    """Return the 99.9 % band of the rms of n normalised errors."""
    low, high = np.sqrt(chi2.ppf([0.0005, 0.9995], n) / n)
    return float(low), float(high)


def check(name: str, seeds: int) -> None:
    error, sigma, held, false = np.zeros(seeds), np.zeros(seeds), 0, []
    for seed in range(seeds):
        sample = CASES[name].make(seed)
        fit, said = told(sample)
        error[seed], sigma[seed] = fit.td - sample.td, fit.sigma
        low, high = (fit.coarse_ns * 1e-9 + end for end in fit.interval)
        held += low <= sample.td <= high
        false += [(seed, text) for text in alarms(said)]
    rms, honest = 1e3 * float(np.sqrt(np.mean(error**2))), float(np.sqrt(np.mean((error / sigma) ** 2)))
    least, most = band(seeds)
    line = (
        f"{name}, {seeds} seeds: rms {rms:.4f} ms, median sigma {1e3 * np.median(sigma):.4f} ms, "
        f"error over sigma {honest:.2f} of {least:.2f}-{most:.2f}, the 95 % interval holds {held}, {len(false)} false alarms {false}"
    )
    print(line)
    assert rms < CASES[name].most_ms, line
    assert least < honest < most, line
    assert held >= binom.ppf(0.001, seeds, 0.95), line
    assert not false, line


@pytest.mark.parametrize("name", CASES)
def test_sigma_is_honest(name: str) -> None:
    check(name, 2 if "board" in name else 1)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_sigma_is_honest_over_many_seeds(name: str) -> None:
    check(name, CASES[name].seeds)
