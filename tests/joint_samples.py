"""Recordings of a camera and an IMU before a board, their joint estimate, and the truth beside it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from time_offset_samples import camera_session, lens

from calibkit.data.observations import BoardViews, ImuSamples
from calibkit.data.result import Result
from calibkit.estimation.added_motion import missing_motions
from calibkit.estimation.joint import CameraInput, ImuGiven, ImuNoise, Joint, Settings, calibrate_joint
from calibkit.estimation.joint_checks import check_joint
from calibkit.estimation.joint_imu import ImuInput, NamedImu
from calibkit.estimation.joint_result import joint_result
from calibkit.estimation.joint_trust import Trust, joint_trust
from calibkit.estimation.stamps import check_stamps
from calibkit.geometry import se3
from calibkit.geometry.so3 import Array
from calibkit.simulation.imu import SimImu, simulate_imu
from calibkit.simulation.session import START_NS, Session, simulate_views
from calibkit.simulation.trajectory import State

TD = 0.005
OTHER_IMU = SimImu(rate_hz=250.0, gyro_bias=(-0.01, 0.005, 0.003), accel_bias=(0.1, 0.06, -0.08))
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

    def fitted(self, settings: Settings | None = None, beside: Sequence[ImuSamples] = ()) -> Joint:
        return calibrate_joint([self.camera], self.imu, self.noise, settings, beside=[ImuGiven(each, self.noise) for each in beside])

    def result(self, joint: Joint, halves: bool = False, imu: ImuInput | None = None, beside: Sequence[ImuSamples] = ()) -> Result:
        """Return what the command would say of the fit."""
        trust, checks = joint_trust(joint.fit), check_joint(joint.fit, halves)
        imus = [NamedImu("imu0", imu or ImuInput(self.imu)), *(NamedImu(f"imu{j}", ImuInput(each)) for j, each in enumerate(beside, 1))]
        stamps = {each.name: check_stamps(each.input.samples.t_ns, "sample") for each in imus}
        stamps["cam0"] = check_stamps(self.views.t_ns, "frame")
        return joint_result(joint, trust, checks, [self.camera], imus, stamps, missing_motions(joint.fit, trust))


def recorded(seed: int, duration_s: float = 30.0, noise_px: float = 0.2, motion: str = "rich", faults: tuple[str, ...] = ()) -> Recording:
    session = camera_session(seed, TD, duration_s=duration_s, motion=motion, faults=faults)
    views, _ = simulate_views(session, noise_px)
    assert session.imu is not None
    return Recording(session, replace(views, board=session.board_told), session.imu)


def second_imu(session: Session, seed: int, T_imu0_imu1: Array, dt: float, imu: SimImu = OTHER_IMU) -> ImuSamples:
    """Return what an IMU elsewhere on the rig measures, t_imu0 = t_imu1 + dt: its place along the way is differentiated by differences."""
    t, h = np.arange(int(session.scenario.duration_s * imu.rate_hz)) / imu.rate_hz, 2e-4
    before, at, after = ((session.trajectory.at(t + side).T_world_imu @ T_imu0_imu1)[:, :3, 3] for side in (-h, 0, h))
    state = session.trajectory.at(t)
    moved = State(
        state.T_world_imu @ T_imu0_imu1, (after - before) / (2 * h), (before - 2 * at + after) / h**2, state.omega_i @ T_imu0_imu1[:3, :3]
    )
    t_ns = START_NS + np.round(t * 1e9).astype(np.int64)
    samples, _ = simulate_imu(imu, moved, t_ns, np.random.default_rng([seed, 77]))
    return replace(samples, t_ns=samples.t_ns - round(dt * 1e9))


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
