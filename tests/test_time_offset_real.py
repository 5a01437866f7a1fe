"""Time offsets of real recordings, against what is known of them."""

from pathlib import Path

import numpy as np
import pytest
from test_board_poses import given
from test_intrinsics_real import EUROC, EUROC_SIZE, board_views

from calibkit.data.verdict import Status
from calibkit.estimation.board_poses import board_poses
from calibkit.estimation.board_turns import turns_of_board
from calibkit.estimation.stamps import check_stamps
from calibkit.estimation.time_offset import Settings, fit_time_offset
from calibkit.estimation.time_offset_verdict import judge_time_offset
from calibkit.estimation.turns import Turns, turns_of_poses
from calibkit.io.recording import open_recording
from calibkit.models.cameras import CAMERAS
from calibkit.simulation.camera import SimCamera

PARTS = pytest.mark.parametrize("part", ["whole", "first half", "second half"])


def of(part: str, turns: Turns) -> Turns:
    middle = len(turns.first) // 2
    return turns.select({"whole": slice(None), "first half": slice(0, middle), "second half": slice(middle, None)}[part])


@PARTS
def test_a_camera_and_an_imu_on_one_clock(data_dir: Path, part: str) -> None:
    lens = np.array([458.654, 457.296, 367.215, 248.375, -0.28340811, 0.07395907, 0.00019359, 1.76187114e-05])
    folder = data_dir / "euroc_imu_april"
    views = board_views(folder / "cam0_corners.csv", EUROC, EUROC_SIZE)
    turns = turns_of_board(board_poses(views, given(SimCamera(CAMERAS["pinhole-radtan"], lens, EUROC_SIZE))))
    imu = open_recording([folder / "imu0.csv"]).imu("imu0")
    fit = fit_time_offset(of(part, turns), imu, Settings())
    low, high = (fit.coarse_ns * 1e-9 + end for end in fit.interval)
    print(f"td {1e3 * fit.td:+.3f} +- {1e3 * fit.sigma:.3f} ms, 95 %: {1e3 * low:+.3f} to {1e3 * high:+.3f} ms")
    assert abs(fit.td) < 5e-4
    assert low < 0 < high
    assert fit.sigma < 2e-4
    assert fit.by_fast_turns is None


@PARTS
def test_motion_capture_whose_fast_motion_is_not_the_cameras(data_dir: Path, part: str) -> None:
    camera, hand = (open_recording([data_dir / f"pose_streams/{name}.csv"]).poses(name) for name in ("camera_in_target", "vicon_hand"))
    fit = fit_time_offset(of(part, turns_of_poses(camera)), hand, Settings())
    print(f"td {1e3 * fit.td:+.2f} +- {1e3 * fit.sigma:.2f} ms, by fast turns {fit.by_fast_turns}")
    assert fit.by_fast_turns is not None
    assert fit.by_fast_turns[0] == pytest.approx(0.031, abs=0.002)  # what other methods came to
    assert 0.017 - 2 * fit.sigma < fit.td < 0.021 + 2 * fit.sigma  # the folder's figures
    assert fit.sigma < 0.006


@pytest.mark.slow
def test_two_recordings_that_have_nothing_in_common(data_dir: Path) -> None:
    phone, hand = (open_recording([data_dir / f"pose_streams/{name}.csv"]).poses(name) for name in ("tango_MARS", "vicon_hand"))
    fit = fit_time_offset(turns_of_poses(phone), hand, Settings())
    judged = judge_time_offset("dt_hand_phone", "phone", "hand", fit, {"phone": check_stamps(phone.t_ns), "hand": check_stamps(hand.t_ns)})
    assert judged.status is Status.NOT_OBSERVABLE
    assert "of the turns is not common to phone and hand: are both on one rigid body, in one recording?" in judged.reasons[0].text
