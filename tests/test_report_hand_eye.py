"""The report of a hand-eye calibration: its pictures and signals, of fits on poses made up here, and of files that lie."""

import re
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text
from numpy.typing import NDArray

from calibkit.data.result import Result
from calibkit.data.rig import StageRun
from calibkit.data.verdict import Verdict
from calibkit.estimation.hand_eye import calibrate_hand_eye
from calibkit.estimation.hand_eye_asked import Asked
from calibkit.estimation.hand_eye_data import of_recording
from calibkit.estimation.hand_eye_result import hand_eye_result
from calibkit.geometry import se3, so3
from calibkit.io.residual_file import load_result, save_residuals
from calibkit.report.figures import PICTURES, draw, plates
from calibkit.report.hand_eye_figures import ELLIPSE
from calibkit.report.page import build
from calibkit.report.signals import measure
from calibkit.report.summary import summarise
from calibkit.report.summary_text import text
from calibkit.report.view import View, views

Array = NDArray[np.float64]
NAME = "T_gripper_cam"
KEYS = {"pose_residuals", "rotation_axes", "cross_sections", "poses_in_space"}
X = se3.make(so3.exp(np.array([0.3, -0.8, 1.2])), np.array([0.05, -0.08, 0.12]))
Z = se3.make(so3.exp(np.array([2.5, 0.4, -0.3])), np.array([0.9, 0.2, 0.1]))


def made(n: int = 30, wrong: tuple[int, ...] = (), one_axis: bool = False, seed: int = 0, **asked: object) -> Result:
    rng = np.random.default_rng(seed)
    turn = 0.5 * rng.normal(size=(n, 3)) * ([0, 0, 1] if one_axis else [1, 1, 1])
    G = se3.make(so3.exp(turn), np.array([0.5, 0, 0.6]) + 0.2 * rng.normal(size=(n, 3)))

    def noisy(T: Array) -> Array:
        return se3.retract(T, np.concatenate([3e-4 * rng.normal(size=(n, 3)), 4e-4 * rng.normal(size=(n, 3))], axis=1))

    second = noisy(se3.inverse(G @ X) @ Z)
    second[list(wrong)] = second[list(wrong)] @ se3.make(so3.exp(np.array([0.0, 0.1, 0.2])), np.array([0.1, 0.0, 0.05]))
    fit = calibrate_hand_eye(of_recording("eye-in-hand", noisy(G), second, labels=tuple(f"im_{k:02}.png" for k in range(n))))
    return hand_eye_result(fit, Asked(**asked))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def good() -> Result:
    return made(wrong=(4, 17), px=np.linspace(0.5, 1.5, 30))


def drawn(view: View, key: str) -> Figure:
    figure = Figure(figsize=(9, 4))
    next(picture for picture in PICTURES if picture.key == key).draw(figure, view)
    return figure


def words(figure: Figure) -> str:
    return " ".join(found.get_text() for found in figure.findobj(Text))


def poses_of(result: Result) -> View:
    return views(result)[0]


def test_all_pictures_are_drawn_and_the_same_each_time(good: Result) -> None:
    again = {
        f"pictures/{NAME}-handeye-{one.plate.key}.png": one.files["png"] for view in views(good) for one in draw(plates(view), ["png"])
    }
    page = build(summarise(good.rig, [replace(good, facts={**good.facts, "tables": [*good.facts["tables"], [["<b>"]]]})]))
    assert b"<th>&lt;b&gt;</th>" in page["report.html"]
    assert {f"pictures/{NAME}-handeye-{key}.png" for key in KEYS} == again.keys()
    assert all(page[key] == png for key, png in again.items())
    assert b"im_04.png" in page["report.html"]
    assert b"<td>daniilidis</td>" in page["report.html"]


def test_poses_that_were_left_out_are_marked_and_named(good: Result) -> None:
    figure = drawn(poses_of(good), "pose_residuals")
    assert len(figure.axes) == 3  # deg, mm and px
    said = words(figure)
    assert "2 poses left out (hatched)" in said
    assert "worst: im_" in said
    hatched = [bar for bar in figure.axes[0].patches if bar.get_hatch()]
    assert sorted(round(bar.get_x() + bar.get_width() / 2) for bar in hatched) == [4, 17]
    assert "rms 0.0" in said  # of the kept ones, in deg
    many = poses_of(made(150, wrong=(3,)))
    assert not drawn(many, "pose_residuals").axes[0].patches


def test_the_ellipse_holds_95_percent_of_the_estimate(good: Result) -> None:
    view = poses_of(good)
    figure = drawn(view, "cross_sections")
    cov = 1e6 * view.hand_eye.X[:3, :3] @ view.hand_eye.cov[:3, :3] @ view.hand_eye.X[:3, :3].T
    for panel, (i, j) in zip(figure.axes, ((0, 1), (0, 2), (1, 2)), strict=True):
        line = next(line for line in panel.lines if line.get_label() == "95 % of the estimate")
        x, y = np.array(line.get_data())
        assert x.max() == pytest.approx(ELLIPSE * np.sqrt(cov[i, i]), rel=1e-3)
        assert y.max() == pytest.approx(ELLIPSE * np.sqrt(cov[j, j]), rel=1e-3)
    draws = np.random.default_rng(0).multivariate_normal(np.zeros(2), np.eye(2), 20000)
    assert np.mean(np.linalg.norm(draws, axis=1) < ELLIPSE) == pytest.approx(0.95, abs=0.01)
    assert "park" in words(figure)


def test_what_is_open_is_not_drawn_as_if_it_were_known() -> None:
    result = made(one_axis=True)
    assert result.not_observable == (f"{NAME}.p_z", "T_base_target.p_z")
    view = poses_of(result)
    assert view.hand_eye.cov is None
    said = words(drawn(view, "cross_sections"))
    assert "not all of it is observable, so no ellipse is drawn" in said
    assert "95 %" not in said
    table = text(summarise(result.rig, [result]))
    rows = [line.split() for line in table.splitlines() if re.match(r"T_\w+ [pr]_[xyz] ", line)]
    assert len(rows) == 12
    assert [row[:2] for row in rows if row[-2:] == ["not", "observable"]] == [[NAME, "p_z"], ["T_base_target", "p_z"]]
    signal = next(signal for each in views(result) for signal in measure(each) if signal.probe.key == "second_axis")
    assert signal.verdict is Verdict.CHECK
    assert signal.value < 0.2


def test_axes_all_over_the_sphere_or_in_one_place() -> None:
    for one_axis in (False, True):
        view = views(made(one_axis=one_axis))[1]
        points = np.asarray(drawn(view, "rotation_axes").axes[0].collections[0].get_offsets())
        assert np.all(np.linalg.norm(points, axis=1) <= 1 + 1e-9)
        assert (np.linalg.norm(points, axis=1).max() > 0.9) != one_axis  # about z alone all are in the middle


def test_the_poses_in_space(good: Result) -> None:
    figure = drawn(poses_of(good), "poses_in_space")
    said = words(figure)
    assert "in base's axes" in said
    labels = {line.get_label() for line in figure.axes[0].lines}
    assert {"gripper", "cam", "target", "left out"} <= labels
    gripper = next(line for line in figure.axes[0].lines if line.get_label() == "gripper")
    camera = next(line for line in figure.axes[0].lines if line.get_label() == "cam")
    apart = np.array(camera.get_data_3d()) - np.array(gripper.get_data_3d())
    np.testing.assert_allclose(np.linalg.norm(apart, axis=0), np.linalg.norm(X[:3, 3]), atol=2e-3)


def test_signals_of_good_and_bad_poses(good: Result) -> None:
    found = {signal.probe.key: signal for view in views(good) for signal in measure(view)}
    assert found.keys() == {"pose_turn", "pose_shift", "poses_dropped", "second_axis"}
    assert all(signal.verdict is Verdict.PASS for signal in found.values())
    assert found["poses_dropped"].value == pytest.approx(100 * 2 / 30)
    assert found["second_axis"].value > 20
    kept = poses_of(good)
    assert found["pose_shift"].value == pytest.approx(1e3 * np.sqrt(np.mean(np.sum(kept.raw[kept.kept] ** 2, axis=1))))
    worse = replace(kept, raw=20 * kept.raw, turn=40 * kept.turn)
    bad = {signal.probe.key: signal.verdict for signal in measure(worse)}
    assert bad["pose_turn"] is Verdict.CHECK
    assert bad["pose_shift"] is Verdict.CHECK


def test_the_residual_file_gives_the_same_report(good: Result, tmp_path) -> None:
    run = StageRun(stage="handeye", command="calibkit handeye", calibkit="0")
    name, digest = save_residuals(good, tmp_path / "rig.yaml")
    rig = good.rig.model_copy(update={"provenance": [run.model_copy(update={"residual_file": name, "residual_sha256": digest})]})
    again = load_result(tmp_path / "rig.yaml", rig, rig.provenance[0])
    for one, other in zip(views(again), views(good), strict=True):
        for key, value in vars(one).items():
            np.testing.assert_equal(value, getattr(other, key)) if key != "hand_eye" else np.testing.assert_equal(
                vars(value), vars(other.hand_eye)
            )
    assert text(summarise(good.rig, [again])) == text(summarise(good.rig, [good]))


@pytest.mark.parametrize(
    "lie",
    [
        {"methods": {"park": {"X": "no"}, "tsai": 3, "li": {"X": [[1e9] * 4] * 4}}},
        {"methods": [1], "fixed_transform": 7},
        {"fixed_transform": "T_a_b_c"},
        {"fixed_transform": "T_nowhere_else"},
        "nothing",
    ],
)
def test_facts_that_lie_are_left_out(good: Result, lie: object) -> None:
    facts = {**good.facts, "hand_eye": {NAME: lie}, "tables": [[["a", "b"], ["c"]], "x", [[]], [["<b>", "1"]]]}
    result = replace(good, facts=facts)
    for view in views(result):
        for key in KEYS & {picture.key for picture in PICTURES if view.has(picture.needs)}:
            drawn(view, key)
    assert "<b>" in text(summarise(result.rig, [result]))  # the one table that is one


@pytest.mark.parametrize(("column", "value"), [("turn", np.nan), ("place", 1e300), ("rotation", 0.0), ("turn", np.inf)])
def test_rows_that_cannot_be_drawn_are_left_out(good: Result, column: str, value: float) -> None:
    first, *rest = good.residuals
    spoilt = first.context[column].astype(float).copy()
    spoilt[3] = value
    result = replace(good, residuals=(replace(first, context={**first.context, column: spoilt}), *rest))
    view = poses_of(result)
    assert len(view.raw) == 29
    assert view.n_lost == 1
    assert {picture.key for picture in PICTURES if view.has(picture.needs)} == KEYS - {"rotation_axes"}
    drawn(view, "poses_in_space")
