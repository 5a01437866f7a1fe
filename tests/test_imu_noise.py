"""Noise terms of a resting IMU: honest against simulated truth, not resolved where they are not, robust to what is no noise."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.fft import dct
from scipy.signal import butter, lfilter

from calibkit.data.verdict import Status
from calibkit.errors import BadInputError
from calibkit.estimation.imu_noise import AxisNoise, fit_noise, model_deviation
from calibkit.estimation.noise_spectrum import flicker_covariance
from calibkit.simulation.noise import SimNoise, flicker, simulate_noise

Array = NDArray[np.float64]
TRUTH = SimNoise(white=1.7e-4, flicker=5.0e-5, walk=3.0e-6)
TERMS = ("white", "flicker", "walk")
VALUES = np.array([TRUTH.white, TRUTH.flicker, TRUTH.walk])


def fitted(noise: SimNoise, hours: float, rate_hz: float, seed: int) -> AxisNoise:
    x = simulate_noise(noise, round(hours * 3600 * rate_hz), rate_hz, np.random.default_rng(seed))
    return fit_noise(x, rate_hz)[0]


def allan_variance(x: Array, m: int) -> float:
    theta = np.concatenate([[0.0], np.cumsum(x - x.mean())])
    return float(np.mean((theta[2 * m :] - 2 * theta[m:-m] + theta[: -2 * m]) ** 2) / (2 * m * m))


def best(fits: list[AxisNoise]) -> Array:
    return np.array([[fit.best[name] for name in TERMS] for fit in fits])


def errors(fits: list[AxisNoise]) -> tuple[Array, Array]:
    """Return normalised errors, per parameter and whitened by the full covariance."""
    plain = (best(fits) - VALUES) / np.sqrt(np.array([np.diag(fit.covariance) for fit in fits]))
    white = np.array([np.linalg.solve(np.linalg.cholesky(f.covariance), b - VALUES) for f, b in zip(fits, best(fits), strict=True)])
    return plain, white


@pytest.mark.parametrize(
    ("noise", "variance"),
    [
        (SimNoise(1.0, 0, 0), lambda tau: 1 / tau),
        (SimNoise(0, 1.0, 0), lambda tau: 2 * np.log(2) / np.pi + 0 * tau),
        (SimNoise(0, 0, 1.0), lambda tau: tau / 3),
        (SimNoise(0, 0, 0, quantisation=1.0), lambda tau: 3 / tau**2),
        (SimNoise(0, 0, 0, ramp=1.0), lambda tau: tau**2 / 2),
    ],
)
def test_simulated_noise_has_the_allan_variance_of_the_standard(noise: SimNoise, variance: object) -> None:
    x = simulate_noise(noise, 2**17, 10.0, np.random.default_rng(0), axes=4)
    for m in (32, 256):
        measured = np.mean([allan_variance(x[:, axis], m) for axis in range(4)])
        assert measured == pytest.approx(variance(m / 10.0), rel=0.06)  # type: ignore[operator]


def test_flicker_covariance_of_the_modes_is_what_simulated_flicker_has() -> None:
    rng, n, runs = np.random.default_rng(1), 2048, 3000
    modes = np.array([dct(flicker(n, rng), norm="ortho")[1:8] for _ in range(runs)])
    C = n * flicker_covariance(7)
    scale = np.sqrt(np.diag(C))
    assert modes.T @ modes / runs / scale[:, None] / scale == pytest.approx(C / scale[:, None] / scale, abs=5 / np.sqrt(runs))
    assert C[0, 2] / scale[0] / scale[2] == pytest.approx(-0.12, abs=0.005)  # so that a diagonal C would fail above


def test_the_model_deviation_is_that_of_the_simulated_noise() -> None:
    noise = SimNoise(1.7e-4, 5e-5, 3e-6, markov=3e-4, markov_time_s=0.3)
    x = simulate_noise(noise, 720_000, 200.0, np.random.default_rng(0))
    fit = fit_noise(x, 200.0)[0]
    m = np.array([2, 20, 100, 400, 2000, 8000])
    measured = np.sqrt([allan_variance(x[:, 0], k) for k in m])
    assert model_deviation(fit, m / 200.0) == pytest.approx(measured, rel=0.08)


def test_noise_is_recovered_and_honest() -> None:
    fits = [fitted(TRUTH, 3.0, 20.0, seed) for seed in range(5)]
    plain, white = errors(fits)
    assert np.all(np.abs(best(fits)[:, :2].mean(axis=0) / VALUES[:2] - 1) < (0.005, 0.05))
    assert 0.4 < np.sqrt(np.mean(white**2)) < 1.6  # 15 numbers, 99.9 %
    assert np.all(np.abs(plain) < 4)
    for fit in fits:
        for name, value in zip(TERMS, VALUES, strict=True):
            term = getattr(fit, name)
            assert term.lower95 / 1.5 < value < term.upper95 * 1.5
        assert fit.white.status is Status.DETERMINED
        assert fit.quantisation is None
        assert fit.ramp is None
        assert fit.markov is None
        assert fit.features == ()
        assert fit.discrepancy == 0


def test_a_short_recording_says_what_it_cannot_tell_and_a_long_one_tells() -> None:
    for seed in range(4):
        short = fitted(TRUTH, 1 / 6, 20.0, seed).walk
        assert short.value is None
        assert short.status is Status.NOT_OBSERVABLE
        assert short.upper95 > TRUTH.walk
        assert short.hours_needed is not None
        assert short.resolves is not None
        assert short.hours_needed > 1 / 6
        longer = fitted(SimNoise(TRUTH.white, TRUTH.flicker, short.resolves), short.hours_needed, 5.0, 100 + seed).walk
        assert longer.value is not None


def test_white_noise_alone_has_neither_flicker_nor_walk() -> None:
    for seed in range(5):
        fit = fitted(SimNoise(1.7e-4, 0, 0), 0.3, 100.0, seed)
        assert fit.white.value == pytest.approx(1.7e-4, rel=0.01)
        assert fit.flicker.value is None
        assert fit.walk.value is None
        assert fit.flicker.upper95 < 5e-5
        assert fit.features == ()


def test_quantisation_and_ramp_are_found_where_they_show() -> None:
    fit = fitted(SimNoise(1.7e-4, 5e-5, 0, quantisation=3e-6, ramp=2e-6), 0.5, 200.0, 0)
    assert fit.quantisation is not None
    assert fit.ramp is not None
    assert fit.quantisation.lower95 < 3e-6 < fit.quantisation.upper95
    assert fit.ramp.lower95 < 2e-6 < fit.ramp.upper95
    assert fit.white.value == pytest.approx(1.7e-4, rel=0.02)
    assert fit.f_max == 100.0


def test_a_bump_is_named_and_not_swallowed_into_the_white_noise() -> None:
    fit = fitted(SimNoise(1.7e-4, 5e-5, 3e-6, markov=3e-4, markov_time_s=0.3), 0.5, 200.0, 0)
    assert fit.markov is not None
    assert fit.markov.time_s == pytest.approx(0.3, rel=0.15)
    assert fit.markov.sigma == pytest.approx(3e-4, rel=0.1)
    assert fit.white.value == pytest.approx(1.7e-4, rel=0.01)


def test_vibration_is_named_and_a_filter_is_left_out() -> None:
    x = simulate_noise(TRUTH, 360_000, 200.0, np.random.default_rng(0))
    b, a = butter(2, 20 / 100)
    filtered = lfilter(b, a, x, axis=0) + 1e-3 * np.sin(2 * np.pi * 3.3 * np.arange(len(x)) / 200.0)[:, None]
    fit = fit_noise(filtered, 200.0)[0]
    assert fit.white.value == pytest.approx(1.7e-4, rel=0.02)
    line, cut = fit.features
    assert line.kind == "line"
    assert line.f_low < 3.3 < line.f_high
    assert line.amplitude == pytest.approx(1e-3, rel=0.05)
    assert line.tau == pytest.approx(0.371 / 3.3, rel=0.05)
    assert cut.kind == "filter"
    assert 5 < cut.f_low < 20
    assert fit.f_max == cut.f_low


def test_units_do_not_matter() -> None:
    x = simulate_noise(TRUTH, 100_000, 200.0, np.random.default_rng(0))
    one = fit_noise(x, 200.0)[0]
    for factor in (57.29578, 1e-9, 1e9):
        other = fit_noise(x * factor, 200.0)[0]
        for name in TERMS:
            assert getattr(other, name).upper95 == pytest.approx(factor * getattr(one, name).upper95, rel=1e-3)
        assert other.covariance == pytest.approx(factor**2 * one.covariance, rel=1e-3)


def test_pieces_of_a_recording_give_nearly_what_the_whole_gives() -> None:
    x = simulate_noise(TRUTH, 360_000, 200.0, np.random.default_rng(0))
    whole = fit_noise(x, 200.0)[0]
    pieces = fit_noise([x[:100_000], x[100_000:200_000], x[200_000:200_300], x[200_300:]], 200.0)[0]
    assert pieces.best["white"] == pytest.approx(whole.best["white"], rel=1e-3)
    assert abs(pieces.best["flicker"] - whole.best["flicker"]) < whole.flicker.sigma  # type: ignore[operator]
    assert pieces.flicker.upper95 / pieces.flicker.lower95 > 0.9 * whole.flicker.upper95 / whole.flicker.lower95


def test_a_stuck_axis_is_said_and_the_others_are_fitted() -> None:
    x = simulate_noise(TRUTH, 20_000, 200.0, np.random.default_rng(0), axes=3)
    x[:, 1] = 9.81
    fits = fit_noise(x, 200.0)
    assert "stuck" in fits[1].reasons[0]
    assert fits[1].white.status is Status.NOT_OBSERVABLE
    assert np.all(np.isfinite(fits[1].covariance))
    assert all(fits[i].white.value == pytest.approx(1.7e-4, rel=0.05) for i in (0, 2))


def test_many_short_pieces_of_filtered_noise() -> None:
    b, a = butter(2, 1 / 100)
    x = lfilter(b, a, simulate_noise(TRUTH, 100_000, 200.0, np.random.default_rng(0)), axis=0)[2000:]
    fit = fit_noise([x[i : i + 400] for i in range(0, len(x) - 400, 400)], 200.0)[0]
    assert fit.f_max < 5
    assert np.isfinite(fit.white.upper95)


@pytest.mark.parametrize(
    ("x", "rate_hz", "words"),
    [
        (np.zeros((399, 3)), 200.0, "too short"),
        (np.full((1000, 3), np.nan), 200.0, "NaN"),
        (np.zeros(1000), 200.0, "axes"),
        (np.ones((1000, 3)), 0.0, "rate"),
    ],
)
def test_bad_input_is_one_line(x: Array, rate_hz: float, words: str) -> None:
    with pytest.raises(BadInputError, match=words) as caught:
        fit_noise(x, rate_hz)
    assert "\n" not in str(caught.value)


def test_the_adis16405s_noise_and_its_second_bump(data_dir: Path) -> None:
    x = np.loadtxt(data_dir / "allan_adis16405" / "imu_100hz.csv.gz", delimiter=",", skiprows=1)
    fits = fit_noise(x, 100.0)
    assert [fit.white.value for fit in fits[:3]] == pytest.approx([0.0406, 0.0427, 0.0386], rel=0.05)
    for fit in fits:
        assert "filter" in [f.kind for f in fit.features]
        assert 6 < fit.f_max < 15
    for fit in fits[3:]:
        strongest = max((f for f in fit.features if f.kind == "line" and f.f_high < 1), key=lambda f: f.amplitude)
        assert 0.6 < strongest.tau < 0.8  # 0.57 Hz
        beside = [m for m in fit.misfit if 0.8 < m.f < 5 and m.used]
        assert all(m.ratio == pytest.approx(1, abs=0.06) for m in beside)
        at_bump = [m for m in fit.misfit if 0.5 < m.f < 0.6 and not m.used]
        assert max(m.ratio for m in at_bump) > 3


@pytest.mark.slow
def test_forty_recordings_of_three_hours_are_honest() -> None:
    fits = [fitted(TRUTH, 3.0, 200.0, seed) for seed in range(40)]
    plain, white = errors(fits)
    relative = best(fits) / VALUES - 1
    rms, pooled = np.sqrt(np.mean(plain**2, axis=0)), float(np.sqrt(np.mean(white**2)))
    covered = [
        float(np.mean([getattr(f, n).lower95 <= v <= getattr(f, n).upper95 for f in fits])) for n, v in zip(TERMS, VALUES, strict=True)
    ]
    resolved = [sum(getattr(f, n).value is not None for f in fits) for n in TERMS]
    print(f"\nN, B, K over 40 seeds of 3 h at 200 Hz: rms error {np.sqrt(np.mean(relative**2, axis=0))}, bias {relative.mean(axis=0)}")
    print(f"error / sigma rms {rms}, whitened {pooled:.3f}, 95 % interval covers {covered}, resolved {resolved}")
    assert np.all((rms[:2] > 0.65) & (rms[:2] < 1.38))
    assert 0.8 < pooled < 1.25
    assert abs(relative[:, 0].mean()) < 0.005
    assert abs(relative[:, 1].mean()) < 0.05
    assert 0.85 <= covered[2] <= 1.0


@pytest.mark.slow
@pytest.mark.parametrize("hours", [1 / 30, 1 / 6])
def test_the_hours_asked_for_do_resolve(hours: float) -> None:
    outcome: dict[str, list[bool]] = {"flicker": [], "walk": []}
    asked: dict[str, list[float]] = {"flicker": [], "walk": []}
    for seed in range(40):
        short = fitted(TRUTH, hours, 200.0, seed)
        for name, runs in outcome.items():
            term = getattr(short, name)
            if term.value is None:
                known = {"white": TRUTH.white, "flicker": short.best["flicker"], "walk": short.best["walk"], name: term.resolves}
                runs.append(getattr(fitted(SimNoise(**known), term.hours_needed, 10.0, 1000 + seed), name).value is not None)
                asked[name].append(term.hours_needed)
    for name, runs in outcome.items():
        print(f"\n{60 * hours:.0f} min: {name} not resolved in {len(runs)} of 40; median hours asked for {np.median(asked[name]):.2f}")
        print(f"share of such recordings that resolve it: {np.mean(runs):.3f}")
        assert np.mean(runs) >= 0.85


@pytest.mark.slow
def test_white_noise_alone_is_seldom_taken_for_more() -> None:
    fits = [fitted(SimNoise(1.7e-4, 0, 0), 0.5, 200.0, seed) for seed in range(40)]
    false = {name: sum(getattr(fit, name).value is not None for fit in fits) for name in ("flicker", "walk")}
    print(f"\npure white noise, 40 seeds of 0.5 h at 200 Hz: false detections {false}")
    assert sum(false.values()) <= 4  # 5 % of 40, and two standard deviations
