"""What is printed as known is right, whatever the poses leave open: every parameter by itself, and closed forms with their own sigmas."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from commands import Run
from numpy.typing import NDArray
from test_hand_eye import ONLY_X, assert_honest, degenerate, error, recorded, seeds, spread

from calibkit.data.rig import TRANSFORM_PARAMETERS, Transform
from calibkit.data.transforms import carry_parameters, make_transform
from calibkit.data.verdict import Status
from calibkit.errors import BadInputError
from calibkit.estimation.hand_eye import HandEyeFit, calibrate_hand_eye
from calibkit.estimation.hand_eye_asked import Asked
from calibkit.estimation.hand_eye_data import HandEyeData, of_motions, of_recording
from calibkit.estimation.hand_eye_known import parameter_statuses, position_covariance
from calibkit.estimation.hand_eye_methods import METHODS
from calibkit.estimation.hand_eye_redrawn import by_closed_form
from calibkit.estimation.hand_eye_result import hand_eye_result
from calibkit.estimation.hand_eye_world import WORLD_METHODS
from calibkit.geometry import se3, so3
from calibkit.io.rig_file import load_rig
from calibkit.report.parameters import rows
from calibkit.report.summary import summarise
from calibkit.report.summary_text import text

Array = NDArray[np.float64]
P, R = TRANSFORM_PARAMETERS[:3], TRANSFORM_PARAMETERS[3:]
X = se3.make(so3.exp(np.array([0.3, -0.8, 1.2])), np.array([0.05, -0.08, 0.12]))
Z = se3.make(so3.exp(np.array([2.5, 0.4, -0.3])), np.array([0.9, 0.2, 0.1]))


def unknown(fit: HandEyeFit) -> set[str]:
    return {key for key, status in parameter_statuses(fit.X, fit.cov_X).items() if status is Status.NOT_OBSERVABLE}


# What is open of X when the axis is none of the frames' own.
OPEN = {"one axis": set(P), "one axis, no way": {*P, *R}, "planar": set(P), "translation": set(P), "rest": {*P, *R}}


@pytest.mark.parametrize("kind", OPEN)
def test_what_is_told_as_known_is_right(kind: str) -> None:
    for s in range(5):
        rng = np.random.default_rng(s)
        G, _ = degenerate(kind, rng)
        truth, data, _ = recorded("eye-in-hand", G, rng)
        fit = calibrate_hand_eye(data, ONLY_X)
        assert unknown(fit) == OPEN[kind], s
        result = hand_eye_result(fit, Asked())
        assert result.exit_code == 3
        off = np.concatenate([truth[:3, 3], so3.log(truth[:3, :3])])
        told = [row for row in rows(result.rig) if row.part == "T_gripper_cam"]
        for row, true in zip(told, off, strict=True):
            if row.name in OPEN[kind]:
                assert (row.value, row.sigma, row.value_text) == (None, None, "not observable")
            else:
                assert abs(row.value - true) < 5 * row.sigma
        # Nor does any other line hold a number of what is open: p along directions that are known is right, too.
        said = text(summarise(result.rig, [result]))
        for value, sigma, *along in re.findall(r"([-+.\d]+) \+- ([.\d]+) mm along \(([-.\d]+), ([-.\d]+), ([-.\d]+)\)", said):
            axis = np.array([float(v) for v in along])
            assert abs(float(value) - 1e3 * axis @ truth[:3, 3]) < 5 * float(sigma) + 0.5 * np.abs(truth[:3, 3]).sum() * 10  # two digits
        for name in R:
            assert (name in OPEN[kind]) == ("R = exp(" not in said)
        rest = re.search(r"cam's axis \(([-.\d, ]+)\) is gripper's axis \(([-.\d, ]+)\) to ([.\d]+) deg", said)
        assert bool(rest) == (kind == "one axis, no way")
        if rest:
            there, here = (np.array([float(v) for v in part.split(",")]) for part in rest.groups()[:2])
            assert np.degrees(np.linalg.norm(truth[:3, :3] @ there - here)) < 5 * float(rest[3]) + 0.2


def test_p_that_turns_with_an_open_axis_is_known_along_it_alone() -> None:
    """R exp(a u) open, p on a circle of 0.2 m about it: the tangent alone would have p known along the radius."""
    R_X = so3.exp(np.array([0.4, -0.2, 0.9]))
    axis, lever = np.array([0.0, 0.0, 1.0]), np.array([0.2, 0.0, 0.0])  # in frame 1
    d = np.concatenate([R_X.T @ np.cross(axis, lever), R_X.T @ axis])
    cov = 100.0 * np.outer(d, d) + 1e-8 * np.eye(6)
    T = se3.make(R_X, lever)
    found = parameter_statuses(T, cov)
    assert {key for key, status in found.items() if status is not Status.NOT_OBSERVABLE} == {"p_z"}
    assert found["p_z"] is Status.DETERMINED
    sigma = np.sqrt(np.diag(position_covariance(T, cov)))
    assert sigma[0] >= 0.2 - 1e-9
    assert sigma[2] < 1e-3


def test_a_direction_across_all_axes_leaves_none_of_them() -> None:
    """31 mm along (1, 1, 1) is 18 mm along each: the whole is not observable, so no part may be told as if it were."""
    v = np.concatenate([np.ones(3) / np.sqrt(3), np.zeros(3)])
    cov = 0.031**2 * np.outer(v, v) + 1e-8 * np.eye(6)
    assert {key for key, status in parameter_statuses(np.eye(4), cov).items() if status is Status.NOT_OBSERVABLE} == set(P)
    cov = 0.029**2 * np.outer(v, v) + 1e-8 * np.eye(6)
    assert {status for key, status in parameter_statuses(np.eye(4), cov).items() if key in P} == {Status.WEAK}


def test_parameters_are_carried_as_they_move() -> None:
    rng = np.random.default_rng(0)
    T = se3.make(so3.exp(np.array([1.2, -0.8, 1.4])), rng.normal(size=3))

    def parameters(d: Array) -> Array:
        moved = se3.retract(T, d)
        return np.concatenate([moved[:3, 3], so3.log(moved[:3, :3])])

    h = 1e-6
    numeric = np.stack([(parameters(h * e) - parameters(-h * e)) / (2 * h) for e in np.eye(6)], axis=1)
    np.testing.assert_allclose(carry_parameters(T), numeric, atol=1e-8)


def test_statuses_that_contradict_the_transform_are_refused() -> None:
    good = dict.fromkeys(TRANSFORM_PARAMETERS, Status.DETERMINED)
    entry = make_transform("a", "b", np.eye(4), 1e-8 * np.eye(6), Status.DETERMINED, statuses=good)
    for status, statuses in (
        (Status.NOT_OBSERVABLE, good),
        (Status.DETERMINED, {**good, "p_x": Status.NOT_OBSERVABLE}),
        (Status.DETERMINED, {"p_x": Status.DETERMINED}),
    ):
        with pytest.raises(ValueError, match="status"):
            Transform(**{**entry.model_dump(), "status": status, "statuses": statuses})


# ---- through the command


def moved(kind: str, rng: np.random.Generator) -> Array:
    """A gripper that starts in the base's axes and turns about z, so that the axis is z in both."""
    n = 2 if kind == "two poses" else 24
    turn, shift = rng.uniform(-1, 1, (n, 1)) * np.array([0, 0, 1.0]), 0.2 * rng.normal(size=(n, 3))
    flat = np.array([1.0, 1.0, 0])
    moves = {
        "one axis": (turn, shift),
        "planar": (turn, shift * flat),
        "translation": (0 * turn, shift),
        "two poses": (0.5 * rng.normal(size=(n, 3)), shift),
        "rest": (0 * turn, 0 * shift),
    }
    return se3.make(so3.exp(moves[kind][0]), np.array([0.5, 0, 0.6]) + moves[kind][1])


@pytest.mark.parametrize(
    ("kind", "hidden"),
    [("one axis", {"p_z"}), ("planar", {"p_z"}), ("translation", set(P)), ("two poses", {*P, *R}), ("rest", {*P, *R})],
)
def test_degenerate_sets_end_with_code_3_and_mark_what_is_open(run: Run, tmp_path: Path, kind: str, hidden: set[str]) -> None:
    rng = np.random.default_rng(0)
    G = moved(kind, rng)
    sides = [G, se3.inverse(G @ X) @ Z]
    asked: list[object] = []
    for name, T in zip(("arm.txt", "board.txt"), sides, strict=True):
        noise = np.concatenate([3e-4 * rng.normal(size=(len(T), 3)), 4e-4 * rng.normal(size=(len(T), 3))], axis=1)
        np.savetxt(tmp_path / name, se3.retract(T, noise).reshape(-1, 16), fmt="%.9f")
        asked += ["--pairs", tmp_path / name]
    rig, js = tmp_path / "rig.yaml", tmp_path / "h.json"
    said = run("handeye", *asked, "--pose-format", "matrix", "--setup", "eye-in-hand", "-o", rig, "--json", js)
    assert said.code == 3, said
    found = json.loads(js.read_text())
    for name in ("T_gripper_cam", "T_base_target"):
        entry = load_rig(rig).transforms[name]
        assert entry.status is Status.NOT_OBSERVABLE
        assert {key for key, status in entry.statuses.items() if status is Status.NOT_OBSERVABLE} == hidden
        in_table = re.findall(rf"^{name} ([pr]_[xyz]) +not observable +(?:m|rad) +not observable$", said.out, re.MULTILINE)
        assert set(in_table) == hidden
        values = {row["name"]: row["value"] for row in found["parameters"] if row["part"] == name}
        assert {key for key, value in values.items() if value is None} == hidden
        assert {key for key in found["not_observable"] if key.startswith(name)} == {f"{name}.{key}" for key in hidden}
    assert f"({', '.join(key for key in TRANSFORM_PARAMETERS if key in hidden)})" in load_rig(rig).transforms["T_gripper_cam"].reasons[0]
    if "p_x" in hidden:  # how far methods lie apart where nothing is known is nobody's business
        row = next(line for line in said.out.splitlines() if line.startswith("park "))
        assert len(re.findall(r" [\d.]+", row)) == 2 + ("r_x" not in hidden)
    # A closed form picks some p: it may not sound as if it knew; and one that compares turns alone knows less.
    park = run("handeye", *asked, "--pose-format", "matrix", "--setup", "eye-in-hand", "--method", "park", "-o", tmp_path / "park.yaml")
    assert park.code == 3, park
    entry = load_rig(tmp_path / "park.yaml").transforms["T_gripper_cam"]
    assert {key for key, status in entry.statuses.items() if status is Status.NOT_OBSERVABLE} >= hidden


# ---- closed forms on request


@pytest.mark.parametrize("n_seeds", seeds(4))
@pytest.mark.parametrize("name", ["tsai", "andreff", "daniilidis", "shah"])
def test_sigmas_of_a_closed_form_are_its_own_and_honest(name: str, n_seeds: int) -> None:
    errors, fits = [], []
    for s in range(n_seeds):
        rng = np.random.default_rng(s)
        truth, data, _ = recorded("eye-in-hand", spread(rng, 15), rng, 0.1)
        refined = calibrate_hand_eye(data, ONLY_X)
        fits.append(by_closed_form(refined, name))
        errors.append(error(fits[-1], truth))
        larger = np.sqrt(np.diag(fits[-1].cov_X) / np.diag(refined.cov_X))
        assert 1.0 < np.mean(larger) < 2.0  # none is as good as maximum likelihood
    assert_honest(errors, fits, n_seeds > 50)


def test_a_closed_forms_bias_is_in_its_sigma() -> None:
    """Turns of 0.05 rad: Andreff's rotation part is pulled towards nothing, and p with it; by first order it would be right."""
    rng = np.random.default_rng(2)
    G = se3.make(so3.exp(0.05 * rng.normal(size=(12, 3))), np.array([0.5, 0, 0.6]) + 0.05 * rng.normal(size=(12, 3)))
    truth, data, _ = recorded("eye-in-hand", G, rng)
    fit = calibrate_hand_eye(data, ONLY_X)
    found = by_closed_form(fit, "andreff")
    off = error(found, truth)
    print(off, np.sqrt(np.diag(found.cov_X)))
    assert off @ np.linalg.solve(found.cov_X, off) < 30  # chi-squared of 6
    assert np.array_equal(by_closed_form(fit, "andreff").cov_X, found.cov_X)  # the same poses give the same file


def test_without_a_common_world_only_pairs_of_motions_can_be_solved() -> None:
    rng = np.random.default_rng(0)
    A = spread(rng, 12)
    fit = calibrate_hand_eye(of_motions(A, se3.inverse(X) @ A @ X))
    for name in METHODS:
        np.testing.assert_allclose(by_closed_form(fit, name).X, X, atol=1e-9)
    for name in WORLD_METHODS:
        with pytest.raises(BadInputError, match=f"--method {name} needs poses about one common world.*choose one of refined, tsai"):
            by_closed_form(fit, name)


def test_a_closed_form_of_exact_poses_is_exact() -> None:
    rng = np.random.default_rng(0)
    G = spread(rng, 12)
    fit = calibrate_hand_eye(of_recording("eye-in-hand", G, se3.inverse(G @ X) @ Z))
    for name in ("tsai", "park", "horaud", "andreff", "daniilidis", "shah", "li"):
        found = by_closed_form(fit, name)
        np.testing.assert_allclose(found.X, X, atol=1e-9)
        assert found.Z is not None
        np.testing.assert_allclose(found.Z, Z, atol=1e-9)
        assert found.scatter.distance < 1e-9
    assert isinstance(fit.data, HandEyeData)
