"""An arm that is off by its pose, and a tool or a board that is moved half-way, are told; white noise and wrong poses are not."""

import numpy as np
import pytest
from numpy.typing import NDArray
from test_hand_eye import ONLY_X, noisy, poses

from calibkit.data.verdict import Status, Verdict
from calibkit.estimation.hand_eye import HandEyeFit, Settings, calibrate_hand_eye
from calibkit.estimation.hand_eye_arm import pattern_of
from calibkit.estimation.hand_eye_asked import Asked
from calibkit.estimation.hand_eye_data import of_recording
from calibkit.estimation.hand_eye_result import hand_eye_result
from calibkit.geometry import se3, so3

Array = NDArray[np.float64]
SETUPS = ("eye-in-hand", "eye-to-hand")
ANY = [pytest.param(10, id="10 seeds"), pytest.param(50, id="all seeds", marks=pytest.mark.slow)]
# a (m), d (m), alpha (rad) of each joint of a six-axis arm with a reach of 0.85 m
ARM = np.array(
    [[0, 0.163, np.pi / 2], [-0.425, 0, 0], [-0.392, 0, 0], [0, 0.133, np.pi / 2], [0, 0.1, -np.pi / 2], [0, 0.1, 0]], np.float64
)
HOME = np.array([0, -1.2, 1.4, -1.7, -1.57, 0])


def forward(q: Array, arm: Array) -> Array:
    """T_base_gripper (n, 4, 4) at joints q (n, 6), by Denavit and Hartenberg 1955."""
    T = np.tile(np.eye(4), (len(q), 1, 1))
    for i, (a, d, alpha) in enumerate(arm):
        z, x = np.zeros((len(q), 3)), np.array([a, 0, 0])
        z[:, 2] = 1
        T = T @ se3.make(so3.exp(q[:, i, None] * z), d * z) @ se3.make(so3.exp(np.array([alpha, 0, 0])), x)
    return T


def recorded(
    setup: str, n: int, rng: np.random.Generator, joint: float = 0.0, length: float = 0.0, robot: float = 3e-4, camera: float = 1e-3
) -> tuple[Array, Array]:
    """What an arm says of n poses, its joints and lengths off by so much (rad, m), and the board's poses T_cam_target."""
    q = HOME + 0.35 * rng.normal(size=(n, 6))
    off = ARM + np.array([length, length, joint]) * rng.normal(size=(6, 3))
    G = forward(q + joint * rng.normal(size=6), off)
    X, fixed = poses(rng, 1, 1.0, 0.1)[0], poses(rng, 1, 1.0, 0.5)[0]
    seen = se3.inverse(G @ X) @ fixed if setup == "eye-in-hand" else se3.inverse(X) @ G @ fixed
    return noisy(forward(q, ARM), rng, robot, robot), noisy(seen, rng, camera, camera / 2)


def fitted(setup: str, first: Array, second: Array) -> HandEyeFit:
    return calibrate_hand_eye(of_recording(setup, first, second), ONLY_X)


@pytest.mark.parametrize("n_seeds", ANY)
@pytest.mark.parametrize("setup", SETUPS)
def test_white_noise_few_poses_and_wrong_ones_are_no_pattern(setup: str, n_seeds: int) -> None:
    told = []
    for s in range(n_seeds):
        for n, robot, camera, wrong in ((10, 3e-4, 1e-3, 0.0), (12, 3e-3, 1e-4, 0.0), (20, 3e-4, 1e-3, 0.3), (30, 1e-3, 3e-4, 0.1)):
            rng = np.random.default_rng((s, n))
            first, second = recorded(setup, n, rng, robot=robot, camera=camera)
            bad = rng.permutation(n)[: round(wrong * n)]
            second[bad] = poses(rng, len(bad), 1.0, 0.7)
            told.append(pattern_of(fitted(setup, first, second)))
    alarms = [pattern.text for pattern in told if pattern is not None]
    print(setup, len(alarms), "alarms of", len(told))
    assert len(alarms) <= 0.01 * len(told)


@pytest.mark.parametrize("n_seeds", ANY)
@pytest.mark.parametrize("setup", SETUPS)
def test_an_arm_that_is_off_by_its_pose_is_told(setup: str, n_seeds: int) -> None:
    told, large = [], []
    for s in range(n_seeds):
        told.append(pattern_of(fitted(setup, *recorded(setup, 30, np.random.default_rng(s), 2e-3, 1e-3))))
        large.append(pattern_of(fitted(setup, *recorded(setup, 30, np.random.default_rng(s), 1e-2, 5e-3))))
    found = [pattern for pattern in told if pattern is not None]
    print(setup, "told", len(found), "of", n_seeds, "; of those five times worse, FAIL", sum(p is not None for p in large))
    assert len(found) >= 0.7 * n_seeds
    assert not any(pattern.moved for pattern in found)
    assert all("calibrate the arm" in pattern.text for pattern in found)
    assert sum(pattern is not None and pattern.verdict is Verdict.FAIL for pattern in large) >= 0.9 * n_seeds


@pytest.mark.parametrize("size", [0.1, 0.01, 0.005])
@pytest.mark.parametrize("what", ["tool", "board"])
def test_what_is_moved_half_way_fails_with_its_size_and_where(what: str, size: float) -> None:
    for s in range(3):
        first, second = recorded("eye-in-hand", 20, np.random.default_rng(s))
        step = se3.make(np.eye(3), np.array([0, 0, size]))
        if what == "tool":
            first[10:] = first[10:] @ step
        else:
            second[10:] = second[10:] @ step
        result = hand_eye_result(fitted("eye-in-hand", first, second), Asked())
        reason = result.reasons[0]
        assert reason.verdict is Verdict.FAIL
        moved = "T_gripper_cam is another one" if what == "tool" else "T_base_target is another one"
        assert f"from pose 11 on {moved}, by " in reason.text
        assert float(reason.text.partition(" by ")[2].partition(" mm")[0]) == pytest.approx(1e3 * size, abs=0.6)
        # No X fits both: nothing of it is told as determined.
        for entry in result.rig.transforms.values():
            assert Status.DETERMINED not in {entry.status, *entry.statuses.values()}
        assert result.exit_code in (1, 3)


def test_a_wrong_order_of_quaternions_determines_nothing() -> None:
    first, second = recorded("eye-in-hand", 20, np.random.default_rng(0))
    wrong = [se3.make(so3.from_quat(so3.to_quat(T[:, :3, :3])[:, [3, 0, 1, 2]]), T[:, :3, 3]) for T in (first, second)]
    result = hand_eye_result(calibrate_hand_eye(of_recording("eye-in-hand", *wrong), Settings()), Asked())
    assert result.verdict is Verdict.FAIL
    assert "the angles between poses agree and their places do not" in result.reasons[0].text
    statuses = result.rig.transforms["T_gripper_cam"].statuses
    assert Status.DETERMINED not in statuses.values()
    assert "determined" not in result.facts["hand_eye"]["T_gripper_cam"]["status"].values()


def test_an_arm_that_leaves_centimetres_fails() -> None:
    first, second = recorded("eye-in-hand", 20, np.random.default_rng(1))
    second = noisy(second, np.random.default_rng(2), 0.02, 0.03)
    result = hand_eye_result(fitted("eye-in-hand", first, second), Asked())
    assert result.verdict is Verdict.FAIL
    assert "more than an arm and a board err by" in " ".join(reason.text for reason in result.reasons)
