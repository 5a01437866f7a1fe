"""How much faster Imu messages are decoded in bulk than by rosbags, one by one: at least 10 times, and bit for bit the same.

python benchmarks/imu_decode.py [--messages 12000]
"""

import argparse
import time
from collections.abc import Callable
from typing import TypeVar

import numpy as np
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from calibkit.io.ros_messages import IMU, decode_imu

T = TypeVar("T")
WANTED = 10.0


def payloads(store: Typestore, encoding: str, n: int) -> list[bytes]:
    """Return n serialised Imu messages of seeded random numbers."""
    types, rng = store.types, np.random.default_rng(0)
    serialize = store.serialize_ros1 if encoding == "ros1" else store.serialize_cdr
    vector, sequence = types["geometry_msgs/msg/Vector3"], {"seq": 0} if encoding == "ros1" else {}
    made = []
    for i in range(n):
        stamp = types["builtin_interfaces/msg/Time"](sec=1_700_000_000 + i // 200, nanosec=i % 200 * 5_000_000)
        header = types["std_msgs/msg/Header"](**sequence, stamp=stamp, frame_id="imu_link")
        q, cov = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0), rng.normal(size=(3, 9))
        message = types[IMU](header, q, cov[0], vector(*rng.normal(size=3)), cov[1], vector(*rng.normal(size=3)), cov[2])
        made.append(bytes(serialize(message, IMU)))
    return made


def best(work: Callable[[], T], repeats: int = 5) -> tuple[float, T]:
    """Return the least CPU seconds of several runs, and the result."""
    times = []
    for _ in range(repeats):
        start = time.process_time()
        result = work()
        times.append(time.process_time() - start)
    return min(times), result


def compare(encoding: str, n: int) -> float:
    """Print and return how many times faster the bulk decoding is; ValueError when it reads anything else."""
    store = get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_HUMBLE)
    raw = payloads(store, encoding, n)
    deserialize = store.deserialize_ros1 if encoding == "ros1" else store.deserialize_cdr
    theirs_s, messages = best(lambda: [deserialize(payload, IMU) for payload in raw], 3)
    ours_s, (gyro, accel, whole) = best(lambda: decode_imu(raw, encoding))
    vectors = [(m.angular_velocity, m.linear_acceleration) for m in messages]  # type: ignore[attr-defined]
    theirs = np.array([[w.x, w.y, w.z, a.x, a.y, a.z] for w, a in vectors])
    if not whole.all() or theirs.tobytes() != np.hstack([gyro, accel]).tobytes():
        raise ValueError(f"{encoding}: not bit for bit what rosbags reads")
    print(f"{encoding}: {n} messages, rosbags {theirs_s * 1e3:.1f} ms, in bulk {ours_s * 1e3:.2f} ms: {theirs_s / ours_s:.0f} times faster")
    return theirs_s / ours_s


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--messages", type=int, default=12000)
    n = parser.parse_args().messages
    slowest = min(compare(encoding, n) for encoding in ("ros1", "cdr"))
    print(f"wanted {WANTED:.0f}, got {slowest:.0f}: {'met' if slowest >= WANTED else 'NOT MET'}")
    raise SystemExit(slowest < WANTED)


if __name__ == "__main__":
    main()
