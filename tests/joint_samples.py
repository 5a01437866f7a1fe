"""Recordings of a camera and an IMU before a board, their joint estimate, and the truth beside it."""

from dataclasses import dataclass, replace

import numpy as np
from time_offset_samples import camera_session, lens

from calibkit.data.observations import BoardViews, ImuSamples
from calibkit.data.result import Result
from calibkit.estimation.joint import CameraInput, ImuNoise, Joint, Settings, calibrate_joint
from calibkit.estimation.joint_checks import check_joint
from calibkit.estimation.joint_imu import ImuInput
from calibkit.estimation.joint_result import joint_result
from calibkit.estimation.joint_trust import Trust, joint_trust
from calibkit.estimation.stamps import check_stamps
from calibkit.geometry import se3
from calibkit.geometry.so3 import Array
from calibkit.simulation.imu import SimImu
from calibkit.simulation.session import Session, simulate_views

TD = 0.005
NOISE = ImuNoise(SimImu.gyro_noise_density, SimImu.gyro_random_walk, SimImu.accel_noise_density, SimImu.accel_random_walk)


@dataclass(frozen=True)
class Recording:
    """What the sensors of a simulated rig saw; a fault is a `replace` of what they say."""

    session: Session
    views: BoardViews
    imu: ImuSamples
    td: float = TD
    noise: ImuNoise = NOISE

    @property
    def camera(self) -> CameraInput:
        return CameraInput(self.views, lens(self.session))

    def fitted(self, settings: Settings | None = None) -> Joint:
        return calibrate_joint([self.camera], self.imu, self.noise, settings)

    def result(self, joint: Joint, halves: bool = False, imu: ImuInput | None = None) -> Result:
        """Return what the command would say of the fit."""
        trust, checks = joint_trust(joint.fit), check_joint(joint.fit, halves)
        stamps = {"imu0": check_stamps(self.imu.t_ns, "sample"), "cam0": check_stamps(self.views.t_ns, "frame")}
        return joint_result(joint, trust, checks, [self.camera], "imu0", imu or ImuInput(self.imu), stamps)


def recorded(seed: int, duration_s: float = 30.0, noise_px: float = 0.2, motion: str = "rich", faults: tuple[str, ...] = ()) -> Recording:
    session = camera_session(seed, TD, duration_s=duration_s, motion=motion, faults=faults)
    views, _ = simulate_views(session, noise_px)
    assert session.imu is not None
    return Recording(session, replace(views, board=session.board_told), session.imu)


def error_of(recording: Recording, joint: Joint) -> Array:
    """Return the step of the border from the truth to the estimate (p,), that of gravity left out (0)."""
    border, camera, x = joint.fit.problem.border, recording.session.tracks[0].camera, joint.fit.x.cameras[0]
    error = np.zeros(border.size)
    error[border["T 0"]] = se3.local(se3.inverse(camera.T_imu_cam), x.T_cam_imu)
    error[border["dt 0"]] = x.dt - recording.td
    error[border["lens 0"]] = x.lens - camera.params
    return error


def of_camera(joint: Joint, trust: Trust) -> tuple[slice, Array]:
    """Return where T_cam_imu, dt and lens stand, and their covariance."""
    where = joint.fit.problem.border.camera(0)
    return where, trust.cov[where, where]
