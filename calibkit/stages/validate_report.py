"""The report of `calibkit validate`: that of the diagnosis, with the checks, the speed sweep and what the halves differ by."""

from functools import partial
from pathlib import Path

from calibkit.data.verdict import Reason, Verdict
from calibkit.stages.diagnose_report import chapters_of, reasons_of, summary_of
from calibkit.stages.report import write_pages
from calibkit.stages.validate import APART, Validated

_POSE = ("p x", "p y", "p z", "R x", "R y", "R z")  # of the IMU's axes, as steps on the right move it


def write_validation(found: Validated, folder: Path, command: str) -> None:
    """Write the report of `calibkit validate`."""
    from calibkit.report.diagnosis_figures import Speed, halves, sweeps
    from calibkit.report.figures import Chapter, Plate

    bad = [Reason(Verdict.FAIL, f"{line.name}: {line.text}") for line in found.lines if not line.good]
    reasons = reasons_of(found.diagnosed)
    if bad:
        reasons = [*bad, *(reason for reason in reasons if reason.verdict is not Verdict.PASS or reason is not reasons[0])]
    checks = [["check", "found", ""], *([line.name, line.text, "ok" if line.good else "BAD"] for line in found.lines)]
    summary = summary_of(found.examined, "validate", command, reasons, found.as_json(), [checks])
    plates = []
    if found.sweeps:
        speeds = [
            Speed(name, unit.replace("^2", "²"), each.rate, each.rms, each.at_rest, each.slope, each.slope_sigma)
            for name, (each, unit) in found.sweeps.items()
        ]
        caption = (
            "Bars of one height are good: dashed is the noise at rest, the curve what grows with the turns. Growth is stamps that jitter "
            "or are late, blur, a rolling shutter, or wrong axes or scale of the IMU."
        )
        plates.append(Plate("speed", "Residuals against the rate of turn", caption, 3.2, partial(sweeps, speeds=speeds)))
    if found.halves is not None:
        names = _names(found)
        caption = "Bars within the dashed lines are good: what the halves differ by is what their sigmas allow."
        draw = partial(halves, names=list(names.values()), z=found.halves.z[list(names)], limit=APART)
        plates.append(Plate("halves", "Each half by itself", caption, 1.0 + 0.2 * len(names), draw))
    chapters = [Chapter("Checks", tuple(plates))] if plates else []
    write_pages(summary, folder, chapters=[*chapters, *chapters_of(found.examined)])


def _names(found: Validated) -> dict[int, str]:
    """Return what stands where in the halves' difference: cameras' poses on the IMU, clocks and lenses."""
    problem, read = found.examined.joint.fit.problem, found.examined.read
    out: dict[int, str] = {}
    for c, camera in enumerate(read.names):
        imu, lens = read.imu.name, problem.cameras[c].views.model.parameter_names
        for block, names in (
            (f"T {c}", [f"T_{camera}_{imu} {key}" for key in _POSE]),
            (f"dt {c}", [f"dt_{imu}_{camera}"]),
            (f"lens {c}", [f"{camera} {key}" for key in lens]),
        ):
            out |= dict(enumerate(names, problem.border[block].start))
    return out
