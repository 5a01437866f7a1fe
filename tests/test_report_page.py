"""The pages: self-contained, escaped, the same bytes twice, whatever the result holds."""

import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure
from report_samples import SIZE, residual_set, result

from calibkit.data.result import Result
from calibkit.data.rig import Estimate, Imu, Rig
from calibkit.data.transforms import make_time_offset, make_transform
from calibkit.data.verdict import Reason, Status, Verdict
from calibkit.detection.thumbnails import draw_corners
from calibkit.geometry import se3, so3
from calibkit.opencv import cv2
from calibkit.report.page import build
from calibkit.report.parameters import number, rows
from calibkit.report.summary import summarise
from calibkit.report.summary_text import text

EVIL = "<script>alert(1)</script>"


def pages(made):
    return build(summarise(made.rig, [made]))


class Checker(HTMLParser):
    """Collect tags and what they would load."""

    def __init__(self, html):
        super().__init__()
        self.tags, self.loaded, self.open = [], [], []
        self.feed(html)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.loaded += [value for key, value in attrs if key in ("src", "href", "srcset", "action")]
        if tag not in ("meta", "link", "br", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_one_page_that_needs_nothing_from_outside():
    files = pages(result(thumbnails=10))
    html = files["report.html"].decode()
    checked = Checker(html)
    assert checked.open == []
    assert all(source.startswith("data:") for source in checked.loaded)
    assert len(checked.loaded) == 1 + 5 + 10
    assert "script" not in checked.tags
    assert not re.search(r"@import|url\(", html)
    assert len(files["report.html"]) < 3e6
    assert sorted(files) == [
        *(f"pictures/cam0-intrinsics-{key}.png" for key in ("coverage", "field", "frames", "over_time", "scatter")),
        "report.html",
        "report.json",
        "report.md",
    ]
    assert html.index("Parameters") < html.index("Signals") < html.index("Residual scatter") < html.index("Worst frames")
    assert "<title>PASS · intrinsics of rig.bag · calibkit report</title>" in html


def test_a_thousand_frames_stay_below_three_megabytes():
    files = pages(result(residuals=residual_set(frames=1000), thumbnails=0))
    assert len(files["report.html"]) < 1.5e6


def test_text_from_files_is_escaped():
    made = result(topic=EVIL, residuals=residual_set(frames=6), reasons=(Reason(Verdict.CHECK, EVIL),), thumbnails=1)
    facts = {"frame_labels": {"cam0": [f"{EVIL} $x_{{$" for _ in range(6)]}}
    thumbnails = tuple(replace(thumbnail, label=f'"{EVIL}') for thumbnail in made.thumbnails)
    runs = [made.rig.provenance[0].model_copy(update={"command": EVIL, "stage": EVIL})]
    made = replace(made, facts=facts, thumbnails=thumbnails, rig=made.rig.model_copy(update={"provenance": runs}))
    html = pages(made)["report.html"].decode()
    assert "<script" not in html
    assert html.count("&lt;script&gt;alert(1)&lt;/script&gt;") >= 5
    assert Checker(html).open == []


@pytest.mark.slow
def test_the_same_input_gives_the_same_bytes_whatever_the_user_s_settings():
    first = pages(result(residuals=residual_set(frames=10), thumbnails=1))
    with matplotlib.rc_context({"font.size": 20, "axes.facecolor": "yellow", "svg.hashsalt": None}):
        assert pages(result(residuals=residual_set(frames=10), thumbnails=1)) == first


def test_the_schema_is_stable():
    data = json.loads(pages(result(residuals=residual_set(frames=6), thumbnails=0))["report.json"])
    assert data["schema"] == "calibkit-report/1"
    assert list(data) == [
        "schema", "verdict", "reasons", "limits", "not_observable", "parameters", "signals", "frames", "facts", "pictures", "provenance",
    ]  # fmt: skip
    assert data["parameters"][0] == {
        "part": "cam0", "name": "fx", "value": 460.0, "sigma": 0.045, "sigma_plain": pytest.approx(0.045 / 1.7),
        "sigma_factor": pytest.approx(1.7), "unit": "px", "status": "determined",
    }  # fmt: skip
    rms = data["signals"][0]
    assert (rms["key"], rms["unit"], rms["good"], rms["fail"], rms["smaller_is_better"]) == ("reprojection_rms", "px", 0.3, 1.0, True)
    assert {"file": "pictures/cam0-intrinsics-field.png", "sensor": "cam0", "key": "field"}.items() <= data["pictures"][1].items()
    assert len(data["frames"]) == 6
    assert json.dumps(data, allow_nan=False)


@pytest.mark.parametrize("plain", [None, 0.03])
def test_columns_that_are_empty_in_every_row_are_left_out(plain):
    """One row with a plain sigma keeps them."""
    known = {name: Estimate(value=460.0, sigma=0.045) for name in ("fy", "cx", "cy", "k1", "k2", "p1", "p2")}
    made = result(thumbnails=0, parameters={"fx": Estimate(value=460.0, sigma=0.045, sigma_plain=plain), **known})
    summary = summarise(made.rig, [])
    head, first = (line.split() for line in text(summary).splitlines() if line.startswith(("parameter", "cam0 fx")))
    page = build(summary)["report.html"].decode()
    fx = next(line for line in page.splitlines() if "<b>fx</b>" in line)
    if plain is None:
        assert head == ["parameter", "value", "sigma", "unit", "status"]
        assert first == ["cam0", "fx", "460.000", "0.045", "given"]
        assert (page.count("plain"), page.count("factor"), fx.count("<td")) == (0, 0, 5)
    else:
        assert head == ["parameter", "value", "sigma", "plain", "factor", "unit", "status"]
        assert first == ["cam0", "fx", "460.000", "0.045", "0.030", "1.50", "given"]
        assert '<td class="n">0.045</td><td class="n">0.030</td><td class="n">1.50</td>' in fx
        assert '<th class="n">plain sigma</th><th class="n">factor</th>' in page


def _nothing_kept(residuals):
    return replace(residuals, context={**residuals.context, "kept": np.zeros(len(residuals.raw), bool)})


@pytest.mark.parametrize(
    "change",
    [
        _nothing_kept,
        lambda r: replace(r, context={}),
        lambda r: replace(r, context={"uv": r.context["uv"]}),
        lambda r: replace(r, raw=np.zeros_like(r.raw)),
        lambda r: replace(r, raw=np.full_like(r.raw, np.nan)),
        lambda r: replace(r, context={**r.context, "uv": np.full_like(r.raw, 1e7)}),
        lambda r: replace(r, context={**r.context, "tilt": np.full(len(r.raw), np.nan)}),
        lambda r: replace(r, context={**r.context, "frame": np.zeros(len(r.raw), np.int32)}),
        lambda r: replace(r, context={**r.context, "frame": np.full(len(r.raw), 2**31 - 1, np.int32)}),
        lambda r: replace(r, raw=np.full_like(r.raw, 1e200)),
        lambda r: replace(r, t_ns=r.t_ns[:1], raw=r.raw[:1], sigma=r.sigma[:1], context={k: v[:1] for k, v in r.context.items()}),
        lambda r: replace(r, t_ns=r.t_ns[:0], raw=r.raw[:0], sigma=r.sigma[:0], context={k: v[:0] for k, v in r.context.items()}),
    ],
    ids=[
        "nothing kept",
        "no context",
        "pixels only",
        "perfect",
        "no prediction",
        "far outside",
        "no tilt",
        "one frame",
        "odd index",
        "absurd",
        "one",
        "none",
    ],
)
def test_odd_residuals_still_give_a_page(change, monkeypatch):
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: None)  # the figure is drawn once all the same
    made = replace(result(residuals=residual_set(frames=5, outliers=2), thumbnails=0))
    made = replace(made, residuals=(change(made.residuals[0]),))
    assert Checker(pages(made)["report.html"].decode()).open == []


def test_every_part_of_a_rig_is_in_the_table():
    R_z = [[0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1]]
    rig = Rig(
        cameras=result(thumbnails=0).rig.cameras,
        imus={"imu0": Imu(gyro_noise_density=Estimate(value=1.7e-4, unit="rad/s/sqrt(Hz)"))},
        transforms={
            "T_cam1_cam0": make_transform("cam1", "cam0", R_z, np.diag([1e-6, 4e-6, 9e-6, 1e-8, 1e-8, 4e-8]), Status.DETERMINED),
            "T_cam0_imu0": make_transform("cam0", "imu0", R_z, status=Status.NOT_OBSERVABLE),
        },
        time_offsets={"dt_imu0_cam0": make_time_offset("imu0", "cam0", Estimate(value=-0.008, sigma=1e-5, unit="s", status=Status.WEAK))},
    )
    table = {(row.part, row.name): row for row in rows(rig)}
    assert len(table) == 8 + 1 + 6 + 6 + 1
    p_x = table["T_cam1_cam0", "p_x"]
    assert (p_x.value_text, p_x.sigma_text) == ("0.1000", "0.0020")  # sigma of rho_y, which R_z turns into x
    assert table["T_cam1_cam0", "r_z"].note == "90.0000 deg"
    assert table["T_cam1_cam0", "r_z"].sigma == pytest.approx(2e-4)
    assert table["T_cam0_imu0", "p_x"].value is None
    assert (table["dt_imu0_cam0", "offset"].value_text, table["dt_imu0_cam0", "offset"].sigma_text) == ("-0.008000", "1.0e-05")
    summary = summarise(rig, [Result(stage="joint", rig=rig, reasons=())])
    assert summary.verdict is Verdict.FAIL
    assert "T_cam0_imu0: not observable in this recording: p_x" in summary.reasons[0].text
    assert b'T_cam0_imu0 <b>p_x</b></td><td class="n">\xe2\x80\x93' in build(summary)["report.html"]


def test_the_sigma_of_a_rotation_vector_is_that_of_its_own_components():
    """Against 4000 draws of R exp(phi) about a turn of 2 rad, where phi's axes and the vector's are far apart."""
    T = se3.make(so3.exp(np.array([1.2, -0.8, 1.4])), np.zeros(3))
    cov = np.diag([0, 0, 0, 1e-8, 9e-8, 4e-8])
    steps = np.random.default_rng(0).multivariate_normal(np.zeros(6), cov, 4000)
    drawn = so3.log(se3.retract(T, steps)[:, :3, :3]).std(axis=0)
    told = [row.sigma for row in rows(Rig(transforms={"T_a_b": make_transform("a", "b", T, cov, Status.DETERMINED)}))][3:]
    np.testing.assert_allclose(told, drawn, rtol=0.05)


@pytest.mark.parametrize(
    ("value", "text"), [(0.0449, "0.045"), (12.34, "12"), (1.5e-5, "1.5e-05"), (3e-9, "3.0e-09"), (123456.0, "1.2e+05"), (0.0, "0")]
)
def test_a_sigma_has_two_digits(value, text):
    assert number(value) == text


def test_a_thumbnail_shows_kept_and_dropped_corners_apart():
    image = np.full((SIZE[1], SIZE[0]), 255, np.uint8)
    found = np.array([[200.0, 200.0], [500.0, 300.0]])
    jpeg = draw_corners(image, found, found + np.array([[0.1, 0.0], [80.0, 0.0]]), np.array([True, False]), "caption é")
    picture = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR).astype(int)
    scale = 640 / SIZE[0]
    assert picture.shape == (round(SIZE[1] * scale) + 22, 640, 3)

    def around(at):
        x, y = np.round(np.array(at) * scale).astype(int)
        return picture[y - 6 : y + 7, x - 6 : x + 7].reshape(-1, 3)

    redness = [np.max(around(at)[:, 2] - around(at)[:, 0]) for at in found]
    assert redness[0] < 120 < redness[1]
    assert np.min(around(found[0]).sum(axis=1)) < 500
    deep = draw_corners((image.astype(np.uint16) << 8), found, found * np.nan, np.array([True, False]), "16 bit, no prediction")
    assert cv2.imdecode(np.frombuffer(deep, np.uint8), cv2.IMREAD_COLOR).shape == picture.shape


def test_a_thumbnail_of_twelve_bits_in_sixteen_is_as_clear_as_one_of_eight():
    y, x = np.mgrid[: SIZE[1], : SIZE[0]]
    image = (127 + 127 * np.sin(x / 40) * np.sin(y / 40)).astype(np.uint8)
    nothing = np.zeros((0, 2))
    jpegs = [draw_corners(i, nothing, nothing, np.zeros(0, bool), "") for i in (image, image.astype(np.uint16) << 4)]
    eight, twelve = (cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE).astype(float) for jpeg in jpegs)
    assert np.abs(eight - twelve).mean() < 2
