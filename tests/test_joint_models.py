"""On request: an IMU's scale, misalignment and sensitivity, a shutter's line delay; what the rig file knows of them is carried."""

from dataclasses import replace

import numpy as np
import pytest
from joint_samples import Recording, recorded
from scipy.stats import chi2

from calibkit.data.observations import ImuSamples
from calibkit.data.result import Result
from calibkit.data.rig import Estimate, ImuIntrinsics
from calibkit.data.transforms import make_covariance
from calibkit.data.verdict import Status, Verdict
from calibkit.estimation.joint import Joint, Settings, calibrate_joint
from calibkit.estimation.joint_imu import ImuInput, imu_input
from calibkit.estimation.joint_state import A_G, LINE, M_A, M_G, PHI
from calibkit.geometry import se3, so3
from calibkit.geometry.so3 import Array
from calibkit.models.imu import ACCEL_PARAMETERS, GYRO_PARAMETERS, PARAMETERS, SENSITIVITY_PARAMETERS, ImuModel, lower
from calibkit.simulation.session import START_NS

SCALED = (M_A, M_G, PHI)
MODEL = ImuModel(
    M_a=lower(np.array([1.012, 0.008, 0.991, -0.011, 0.006, 1.02])),
    M_g=lower(np.array([0.994, -0.004, 1.006, 0.003, 0.007, 1.011])),
    C_g_i=so3.exp(np.array([0.008, -0.012, 0.005])),
    A_g=1e-4 * np.array([[3.0, -1, 2], [0, -4, 1], [2, 1, 5]]),
)
IDEAL_G = replace(MODEL, A_g=np.zeros((3, 3)))
SHORT_S = 15.0
LINE_DELAY = 30e-6  # s: 14 ms an image of 480 rows
FREE = (*ACCEL_PARAMETERS[:6], *GYRO_PARAMETERS[:9])


def through(model: ImuModel, imu: ImuSamples, gains: tuple[float, float] = (1.0, 1.0)) -> ImuSamples:
    """What an IMU of this model makes of samples."""
    accel, gyro = model.measure(imu.accel, imu.gyro)
    return replace(imu, accel=gains[0] * accel, gyro=gains[1] * gyro, unit="SI" if gains == (1.0, 1.0) else "counts")


def calibrated(recording: Recording, imu: ImuInput, extras: tuple[str, ...] = ()) -> tuple[Joint, Result]:
    recording = replace(recording, imu=imu.samples)
    joint = recording.fitted(Settings(imu=imu.model, imu_information=imu.information, extras=(*imu.extras, *extras)))
    return joint, recording.result(joint, imu=imu)


def sigmas_off(found: ImuIntrinsics, truth: dict[str, float], names: tuple[str, ...]) -> Array:
    estimates = [found.parameters[name] for name in names]
    return np.array([(each.value - truth[name]) / each.sigma for name, each in zip(names, estimates, strict=True)])  # type: ignore[operator]


def extrinsics_off(recording: Recording, result: Result) -> Array:
    """T_cam_imu's error, whitened by its own covariance, and dt's in sigmas (7,)."""
    entry, dt = result.rig.transforms["T_cam0_imu0"], result.rig.time_offsets["dt_imu0_cam0"].offset
    assert entry.covariance is not None
    error = se3.local(se3.inverse(recording.session.tracks[0].camera.T_imu_cam), np.array(entry.matrix))
    white = np.linalg.solve(np.linalg.cholesky(np.array(entry.covariance.matrix)), error)
    assert dt.value is not None
    assert dt.sigma is not None
    return np.append(white, (dt.value - recording.td) / dt.sigma)


def check_model(seed: int, asked: tuple[str, ...], duration_s: float = 30.0) -> Array:
    """An IMU whose model is free comes out within 4 of its sigmas, and so do T_cam_imu and dt beside it."""
    recording = recorded(seed, duration_s)
    model = MODEL if A_G in asked else IDEAL_G
    _, result = calibrated(recording, imu_input("imu0", through(model, recording.imu), None, asked))
    found = result.rig.imus["imu0"].intrinsics
    assert found is not None
    assert {each.status for each in found.parameters.values()} == {Status.DETERMINED}
    assert found.verdict is Verdict.PASS
    names = (*FREE, *(SENSITIVITY_PARAMETERS if A_G in asked else ()))
    assert found.parameters.keys() == {*names, *(f"b_{s}_{a}" for s in "ag" for a in "xyz")}
    z = np.concatenate([sigmas_off(found, model.values(), names), extrinsics_off(recording, result)])
    assert np.abs(z).max() < 4.0
    return z


def test_scale_misalignment_and_sensitivity_are_found() -> None:
    check_model(0, (*SCALED, A_G), SHORT_S)


@pytest.mark.slow
@pytest.mark.parametrize("asked", [SCALED, (*SCALED, A_G)])
def test_models_of_the_imu_are_found_and_their_sigmas_honest(asked: tuple[str, ...]) -> None:
    z = np.array([check_model(seed, asked) for seed in range(20)])
    within(z)


def within(z: Array) -> None:
    """Errors over sigma (seeds, parameters): each parameter's rms in its band of 99.9 %, and together within a fifth of 1."""
    low, high = np.sqrt(chi2.ppf([0.0005, 0.9995], len(z)) / len(z))
    rms = np.sqrt(np.mean(z**2, axis=0))
    print(f"{len(z)} seeds: error over sigma {rms.round(2)}, together {np.sqrt(np.mean(z**2)):.2f}")
    assert np.all((rms > low) & (rms < high)), rms
    assert 0.8 < np.sqrt(np.mean(z**2)) < 1.2


@pytest.mark.slow
def test_what_does_not_turn_tells_no_scale_of_the_gyroscope() -> None:
    recording = recorded(0, SHORT_S, motion="translation")
    _, result = calibrated(recording, imu_input("imu0", through(IDEAL_G, recording.imu), None, SCALED))
    found = result.rig.imus["imu0"].intrinsics
    assert found is not None
    unknown = {key for key, each in found.parameters.items() if each.value is None}
    assert unknown >= {*GYRO_PARAMETERS[:9]}
    assert {f"imu0.{key}" for key in unknown} <= set(result.not_observable)
    assert result.exit_code == 3
    assert any(reason.text.startswith("imu0: M_g_xx") and "turn the rig fast" in reason.text for reason in result.reasons)


def rig_entry(model: ImuModel, sigma: float | None, gains: tuple[float, float] = (1.0, 1.0)) -> ImuIntrinsics:
    """What a rig file says of an IMU: every number known to `sigma` of its scale, or given."""
    of = {"M_a": gains[0], "b_a": gains[0], "M_g": gains[1], "b_g": gains[1], "A_g": gains[1], "phi": 1.0}
    values = {key: value for key, value in model.values().items() if key not in SENSITIVITY_PARAMETERS}
    values = {key: value * of[key[:3]] for key, value in values.items()}
    own = {key: None if sigma is None else sigma * of[key[:3]] for key in values}
    return ImuIntrinsics(
        unit="SI" if gains == (1.0, 1.0) else "counts",
        gravity=9.80665,
        parameters={
            key: Estimate(value=value, sigma=own[key], status=Status.GIVEN if sigma is None else Status.DETERMINED)
            for key, value in values.items()
        },
        covariance=None if sigma is None else make_covariance(list(own), np.diag([(each or 0.0) ** 2 for each in own.values()])),
    )


def test_intrinsics_of_the_rig_file_are_carried_with_their_covariance() -> None:
    """Raw counts, known to 5e-4: better than that recording tells of the accelerometer, worse than it tells of the gyroscope."""
    recording, gains, known_to = recorded(0, SHORT_S), (2000.0, 900.0), 5e-4
    rng = np.random.default_rng(5)
    told = {key: value + known_to * rng.standard_normal() for key, value in IDEAL_G.values().items()}
    known = rig_entry(ImuModel.of(told), known_to, gains)
    _, result = calibrated(recording, imu_input("imu0", through(IDEAL_G, recording.imu, gains), known, ()))
    assert np.abs(extrinsics_off(recording, result)).max() < 4
    found = result.rig.imus["imu0"].intrinsics
    assert found is not None
    assert found.unit == "counts"
    truth = {key: value * gains[0 if key[2] == "a" else 1] if key[:2] == "M_" else value for key, value in IDEAL_G.values().items()}
    assert np.abs(sigmas_off(found, truth, FREE)).max() < 4
    for key, gain in (("M_a_xx", gains[0]), ("M_g_xx", gains[1])):
        sigma = found.parameters[key].sigma
        assert sigma is not None
        assert sigma < known_to * gain
    assert found.covariance is not None
    assert found.covariance.order == [key for key in PARAMETERS if key in found.parameters]


def test_given_intrinsics_without_a_covariance_are_held_and_it_is_said() -> None:
    recording = recorded(0, SHORT_S)
    imu = imu_input("imu0", through(IDEAL_G, recording.imu), rig_entry(IDEAL_G, None), ())
    joint, result = calibrated(recording, imu)
    assert joint.fit.problem.extras == ()
    assert np.abs(extrinsics_off(recording, result)).max() < 4
    assert any(reason.text.startswith("imu0: its scale and axes are held as given") for reason in result.reasons)
    freed = imu_input("imu0", through(IDEAL_G, recording.imu), rig_entry(IDEAL_G, None), SCALED)
    assert freed.extras == SCALED
    assert not freed.given


@pytest.mark.slow
def test_another_unit_is_no_scale() -> None:
    recording = recorded(0, SHORT_S)
    imu = imu_input("imu0", replace(recording.imu, accel=recording.imu.accel * 1.5), None, SCALED)
    _, result = calibrated(recording, imu)
    assert result.exit_code == 1
    assert any("accelerometer's scale is 1.5, not about 1" in reason.text for reason in result.reasons)


def turned_through(recording: Recording, line_delay: float) -> Recording:
    """The recording by a shutter that reads row after row, the middle one at the frame's time."""
    views = recording.views
    points = views.board.points[views.corner]
    noise = views.uv - project(recording, points, np.zeros(len(points)))
    late = np.zeros(len(points))
    for _ in range(4):
        uv = project(recording, points, late)
        late = line_delay * (uv[:, 1] - (views.image_size[1] - 1) / 2)
    return replace(recording, views=replace(views, uv=uv + noise))


def project(recording: Recording, points: Array, late: Array) -> Array:
    """Where points are seen, each so late after its frame."""
    session, views = recording.session, recording.views
    track = session.tracks[0]
    frame = np.searchsorted(track.stamp_ns, views.t_ns)[views.frame]
    t = (track.t_true_ns[frame] - START_NS) * 1e-9 + late
    T = se3.inverse(session.trajectory.at(t).T_world_imu @ track.camera.T_imu_cam) @ session.T_world_board
    uv: Array = track.camera.model.project(se3.transform(T, points[:, None])[:, 0], track.camera.params).uv
    return uv


def check_line_delay(seed: int, duration_s: float = 30.0) -> Array:
    recording = turned_through(recorded(seed, duration_s), LINE_DELAY)
    joint, result = calibrated(recording, ImuInput(recording.imu), (LINE,))
    found = result.rig.cameras["cam0"].line_delay
    assert found is not None
    assert found.value is not None
    assert found.sigma is not None
    assert found.status is Status.DETERMINED
    assert result.verdict is Verdict.PASS, [reason.text for reason in result.reasons]
    z = np.append(extrinsics_off(recording, result), (found.value - LINE_DELAY) / found.sigma)
    assert np.abs(z).max() < 4
    assert joint.fit.factors["camera 0"] < 1.1
    return z


def test_line_delay_is_found() -> None:
    check_line_delay(0, SHORT_S)


@pytest.mark.slow
def test_line_delays_are_found_and_their_sigmas_honest() -> None:
    within(np.array([check_line_delay(seed) for seed in range(20)]))


@pytest.mark.slow
def test_line_delay_is_not_claimed_at_rest() -> None:
    recording = recorded(0, SHORT_S, motion="static")
    _, result = calibrated(recording, ImuInput(recording.imu), (LINE,))
    found = result.rig.cameras["cam0"].line_delay
    assert found is not None
    assert found.value is None
    assert "cam0.line_delay" in result.not_observable


def test_rolling_shutter_that_nobody_asked_for_is_told() -> None:
    recording = turned_through(recorded(0, SHORT_S), LINE_DELAY / 3)
    result = recording.result(recording.fitted())
    assert [reason.verdict for reason in result.reasons] == [Verdict.CHECK]
    text = result.reasons[0].text
    assert text.startswith("cam0: its rows seem to be read one after the other, 10 +- ")
    assert text.endswith("a rolling shutter? Add --line-delay")


@pytest.mark.slow
def test_line_delay_of_the_rig_file_is_used() -> None:
    recording = turned_through(recorded(0, SHORT_S), LINE_DELAY)
    camera = recording.camera
    known = camera.camera.model_copy(update={"line_delay": Estimate(value=LINE_DELAY, unit="s")})
    joint = calibrate_joint([replace(camera, camera=known)], recording.imu, recording.noise)
    result = recording.result(joint)
    assert np.abs(extrinsics_off(recording, result)).max() < 4
    assert joint.fit.factors["camera 0"] < 1.1
    assert result.verdict is Verdict.PASS
