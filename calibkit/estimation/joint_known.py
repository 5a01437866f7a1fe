"""A rig file's cameras and IMU as a joint state, with the covariance that it has of them: a calibration to be tested on other data."""

from collections.abc import Sequence

import numpy as np

from calibkit.data.rig import Camera, Rig, Transform
from calibkit.data.transforms import find_time_offset
from calibkit.data.verdict import Status
from calibkit.errors import BadInputError
from calibkit.estimation.joint_state import CameraState
from calibkit.estimation.joint_suspects import Known
from calibkit.estimation.rig_values import inverse_transform, tangent_covariance
from calibkit.geometry.so3 import Array
from calibkit.models.cameras import CAMERAS
from calibkit.models.imu import ImuModel

_ALONE = "; calibkit diagnose --no-imu tests cameras alone"


def known_calibration(rig: Rig, cameras: Sequence[str], imu: str, model: ImuModel) -> Known:
    """Return what the rig file says of the cameras beside the IMU; BadInputError where it lacks one, or has one that is not observable."""
    states, covs = [], []
    for name in cameras:
        camera, entry, dt = rig.cameras[name], _transform(rig, name, imu), find_time_offset(rig, imu, name)
        if dt is None or dt.value is None:
            raise BadInputError(f"the rig file has no dt_{imu}_{name}: run calibkit joint first{_ALONE}")
        lens = np.array([camera.parameters[p].value for p in CAMERAS[camera.model].parameter_names], float)
        delay = 0.0 if camera.line_delay is None else camera.line_delay.value or 0.0
        states.append(CameraState(np.array(entry.matrix), dt.value, lens, delay))
        covs.append((tangent_covariance(entry), 0.0 if dt.sigma is None else dt.sigma**2, _of_lens(camera)))
    return Known(tuple(states), model, tuple(covs))


def _transform(rig: Rig, name: str, imu: str) -> Transform:
    entry = rig.transforms.get(f"T_{name}_{imu}")
    if entry is None and f"T_{imu}_{name}" in rig.transforms:
        entry = inverse_transform(f"T_{imu}_{name}", rig.transforms[f"T_{imu}_{name}"])
    if entry is None:
        raise BadInputError(f"the rig file has no T_{name}_{imu}: run calibkit joint first{_ALONE}")
    if entry.status is Status.NOT_OBSERVABLE:
        raise BadInputError(f"T_{name}_{imu} is not observable by the rig file: there is nothing to test; calibrate it first")
    return entry


def _of_lens(camera: Camera) -> Array:
    names = CAMERAS[camera.model].parameter_names
    if camera.covariance is None:
        return np.diag([(camera.parameters[p].sigma or 0.0) ** 2 for p in names])
    out = np.zeros((len(names), len(names)))
    at = [names.index(p) for p in camera.covariance.order]
    out[np.ix_(at, at)] = camera.covariance.matrix
    return out
