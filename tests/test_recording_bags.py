"""Bags of every format: what rosbags wrote comes back; order, times, damage and hostile sizes."""

from pathlib import Path

import numpy as np
import pytest
from recording_helper import FORMATS, Make, write

from calibkit.io.recording import open_recording

T0 = 1_700_000_000_000_000_000
LATENCY = 3_000_000


def _messages(form: str, n: int = 40) -> list[tuple[str, int, object]]:
    make, rng = Make(form), np.random.default_rng(1)
    messages = []
    for i in range(n):
        t = T0 + i * 5_000_000
        messages.append(("/imu", t + LATENCY, make.imu(t, rng.normal(size=3), rng.normal(size=3))))
        if i % 4 == 0:
            messages.append(("/cam", t + LATENCY, make.image(t, rng.integers(0, 255, (12, 16), np.uint8), "mono8")))
            messages.append(("/pose", t + LATENCY, make.pose(t, rng.normal(size=3), (0, 0, 0.6, 0.8))))
    return messages


@pytest.mark.parametrize("form", FORMATS)
def test_every_format_gives_back_what_was_written(tmp_path: Path, form: str) -> None:
    written = _messages(form)
    recording = open_recording([write(tmp_path, form, written)])
    assert {(t.name, t.kind, t.count) for t in recording.topics} == {("/imu", "imu", 40), ("/cam", "image", 10), ("/pose", "pose", 10)}
    imu = recording.imu(recording.choose("imu"))
    sent = [m for topic, _, m in written if topic == "/imu"]
    assert imu.t_ns.tolist() == [T0 + i * 5_000_000 for i in range(40)]
    np.testing.assert_array_equal(imu.gyro, [[m.angular_velocity.x, m.angular_velocity.y, m.angular_velocity.z] for m in sent])
    np.testing.assert_array_equal(imu.accel[:, 2], [m.linear_acceleration.z for m in sent])
    frames = list(recording.images("/cam"))
    sent = [m for topic, _, m in written if topic == "/cam"]
    assert [f.t_ns for f in frames] == [T0 + i * 20_000_000 for i in range(10)]
    for frame, image in zip(frames, sent, strict=True):
        np.testing.assert_array_equal(frame.decode().ravel(), image.data)
    assert len({f.payload for f in frames}) == 10
    poses = recording.poses("/pose")
    np.testing.assert_allclose(poses.q, np.tile([0, 0, 0.6, 0.8], (10, 1)), atol=1e-15)
    assert (poses.parent, poses.child) == ("world", "/pose")
    assert recording.warnings == []
