"""Overlapping Allan deviation of 3 h at 200 Hz of six axes at 100 log-spaced averaging times, against allantools.oadev on the same arrays.

Asked: thinned at long averaging times at least 20 times faster and within 1e-3; exact at least twice as fast and within 1e-9.

python benchmarks/allan.py [--hours 3]
"""

import argparse
import resource
import sys
import time
from collections.abc import Callable
from typing import TypeVar

import allantools
import numpy as np
from numpy.typing import NDArray

from calibkit.estimation.allan import deviation

Array = NDArray[np.float64]
T = TypeVar("T")
RATE_HZ, AXES = 200.0, 6


def rates(n: int) -> Array:
    """Return white noise and a random walk, of another ratio on each axis, with quantisation and a constant: what a resting IMU gives."""
    rng = np.random.default_rng(0)
    x = np.empty((n, AXES))
    for j in range(AXES):
        x[:, j] = 1.0 + rng.normal(size=n) + np.cumsum(rng.normal(scale=10.0 ** -(3 + j / 2), size=n))
    return np.round(x, 1)


def theirs(x: Array, tau: Array) -> Array:
    found = [allantools.oadev(x[:, j], rate=RATE_HZ, data_type="freq", taus=tau) for j in range(AXES)]
    if any(len(used) != len(tau) for used, *_ in found):
        raise ValueError("allantools left averaging times out")
    return np.stack([dev for _, dev, *_ in found], axis=1)


def timed(work: Callable[[], T], repeats: int) -> tuple[float, float, T]:
    """Return the least wall and CPU seconds of several runs, and the result."""
    wall = cpu = np.inf
    for _ in range(repeats):
        w, c = time.perf_counter(), time.process_time()
        result = work()
        wall, cpu = min(wall, time.perf_counter() - w), min(cpu, time.process_time() - c)
    return float(wall), float(cpu), result


def peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1 << (20 if sys.platform == "darwin" else 10))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hours", type=float, default=3.0)
    x = rates(round(parser.parse_args().hours * 3600 * RATE_HZ))
    # Log-spaced ones differ from each other only from some samples on: as many are asked for as give 100 different ones.
    counts = np.arange(100, 200)
    asked = next(t for t in (np.unique(np.round(np.geomspace(1, len(x) // 4, k))) for k in counts) if len(t) == 100) / RATE_HZ
    thinned = timed(lambda: deviation(x, RATE_HZ, asked), 5)
    tau = thinned[2].tau  # rounded a little: the others are given the same
    memory = peak_mb()
    exact = timed(lambda: deviation(x, RATE_HZ, tau, exact=True), 2)
    wall, cpu, reference = timed(lambda: theirs(x, tau), 2)
    cases = {"thinned": (*thinned, 20.0, 1e-3), "exact": (*exact, 2.0, 1e-9)}
    print(f"{len(x)} samples x {AXES} axes, {len(tau)} averaging times; {x.nbytes / 2**20:.0f} MB of rates, peak memory {memory:.0f} MB")
    print(f"{'':<12}{'wall s':>9}{'CPU s':>9}{'ratio':>8}{'of CPU':>8}{'asked':>7}{'difference':>12}{'allowed':>9}")
    print(f"{'allantools':<12}{wall:>9.3f}{cpu:>9.3f}{1:>8.1f}{1:>8.1f}")
    missed = False
    for name, (w, c, found, faster, within) in cases.items():
        difference = float(np.max(np.abs(found.dev / reference - 1)))
        met = wall / w >= faster and difference <= within
        missed |= not met
        figures = f"{w:>9.3f}{c:>9.3f}{wall / w:>8.1f}{cpu / c:>8.1f}{faster:>7.0f}{difference:>12.1e}{within:>9.0e}"
        print(f"{name:<12}{figures}  {'met' if met else 'MISSED'}")
    raise SystemExit(missed)


if __name__ == "__main__":
    main()
