"""A rig with something in every field, and asymmetric in every frame, for the tests of files."""

from typing import Any

import numpy as np

from calibkit.data.rig import Camera, Estimate, Imu, ImuIntrinsics, InputFile, Reprojection, Rig, StageRun
from calibkit.data.transforms import make_covariance, make_time_offset, make_transform
from calibkit.data.verdict import Status, Verdict
from calibkit.geometry import se3, so3
from calibkit.models.cameras import CAMERAS
from calibkit.models.imu import CORRECTION, EQUATION, UNITS, ImuModel

T_CAM0_IMU0 = se3.make(so3.exp(np.array([0.4, -1.1, 0.7])), np.array([0.03, -0.05, 0.11]))
T_CAM1_CAM0 = se3.make(so3.exp(np.array([-0.02, 0.05, 0.01])), np.array([-0.11, 0.002, -0.004]))
LENSES = {
    "pinhole-radtan": [458.654, 457.296, 367.215, 248.375, -0.28340811, 0.07395907, 0.00019359, 1.76187114e-05],
    "pinhole-radtan5": [1056.18, 1056.26, 958.95, 587.09, -0.1302, 0.0955, 1e-4, -2e-4, -0.045],
    "pinhole-radtan8": [520.1, 519.7, 322.3, 241.9, 0.31, -0.12, 1e-4, -3e-4, 0.02, 0.52, -0.03, 0.01],
    "pinhole-equi": [190.978, 190.973, 254.932, 256.897, 0.0034823894, 0.0007150348, -0.0020532361, 0.0002029367],
}
SIZES = {"pinhole-radtan": (752, 480), "pinhole-radtan5": (1920, 1200), "pinhole-radtan8": (640, 480), "pinhole-equi": (512, 512)}
IMU_MODEL = ImuModel(  # nothing symmetric, and far enough from ideal that an inverse or a transpose shows
    M_a=np.array([[1.03, 0, 0], [0.02, 0.96, 0], [-0.015, 0.011, 1.05]]),
    b_a=np.array([0.3, -0.2, 0.1]),
    M_g=np.array([[0.97, 0, 0], [-0.013, 1.04, 0], [0.017, 0.009, 1.01]]),
    C_g_i=so3.exp(np.array([0.3, -0.2, 0.5])),
    b_g=np.array([0.01, -0.02, 0.03]),
    A_g=np.array([[1e-3, 2e-3, -3e-3], [4e-3, -5e-3, 6e-3], [7e-3, 8e-3, -9e-3]]),
)


def imu_intrinsics(model: ImuModel = IMU_MODEL, **more: Any) -> ImuIntrinsics:
    """What `calibkit imu` would write of this model."""
    parameters = {
        name: Estimate(value=value, unit=UNITS["SI"][name[:3]], sigma=1e-4, status=Status.DETERMINED)
        for name, value in model.values().items()
    }
    return ImuIntrinsics(equation=EQUATION, correction=CORRECTION, **{"gravity": 9.81744, "parameters": parameters} | more)


def camera(model: str, topic: str | None = None) -> Camera:
    """A determined camera with a full covariance."""
    names = CAMERAS[model].parameter_names
    rng = np.random.default_rng(7)
    A = rng.normal(size=(len(names), len(names))) * 1e-3
    C = A @ A.T
    return Camera(
        topic=topic,
        resolution=SIZES[model],
        model=model,
        equation=CAMERAS[model].equation,
        parameters={
            name: Estimate(
                value=value, unit="px" if i < 4 else "", sigma=C[i, i] ** 0.5, sigma_plain=C[i, i] ** 0.5 / 3, status=Status.DETERMINED
            )
            for i, (name, value) in enumerate(zip(names, LENSES[model], strict=True))
        },
        covariance=make_covariance(names, C),
        reprojection=Reprojection(rms_px=0.1034, rms_all_px=0.2, held_out_rms_px=0.11, corners=11424, corners_dropped=3, frames=28),
        verdict=Verdict.CHECK,
        reasons=["no board in the lower right: k3 is weak there", "second \u2014 with 'quotes': and # signs"],
    )


def full_rig() -> Rig:
    """Two cameras and two IMUs with transforms, offsets and provenance."""
    return Rig(
        cameras={"cam0": camera("pinhole-radtan", "/cam0/image_raw"), "cam1": camera("pinhole-equi")},
        imus={
            "imu0": Imu(
                topic="/imu0",
                rate_hz=200.0,
                gyro_noise_density=Estimate(value=1.6968e-4, unit="rad/s/sqrt(Hz)", sigma=1e-6, status=Status.WEAK),
                gyro_random_walk=Estimate(value=1.9393e-05, unit="rad/s^2/sqrt(Hz)"),
                accel_noise_density=Estimate(value=2.0e-3, unit="m/s^2/sqrt(Hz)"),
                accel_random_walk=Estimate(value=3.0e-3, unit="m/s^3/sqrt(Hz)"),
            ),
            "imu1": Imu(gyro_noise_density=Estimate(value=2e-4)),
        },
        transforms={
            "T_cam0_imu0": make_transform("cam0", "imu0", T_CAM0_IMU0, np.diag([1e-6, 2e-6, 3e-6, 1e-8, 2e-8, 3e-8]), Status.DETERMINED),
            "T_cam1_cam0": make_transform("cam1", "cam0", T_CAM1_CAM0),
            "T_imu1_imu0": make_transform("imu1", "imu0", se3.make(so3.exp(np.array([3.0, 0.2, 0.1])), np.array([0.5, 0.1, -0.2]))),
        },
        time_offsets={
            "dt_imu0_cam0": make_time_offset("imu0", "cam0", Estimate(value=-0.008, unit="s", sigma=1e-5, status=Status.DETERMINED)),
            "dt_imu0_imu1": make_time_offset("imu0", "imu1", Estimate(value=0.025, unit="s")),
        },
        provenance=[
            StageRun(
                stage="intrinsics",
                command="calibkit intrinsics a.bag --target 'my board.yaml'",
                calibkit="0.1.0",
                inputs=[InputFile(name="a.bag", sha256="0" * 64), InputFile(name="images")],
                options={"model": "auto", "frames": 3, "strict": True, "cut": None, "sigma": 0.1},
                residual_file="rig.intrinsics.residuals.npz",
                residual_sha256="f" * 64,
            )
        ],
    )
