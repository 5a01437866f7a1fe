"""Rigs whose numbers are drawn from their own covariances, for the tests of `diff` and `budget`."""

import numpy as np
from rigs import IMU_MODEL, LENSES, SIZES, T_CAM0_IMU0, imu_intrinsics

from calibkit.data.rig import Camera, Estimate, Imu, Rig, Transform
from calibkit.data.transforms import make_covariance, make_time_offset, make_transform
from calibkit.data.verdict import Status
from calibkit.geometry import se3, so3
from calibkit.models.cameras import CAMERAS

# fx fy cx cy k1 k2 p1 p2 of 28 frames at 0.1 px: tied to each other as real ones are
_LENS_SIGMA = np.array([0.12, 0.11, 0.15, 0.14, 4e-4, 3e-4, 3e-5, 3e-5])
_LENS_TIED = np.array([[1, 0.98, 0.1, -0.2, -0.3, 0.2, 0, 0.1], [0, 0, 0.3, 0, 0.9, -0.9, 0.1, 0.8], [0, 0, 0, 0.9, 0.1, 0, 0.9, 0.1]])
COV_LENS = _LENS_SIGMA * (_LENS_TIED.T @ _LENS_TIED + 0.05 * np.eye(8)) * _LENS_SIGMA[:, None]
_A = np.random.default_rng(3).normal(size=(6, 6))
COV_T = np.diag([3e-4] * 3 + [2e-4] * 3) @ (_A @ _A.T / 6 + 0.2 * np.eye(6)) @ np.diag([3e-4] * 3 + [2e-4] * 3)
SIGMA_DT = 2e-5
# near half a turn: of two recordings one gives r, the other 2 pi - r about the opposite axis
T_HALF_TURN = se3.make(so3.exp(np.pi * np.array([0.6, 0.0, 0.8])), np.array([0.5, 0.1, -0.2]))
_DENSITIES = {"gyro_noise_density": 1.7e-4, "gyro_random_walk": 2e-5, "accel_noise_density": 2e-3, "accel_random_walk": 3e-3}
_ROOT_LENS, _ROOT_T = np.linalg.cholesky(COV_LENS), np.linalg.cholesky(COV_T)
_IMU = Imu(
    **{name: Estimate(value=value, sigma=0.04 * value, status=Status.DETERMINED) for name, value in _DENSITIES.items()},
    intrinsics=imu_intrinsics(IMU_MODEL),
)
_TRANSFORMS = {
    "T_cam0_imu0": make_transform("cam0", "imu0", T_CAM0_IMU0, COV_T, Status.DETERMINED),
    "T_imu1_imu0": make_transform("imu1", "imu0", T_HALF_TURN, COV_T, Status.DETERMINED),
}
_SIGMA_INTRINSIC = 1e-4  # as imu_intrinsics says
ENTRIES = 6


def _moved(entry: Transform, T: np.ndarray) -> Transform:
    inverse, q = se3.inverse(T).tolist(), so3.to_quat(T[:3, :3]).tolist()
    here = {"matrix": T.tolist(), "inverse_matrix": inverse, "rotation_xyzw": q, "translation": T[:3, 3].tolist()}
    return entry.model_copy(update=here)


def _shifted(estimate: Estimate, by: float) -> Estimate:
    return estimate.model_copy(update={"value": estimate.value + by})


def camera(model: str, params: np.ndarray, cov: np.ndarray | None, size: tuple[int, int] | None = None) -> Camera:
    """A camera with these parameters and this covariance; given where there is none."""
    names = CAMERAS[model].parameter_names
    sigma = [None] * len(names) if cov is None else np.sqrt(np.diag(cov)).tolist()
    status = Status.GIVEN if cov is None else Status.DETERMINED
    return Camera(
        resolution=size or SIZES[model],
        model=model,
        parameters={n: Estimate(value=v, sigma=s, status=status) for n, v, s in zip(names, params.tolist(), sigma, strict=True)},
        covariance=None if cov is None else make_covariance(names, cov),
    )


def lens() -> np.ndarray:
    return np.array(LENSES["pinhole-radtan"])


def offset(value: float | None, sigma: float | None = SIGMA_DT) -> Estimate:
    status = Status.NOT_OBSERVABLE if value is None else Status.GIVEN if sigma is None else Status.DETERMINED
    return Estimate(value=value, unit="s", sigma=sigma, status=status)


def rig(rng: np.random.Generator | None = None, sigmas: float = 1.0) -> Rig:
    """Camera, IMU with noise and scale, two transforms and an offset: the truth, or drawn `sigmas` times as far from it as they say."""

    def draw(root: np.ndarray) -> np.ndarray:
        return np.zeros(len(root)) if rng is None else sigmas * root @ rng.normal(size=len(root))

    imu = _IMU
    if rng is not None:  # copies, which are not checked again: there are many of them
        density = dict(zip(_DENSITIES, draw(np.diag([0.04 * value for value in _DENSITIES.values()])).tolist(), strict=True))
        names = imu.intrinsics.parameters
        shift = dict(zip(names, draw(_SIGMA_INTRINSIC * np.eye(len(names))).tolist(), strict=True))
        shifted = {name: _shifted(estimate, shift[name]) for name, estimate in names.items()}
        noise = {name: _shifted(getattr(imu, name), density[name]) for name in _DENSITIES}
        imu = imu.model_copy(update={**noise, "intrinsics": imu.intrinsics.model_copy(update={"parameters": shifted})})
    return Rig(
        cameras={"cam0": camera("pinhole-radtan", lens() + draw(_ROOT_LENS), COV_LENS)},
        imus={"imu0": imu},
        transforms={name: _moved(entry, se3.retract(np.array(entry.matrix), draw(_ROOT_T))) for name, entry in _TRANSFORMS.items()},
        time_offsets={"dt_imu0_cam0": make_time_offset("imu0", "cam0", offset(float(-0.008 + draw(np.array([[SIGMA_DT]]))[0])))},
    )
