"""The report of a time offset: its pictures and signals, on recordings made up here: a camera at 20 Hz against a gyroscope."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text

from calibkit.data.result import ResidualSet, Result
from calibkit.data.rig import Estimate, Rig, StageRun
from calibkit.data.transforms import make_time_offset
from calibkit.data.verdict import Status, Verdict
from calibkit.errors import BadInputError
from calibkit.io import residual_file
from calibkit.io.residual_file import load_result, save_residuals
from calibkit.report.figures import PICTURES, draw, plates
from calibkit.report.growth import growth
from calibkit.report.look import ACCENT
from calibkit.report.page import build
from calibkit.report.signals import measure, not_good
from calibkit.report.summary import summarise
from calibkit.report.view import views

SENSOR = "dt_imu0_cam0"
NOISE = 0.012  # rad/s a component of the camera's rates: 0.03 deg of its poses at 20 Hz
START_NS = 1_500_000_000_000_000_000


def motion(seed=0, size=1.0):
    """Return omega(t) (n, 3) rad/s: hand-held, waving in bouts, about `size` rad/s."""
    rng = np.random.default_rng(seed)
    f, phase, gain = rng.uniform(0.2, 1.3, (3, 5)), rng.uniform(0, 2 * np.pi, (3, 5)), rng.uniform(0.3, 0.7, (3, 5))

    def omega(t):
        bouts = 0.55 + 0.45 * np.sin(2 * np.pi * t / 23)
        waves = np.sum(gain * np.sin(2 * np.pi * f * t[:, None, None] + phase), axis=2)
        return size * bouts[:, None] * waves

    return omega


def sets(td=0.012, clock=None, size=1.0, duration=60.0, seed=0, far=False, second=None, scale=0.0):
    """Residual sets as the stage leaves them and the V's facts. `clock(t)` s is the true offset, `td` the one that was estimated.

    `scale` is the gyroscope's wrong scale, `far` an offset that leaves no overlap with the stamps as they are, `second` another bottom.
    """
    rng, norm = np.random.default_rng(seed + 1), np.linalg.norm
    waves = motion(seed, size)
    t = np.arange(1.0, duration, 0.05)
    seen = waves(t + (td if clock is None else clock(t))) + np.diff(rng.normal(0, NOISE / np.sqrt(2), (len(t) + 1, 3)), axis=0)
    kept = rng.random(len(t)) > 0.02
    seen[~kept] += rng.normal(0, 0.6, (int(np.sum(~kept)), 3))

    def gyro(delay):
        return (1 + scale) * waves(t + delay) + 0.002

    slope = norm(waves(t + 1e-3) - waves(t - 1e-3), axis=1) / 2e-3
    before = gyro(0.0) * (np.nan if far else 1.0)
    turns = {
        "kept": kept, "rate": norm(gyro(td), axis=1), "of_rate": norm(seen, axis=1),
        "rate_before": norm(before, axis=1), "before": seen - before,
    }  # fmt: skip
    delay = td + np.arange(-0.05, 0.0501, 0.0005)
    cost = np.array([np.sum((seen - gyro(d))[kept] ** 2) for d in delay]) / NOISE**2
    if second is not None:  # the same motion again, a little later
        cost = np.minimum(cost - cost.min(), 2.5 + ((delay - second) / 1e-4) ** 2)
    sigma = min(NOISE / max(norm(slope), 1e-9), 1.0)
    at = np.arange(5.0, duration - 4, 5.0)
    sigmas = np.minimum([NOISE / max(norm(slope[abs(t - middle) < 5]), 1e-9) for middle in at], 1.0)
    model = np.full(len(at), td) if clock is None else clock(at)
    left = sigmas * rng.normal(size=len(at))
    windows = {"window_offset": model + left, "window_sigma": sigmas, "clock": model}
    made = (
        _set("rad/s", t, seen - gyro(td), np.full(len(t), NOISE), turns),
        _set("", None, (cost - cost.min())[:, None], np.ones(len(delay)), {"delay": delay}),
        _set("s", at, left[:, None], sigmas, windows),
    )
    return made, {"offset": td, "sigma": sigma, "low": td - 1.96 * sigma, "high": td + 1.96 * sigma, "second": second}


def _set(unit, t, raw, sigma, context):
    t_ns = np.zeros(len(raw), np.int64) if t is None else START_NS + np.round(1e9 * t).astype(np.int64)
    return ResidualSet(SENSOR, unit, t_ns, raw, sigma, context)


def result(status=Status.DETERMINED, told=None, **kwargs):
    """A result; `told` is what the stage says of the clock, its times counted from START_NS."""
    made, bottom = sets(**kwargs)
    known = status is not Status.NOT_OBSERVABLE
    estimate = Estimate(value=bottom["offset"] if known else None, sigma=bottom["sigma"] if known else None, unit="s", status=status)
    run = StageRun(stage="timeoffset", command="calibkit timeoffset rig.bag", calibkit="0.1")
    rig = Rig(time_offsets={SENSOR: make_time_offset("imu0", "cam0", estimate)}, provenance=[run])
    facts = {"v": {SENSOR: bottom}}
    if told is not None:
        facts |= {"time_offset": {SENSOR: {"clock": told}}, "t_zero_ns": {SENSOR: START_NS}}
    return Result("timeoffset", rig, (), made, facts)


PICTURES_OF = {"v_curve", "rates", "residual_rate", "offset_over_time"}
JUMPING = {"drifts": False, "skew": -4e-6, "jumps": [{"t": 31.0, "size": 0.033}]}
DRIFTING = {"drifts": True, "skew": 50e-6, "jumps": []}
CASES = {
    "good": {},
    "flat": {"size": 0.0, "td": 0.003, "status": Status.NOT_OBSERVABLE},
    "second": {"second": 0.045},
    "jump": {"td": 0.0285, "clock": lambda t: 0.012 + 0.033 * (t > 31), "told": JUMPING},
    "far": {"td": 83.0123, "far": True},
    "drift": {"td": 0.005, "clock": lambda t: 0.005 + 50e-6 * (t - 30), "told": DRIFTING},
    "scale": {"td": 0.005, "scale": 0.05},
}


def drawn_of(made):
    """Return the drawn pictures by key."""
    return {one.plate.key: one for view in views(made) for one in draw(plates(view), ["png"])}


def signals_of(made):
    return {signal.probe.key: signal for view in views(made) for signal in measure(view)}


def texts(made, key):
    """Return every text of a picture, as one string."""
    (view,) = [view for view in views(made) for one in draw_keys(view) if one.key == key]
    figure = Figure(figsize=(9, 4))
    next(one for one in PICTURES if one.key == key).draw(figure, view)
    return "\n".join(text.get_text() for text in figure.findobj(Text)), figure


def draw_keys(view):
    return [one for one in PICTURES if view.has(one.needs)]


@pytest.mark.parametrize("case", ["good", *(pytest.param(case, marks=pytest.mark.slow) for case in CASES if case != "good")])
def test_each_case_has_its_four_pictures_twice_the_same(case):
    first, again = (drawn_of(result(**CASES[case])) for _ in range(2))
    assert set(first) == PICTURES_OF
    for key, one in first.items():
        assert (one.svg, one.files) == (again[key].svg, again[key].files)
        assert len(one.svg) < 5e5


def test_the_v_says_its_bottom_with_the_formula():
    said, figure = texts(result(), "v_curve")
    sigma = sets()[1]["sigma"]
    assert f"t_imu0 = t_cam0 + td:  td = +12.000 ms, 95 %: {12 - 1960 * sigma:+.3f} ms to {12 + 1960 * sigma:+.3f} ms" in said
    near = figure.axes[1]
    assert near.get_xlim() == pytest.approx((12 - 3920 * sigma, 12 + 3920 * sigma))
    x, y = near.lines[1].get_data()  # the parabola meets the limit where the interval ends
    np.testing.assert_allclose(np.interp([12 - 1960 * sigma, 12 + 1960 * sigma], x, y), 3.84, rtol=0.01)


def test_a_flat_v_looks_flat_and_has_no_number():
    said, figure = texts(result(**CASES["flat"]), "v_curve")
    assert "does not tell td" in said
    assert "td =" not in said
    (panel,) = figure.axes
    assert panel.get_ylim()[1] > 20
    said, figure = texts(result(**CASES["flat"]), "offset_over_time")
    assert "does not tell td" in said
    assert "mean" not in said
    unknown = result(**CASES["flat"] | {"status": Status.DETERMINED})
    said, figure = texts(unknown, "v_curve")  # the interval is wider than the sweep
    assert "beyond what was tried" in said
    assert len(figure.axes) == 1


def test_a_second_bottom_is_marked_with_what_it_costs():
    said, _ = texts(result(second=0.045), "v_curve")
    assert "or +45.000 ms?" in said
    assert "second bottom\n+45.000 ms\ncost 2.5" in said
    assert "second" not in texts(result(), "v_curve")[0]


def test_an_offset_of_minutes_is_drawn_from_a_round_number_and_without_a_before():
    made = result(**CASES["far"])
    assert "time offset tau, ms from +83.0 s" in texts(made, "v_curve")[0]
    said, figure = texts(made, "rates")
    assert "imu0 has nothing at these times" in said
    assert len(figure.axes) == 2
    assert "before" not in texts(made, "residual_rate")[0]
    assert "td, ms from +83.0 s" in texts(made, "offset_over_time")[0]


def test_rates_show_the_busiest_seconds_with_and_without_the_shift():
    made = result()
    _, figure = texts(made, "rates")
    before, after, wrong, left = figure.axes
    x, y = after.lines[0].get_data()
    assert 5 < np.ptp(x) <= 6
    t = np.arange(0, 59, 0.05)
    rate = views(made)[0].rate
    walked = [np.sum(np.abs(np.diff(rate[(t >= s) & (t <= s + 6)]))) for s in range(53)]
    assert np.sum(np.abs(np.diff(y))) >= max(walked) - 1e-9
    assert np.nanstd(wrong.lines[1].get_ydata()) > 4 * np.nanstd(left.lines[1].get_ydata())
    assert before.get_ylim() == after.get_ylim()


def test_a_step_of_the_clock_is_marked_with_its_size_and_a_drift_in_ppm():
    said, figure = texts(result(**CASES["jump"]), "offset_over_time")
    assert "line: 1 jump (dashed)" in said
    assert "+33.00 ms" in said
    assert "ppm" not in said  # a skew that is no more than its sigma
    assert "mean" not in said
    (step,) = _marked(figure)
    assert step.get_xdata()[0] == 31.0  # where the text has it, and not between the windows at 30 and 35 s
    assert len(figure.axes) == 2  # below: what the clock leaves
    assert "the clocks drift apart by +50 ppm" in texts(result(**CASES["drift"]), "offset_over_time")[0]
    said, figure = texts(result(told={"drifts": False, "skew": 0.0, "jumps": []}), "offset_over_time")
    assert "the clocks run alike" in said
    assert "mean" in said
    assert "jump" not in said
    assert len(figure.axes) == 1


def test_times_count_from_the_zero_that_the_stage_gives():
    made = result(**CASES["jump"])
    for zero, label, later in ((START_NS - 10**9, "sample of imu0", 2.0), (None, "turn of cam0", 0.0), ("0", "turn of cam0", 0.0)):
        zeroed = replace(made, facts={**made.facts, "t_zero_ns": {SENSOR: zero}})
        for key in ("offset_over_time", "rates"):
            said, figure = texts(zeroed, key)
            assert f"s after the first {label}" in said
            if key == "offset_over_time":
                assert [step.get_xdata()[0] for step in _marked(figure)] == ([31.0] if later else [])  # counted from that zero, if from any
                first = figure.axes[0].containers[1].lines[0].get_xdata()[0]
                assert first == pytest.approx(5.0 - 1 + later, abs=0.03)


def _marked(figure):
    return [line for line in figure.axes[0].lines if line.get_linestyle() == "--" and line.get_color() == ACCENT]


def test_growth_is_found_with_its_size_and_noise_has_none():
    """|residual| = 0.1 + 0.05 x with noise of 0.02: 100 seeds, the slope's sigma holds; without, it is chance."""
    z = []
    for seed in range(100):
        rng = np.random.default_rng(seed)
        x = rng.uniform(0, 3, 1000)
        found = growth(x, 0.1 + 0.05 * x + rng.normal(0, 0.02, 1000))
        z.append((found.slope - 0.05) / found.slope_sigma)
        assert found.at_rest == pytest.approx(0.1, abs=0.01)
    assert 0.6 < np.sqrt(np.mean(np.square(z))) < 1.3
    assert growth(np.ones(1000), np.ones(1000)) is None
    assert growth(np.arange(50.0), np.ones(50)) is None
    assert growth(np.arange(100.0), np.zeros(100)).slope == 0


def test_good_recordings_raise_no_signal():
    """20 seeds, td from -200 to 200 ms, 0.3 to 4 rad/s, and recordings at rest."""
    for seed, (td, size) in enumerate(zip(np.linspace(-0.2, 0.2, 20), np.geomspace(0.3, 4, 20), strict=True)):
        found = signals_of(result(td=td, size=size, seed=seed))
        assert not_good(found.values()) == ()
        assert {"over_before", "window_scatter"} <= set(found)
    assert not_good(signals_of(result(**CASES["flat"])).values()) == ()


def test_an_offset_that_is_not_known_has_no_signals():
    """Even where turns and windows disagree by far: there is nothing to believe, or not to."""
    made = result(**CASES["scale"] | {"clock": lambda t: 0.005 + 1e-3 * np.sin(t)})
    assert len(signals_of(made)) == 3
    assert signals_of(_changed(made, 2, raw=np.full((W, 1), 0.01)))["window_scatter"].verdict is Verdict.CHECK
    unknown = result(**CASES["scale"] | {"status": Status.NOT_OBSERVABLE})
    assert signals_of(unknown) == {}


def test_a_wrong_scale_shows_as_growth_with_the_rate():
    signal = signals_of(result(**CASES["scale"]))["rate_growth"]
    assert signal.verdict is Verdict.CHECK
    assert signal.value == pytest.approx(5, abs=1.2)
    assert "at rest" in signal.note
    assert "calibkit imu" in signal.reason.text


def test_harmless_growth_is_left_in_peace():
    """At 200 Hz, 0.1 ms of jitter alone is 2 % of the rate."""
    made = result(scale=0.07)
    turns = made.residuals[0]
    fast = replace(turns, t_ns=START_NS + (turns.t_ns - START_NS) // 20)
    signal = signals_of(replace(made, residuals=(fast,)))["rate_growth"]
    assert signal.value > signal.probe.good
    assert (signal.verdict, signal.mark) == (Verdict.PASS, "-")
    assert "jitter" in signal.note


def test_an_offset_that_makes_it_worse_is_said():
    made = result()
    turns = made.residuals[0]
    context = {**turns.context, "before": turns.raw}
    swapped = replace(turns, raw=turns.context["before"], context=context)
    signal = signals_of(replace(made, residuals=(swapped,)))["over_before"]
    assert signal.verdict is Verdict.CHECK
    assert signals_of(made)["over_before"].value == pytest.approx(1 / signal.value)


@pytest.mark.parametrize(("scatter", "verdict", "mark"), [(5e-3, Verdict.CHECK, "CHECK"), (2e-5, Verdict.PASS, "-")])
def test_windows_that_scatter_beyond_their_sigma(scatter, verdict, mark):
    made = result()
    windows = made.residuals[2]
    left = scatter * np.where(np.arange(len(windows.raw)) % 2, 1.0, -1.0)
    context = {**windows.context, "window_sigma": np.full(len(left), scatter / 6)}
    signal = signals_of(replace(made, residuals=(replace(windows, raw=left[:, None], context=context),)))["window_scatter"]
    assert signal.value == pytest.approx(6)
    assert (signal.verdict, signal.mark) == (verdict, mark)


@pytest.mark.slow
def test_one_section_of_the_page_holds_them_in_reading_order():
    made = result()
    files = build(summarise(made.rig, [made]))
    html = files["report.html"].decode()
    assert html.count(f"<h2>{SENSOR} (timeoffset)</h2>") == 1
    titles = ["The V: cost", "Rotation rates before", "Residual against rotation", "Time offset over time"]
    assert sorted(html.index(f"<h3>{title}") for title in titles) == [html.index(f"<h3>{title}") for title in titles]
    assert {name for name in files if name.endswith(".png")} == {f"pictures/{SENSOR}-timeoffset-{key}.png" for key in PICTURES_OF}


def test_the_residual_file_keeps_every_column(tmp_path):
    made = result(**CASES["far"])
    name, _ = save_residuals(made, tmp_path / "rig.yaml")
    back = load_result(tmp_path / "rig.yaml", made.rig, StageRun(stage="timeoffset", command="c", calibkit="0", residual_file=name))
    for old, new in zip(made.residuals, back.residuals, strict=True):
        assert (new.sensor, list(new.context)) == (SENSOR, list(old.context))
        for key, values in old.context.items():
            np.testing.assert_array_equal(new.context[key], values)
    assert [view.bottom for view in views(back)] == [view.bottom for view in views(made)]


@pytest.mark.parametrize(
    ("key", "values"),
    [("rate", np.zeros((1180, 2))), ("before", np.zeros((1180, 2))), ("before", np.zeros(1180)), ("of_rate", np.zeros(1180, bool))],
)
def test_a_column_of_another_shape_or_type_is_refused_by_name(tmp_path, monkeypatch, key, values):
    made = result()
    turns = replace(made.residuals[0], context={**made.residuals[0].context, key: values})
    with monkeypatch.context() as patch:  # what a stranger writes
        patch.delitem(residual_file.COLUMNS, key)
        name, _ = save_residuals(replace(made, residuals=(turns,)), tmp_path / "rig.yaml")
    run = StageRun(stage="timeoffset", command="c", calibkit="0", residual_file=name)
    with pytest.raises(BadInputError, match=rf"damaged \({key} has (shape|type)"):
        load_result(tmp_path / "rig.yaml", made.rig, run)


def _changed(made, i, **columns):
    """Return the result with columns of one set replaced; raw and t_ns are columns too."""
    own = {key: columns.pop(key) for key in ("raw", "t_ns") if key in columns}
    one = replace(made.residuals[i], **own, context={**made.residuals[i].context, **columns})
    return replace(made, residuals=tuple(one if k == i else other for k, other in enumerate(made.residuals)))


def _with_v(made, **values):
    return replace(made, facts={"v": {SENSOR: {**made.facts["v"][SENSOR], **values}}})


def _rows(made, rows):
    cut = lambda r: ResidualSet(r.sensor, r.unit, r.t_ns[rows], r.raw[rows], r.sigma[rows], {k: v[rows] for k, v in r.context.items()})  # noqa: E731
    return replace(made, residuals=tuple(cut(one) for one in made.residuals))


N, K, W = (len(one.raw) for one in sets()[0])
ODD_ROWS = np.arange(N) % 2 == 1
ODD_CLOCK = {
    "time_offset": {SENSOR: {"clock": {"drifts": True, "skew": "1", "jumps": [1, {"t": "x"}, {"t": 1e300, "size": 0.1}]}}},
    "t_zero_ns": {SENSOR: START_NS},
}
ODD = {
    "no facts": lambda r: replace(r, facts={}),
    "facts of another kind": lambda r: replace(r, facts={"v": [1]}),
    "texts": lambda r: _with_v(r, offset="<script>"),
    "absurd bottom": lambda r: _with_v(r, offset=1e300, low=-1e300, high=1e301),
    "upside down": lambda r: _with_v(r, low=1.0, high=-1.0),
    "no width": lambda r: _with_v(r, low=0.012, high=0.012),
    "needle": lambda r: _with_v(r, low=0.012, high=0.012 + 1e-15),
    "at the end": lambda r: _with_v(r, offset=0.062, low=0.0619, high=0.0621),
    "second elsewhere": lambda r: _with_v(r, second=5.0),
    "one row": lambda r: _rows(r, slice(1)),
    "two rows": lambda r: _rows(r, slice(2)),
    "no rows": lambda r: _rows(r, slice(0)),
    "nothing kept": lambda r: _changed(r, 0, kept=np.zeros(N, bool)),
    "one kept": lambda r: _changed(r, 0, kept=np.arange(N) == 7),
    "rates unknown": lambda r: _changed(r, 0, rate=np.full(N, np.nan)),
    "rates in turn": lambda r: _changed(r, 0, rate=np.where(ODD_ROWS, np.nan, 1.0), of_rate=np.where(ODD_ROWS, 1.0, np.nan)),
    "rates absurd": lambda r: _changed(r, 0, rate=np.full(N, 1e200), of_rate=np.full(N, -np.inf)),
    "rates equal": lambda r: _changed(r, 0, rate=np.ones(N), of_rate=np.ones(N), rate_before=np.ones(N)),
    "before in part": lambda r: _changed(r, 0, before=np.where(np.arange(N)[:, None] % 3, np.nan, 1.0)),
    "perfect": lambda r: _changed(r, 0, raw=np.zeros((N, 3)), before=np.zeros((N, 3))),
    "one time": lambda r: _changed(r, 0, t_ns=np.zeros(N, np.int64)),
    "backwards": lambda r: _changed(r, 0, t_ns=np.linspace(2**63 - 1025, -(2**63), N).astype(np.int64)),
    "cost zero": lambda r: _changed(r, 1, raw=np.zeros((K, 1))),
    "cost absurd": lambda r: _changed(r, 1, raw=np.full((K, 1), 1e17)),
    "one delay": lambda r: _changed(r, 1, delay=np.full(K, 0.012)),
    "delays unknown": lambda r: _changed(r, 1, delay=np.full(K, np.nan)),
    "delays absurd": lambda r: _changed(r, 1, delay=np.where(np.arange(K) % 2, 1e8, -1e8)),
    "sigma unknown": lambda r: _changed(r, 2, window_sigma=np.full(W, np.nan)),
    "sigma zero": lambda r: _changed(r, 2, window_sigma=np.zeros(W)),
    "sigma in part": lambda r: _changed(r, 2, window_sigma=np.where(np.arange(W) % 2, np.nan, 1e-4)),
    "sigma absurd": lambda r: _changed(r, 2, window_sigma=np.where(np.arange(W) % 2, 1e8, 1e-12)),
    "clock told oddly": lambda r: replace(_changed(r, 2), facts={**r.facts, **ODD_CLOCK}),
    "no clock": lambda r: _changed(r, 2, clock=np.full(W, np.nan)),
    "one clock": lambda r: _changed(r, 2, clock=np.where(np.arange(W) == 3, 0.012, np.nan)),
    "clock absurd": lambda r: _changed(r, 2, clock=np.where(np.arange(W) % 2, 1e8, -1e8)),
    "windows at one time": lambda r: _changed(r, 2, t_ns=np.zeros(W, np.int64)),
}  # fmt: skip


@pytest.mark.parametrize("change", ODD.values(), ids=ODD)
def test_odd_residuals_still_give_a_page(change, monkeypatch):
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: None)  # the figure is laid out once all the same
    whole = result()
    made = change(whole)
    touched = [new for old, new in zip(whole.residuals, made.residuals, strict=True) if new is not old]
    made = replace(made, residuals=tuple(touched or made.residuals[1:2]))  # facts are the V's
    html = build(summarise(made.rig, [made]))["report.html"].decode()
    assert "<script" not in html


def test_rows_unknown_in_a_column_that_is_not_needed_are_kept():
    made = result(**CASES["far"])
    assert [len(view.raw) for view in views(made)] == [N, K, W]
    assert views(made)[0].before is None
    part = _changed(result(), 0, before=np.where(np.arange(N)[:, None] < 100, np.nan, 1.0))
    assert len(views(part)[0].raw) == N
    assert len(views(_changed(result(), 1, delay=np.where(np.arange(K) < 5, np.nan, 0.01)))[1].raw) == K - 5
