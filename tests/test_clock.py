"""td over time: a constant clock is not taken for another, drifts and jumps are found with honest sigmas, and said in words."""

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from time_offset_samples import Sample, board_sample, path, pose_imu, told

from calibkit.data.rig import Estimate, Rig
from calibkit.data.transforms import make_time_offset
from calibkit.estimation.clock import Clock, describe, fit_clock
from calibkit.estimation.stamps import check_stamps
from calibkit.estimation.time_offset import TimeOffsetFit
from calibkit.estimation.time_offset_delay import Delays
from calibkit.estimation.time_offset_result import Pair, time_offset_result
from calibkit.report.view import views
from calibkit.simulation.faults import apply_faults
from calibkit.simulation.scenarios import SCENARIOS
from calibkit.simulation.session import simulate_session

Scatter = Callable[[np.random.Generator, int], np.ndarray]


def _with_wrong(rng: np.random.Generator, w: int) -> np.ndarray:
    return rng.normal(size=w) * np.where(rng.random(w) < 0.05, 30, 1)


SCATTER: dict[str, Scatter] = {
    "as told": lambda rng, w: rng.normal(size=w),
    "1.5 times": lambda rng, w: 1.5 * rng.normal(size=w),
    "heavy tails": lambda rng, w: rng.standard_t(3, size=w),
    "1.5 times heavy tails": lambda rng, w: 1.5 * rng.standard_t(3, size=w),
    "some wrong": _with_wrong,
}


def _windows(w: int, span_s: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    edges = np.linspace(0, span_s, w + 1)
    return (edges[:-1] + edges[1:]) / 2, edges[:-1], edges[1:]


def _clock(
    w: int,
    span_s: float,
    sigma_s: float,
    seed: int,
    skew: float = 0.0,
    jumps: tuple[tuple[float, float], ...] = (),
    scatter: Scatter = SCATTER["as told"],
) -> Clock:
    """Fit windows of a clock; td of a window with a jump in its middle lies between, with an error of a fifth of the jump."""
    rng = np.random.default_rng((seed, w))
    t, start, end = _windows(w, span_s)
    sigma = sigma_s * np.exp(0.3 * rng.normal(size=w))
    td = 0.006 + skew * t + sigma * scatter(rng, w)
    for at, size in jumps:
        inside = (start < at - 1e-9) & (at + 1e-9 < end)
        part = np.clip((end - at) / (end - start), 0, 1)
        td += size * np.where(inside, np.clip(part + 0.2 * rng.normal(size=w), 0, 1), part)
    return fit_clock(t, start, end, td, sigma)


def _rms(errors: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(errors))))


def _false_alarms(w: int, scatter: str, seeds: int) -> float:
    t, start, end = _windows(w, 2.0 * w)
    alarms = 0
    for seed in range(seeds):
        rng = np.random.default_rng((seed, w))
        sigma = 1e-4 * np.exp(0.5 * rng.normal(size=w))
        alarms += fit_clock(t, start, end, 0.005 + sigma * SCATTER[scatter](rng, w), sigma).kind != "constant"
    return alarms / seeds


@pytest.mark.parametrize("scatter", SCATTER)
def test_a_constant_clock_is_constant(scatter: str) -> None:
    assert np.mean([_false_alarms(w, scatter, 60) for w in (4, 6, 12, 30)]) < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("scatter", SCATTER)
@pytest.mark.parametrize("w", [4, 6, 12, 30, 120, 360])
def test_false_alarms_are_below_half_a_percent(w: int, scatter: str) -> None:
    assert _false_alarms(w, scatter, 2000) < 0.005


@pytest.mark.parametrize(("w", "sigma_s"), [(6, 5e-5), (12, 5e-5), (12, 3e-4), (30, 3e-4), (60, 3e-4)])
def test_fifty_ppm_over_a_minute_are_found(w: int, sigma_s: float) -> None:
    clocks = [_clock(w, 60, sigma_s, seed, skew=50e-6) for seed in range(30)]
    assert {clock.kind for clock in clocks} == {"drifting"}
    assert 0.6 < _rms([(clock.skew - 50e-6) / clock.skew_sigma for clock in clocks]) < 1.44
    assert 0.6 < _rms([(clock.offset_s - 0.006 - 50e-6 * clock.t_ref_s) / clock.sigma_s for clock in clocks]) < 1.44


@pytest.mark.parametrize("scatter", ["as told", "1.5 times heavy tails"])
@pytest.mark.parametrize("skew", [0.0, 50e-6])
@pytest.mark.parametrize("jumps", [((30.4, 0.033),), ((20.3, 0.033), (39.1, -0.033)), ((15.2, -0.033), (30.0, -0.033), (45.7, 0.05))])
def test_jumps_are_found_with_and_without_a_skew(jumps: tuple[tuple[float, float], ...], skew: float, scatter: str) -> None:
    errors = []
    for seed in range(12):
        clock = _clock(60, 60, 1e-4, seed, skew, jumps, SCATTER[scatter])
        assert clock.kind == "jumping"
        assert len(clock.jumps) == len(jumps)
        for found, (at, size) in zip(clock.jumps, jumps, strict=True):
            assert abs(found.t_s - at) <= 1.0
            assert found.t_sigma_s <= 0.58
            errors.append((found.size_s - size) / found.sigma_s)
        errors.append((clock.skew - skew) / clock.skew_sigma)
    assert 0.6 < _rms(errors) < 1.44


def test_the_model_gives_td_back_at_any_time() -> None:
    clock = _clock(60, 60, 1e-6, 0, 50e-6, ((30.0, 0.033),))
    t = np.array([1.0, 29.0, 31.0, 59.0])
    assert np.abs(clock.at(t) - (0.006 + 50e-6 * t + 0.033 * (t > 30))).max() < 2e-6
    assert clock.at(np.array(clock.t_ref_s)) == pytest.approx(clock.offset_s, abs=1e-15)
    assert clock.jumps[0].t_s == pytest.approx(30)


def test_sign_and_order_and_a_distant_clock_change_nothing_else() -> None:
    t, start, end = _windows(30, 60)
    td = 50e-6 * t + np.where(t > 30, -0.033, 0) + 1e-4 * np.random.default_rng(0).normal(size=30)
    sigma = np.full(30, 1e-4)
    near, mirrored = fit_clock(t, start, end, td, sigma), fit_clock(t, start, end, -td, sigma)
    assert near.jumps[0].size_s == pytest.approx(-0.033, abs=5e-4)
    assert mirrored.skew == pytest.approx(-near.skew, rel=1e-6)
    mixed = np.random.default_rng(1).permutation(30)
    far = fit_clock(t[mixed] + 1e5, start[mixed] + 1e5, end[mixed] + 1e5, td[mixed] + 4583.0, sigma[mixed])
    assert far.offset_s - 4583.0 == pytest.approx(near.offset_s, abs=1e-9)
    assert (far.skew, far.jumps[0].size_s) == pytest.approx((near.skew, near.jumps[0].size_s), rel=1e-4)


@pytest.mark.parametrize(("kind", "every_s"), [("one wrong window", 0), ("wrong windows", 9)])
def test_a_window_that_went_wrong_is_no_jump(kind: str, every_s: int) -> None:
    for seed in range(20):
        rng = np.random.default_rng(seed)
        t, start, end = _windows(60, 60)
        td = 0.006 + 1e-4 * rng.normal(size=60)
        td[rng.integers(60) if not every_s else slice(3, None, every_s)] += 0.05
        assert fit_clock(t, start, end, td, np.full(60, 1e-4)).kind == "constant"


@pytest.mark.parametrize(
    "drift",
    [lambda t: 40e-6 * t + 10e-6 / 3600 * t**2, lambda t: -0.03 * np.exp(-t / 600) + 10e-6 * t, lambda t: 1e-3 * np.sin(t / 287)],
    ids=["bent", "warming up", "waving"],
)
def test_a_skew_that_changes_with_temperature_is_no_staircase(drift: Callable[[np.ndarray], np.ndarray]) -> None:
    t, start, end = _windows(180, 3600)
    for seed in range(3):
        td = 0.006 + drift(t) + 1e-4 * np.random.default_rng(seed).normal(size=180)
        clock = fit_clock(t, start, end, td, np.full(180, 1e-4))
        assert clock.kind == "drifting"
        assert _rms(list(clock.at(t) - 0.006 - drift(t))) < 1e-4
        rates = np.gradient(drift(t), t)
        assert clock.skew_range == pytest.approx((rates.min(), rates.max()), abs=6e-6)
        assert "ppm, from " in describe(clock, "imu0")[0]


def test_many_drops_are_many_jumps() -> None:
    clock = _clock(60, 60, 1e-4, 0, jumps=tuple((5.0 * k, -0.05) for k in range(1, 12)))
    assert len(clock.jumps) == 11
    said = describe(clock, "imu0", 20.0)
    assert len(said) == 5
    assert said[0].endswith("ms at 5.0 s after the first sample of imu0 (1 frame period of 20 Hz: dropped frames or a driver's re-sync)")
    assert said[-1] == "7 more jumps, of -50.0 to -49.9 ms, the last at 55.0 s"


def test_few_windows_are_too_short_to_tell() -> None:
    for w in (1, 2, 3):
        t, start, end = _windows(w, 10)
        clock = fit_clock(t, start, end, 0.03 * np.arange(w), np.full(w, 1e-4))
        assert (clock.kind, clock.too_short, clock.jumps, clock.skew) == ("constant", True, (), 0)
        assert describe(clock, "imu0")[0].startswith("too short to tell whether the clocks drift or jump: ")
    with pytest.raises(ValueError, match="needs windows"):
        fit_clock(*np.zeros((5, 0)))


def test_words() -> None:
    (said,) = describe(_clock(60, 60, 5e-5, 0, skew=50e-6), "imu0")
    assert said == "the clock drifts: td changes by +49.9 +- 0.3 ppm (+2.99 ms over 60 s)"
    drift, jump = describe(_clock(60, 60, 5e-5, 0, -50e-6, ((30.1, 0.05),)), "imu0", 20.0)
    assert drift.startswith("the clock drifts: td changes by -5")
    assert jump == (
        "the clock jumps: td changes by +50.01 +- 0.02 ms at 30.5 s after the first sample of imu0 "
        "(1 frame period of 20 Hz: dropped frames or a driver's re-sync)"
    )
    (other,) = describe(_clock(60, 60, 5e-5, 0, 0.0, ((30.1, 0.033),)), "imu0", 20.0)
    assert other.endswith("(dropped frames or a driver's re-sync)")
    constant = _clock(60, 60, 5e-5, 0)
    (said,) = describe(constant, "imu0")
    limit = constant.skew_limit * 1e6
    assert said == f"the clocks keep step: no jump, and a drift is below {limit:.2g} ppm ({limit * 0.06:.2g} ms over 60 s)"
    assert 0 < limit < 3


@pytest.mark.parametrize("seed", range(2))
def test_a_jump_within_one_of_five_windows_is_no_drift_and_has_its_size(seed: int) -> None:
    """-33 ms half-way through 25 s: seed 0's windows told -25 +- 6.5 ms, those of seed 1 a drift of -1755 ppm."""
    session = apply_faults(simulate_session(replace(SCENARIOS["cam-imu"], duration_s=25.0), seed), ("image-step",))
    sample = board_sample(session)
    fit, said = told(sample)
    assert fit.clock is not None
    (jump,) = fit.clock.jumps
    assert jump.size_s == pytest.approx(-0.033, abs=4 * jump.sigma_s)
    assert jump.sigma_s < 3e-4
    assert jump.t_s == pytest.approx(12.5, abs=0.06)
    assert not fit.clock.drifts
    before = float(fit.clock.t_ref_s < jump.t_s)
    assert fit.td == pytest.approx(sample.td - 0.033 * (1 - before), abs=4 * fit.sigma)
    assert fit.sigma < 1e-4
    (reason,) = said.reasons
    assert "the clock jumps: td changes by -3" in reason.text
    result = time_offset_result(Pair("cam0", "imu0", "/cam0", "/imu0", "poses"), fit, Rig(), {}, Delays(), None)
    drawn = views(result)[2].clock_line
    assert drawn is not None
    assert (drawn.skew, drawn.jumps) == (None, ((jump.t_s, jump.size_s),))
    assert not any("drift" in line or "scatter" in line for line in result.facts["lines"])  # type: ignore[attr-defined]


@pytest.fixture(scope="module")
def lost() -> tuple[Sample, TimeOffsetFit]:
    """Stamps counted on at 20 Hz: each lost frame makes them late by 50 ms more, in all further than the V reaches; and they drift."""
    sample = pose_imu(path(0), 0, 0.0123, 1e-3, 60.0)
    stamps = sample.of_t_ns + np.round(_late(sample.of_t_ns) * 1e9).astype(np.int64)
    sample = replace(sample, turns=replace(sample.turns, t_ns=stamps), of_t_ns=stamps)
    return sample, sample.fitted


def _late(t_ns: np.ndarray) -> np.ndarray:
    since = (t_ns - t_ns[0]) * 1e-9
    return 20e-6 * since + 0.05 * (since >= 20) + 0.05 * (since >= 42)


def test_frames_that_a_driver_lost_are_found_to_the_frame(lost: tuple[Sample, TimeOffsetFit]) -> None:
    sample, fit = lost
    clock, a = fit.clock, fit.alignment
    assert clock is not None
    assert clock.kind == "jumping"
    late = _late(pose_imu(path(0), 0, 0.0123, 1e-3, 60.0).of_t_ns)
    t = (sample.of_t_ns + fit.coarse_ns - a.track.origin_ns) * 1e-9
    assert len(clock.jumps) == 2
    for jump, k in zip(clock.jumps, np.flatnonzero(np.diff(late) > 0.04), strict=True):
        assert jump.size_s == pytest.approx(-0.05, abs=4 * jump.sigma_s)
        assert t[k] < jump.t_s < t[k + 1]
        assert jump.t_sigma_s < 0.05
    wrong = fit.coarse_ns * 1e-9 + a.shift(t) - (sample.td - late)
    assert np.abs(wrong).max() < 4 * (fit.sigma + 30 * clock.skew_sigma + sum(jump.sigma_s for jump in clock.jumps))
    assert 3.5e-5 < fit.sigma < 1e-4  # 3.5e-5 were the jumps' sizes known
    assert a.turns > 0.99 * fit.n_turns


def test_a_jump_is_named_in_frames_with_its_time_and_in_the_direction_that_it_is_stored(lost: tuple[Sample, TimeOffsetFit]) -> None:
    sample, fit = lost
    stamps = {"cam0": check_stamps(sample.of_t_ns), "imu0": check_stamps(sample.reference.t_ns)}
    pair = Pair("cam0", "imu0", "/cam0", "/imu0", "poses")
    turned = Rig(time_offsets={"dt_cam0_imu0": make_time_offset("cam0", "imu0", Estimate(value=0.0, unit="s"))})
    for base, about in ((Rig(), ""), (turned, "of dt_imu0_cam0, which is minus this: ")):
        result = time_offset_result(pair, fit, base, stamps, Delays(), None)
        (entry,) = result.rig.time_offsets.values()
        said = re.fullmatch(
            rf"{about}the clock jumps: td changes by -50\.\d \+- \d\.\d ms at (\S+) s after the first sample of imu0 "
            r"\(1 frame period of 20 Hz: dropped frames or a driver's re-sync\); one number does not hold throughout",
            entry.reasons[0],
        )
        assert said, entry.reasons
        assert float(said[1]) == pytest.approx(1.0123 + 20.0, abs=0.1)  # poses begin 1.0123 s after the IMU
        turns, _, windows = views(result)
        assert min(turns.t) == pytest.approx(1.0123 + 0.025, abs=0.06)  # the report's axis has the same zero
        assert windows.zeroed
        lines = "\n".join(map(str, result.facts["lines"]))  # type: ignore[call-overload]
        assert ("the rig file has it the other way round: t_cam0 = t_imu0 + dt_cam0_imu0" in lines) is bool(about)
        assert re.search(r"this td is that of \d\d\.\d s after the first sample of imu0", lines)
