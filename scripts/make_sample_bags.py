"""Make the recordings in sample_bags/ anew: `python scripts/make_sample_bags.py`."""

import gzip
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calibkit.cli.progress import bar
from calibkit.data.rig import Camera, Estimate, Imu, ImuAxis, ImuIntrinsics, Noise, Rig
from calibkit.data.transforms import make_transform
from calibkit.geometry import se3, so3
from calibkit.io.rig_file import save_rig
from calibkit.io.target_file import load_target
from calibkit.models import imu
from calibkit.models.cameras import CAMERAS
from calibkit.simulation.camera import SimCamera, random_board_poses
from calibkit.simulation.multi_position import MultiPositionPlan, simulate_multi_position
from calibkit.simulation.noise import SimNoise, simulate_noise
from calibkit.simulation.render import Renderer, encode_jpeg
from calibkit.stages.simulate import simulate

FOLDER = Path(__file__).resolve().parent.parent / "sample_bags"
LARGEST = 8_000_000  # bytes: what a repository bears
START_NS = 1_700_000_000_000_000_000
GYRO = SimNoise(white=1.7e-4, flicker=1.5e-4, walk=2.5e-5)
ACCEL = SimNoise(white=2e-3, flicker=1.5e-3, walk=2.5e-4)
DEVICE = imu.ImuModel(
    M_a=np.array([[1.01, 0, 0], [0.004, 0.99, 0], [-0.003, 0.006, 1.005]]),
    b_a=np.array([0.1, -0.08, 0.12]),
    M_g=np.array([[0.995, 0, 0], [0.003, 1.008, 0], [-0.004, 0.002, 1.002]]),
    C_g_i=so3.exp(np.array([0.004, -0.006, 0.008])),
    b_g=np.array([0.01, -0.02, 0.015]),
)
GRIPPER_CAM = se3.make(so3.exp(np.array([0.1, -0.2, 1.5])), np.array([0.04, -0.06, 0.09]))
BASE_TARGET = se3.make(so3.exp(np.array([3.0, 0.2, 0.1])), np.array([0.7, 0.2, 0.05]))
GYRO_AXES: tuple[ImuAxis, ...] = ("gyro_x", "gyro_y", "gyro_z")
ACCEL_AXES: tuple[ImuAxis, ...] = ("accel_x", "accel_y", "accel_z")


def write_imu(name: str, rate_hz: float, gyro: NDArray[np.float64], accel: NDArray[np.float64]) -> None:
    """Write a CSV of an IMU, gzipped without a time of its own: the same samples give the same bytes."""
    lines = ["t [ns],wx [rad/s],wy [rad/s],wz [rad/s],ax [m/s^2],ay [m/s^2],az [m/s^2]"]
    for k, row in enumerate(np.hstack([gyro, accel])):
        lines.append(f"{START_NS + round(k * 1e9 / rate_hz)}," + ",".join(f"{value:.6f}" for value in row))
    (FOLDER / name).write_bytes(gzip.compress(("\n".join(lines) + "\n").encode(), 9, mtime=0))


def make_rest() -> None:
    """An IMU at rest for an hour at 20 Hz."""
    rng, n, rate_hz = np.random.default_rng(0), 72_000, 20.0
    gyro, accel = (simulate_noise(noise, n, rate_hz, rng, 3) for noise in (GYRO, ACCEL))
    write_imu("imu_rest.csv.gz", rate_hz, gyro + [0.004, -0.003, 0.002], accel + [0.05, -0.03, 9.81])  # noqa: RUF005


def make_stands() -> imu.ImuModel:
    """An IMU put down in many attitudes, at 50 Hz; its biases are the means over the stands."""
    made = simulate_multi_position(MultiPositionPlan(model=DEVICE, gravity=9.81, rate_hz=50.0), seed=0)
    write_imu("imu_stands.csv.gz", 50.0, made.gyro, made.accel)
    return made.model


def true_imu(model: imu.ImuModel) -> Imu:
    """Return the truth of both recordings; they are of different devices, as far as noise goes."""
    noise = {
        axis: Noise(white=Estimate(value=of.white), flicker=Estimate(value=of.flicker), walk=Estimate(value=of.walk))
        for axes, of in ((GYRO_AXES, GYRO), (ACCEL_AXES, ACCEL))
        for axis in axes
    }
    values = {name: Estimate(value=value) for name, value in model.values().items()}
    return Imu(noise=noise, intrinsics=ImuIntrinsics(equation=imu.EQUATION, correction=imu.CORRECTION, gravity=9.81, parameters=values))


def make_hand_eye() -> Rig:
    """A robot with a camera on its gripper before the board of target.yaml: 20 images, and the robot's poses of 0.1 mm and 0.02 deg."""
    rng, folder = np.random.default_rng(0), FOLDER / "hand_eye"
    folder.mkdir(exist_ok=True)
    board = load_target(FOLDER / "target.yaml")
    model = CAMERAS["pinhole-radtan"]
    camera = SimCamera(model, np.array([390.0, 389.2, 318.4, 201.1, -0.28, 0.07, 2e-4, 2e-5]), (640, 400))
    T_cam_target = random_board_poses(camera, board, 20, rng, fill=(0.5, 0.8))
    renderer = Renderer(camera, board)
    T = BASE_TARGET @ se3.inverse(T_cam_target) @ se3.inverse(GRIPPER_CAM)
    T = se3.retract(T, np.concatenate([1e-4 * rng.normal(size=(20, 3)), np.radians(0.02) * rng.normal(size=(20, 3))], axis=1))
    yaw_pitch_roll = Rotation.from_matrix(T[:, :3, :3]).as_euler("ZYX", degrees=True)
    rows = ["image,X [mm],Y [mm],Z [mm],A [deg],B [deg],C [deg]"]
    for k in range(20):
        name = f"im_{k + 1:02}.jpg"
        (folder / name).write_bytes(encode_jpeg(renderer.render(T_cam_target[k], rng), 85))
        rows.append(f"{name}," + ",".join(f"{x:.4f}" for x in (*(1e3 * T[k, :3, 3]), *yaw_pitch_roll[k])))
    (folder / "poses.csv").write_text("\n".join(rows) + "\n")
    parameters = {name: Estimate(value=float(v)) for name, v in zip(model.parameter_names, camera.params, strict=True)}
    transforms = {
        "T_gripper_cam0": make_transform("gripper", "cam0", GRIPPER_CAM),
        "T_base_target": make_transform("base", "target", BASE_TARGET),
    }
    return Rig(cameras={"cam0": Camera(resolution=camera.size, model=model.name, parameters=parameters)}, transforms=transforms)


if __name__ == "__main__":
    simulate("cam-imu", FOLDER, seed=0, force=True, progress=bar)
    save_rig(make_hand_eye(), FOLDER / "truth_hand_eye.yaml", force=True)
    make_rest()
    save_rig(Rig(imus={"imu0": true_imu(make_stands())}), FOLDER / "truth_imu.yaml", force=True)
    for path in sorted(path for path in FOLDER.rglob("*") if path.is_file()):
        size = path.stat().st_size
        print(f"{path.name}: {size / 1e6:.2f} MB")
        if size > LARGEST:
            raise SystemExit(f"{path.name} is larger than {LARGEST / 1e6:g} MB")
