"""Several IMUs on one trajectory: where each sits, how it lies and how late its clock is, with sigmas that mean what they say."""

import re
from dataclasses import replace

import numpy as np
import pytest
from joint_samples import Recording, error_of, recorded, second_imu
from test_joint_honest import band, rms

from calibkit.data.observations import ImuSamples
from calibkit.data.result import Result
from calibkit.data.verdict import Status, Verdict
from calibkit.errors import BadInputError
from calibkit.estimation.joint import Joint
from calibkit.estimation.joint_trust import joint_trust
from calibkit.geometry import se3, so3
from calibkit.geometry.so3 import Array

pytestmark = pytest.mark.slow
T_IMU0_IMU1 = se3.make(so3.exp(np.array([0.4, -1.1, 0.7])), np.array([0.12, -0.20, 0.08]))
DT = 0.0123  # s, t_imu0 = t_imu1 + DT


def error_of_imu(joint: Joint, dt: float = DT) -> Array:
    """Return the step of T_imu1_imu0 and dt from the truth to the estimate (7,)."""
    x = joint.fit.x.beside[0]
    return np.append(se3.local(se3.inverse(T_IMU0_IMU1), x.T_imu_ref), x.dt - dt)


def of_imu(joint: Joint) -> Array:
    return joint.fit.problem.border.at(["T_imu 1", "dt_imu 1"])


def told(recording: Recording, *beside: ImuSamples) -> tuple[Joint, Result, str]:
    joint = recording.fitted(beside=beside)
    result = recording.result(joint, beside=beside)
    return joint, result, "; ".join(reason.text for reason in result.reasons)


def test_sigmas_of_where_a_second_imu_sits_are_honest() -> None:
    """And those of the camera, which has more to go by, still are."""
    scores, of_camera, whitened, sizes = [], [], [], []
    for seed in range(20):
        recording = recorded(seed)
        joint = recording.fitted(beside=[second_imu(recording.session, seed, T_IMU0_IMU1, DT)])
        cov, where = joint_trust(joint.fit).cov, of_imu(joint)
        error, own = error_of_imu(joint), cov[np.ix_(where, where)]
        scores.append(error / np.sqrt(np.diag(own)))
        whitened.append(error @ np.linalg.solve(own, error) / len(error))
        sizes.append(error)
        camera = joint.fit.problem.border.camera(0)
        of_camera.append(error_of(recording, joint)[camera] / np.sqrt(np.diag(cov))[camera])
    least, most = band(len(scores))
    found, camera_found, pooled = rms(np.array(scores)), rms(np.array(of_camera)), float(np.sqrt(np.mean(whitened)))
    p, R, dt = 1e3 * rms(np.array(sizes)[:, :3]), np.degrees(rms(np.array(sizes)[:, 3:6])), 1e6 * rms(np.array(sizes)[:, 6])
    line = (
        f"imu1 of 20 seeds: p {p.round(3)} mm, R {R.round(4)} deg, dt {dt:.1f} us; error over sigma {found.round(2)}, together {pooled:.2f}"
    )
    print(f"{line}; camera {camera_found.round(2)}")
    assert np.all((found > least) & (found < most)), line
    assert np.all((camera_found > least) & (camera_found < most)), line
    assert 0.8 < pooled < 1.25, line


def test_clocks_of_different_origins() -> None:
    recording = recorded(1)
    joint, _, text = told(recording, second_imu(recording.session, 1, T_IMU0_IMU1, -250.0))
    assert np.abs(error_of_imu(joint, -250.0)[6]) < 1e-4
    assert np.linalg.norm(error_of_imu(joint, -250.0)[3:6]) < 1e-3
    assert "dt_imu0_imu1: -250.000 s is more than any delay: imu1 and imu0 have clocks of different origins" in text


@pytest.mark.parametrize(
    ("motion", "open_of_T", "open_of_dt"),
    [
        ("static", ("R of T_imu1_imu0", "p of T_imu1_imu0"), True),
        ("translation", ("p of T_imu1_imu0 along",), False),
        ("single-axis", ("p of T_imu1_imu0 along",), False),
        ("planar", ("p of T_imu1_imu0 along",), False),
    ],
)
@pytest.mark.parametrize("seed", range(5))
def test_what_the_motion_leaves_open_of_a_second_imu(motion: str, open_of_T: tuple[str, ...], open_of_dt: bool, seed: int) -> None:
    recording = recorded(seed, motion=motion)
    joint, result, text = told(recording, second_imu(recording.session, seed, T_IMU0_IMU1, DT))
    for each in open_of_T:
        assert each in text, text
    assert ("dt_imu0_imu1.offset" in result.not_observable) == open_of_dt
    assert any(name.startswith("T_imu1_imu0.") for name in result.not_observable)
    if not open_of_dt:
        sigma = np.sqrt(np.diag(joint_trust(joint.fit).cov))[of_imu(joint)[6]]
        assert abs(error_of_imu(joint)[6]) < 4 * sigma


def test_a_rich_recording_passes_and_the_lines_say_where_the_imu_sits() -> None:
    recording = recorded(2)
    _, result, text = told(recording, second_imu(recording.session, 2, T_IMU0_IMU1, DT))
    assert not [reason for reason in result.reasons if reason.verdict is Verdict.FAIL], text
    assert not result.not_observable
    place = "imu1 sits at (12"
    assert any(place in line for line in result.facts["lines"]), result.facts["lines"]
    said = re.search(r"t_imu0 = t_imu1 \+ dt: imu1's stamps are (\S+) ms early", "; ".join(map(str, result.facts["lines"])))
    assert said is not None
    assert float(said[1]) == pytest.approx(1e3 * DT, abs=0.06)  # 4 sigma


def test_the_same_imu_twice_sits_in_one_place() -> None:
    recording = recorded(3)
    joint, _, _ = told(recording, recording.imu)
    x = joint.fit.x.beside[0]
    sigma = np.sqrt(np.diag(joint_trust(joint.fit).cov))[of_imu(joint)]
    assert np.all(np.abs(np.append(se3.local(np.eye(4), x.T_imu_ref), x.dt)) < 0.05 * sigma)  # where the solver stops


SWAP, FLIP, ROUND = np.eye(3)[[1, 0, 2]], np.diag([1.0, 1.0, -1.0]), np.eye(3)[[1, 2, 0]]
HAS = "has its axes wrong: its x, y, z are imu1's"
WRONG: dict[str, tuple[Array, Array, str]] = {
    "gyroscope swapped": (SWAP, np.eye(3), f"imu1's gyroscope {HAS} y, x, z by all other data; they are no right-handed frame"),
    "accelerometer swapped": (np.eye(3), SWAP, f"imu1's accelerometer {HAS} y, x, z by all other data; they are no right-handed"),
    "accelerometer flipped": (np.eye(3), FLIP, f"imu1's accelerometer {HAS} x, y, -z by all other data; they are no right-handed"),
    "accelerometer turned": (np.eye(3), ROUND, f"imu1's accelerometer {HAS} y, z, x by all other data: mend the driver"),
    "both swapped": (SWAP, SWAP, "imu1's axes are no right-handed frame by all other data: one is flipped, or two are swapped"),
    "in g": (np.eye(3), np.eye(3) / 9.80665, "imu1's accelerometer reads 0.102 times what all other data have it: is it in g?"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_with_a_second_imu_is_named_and_costs_the_first_nothing(name: str) -> None:
    gyro, accel, why = WRONG[name]
    recording = recorded(4, 20.0)
    imu = second_imu(recording.session, 4, T_IMU0_IMU1, DT)
    joint, result, text = told(recording, replace(imu, gyro=imu.gyro @ gyro.T, accel=imu.accel @ accel.T))
    assert why in text
    T, dt = result.rig.transforms["T_imu1_imu0"], result.rig.time_offsets["dt_imu0_imu1"]
    assert T.status is Status.NOT_OBSERVABLE
    assert dt.offset.value is None
    assert T.verdict is dt.verdict is Verdict.FAIL
    assert result.rig.transforms["T_cam0_imu0"].verdict is Verdict.PASS
    of_camera = joint.fit.problem.border.camera(0)
    z = error_of(recording, joint)[of_camera] / np.sqrt(np.diag(joint_trust(joint.fit).cov))[of_camera]
    assert np.abs(z).max() < 4


def test_a_second_imu_in_deg_per_s_or_of_another_scale_is_named() -> None:
    recording = recorded(4)
    imu = second_imu(recording.session, 4, T_IMU0_IMU1, DT)
    with pytest.raises(BadInputError, match=r"a further IMU turns 57 times as fast as the reference IMU: a gyroscope in deg/s"):
        recording.fitted(beside=[replace(imu, gyro=np.degrees(imu.gyro))])
    _, _, text = told(recording, replace(imu, accel=imu.accel * 1.2))
    assert "imu1's accelerometer is" in text
