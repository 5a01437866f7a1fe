"""What ROS messages mean: kinds of topics by type, decoding with rosbags' own standard types, and bulk decoding of Imu.

Definitions inside a file are never compiled: rosbags would run code generated from untrusted text, and one unparsable
definition would block the rest. The types read here are the same in every ROS 2 distribution (a test holds that); a ROS 1
checksum that differs from the standard one is told.
"""

import struct
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from calibkit.errors import BadInputError, one_line

Array = NDArray[np.float64]
DECODE_ERRORS = (SerdeError, struct.error, ValueError, IndexError, KeyError, TypeError, AssertionError, OverflowError, MemoryError)

IMU = "sensor_msgs/msg/Imu"
IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
_TF = "tf2_msgs/msg/TFMessage"
_OLD_TF = "tf/msg/tfMessage"  # the same under its first name
_VIDEO = (
    "foxglove_msgs/msg/CompressedVideo",
    "ffmpeg_image_transport_msgs/msg/FFMPEGPacket",
    "theora_image_transport/msg/Packet",
    "h264_msgs/msg/Packet",
    "webots_ros/msg/H264",
)
_VIDEO_FORMATS = ("h264", "h265", "hevc", "av1", "vp9", "compresseddepth")

Pose = tuple[Any, Any, str, str]  # position, orientation, parent, child


def _stamped(message: Any) -> Pose:
    return message.pose.position, message.pose.orientation, message.header.frame_id, ""


def _covariance(message: Any) -> Pose:
    return message.pose.pose.position, message.pose.pose.orientation, message.header.frame_id, ""


def _odometry(message: Any) -> Pose:
    return message.pose.pose.position, message.pose.pose.orientation, message.header.frame_id, message.child_frame_id


def transform(message: Any) -> Pose:
    """Return the pose in a TransformStamped: T_frame_id_child_frame_id."""
    return message.transform.translation, message.transform.rotation, message.header.frame_id, message.child_frame_id


POSES: dict[str, Callable[[Any], Pose]] = {
    "geometry_msgs/msg/PoseStamped": _stamped,
    "geometry_msgs/msg/PoseWithCovarianceStamped": _covariance,
    "nav_msgs/msg/Odometry": _odometry,
    "geometry_msgs/msg/TransformStamped": transform,
}


def _rates(message: Any) -> Any:
    return message.twist.angular


def _rates_with_covariance(message: Any) -> Any:
    return message.twist.twist.angular


TWISTS: dict[str, Callable[[Any], Any]] = {
    "geometry_msgs/msg/TwistStamped": _rates,
    "geometry_msgs/msg/TwistWithCovarianceStamped": _rates_with_covariance,
}
KINDS = {
    IMAGE: "image",
    COMPRESSED: "image",
    IMU: "imu",
    CAMERA_INFO: "camera_info",
    "sensor_msgs/msg/PointCloud2": "cloud",
    **dict.fromkeys(POSES, "pose"),
    **dict.fromkeys(TWISTS, "twist"),
    _TF: "tf",
    _OLD_TF: "tf",
    **dict.fromkeys(_VIDEO, "video"),
}
ENCODINGS = ("ros1", "cdr")
_DISTROS = {store.value.split("_")[-1]: store for store in Stores if store not in (Stores.EMPTY, Stores.LATEST)} | {
    "ros1": Stores.ROS1_NOETIC
}


def is_video(compressed_format: str) -> bool:
    """Tell whether CompressedImage's format field names a coding that is no still image."""
    return any(name in compressed_format.lower() for name in _VIDEO_FORMATS)


# ROS 1's checksums of the standard types (a test holds them against rosbags): to build its types takes a tenth of a second.
STANDARD_MD5 = {
    IMAGE: "060021388200f6f0f447d0fcd9c64743",
    COMPRESSED: "8f7a12909da2c9d3332d540a0977563f",
    IMU: "6a62c6daae103f4ff57a132d6f95cec2",
    CAMERA_INFO: "c9a58c1b0b154e0e6da7578cb991d214",
    "sensor_msgs/msg/PointCloud2": "1158d486dd51d683ce2f1be655c3c181",
    "geometry_msgs/msg/PoseStamped": "d3812c3cbc69362b77dc0b19b345f8f5",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "953b798c0f514ff060a53a3498ce6246",
    "nav_msgs/msg/Odometry": "cd5e73d190d741a2f92e81eda573aca7",
    "geometry_msgs/msg/TransformStamped": "b5764a33bfeb3588febc2682852579b0",
    "geometry_msgs/msg/TwistStamped": "98d34b0043a2093cf9d9345ab6eef12e",
    "geometry_msgs/msg/TwistWithCovarianceStamped": "8927a1a12fb2607ceea095b2dc440a96",
    _TF: "94810edda583a504dfda3829e70d7eec",
}


def starts_with_header(kind: str) -> bool:
    """Tell whether messages of a ROS type begin with a std_msgs/Header, as far as the standard types know."""
    if kind in STANDARD_MD5:
        return kind != _TF
    definition = typestore(None).fielddefs.get(kind)
    return bool(definition and definition[1] and definition[1][0][1][1] == "std_msgs/msg/Header")


def check_distro(name: str | None) -> None:
    """Raise BadInputError for a distribution that rosbags does not know."""
    if name is not None and name not in _DISTROS:
        raise BadInputError(f"--ros-distro {one_line(name, 40)} is not known: give one of {', '.join(sorted(_DISTROS))}")


@lru_cache
def typestore(distro: str | None) -> Typestore:
    """Return rosbags' types of a distribution: "ros1", a ROS 2 name, or the latest for None."""
    check_distro(distro)
    store = get_typestore(_DISTROS[distro] if distro else Stores.LATEST)
    if _TF not in store.fielddefs:  # rosbags has it for ROS 2 only; ROS 1's is the same
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", _TF))
    return store


def known_distro(name: str | None) -> bool:
    """Tell whether rosbags has the types of a distribution."""
    return any(store.value.endswith(f"_{name}") for store in Stores)


def deserialize(payload: bytes, kind: str, encoding: str, distro: str | None) -> Any:
    """Return a message as rosbags reads it; raises one of DECODE_ERRORS when it is damaged."""
    kind = _TF if kind == _OLD_TF else kind
    if encoding == "ros1":
        return typestore("ros1").deserialize_ros1(payload, kind)
    return typestore(distro).deserialize_cdr(payload, kind)


def header_ns(payload: bytes, encoding: str) -> int:
    """Return the stamp of a message that begins with a Header: bytes 4 to 12 both in ROS 1 (after seq) and in CDR (after its flags)."""
    if len(payload) < 12:
        return 0
    seconds, nanoseconds = struct.unpack_from(_order(payload, encoding) + "II", payload, 4)
    return int(seconds) * 10**9 + int(nanoseconds)


def _order(payload: bytes, encoding: str) -> str:
    return ">" if encoding == "cdr" and payload[1:2] == b"\x00" else "<"


def _imu_dtype(payload: bytes, encoding: str) -> np.dtype[np.void] | None:
    """Return where the fields of an Imu lie in messages as long as this one; None where this one is odd."""
    if len(payload) < 16:
        return None
    order = _order(payload, encoding)
    begin = 16 + struct.unpack_from(order + "I", payload, 12)[0]
    if encoding == "cdr":
        begin = 4 + -(-(begin - 4) // 8) * 8  # doubles are aligned to 8 bytes, counted after the 4 bytes of flags
    end = begin + 8 * (4 + 9 + 3 + 9 + 3 + 9)  # orientation, gyro and accelerometer, each with its covariance
    if not end <= len(payload) <= end + 3:
        return None
    fields = {
        "flags": ("S4", 0),
        "frame_length": (order + "u4", 12),
        "gyro": (order + "3f8", begin + 104),
        "accel": (order + "3f8", begin + 200),
    }
    names, places = zip(*fields.items(), strict=True)
    formats, offsets = zip(*places, strict=True)
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": len(payload)})


def decode_imu(payloads: Sequence[bytes], encoding: str) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return gyro (n, 3), accel (n, 3) and which messages were whole, bit for bit what rosbags reads.

    Messages of one length are joined and read at once; others one by one.
    """
    dtype = _imu_dtype(payloads[0], encoding) if payloads else None
    if dtype is not None and len(set(map(len, payloads))) == 1:
        rows = np.frombuffer(b"".join(payloads), dtype)
        same = rows["frame_length"] == rows["frame_length"][0]
        if encoding == "cdr":
            same &= rows["flags"] == rows["flags"][0]
        if np.all(same):
            return rows["gyro"].astype(np.float64), rows["accel"].astype(np.float64), np.ones(len(rows), bool)
    return _decode_imu_singly(payloads, encoding)


def _decode_imu_singly(payloads: Sequence[bytes], encoding: str) -> tuple[Array, Array, NDArray[np.bool_]]:
    values, whole = np.zeros((len(payloads), 6)), np.zeros(len(payloads), bool)
    for row, payload in enumerate(payloads):
        try:
            message = deserialize(payload, IMU, encoding, None)
        except DECODE_ERRORS:
            continue
        gyro, accel = message.angular_velocity, message.linear_acceleration
        values[row] = gyro.x, gyro.y, gyro.z, accel.x, accel.y, accel.z
        whole[row] = True
    return values[:, :3], values[:, 3:], whole
