"""What a hand-eye calibration is worth, in words: what the poses leave open, what does not fit, and what to do about it."""

from dataclasses import dataclass

import numpy as np

from calibkit.data.plural import counted, plain
from calibkit.data.verdict import Reason, Status, Verdict
from calibkit.errors import one_line
from calibkit.estimation.hand_eye import HandEyeFit
from calibkit.estimation.hand_eye_arm import Pattern, pattern_of
from calibkit.estimation.hand_eye_doubts import Suspect
from calibkit.estimation.hand_eye_known import parameter_statuses
from calibkit.estimation.hand_eye_lag import stretch
from calibkit.estimation.hand_eye_lengths import places_disagree, unit_of
from calibkit.estimation.hand_eye_open import Open

GOOD_POSES = 10
_MANY_WRONG = 0.4  # of the poses: who is right is then a matter of opinion
_FEW_ENOUGH = 200  # poses, to name those that are wrong
_NAMED = 4
_OFF, _OFF_SIGMAS = 3e-3, 10.0  # m or sigmas that lengths of another scale may move p by, with a CHECK
_NO_ARM = 0.02  # m rms
_NOT_EXACT = 3.0  # times the corners' noise
_COARSER = 1.5  # times the stated noise: 20 poses tell it to a fifth
_ANCHORS = ("park", "horaud", "daniilidis")  # that fail together only where something is wrong


@dataclass(frozen=True)
class Doubts:
    """What trying other hypotheses has shown."""

    better: str = ""  # the setup, or direction of the poses, that fits far better than the one asked for
    times: float = 1.0  # by how much
    length_ratio: float | None = None
    step: str = ""  # the files are out of step, in words
    unconfirmed: str = ""  # the setup was taken by what fits, which other poses the other way round would, too


@dataclass(frozen=True)
class Judged:
    """What is to be said of X."""

    reasons: tuple[Reason, ...]
    contradicted: bool  # no X fits these poses: its sigmas say nothing


def judge_hand_eye(name: str, fit: HandEyeFit, wrong: tuple[Suspect, ...], doubts: Doubts, method: str) -> Judged:
    """Return the reasons about `name` = T_1_2, none where there is nothing to say; what explains the others comes first."""
    pattern = None if fit.lag is not None else pattern_of(fit)  # what a lag leaves looks like any of them
    cause = _cause(fit, doubts, pattern)
    misfit = cause or _scale(fit) or ([] if pattern is None else [(pattern.verdict, pattern.text)]) or _too_far(fit)
    found = (*misfit, *_open(fit, not cause), *_poses(fit, wrong), *_about(fit))
    reasons = [Reason(verdict, f"{name}: {text}") for verdict, text in found]
    chosen = fit.methods.get(method)
    if chosen is not None and chosen.failed:
        reasons.append(Reason(Verdict.FAIL, f"{name}: {method}, which was asked for, is far from the refined X: take --method refined"))
    if doubts.unconfirmed:
        reasons.append(Reason(Verdict.CHECK, f"{name}: {doubts.unconfirmed}"))
    return Judged(tuple(reasons), any(verdict is Verdict.FAIL for verdict, _ in misfit))


def _cause(fit: HandEyeFit, doubts: Doubts, pattern: Pattern | None) -> list[tuple[Verdict, str]]:
    """Return what is wrong with all poses alike: then no more of them would help, and no other guess is worth telling."""
    s, motion = doubts.length_ratio, fit.data.setup == "motion"
    if doubts.better:
        return [(Verdict.FAIL, f"{doubts.better} fits {plain(doubts.times)} times better")]
    if doubts.step:
        return [(Verdict.FAIL, doubts.step)]
    if s is not None:
        why = "the units of both sides" if motion else unit_of(s) or "the size of the board and the units of the poses"
        check = "" if unit_of(s) and not motion else "check "
        return [(Verdict.FAIL, f"{_second(fit)}'s lengths times {s:.4g} fit far better: {check}{why}")]
    if pattern is not None and pattern.moved and pattern.verdict is Verdict.FAIL:
        return [(pattern.verdict, pattern.text)]
    if places_disagree(fit) and not _scale(fit):
        text = "the angles between poses agree and their places do not: places or angles are read wrongly"
        names = "units and the quaternions' order of both sides" if motion else "--pose-format, --pose-unit and the quaternions' order"
        return [(Verdict.FAIL, f"{text}; check {names}")]
    return []


def _scale(fit: HandEyeFit) -> list[tuple[Verdict, str]]:
    """Return lengths that fit better by little; FAIL where X is off by more than its sigma, which holds no error of scale, can tell."""
    found = stretch(fit.data, fit.refined, fit.trusted.inflation)
    if found is None:
        return []
    p = found.moves[:3]
    far = float(np.linalg.norm(p))
    sigma = float(np.sqrt(p @ fit.cov_X[:3, :3] @ p)) / max(far, 1e-12)
    text = f"{_second(fit)}'s lengths times {found.factor:.4f} +- {plain(found.sigma)} fit better, and move p by {plain(1e3 * far)} mm"
    limit = _OFF_SIGMAS * sigma
    check = "the units of both, and the scale of an odometry"  # which drifts by a percent, and X's sigma holds what that leaves
    if fit.data.setup != "motion":
        limit, check = min(_OFF, limit), "the board's squares (measure them), the target file and the units of the poses"
    return [(Verdict.FAIL if far > limit else Verdict.CHECK, f"{text}: check {check}")]


def _too_far(fit: HandEyeFit) -> list[tuple[Verdict, str]]:
    """Return that an arm's poses leave more than any arm and board err by; an odometry that drifts may."""
    left = float(np.sqrt(np.mean(np.sum(fit.residual[fit.kept, :3] ** 2, axis=1)))) if fit.kept.any() else 0.0
    if not fit.data.words.arm or left < _NO_ARM:
        return []
    text = f"the poses leave {plain(1e3 * left)} mm, more than an arm and a board err by: poses of other moments or read wrongly"
    return [(Verdict.FAIL, f"{text}; check which pose belongs to which image, --pose-format, --angle-unit")]


def _second(fit: HandEyeFit) -> str:
    return fit.data.words.frames[1] if fit.data.setup == "motion" else "the second side"


def _open(fit: HandEyeFit, advise: bool) -> list[tuple[Verdict, str]]:
    """Return what is not observable, and what is weak where that is not the same; the poses to add once."""
    advice = "; ".join(dict.fromkeys(a.text for a in fit.advice)) if advise else ""
    hidden = [key for key, status in parameter_statuses(fit.X, fit.cov_X).items() if status is Status.NOT_OBSERVABLE]
    those = [o.text for o in fit.open if o.grade == "not observable"]
    weak = [f"{o.text}, known to {plain(o.sigma)} {_unit(o)} only" for o in fit.open if o.grade == "weak" and o.text not in those]
    out = []
    if those:
        out.append((Verdict.FAIL, f"not observable: {'; '.join(those)} ({', '.join(hidden)})" + (f": {advice}" if advice else "")))
    if weak and advise:
        out.append((Verdict.CHECK, f"weak: {'; '.join(weak)}" + (f": {advice}" if advice and not those else "")))
    return out


def _unit(o: Open) -> str:
    return "mm" if o.text.startswith("p ") else "mrad"


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
    out = _stated(fit)
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


def _stated(fit: HandEyeFit) -> list[tuple[Verdict, str]]:
    """Return where the residuals have more noise than was stated of the robot."""
    robot, out = fit.robot, []
    if robot is None:
        return []
    if robot.exact:
        off = fit.noise.get("Q_factor", 0.0)
        text = f"with exact robot poses the corners are off by {off:.2g} times their noise: this robot's poses are not exact"
        return [(Verdict.CHECK, f"{text}; leave out --robot-noise exact")] if off > _NOT_EXACT else []
    for sigma, kind, what in ((robot.rotation, "P_rotation", "turns"), (robot.translation, "P_translation", "places")):
        if fit.noise.get(kind, 0.0) > _COARSER * sigma:
            text = f"the robot's {what} err by {fit.noise[kind] / sigma:.2g} times what --robot-noise states, which is taken instead"
            out.append((Verdict.CHECK, f"{text}: a repeatability is not the accuracy of an arm's geometry"))
    return out
