"""The worked examples of the SPEC through the estimator's own core, and recordings that do not tell an offset."""

from dataclasses import replace

import numpy as np
import pytest
from time_offset_samples import Sample, constant_rate, path, pose_imu, refused, told

from calibkit.data.observations import ImuSamples
from calibkit.data.verdict import Status
from calibkit.errors import BadInputError
from calibkit.estimation.alignment import Alignment, sweep, weighed
from calibkit.estimation.orientation_track import track_of_gyro
from calibkit.estimation.time_offset import Settings, fit_time_offset
from calibkit.estimation.time_offset_result import early_or_late, smear
from calibkit.estimation.turn_comparison import Stretch, weigh
from calibkit.estimation.turn_noise import NoiseLevels
from calibkit.estimation.turns import Turns

F_PX, OMEGA, TD = 500.0, 2.0, 0.010
TAUS = np.array([0.0, 0.005, 0.010, 0.015])


def v_of_one_feature(omega: float) -> np.ndarray:
    """The costs (px^2) of a feature's displacement at f = 500 px by a turn that starts from rest, against the gyroscope's at t + tau."""
    t_ns = np.arange(0, 4_000_000_000, 5_000_000)
    rate = np.zeros((len(t_ns), 3))
    rate[t_ns >= 2_000_000_000, 1] = omega
    track = track_of_gyro(ImuSamples(t_ns, rate, np.zeros((len(t_ns), 0))))
    # The camera's stamps are 10 ms early: between stamps of 1 s and 3 s it saw the turn from rest to 3 s + td.
    stamps = np.array([1_000_000_000, 3_000_000_000])
    turned = np.array([0, omega * (1.0 + TD + 0.0025), 0])  # the rate goes up linearly over the sample before 2 s
    turns = Turns(stamps, np.array([0]), np.array([1]), turned[None], own_cov=np.eye(3)[None] / F_PX**2)
    stretch = Stretch(turns, 0, free_bias=False)
    keep = (np.ones(1, bool),)
    a = Alignment(track, (stretch,), keep, (), NoiseLevels(0.0, 1.0), np.ones(3), np.eye(3), False, 0.0)
    part = weigh(stretch, stretch.noise(track, a.R, a.shift(stretch.t), a.shape), a.levels)
    return sweep(replace(a, parts=(part,)), TAUS)


def test_the_v_of_worked_example_2() -> None:
    costs = v_of_one_feature(OMEGA)
    np.testing.assert_allclose(np.sqrt(costs), [10, 5, 0, 5], atol=1e-6)
    np.testing.assert_allclose(costs, [100, 25, 0, 25], atol=1e-5)


def test_at_rest_every_offset_costs_the_same() -> None:
    np.testing.assert_allclose(v_of_one_feature(0.0), 0, atol=1e-20)
    _, said = told(pose_imu(constant_rate(np.zeros(3)), 0, TD, 1e-3, 30.0))
    assert said.status is Status.NOT_OBSERVABLE
    assert "hardly turns" in said.reasons[0].text


def test_the_cost_of_an_error_of_worked_example_3() -> None:
    assert smear(1.0, 0.005, F_PX) == "2.5 px"
    assert smear(3.0, 0.005, F_PX) == "7.5 px"
    assert smear(1.0, -0.005, None) == "5 mrad"
    assert early_or_late("cam0", 0.0062) == "cam0's stamps are 6.200 ms early: add +6.200 ms to them"
    assert early_or_late("cam0", -0.008) == "cam0's stamps are 8.000 ms late: add -8.000 ms to them"


@pytest.mark.parametrize("td", [0.025, -0.025, 61.7, -4583.4])
def test_the_sign_and_any_size_of_an_offset(td: float) -> None:
    sample = pose_imu(path(1), 1, td, 1e-3, 30.0)
    fit, said = told(sample)
    assert abs(fit.td - td) < 4.5 * fit.sigma < 5e-4
    assert said.status is Status.DETERMINED


@pytest.mark.parametrize("noise", [1e-5, 1e-4, 1e-3])
@pytest.mark.parametrize("omega", [(0, 0, 0), (0.3, -0.2, 0.4), (1.5, 1.0, -2.0)])
def test_rest_and_constant_rates_tell_nothing(noise: float, omega: tuple[float, float, float]) -> None:
    assert refused(pose_imu(constant_rate(np.array(omega)), 3, 0.012, noise, 20.0))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20))
def test_rest_and_constant_rates_tell_nothing_over_seeds(seed: int) -> None:
    rng = np.random.default_rng((seed, 5))
    for omega in (np.zeros(3), rng.normal(size=3)):
        for noise in (1e-5, 1e-4, 1e-3):
            assert refused(pose_imu(constant_rate(omega), seed, 0.012, noise, 30.0)), (omega, noise)


def test_pure_translation_tells_nothing() -> None:
    assert refused(pose_imu(path(0, "translation"), 0, 0.012, 1e-3, 20.0))


def test_recordings_that_do_not_belong_together_are_refused() -> None:
    one, other = pose_imu(path(0), 0, 0.0, 1e-3, 40.0), pose_imu(path(9), 9, 0.0, 1e-3, 40.0)
    _, said = told(Sample(one.turns, one.of_t_ns, other.reference, 0.0))
    assert said.status is Status.NOT_OBSERVABLE
    assert "turn alike" in said.reasons[0].text


def test_streams_without_a_common_time_are_bad_input() -> None:
    one = pose_imu(path(0), 0, 0.0, 1e-3, 20.0)
    short = one.turns.select(slice(0, 5))
    with pytest.raises(BadInputError, match="too little time"):
        fit_time_offset(short, one.reference, Settings())


def test_a_weighed_stretch_is_white() -> None:
    """What `weighed` whitens has unit variance: the cost of the truth is the number of rows, less what was fitted."""
    fit, _ = told(pose_imu(path(2), 2, 0.01, 1e-3, 40.0))
    a = weighed(fit.alignment)
    rows = sum(len(part.stretch.turns.first) * 3 - 3 for part in a.parts)
    cost = float(sweep(a, np.array([a.tau]))[0])
    assert abs(cost / rows - 1) < 5 * np.sqrt(2 / rows)
