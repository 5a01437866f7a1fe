"""What a simulated rig really is, as a rig file."""

from collections.abc import Sequence

import numpy as np

from calibkit.data.rig import Camera, Estimate, Imu, Rig, StageRun
from calibkit.data.transforms import make_time_offset, make_transform
from calibkit.geometry import se3
from calibkit.simulation.camera import SimCamera
from calibkit.simulation.imu import SimImu
from calibkit.simulation.session import Session
from calibkit.version import __version__


def true_rig(session: Session, name: str, faults: Sequence[str] = ()) -> Rig:
    """Return the rig of a session; extrinsics and time offsets are to the IMU, or to the first camera where there is none."""
    cameras, imu = session.scenario.cameras, session.scenario.imu
    if imu is not None:
        reference, T_imu_reference, dt_imu_reference, others = imu.name, np.eye(4), 0.0, cameras
    else:
        reference, T_imu_reference, dt_imu_reference, others = cameras[0].name, cameras[0].T_imu_cam, cameras[0].dt_imu_cam, cameras[1:]
    transforms, offsets = {}, {}
    for camera in others:
        transforms[f"T_{reference}_{camera.name}"] = make_transform(reference, camera.name, se3.inverse(T_imu_reference) @ camera.T_imu_cam)
        offset = Estimate(value=camera.dt_imu_cam - dt_imu_reference, unit="s")
        offsets[f"dt_{reference}_{camera.name}"] = make_time_offset(reference, camera.name, offset)
    return Rig(
        cameras={camera.name: _camera(camera) for camera in cameras},
        imus={} if imu is None else {imu.name: _imu(imu)},
        transforms=transforms,
        time_offsets=offsets,
        provenance=[_provenance(session, name, faults)],
    )


def _provenance(session: Session, name: str, faults: Sequence[str]) -> StageRun:
    return StageRun(
        stage="simulate",
        command=f"calibkit simulate {name}",
        calibkit=__version__,
        options={"seed": session.seed, "duration_s": session.scenario.duration_s, "faults": ", ".join(faults) or None},
    )


def _camera(camera: SimCamera) -> Camera:
    units = {"fx": "px", "fy": "px", "cx": "px", "cy": "px"}
    values = zip(camera.model.parameter_names, camera.params, strict=True)
    return Camera(
        topic=camera.topic,
        resolution=camera.size,
        model=camera.model.name,
        equation=camera.model.equation,
        parameters={name: Estimate(value=float(value), unit=units.get(name, "")) for name, value in values},
    )


def _imu(imu: SimImu) -> Imu:
    return Imu(
        topic=imu.topic,
        rate_hz=imu.rate_hz,
        gyro_noise_density=Estimate(value=imu.gyro_noise_density, unit="rad/s/sqrt(Hz)"),
        gyro_random_walk=Estimate(value=imu.gyro_random_walk, unit="rad/s^2/sqrt(Hz)"),
        accel_noise_density=Estimate(value=imu.accel_noise_density, unit="m/s^2/sqrt(Hz)"),
        accel_random_walk=Estimate(value=imu.accel_random_walk, unit="m/s^3/sqrt(Hz)"),
    )
