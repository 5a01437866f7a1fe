"""Recordings that cannot tell a time offset, and recordings with something wrong: refused, survived, or named with its size."""

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from time_offset_samples import (
    R_OF_TO,
    Sample,
    alarms,
    any_offset,
    board_sample,
    camera_session,
    constant_rate,
    imu_imu,
    path,
    pose_imu,
    refused,
    seen_gyro,
    seen_poses,
    stamps,
    told,
)

from calibkit.data.observations import ImuSamples, PoseSamples
from calibkit.data.rig import Rig
from calibkit.data.verdict import Status, Verdict
from calibkit.errors import BadInputError
from calibkit.estimation.stamps import check_stamps
from calibkit.estimation.time_offset import TimeOffsetFit
from calibkit.estimation.time_offset_delay import Delays
from calibkit.estimation.time_offset_result import Pair, time_offset_result
from calibkit.estimation.turns import turns_of_poses
from calibkit.geometry import so3
from calibkit.simulation.session import START_NS

Array = NDArray[np.float64]
PAIR = Pair("cam0", "imu0", "/cam0", "/imu0", "poses")

# What cannot be told

RATES = ([0.0, 0.0, 1.0], [0.3, 0.0, 0.0], [2.0, -1.0, 1.5], [0.0, -4.0, 0.0])
DEGENERATE: dict[str, Callable[[int, float], Sample]] = {
    "static": lambda seed, noise: pose_imu(path(seed, "static"), seed, any_offset(seed), noise, 30.0),
    "translation": lambda seed, noise: pose_imu(path(seed, "translation"), seed, any_offset(seed), noise, 30.0),
    "constant velocity": lambda seed, noise: pose_imu(path(seed, "constant-velocity"), seed, any_offset(seed), noise, 30.0),
    **{
        f"constant rate {rate}": lambda seed, noise, rate=rate: pose_imu(  # type: ignore[misc]
            constant_rate(np.array(rate)), seed, any_offset(seed), noise, 30.0
        )
        for rate in RATES
    },
}


@pytest.mark.parametrize("name", DEGENERATE)
def test_what_does_not_change_its_rate_of_turn_tells_nothing(name: str) -> None:
    assert refused(DEGENERATE[name](0, 1e-4))


@pytest.mark.slow
@pytest.mark.parametrize("name", DEGENERATE)
@pytest.mark.parametrize("noise", [1e-5, 1e-4, 1e-3])
def test_what_does_not_change_its_rate_of_turn_never_tells_anything(name: str, noise: float) -> None:
    assert [seed for seed in range(20) if not refused(DEGENERATE[name](seed, noise))] == []


@pytest.mark.parametrize("motion", ["static", "translation", "constant-rate"])
def test_a_board_that_does_not_turn_tells_nothing(motion: str) -> None:
    assert refused(board_sample(camera_session(0, any_offset(0), motion=motion, duration_s=15.0)))


def test_no_number_is_left_where_nothing_is_known() -> None:
    sample = DEGENERATE["static"](0, 1e-4)
    result = time_offset_result(PAIR, sample.fitted, Rig(), {"cam0": check_stamps(sample.of_t_ns)}, Delays(), None)
    entry = result.rig.time_offsets["dt_imu0_cam0"]
    assert (entry.offset.value, entry.offset.sigma, entry.offset.status) == (None, None, Status.NOT_OBSERVABLE)
    assert entry.verdict is Verdict.FAIL
    assert result.not_observable == ("dt_imu0_cam0.offset",)
    facts = result.facts["v"]
    assert isinstance(facts, dict)
    assert set(facts["dt_imu0_cam0"].values()) == {None}
    assert not re.search(r"td|\+-", " ".join(str(line) for line in result.facts["lines"]))  # type: ignore[attr-defined]
    assert "at rest every offset fits alike" in result.reasons[0].text


def apart(seed: int) -> Sample:
    """Poses of one recording and the IMU of another."""
    return replace(pose_imu(path(seed), seed, 0.1, 1e-3), reference=pose_imu(path(seed + 50), seed + 50, 0.1, 1e-3).reference)


def test_recordings_that_do_not_belong_together_give_no_number() -> None:
    assert refused(apart(0))


@pytest.mark.slow
def test_recordings_that_do_not_belong_together_never_give_a_number() -> None:
    assert [seed for seed in range(20) if not refused(apart(seed))] == []


def test_recordings_that_share_no_time_are_refused() -> None:
    sample = pose_imu(path(0), 0, 0.0, 1e-3, 10.0)
    with pytest.raises(BadInputError, match="share too little time"):
        told(replace(sample, turns=sample.turns.select(slice(0, 10))))


def silent_period(seed: int) -> str:
    """What is wrong with the offset of a rig that swings about one axis again and again: nothing where it is right or alarmed."""
    sample = pose_imu(path(seed, "swing"), seed, any_offset(seed), 1e-3, 30.0)
    fit, said = told(sample)
    if said.status is Status.NOT_OBSERVABLE or any("the motion repeats itself" in reason.text for reason in said.reasons):
        return ""
    return "" if abs(fit.td - sample.td) < 5 * fit.sigma else f"seed {seed}: {fit.td} +- {fit.sigma} for {sample.td}, nothing said"


def test_a_swing_is_not_taken_a_period_off_in_silence() -> None:
    assert silent_period(0) == ""


@pytest.mark.slow
def test_no_swing_is_taken_a_period_off_in_silence() -> None:
    assert [silent_period(seed) for seed in range(20)] == [""] * 20


# What is wrong and named


def faulty(fault: str, seed: int, duration_s: float = 60.0) -> tuple[Sample, TimeOffsetFit, str]:
    sample = board_sample(camera_session(seed, any_offset(seed), faults=(fault,), duration_s=duration_s))
    fit, said = told(sample)
    assert said.status is not Status.NOT_OBSERVABLE
    return sample, fit, " | ".join(f"{reason.verdict.value}: {reason.text}" for reason in said.reasons)


def numbers(pattern: str, text: str) -> list[float]:
    found = re.search(pattern, text)
    assert found, text
    return [float(each) for each in found.groups()]


def clock_error(sample: Sample, fit: TimeOffsetFit, late: Callable[[Array], Array]) -> float:
    """The largest error of the offset over time, over what its level, skew and jumps are known to; `late` s are the stamps at s."""
    since = np.linspace(1.0, 58.0, 30)
    since = since[np.abs(since - 29.975) > 2.0]  # where the step is, is known to a window
    stamp = sample.of_t_ns[0] + np.round((since + late(since)) * 1e9).astype(np.int64)
    t = (stamp + fit.coarse_ns - fit.alignment.track.origin_ns) * 1e-9
    wrong = fit.coarse_ns * 1e-9 + fit.alignment.shift(t) - (sample.td - late(since))
    assert fit.clock is not None
    sigma = fit.sigma + 30 * fit.clock.skew_sigma + sum(jump.sigma_s for jump in fit.clock.jumps)
    return float(np.abs(wrong).max()) / sigma


SEEDS = (0,)
MORE = pytest.param(tuple(range(10)), marks=pytest.mark.slow)


@pytest.mark.parametrize("seeds", [SEEDS, MORE])
def test_a_skew_is_named(seeds: tuple[int, ...]) -> None:
    for seed in seeds:
        sample, fit, said = faulty("image-skew", seed)
        ppm, sigma = numbers(r"CHECK: dt_imu0_cam0: the clock drifts: td changes by (\S+) \+- (\S+) ppm", said)
        assert abs(ppm + 50) < 4 * sigma < 10
        assert clock_error(sample, fit, lambda s: 50e-6 * s) < 4


@pytest.mark.parametrize("seeds", [SEEDS, MORE])
def test_a_step_is_named(seeds: tuple[int, ...]) -> None:
    for seed in seeds:
        sample, fit, said = faulty("image-step", seed)
        ms, sigma, at = numbers(r"FAIL: dt_imu0_cam0: the clock jumps: td changes by (\S+) \+- (\S+) ms at (\S+) s", said)
        assert abs(ms + 33) < max(4 * sigma, 0.06)
        assert at == pytest.approx(30, abs=2.5)
        assert clock_error(sample, fit, lambda s: np.where(s < 29.975, 0.0, 0.033)) < 4


@pytest.mark.parametrize("seeds", [SEEDS, MORE])
def test_missing_frames_are_named(seeds: tuple[int, ...]) -> None:
    for seed in seeds:
        sample, fit, said = faulty("image-drops-30", seed)
        share, missing, expected = numbers(r"CHECK: cam0: (\S+) % of the frames are missing \((\d+) of (\d+)\), the rate is 20 Hz", said)
        assert missing == expected - len(sample.of_t_ns)
        assert share == pytest.approx(30, abs=5)
        assert abs(fit.td - sample.td) < 4 * fit.sigma < 1e-4


@pytest.mark.parametrize("seeds", [SEEDS, MORE])
def test_jitter_is_named_twice(seeds: tuple[int, ...]) -> None:
    """By the stamps among themselves, and by the motion: the second sees it in stamps without any grid, too."""
    for seed in seeds:
        sample, fit, said = faulty("image-jitter-2", seed)
        assert numbers(r"as if its stamps jittered by (\S+) ms", said)[0] == pytest.approx(2.0, abs=0.25)
        assert numbers(r"cam0: stamps jitter by (\S+) \+- \S+ ms rms around a regular grid", said)[0] == pytest.approx(2.0, abs=0.2)
        assert abs(fit.td - sample.td) < 4 * fit.sigma < 5e-4


@pytest.mark.parametrize("seeds", [SEEDS, MORE])
def test_repeated_stamps_are_named(seeds: tuple[int, ...]) -> None:
    for seed in seeds:
        sample, fit, said = faulty("duplicate-stamps", seed)
        many = len(sample.of_t_ns) - len(np.unique(sample.of_t_ns))
        assert re.search(rf"CHECK: cam0: {many} (stamps repeat|frames have)", said), said
        assert abs(fit.td - sample.td) < 4 * fit.sigma < 1e-4


def test_a_stamp_that_is_not_set_is_named() -> None:
    sample, fit, said = faulty("zero-stamp", 0, 30.0)
    assert re.search(r"1 (stamp is|frame has a stamp of) zero", said), said
    assert abs(fit.td - sample.td) < 4 * fit.sigma < 1e-4


def test_stamps_that_are_seconds_late_are_an_offset_of_seconds() -> None:
    session = camera_session(0, any_offset(0), faults=("image-late",))
    sample = replace(board_sample(session), td=any_offset(0) - 5.0)
    fit, said = told(sample)
    assert abs(fit.td - sample.td) < 4 * fit.sigma < 1e-4
    assert alarms(said) == []


# What is wrong and survived


@pytest.mark.parametrize("fault", ["imu-gap", "image-gap", "image-stamp"])
def test_gaps_and_one_wrong_stamp_are_survived(fault: str) -> None:
    sample, fit, _ = faulty(fault, 1, 30.0)
    assert abs(fit.td - sample.td) < 4 * fit.sigma < 1e-4


def posed(seed: int, spoil: Callable[[Array, np.random.Generator], Array], gyro: Callable[[Array], Array] = lambda rate: rate) -> Sample:
    """Poses and an IMU, with something done to the quaternions or to the rates."""
    truth, rng, td = path(seed), np.random.default_rng((seed, 9)), any_offset(seed)
    poses = seen_poses(truth, stamps(20, 58, 1.0123), 1e-3, rng, R_OF_TO.T, td)
    imu = seen_gyro(truth, stamps(200, 60), rng)
    poses = PoseSamples(poses.t_ns, spoil(poses.q, rng), poses.p, poses.parent, poses.child)
    return Sample(turns_of_poses(poses), poses.t_ns, replace(imu, gyro=gyro(imu.gyro)), td)


def turned_wrong(q: Array, rows: NDArray[np.generic], by: Array) -> Array:
    out = q.copy()
    out[rows] = so3.quat_multiply(q[rows], so3.quat_exp(by))
    return out


def one_gross(q: Array, rng: np.random.Generator) -> Array:
    return turned_wrong(q, np.array([400]), np.array([[1.0, 2.0, 0.5]]))


def a_tenth(q: Array, rng: np.random.Generator) -> Array:
    rows = rng.choice(len(q), len(q) // 10, replace=False)
    return turned_wrong(q, rows, rng.uniform(-1, 1, (len(rows), 3)))


def a_tenth_alike(q: Array, rng: np.random.Generator) -> Array:
    rows = rng.choice(len(q), len(q) // 10, replace=False)
    return turned_wrong(q, rows, np.tile([0.3, 0.0, 0.0], (len(rows), 1)))


def test_one_gross_pose_moves_nothing() -> None:
    fit, said = told(posed(0, one_gross))
    clean, _ = told(posed(0, lambda q, rng: q))
    assert abs(fit.td - clean.td) < 0.3 * clean.sigma
    assert fit.n_turns - fit.alignment.turns == 2
    assert alarms(said) == []


@pytest.mark.parametrize("spoil", [a_tenth, a_tenth_alike])
@pytest.mark.parametrize("seeds", [SEEDS, MORE])
def test_a_tenth_of_wrong_poses_is_given_up_and_said(spoil: Callable[[Array, np.random.Generator], Array], seeds: tuple[int, ...]) -> None:
    for seed in seeds:
        sample = posed(seed, spoil)
        fit, said = told(sample)
        assert abs(fit.td - sample.td) < 4 * fit.sigma < 5e-4
        share = numbers(
            r"CHECK: dt_imu0_cam0: (\S+) % of the turns of cam0 contradict imu0", " | ".join(f"CHECK: {x}" for x in alarms(said))
        )
        assert share[0] == pytest.approx(19, abs=4)  # 1 - 0.9^2


def test_a_gyroscopes_bias_is_found() -> None:
    bias = np.array([0.1, -0.06, 0.08])
    sample = posed(0, lambda q, rng: q, lambda rate: rate + bias)
    fit, said = told(sample)
    assert abs(fit.td - sample.td) < 4 * fit.sigma < 3e-4
    np.testing.assert_allclose(fit.gyro_bias, bias + np.array([0.004, -0.003, 0.002]), atol=2e-4)
    assert alarms(said) == []


@pytest.mark.parametrize("seeds", [SEEDS, MORE])
def test_a_gyroscopes_scale_error_is_paid_for(seeds: tuple[int, ...]) -> None:
    for seed in seeds:
        sample, right = (posed(seed, lambda q, rng: q, lambda rate, by=by: by * rate) for by in (1.02, 1.0))  # type: ignore[misc]
        fit = sample.fitted
        assert abs(fit.td - sample.td) < 4 * fit.sigma < 1e-3
        assert fit.sigma > 1.5 * right.fitted.sigma  # what is left goes with the motion, and is no white noise


def test_an_offset_beyond_the_sweep_is_found_by_correlation() -> None:
    sample = pose_imu(path(3), 3, -123.456, 1e-3, 30.0)
    fit, said = told(sample)
    assert abs(fit.td - sample.td) < 4 * fit.sigma
    assert alarms(said) == []


def test_streams_without_order_are_sorted() -> None:
    sample = pose_imu(path(0), 0, 0.05, 1e-3, 20.0)
    assert isinstance(sample.reference, ImuSamples)
    mixed = sample.reference.select(np.random.default_rng(0).permutation(len(sample.reference.t_ns)))
    assert replace(sample, reference=mixed).fitted.td == sample.fitted.td
    assert sample.fitted.alignment.track.origin_ns == START_NS


def test_an_axis_of_the_wrong_sign_fails() -> None:
    """No rotation makes a left-handed frame: td is found by the other axes, and the rig must not pass."""
    sample = imu_imu(path(2), 2, 0.012)
    assert isinstance(sample.reference, ImuSamples)
    against = replace(sample.reference, gyro=-sample.reference.gyro)
    _, said = told(replace(sample, reference=against))
    assert any(reason.verdict is Verdict.FAIL and "flipped sign" in reason.text for reason in said.reasons)


@pytest.mark.parametrize("share", [0.02, 0.1])
def test_samples_that_an_imu_lost_cost_no_turns(share: float) -> None:
    sample = pose_imu(path(1), 1, 0.012, 1e-3, 30.0)
    assert isinstance(sample.reference, ImuSamples)
    imu = sample.reference.select(np.random.default_rng(5).random(len(sample.reference.t_ns)) > share)
    fit, _ = told(replace(sample, reference=imu))
    assert fit.n_turns > 0.97 * len(sample.turns.first)
    assert abs(fit.td - 0.012) < 4.5 * fit.sigma < 5e-4


def test_stamps_in_bursts_are_refused() -> None:
    sample = pose_imu(path(1), 1, 0.012, 1e-3, 20.0)
    assert isinstance(sample.reference, ImuSamples)
    t_ns = sample.reference.t_ns // 50_000_000 * 50_000_000 + np.arange(len(sample.reference.t_ns)) % 10 * 1000
    with pytest.raises(BadInputError, match="bursts"):
        told(replace(sample, reference=replace(sample.reference, t_ns=t_ns)))
