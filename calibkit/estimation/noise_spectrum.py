"""A static recording seen in the cosine basis, where IMU noise is nearly independent from mode to mode.

The modes c_k(t) = sqrt(2 / T) cos(k pi t / T), k >= 1, of a record of T seconds have frequency f = k / (2 T). In them white noise is
exactly independent, and so is a random walk (they are the Karhunen-Loeve basis of a Brownian motion about its mean, which a Fourier
periodogram with its leakage is not); flicker noise is correlated by 0.12 at most, and that exactly known (`flicker_covariance`).
So one cosine transform makes a likelihood of the record: the lowest modes with their full covariance, the rest averaged in bands.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct
from scipy.special import sici

Array = NDArray[np.float64]

TERMS = ("white", "flicker", "walk", "quantisation")  # of the linear model: PSD = sum of coefficient^2 x shape(f)
LOW = 40  # modes taken with their full covariance
_BAND = 0.02  # relative width of a band: the spectrum's slope within it cannot be seen


@dataclass(frozen=True)
class Spectrum:
    """Modes of one uninterrupted record: the low ones singly, the others averaged. Powers are two-sided PSDs, x^2 / Hz."""

    rate_hz: float
    duration_s: float
    low: Array  # (m,) amplitudes of the modes 1 .. m, x / sqrt(Hz)
    f: Array  # (b,) mean frequency of each band
    count: Array  # (b,) modes in it
    power: Array  # (b,) mean squared amplitude

    @property
    def low_f(self) -> Array:
        f: Array = np.arange(1, len(self.low) + 1) / (2 * self.duration_s)
        return f


def spectrum(x: Array, rate_hz: float) -> Spectrum:
    """Return the modes of samples x (n,)."""
    n = len(x)
    mode = dct(x, norm="ortho")[1:] / np.sqrt(rate_hz)
    low, edges = band_edges(n)
    duration = n / rate_hz
    # A ramp's amplitudes fall as 1 / k^2 and are nothing beyond the low modes unless it is huge; what mode 1 can be of it is taken out.
    k = np.arange(low + 1, n)
    rest = mode[low:] - np.where(k % 2 == 1, mode[0] / k.astype(np.float64) ** 2, 0.0)
    count = np.diff(edges).astype(np.float64)
    power = np.add.reduceat(rest * rest, edges[:-1] - low - 1) / count if len(count) else np.zeros(0)
    f = (edges[:-1] + edges[1:] - 1) / 2 / (2 * duration)
    return Spectrum(rate_hz, duration, mode[:low], f, count, power)


def band_edges(n: int) -> tuple[int, NDArray[np.int64]]:
    """Return the number of low modes of n samples, and the first mode of each band with n at the end."""
    low = min(LOW, n - 1)
    count = max(2, int(np.log(n / (low + 1)) / _BAND))
    edges = np.unique(np.round(np.geomspace(low + 1, n, count)).astype(np.int64))
    return low, edges


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


def flicker_covariance(modes: int, duration_s: float) -> Array:
    """Return the covariance (m, m) of the modes' amplitudes under flicker noise of B = 1, whose generalised covariance is -ln|t| / pi.

    The double integral of c_k(s) c_l(t) ln|s - t| has a closed form: with a = k pi, b = l pi the covariance is
    (2 T / pi) (Si(a) / a - (1 - cos a) / a^2) on the diagonal, -(4 T / pi) (Cin(a) - Cin(b)) / (a^2 - b^2) where k and l
    are both even or both odd, else zero.
    """
    k = np.arange(1, modes + 1)
    a = np.pi * k
    si, ci = sici(a)
    cin = np.euler_gamma + np.log(a) - ci
    gap = np.where(k[:, None] == k, 1.0, a[:, None] ** 2 - a**2)
    covariance = np.where((k[:, None] - k) % 2 == 0, -2 * (cin[:, None] - cin) / gap, 0.0)
    covariance[k - 1, k - 1] = si / a - (1 - np.cos(a)) / a**2
    scaled: Array = 2 * duration_s / np.pi * covariance
    return scaled


def ramp_modes(modes: int, duration_s: float) -> Array:
    """Return the amplitudes (m,) of a ramp of 1 x / s: -2 sqrt(2) T^1.5 / (k pi)^2 for odd k, else 0."""
    k = np.arange(1, modes + 1)
    amplitude: Array = np.where(k % 2 == 1, -2 * np.sqrt(2) * duration_s**1.5 / (np.pi * k) ** 2, 0.0)
    return amplitude
