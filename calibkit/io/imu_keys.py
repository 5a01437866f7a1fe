"""IMU intrinsics in Kalibr's and OpenVINS' keys, both ways; `models/imu.py` has our names and equations.

Kalibr (ethz-asl/kalibr, IccSensors.py, IccScaledMisalignedImu):

    a_m = accelerometers.M a + b_a,    w_m = gyroscopes.M C_gyro_i w + gyroscopes.A C_gyro_i a + b_g

OpenVINS (rpng/open_vins, docs/propagation-analytical.dox; state/Propagator.cpp applies the inverse, with D = T^-1):

    a_m = Ta R_IMUtoACC a + b_a,       w_m = Tw R_IMUtoGYRO w + Tg a + b_g

so Ta = M_a where R_IMUtoACC is identity, Tw = M_g, R_IMUtoGYRO = C_g_i, and Tg = A_g C_g_i: OpenVINS' Tg takes the specific force in the
IMU's frame, Kalibr's A in the gyroscope's. Neither has a place for the biases: both tools estimate their own.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibkit.data.rig import Estimate, Imu, ImuIntrinsics
from calibkit.errors import one_line
from calibkit.io import foreign
from calibkit.io.yaml_file import Document
from calibkit.models.imu import CORRECTION, EQUATION, SENSITIVITY_PARAMETERS, STANDARD_GRAVITY, UNITS, ImuModel

Array = NDArray[np.float64]
Keys = Sequence[str]

_KALIBR = {"accelerometers": ("M",), "gyroscopes": ("M", "A", "C_gyro_i")}
_OPENVINS = ("Tw", "R_IMUtoGYRO", "Ta", "R_IMUtoACC", "Tg")
NAMES = ("model", *_KALIBR, *_OPENVINS)  # of an IMU's keys that speak of its intrinsics
_KALIBR_GRAVITY = 9.80655  # m/s^2 (sic), the length to which Kalibr holds its gravity vector
_ABOVE_DIAGONAL = 1e-9  # what inverting a matrix in floating point may leave there
_LARGEST = 100.0  # in SI a scale is about 1


def to_kalibr(model: ImuModel) -> dict[str, Any]:
    """Return the keys of Kalibr's scale-misalignment model."""
    return {
        "model": "scale-misalignment",
        "accelerometers": {"M": model.M_a.tolist()},
        "gyroscopes": {"M": model.M_g.tolist(), "A": model.A_g.tolist(), "C_gyro_i": model.C_g_i.tolist()},
    }


def to_openvins(model: ImuModel) -> dict[str, Any]:
    """Return the keys of OpenVINS' model `kalibr`: lower triangular T, the accelerometer in the IMU's frame."""
    return {
        "model": "kalibr",
        "Tw": model.M_g.tolist(),
        "R_IMUtoGYRO": model.C_g_i.tolist(),
        "Ta": model.M_a.tolist(),
        "R_IMUtoACC": np.eye(3).tolist(),
        "Tg": (model.A_g @ model.C_g_i).tolist(),
    }


def exportable(name: str, imu: Imu, tool: str, notes: list[str]) -> ImuModel | None:
    """Return the model without its biases; None, with a note where counts are why, where there is none for `tool`."""
    if imu.intrinsics is None:
        return None
    if imu.intrinsics.unit != "SI":
        notes.append(f"{name}: intrinsics in raw counts are not written, {tool} takes SI; feed it samples corrected by calibkit.models.imu")
        return None
    values = dict.fromkeys(imu.intrinsics.parameters, 0.0)
    for key, estimate in imu.intrinsics.parameters.items():
        if not key.startswith("b_"):
            foreign.refuse_unobservable(f"imus.{name}.intrinsics.parameters.{key}", estimate.status)
            values[key] = float(estimate.value or 0.0)
    if any(estimate.value for key, estimate in imu.intrinsics.parameters.items() if key.startswith("b_")):
        notes.append(f"{name}: its biases are not written, {tool}'s file has no place for them; {tool} estimates its own")
    return ImuModel.of(values)


def read(document: Document, name: str, keys: Keys, warnings: list[str]) -> ImuIntrinsics | None:
    """Return one IMU's intrinsics in either tool's keys; None where there are none, or only the identities that stand for none."""
    for part, known in _KALIBR.items():
        node = foreign.value_at(document, (*keys, part))
        others = [f"{part}.{one_line(key, 40)}" for key in node if key not in known] if isinstance(node, dict) else []
        if others:
            warnings.append(f"{name}: {', '.join(others)} has no place in the rig file; not taken over")
    used = [dialect for dialect in _DIALECTS if any(not _neutral(document, (*keys, *path)) for path in dialect.paths)]
    if not used:
        return None
    if len(used) > 1:
        raise document.error(keys, "holds intrinsics in Kalibr's keys and in OpenVINS'; remove one of them")
    values = used[0].read(document, keys, warnings).values()
    if not any(values[key] for key in SENSITIVITY_PARAMETERS):
        values = {key: value for key, value in values.items() if key not in SENSITIVITY_PARAMETERS}
    gravity = used[0].gravity
    text = f"{used[0].tool}'s file holds neither biases nor gravity: taken as 0 and {gravity} m/s^2"
    warnings.append(f"{name}: {text}")
    return ImuIntrinsics(
        equation=EQUATION,
        correction=CORRECTION,
        gravity=gravity,
        parameters={key: Estimate(value=value, unit=UNITS["SI"][key[:3]]) for key, value in values.items()},
        reasons=[text],
    )


def _neutral(document: Document, keys: Keys) -> bool:
    """Say whether a matrix is absent or changes nothing: a sensitivity of zeros, any other an identity."""
    value = foreign.value_at(document, keys)
    if not isinstance(value, list):
        return value is None
    flat = [item for row in value for item in (row if isinstance(row, list) else [row])]
    nothing: list[float] = (np.zeros(9) if keys[-1] in ("A", "Tg") else np.eye(3).ravel()).tolist()
    return flat == nothing


def _from_kalibr(document: Document, keys: Keys, warnings: list[str]) -> ImuModel:
    gyroscopes = (*keys, "gyroscopes")
    return ImuModel(
        M_a=_lower(document, (*keys, "accelerometers", "M")),
        M_g=_lower(document, (*gyroscopes, "M")),
        A_g=_matrix(document, (*gyroscopes, "A")),
        C_g_i=_rotation(document, (*gyroscopes, "C_gyro_i"), warnings),
    )


def _from_openvins(document: Document, keys: Keys, warnings: list[str]) -> ImuModel:
    remedy = f"but our IMU frame is the accelerometer's; write the file in OpenVINS' model kalibr, or remove {', '.join(_OPENVINS)}"
    if foreign.text_at(document, (*keys, "model")) == "rpng":  # upper triangular, in the gyroscope's frame
        raise document.error((*keys, "model"), f"is rpng, {remedy}")
    if not _neutral(document, (*keys, "R_IMUtoACC")):
        raise document.error((*keys, "R_IMUtoACC"), f"is not identity, {remedy}")
    R_gyro_imu = _rotation(document, (*keys, "R_IMUtoGYRO"), warnings)
    return ImuModel(
        M_a=_lower(document, (*keys, "Ta")),
        M_g=_lower(document, (*keys, "Tw")),
        A_g=_matrix(document, (*keys, "Tg")) @ R_gyro_imu.T,
        C_g_i=R_gyro_imu,
    )


def _matrix(document: Document, keys: Keys) -> Array:
    M = foreign.numbers_at(document, keys, (9,)).reshape(3, 3)
    if np.abs(M).max() > _LARGEST:
        raise document.error(keys, f"has an entry beyond {_LARGEST:g}, which no IMU in SI has; check its numbers")
    return M


def _lower(document: Document, keys: Keys) -> Array:
    M = _matrix(document, keys)
    if np.abs(np.triu(M, 1)).max() > _ABOVE_DIAGONAL:
        raise document.error(keys, "is not lower triangular; write it as Kalibr's scale-misalignment model has it")
    if np.diag(M).min() <= 0:
        raise document.error(keys, "has a scale that is not positive on its diagonal; check its numbers")
    return np.tril(M)


def _rotation(document: Document, keys: Keys, warnings: list[str]) -> Array:
    return foreign.rotation_of(document, keys, _matrix(document, keys), "its matrix", warnings)


@dataclass(frozen=True)
class _Dialect:
    tool: str
    paths: tuple[tuple[str, ...], ...]
    read: Callable[[Document, Keys, list[str]], ImuModel]
    gravity: float  # m/s^2 that the scale hangs on, as far as the tool lets one know


_DIALECTS = (
    _Dialect("Kalibr", tuple((part, key) for part, names in _KALIBR.items() for key in names), _from_kalibr, _KALIBR_GRAVITY),
    _Dialect("OpenVINS", tuple((key,) for key in _OPENVINS), _from_openvins, STANDARD_GRAVITY.value),
)
