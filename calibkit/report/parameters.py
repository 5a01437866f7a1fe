"""Every number of a rig as one table: value, sigma, status, whatever part of the rig it belongs to."""

from collections.abc import Iterator
from dataclasses import dataclass
from math import degrees, floor, log10

import numpy as np

from calibkit.data.rig import TRANSFORM_PARAMETERS, Camera, Estimate, Imu, ImuIntrinsics, Noise, Rig, TimeOffset, Transform
from calibkit.data.transforms import TANGENT, carry_parameters
from calibkit.data.verdict import Reason, Status, Verdict, worst
from calibkit.geometry import so3
from calibkit.models.noise import LETTERS
from calibkit.report.imu_units import for_people

_SIGMA_NOTE = "sigma is one standard deviation, plain takes residuals as independent; factor is their ratio: it covers what residuals share"
_CAMERA_NOTE = "neighbouring frames have errors in common, and the detector always errs alike at one place of the image"


def sigma_note(rig: Rig) -> str:
    """Return what the columns sigma, plain and factor mean."""
    return f"{_SIGMA_NOTE}{f' ({_CAMERA_NOTE})' if rig.cameras else ''}."


@dataclass(frozen=True)
class Row:
    """One parameter of one part of the rig (cam0, T_cam1_cam0, ...)."""

    part: str
    name: str
    value: float | None
    sigma: float | None
    sigma_plain: float | None
    unit: str
    status: Status
    note: str = ""

    @property
    def factor(self) -> float | None:
        """How much larger the corrected sigma is than the one for white residuals."""
        return self.sigma / self.sigma_plain if self.sigma is not None and self.sigma_plain else None

    @property
    def value_text(self) -> str:
        """The value to two digits of its sigma, else as it was given."""
        if self.value is None:
            return "not observable"
        return f"{self.value:.9g}" if not self.sigma else f"{self.value:.{decimals(self.sigma)}f}"

    @property
    def sigma_text(self) -> str:
        return "" if self.sigma is None else number(self.sigma)

    @property
    def sigma_plain_text(self) -> str:
        return "" if self.sigma_plain is None else number(self.sigma_plain)

    @property
    def factor_text(self) -> str:
        return "" if self.factor is None else f"{self.factor:.2f}"


def decimals(sigma: float) -> int:
    """Return how many decimals show two digits of a sigma."""
    return min(max(0, 1 - floor(log10(sigma))), 12)


def number(value: float) -> str:
    """Return a sigma in two digits, plain where that is short."""
    return f"{value:.{decimals(value)}f}" if 1e-4 <= value < 1e4 else f"{value:.1e}" if value else "0"


def parts(rig: Rig) -> list[tuple[str, Camera | Transform | TimeOffset | Imu | ImuIntrinsics]]:
    """Return what of the rig carries a verdict, with its name; an IMU's noise and its intrinsics have one each."""
    intrinsics = {name: imu.intrinsics for name, imu in rig.imus.items() if imu.intrinsics is not None}
    return [pair for entries in (rig.cameras, rig.transforms, rig.time_offsets, rig.imus, intrinsics) for pair in entries.items()]


def rows(rig: Rig) -> list[Row]:
    """Return all parameters of the rig: cameras, transforms, time offsets, IMUs."""
    out = []
    for name, camera in rig.cameras.items():
        out += [_row(name, key, estimate) for key, estimate in camera.parameters.items()]
        out += [_row(name, "line_delay", camera.line_delay)] if camera.line_delay is not None else []
    for name, transform in rig.transforms.items():
        out += _transform_rows(name, transform)
    out += [_row(name, "offset", entry.offset, entry.equation) for name, entry in rig.time_offsets.items()]
    for name, imu in rig.imus.items():
        for key in Imu.model_fields:
            estimate = getattr(imu, key)
            if isinstance(estimate, Estimate):
                out.append(_row(name, key, estimate))
        for axis, noise in imu.noise.items():
            out += [_noise_row(name, axis, key, getattr(noise, key)) for key in Noise.model_fields if getattr(noise, key) is not None]
        if imu.intrinsics is not None:
            out += [_row(name, key, estimate) for key, estimate in imu.intrinsics.parameters.items()]
    return out


def _noise_row(imu: str, axis: str, coefficient: str, estimate: Estimate) -> Row:
    note = "" if estimate.value is None else f"{LETTERS[coefficient]}: {for_people(axis[:-2], coefficient, estimate.value)}"
    return _row(imu, f"{axis} {coefficient}", estimate, note)


def _row(part: str, name: str, estimate: Estimate, note: str = "") -> Row:
    return Row(part, name, estimate.value, estimate.sigma, estimate.sigma_plain, estimate.unit, estimate.status, note)


def _transform_rows(name: str, transform: Transform) -> Iterator[Row]:
    """Yield p_a_b in a's axes and the rotation vector r = log R, each with its own status where it has one."""
    T = np.array(transform.matrix)
    values = [*T[:3, 3], *so3.log(T[:3, :3])]
    sigma: list[float | None] = [None] * 6
    if transform.covariance is not None and transform.covariance.order == list(TANGENT):
        carry = carry_parameters(T)
        variance = np.diag(carry @ np.array(transform.covariance.matrix) @ carry.T)
        sigma = [float(v) for v in np.sqrt(np.maximum(variance, 0))]
    for i, key in enumerate(TRANSFORM_PARAMETERS):
        status = transform.statuses.get(key, transform.status)
        known, turn = status is not Status.NOT_OBSERVABLE, i >= 3
        value, size = (float(values[i]), sigma[i]) if known else (None, None)
        note = f"{degrees(value):.4f} deg" if turn and value is not None else ""
        yield Row(name, key, value, size, None, "rad" if turn else "m", status, note)


def rig_reasons(rig: Rig, known: tuple[Reason, ...]) -> tuple[Reason, ...]:
    """Return what the rig file says against its own parts beyond the `known` reasons: stored verdicts, and parameters not observable."""
    heard = {reason.text for reason in known}
    out = []
    for part, entry in parts(rig):
        if entry.verdict is None:
            continue
        texts = [text for text in entry.reasons if text not in heard]
        out += [Reason(entry.verdict, f"{part}: {text}") for text in texts if f"{part}: {text}" not in heard]
        if not entry.reasons and entry.verdict is not Verdict.PASS and worst(known) is Verdict.PASS:
            out.append(Reason(entry.verdict, f"{part}: its stage judged it {entry.verdict.value}"))
    gone: dict[str, list[str]] = {}
    for row in rows(rig):
        whole = row.part in rig.transforms or row.part in rig.time_offsets  # reasons name directions, or the one parameter there is
        said = any("not observable" in text and text.startswith(f"{row.part}:") and (whole or row.name in text) for text in heard)
        if row.status is Status.NOT_OBSERVABLE and not said:
            gone.setdefault(row.part, []).append(row.name)
    out += [Reason(Verdict.FAIL, f"{part}: not observable in this recording: {', '.join(names)}") for part, names in gone.items()]
    return tuple(out)
