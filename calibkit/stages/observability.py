"""`calibkit observability`: what a recording can and cannot determine of a camera-IMU rig, and the motion that it lacks."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from calibkit.data.progress import Progress, silent
from calibkit.data.result import Result
from calibkit.data.rig import Rig
from calibkit.data.verdict import Reason, Status
from calibkit.estimation.added_motion import DURATION_S, AddedMotion, in_words, missing_motions
from calibkit.estimation.joint import CameraInput
from calibkit.estimation.joint_checks import check_joint
from calibkit.estimation.joint_imu import NamedImu
from calibkit.estimation.joint_result import joint_result
from calibkit.estimation.joint_trust import joint_trust
from calibkit.report.columns import columns
from calibkit.report.parameters import Row, number, rows
from calibkit.stages.camera_imu import Sensors, read_camera_imu


@dataclass(frozen=True)
class Observability:
    """What a recording tells."""

    what: str
    rows: tuple[Row, ...]
    reasons: tuple[Reason, ...]  # what the recording leaves open, and what else speaks against it
    motions: tuple[AddedMotion, ...]
    warnings: tuple[str, ...]

    @property
    def exit_code(self) -> int:
        """SPEC section 6: 3 where something is not observable."""
        return 3 if any(row.status is Status.NOT_OBSERVABLE for row in self.rows) else 0

    @property
    def text(self) -> str:
        """Return what is said on the terminal."""
        table = [["parameter", "sigma", "unit", "status"]]
        for row in self.rows:
            sigma = "" if row.sigma is None else number(row.sigma)
            table.append([f"{row.part} {row.name}", sigma, row.unit, "" if row.status is None else row.status.value])
        out = [self.what, "", columns(table), ""]
        out += [f"  {reason.verdict.value} {reason.text}" for reason in self.reasons]
        out += ["", f"to determine T and dt, add, for {DURATION_S:.0f} s each:"] if self.motions else []
        out += [f"  {text}" for text in in_words(self.motions)]
        return "\n".join([*out, "", self.verdict])

    @property
    def verdict(self) -> str:
        """Return the answer in one line."""
        if self.exit_code:
            return "NOT OBSERVABLE: this motion does not tell all of the calibration"
        if any(row.status is Status.WEAK for row in self.rows):
            return "CHECK: this motion tells some of the calibration weakly"
        besides = "; what is marked above is not the motion's" if self.reasons else ""
        return f"PASS: this motion tells all of the calibration{besides}"

    def as_json(self) -> dict[str, object]:
        """Return everything, for machines."""
        return {
            "schema": "calibkit-observability/1",
            "verdict": self.verdict,
            "parameters": [
                {
                    "name": f"{row.part}.{row.name}",
                    "sigma": row.sigma,
                    "unit": row.unit,
                    "status": None if row.status is None else row.status.value,
                }
                for row in self.rows
            ],
            "reasons": [{"verdict": reason.verdict.value, "text": reason.text} for reason in self.reasons],
            "add": [{"motion": motion.text, "worst": motion.left} for motion in self.motions],
            "warnings": list(self.warnings),
        }


def observability(
    sources: Sequence[Path], target: Path, rig: Rig, sensors: Sensors | None = None, progress: Progress = silent
) -> Observability:
    """Say what a recording before a board would tell of T_cam_imu, dt and the lens: sigmas, what stays open, what motion would mend it.

    BadInputError names the file, topic or option that is wrong.
    """
    read = read_camera_imu(sources, target, rig, sensors or Sensors(), progress)
    cameras = [CameraInput(views, lens) for views, lens in zip(read.views, read.lenses, strict=True)]
    joint = read.fitted(cameras, read.settings(), progress)
    trust = joint_trust(joint.fit)
    result = joint_result(
        joint, trust, check_joint(joint.fit, halves=False), cameras, [NamedImu(read.imu.name, read.imu.input)], read.stamps
    )
    motions = missing_motions(joint.fit, trust)
    span = joint.fit.problem.imu.t[-1] - joint.fit.problem.imu.t[0]
    frames = ", ".join(f"{len(each.t)} frames of {name}" for each, name in zip(joint.fit.problem.cameras, read.names, strict=True))
    samples = f"{len(joint.fit.problem.imu.t)} samples of {read.imu.name} over {span:.4g} s"
    what = f"{frames}, {samples}; sigmas are those that calibkit joint would have"
    return Observability(what, tuple(_asked(result)), result.reasons, motions, tuple(read.warnings))


def _asked(result: Result) -> list[Row]:
    """Return the rows of what a joint estimate finds."""
    return [row for row in rows(result.rig) if row.status is not Status.GIVEN]
