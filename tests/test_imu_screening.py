"""What spoils a static IMU recording is found with its time; honest noise is not."""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibkit.data.observations import ImuSamples
from calibkit.errors import BadInputError
from calibkit.estimation.imu_motion import Windows, check_levels
from calibkit.estimation.imu_screening import Finding, clean, rate_hz, screen
from calibkit.io.imu_options import ImuOptions
from calibkit.io.recording import open_recording
from calibkit.simulation.noise import SimNoise, simulate_noise

T0 = 1_700_000_000_000_000_000
RATE = 100.0
N = 120_000  # 20 minutes
GYRO, ACCEL = SimNoise(), SimNoise(white=2e-3, flicker=6e-4, walk=3e-5)
NOISES = {
    "typical": (GYRO, ACCEL),
    "flicker": (SimNoise(1e-4, 3e-4, 1e-6), SimNoise(1e-3, 3e-3, 1e-5)),
    "walk": (SimNoise(1e-4, 2e-5, 2e-5), SimNoise(1e-3, 2e-4, 3e-4)),
    "markov": (replace(GYRO, markov=3e-3, markov_time_s=0.3), replace(ACCEL, markov=1e-2, markov_time_s=30.0)),
}


def _static(seed: int, n: int = N, rate: float = RATE, gyro: SimNoise = GYRO, accel: SimNoise = ACCEL) -> ImuSamples:
    rng = np.random.default_rng(seed)
    t_ns = T0 + np.rint(np.arange(n) * (1e9 / rate)).astype(np.int64)
    turn, force = (simulate_noise(noise, n, rate, rng, 3) for noise in (gyro, accel))
    return ImuSamples(t_ns, turn + np.array([0.01, -0.02, 0.003]), force + np.array([0.1, 0.3, 9.7]))


@pytest.fixture(scope="module")
def still() -> ImuSamples:
    return _static(0)


def _found(samples: ImuSamples, kind: str) -> list[Finding]:
    return [finding for finding in screen(samples) if finding.kind == kind]


def _only(samples: ImuSamples, kind: str) -> Finding:
    """Return the one finding; nothing else may be alarmed by the fault."""
    findings = screen(samples)
    assert [finding.kind for finding in findings] == [kind], findings
    return findings[0]


def _changed(samples: ImuSamples, change: Callable[[np.ndarray, np.ndarray], None]) -> ImuSamples:
    gyro, accel = samples.gyro.copy(), samples.accel.copy()
    change(gyro, accel)
    return replace(samples, gyro=gyro, accel=accel)


def _seconds(samples: ImuSamples) -> np.ndarray:
    return (samples.t_ns - samples.t_ns[0]) * 1e-9


@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("seed", range(2))
def test_honest_noise_is_no_fault(noise: str, seed: int) -> None:
    samples = _static(seed, 90_000, 50.0, *NOISES[noise])
    assert screen(samples) == []
    (whole,) = clean(samples, [])
    assert whole.t_ns is samples.t_ns or np.array_equal(whole.t_ns, samples.t_ns)


@pytest.mark.slow
@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize(("seconds", "rate"), [(20, 200.0), (600, 100.0), (3600, 50.0), (10800, 20.0)])
def test_honest_noise_is_no_fault_over_all_seeds(noise: str, seconds: int, rate: float) -> None:
    alarms = [f for seed in range(40) for f in screen(_static(seed, int(seconds * rate), rate, *NOISES[noise])) if f.kind != "short"]
    assert alarms == []


def test_a_touch_of_the_table_is_found_and_cut(still: ImuSamples) -> None:
    at = slice(60_000, 60_100)  # 600 to 601 s

    def touch(gyro: np.ndarray, accel: np.ndarray) -> None:
        accel[at, 2] += 0.08 * np.sin(np.arange(100) * 0.9)

    touched = _changed(still, touch)
    finding = _only(touched, "motion")
    assert finding.cut
    assert 597 <= finding.t_start_s <= 600
    assert 601 <= finding.t_end_s <= 603.5
    assert "accelerometer z" in finding.text
    before, after = clean(touched, [finding])
    assert before.t_ns[-1] < touched.t_ns[60_000]
    assert after.t_ns[0] > touched.t_ns[60_099]
    assert screen(before) == [] or {f.kind for f in screen(before)} <= {"short"}


def test_each_of_several_motions_is_found(still: ImuSamples) -> None:
    def knock(gyro: np.ndarray, accel: np.ndarray) -> None:
        for begin in (20_000, 50_000, 90_000):
            gyro[begin : begin + 80, 0] += 0.02 * np.sin(np.arange(80) * 0.5)

    knocked = _changed(still, knock)
    found = _found(knocked, "motion")
    assert [round(f.t_start_s, -1) for f in found] == [200, 500, 900]
    assert len(clean(knocked, found)) == 4


def test_motion_that_leaves_another_attitude_is_motion_and_no_step(still: ImuSamples) -> None:
    def turn(gyro: np.ndarray, accel: np.ndarray) -> None:
        gyro[50_000:50_200, 1] += 0.5
        accel[50_000:50_200, 0] += np.linspace(0, 2, 200)
        accel[50_200:, 0] += 2

    assert _only(_changed(still, turn), "motion").t_start_s == pytest.approx(500, abs=2)


@pytest.mark.parametrize(("size", "axis"), [(0.02, 2), (-0.02, 0)])
def test_a_step_of_the_level_is_found(still: ImuSamples, size: float, axis: int) -> None:
    def step(gyro: np.ndarray, accel: np.ndarray) -> None:
        accel[70_000:, axis] += size

    finding = _only(_changed(still, step), "step")
    assert finding.t_start_s - 1 <= 700 <= finding.t_end_s + 1
    assert f"accelerometer {'xyz'[axis]} steps by {size:.1g}"[:-1] in finding.text
    assert finding.cut


def test_warming_up_is_found_and_cut(still: ImuSamples) -> None:
    def warm(gyro: np.ndarray, accel: np.ndarray) -> None:
        gyro[:, 0] += 0.03 * np.exp(-np.arange(N) / (60 * RATE))

    found = screen(_changed(still, warm))
    assert {f.kind for f in found} == {"drift"}
    assert found[0].t_start_s < 30
    assert 60 < max(f.t_end_s for f in found) < 500
    assert "gyroscope x" in found[0].text
    assert found[0].cut


def test_a_drift_throughout_is_found_and_kept(still: ImuSamples) -> None:
    def warm(gyro: np.ndarray, accel: np.ndarray) -> None:
        accel[:, 1] += np.linspace(0, 0.1, N)

    finding = _only(_changed(still, warm), "drift")
    assert not finding.cut
    rate = float(finding.text.split("drifts by ")[1].split()[0])
    assert rate == pytest.approx(0.3, rel=0.1)
    assert "accelerometer y" in finding.text


def test_a_long_gap_splits_and_a_short_one_is_told(still: ImuSamples) -> None:
    keep = np.ones(N, bool)
    keep[30_000:30_500] = False
    keep[80_000:80_010] = False
    gapped = still.select(keep)
    found = screen(gapped)
    assert [(f.kind, f.cut) for f in found] == [("gap", True), ("short_gap", False)]
    assert found[0].t_start_s == pytest.approx(299.99)
    assert found[0].t_end_s == pytest.approx(305.0)
    assert found[1].t_start_s == pytest.approx(799.99)
    assert "about 10 samples missing" in found[1].text
    assert [len(piece.t_ns) for piece in clean(gapped, found)] == [30_000, N - 30_510]
    assert rate_hz(gapped.t_ns) == pytest.approx(RATE, rel=1e-9)


def test_stamps_in_bursts_do_not_make_the_rate(still: ImuSamples) -> None:
    burst = np.arange(N) // 10 * 10
    bunched = replace(still, t_ns=still.t_ns[burst] + (np.arange(N) - burst) * 100_000)  # ten samples within a millisecond
    assert rate_hz(bunched.t_ns) == pytest.approx(RATE, rel=1e-4)
    assert "the mean rate, 100 Hz" in _only(bunched, "bursts").text


def test_many_missing_samples_are_more_than_told(still: ImuSamples) -> None:
    lossy = still.select(np.random.default_rng(0).random(N) > 0.3)
    assert rate_hz(lossy.t_ns) == pytest.approx(RATE)
    assert "K some 19" in _only(lossy, "missing").text  # 1 / sqrt(1 - 0.3)


def test_jitter_is_told(still: ImuSamples) -> None:
    late = np.random.default_rng(1).integers(0, 4_000_000, N)
    assert "stamps jitter: intervals scatter by" in _only(replace(still, t_ns=still.t_ns + late), "jitter").text
    assert rate_hz(still.t_ns) == pytest.approx(RATE)


def test_backward_stamps_are_put_in_order(still: ImuSamples) -> None:
    t_ns = still.t_ns.copy()
    t_ns[[5000, 5001]] = t_ns[[5001, 5000]]
    swapped = replace(still, t_ns=t_ns)
    finding = _only(swapped, "backward")
    assert finding.t_start_s == pytest.approx(50, abs=0.1)
    (ordered,) = clean(swapped, [finding])
    assert np.all(np.diff(ordered.t_ns) > 0)
    np.testing.assert_array_equal(ordered.gyro[5000], still.gyro[5001])


def test_duplicates_are_taken_once_and_a_coarse_clock_is_kept(still: ImuSamples) -> None:
    twice = still.select(np.sort(np.concatenate([np.arange(N), [4000, 4001, 4002]])))
    finding = _only(twice, "duplicate")
    assert (finding.t_start_s, finding.t_end_s) == (pytest.approx(40), pytest.approx(40.02))
    (once,) = clean(twice, [finding])
    np.testing.assert_array_equal(once.t_ns, still.t_ns)
    t_ns = still.t_ns.copy()
    t_ns[4001] = t_ns[4000]
    coarse = replace(still, t_ns=t_ns)
    found = screen(coarse)
    assert "same_stamp" in {f.kind for f in found}
    assert sum(len(piece.t_ns) for piece in clean(coarse, found)) == N


@pytest.mark.parametrize(("step", "kind"), [(0.01, "quantisation"), (0.08, "unresolved")])
def test_the_step_of_the_values_is_told_and_whether_noise_resolves_it(still: ImuSamples, step: float, kind: str) -> None:
    def quantise(gyro: np.ndarray, accel: np.ndarray) -> None:
        accel[:] = np.rint(accel / step) * step

    finding = _only(_changed(still, quantise), kind)
    assert f"the accelerometer: values come in steps of {step:g} m/s^2" in finding.text


def test_fine_steps_do_not_matter(still: ImuSamples) -> None:
    def rounded(gyro: np.ndarray, accel: np.ndarray) -> None:
        gyro[:], accel[:] = gyro.round(6), accel.astype(np.float32)

    assert screen(_changed(still, rounded)) == []


@pytest.mark.parametrize("hertz", [7.3, 21.0, 40.03])
def test_vibration_is_told_with_frequency_amplitude_and_axis(still: ImuSamples, hertz: float) -> None:
    def hum(gyro: np.ndarray, accel: np.ndarray) -> None:
        accel[:, 0] += 0.004 * np.sin(2 * np.pi * hertz * np.arange(N) / RATE)
        gyro[:, 2] += 0.0006 * np.sin(2 * np.pi * hertz * np.arange(N) / RATE)

    text = _only(_changed(still, hum), "vibration").text
    assert float(text.split("vibration at ")[1].split()[0]) == pytest.approx(hertz, abs=0.02)
    assert float(text.split("accelerometer x ")[1].split()[0]) == pytest.approx(0.004, rel=0.05)
    assert float(text.split("gyroscope z ")[1].split()[0]) == pytest.approx(0.0006, rel=0.1)


def test_clipping_and_a_dead_axis_are_told(still: ImuSamples) -> None:
    def clip(gyro: np.ndarray, accel: np.ndarray) -> None:
        np.minimum(accel[:, 2], 9.72, out=accel[:, 2])
        gyro[:, 1] = 0.25

    texts = {f.kind: f.text for f in screen(_changed(still, clip))}
    assert texts["saturation"].startswith("accelerometer z is clipped at 9.72 (")
    assert texts["frozen"] == "gyroscope y never changes (0.25 rad/s)"


def test_a_driver_that_repeats_its_sensor_is_told(still: ImuSamples) -> None:
    slow = np.repeat(np.arange(N // 2), 2)
    assert "50.0 % of the samples repeat" in _found(replace(still, gyro=still.gyro[slow], accel=still.accel[slow]), "repeated")[0].text


@pytest.mark.parametrize(
    ("scale", "told"),
    [
        (1 / 9.80665, "is it in g? then add --accel-unit g"),
        (1000 / 9.80665, "is it in mg?"),
        (0.01, "gravity is missing"),
        (3, "neither 9.81"),
    ],
)
def test_an_accelerometer_in_another_unit_is_told(still: ImuSamples, scale: float, told: str) -> None:
    assert told in _only(replace(still, accel=still.accel * scale), "accel_unit").text


def test_a_gyroscope_in_degrees_is_told(still: ImuSamples) -> None:
    assert "is it in deg/s? then add --gyro-unit deg/s" in _only(replace(still, gyro=np.rad2deg(still.gyro)), "gyro_unit").text


def test_counts_have_no_unit_to_judge(still: ImuSamples) -> None:
    assert screen(replace(still, gyro=still.gyro * 5000, accel=still.accel * 400 + 32768, unit="counts")) == []


@pytest.mark.parametrize("missing", ["gyro", "accel"])
def test_one_sensor_alone_is_screened(still: ImuSamples, missing: str) -> None:
    alone = replace(still, **{missing: np.zeros((N, 0))})
    assert screen(alone) == []
    (whole,) = clean(alone, [])
    assert getattr(whole, missing).shape == (N, 0)


def test_a_moving_recording_is_told(still: ImuSamples) -> None:
    t = np.arange(6000) / RATE

    def move(gyro: np.ndarray, accel: np.ndarray) -> None:
        gyro += np.sin(np.outer(t, [1.0, 1.7, 0.8])) * 0.3
        accel += np.sin(np.outer(t, [2.0, 1.1, 0.9]))

    moving = _changed(_static(1, 6000), move)
    found = {f.kind: f for f in screen(moving)}
    assert "the recording is not at rest" in found["moving"].text
    assert (found["moving"].t_start_s, found["moving"].t_end_s) == (0, pytest.approx(60, abs=1))


def test_a_short_recording_is_told() -> None:
    assert "lasts 20 s: enough for white noise at best" in _only(_static(3, 2001), "short").text


@pytest.mark.parametrize(
    ("samples", "told"),
    [
        (_static(0, 50), "the IMU has 50 samples: at least 100 are needed"),
        (replace(_static(0, 200), t_ns=np.zeros(200, np.int64)), "all stamps of the IMU are the same: .*--rate HZ"),
    ],
)
def test_what_cannot_be_judged_is_refused(samples: ImuSamples, told: str) -> None:
    with pytest.raises(BadInputError, match=told):
        screen(samples)
    with pytest.raises(BadInputError, match=told):
        clean(samples, [])


def test_nothing_left_is_refused(still: ImuSamples) -> None:
    with pytest.raises(BadInputError, match="nothing of 10 s or more is left of the recording"):
        clean(still, [Finding("motion", "", 5.0, 1e9, cut=True)])


def test_hours_are_screened_in_seconds() -> None:
    rng = np.random.default_rng(0)
    n = 3 * 3600 * 200
    samples = ImuSamples(np.arange(n) * 5_000_000, rng.normal(0, 2e-3, (n, 3)), rng.normal((0, 0, 9.8), 2e-2, (n, 3)))
    began = time.process_time()
    assert screen(samples) == []
    assert time.process_time() - began < 4  # measured 1.2


def test_a_real_recording_is_told_as_quantised_touched_and_shaken(data_dir: Path) -> None:
    samples = open_recording([data_dir / "allan_adis16405" / "imu_100hz.csv.gz"], imu=ImuOptions(rate_hz=100)).imu("imu_100hz")
    found = screen(samples)
    steps = [f.text for f in found if f.kind == "quantisation"]
    assert any("gyroscope: values come in steps of 0.00087266 rad/s" in text for text in steps)  # 0.05 deg/s
    assert any("accelerometer: values come in steps of 0.032656 m/s^2" in text for text in steps)  # 3.33 mg
    assert [f.t_start_s for f in found if f.kind == "motion"] == [pytest.approx(2.5, abs=1)]
    assert any("vibration at 0.56 Hz" in f.text for f in found)


def test_a_stuck_axis_makes_no_steps_of_rounding() -> None:
    """Sums over a constant 9.7 are off by 1e-12: that was taken for steps, and good data of the other axes was cut."""
    k = 1000
    stuck = Windows(np.arange(k + 1.0), np.full((k, 1), 9.7), np.zeros((k, 1)), np.zeros(1), 100, ("accel_z",), True)
    assert check_levels(stuck, np.zeros(k, bool)) == []
