"""Hand-eye of a real arm, from images to X, against the figures in data/README.md."""

import os
from pathlib import Path

import numpy as np
import pytest

from calibkit.data.progress import silent
from calibkit.data.verdict import Status
from calibkit.estimation.board_poses import BoardPoses, board_poses
from calibkit.estimation.hand_eye import HandEyeFit, calibrate_hand_eye
from calibkit.estimation.hand_eye_arm import by_pose, pattern_of
from calibkit.estimation.hand_eye_data import of_recording
from calibkit.estimation.hand_eye_explained import left_of
from calibkit.estimation.intrinsics import CameraRequest, calibrate_cameras
from calibkit.geometry import se3, so3
from calibkit.io.recording import open_recording
from calibkit.models.board import Checkerboard
from calibkit.stages.intrinsics import Options, name_cameras, observe

# T_gripper_cam by Park, measured with other corners and another solver.
PARK = se3.make(so3.from_quat(np.array([-0.49659, 0.52801, -0.48651, 0.48777])), np.array([0.01439, -0.10786, -0.08193]))
SCATTER_DEG, SCATTER_MM = 0.047, 0.68


@pytest.fixture(scope="module")
def boards() -> tuple[BoardPoses, np.ndarray]:
    """The 28 boards under the lens of the same images, and the arm's poses."""
    value = os.environ.get("CALIBKIT_TEST_DATA", "")
    if not value or not Path(value).is_dir():
        pytest.skip("needs the real recordings: set CALIBKIT_TEST_DATA to their folder")
    folder = Path(value) / "kuka2"
    recording = open_recording([folder])
    views = observe(recording, name_cameras(recording, ()), Checkerboard(24, 17, 0.015, 0.015), Options(cache=False), silent)[0]
    lens = calibrate_cameras([CameraRequest(views, "pinhole-radtan5")]).rig.cameras["cam0"]
    return board_poses(views, lens), np.loadtxt(folder / "RobotPosesVec.txt").reshape(-1, 4, 4)


def fit(boards: tuple[BoardPoses, np.ndarray], wrong: tuple[int, ...] = (), **more: object) -> HandEyeFit:
    found, T_base_gripper = boards
    P = T_base_gripper[found.frame].copy()
    P[np.array(wrong, int)] = P[np.roll(np.array(wrong, int), 1)]
    return calibrate_hand_eye(of_recording("eye-in-hand", P, found.T_cam_board, found.cov, labels=found.labels, **more))


def test_kuka2_is_what_park_gives_with_a_smaller_sigma(boards: tuple[BoardPoses, np.ndarray]) -> None:
    result = fit(boards)
    off = se3.local(PARK, result.X)
    print("off Park", np.linalg.norm(off[:3]), np.degrees(np.linalg.norm(off[3:])), result.scatter, result.noise)
    assert result.kept.sum() == len(result.kept) == 28
    assert np.linalg.norm(off[:3]) < 1.0e-3
    assert np.degrees(np.linalg.norm(off[3:])) < 0.05
    park = result.methods["park"].scatter
    assert result.scatter.angle < 1.05 * park.angle
    assert result.scatter.distance < 1.05 * park.distance
    assert np.degrees(result.scatter.angle) < SCATTER_DEG
    assert 1e3 * result.scatter.distance < SCATTER_MM
    assert result.statuses == {"p": Status.DETERMINED, "R": Status.DETERMINED}
    assert not result.open


def test_kuka2_has_no_pattern_large_enough_to_tell(boards: tuple[BoardPoses, np.ndarray]) -> None:
    """Its arm's errors depend on its pose beyond any chance, by 0.45 mm and 0.6 mrad: less than X must be known to."""
    result = fit(boards)
    left = left_of(result)
    assert left is not None
    found = left.by(by_pose(left))
    assert found is not None
    assert found.chance < 1e-9
    assert found.distance < 1e-3
    assert found.angle < 1e-3
    assert pattern_of(result) is None


def test_kuka2_shows_andreffs_failure_and_that_the_others_agree(boards: tuple[BoardPoses, np.ndarray]) -> None:
    methods = fit(boards).methods
    assert methods["andreff"].failed
    assert methods["andreff"].distance == pytest.approx(0.033, abs=0.003)
    assert {name for name, method in methods.items() if method.failed} == {"andreff", "li"}
    tsai = se3.local(methods["park"].X, methods["tsai"].X)
    assert np.linalg.norm(tsai[:3]) < 0.3e-3


def test_kuka2_with_poses_of_other_images_gives_the_same_x(boards: tuple[BoardPoses, np.ndarray]) -> None:
    wrong = (2, 6, 11, 15, 19, 22, 24, 27)
    clean, mixed = fit(boards), fit(boards, wrong)
    assert set(np.flatnonzero(~mixed.kept)) == set(wrong)
    off = se3.local(clean.X, mixed.X)
    assert np.linalg.norm(off[:3]) < 1e-3
    assert np.degrees(np.linalg.norm(off[3:])) < 0.05


def test_the_two_halves_of_kuka2_agree_within_their_sigmas(boards: tuple[BoardPoses, np.ndarray]) -> None:
    found, T_base_gripper = boards
    halves = []
    for part in (slice(0, None, 2), slice(1, None, 2)):
        at = found.frame[part]
        halves.append(calibrate_hand_eye(of_recording("eye-in-hand", T_base_gripper[at], found.T_cam_board[part], found.cov[part])))
    off = se3.local(halves[0].X, halves[1].X)
    z = off / np.sqrt(np.diag(halves[0].cov_X + halves[1].cov_X))
    print("halves apart by", off, "sigmas", z)
    assert np.abs(z).max() < 3
