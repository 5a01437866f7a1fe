"""The IMU model: its two directions, its names, and its place in the rig file."""

from pathlib import Path

import numpy as np
import pytest

from calibkit.data.rig import Estimate, Imu, ImuIntrinsics, Noise, Rig
from calibkit.geometry import so3
from calibkit.io.rig_file import load_rig, save_rig
from calibkit.models import imu
from calibkit.models.imu import ImuModel


def odd_model() -> ImuModel:
    rng = np.random.default_rng(0)
    small = 0.02 * rng.standard_normal((4, 3, 3))
    return ImuModel(
        M_a=415 * (np.eye(3) + np.tril(small[0])),
        b_a=np.array([33123.0, 33276, 32360]),
        M_g=4778 * (np.eye(3) + np.tril(small[1])),
        C_g_i=so3.exp(np.array([0.01, -0.02, 0.03])),
        b_g=np.array([32768.0, 32466, 32485]),
        A_g=small[2],
    )


def test_correcting_undoes_measuring() -> None:
    model, rng = odd_model(), np.random.default_rng(1)
    accel, gyro = 9.8 * rng.standard_normal((50, 3)), rng.standard_normal((50, 3))
    a, w = model.correct(*model.measure(accel, gyro))
    np.testing.assert_allclose(a, accel, atol=1e-12)
    np.testing.assert_allclose(w, gyro, atol=1e-12)


def test_the_equation_is_the_one_that_is_written_in_the_file() -> None:
    model = odd_model()
    accel, gyro = np.array([1.0, -2.0, 9.0]), np.array([0.3, 0.2, -0.1])
    a, w = model.measure(accel, gyro)
    np.testing.assert_allclose(a, model.M_a @ accel + model.b_a, rtol=1e-14)
    np.testing.assert_allclose(w, model.M_g @ model.C_g_i @ gyro + model.A_g @ (model.C_g_i @ accel) + model.b_g, rtol=1e-14)


def test_names_and_values_come_back() -> None:
    model = odd_model()
    values = model.values()
    assert tuple(values) == imu.PARAMETERS
    again = ImuModel.of(values)
    for name in ("M_a", "b_a", "M_g", "C_g_i", "b_g", "A_g"):
        np.testing.assert_allclose(getattr(again, name), getattr(model, name), atol=1e-12)
    without = ImuModel.of({name: value for name, value in values.items() if not name.startswith("A_g")})
    assert not without.A_g.any()


def test_noise_and_intrinsics_survive_the_rig_file(tmp_path: Path) -> None:
    unit = Estimate(value=1.0, sigma=0.1)
    values = {name: Estimate(value=value) for name, value in odd_model().values().items()}
    intrinsics = ImuIntrinsics(equation=imu.EQUATION, correction=imu.CORRECTION, unit="counts", gravity=9.81, parameters=values)
    rig = Rig(imus={"imu0": Imu(noise={"gyro_x": Noise(white=unit, flicker=unit, walk=unit)}, intrinsics=intrinsics)})
    save_rig(rig, tmp_path / "rig.yaml")
    assert load_rig(tmp_path / "rig.yaml") == rig


def test_intrinsics_with_a_part_missing_are_refused() -> None:
    values = {name: Estimate(value=value) for name, value in odd_model().values().items() if name != "b_a_x"}
    with pytest.raises(ValueError, match="the parameters of an IMU are M_a_xx"):
        ImuIntrinsics(gravity=9.81, parameters=values)
