"""Poses between two frames of a tf tree: direction, chaining, interpolation, gaps."""

from pathlib import Path

import numpy as np
import pytest
from recording_helper import Make, write

from calibkit.errors import BadInputError
from calibkit.geometry import se3, so3
from calibkit.io.recording import Recording, open_recording

T0 = 1_700_000_000_000_000_000
RNG = np.random.default_rng(5)
T_hand_cam = se3.make(so3.exp(RNG.normal(size=3)), RNG.normal(size=3))
OMEGA, VELOCITY = np.array([0.3, -0.4, 0.5]), np.array([0.1, 0.2, -0.3])


def _motion(t_ns: int) -> np.ndarray:
    """A screw of constant rates: exact under interpolation between neighbours."""
    t = (t_ns - T0) * 1e-9
    return se3.make(so3.exp(OMEGA * t), VELOCITY * t)


def _entry(t_ns: int, parent: str, child: str, T: np.ndarray) -> tuple:
    return t_ns, parent, child, T[:3, 3], so3.to_quat(T[:3, :3])


def _recording(folder: Path, form: str) -> Recording:
    make = Make(form)
    messages = [("/tf_static", T0, make.tf(_entry(T0, "/hand", "/cam", T_hand_cam)))]
    for i in range(200):
        t = T0 + i * 10_000_000
        messages.append(("/tf", t, make.tf(_entry(t, "odom", "hand", _motion(t)))))
        if i % 7 == 0 and not 40 < i < 80:
            slow = t + 3_000_000
            messages.append(("/tf", slow, make.tf(_entry(slow, "world", "odom", _motion(slow)))))
    return open_recording([write(folder, form, messages)])


@pytest.mark.parametrize("form", ["ros1", "mcap"])
def test_a_chain_of_static_and_moving_transforms(tmp_path: Path, form: str) -> None:
    recording = _recording(tmp_path, form)
    direct = recording.tf("odom", "hand")
    assert len(direct.t_ns) == 200
    np.testing.assert_allclose(direct.p[-1], _motion(int(direct.t_ns[-1]))[:3, 3], atol=1e-12)
    chained = recording.tf("world", "cam")
    assert (chained.parent, chained.child) == ("world", "cam")
    assert 15 < len(chained.t_ns) < 29  # at the times of world -> odom, the slower one
    for t_ns, q, p in zip(chained.t_ns, chained.q, chained.p, strict=True):
        T = _motion(int(t_ns)) @ _motion(int(t_ns)) @ T_hand_cam
        np.testing.assert_allclose(so3.from_quat(q), T[:3, :3], atol=1e-6)
        np.testing.assert_allclose(p, T[:3, 3], atol=1e-6)


def test_the_other_direction_is_the_inverse(tmp_path: Path) -> None:
    recording = _recording(tmp_path, "mcap")
    there, back = recording.tf("world", "cam"), recording.tf("cam", "world")
    T = se3.make(so3.from_quat(there.q), there.p) @ se3.make(so3.from_quat(back.q), back.p)
    np.testing.assert_allclose(T, np.broadcast_to(np.eye(4), T.shape), atol=1e-12)


def test_nothing_is_interpolated_across_a_gap(tmp_path: Path) -> None:
    make = Make("mcap")
    messages = []
    for i in range(100):
        t = T0 + i * 10_000_000
        if not 40 <= i < 60:
            messages.append(("/tf", t, make.tf(_entry(t, "odom", "hand", _motion(t)))))
        if i % 3 == 0:
            messages.append(("/tf", t + 5_000_000, make.tf(_entry(t + 5_000_000, "world", "odom", _motion(t + 5_000_000)))))
    poses = open_recording([write(tmp_path, "mcap", messages)]).tf("world", "hand")
    assert not np.any((poses.t_ns > T0 + 390_000_000) & (poses.t_ns < T0 + 600_000_000))
    assert len(poses.t_ns) == 26


def test_frames_that_are_not_connected_are_refused_with_those_that_are(tmp_path: Path) -> None:
    recording = _recording(tmp_path, "mcap")
    with pytest.raises(BadInputError, match="no tf from world to lidar; the recording's frames: cam, hand, odom, world"):
        recording.tf("world", "lidar")
    with pytest.raises(BadInputError, match="name two frames"):
        recording.tf("world", "world")


def test_a_static_transform_without_a_proper_rotation_is_refused(tmp_path: Path) -> None:
    make = Make("mcap")
    entry = T0, "hand", "cam", np.zeros(3), np.array([0.0, 0, 0, 5])
    moving = _entry(T0, "odom", "hand", np.eye(4))
    recording = open_recording([write(tmp_path, "mcap", [("/tf_static", T0, make.tf(entry)), ("/tf", T0, make.tf(moving))])])
    with pytest.raises(BadInputError, match="tf from odom to cam holds no transform"):
        recording.tf("odom", "cam")
