"""What sensors saw: frozen records of flat arrays, checked once at the door.

Times are int64 nanoseconds of the recording's own clock (SPEC section 1).
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from calibkit.errors import BadInputError
from calibkit.models.board import Board

Array = NDArray[np.float64]
Times = NDArray[np.int64]
ImuUnit = Literal["SI", "counts"]


def _check(record: str, **arrays: tuple[NDArray[np.generic], tuple[int, ...]]) -> None:
    for name, (array, shape) in arrays.items():
        if array.shape != shape:
            raise ValueError(f"{record}.{name} has shape {array.shape}, expected {shape}")
        if array.dtype.kind == "f" and not np.all(np.isfinite(array)):
            raise BadInputError(f"{record}.{name} holds values that are not finite: remove those samples from the recording")


@dataclass(frozen=True)
class ImuSamples:
    """Gyroscope and accelerometer of one IMU, sorted by time or not: as the recording had them."""

    t_ns: Times  # (n,)
    gyro: Array  # (n, 3) rad/s, or counts; (n, 0) where there is no gyroscope
    accel: Array  # (n, 3) m/s^2, or counts; (n, 0) where there is no accelerometer
    unit: ImuUnit = "SI"
    interpolated: bool = False  # the gyroscope at the accelerometer's times: its noise is another

    def __post_init__(self) -> None:
        n = len(self.t_ns)
        axes = {name: 3 if array.shape != (n, 0) else 0 for name, array in (("gyro", self.gyro), ("accel", self.accel))}
        _check("ImuSamples", t_ns=(self.t_ns, (n,)), gyro=(self.gyro, (n, axes["gyro"])), accel=(self.accel, (n, axes["accel"])))

    @property
    def has_gyro(self) -> bool:
        return bool(self.gyro.shape[1] == 3)

    @property
    def has_accel(self) -> bool:
        return bool(self.accel.shape[1] == 3)

    def select(self, rows: slice | NDArray[np.generic]) -> "ImuSamples":
        """Return some of the samples: a slice (views of the arrays), a mask or indices."""
        return ImuSamples(self.t_ns[rows], self.gyro[rows], self.accel[rows], self.unit, self.interpolated)


@dataclass(frozen=True)
class TableRates:
    """One mounting on a turntable: its known rate over time, on the IMU's clock, linear between the rows."""

    t_ns: Times  # (k,)
    rate: Array  # (k,) rad/s about the table's axis
    axis: Array | None = None  # (3,) that axis in the IMU's frame, where it is known


class Lost(str):
    """A warning that says what of the recording is lost: whatever is made from the rest is to be looked at."""


@dataclass(frozen=True)
class PoseSamples:
    """Poses T_parent_child over time."""

    t_ns: Times  # (n,)
    q: Array  # (n, 4) xyzw of R_parent_child
    p: Array  # (n, 3) m, child's origin in parent
    parent: str
    child: str

    def __post_init__(self) -> None:
        n = len(self.t_ns)
        _check("PoseSamples", t_ns=(self.t_ns, (n,)), q=(self.q, (n, 4)), p=(self.p, (n, 3)))


@dataclass(frozen=True)
class BoardViews:
    """Board corners of one camera: one row a frame, and one row a corner, sorted by frame."""

    board: Board
    image_size: tuple[int, int]  # width, height px
    t_ns: Times  # (f,) stamp of each frame that shows the board; 0 throughout where there are no stamps
    labels: tuple[str, ...]  # (f,) what to call each frame: file name or stamp
    frame: NDArray[np.int32]  # (n,) index into the frames
    corner: NDArray[np.int32]  # (n,) index into board.points
    uv: Array  # (n, 2) px
    sigma_px: Array  # (n,) px per coordinate, as the detector judged it
    camera: str = "cam0"
    sigma_bias_px: float = 0.0  # px per coordinate: the detector's error that stays the same at one place of the image, in every frame
    n_images: int = 0  # images looked at, those without a board included
    warnings: tuple[str, ...] = field(default=())

    def __post_init__(self) -> None:
        f, n = len(self.t_ns), len(self.frame)
        _check(
            "BoardViews",
            t_ns=(self.t_ns, (f,)),
            frame=(self.frame, (n,)),
            corner=(self.corner, (n,)),
            uv=(self.uv, (n, 2)),
            sigma_px=(self.sigma_px, (n,)),
        )
        if len(self.labels) != f:
            raise ValueError(f"BoardViews has {len(self.labels)} labels for {f} frames")
        if n and (np.any(np.diff(self.frame) < 0) or self.frame[-1] >= f or self.corner.max() >= len(self.board.points)):
            raise ValueError("BoardViews rows must be sorted by frame, with frame and corner indices in range")

    @property
    def n_frames(self) -> int:
        return len(self.t_ns)

    def select(self, frames: NDArray[np.generic]) -> "BoardViews":
        """Return the views of the given frames only (an index or a boolean mask), in the recording's order."""
        keep = np.zeros(self.n_frames, bool)
        keep[frames] = True
        rows = keep[self.frame]
        renumber = np.cumsum(keep) - 1
        return BoardViews(
            board=self.board,
            image_size=self.image_size,
            t_ns=self.t_ns[keep],
            labels=tuple(label for label, kept in zip(self.labels, keep, strict=True) if kept),
            frame=renumber[self.frame[rows]].astype(np.int32),
            corner=self.corner[rows],
            uv=self.uv[rows],
            sigma_px=self.sigma_px[rows],
            camera=self.camera,
            sigma_bias_px=self.sigma_bias_px,
            n_images=self.n_images,
            warnings=self.warnings,
        )


@dataclass(frozen=True)
class FeatureTracks:
    """Points of the scene followed through one camera's images: one row where a track is seen in a frame, sorted by frame, then track."""

    camera: str
    image_size: tuple[int, int]  # width, height px
    t_ns: Times  # (f,) stamps, increasing
    labels: tuple[str, ...]  # (f,) what to call each frame: file name or stamp
    frame: NDArray[np.int32]  # (n,) index into the frames
    track: NDArray[np.int32]  # (n,) which point it is; a number is never used again
    uv: Array  # (n, 2) px
    warnings: tuple[str, ...] = field(default=())

    def __post_init__(self) -> None:
        f, n = len(self.t_ns), len(self.frame)
        _check("FeatureTracks", t_ns=(self.t_ns, (f,)), frame=(self.frame, (n,)), track=(self.track, (n,)), uv=(self.uv, (n, 2)))
        if len(self.labels) != f:
            raise ValueError(f"FeatureTracks has {len(self.labels)} labels for {f} frames")
        if np.any(np.diff(self.t_ns) <= 0):
            raise ValueError("FeatureTracks.t_ns must increase")
        if n and (self.frame[0] < 0 or self.frame[-1] >= f or np.any(np.diff(self.frame.astype(np.int64) << 32 | self.track) <= 0)):
            raise ValueError("FeatureTracks rows must be sorted by frame, then track, without repeats, with frames in range")


@dataclass(frozen=True)
class ImageFrame:
    """One image of a recording, not yet decoded: many may wait while few are in memory as pixels."""

    t_ns: int
    label: str  # file name, or the stamp in seconds
    payload: bytes  # as stored: what the corner cache hashes
    decode: Callable[[], NDArray[np.uint8] | NDArray[np.uint16]]  # -> gray (h, w); thread-safe; BadInputError when broken
