"""What speaks for and against the noise of an IMU at rest: the recording's faults, what is in its spectra, what it does not tell."""

from dataclasses import dataclass
from itertools import product

import numpy as np

from calibkit.data.rig import ImuAxis
from calibkit.data.verdict import Reason, Status, Verdict
from calibkit.estimation.allan import Deviation
from calibkit.estimation.findings import Finding
from calibkit.estimation.imu_noise import AxisNoise, NoiseTerm
from calibkit.models.noise import LETTERS, UNITS

ALWAYS = ("white", "flicker", "walk")  # the terms that every axis has; the others show or do not
DENSITIES = {"white": "noise_density", "walk": "random_walk"}  # Kalibr's name of the one value for a sensor's three axes
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


def of_sensor(found: Rest, sensor: str) -> list[ImuAxis]:
    """Return the axes of a sensor ("gyro" or "accel") that the recording has."""
    return [axis for axis in found.axes if axis.startswith(sensor)]


def reasons_for(found: Rest, cut: bool) -> list[Reason]:
    """Return the reasons of the verdict; `cut` says whether findings were cut out."""
    by_axis = [reason for axis in found.axes for reason in _about_axis(found, axis)]
    return [*_about_recording(found, cut), *_about_spectra(found), *_about_weak(found), *_about_densities(found), *by_axis]


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
    for sensor in UNITS:
        features = [(axis, feature) for axis in of_sensor(found, sensor) for feature in found.noise[axis].features]
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
    for sensor, key in product(UNITS, LETTERS):
        terms = [(axis, getattr(found.noise[axis], key)) for axis in of_sensor(found, sensor)]
        weak = [f"{axis[-1]} {t.lower95:.2g} to {t.upper95:.2g}" for axis, t in terms if t is not None and t.status is Status.WEAK]
        if weak:
            text = f"{key} ({LETTERS[key]}) is weak: 95 % intervals {', '.join(weak)} {UNITS[sensor][key]}; a longer recording tells more"
            out.append(Reason(Verdict.CHECK, f"{found.name}: {sensor} {text}"))
    return out


def _about_densities(found: Rest) -> list[Reason]:
    """Return which of Kalibr's values rest on some of a sensor's axes only."""
    out = []
    for sensor, (key, name) in product(UNITS, DENSITIES.items()):
        axes = of_sensor(found, sensor)
        known = [axis[-1] for axis in axes if getattr(found.noise[axis], key).value is not None]
        if 0 < len(known) < len(axes):
            unknown = " and ".join(axis[-1] for axis in axes if axis[-1] not in known)
            text = f"rests on {' and '.join(known)} only: the recording does not tell {LETTERS[key]} of {unknown}"
            out.append(Reason(Verdict.CHECK, f"{found.name}: {sensor}_{name} {text}"))
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
    for key in ALWAYS:
        term: NoiseTerm = getattr(noise, key)
        if term.value is None:
            out.append(
                Reason(
                    Verdict.FAIL,
                    f"{found.name}: {axis} {key} ({LETTERS[key]}) is not observable in this recording{_needed(axis, key, term)}",
                )
            )
    return out


def duration(hours: float) -> str:
    return f"{hours:.3g} h" if hours >= 1 else f"{hours * 60:.3g} min"


def _needed(axis: ImuAxis, key: str, term: NoiseTerm) -> str:
    unit = UNITS[axis[:-2]][key]
    at_most = f": at most {term.upper95:.2g} {unit} (95 %)" if term.upper95 > 0 else ""
    if term.hours_needed is None or term.resolves is None:
        return at_most
    if not np.isfinite(term.hours_needed):
        return f"{at_most}; no recording of a sensible length would tell {term.resolves:.2g} from none"
    return f"{at_most}; longer than {duration(term.hours_needed)} needed to tell {term.resolves:.2g} from none"
