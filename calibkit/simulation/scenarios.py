"""The table of simulated rigs: each a name, the sensors, the board, the motion, and what is wrong with the recording."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from calibkit.geometry import se3, so3
from calibkit.models.board import AprilGrid, Board, Charuco, Checkerboard, CircleGrid
from calibkit.models.cameras import CAMERAS
from calibkit.simulation.camera import RenderStyle, SimCamera
from calibkit.simulation.imu import SimImu

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Scenario:
    """A rig before a board, and how it moves."""

    summary: str
    cameras: tuple[SimCamera, ...]  # the first one looks at the board while the rig rests
    board: Board
    imu: SimImu | None = field(default_factory=SimImu)
    motion: str = "rich"  # a key of trajectory.MOTIONS
    speed: float = 1.0  # that motion's path, so many times as fast
    distance: float = 0.75  # m, of the board from the resting camera
    duration_s: float = 30.0
    style: RenderStyle = field(default_factory=RenderStyle)
    jpeg_quality: int | None = None  # None: raw mono8 images
    faults: tuple[str, ...] = ()  # keys of faults.FAULTS


# The camera's x axis points along the IMU's y, roughly, as on EuRoC's rig; no entry is zero, so that no sign can hide.
T_IMU_CAM: Array = se3.make(so3.exp(np.array([0.05, -0.08, 1.50])), np.array([-0.021, -0.065, 0.010]))
_T_CAM0_CAM1: Array = se3.make(so3.exp(np.array([0.004, -0.012, 0.006])), np.array([0.110, 0.0005, -0.001]))

_EUROC = SimCamera(
    CAMERAS["pinhole-radtan"],
    np.array([461.2, 459.8, 366.7, 247.9, -0.28, 0.07, 2e-4, 2e-5]),
    (752, 480),
    T_imu_cam=T_IMU_CAM,
    dt_imu_cam=0.005,
)
_FISHEYE = replace(
    _EUROC, model=CAMERAS["pinhole-equi"], params=np.array([305.4, 304.9, 381.3, 242.6, 0.0035, 0.0007, -0.0021, 0.0002]), size=(752, 480)
)
_RIGHT = replace(
    _EUROC,
    params=np.array([457.6, 456.3, 379.9, 255.2, -0.284, 0.074, -1e-4, -4e-5]),
    T_imu_cam=T_IMU_CAM @ _T_CAM0_CAM1,
    name="cam1",
    topic="/cam1/image_raw",
)
_GRID = AprilGrid(columns=6, rows=6, tag_size=0.088, spacing=0.3)

_CAM_IMU = Scenario("pinhole-radtan camera and IMU, rich motion, JPEG: the sample bag", (_EUROC,), _GRID, duration_s=15.0, jpeg_quality=60)
_SHARP = replace(_CAM_IMU, duration_s=30.0, jpeg_quality=None, imu=None)


SCENARIOS: dict[str, Scenario] = {
    "cam-imu": _CAM_IMU,
    "stereo-imu": replace(_CAM_IMU, summary="two pinhole-radtan cameras and IMU", cameras=(_EUROC, _RIGHT)),
    "fisheye-imu": replace(_CAM_IMU, summary="pinhole-equi camera and IMU", cameras=(_FISHEYE,), distance=0.45),
    "aprilgrid": replace(_SHARP, summary="pinhole-radtan camera alone, raw images of an AprilGrid"),
    "checkerboard": replace(_SHARP, summary="the same with a checkerboard", distance=0.55, board=Checkerboard(9, 6, 0.07, 0.06)),
    "charuco": replace(_SHARP, summary="the same with a ChArUco board", distance=0.55, board=Charuco(8, 6, 0.08, 0.06)),
    "circlegrid": replace(
        _SHARP, summary="the same with an asymmetric circle grid", distance=0.55, board=CircleGrid(4, 11, 0.05, asymmetric=True)
    ),
    "static": replace(_CAM_IMU, summary="cam-imu without motion: almost nothing is observable", motion="static"),
    "translation": replace(_CAM_IMU, summary="cam-imu without rotation: all views fronto-parallel, no lever arm", motion="translation"),
    "single-axis": replace(_CAM_IMU, summary="cam-imu turning about one axis only", motion="single-axis"),
    "constant-velocity": replace(_CAM_IMU, summary="cam-imu gliding without acceleration or rotation", motion="constant-velocity"),
    "planar": replace(_CAM_IMU, summary="cam-imu moving as a vehicle on flat ground", motion="planar"),
}
