"""Small bags for tests, written by rosbags: an outsider's idea of the formats."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS2 = get_typestore(Stores.ROS2_HUMBLE)
ROS1.register({"tf2_msgs/msg/TFMessage": ROS2.fielddefs["tf2_msgs/msg/TFMessage"]})
Messages = Iterable[tuple[str, int, Any]]  # topic, record time, message

FORMATS = {
    "ros1": {},
    "ros1-bz2": {"ros1": Writer1.CompressionFormat.BZ2},
    "ros1-lz4": {"ros1": Writer1.CompressionFormat.LZ4},
    "db3": {"plugin": StoragePlugin.SQLITE3},
    "db3-file-zstd": {"plugin": StoragePlugin.SQLITE3, "mode": CompressionMode.FILE},
    "db3-message-zstd": {"plugin": StoragePlugin.SQLITE3, "mode": CompressionMode.MESSAGE},
    "mcap": {"plugin": StoragePlugin.MCAP},
    "mcap-zstd": {"plugin": StoragePlugin.MCAP, "mode": CompressionMode.STORAGE},
}


def store(form: str) -> Any:
    return ROS1 if form.startswith("ros1") else ROS2


def write(folder: Path, form: str, messages: Messages) -> Path:
    """Write messages in one of FORMATS and return what a person would give as SOURCE."""
    options, types = FORMATS[form], store(form)
    path = folder / ("rec.bag" if types is ROS1 else "rec")
    writer = Writer1(path) if types is ROS1 else Writer2(path, version=8, storage_plugin=options["plugin"])
    if options.get("ros1"):
        writer.set_compression(options["ros1"])
    if options.get("mode"):
        writer.set_compression(options["mode"], CompressionFormat.ZSTD)
    serialize = types.serialize_ros1 if types is ROS1 else types.serialize_cdr
    connections: dict[str, Any] = {}
    with writer:
        for topic, record_ns, message in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, message.__msgtype__, typestore=types)
            writer.write(connections[topic], record_ns, serialize(message, message.__msgtype__))
    return path


class Make:
    """Messages of one type store."""

    def __init__(self, form: str) -> None:
        self.types = store(form).types
        self.ros1 = store(form) is ROS1

    def header(self, t_ns: int, frame: str = "body") -> Any:
        stamp = self.types["builtin_interfaces/msg/Time"](sec=t_ns // 10**9, nanosec=t_ns % 10**9)
        sequence = {"seq": 0} if self.ros1 else {}
        return self.types["std_msgs/msg/Header"](**sequence, stamp=stamp, frame_id=frame)

    def vector(self, v: Any) -> Any:
        return self.types["geometry_msgs/msg/Vector3"](*map(float, v))

    def quaternion(self, q: Any) -> Any:
        return self.types["geometry_msgs/msg/Quaternion"](*map(float, q))

    def imu(self, t_ns: int, gyro: Any, accel: Any, frame: str = "imu") -> Any:
        none = np.zeros(9)
        return self.types["sensor_msgs/msg/Imu"](
            self.header(t_ns, frame), self.quaternion((0, 0, 0, 1)), none, self.vector(gyro), none, self.vector(accel), none
        )

    def image(self, t_ns: int, pixels: np.ndarray, encoding: str, *, step: int | None = None, bigendian: int = 0) -> Any:
        data = np.frombuffer(pixels.tobytes(), np.uint8)
        height, width = pixels.shape[:2]
        return self.types["sensor_msgs/msg/Image"](self.header(t_ns), height, width, encoding, bigendian, step or data.size // height, data)

    def compressed(self, t_ns: int, form: str, data: bytes) -> Any:
        return self.types["sensor_msgs/msg/CompressedImage"](self.header(t_ns), form, np.frombuffer(data, np.uint8))

    def pose(self, t_ns: int, p: Any, q: Any) -> Any:
        point = self.types["geometry_msgs/msg/Point"](*map(float, p))
        return self.types["geometry_msgs/msg/PoseStamped"](
            self.header(t_ns, "world"), self.types["geometry_msgs/msg/Pose"](point, self.quaternion(q))
        )

    def twist(self, t_ns: int, rate: Any, frame: str = "base") -> Any:
        twist = self.types["geometry_msgs/msg/Twist"](self.vector((1, 0, 0)), self.vector(rate))
        return self.types["geometry_msgs/msg/TwistStamped"](self.header(t_ns, frame), twist)

    def twist_with_covariance(self, t_ns: int, rate: Any) -> Any:
        twist = self.twist(t_ns, rate)
        known = self.types["geometry_msgs/msg/TwistWithCovariance"](twist.twist, np.zeros(36))
        return self.types["geometry_msgs/msg/TwistWithCovarianceStamped"](twist.header, known)

    def odometry(self, t_ns: int, p: Any, q: Any, rate: Any) -> Any:
        pose, none = self.pose(t_ns, p, q), np.zeros(36)
        twist = self.types["geometry_msgs/msg/TwistWithCovariance"](self.twist(t_ns, rate).twist, none)
        return self.types["nav_msgs/msg/Odometry"](
            self.header(t_ns, "odom"), "base", self.types["geometry_msgs/msg/PoseWithCovariance"](pose.pose, none), twist
        )

    def tf(self, *entries: tuple[int, str, str, Any, Any]) -> Any:
        transforms = [
            self.types["geometry_msgs/msg/TransformStamped"](
                self.header(t_ns, parent), child, self.types["geometry_msgs/msg/Transform"](self.vector(p), self.quaternion(q))
            )
            for t_ns, parent, child, p, q in entries
        ]
        return (self.types.get("tf2_msgs/msg/TFMessage"))(transforms)
