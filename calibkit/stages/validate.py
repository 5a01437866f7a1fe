"""`calibkit validate`: a calibration on a recording that it was not made from: residuals, repeatability, plausibility, speed."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibkit.data.progress import Progress, silent
from calibkit.data.rig import Rig
from calibkit.errors import BadInputError, one_line
from calibkit.estimation.joint_checks import Checks, Halves, check_joint
from calibkit.estimation.joint_suspects import left_by_sensor
from calibkit.estimation.rig_values import distance
from calibkit.estimation.speed_sweep import Sweep, sweep
from calibkit.geometry.spline import Steps, basis, turning
from calibkit.report.columns import columns
from calibkit.stages.camera_imu import has_imu
from calibkit.stages.diagnose import Diagnosed, Examined, Options, examine, sensors_of

APART = 4.5  # sigmas of halves, of gravity and of the board's size
_SCALE_OFF = 0.004  # of the board's size
_GROWS = 5.0  # sigmas of a slope with the rate
_MUCH = 1.5  # rms at the fastest turns over that at rest


@dataclass(frozen=True)
class Line:
    """One question with its answer."""

    name: str
    text: str
    good: bool


@dataclass(frozen=True)
class Validated:
    """What was found."""

    lines: tuple[Line, ...]
    sweeps: dict[str, tuple[Sweep, str]]  # by sensor, with the unit of its residuals
    halves: Halves | None
    examined: Examined

    @property
    def diagnosed(self) -> Diagnosed:
        return self.examined.diagnosed

    @property
    def warnings(self) -> tuple[str, ...]:
        return self.diagnosed.warnings

    @property
    def verdict(self) -> str:
        """Return the answer in one line."""
        if self.diagnosed.exit_code:
            return self.diagnosed.verdict
        bad = [line for line in self.lines if not line.good]
        return f"FAIL: {bad[0].name}: {bad[0].text}" if bad else self.diagnosed.verdict

    @property
    def exit_code(self) -> int:
        """SPEC section 6: 1 on FAIL."""
        return 1 if self.verdict.startswith("FAIL") else 0

    @property
    def text(self) -> str:
        """Return what is said on the terminal."""
        out = [self.diagnosed.text.rsplit("\n\n", 1)[0], ""]
        if self.sweeps:
            header = [""] + [f"{rate:.2g}" for rate in next(iter(self.sweeps.values()))[0].rate] + ["at rest", "growth"]
            table = [["rms by rad/s", *header[1:]]]
            for name, (found, unit) in self.sweeps.items():
                cells = [f"{rms:.3g}" for rms in found.rms]
                table.append(
                    [name, *cells, f"{found.at_rest:.3g} {unit}", f"{found.slope:.2g} +- {found.slope_sigma:.1g} {unit} per rad/s"]
                )
            out += [columns(table), ""]
        out += [f"  {'ok ' if line.good else 'BAD'} {line.name}: {line.text}" for line in self.lines]
        return "\n".join([*out, "", self.verdict])

    def as_json(self) -> dict[str, object]:
        """Return everything, for machines."""
        return {
            **self.diagnosed.as_json(),
            "schema": "calibkit-validation/1",
            "verdict": self.verdict.split(":")[0],
            "checks": [{"name": line.name, "text": line.text, "good": line.good} for line in self.lines],
            "speed": {
                name: {
                    "unit": unit,
                    "rate": found.rate.tolist(),
                    "rms": found.rms.tolist(),
                    "at_rest": found.at_rest,
                    "slope": found.slope,
                    "slope_sigma": found.slope_sigma,
                }
                for name, (found, unit) in self.sweeps.items()
            },
        }


@dataclass(frozen=True)
class Measured:
    """A distance between two sensors that somebody measured, m."""

    a: str
    b: str
    size: float
    sigma: float


def validate(
    sources: Sequence[Path],
    target: Path,
    rig: Rig,
    options: Options | None = None,
    progress: Progress = silent,
    distances: Sequence[Measured] = (),
) -> Validated:
    """Ask a rig file's calibration of cameras and IMU for what it says of a recording before a board that it was not made from.

    Errors as `stages.diagnose.examine` has them.
    """
    measured = tuple(_distance(rig, each) for each in distances)
    if not has_imu(sources, options or Options()):
        names = ", ".join(one_line(source.name) for source in sources)
        raise BadInputError(f"{names}: no IMU in it: validate asks cameras and an IMU together; calibkit diagnose tests cameras alone")
    found = examine(sources, target, rig, options, progress)
    checks = check_joint(found.joint.fit)
    sweeps = _sweeps(found)
    return Validated(_lines(found, checks, sweeps) + measured, sweeps, checks.halves, found)


def _distance(rig: Rig, told: Measured) -> Line:
    """Compare a measured distance with the rig file's."""
    name = f"{one_line(told.a)} to {one_line(told.b)}"
    found = distance(rig, told.a, told.b)
    if found is None:
        raise BadInputError(f"--distance {name}: no transform of the rig file joins the two: name sensors that it has")
    size, sigma = found
    good = abs(size - told.size) < APART * float(np.hypot(sigma, told.sigma))
    text = f"{1e3 * size:.2f} +- {1e3 * sigma:.2g} mm by the rig file, {1e3 * told.size:.2f} +- {1e3 * told.sigma:.2g} mm as measured"
    return Line(f"distance, {name}", text, good)


def _sweeps(found: Examined) -> dict[str, tuple[Sweep, str]]:
    problem, x = found.joint.fit.problem, found.held
    out = {}
    for kind, (t, left) in left_by_sensor(problem, x).items():
        i, u = problem.knots.locate(t)
        at = turning(x.R, Steps.of(x.R), i, basis(problem.knots, u), basis(problem.knots, u, 1), jacobians=False)
        made = sweep(np.linalg.norm(at.omega, axis=1), left)
        if made is not None:
            name, unit = sensors_of(found.read)[kind]
            out[name] = made, unit
    return out


def _lines(found: Examined, checks: Checks, sweeps: dict[str, tuple[Sweep, str]]) -> tuple[Line, ...]:
    fit, lines = found.joint.fit, []
    if checks.halves is not None:
        worst = float(np.abs(checks.halves.z).max())
        lines.append(Line("repeatability", f"each half by itself gives the same within {worst:.1f} sigma", worst < APART))
    size, prior = float(np.linalg.norm(fit.x.gravity)), fit.problem.gravity
    lines.append(
        Line("gravity", f"{size:.4f} m/s^2 of {prior.size:.4f} +- {prior.sigma:.2g}", abs(size - prior.size) < APART * prior.sigma)
    )
    scale, sigma = checks.board_scale
    good = abs(scale - 1) < max(_SCALE_OFF, APART * sigma)
    lines.append(Line("board", f"{scale:.4f} +- {sigma:.2g} times the size that its file says, by the accelerometer", good))
    for name, (each, unit) in sweeps.items():
        fast = float(each.rms[-1] / max(each.at_rest, 1e-300))
        grows = each.slope > _GROWS * each.slope_sigma and fast > _MUCH
        lines.append(
            Line(f"speed, {name}", f"{each.rms[-1]:.3g} {unit} at {each.rate[-1]:.2g} rad/s, {each.at_rest:.3g} at rest", not grows)
        )
    return tuple(lines)
