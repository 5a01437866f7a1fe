"""Static IMU noise of known truth: white, flicker, random walk, quantisation and ramp, in the conventions of IEEE Std 952."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft
from scipy.signal import lfilter

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SimNoise:
    """Noise of one axis, x = rad/s or m/s^2: PSD (two-sided) N^2 + B^2 / (2 pi f) + K^2 / (2 pi f)^2 + Q^2 (2 pi f)^2 / rate, and R t."""

    white: float = 1.7e-4  # N, x / sqrt(Hz)
    flicker: float = 5.0e-5  # B, x; the Allan deviation's floor is B sqrt(2 ln 2 / pi)
    walk: float = 3.0e-6  # K, x / s / sqrt(Hz)
    quantisation: float = 0.0  # Q, x s
    ramp: float = 0.0  # R, x / s
    markov: float = 0.0  # standard deviation of a first-order Gauss-Markov process, x
    markov_time_s: float = 1.0


def simulate_noise(noise: SimNoise, n: int, rate_hz: float, rng: np.random.Generator, axes: int = 1) -> Array:
    """Return (n, axes) samples of independent axes; walk and flicker start at zero."""
    out = np.empty((n, axes))
    for axis in range(axes):
        x = noise.white * np.sqrt(rate_hz) * rng.standard_normal(n)
        if noise.flicker:
            x += noise.flicker * flicker(n, rng)
        if noise.walk:
            x += np.cumsum(noise.walk / np.sqrt(rate_hz) * rng.standard_normal(n))
        if noise.quantisation:
            x += noise.quantisation * rate_hz * np.diff(rng.standard_normal(n + 1))
        if noise.markov:
            x += noise.markov * _markov(n, noise.markov_time_s * rate_hz, rng)
        out[:, axis] = x + noise.ramp * np.arange(n) / rate_hz
    return out


def flicker(n: int, rng: np.random.Generator) -> Array:
    """Return n samples of 1/f noise with B = 1, starting at zero: white noise through (1 - z^-1)^(-1/2) (Kasdin and Walter 1992, eq. 8).

    The PSD is 1 / (2 rate sin(pi f / rate)), 1 / (2 pi f) far below the Nyquist frequency. Its first differences are stationary, with
    autocovariance g(0) = 4 / pi, g(h) = g(h - 1) (h - 3/2) / (h + 1/2) (Hosking 1981, d = -1/2); these are drawn exactly by circulant
    embedding (Davies and Harte 1987) and summed, so the noise has no beginning, as Kasdin's filter started from rest has.
    """
    size = next_fast_len(n, real=True)
    h = np.arange(1, size + 1)
    covariance = 4 / np.pi * np.concatenate([[1.0], np.cumprod((h - 1.5) / (h + 0.5))])
    power = rfft(np.concatenate([covariance, covariance[-2:0:-1]])).real  # of the circulant, 2 size long; none is negative for d < 0
    gauss = rng.standard_normal((2, len(power)))
    gauss[1, [0, -1]] = 0
    gauss[0, 1:-1] /= np.sqrt(2)
    gauss[1, 1:-1] /= np.sqrt(2)
    steps: Array = irfft(np.sqrt(np.maximum(power, 0) * 2 * size) * (gauss[0] + 1j * gauss[1]), 2 * size)[:n]
    noise: Array = np.cumsum(steps) - steps[0]
    return noise


def _markov(n: int, time: float, rng: np.random.Generator) -> Array:
    phi = np.exp(-1 / time)
    start = np.array([phi * rng.standard_normal()])
    y, _ = lfilter([1.0], [1.0, -phi], np.sqrt(1 - phi * phi) * rng.standard_normal(n), zi=start)
    out: Array = np.asarray(y, dtype=np.float64)
    return out
