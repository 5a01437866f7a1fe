"""Bags written: ROS 1 .bag, ROS 2 folders with .mcap or .db3, from streams of any length and in little memory.

The same streams give the same bytes (db3: as far as SQLite's version allows).
"""

import heapq
import shutil
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from itertools import repeat
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from calibkit.errors import BadInputError, one_line

Array = NDArray[np.float64]

_TF = "tf2_msgs/msg/TFMessage"


class Sample(NamedTuple):
    """One message: when it was recorded, what its header says, and what its kind of stream holds (`KINDS`)."""

    record_ns: int
    stamp_ns: int
    payload: Any


@dataclass(frozen=True)
class Stream:
    """The messages of one topic, in the order of their record times."""

    topic: str
    kind: str  # a key of KINDS
    frame_id: str
    samples: Iterable[Sample]


class ImuPayload(NamedTuple):
    """One IMU sample."""

    gyro: Array  # (3,) rad/s
    accel: Array  # (3,) m/s^2


class CompressedPayload(NamedTuple):
    """An image file as it is stored."""

    format: str  # jpeg or png
    data: bytes


class PosePayload(NamedTuple):
    """T_parent_child, the parent being the stream's frame_id."""

    q: Array  # (4,) xyzw
    p: Array  # (3,) m
    child: str


class _Writer(Protocol):
    def add_connection(self, topic: str, msgtype: str, *, typestore: Typestore) -> Any: ...
    def write(self, connection: Any, timestamp: int, data: Any) -> None: ...


def _time(store: Typestore, t_ns: int) -> Any:
    return store.types["builtin_interfaces/msg/Time"](sec=t_ns // 10**9, nanosec=t_ns % 10**9)


def _header(store: Typestore, stamp_ns: int, frame_id: str) -> Any:
    _, fields = store.fielddefs["std_msgs/msg/Header"]
    sequence = {"seq": 0} if "seq" in dict(fields) else {}  # ROS 1 only
    return store.types["std_msgs/msg/Header"](**sequence, stamp=_time(store, stamp_ns), frame_id=frame_id)


def _vector(store: Typestore, v: Array, name: str = "Vector3") -> Any:
    return store.types[f"geometry_msgs/msg/{name}"](x=float(v[0]), y=float(v[1]), z=float(v[2]))


def _quaternion(store: Typestore, q: Array) -> Any:
    return store.types["geometry_msgs/msg/Quaternion"](x=float(q[0]), y=float(q[1]), z=float(q[2]), w=float(q[3]))


def _imu(store: Typestore, header: Any, payload: ImuPayload) -> Any:
    unknown = np.zeros(9)
    return store.types["sensor_msgs/msg/Imu"](
        header=header,
        orientation=_quaternion(store, np.array([0, 0, 0, 1.0])),
        orientation_covariance=np.array([-1.0, 0, 0, 0, 0, 0, 0, 0, 0]),  # ROS: there is no orientation
        angular_velocity=_vector(store, payload.gyro),
        angular_velocity_covariance=unknown,
        linear_acceleration=_vector(store, payload.accel),
        linear_acceleration_covariance=unknown,
    )


def _compressed(store: Typestore, header: Any, payload: CompressedPayload) -> Any:
    data = np.frombuffer(payload.data, np.uint8)
    return store.types["sensor_msgs/msg/CompressedImage"](header=header, format=payload.format, data=data)


def _mono8(store: Typestore, header: Any, payload: NDArray[np.uint8]) -> Any:
    height, width = payload.shape
    return store.types["sensor_msgs/msg/Image"](
        header=header, height=height, width=width, encoding="mono8", is_bigendian=0, step=width, data=payload.ravel()
    )


def _pose(store: Typestore, header: Any, payload: PosePayload) -> Any:
    pose = store.types["geometry_msgs/msg/Pose"](position=_vector(store, payload.p, "Point"), orientation=_quaternion(store, payload.q))
    return store.types["geometry_msgs/msg/PoseStamped"](header=header, pose=pose)


def _tf(store: Typestore, header: Any, payload: PosePayload) -> Any:
    transform = store.types["geometry_msgs/msg/Transform"](translation=_vector(store, payload.p), rotation=_quaternion(store, payload.q))
    stamped = store.types["geometry_msgs/msg/TransformStamped"](header=header, child_frame_id=payload.child, transform=transform)
    return store.types[_TF](transforms=[stamped])


# Kind of stream -> ROS type, and how a message is made of a header and a payload.
KINDS: dict[str, tuple[str, Callable[[Typestore, Any, Any], Any]]] = {
    "imu": ("sensor_msgs/msg/Imu", _imu),
    "compressed": ("sensor_msgs/msg/CompressedImage", _compressed),
    "mono8": ("sensor_msgs/msg/Image", _mono8),
    "pose": ("geometry_msgs/msg/PoseStamped", _pose),
    "tf": (_TF, _tf),
}


@dataclass(frozen=True)
class _Storage:
    suffix: str  # of the path that is given
    types: Stores
    open: Callable[[Path], AbstractContextManager[Any]]

    def serialize(self, store: Typestore, message: Any, msgtype: str) -> Any:
        encode = store.serialize_ros1 if self.types is Stores.ROS1_NOETIC else store.serialize_cdr
        return encode(message, msgtype)


STORAGES: dict[str, _Storage] = {
    "ros1": _Storage(".bag", Stores.ROS1_NOETIC, Ros1Writer),
    "mcap": _Storage("", Stores.ROS2_HUMBLE, lambda path: Ros2Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)),
    "db3": _Storage("", Stores.ROS2_HUMBLE, lambda path: Ros2Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3)),
}


def write_bag(path: Path, streams: Iterable[Stream], storage: str) -> None:
    """Write the streams, merged by record time, as one bag (mcap, db3: a ROS 2 folder); an existing path is refused."""
    kind = STORAGES[storage]
    if path.exists():
        raise BadInputError(f"{one_line(path)}: exists already; remove it or give another name")
    store, streams = _typestore(kind.types), list(streams)
    try:
        with kind.open(path) as writer:
            _write(writer, store, streams, kind)
    except BaseException:
        # Half a bag helps nobody.
        shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
        raise


def _typestore(types: Stores) -> Typestore:
    store = get_typestore(types)
    if _TF not in store.types:  # rosbags' Noetic knows no tf2
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", _TF))
    return store


def _write(writer: _Writer, store: Typestore, streams: list[Stream], storage: _Storage) -> None:
    topics = [writer.add_connection(stream.topic, KINDS[stream.kind][0], typestore=store) for stream in streams]
    numbered = (zip(stream.samples, repeat(i)) for i, stream in enumerate(streams))
    for sample, i in heapq.merge(*numbered, key=lambda item: item[0].record_ns):
        stream, (msgtype, build) = streams[i], KINDS[streams[i].kind]
        message = build(store, _header(store, sample.stamp_ns, stream.frame_id), sample.payload)
        writer.write(topics[i], sample.record_ns, storage.serialize(store, message, msgtype))
