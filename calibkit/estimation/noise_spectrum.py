"""A static recording seen in the cosine basis, where IMU noise is nearly independent from mode to mode.

The modes c_k(t) = sqrt(2 / T) cos(k pi t / T), k >= 1, of a record of T seconds have frequency f = k / (2 T). In them white noise is
exactly independent, and so is a random walk (they are the Karhunen-Loeve basis of a Brownian motion about its mean, which a Fourier
periodogram with its leakage is not); flicker noise is correlated by 0.12 at most, and that exactly known (`flicker_covariance`).
So one cosine transform makes a likelihood of the record: the lowest modes with their full covariance, the rest averaged in bands.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct
from scipy.special import sici

Array = NDArray[np.float64]

TERMS = ("white", "flicker", "walk", "quantisation")  # of the linear model: PSD = sum of coefficient^2 x shape(f)
LOW, _LEAST_LOW = 40, 8  # modes taken with their full covariance: of one piece, and of each of many
_RAMP_REACH = 30000  # the highest mode from which a ramp is taken out
_BAND = 0.02  # relative width of a band: the spectrum's slope within it cannot be seen


@dataclass(frozen=True)
class Spectrum:
    """Modes of the r pieces of a recording: the low ones singly, the others averaged. Powers are two-sided PSDs, x^2 / Hz."""

    rate_hz: float
    durations_s: Array  # (r,)
    low: Array  # (r, m) amplitudes of the modes 1 .. m, x / sqrt(Hz)
    f: Array  # (b,) mean frequency of each band, rising
    count: Array  # (b,) modes in it
    power: Array  # (b,) mean squared amplitude

    @property
    def low_f(self) -> Array:
        """Return the frequencies (r, m) of the low modes."""
        f: Array = np.arange(1, self.low.shape[1] + 1) / (2 * self.durations_s[:, None])
        return f


def spectrum(pieces: Sequence[Array], rate_hz: float) -> Spectrum:
    """Return the modes of uninterrupted pieces of samples (n_i,), which count as independent."""
    m = max(_LEAST_LOW, int(LOW / np.sqrt(len(pieces))))
    low, sums = np.empty((len(pieces), m)), []
    for row, x in zip(low, pieces, strict=True):
        mode = dct(x, norm="ortho")[1:] / np.sqrt(rate_hz)
        row[:] = mode[:m]
        sums.append(_band_sums(mode, m, rate_hz))
    f, count, power = np.concatenate(sums, axis=1)
    # Pieces of one recording share bands, so that a hundred of them cost no more than one.
    _, group = np.unique(np.floor(np.log(f / f.min()) / _BAND), return_inverse=True)
    total = np.bincount(group, count).astype(np.float64)
    durations = np.array([len(x) / rate_hz for x in pieces])
    return Spectrum(rate_hz, durations, low, np.bincount(group, f * count) / total, total, np.bincount(group, power) / total)


def _band_sums(mode: Array, low: int, rate_hz: float) -> Array:
    """Return frequency, number of modes and summed squares (3, b) of the bands beyond the low modes."""
    n = len(mode) + 1
    k = np.arange(low + 1, min(n, _RAMP_REACH))
    # A ramp's amplitudes, cos / sin^2 of pi k / 2 n for odd k, are nothing here unless it is huge; what mode 1 can be of it is taken out.
    half = np.pi / (2 * n)
    ramp = np.where(k % 2 == 1, np.cos(half * k) / np.sin(half * k) ** 2, 0.0) * np.tan(half) * np.sin(half)
    squares = mode[low:] ** 2
    squares[: len(k)] = (mode[low : low + len(k)] - mode[0] * ramp) ** 2
    edges = np.unique(np.round(np.geomspace(low + 1, n, max(2, int(np.log(n / (low + 1)) / _BAND)))).astype(np.int64))
    f = (edges[:-1] + edges[1:] - 1) / 2 * rate_hz / (2 * n)
    return np.stack([f, np.diff(edges).astype(np.float64), np.add.reduceat(squares, edges[:-1] - low - 1)])


def shapes(f: Array, rate_hz: float) -> Array:
    """Return (4, b) PSDs of unit coefficients in the order of TERMS, sampled at rate_hz; two-sided, 1 / Hz.

    1, 1 / (2 pi f), 1 / (2 pi f)^2 and (2 pi f)^2 / rate (IEEE Std 952, annex C), each with 2 pi f -> 2 rate sin(pi f / rate): exact for
    summed and differenced white noise, and the flicker of Kasdin and Walter (1992).
    """
    omega = 2 * rate_hz * np.sin(np.pi * f / rate_hz)
    return np.stack([np.ones_like(f), 1 / omega, 1 / omega**2, omega**2 / rate_hz])


def markov_shape(f: Array, rate_hz: float, time_s: float) -> Array:
    """Return the PSD of a first-order Gauss-Markov process of unit variance, 2 T / (1 + (2 pi f T)^2), as sampled (an AR(1))."""
    phi = np.exp(-1 / (rate_hz * time_s))
    psd: Array = (1 - phi**2) / rate_hz / ((1 - phi) ** 2 + 4 * phi * np.sin(np.pi * f / rate_hz) ** 2)
    return psd


def flicker_covariance(modes: int) -> Array:
    """Return the covariance (m, m) of the modes' amplitudes under flicker noise of B = 1 over a duration of 1 s (T s: T times as much).

    The generalised covariance of flicker is -ln|t| / pi, and the double integral of c_k(s) c_l(t) ln|s - t| has a closed form: with
    a = k pi, b = l pi the modes' covariance is (2 / pi) (Si(a) / a - (1 - cos a) / a^2) on the diagonal,
    -(4 / pi) (Cin(a) - Cin(b)) / (a^2 - b^2) where k and l are both even or both odd, else zero.
    """
    k = np.arange(1, modes + 1)
    a = np.pi * k
    si, ci = sici(a)
    cin = np.euler_gamma + np.log(a) - ci
    gap = np.where(k[:, None] == k, 1.0, a[:, None] ** 2 - a**2)
    covariance = np.where((k[:, None] - k) % 2 == 0, -2 * (cin[:, None] - cin) / gap, 0.0)
    covariance[k - 1, k - 1] = si / a - (1 - np.cos(a)) / a**2
    scaled: Array = 2 / np.pi * covariance
    return scaled


def ramp_modes(modes: int) -> Array:
    """Return the amplitudes (m,) of a ramp of 1 x / s over 1 s (T s: T^1.5 times as much): -2 sqrt(2) / (k pi)^2 for odd k, else 0."""
    k = np.arange(1, modes + 1)
    amplitude: Array = np.where(k % 2 == 1, -2 * np.sqrt(2) / (np.pi * k) ** 2, 0.0)
    return amplitude
