"""Allan deviations against NIST's and Stable32's numbers, published recordings and known noise; thinned against exact; honest intervals."""

from pathlib import Path

import numpy as np
import pytest

from calibkit.errors import BadInputError
from calibkit.estimation.allan import KINDS, deviation, log_spaced, octaves
from calibkit.estimation.allan_confidence import degrees_of_freedom, interval

# NIST SP1065 (Riley 2008), table 31: averaging factors 1, 10, 100.
NIST = {
    "adev": (2.922319e-01, 9.965736e-02, 3.897804e-02),
    "overlapping": (2.922319e-01, 9.159953e-02, 3.241343e-02),
    "modified": (2.922319e-01, 6.172376e-02, 2.170921e-02),
    "tdev": (1.687202e-01, 3.563623e-01, 1.253382e00),
    "hdev": (2.943883e-01, 1.052754e-01, 3.910861e-02),
    "hadamard": (2.943883e-01, 9.581083e-02, 3.237638e-02),
    "totdev": (2.922319e-01, 9.134743e-02, 3.406530e-02),
}
STABLE32 = {
    "adev": "adev",
    "overlapping": "oadev",
    "modified": "mdev",
    "tdev": "tdev",
    "hdev": "hdev",
    "hadamard": "ohdev",
    "totdev": "totdev",
}


@pytest.mark.parametrize("exact", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_nist_thousand_points(kind: str, exact: bool) -> None:
    n = [1234567890]
    for _ in range(999):
        n.append(16807 * n[-1] % 2147483647)
    found = deviation(np.array(n) / 2147483647, 1.0, [1, 10, 100], kind, exact)
    np.testing.assert_allclose(found.dev[:, 0], NIST[kind], rtol=4e-7)


def stable32(folder: Path, name: str) -> np.ndarray:
    """Return the rows of a Stable32 table: factor, tau, number, alpha, lower, sigma, upper."""
    return np.loadtxt(folder / "allan_ocxo" / name)


def ocxo(folder: Path) -> np.ndarray:
    return np.loadtxt(folder / "allan_ocxo" / "ocxo_frequency.txt") / 1e7 - 1


@pytest.mark.parametrize("exact", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_stable32_at_all_taus(data_dir: Path, kind: str, exact: bool) -> None:
    table = stable32(data_dir, f"stable32_{STABLE32[kind]}_alltau.txt")
    found = deviation(ocxo(data_dir), 1.0, table[:, 1], kind, exact)
    np.testing.assert_allclose(found.dev[:, 0], table[:, 5], rtol=5.1e-5)  # half of their last digit
    np.testing.assert_array_equal(found.n, table[:, 2])


def test_stable32_finds_the_same_noise(data_dir: Path) -> None:
    table = stable32(data_dir, "stable32_oadev_alltau.txt")
    table = table[table[:, 0] < 19982 / 64]  # with fewer averages that of the tau before is kept
    found = deviation(ocxo(data_dir), 1.0, table[:, 1], exact=True)
    assert np.mean(found.alpha[:, 0] == table[:, 3]) > 0.98
    assert np.max(np.abs(found.alpha[:, 0] - table[:, 3])) <= 1


@pytest.mark.parametrize("kind", KINDS)
def test_stable32_intervals_for_the_noise_it_names(data_dir: Path, kind: str) -> None:
    table, of = stable32(data_dir, f"{STABLE32[kind]}_octave.txt"), KINDS[kind]
    m, alpha = table[:, 0].astype(np.int64), table[:, 3:4].astype(np.int64)
    _, low, high = interval(of.order - of.modified, of.modified, of.overlapped, of.reflected, m, 19983, alpha, 0.683)
    # Theirs sums in coarser steps where few terms are left, and looks up approximate coefficients where there are many.
    np.testing.assert_allclose(low[:, 0], table[:, 4] / table[:, 5], rtol=2e-3)
    np.testing.assert_allclose(high[:, 0], table[:, 6] / table[:, 5], rtol=4e-3)


@pytest.mark.parametrize(("exact", "within"), [(False, 1e-3), (True, 1e-5)])
def test_published_deviations_of_an_imu(data_dir: Path, exact: bool, within: float) -> None:
    x = np.loadtxt(data_dir / "allan_adis16405" / "imu_100hz.csv.gz", delimiter=",", skiprows=1)
    published = np.loadtxt(data_dir / "allan_adis16405" / "published_adev.csv", delimiter=",")
    found = deviation(x, 100.0, published[:, 0], exact=exact)
    np.testing.assert_allclose(found.tau, published[:, 0])
    np.testing.assert_allclose(found.dev, published[:, 1:], rtol=within)


def signals(n: int) -> dict[str, np.ndarray]:
    """Return rates that thinning may get wrong, each in its way; 1/8, 1/16 of the rate: in step with the strides."""
    rng, i = np.random.default_rng(0), np.arange(n)
    white = rng.normal(size=n)
    return {
        "white": white,
        "phase noise": np.diff(rng.normal(size=n + 1)),
        "walk": white + np.cumsum(rng.normal(scale=1e-3, size=n)),
        "drift": white + 1e-3 * i,
        "quantised": np.round(white) + 100.0,
        "vibration": white + 20 * np.sin(2 * np.pi * i / 8 + 0.3) + 20 * np.sin(2 * np.pi * i / 16 + 0.1),
        "slow vibration": white + 5 * np.sin(2 * np.pi * i / 333.3),
        "ramp": 1e-3 * i,
    }


@pytest.mark.parametrize("kind", ["overlapping", "modified", "hadamard"])
def test_thinned_is_within_a_thousandth_of_exact(kind: str) -> None:
    x = np.stack(list(signals(400_000).values()), axis=1)
    x = x[:, : 7 if kind == "hadamard" else None]  # a ramp has none but rounding: third differences take it away
    thinned = deviation(x, 200.0, log_spaced(len(x), 200.0, 40), kind)
    exact = deviation(x, 200.0, thinned.tau, kind, exact=True)
    np.testing.assert_array_equal(thinned.tau, exact.tau)
    np.testing.assert_allclose(thinned.dev, exact.dev, rtol=1e-3)
    assert not np.array_equal(thinned.dev, exact.dev)


@pytest.mark.parametrize("exact", [False, True])
def test_known_noise_is_named_and_within_the_interval(exact: bool) -> None:
    """95 % hold the truth: 200 channels of white noise, of which dev = sigma / sqrt m, and of its sum, sigma sqrt((2 m^2 + 1) / 6 m)."""
    rng, n = np.random.default_rng(1), 8192
    white = rng.normal(size=(n, 200))
    m = np.array([1, 4, 16, 64, 256, 1024, 2048])
    for x, truth, alpha in ((white, 1 / np.sqrt(m), 0), (np.cumsum(white, axis=0), np.sqrt((2 * m**2 + 1) / (6 * m)), -2)):
        found = deviation(x, 1.0, m, exact=exact)
        assert np.mean(found.alpha == alpha) > 0.95
        held = (found.lower < truth[:, None]) & (truth[:, None] < found.upper)
        assert np.all((held.mean(axis=1) > 0.88) & (held.mean(axis=1) < 0.995)), held.mean(axis=1)
        # edf s^2 / sigma^2 is chi-squared: its variance over the channels is 2 edf.
        edf = np.array([degrees_of_freedom(2, False, True, lag, n + 1, alpha) for lag in m.tolist()])
        spread = np.var((found.dev / truth[:, None]) ** 2, axis=1) * edf / 2
        assert np.all((spread > 0.65) & (spread < 1.5)), spread


def test_white_phase_noise_is_named() -> None:
    x = np.diff(np.random.default_rng(2).normal(size=4097))
    assert deviation(x, 1.0, [1, 4, 16]).alpha[:, 0].tolist() == [2, 2, 2]


def test_a_ramp_is_exact_and_a_constant_has_no_deviation() -> None:
    tau = octaves(100_000, 10.0)
    for exact in (False, True):
        ramp = deviation(np.arange(100_000) * 0.1 * 0.02, 10.0, tau, exact=exact)
        np.testing.assert_allclose(ramp.dev[:, 0], 0.02 * ramp.tau / np.sqrt(2), rtol=1e-6)
        still = deviation(np.full(100_000, 0.25), 10.0, tau, exact=exact)
        assert not still.dev.any()
        assert not still.upper.any()


def test_taus_are_rounded_deduplicated_and_told_back() -> None:
    x = np.random.default_rng(3).normal(size=(1000, 2))
    found = deviation(x, 100.0, [0.2, 0.011, 0.0101, 0.2, 400.0])
    np.testing.assert_allclose(found.tau, [0.01, 0.2])
    np.testing.assert_array_equal(found.n, [999, 961])
    np.testing.assert_array_equal(deviation(x[:, 0], 100.0, found.tau).dev[:, 0], found.dev[:, 0])
    assert len(deviation(x, 100.0).tau) > 30


@pytest.mark.parametrize(
    ("x", "rate_hz", "tau", "says"),
    [
        (np.r_[np.zeros(50), np.nan, np.zeros(50)], 100.0, None, "not finite"),
        (np.r_[np.zeros(50), np.inf, np.zeros(50)], 100.0, None, "not finite"),
        (np.r_[np.zeros(50), 1e300, np.zeros(50)], 100.0, None, "absurdly large"),
        (np.zeros(7), 100.0, None, "too few"),
        (np.zeros(100), 0.0, None, "0.0 Hz"),
        (np.zeros(100), np.nan, None, "nan Hz"),
        (np.zeros(100), 100.0, [0.0], "positive"),
        (np.zeros(100), 100.0, [0.1, np.nan], "positive"),
        (np.zeros(100), 100.0, [[0.1]], "one list"),
        (np.zeros(100), 100.0, [1e300], "too long"),
        (np.zeros(100), 100.0, [], "averaging time"),
    ],
)
def test_bad_input_is_refused(x: np.ndarray, rate_hz: float, tau: list[float] | None, says: str) -> None:
    with pytest.raises(BadInputError, match=says):
        deviation(x, rate_hz, tau)


def test_an_unknown_kind_or_shape_is_a_mistake() -> None:
    with pytest.raises(ValueError, match="overlapping, modified"):
        deviation(np.zeros(100), 1.0, kind="allan")
    with pytest.raises(ValueError, match=r"\(n, channels\)"):
        deviation(np.zeros((100, 2, 2)), 1.0)
