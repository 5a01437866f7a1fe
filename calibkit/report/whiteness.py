"""Whether samples in time are white: their autocorrelation and their spectrum (numpy only)."""

import numpy as np

from calibkit.report.view import Array

LAGS_S, MAX_LAGS = 0.5, 200
CHANCE = 3.9  # sigmas
SEGMENT_S = 2.0


def autocorrelation(t: Array, x: Array) -> tuple[Array, Array, float]:
    """Return lags (k,) s from one sample on, the autocorrelation (k, d) of samples x (n, d), and how large chance makes it."""
    interval, x = _interval(t), x - x.mean(axis=0)
    n = len(x)
    many = int(np.clip(LAGS_S / interval, 1, min(MAX_LAGS, max(n // 4, 1))))
    size = 1 << (2 * n - 1).bit_length()
    power = np.abs(np.fft.rfft(x, size, axis=0)) ** 2
    found = np.fft.irfft(power, size, axis=0)[: many + 1]
    rho: Array = found[1:] / np.maximum(found[0], 1e-300)
    lags: Array = interval * np.arange(1.0, many + 1)
    return lags, rho, CHANCE / float(np.sqrt(n))


def spectrum(t: Array, x: Array) -> tuple[Array, Array]:
    """Return frequencies (f,) Hz and the one-sided density (f, d) unit/sqrt(Hz) over sqrt(2): of white noise sigma / sqrt(rate).

    Welch's method: Hann windows of SEGMENT_S that overlap by half. The factor makes it the density of an IMU's data sheet.
    """
    interval, n = _interval(t), len(x)
    length = int(np.clip(SEGMENT_S / interval, 8, max(n, 8)))
    window = np.hanning(length)[:, None]
    starts = range(0, max(n - length, 0) + 1, max(length // 2, 1))
    parts = [x[start : start + length] for start in starts]
    power = np.mean([np.abs(np.fft.rfft((part - part.mean(axis=0)) * window[: len(part)], length, axis=0)) ** 2 for part in parts], axis=0)
    density: Array = np.sqrt(power * interval / np.sum(window**2))
    frequency = np.fft.rfftfreq(length, interval).astype(np.float64)
    return frequency[1:], density[1:]


def _interval(t: Array) -> float:
    return max(float(np.median(np.diff(t))), 1e-9) if len(t) > 1 else 1.0
