"""Stamps against the grid of their sensor: period, missing frames, jitter, repeats and bursts, each with its size."""

import numpy as np
import pytest

from calibkit.estimation import doctor
from calibkit.estimation.stamps import check_stamps, describe
from calibkit.simulation.faults import apply_faults
from calibkit.simulation.scenarios import SCENARIOS
from calibkit.simulation.session import simulate_session

T0 = 1_700_000_000_000_000_000
RNG = np.random.default_rng


def _stamps(n: int, hz: float, jitter_s: float = 0.0, drops: float = 0.0, seed: int = 0) -> tuple[np.ndarray, int]:
    """Return stamps, and how many were lost between the first and the last."""
    rng = np.random.default_rng(seed)
    t = np.arange(n) / hz + rng.normal(size=n) * jitter_s
    kept = np.flatnonzero(rng.random(n) >= drops)
    return T0 + np.rint(t[kept] * 1e9).astype(np.int64), int(np.ptp(kept)) + 1 - len(kept)


@pytest.mark.parametrize("drops", [0.0, 0.1, 0.3, 0.5])
@pytest.mark.parametrize("jitter", [0.0, 0.004, 0.04, 0.1, 0.2])
def test_the_period_and_the_share_missing_are_found_whatever_is_lost(jitter: float, drops: float) -> None:
    for seed, (n, hz) in enumerate([(1400, 20.0), (900, 30.0), (12000, 200.0), (1400, 29.97)]):
        t_ns, lost = _stamps(n, hz, jitter / hz, drops, seed)
        report = check_stamps(t_ns)
        assert report.rate_hz == pytest.approx(hz, rel=1e-9 + 0.005 * jitter)
        assert abs(report.missing - lost) <= (1 if jitter == 0.2 else 0)
        assert report.jitter_s * hz == pytest.approx(jitter, abs=4 * report.jitter_sigma_s * hz + 0.03 * jitter + 1e-6)
        assert doctor.rate_hz(t_ns) == report.rate_hz


def test_two_ms_of_jitter_reads_two_ms_and_its_sigma_is_honest() -> None:
    reports = [check_stamps(_stamps(1400, 20, 2e-3, 0.3, seed)[0]) for seed in range(40)]
    off = np.array([report.jitter_s - 2e-3 for report in reports])
    assert np.abs(off).max() < 0.15e-3
    assert 0.65 < np.sqrt(np.mean((off / [report.jitter_sigma_s for report in reports]) ** 2)) < 1.38


def test_a_clock_that_drifts_or_jumps_or_a_long_gap_is_no_jitter() -> None:
    t_ns, _ = _stamps(1400, 20, 2e-3)
    seconds = (t_ns - T0) * 1e-9
    for late in (seconds * 200e-6, np.where(seconds > 35, 0.033, 0), 2e-3 * np.sin(seconds / 5), np.where(seconds > 20, 3.017, 0)):
        report = check_stamps(t_ns + np.rint(late * 1e9).astype(np.int64))
        assert report.jitter_s == pytest.approx(2e-3, abs=0.15e-3)
        assert report.rate_hz == pytest.approx(20, rel=3e-4)
    jumped = t_ns + np.where(seconds > 35, 25_000_000, 0)
    assert [f.code for f in doctor.check_times(jumped) if f.problem] == ["irregular"]


@pytest.mark.parametrize("hz", [10.0, 20.0, 29.97])
@pytest.mark.parametrize("jitter_s", [0.0, 1e-4])
def test_one_jump_in_a_short_recording_is_no_jitter_and_no_other_rate(hz: float, jitter_s: float) -> None:
    t_ns, _ = _stamps(250, hz, jitter_s)
    for at in (40, 125, 160, 240):
        for jump_ns in (-33_000_000, 15_000_000, 33_000_000):
            report = check_stamps(t_ns + jump_ns * (np.arange(250) >= at))
            a_frame = hz == 29.97 and abs(jump_ns) == 33_000_000  # one more or less, and the 0.4 ms that it is off a period jitter
            assert report.jitter_s == pytest.approx(jitter_s, rel=0.25 if a_frame else 0.05, abs=1e-9)
            assert report.rate_hz == pytest.approx(hz, rel=1e-9 + jitter_s)


def test_stamps_are_of_what_the_stream_has() -> None:
    t_ns, _ = _stamps(100, 30)
    assert describe(check_stamps(np.repeat(t_ns, 2), "pose")) == ["100 poses have the stamp of another"]


def test_faults_of_a_recording_are_named_with_their_size() -> None:
    run = simulate_session(SCENARIOS["cam-imu"], 0)
    n = len(run.tracks[0].stamp_ns)

    def report(*names: str) -> tuple[object, list[str]]:
        found = check_stamps(apply_faults(run, names).tracks[0].stamp_ns)
        return found, describe(found)

    found, said = report("image-drops-30")
    assert said == [f"{100 * found.missing_share:.3g} % of the frames are missing ({found.missing} of {found.expected}), the rate is 10 Hz"]
    assert found.missing_share == pytest.approx(0.3, abs=0.1)
    assert found.expected <= n
    found, said = report("image-jitter-2")
    assert found.jitter_s == pytest.approx(2e-3, rel=0.25)
    assert said[0].startswith("stamps jitter by ")
    assert said[0].endswith("ms rms around a regular grid, the rate is 10 Hz")
    found, said = report("duplicate-stamps")
    assert (found.duplicates, found.missing) == (n // 20, 0)
    assert said == [f"{n // 20} frames have the stamp of another"]
    assert report("zero-stamp")[1] == ["1 frame has a stamp of zero"]
    assert report("zero-stamps")[1] == [f"{n} frames have a stamp of zero"]
    assert report()[1] == []


def test_the_doctor_says_the_share_that_is_missing_and_the_jitter() -> None:
    t_ns, lost = _stamps(1400, 20, 2e-3, 0.3)
    missing, jitter = doctor.check_times(t_ns)
    assert (missing.code, missing.problem) == ("gap", True)
    expected = len(t_ns) + lost
    assert f"about {lost} samples missing ({100 * lost / expected:.0f} % of {expected}, the rate is 20 Hz)" in missing.text
    assert (jitter.code, jitter.problem, jitter.text) == ("jitter", False, "stamps jitter by 2 ms rms around 50 ms")
    (problem,) = doctor.check_times(_stamps(600, 20, 5e-3)[0])
    assert (problem.code, problem.problem) == ("jitter", True)


@pytest.mark.parametrize("batch", [2, 5, 100])
def test_bursts_are_times_of_arrival(batch: int) -> None:
    i = np.arange(3000)
    t_ns = T0 + ((i // batch + 1) * batch * 5_000_000 + i % batch * 20_000).astype(np.int64)
    report = check_stamps(t_ns)
    assert report.bursts
    assert (report.period_s, report.jitter_s) == (None, None)
    assert describe(report) == ["stamps come in bursts: they are times of arrival, not of the sensor"]
    assert "bursts" in {finding.code for finding in doctor.check_times(t_ns)}


def test_times_on_no_grid_have_no_period_and_few_say_nothing() -> None:
    for seed in range(10):
        waits = np.random.default_rng(seed).exponential(0.05, 1000)
        report = check_stamps(T0 + np.rint(np.cumsum(waits) * 1e9).astype(np.int64))
        assert (report.period_s, report.missing, report.jitter_s) == (None, 0, None)
    for t_ns in (np.zeros(0, np.int64), np.zeros(5, np.int64), np.full(50, T0), T0 + np.arange(9) * 50_000_000):
        report = check_stamps(t_ns)
        assert (report.count, report.period_s) == (len(t_ns), None)
    assert check_stamps(np.arange(100) * 5_000_000).zeros == 0  # a recording's own time starts at 0


def test_order_does_not_matter_and_is_told() -> None:
    t_ns, _ = _stamps(1000, 20, 2e-3)
    swapped = t_ns.copy()
    swapped[[300, 301]] = swapped[[301, 300]]
    report = check_stamps(swapped)
    assert (report.backward, report.jitter_s) == (1, check_stamps(t_ns).jitter_s)
    assert "1 stamp goes back in time" in describe(report)


@pytest.mark.parametrize(
    ("seconds", "off"),
    [(7200.0, "1.99 h"), (-7200.0, "1.99 h"), (300.0, "4.5 min"), (-50.0, "20 s"), (-T0 * 1e-9 + 1, "53.9 years"), (-9e9, "285 years")],
)
def test_a_wild_stamp_is_named_and_no_other_is_missing(seconds: float, off: str) -> None:
    """It stays out of the grid: of 1.44 million ticks in two hours 99 % would be missing."""
    t_ns, _ = _stamps(12000, 200)
    t_ns[6000] += np.int64(seconds * 1e9)
    report = check_stamps(t_ns)
    assert (report.far, report.missing, report.backward, report.rate_hz) == (1, 0, 0, pytest.approx(200))
    assert describe(report) == [f"1 frame has a stamp {off} off all others"]
    assert report.jitter_s == pytest.approx(0, abs=1e-8)


def test_some_wild_stamps_are_counted_and_a_pause_or_a_sparse_stream_has_none() -> None:
    t_ns, _ = _stamps(2000, 20, 2e-3)
    t_ns[[5, 6, 900]] += 300_000_000_000_000
    assert describe(check_stamps(t_ns))[0] == "3 frames have stamps up to 3.47 days off all others"
    paused, _ = _stamps(2000, 20)
    paused[1000:] += 3_600_000_000_000
    assert check_stamps(paused).far == 0
    waits = T0 + np.cumsum(RNG(0).exponential(20.0, 60) * 1e9).astype(np.int64)
    assert check_stamps(waits).far == 0


def test_numbers_are_plain() -> None:
    """Nobody reads 1e+02 %."""
    t_ns, _ = _stamps(2000, 20)
    t_ns[1000:] += 36_000_000_000_000
    assert describe(check_stamps(t_ns)) == ["99.7 % of the frames are missing (720000 of 722000), the rate is 20 Hz"]
    slow, _ = _stamps(400, 0.5, 0.15)
    (text,) = describe(check_stamps(slow))
    assert text == "stamps jitter by 150 +- 5 ms rms around a regular grid, the rate is 0.5 Hz"
