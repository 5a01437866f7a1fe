"""What a hand-eye calibration is worth, in words: what the poses leave open, what does not fit, and what to do about it."""

from dataclasses import dataclass

from calibkit.data.plural import counted
from calibkit.data.verdict import Reason, Status, Verdict
from calibkit.errors import one_line
from calibkit.estimation.hand_eye import HandEyeFit
from calibkit.estimation.hand_eye_doubts import Suspect
from calibkit.estimation.hand_eye_known import parameter_statuses
from calibkit.estimation.hand_eye_lag import stretch
from calibkit.estimation.hand_eye_open import Open

GOOD_POSES = 10
_MANY_WRONG = 0.4  # of the poses: who is right is then a matter of opinion
_FEW_ENOUGH = 200  # poses, to name those that are wrong
_NAMED = 4
_ANCHORS = ("park", "horaud", "daniilidis")  # that fail together only where something is wrong


@dataclass(frozen=True)
class Doubts:
    """What trying other hypotheses has shown."""

    better: str = ""  # the setup, or direction of the poses, that fits far better than the one asked for
    times: float = 1.0  # by how much
    length_ratio: float | None = None
    step: str = ""  # the files are out of step, in words


def judge_hand_eye(name: str, fit: HandEyeFit, wrong: tuple[Suspect, ...], doubts: Doubts, method: str) -> tuple[Reason, ...]:
    """Return the reasons about `name` = T_1_2, PASS where there is nothing to say."""
    found = (*_doubtful(fit, doubts), *_open(fit), *_poses(fit, wrong), *_about(fit))
    reasons = [Reason(verdict, f"{name}: {text}") for verdict, text in found]
    chosen = fit.methods.get(method)
    if chosen is not None and chosen.failed:
        reasons.append(Reason(Verdict.FAIL, f"{name}: {method}, which was asked for, is far from the refined X: take --method refined"))
    return tuple(reasons)


def _open(fit: HandEyeFit) -> list[tuple[Verdict, str]]:
    advice = "; ".join(dict.fromkeys(a.text for a in fit.advice))
    hidden = [key for key, status in parameter_statuses(fit.X, fit.cov_X).items() if status is Status.NOT_OBSERVABLE]
    out = []
    for grade, verdict in (("not observable", Verdict.FAIL), ("weak", Verdict.CHECK)):
        those = [f"{o.text}, known to {o.sigma:.2g} {_unit(o)} only" if grade == "weak" else o.text for o in fit.open if o.grade == grade]
        if those:
            named = f" ({', '.join(hidden)})" if grade == "not observable" else ""
            out.append((verdict, f"{grade}: {'; '.join(those)}{named}" + (f": {advice}" if advice else "")))
    return out


def _unit(o: Open) -> str:
    return "mm" if o.text.startswith("p ") else "mrad"


def _doubtful(fit: HandEyeFit, doubts: Doubts) -> list[tuple[Verdict, str]]:
    out = []
    if doubts.better:
        out.append((Verdict.FAIL, f"{doubts.better} fits {doubts.times:.3g} times better"))
    if doubts.step:
        out.append((Verdict.FAIL, doubts.step))
    s = doubts.length_ratio
    by_little = stretch(fit.data, fit.refined, fit.trusted.inflation) if s is None and not out else None
    if by_little is not None:
        text = f"the second side's lengths times {by_little.factor:.4f} +- {by_little.sigma:.2g} fit better"
        out.append((Verdict.CHECK, f"{text}: measure the board's squares, and check the target file and the units of the poses"))
    if s is not None:
        unit = next((f": {text}" for factor, text in _UNITS if abs(s / factor - 1) < 0.05), "")
        text = f"the second side's lengths times {s:.4g} fit far better{unit or ': check the size of the board and the units of the poses'}"
        out.append((Verdict.FAIL, text))
    return out


_UNITS = (
    (1000.0, "the first side's poses are in mm, or the board's size is 1000 times too small: check --pose-unit and the target file"),
    (0.001, "the board's size is in mm, or the first side's poses are 1000 times too small: check the target file and --pose-unit"),
    (100.0, "the first side's poses are in cm: check --pose-unit"),
    (0.01, "the board's size is in cm: check the target file"),
)


def _poses(fit: HandEyeFit, wrong: tuple[Suspect, ...]) -> list[tuple[Verdict, str]]:
    n, kept = len(fit.kept), int(fit.kept.sum())
    out = []
    if kept < GOOD_POSES:
        text = f"{counted(kept, 'pose')} only: sigmas of so few are a guess; record {GOOD_POSES} or more, turned about two axes or more"
        out.append((Verdict.CHECK, text))
    if wrong and n <= _FEW_ENOUGH:  # of more their share is told, as a signal
        verdict = Verdict.FAIL if len(wrong) > _MANY_WRONG * n else Verdict.CHECK
        named = "; ".join(f"{one_line(s.label, 60)}{f' ({s.why})' if s.why else ''}" for s in wrong[:_NAMED])
        more = f"; and {len(wrong) - _NAMED} more" if len(wrong) > _NAMED else ""
        out.append((verdict, f"{len(wrong)} of {counted(n, 'pose')} do not fit the others and are left out: {named}{more}"))
    return out


def _about(fit: HandEyeFit) -> list[tuple[Verdict, str]]:
    out = []
    if fit.lag is not None:
        text = (
            f"residuals grow with speed as if the second side were {1e3 * fit.lag.dt:+.3g} +- {1e3 * fit.lag.sigma:.2g} ms off "
            f"({fit.lag.share:.0%} of what is left): take still poses, or find the lag with calibkit timeoffset"
        )
        out.append((Verdict.CHECK, text))
    anchors = [fit.methods[key] for key in _ANCHORS if key in fit.methods]
    if anchors and all(m.failed for m in anchors) and not any(o.grade == "not observable" for o in fit.open):
        text = "no closed form agrees with the refined X: look at the residuals before you believe either"
        out.append((Verdict.CHECK, text))
    return out
