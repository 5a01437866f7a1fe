"""From an IMU's fitted noise to a result: what the rig file keeps of it, what speaks against it, and the curves of its report."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from calibkit.data.plural import counted
from calibkit.data.result import ResidualSet, Result
from calibkit.data.rig import Estimate, Imu, ImuAxis, Noise, Rig
from calibkit.data.verdict import Reason, Status, Verdict, worst
from calibkit.estimation.allan import Deviation
from calibkit.estimation.findings import Finding
from calibkit.estimation.imu_noise import AxisNoise, NoiseTerm, model_deviation

AXES: dict[str, tuple[ImuAxis, ImuAxis, ImuAxis]] = {
    "gyro": ("gyro_x", "gyro_y", "gyro_z"),
    "accel": ("accel_x", "accel_y", "accel_z"),
}
_ORDER = (*AXES["gyro"], *AXES["accel"])
UNITS = {
    "gyro": {"quantisation": "rad", "white": "rad/s/sqrt(Hz)", "flicker": "rad/s", "walk": "rad/s^2/sqrt(Hz)", "ramp": "rad/s^2"},
    "accel": {"quantisation": "m/s", "white": "m/s^2/sqrt(Hz)", "flicker": "m/s^2", "walk": "m/s^3/sqrt(Hz)", "ramp": "m/s^3"},
}
_LETTERS = {"white": "N", "flicker": "B", "walk": "K", "quantisation": "Q", "ramp": "R"}
_DENSITIES = {"white": "noise_density", "walk": "random_walk"}
_HARMLESS = ("quantisation", "short_gap")  # kinds of findings that are only told
_BADLY = 0.1  # relative misfit of the noise model worth a CHECK
_LOST = 0.1  # share of the recording that is cut out, worth a CHECK


@dataclass(frozen=True)
class Rest:
    """All that a recording of an IMU at rest gave."""

    name: str
    topic: str
    rate: float
    axes: list[ImuAxis]
    noise: dict[ImuAxis, AxisNoise]
    curve: Deviation
    findings: list[Finding]
    hours: list[float]  # of each piece that was used
    total_hours: float


def noise_result(found: Rest, before: Imu, cut: bool) -> Result:
    """Return the result of stage `allan`; `before` is what a rig file already says of this IMU, `cut` whether findings were cut out."""
    reasons = [
        *_about_recording(found, cut),
        *_about_spectra(found),
        *_about_weak(found),
        *(reason for axis in found.axes for reason in _about_axis(found, axis)),
    ]
    noise = {axis: _as_noise(axis, found.noise[axis]) for axis in found.axes}
    gone = [
        f"{found.name}.{axis} {key}"
        for axis in found.axes
        for key in ("white", "flicker", "walk")
        if getattr(found.noise[axis], key).value is None
    ]
    verdict = Verdict.FAIL if gone else worst(reasons)
    told = [reason.text.removeprefix(f"{found.name}: ") for reason in reasons if reason.verdict is not Verdict.PASS]
    imu = before.model_copy(
        update={
            "topic": before.topic or found.topic,
            "rate_hz": found.rate,
            **_densities(found.axes, noise),
            "noise": {**before.noise, **noise},
            "verdict": verdict,
            "reasons": told,
        }
    )
    return Result(
        stage="allan",
        rig=Rig(imus={found.name: imu}),
        reasons=tuple(reasons),
        residuals=(_residuals(found),),
        facts={
            "lines": _lines(found),
            "imu": found.name,
            "pieces_h": found.hours,
            "axes": {axis: _facts(found.noise[axis]) for axis in found.axes},
        },
        not_observable=tuple(gone),
    )


def _about_recording(found: Rest, cut: bool) -> list[Reason]:
    """Return what screening found: what was cut out is told, what stayed in is worth a look."""
    total = found.total_hours
    lost = 1 - sum(found.hours) / total
    out = []
    for finding in found.findings:
        if finding.kind == "frozen":  # said of the axis
            continue
        gone = cut and finding.cut
        mild = gone or finding.kind in _HARMLESS
        where = (
            "" if finding.t_end_s - finding.t_start_s > 0.9 * 3600 * total else f" (at {finding.t_start_s:.1f} to {finding.t_end_s:.1f} s)"
        )
        out.append(Reason(Verdict.PASS if mild else Verdict.CHECK, f"{found.name}: {finding.text}{where}{'; cut out' if gone else ''}"))
    if lost > _LOST:
        out.append(Reason(Verdict.CHECK, f"{found.name}: {lost:.0%} of the recording had to be cut out: record it anew, undisturbed"))
    return out


def _about_spectra(found: Rest) -> list[Reason]:
    """Return what the spectra of a sensor's axes hold beside noise: lines, and a filter beyond which the noise is none of the model's."""
    out = []
    for sensor, axes in AXES.items():
        features = [(axis, feature) for axis in axes if axis in found.noise for feature in found.noise[axis].features]
        lines = sorted((np.sqrt(f.f_low * f.f_high), f.amplitude, axis) for axis, f in features if f.kind == "line")
        if lines:
            hz, size, axis = max(lines, key=lambda line: line[1])
            others = ", ".join(dict.fromkeys(f"{line[0]:.2g}" for line in lines))
            text = f"periodic at {others} Hz, the largest {size:.2g} {UNITS[sensor]['flicker']} at {hz:.3g} Hz on {axis}"
            out.append(Reason(Verdict.CHECK, f"{found.name}: {sensor}: {text}: vibration or interference? Left out of N, B and K"))
        for kind, verdict, what in (
            ("filter", Verdict.PASS, "a low-pass filter acts"),
            ("excess", Verdict.CHECK, "the spectrum rises above what noise terms describe"),
        ):
            cuts = [(f.f_low, f.tau) for _, f in features if f.kind == kind]
            if cuts:
                text = f"{what} beyond {min(cuts)[0]:.3g} Hz: N is that of tau > {max(tau for _, tau in cuts):.2g} s"
                out.append(Reason(verdict, f"{found.name}: {sensor}: {text}"))
    return out


def _about_weak(found: Rest) -> list[Reason]:
    """Return which coefficients are known to a factor only, with their 95 % intervals."""
    out = []
    for sensor, key in product(AXES, _LETTERS):
        terms = [(axis, getattr(found.noise[axis], key)) for axis in AXES[sensor] if axis in found.noise]
        weak = [f"{axis[-1]} {t.lower95:.2g} to {t.upper95:.2g}" for axis, t in terms if t is not None and t.status is Status.WEAK]
        if weak:
            text = f"{key} ({_LETTERS[key]}) is weak: 95 % intervals {', '.join(weak)} {UNITS[sensor][key]}; a longer recording tells more"
            out.append(Reason(Verdict.CHECK, f"{found.name}: {sensor} {text}"))
    return out


def _about_axis(found: Rest, axis: ImuAxis) -> list[Reason]:
    """Return what speaks against the noise model of one axis, and which coefficients the recording does not tell."""
    noise, name = found.noise[axis], f"{found.name}: {axis}"
    if noise.reasons:  # a stuck axis tells nothing else
        return [Reason(Verdict.FAIL, f"{name} white, {axis} flicker and {axis} walk are not observable: {'; '.join(noise.reasons)}")]
    out: list[Reason] = []
    if noise.markov is not None:
        size = f"{noise.markov.sigma:.2g} {UNITS[axis[:-2]]['flicker']}"
        text = f"correlated noise of {size} over {noise.markov.time_s:.2g} s beside N, B and K"
        out.append(
            Reason(
                Verdict.CHECK,
                f"{name}: {text}: a bump in the Allan deviation near tau {1.9 * noise.markov.time_s:.2g} s, kept out of N, B and K",
            )
        )
    if noise.discrepancy > _BADLY:
        bad = max((m for m in noise.misfit if m.used), key=lambda m: abs(m.z), default=None)
        where = "" if bad is None else f", most at tau {bad.tau:.2g} s"
        out.append(Reason(Verdict.CHECK, f"{name}: N, B and K describe its noise to {noise.discrepancy:.0%} only{where}: look at the plot"))
    for key in ("white", "flicker", "walk"):
        term: NoiseTerm = getattr(noise, key)
        if term.value is None:
            out.append(
                Reason(
                    Verdict.FAIL,
                    f"{found.name}: {axis} {key} ({_LETTERS[key]}) is not observable in this recording{_needed(axis, key, term)}",
                )
            )
    return out


def _duration(hours: float) -> str:
    return f"{hours:.3g} h" if hours >= 1 else f"{hours * 60:.3g} min"


def _needed(axis: ImuAxis, key: str, term: NoiseTerm) -> str:
    unit = UNITS[axis[:-2]][key]
    at_most = f": at most {term.upper95:.2g} {unit} (95 %)" if term.upper95 > 0 else ""
    if term.hours_needed is None or term.resolves is None:
        return at_most
    if not np.isfinite(term.hours_needed):
        return f"{at_most}; no recording of a sensible length would tell {term.resolves:.2g} from none"
    return f"{at_most}; longer than {_duration(term.hours_needed)} needed to tell {term.resolves:.2g} from none"


def _as_noise(axis: ImuAxis, noise: AxisNoise) -> Noise:
    units = UNITS[axis[:-2]]

    def estimate(key: str) -> Estimate | None:
        term: NoiseTerm | None = getattr(noise, key)
        return None if term is None else Estimate(value=term.value, unit=units[key], sigma=term.sigma, status=term.status)

    return Noise.model_validate({key: estimate(key) for key in Noise.model_fields})


def _densities(axes: Sequence[ImuAxis], noise: dict[ImuAxis, Noise]) -> dict[str, Estimate]:
    """Return Kalibr's four values, one for the three axes: their rms, of the axes that have one."""
    out = {}
    for sensor, (key, name) in product(AXES, _DENSITIES.items()):
        all_axes = [getattr(noise[axis], key) for axis in axes if axis in AXES[sensor]]
        known = [estimate for estimate in all_axes if estimate.value is not None]
        unit = UNITS[sensor][key]
        if not all_axes:
            continue
        if not known:
            out[f"{sensor}_{name}"] = Estimate(value=None, unit=unit, status=Status.NOT_OBSERVABLE)
            continue
        values, sigmas = (np.array([getattr(e, field) or 0.0 for e in known]) for field in ("value", "sigma"))
        rms = float(np.sqrt(np.mean(values**2)))
        sure = len(known) == len(all_axes) and all(e.status is Status.DETERMINED for e in known)
        sigma = float(np.linalg.norm(values * sigmas) / (len(known) * rms))
        out[f"{sensor}_{name}"] = Estimate(value=rms, unit=unit, sigma=sigma, status=Status.DETERMINED if sure else Status.WEAK)
    return out


def _residuals(found: Rest) -> ResidualSet:
    """Return ln(measured / model) at every averaging time and axis, with the curves that a report draws."""
    curve, k, c = found.curve, len(found.curve.tau), len(found.axes)
    fitted = np.stack([model_deviation(found.noise[axis], curve.tau) for axis in found.axes], axis=1)
    safe = np.where((curve.dev > 0) & (fitted > 0), curve.dev / np.where(fitted > 0, fitted, 1), 1)
    sigma = np.where(curve.dev > 0, (curve.upper - curve.lower) / (2 * 1.96 * np.where(curve.dev > 0, curve.dev, 1)), 1)
    columns = {
        "tau": np.repeat(curve.tau, c),
        "deviation": curve.dev.ravel(),
        "fitted": fitted.ravel(),
        "low": curve.lower.ravel(),
        "high": curve.upper.ravel(),
    }
    index = np.array([_ORDER.index(axis) for axis in found.axes], np.int32)
    return ResidualSet(
        found.name, "ln", np.zeros(k * c, np.int64), np.log(safe).reshape(-1, 1), sigma.ravel(), {"axis": np.tile(index, k), **columns}
    )


def _lines(found: Rest) -> list[str]:
    whole = sum(found.hours)
    in_pieces = "" if len(found.hours) == 1 else f" in {counted(len(found.hours), 'piece')}"
    return [f"{found.name}: {found.topic}, {found.rate:.4g} Hz; {_duration(whole)} at rest{in_pieces} used"]


def _facts(noise: AxisNoise) -> dict[str, object]:
    terms = {key: getattr(noise, key) for key in _LETTERS}
    return {
        **{
            key: {"lower95": term.lower95, "upper95": term.upper95, "hours_needed": _finite(term.hours_needed)}
            for key, term in terms.items()
            if term is not None
        },
        "goodness": noise.goodness,
        "discrepancy": noise.discrepancy,
        "gauss_markov": None if noise.markov is None else {"sigma": noise.markov.sigma, "time_s": noise.markov.time_s},
    }


def _finite(value: float | None) -> float | None:
    return value if value is not None and np.isfinite(value) else None
