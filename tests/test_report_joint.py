"""The report of a joint calibration: its pictures and signals on samples made up here, and what the stage itself leaves."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text
from report_samples import residual_set
from report_samples import result as camera_result

from calibkit.data.result import ResidualSet, Result
from calibkit.data.rig import Rig, StageRun
from calibkit.data.verdict import Verdict
from calibkit.io.residual_file import load_result, save_residuals
from calibkit.io.rig_file import save_rig
from calibkit.report.figures import PICTURES, draw, plates
from calibkit.report.joint_figures import STRETCH_S
from calibkit.report.signals import measure, not_good
from calibkit.report.view import views
from calibkit.report.whiteness import autocorrelation, spectrum

START_NS = 1_500_000_000_000_000_000
RATE_HZ = 200.0
DENSITY = 2e-3


def samples(n=6000, seed=0, noise=None, scale=0.0, dropped=()):
    """A gyroscope's set: motion that doubles every 10 s, noise (n, 3) of its own or white; `scale` is its wrong scale."""
    rng = np.random.default_rng(seed)
    t = np.arange(n) / RATE_HZ
    waves = np.sin(2 * np.pi * t[:, None] * rng.uniform(0.3, 1.0, 3)) * (0.2 * 2 ** (t / 10))[:, None]
    left = (DENSITY * np.sqrt(RATE_HZ) * rng.standard_normal((n, 3)) if noise is None else noise) + scale * waves
    kept = np.ones(n, bool)
    kept[list(dropped)] = False
    left[~kept] += 3.0
    context = {"measured": waves + left, "kept": kept, "rate": np.linalg.norm(waves, axis=1)}
    return ResidualSet("imu0_gyro", "rad/s", START_NS + np.round(1e9 * t).astype(np.int64), left, np.full(n, 0.03), context)


def way(n=300, seed=0):
    """The set of the way: a circle in the board's x and y, biases of one size each."""
    turn = np.linspace(0, 2 * np.pi, n)
    place = np.stack([0.3 * np.cos(turn), 0.2 * np.sin(turn), 0.9 + 0 * turn], axis=1)
    bias = np.tile([0.01, 0.02, 0.03, 0.1, 0.2, 0.3], (n, 1))
    t_ns = START_NS + np.arange(n) * 100_000_000
    context = {"place": place, "bias": bias, "bias_sigma": 0.1 * bias}
    return ResidualSet("imu0", "sigma", t_ns, np.random.default_rng(seed).standard_normal((n, 6)), np.ones(n), context)


def result(*sets):
    names = {each.sensor for each in sets}
    return Result("joint", Rig(), (), sets, {"t_zero_ns": dict.fromkeys(names, START_NS)})


def signals_of(*sets):
    return {signal.probe.key: signal for view in views(result(*sets)) for signal in measure(view)}


def drawn(made, key):
    """Return a picture's texts as one string, and the picture."""
    (picture,) = [one for one in PICTURES if one.key == key]
    view = next(view for view in views(made) if view.has(picture.needs))
    figure = Figure(figsize=(9, picture.height))
    picture.draw(figure, view)
    return "\n".join(text.get_text() for text in figure.findobj(Text)), figure


def test_each_set_has_its_pictures_twice_the_same():
    made = result(samples(), way())
    first, again = ({(v.sensor, one.plate.key): one for v in views(made) for one in draw(plates(v), ["png"])} for _ in range(2))
    assert set(first) == {("imu0_gyro", key) for key in ("imu_fit", "whiteness", "residual_rate")} | {("imu0", "biases"), ("imu0", "way")}
    for key, one in first.items():
        assert (one.svg, one.files) == (again[key].svg, again[key].files)
        assert len(one.svg) < 5e5


def test_the_stretch_is_where_the_motion_is_greatest_and_the_line_is_what_was_predicted():
    made = samples()
    _, figure = drawn(result(made), "imu_fit")
    squares, line = figure.axes[0].lines
    x, y = line.get_data()
    assert np.ptp(x) == pytest.approx(STRETCH_S, abs=0.01)
    assert x[-1] > 25  # the motion grows
    rows = np.round(x * RATE_HZ).astype(int)
    np.testing.assert_allclose(y, made.context["measured"][rows, 0] - made.raw[rows, 0], atol=1e-9)
    np.testing.assert_allclose(squares.get_ydata(), made.context["measured"][rows, 0], atol=1e-9)


def test_samples_that_were_given_up_are_marked_and_do_not_set_the_scale():
    dropped = (100, 3000)
    said, figure = drawn(result(samples(dropped=dropped)), "imu_fit")
    assert "× given up" in said
    whole = figure.axes[1]
    assert max(np.abs(whole.get_ylim())) < 1
    crosses = next(line for line in whole.lines if line.get_marker() == "x")
    np.testing.assert_allclose(crosses.get_xdata(), np.array(dropped) / RATE_HZ, atol=1e-6)
    assert "given up" not in drawn(result(samples()), "imu_fit")[0]


def test_biases_have_bands_of_three_sigma():
    _, figure = drawn(result(way()), "biases")
    gyro, accel = figure.axes
    low, high = (np.concatenate([band.get_paths()[0].vertices[:, 1] for band in panel.collections]) for panel in (gyro, accel))
    assert (low.min(), low.max()) == pytest.approx((0.007, 0.039))
    assert (high.min(), high.max()) == pytest.approx((0.07, 0.39))


def test_the_way_is_drawn_from_three_sides_at_one_scale():
    _, figure = drawn(result(way()), "way")
    sizes = [np.ptp(limits) for panel in figure.axes for limits in (panel.get_xlim(), panel.get_ylim())]
    np.testing.assert_allclose(sizes, sizes[0])
    curve, start, end = figure.axes[0].lines
    assert np.ptp(curve.get_xdata()) == pytest.approx(0.6, rel=0.01)
    np.testing.assert_allclose([start.get_xdata()[0], end.get_ydata()[0]], [0.3, 0.0], atol=1e-9)


def test_the_spectrum_of_white_noise_is_its_density():
    t = np.arange(40_000) / RATE_HZ
    x = DENSITY * np.sqrt(RATE_HZ) * np.random.default_rng(0).standard_normal((len(t), 3))
    frequency, density = spectrum(t, x)
    assert frequency[-1] == pytest.approx(RATE_HZ / 2)
    np.testing.assert_allclose(np.sqrt(np.mean(density[:-1] ** 2, axis=0)), DENSITY, rtol=0.02)
    lags, rho, chance = autocorrelation(t, x)
    assert lags[0] == pytest.approx(1 / RATE_HZ)
    assert np.abs(rho).max() < chance
    assert np.std(rho) == pytest.approx(len(t) ** -0.5, rel=0.2)


def test_a_vibration_stands_in_the_spectrum_at_its_frequency():
    t = np.arange(8000) / RATE_HZ
    x = np.sin(2 * np.pi * 37 * t)[:, None] * [0, 1, 0] + 0.1 * np.random.default_rng(0).standard_normal((8000, 3))
    frequency, density = spectrum(t, x)
    assert frequency[np.argmax(density[:, 1])] == pytest.approx(37, abs=0.5)
    assert density[:, 1].max() > 20 * density[:, 0].max()


def test_noise_alone_is_good():
    for seed in range(20):
        found = signals_of(samples(seed=seed), way(seed=seed))
        assert set(found) == {"fast_samples", "autocorrelation"}
        assert not_good(found.values()) == ()


def test_an_autocorrelation_is_found_with_its_size_and_axis():
    rng = np.random.default_rng(0)
    white = rng.standard_normal((6001, 3))
    noise = white[1:] + [0, 0, 1] * white[:-1]  # MA(1): 0.5 at one sample's lag
    signal = signals_of(samples(noise=0.03 * noise))["autocorrelation"]
    assert signal.value == pytest.approx(0.5, abs=0.05)
    assert signal.verdict is Verdict.CHECK
    assert signal.note == "z, 5 ms apart"
    freedom = white[1:] - 0.5 * white[:-1]  # what a spline leaves of white noise: negative
    signal = signals_of(samples(noise=0.03 * freedom))["autocorrelation"]
    assert signal.verdict is Verdict.PASS


def test_a_wrong_scale_shows_at_fast_turns():
    signal = signals_of(samples(scale=0.1))["fast_samples"]
    assert signal.verdict is Verdict.CHECK
    assert signal.value > 1.5
    assert "rad/s at" in signal.note


@pytest.mark.parametrize(("noise", "verdict", "mark"), [(0.2, Verdict.CHECK, "CHECK"), (0.01, Verdict.PASS, "-")])
def test_frames_that_get_worse_with_the_rate(noise, verdict, mark):
    """Residuals that grow fourfold: a CHECK, unless even the largest are small."""
    made = residual_set(frames=120, noise=noise)
    frame = made.context["frame"]
    rate = np.random.default_rng(0).uniform(0, 3, 120)[frame]
    turning = replace(made, context={**made.context, "rate": rate})
    grown = replace(turning, raw=made.raw * (1 + rate)[:, None])

    def signal(residuals):
        found = [one for view in views(camera_result(residuals=residuals, thumbnails=0)) for one in measure(view)]
        return next(one for one in found if one.probe.key == "fast_corners")

    assert signal(turning).verdict is Verdict.PASS
    assert (signal(grown).verdict, signal(grown).mark) == (verdict, mark)
    assert signal(grown).value > 2.5


def test_corners_of_a_frame_share_their_moment():
    """Against the change of the rate there are points, though most neighbouring rows have one and the same time."""
    made = residual_set(frames=120)
    frame = made.context["frame"].astype(np.int64)
    rate = (1 + np.sin(frame / 5)) / 2
    turning = replace(made, t_ns=START_NS + 50_000_000 * frame, context={**made.context, "rate": rate})
    _, figure = drawn(camera_result(residuals=turning, thumbnails=0), "residual_rate")
    points = figure.axes[1].lines[0].get_xdata()
    assert len(points) > 100
    assert points.max() == pytest.approx(0.5 / 5 / 0.05, rel=0.05)


def test_the_residual_file_keeps_every_column(tmp_path):
    made = result(samples(dropped=(7,)), way())
    save_rig(made.rig, tmp_path / "rig.yaml")
    name, _ = save_residuals(made, tmp_path / "rig.yaml")
    run = StageRun(stage="joint", command="calibkit joint", calibkit="0.1", residual_file=name)
    read = load_result(tmp_path / "rig.yaml", made.rig, run)
    for old, new in zip(made.residuals, read.residuals, strict=True):
        assert set(old.context) == set(new.context)
        for key, column in old.context.items():
            np.testing.assert_array_equal(column, new.context[key])


@pytest.mark.parametrize("key", ["measured", "bias", "bias_sigma", "place"])
def test_absurd_columns_are_left_out(key):
    made = samples() if key == "measured" else way()
    column = made.context[key].copy()
    column[3] = np.nan
    (view,) = views(result(replace(made, context={**made.context, key: column})))
    assert len(view.raw) == len(made.raw) - 1
    draw(plates(view))
