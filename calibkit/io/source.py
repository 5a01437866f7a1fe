"""What every kind of recording is turned into: topics, and for each kind of topic a way to read it when asked."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibkit.data.observations import ImageFrame, ImuSamples, PoseSamples
from calibkit.data.progress import Progress

Array = NDArray[np.float64]
Times = NDArray[np.int64]

# What a topic of each kind is good for, as `calibkit info` tells it.
USES = {
    "image": "intrinsics (with --target), timeoffset, handeye (with --target)",
    "imu": "allan, imu, timeoffset; joint (yet to come)",
    "pose": "timeoffset, handeye",
    "twist": "timeoffset",
    "tf": "timeoffset and handeye (with --pose tf:PARENT/CHILD)",
    "camera_info": "the driver's own calibration, to compare with",
    "corners": "intrinsics (with --target and --resolution), timeoffset and handeye (with --target)",
    "cloud": "nothing yet",
    "video": "nothing: video-coded images are not read; record sensor_msgs/CompressedImage (jpeg or png) instead",
    "other": "nothing",
}


@dataclass(frozen=True)
class TopicInfo:
    """One topic as its files describe it."""

    name: str
    type: str  # ROS type, or what the file is ("image folder", "IMU CSV")
    kind: str  # a key of USES
    count: int  # messages that the files' indices claim

    @property
    def usable_for(self) -> str:
        return USES[self.kind]


@dataclass(frozen=True)
class Stamps:
    """Times of one topic's messages in the order of the file, and what was read with them."""

    header_ns: Times | None  # (n,) None: this type has no header
    record_ns: Times  # (n,)
    imu: ImuSamples | None = None  # of an IMU topic


@dataclass(frozen=True)
class Look:
    """Some images of a topic, shown while a survey passes them."""

    every: int  # the first of so many images
    show: Callable[[ImageFrame], None]


@dataclass(frozen=True)
class CameraInfo:
    """A driver's own calibration of a camera, as sensor_msgs/CameraInfo has it."""

    width: int
    height: int
    model: str  # plumb_bob, rational_polynomial, equidistant
    K: Array  # (3, 3) px
    D: Array  # (n,)
    frame: str


@dataclass(frozen=True)
class CornerRows:
    """Board corners from a file, not yet laid against a board."""

    file: str
    t_ns: Times  # (n,)
    corner: NDArray[np.int64]  # (n,) 4 tag_id + corner_idx
    uv: Array  # (n, 2) px
    xyz: Array | None  # (n, 3) m, where the file says where it thinks the corner is
    sigma_px: Array | None  # (n,)


@dataclass(frozen=True)
class Edge:
    """Transforms of one parent-child pair of a tf tree, T_parent_child."""

    poses: PoseSamples
    static: bool


@dataclass
class Source:
    """One recording, or one part of a recording: nothing is read before it is asked for."""

    name: str
    files: list[Path]
    start_ns: int = 0  # of the first message, where known without reading all
    topics: list[TopicInfo] = field(default_factory=list)
    images: dict[str, Callable[[], Iterator[ImageFrame]]] = field(default_factory=dict)
    imu: dict[str, Callable[[Progress], ImuSamples]] = field(default_factory=dict)
    part: str = ""  # "gyro" or "accel": an IMU's file that holds this sensor only
    poses: dict[str, Callable[[], PoseSamples]] = field(default_factory=dict)
    twist: dict[str, Callable[[], ImuSamples]] = field(default_factory=dict)  # rates alone
    camera_info: dict[str, Callable[[], CameraInfo]] = field(default_factory=dict)
    corners: dict[str, Callable[[], CornerRows]] = field(default_factory=dict)
    edges: Callable[[], dict[tuple[str, str], Edge]] | None = None
    survey: Callable[[Progress, Mapping[str, Look]], dict[str, Stamps]] | None = None
    warnings: list[str] = field(default_factory=list)
    recorded: dict[str, int] = field(default_factory=dict)  # header stamps of a topic that are zero: record times stand in for them

    def warn(self, text: str) -> None:
        """Note once what a reader of the result must know."""
        if text not in self.warnings:
            self.warnings.append(text)


def seconds_text(t_ns: int) -> str:
    """Return the stamp in seconds, every digit of it."""
    return f"{t_ns // 10**9}.{t_ns % 10**9:09d}"
