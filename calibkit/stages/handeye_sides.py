"""What `calibkit handeye` is asked, and what it has of both sides before anything is estimated."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibkit.data.observations import BoardViews, ImageFrame
from calibkit.data.result import Result
from calibkit.data.rig import Camera, TimeOffset
from calibkit.data.verdict import Reason
from calibkit.errors import BadInputError, one_line
from calibkit.estimation.board_poses import BoardPoses
from calibkit.estimation.hand_eye import HandEyeFit
from calibkit.geometry.so3 import Array
from calibkit.stages.intrinsics import AUTO

ROBOT = ("eye-in-hand", "eye-to-hand")
Times = NDArray[np.int64]


@dataclass(frozen=True)
class Options:
    """Which poses, and how to look."""

    poses: Path | None = None  # a robot's
    pose_format: str | None = None
    pose_unit: str | None = None
    angle_unit: str | None = None
    pairs: tuple[Path, ...] = ()
    motions: bool = False  # the pairs are motions, no poses
    pose: tuple[str, ...] = ()  # topics, NAME=/topic, or tf:PARENT/CHILD
    cameras: tuple[str, ...] = ()
    target: Path | None = None
    model: str = AUTO  # of a lens that is calibrated on the way
    resolution: tuple[int, int] | None = None
    base: str | None = None  # what to call the poses' frames
    gripper: str | None = None
    inverse_poses: bool = False
    inverse_second: bool = False
    setup: str | None = None
    predict: int = 0
    method: str = "refined"
    robot_noise: str = "auto"  # exact, or sigmas of a coordinate in mm and deg
    free_intrinsics: bool = False
    cache: bool = True
    ros_distro: str | None = None

    @property
    def pose_files(self) -> list[Path]:
        return [path for path in (self.poses, *self.pairs) if path is not None]


@dataclass(frozen=True)
class Seen:
    """A camera's boards, and the lens that they were seen through."""

    views: BoardViews
    poses: BoardPoses
    camera: Camera
    lens: Result | None  # where it was calibrated on the way
    images: Callable[[], Iterator[ImageFrame]] | None = None  # to be read again; None of corner files


@dataclass(frozen=True)
class Sides:
    """n poses of each side that belong together."""

    first: Array  # (n, 4, 4) T_base_gripper, or T_world1_sensor1
    second: Array  # (n, 4, 4) T_cam_target, or T_world2_sensor2
    frames: tuple[str, str, str, str]  # gripper, cam, base, target, or sensor1, sensor2, world1, world2
    candidates: tuple[str, ...]  # setups that it may be
    labels: tuple[str, ...]
    t_ns: Times | None = None  # (n,)
    cov_second: Array | None = None  # (n, 6, 6)
    board: Seen | None = None  # with one pose a row
    lines: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    inputs: tuple[tuple[str, str | None], ...] = ()
    fit: HandEyeFit | None = None  # of streams: they are paired and fitted at once
    offsets: dict[str, TimeOffset] = field(default_factory=dict)  # of their clocks, for the rig
    reasons: tuple[Reason, ...] = ()  # about these
    unconfirmed: str = ""  # what else the setup of `fit` may be

    def words(self, setup: str) -> tuple[str, str, str, str]:
        """Return the frames 1, 2, w1, w2 of a setup."""
        return words(self.frames, setup)


def words(frames: tuple[str, str, str, str], setup: str) -> tuple[str, str, str, str]:
    """Return the frames 1, 2, w1, w2 of a setup from gripper, cam, base, target, or sensor1, sensor2, world1, world2."""
    one, two, w1, w2 = frames
    return (w1, two, one, w2) if setup == "eye-to-hand" else frames


def only(board: Seen, rows: NDArray[np.intp]) -> Seen:
    """Return some of a camera's board poses."""
    p = board.poses
    kept = p.kept & np.isin(board.views.frame, p.frame[rows])
    some = replace(
        p,
        t_ns=p.t_ns[rows],
        labels=tuple(p.labels[i] for i in rows),
        frame=p.frame[rows],
        T_cam_board=p.T_cam_board[rows],
        cov=p.cov[rows],
        rms=p.rms[rows],
        n_corners=p.n_corners[rows],
        kept=kept,
    )
    return replace(board, poses=some)


def arm_names(options: Options) -> tuple[str, str]:
    """Return what to call the poses' parent and child."""
    names = (options.base or "base", options.gripper or "gripper")
    for name in names:
        if not (name.isascii() and name.isalnum() and name[0].isalpha()) or names[0] == names[1]:
            raise BadInputError(f"--base {one_line(names[0])} --gripper {one_line(names[1])}: give two names of letters and digits")
    return names
