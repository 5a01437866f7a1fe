"""What the joint estimate is worth: what the motion left open and would mend, and what speaks against the data."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibkit.data.plural import counted
from calibkit.data.verdict import Reason, Status, Verdict, worst
from calibkit.estimation.joint import CameraInput, Joint
from calibkit.estimation.joint_causes import jittering
from calibkit.estimation.joint_checks import Checks
from calibkit.estimation.joint_frozen import WORDS
from calibkit.estimation.joint_gaps import gaps_of_camera, gaps_of_imu, never_together
from calibkit.estimation.joint_imu import NamedImu
from calibkit.estimation.joint_rivals import Rival
from calibkit.estimation.joint_state import A_G, IMU_MODEL, LINE, M_A, M_G, PHI, of_imu
from calibkit.estimation.joint_trust import Trust
from calibkit.estimation.open_directions import Open, open_directions
from calibkit.estimation.stamps import StampReport
from calibkit.estimation.time_offset_verdict import judge_time_offset
from calibkit.solver.trust import grade

_VERDICTS = {Status.DETERMINED: Verdict.PASS, Status.WEAK: Verdict.CHECK, Status.NOT_OBSERVABLE: Verdict.FAIL}
_NOISIER = {"camera": (2.0, 6.0), "gyro": (3.0, 30.0), "accel": (3.0, 30.0)}  # real over stated sigma: CHECK, FAIL
_LOST, _MOSTLY_LOST = 0.05, 0.3
_GRAVITY_OFF = 4.0  # sigmas of what was told
_SCALE_OFF, _SURE = 0.004, 5.0  # of the board's size, and sigmas
_HALVES_APART = 4.5  # sigmas; over some 14 numbers by chance once in ten thousand recordings
_MOTION = "turn the rig back and forth about two or more axes and move it, with the board in view, for 30 s or more"
_TURN = "turn the rig fast, back and forth about two or more axes"
_OTHER_CLOCK_S = 1.0
_READOUT_S = 5e-4  # of an image: less costs 0.25 px at the first and the last row at a fast 1 rad/s
_ODD_SCALE = 1.25  # a scale farther from 1 is no sensor's error
_IMU_MENDS = {
    M_A: "turn the rig onto each of its sides, and shake it along all axes",
    M_G: "turn the rig fast about all axes",
    PHI: "turn the rig fast about all axes",
    A_G: "shake the rig along all axes, and turn it onto each of its sides",
}


@dataclass(frozen=True)
class Judged:
    """Status of each border parameter, and all there is to say."""

    statuses: tuple[Status, ...]  # (p,)
    opens: tuple[tuple[Open, ...], ...]  # per camera, of T_cam_imu
    opens_of_imus: tuple[tuple[Open, ...], ...]  # per further IMU, of T_imu_ref
    reasons: dict[str, tuple[Reason, ...]]  # by rig entry, "" what concerns all
    contradicted: bool = False  # sensors contradict each other: what is open is no lack of motion

    @property
    def all(self) -> tuple[Reason, ...]:
        return tuple(reason for each in self.reasons.values() for reason in each)

    def verdict(self, entry: str) -> Verdict:
        return worst(self.reasons.get(entry, ()))

    def texts(self, entry: str) -> list[str]:
        return [reason.text.removeprefix(f"{entry}: ") for reason in self.reasons.get(entry, ())]


def judge_joint(
    joint: Joint,
    trust: Trust,
    checks: Checks,
    cameras: Sequence[CameraInput],
    imus: Sequence[NamedImu],
    stamps: dict[str, StampReport],
    wrong_imus: Sequence[dict[str, str]],
) -> Judged:
    """Return what is known of the cameras and of the IMUs; `wrong_imus` are each IMU's sensors that contradict all others, and why."""
    fit, names, imu = joint.fit, tuple(each.views.camera for each in cameras), imus[0].name
    border = fit.problem.border
    sigma = np.sqrt(np.diag(trust.cov)) / trust.scales
    statuses = [Status(grade(s)) for s in sigma]
    jitter = [jittering(joint, c, name, stamps) for c, name in enumerate(names)]
    reasons: dict[str, tuple[Reason, ...]] = {"": ()}
    opens, opens_of_imus = [], []
    for c, name in enumerate(names):
        T, dt = f"T_{name}_{imu}", f"dt_{imu}_{name}"
        where = border[f"T {c}"]
        found = open_directions(T, imu, np.eye(3), trust.cov[where, where])
        opens.append(found)
        reasons[T] = tuple(Reason(_VERDICTS[Status(each.grade)], f"{T}: {_open_text(each)}") for each in found)
        k = border[f"dt {c}"].start
        reasons[dt] = _of_known_offset(dt, statuses[k], float(sigma[k] * trust.scales[k]), _MOTION)
        if joint.rival is not None:
            reasons[dt] = (_of_rival(dt, fit.x.cameras[c].dt, joint.rival, c),)
        rolls = _of_shutter(joint, checks, name, c)
        judged = judge_time_offset(dt, name, imu, joint.turns[c], {s: stamps[s] for s in (name, imu) if s in stamps})
        if statuses[k] is not Status.NOT_OBSERVABLE:
            turns = () if rolls or fit.x.cameras[c].line_delay else judged.turns  # which know nothing of a shutter
            reasons[dt] += (*_of_offset(fit.x.cameras[c].dt, dt, name, imu), *judged.clock, *turns, *judged.stamps)
        cause = jitter[c]  # what follows from it, or from a shutter, is not told
        corners = rolls or (_of_corners(joint, names, c) if cause is None else (cause,))
        reasons[name] = (*_of_lens(joint, trust, cameras[c], c), *corners, *gaps_of_camera(joint, c, name))
        if cause is not None:
            reasons[dt] = tuple(reason for reason in reasons[dt] if "jitter" not in reason.text)
    for j, each in enumerate(imus):
        reasons[each.name] = (*_of_imu(joint, statuses, each, j), *(gaps_of_imu(joint, each.name, j) if j else ()))
        if j:
            found, more = _of_beside(joint, trust, statuses, (each.name, imu), j, stamps)
            opens_of_imus.append(found)
            if wrong_imus[j]:
                more = {key: _follows(key, those) for key, those in more.items()}
            reasons |= more
    sensors = (*names, *(each.name for each in imus))
    wrong = _never_together(joint, statuses, names, imu) or list(wrong_imus[0].values())
    if wrong:  # what they leave open is no lack of motion
        reasons |= {key: _follows(key, each) for key, each in reasons.items() if key not in sensors}
    reasons[""] = _of_all(joint, checks, sensors[len(names) :], any(cause is not None for cause in jitter), wrong, wrong_imus)
    reasons = {key: reasons[key] for key in sorted(reasons, key=lambda key: _rank(key, sensors))}
    return Judged(
        tuple(statuses), tuple(opens), tuple(opens_of_imus), {key: tuple(dict.fromkeys(each)) for key, each in reasons.items()}, bool(wrong)
    )


def _never_together(joint: Joint, statuses: Sequence[Status], names: tuple[str, ...], imu: str) -> list[str]:
    """Name sensors that were never recorded at once."""
    border, strange = joint.fit.problem.border, joint.fit.factors["gyro"] > _NOISIER["gyro"][1]
    lost = [c for c in range(len(names)) if strange or statuses[border[f"dt {c}"].start] is Status.NOT_OBSERVABLE]
    return [text for c in lost if (text := never_together(joint, c, names[c], imu))]


def _follows(key: str, reasons: tuple[Reason, ...]) -> tuple[Reason, ...]:
    """Return one reason for all that failed of an entry, where its sensors are at fault."""
    failed = [reason for reason in reasons if reason.verdict is Verdict.FAIL]
    return (Reason(Verdict.FAIL, f"{key}: not observable: its sensors contradict each other"),) if failed else reasons


def _rank(key: str, names: tuple[str, ...]) -> int:
    """Return the order in which reasons are told: sensors first, whose faults leave directions open."""
    return 0 if not key else 1 if key in names else 2


def _of_known_offset(dt: str, status: Status, sigma: float, mend: str) -> tuple[Reason, ...]:
    size = f"its sigma would be {sigma * 1e3:.2g} ms"
    known = {Status.DETERMINED: "", Status.WEAK: f"weak: {size}", Status.NOT_OBSERVABLE: f"not observable: {size}"}[status]
    return (Reason(_VERDICTS[status], f"{dt}: {known}; {mend}"),) if known else ()


def _of_beside(
    joint: Joint, trust: Trust, statuses: Sequence[Status], names: tuple[str, str], j: int, stamps: dict[str, StampReport]
) -> tuple[tuple[Open, ...], dict[str, tuple[Reason, ...]]]:
    """Return what is open of where IMU j sits beside the first one, and what there is to say of that and of its clock."""
    name, ref = names
    T, dt, border = f"T_{name}_{ref}", f"dt_{ref}_{name}", joint.fit.problem.border
    where, k = border[f"T_imu {j}"], border[f"dt_imu {j}"].start
    found = open_directions(T, ref, np.eye(3), trust.cov[where, where])
    of_dt = _of_known_offset(dt, statuses[k], float(np.sqrt(trust.cov[k, k])), _TURN)
    if not of_dt or statuses[k] is Status.WEAK:
        judged = judge_time_offset(dt, name, ref, joint.turns_of_imus[j - 1], {s: stamps[s] for s in names if s in stamps})
        of_dt += (*_of_offset(joint.fit.x.beside[j - 1].dt, dt, name, ref), *judged.clock, *judged.stamps)
    of_T = tuple(Reason(_VERDICTS[Status(each.grade)], f"{T}: {_open_text(each, _TURN)}") for each in found)
    return found, {T: of_T, dt: of_dt}


def _of_offset(size: float, dt: str, name: str, imu: str) -> tuple[Reason, ...]:
    found = []
    if abs(size) > _OTHER_CLOCK_S:
        text = f"{dt}: {size:.3f} s is more than any delay: {name} and {imu} have clocks of different origins"
        found.append(Reason(Verdict.CHECK, f"{text}: it will be another one at the next start"))
    return tuple(found)


def _of_rival(dt: str, one: float, rival: Rival, c: int) -> Reason:
    ms = f"{one * 1e3:+.1f}", f"{rival.offsets[c] * 1e3:+.1f} ms"
    both = f"{ms[1]} fits as well as {ms[0]} ms" if rival.alike else f"neither {ms[0]} nor {ms[1]} fits"
    why = "the motion repeats itself" if rival.alike else "the motion repeats itself, or the sensors contradict each other"
    return Reason(Verdict.FAIL, f"{dt}: not observable: {both}: {why}; turn irregularly, about several axes")


def _open_text(each: Open, turn: str = "accelerate along several axes") -> str:
    cause = "not observable in this motion" if each.grade == "not observable" else f"weak ({each.sigma:.0f} times 1 mm, 1 mrad)"
    mend = turn if each.text.startswith("R") else "turn about axes across it, 30 deg or more each way"
    return f"{each.text} is {cause}: {mend}"


def _of_imu(joint: Joint, statuses: Sequence[Status], each: NamedImu, j: int) -> tuple[Reason, ...]:
    """Return what is not known of IMU j's model, and a scale that is another unit's."""
    imu, border, found = each.name, joint.fit.problem.border, []
    if each.input.given:
        text = f"{imu}: its scale and axes are held as given without a covariance: the sigmas of T and dt hold none of their errors"
        found.append(Reason(Verdict.CHECK, text))
    for status in (Status.NOT_OBSERVABLE, Status.WEAK):
        for extra, mend in _IMU_MENDS.items():
            if extra not in border.free_of(j):
                continue
            where = border[of_imu(extra, j)]
            those = [key for key, s in zip(IMU_MODEL[extra], statuses[where], strict=True) if s is status]
            if those:
                be = "is" if len(those) == 1 else "are"
                found.append(Reason(_VERDICTS[status], f"{imu}: {', '.join(those)} {be} {status.value}: {mend}"))
    model = joint.fit.x.imus[j].model
    for extra, M in ((M_A, model.M_a), (M_G, model.M_g)):
        scale = float(np.median(np.diag(M)))
        if extra in border.free_of(j) and not 1 / _ODD_SCALE < scale < _ODD_SCALE:
            sensor = WORDS["accel" if extra == M_A else "gyro"]
            found.append(Reason(Verdict.FAIL, f"{imu}: the {sensor}'s scale is {scale:.4g}, not about 1: another unit, or raw counts?"))
    return tuple(found)


def _of_lens(joint: Joint, trust: Trust, camera: CameraInput, c: int) -> tuple[Reason, ...]:
    fit, name, border = joint.fit, camera.views.camera, joint.fit.problem.border
    if camera.lens_given:
        text = f"{name}: its lens is held as given without a covariance: the sigmas of T and dt hold none of its error"
        return (Reason(Verdict.CHECK, text),)
    where = border[f"lens {c}"]
    model = fit.problem.cameras[c].views.model
    sigma = (np.sqrt(np.diag(trust.cov)) / trust.scales)[where]
    found = []
    for status in (Status.NOT_OBSERVABLE, Status.WEAK):
        those = [p for p, s in zip(model.parameter_names, sigma, strict=True) if Status(grade(s)) is status]
        if those:
            mend = "tilt the board by 30 to 45 deg, and bring it to the image's edges"
            found.append(
                Reason(_VERDICTS[status], f"{name}: {', '.join(those)} {'is' if len(those) == 1 else 'are'} {status.value}: {mend}")
            )
    if LINE in border.extras:
        k = border[f"{LINE} {c}"].start
        status = Status(grade(float(np.sqrt(trust.cov[k, k]) / trust.scales[k])))
        if status is not Status.DETERMINED:
            found.append(
                Reason(_VERDICTS[status], f"{name}: its line delay is {status.value}: turn faster, the board over the whole image")
            )
    return tuple(found)


def _of_shutter(joint: Joint, checks: Checks, name: str, c: int) -> tuple[Reason, ...]:
    """Return that a camera whose rows are taken to be read at once reads them one by one."""
    asked = checks.line_delays[c]
    if asked is None:
        return ()
    delay, sigma = asked
    readout = delay * joint.fit.problem.cameras[c].views.image_size[1]
    if abs(readout) < _READOUT_S or abs(delay) < _SURE * sigma:
        return ()
    rows = f"{delay * 1e6:.3g} +- {sigma * 1e6:.2g} us a row, {abs(readout) * 1e3:.2g} ms an image"
    return (Reason(Verdict.CHECK, f"{name}: its rows seem to be read one after the other, {rows}: a rolling shutter? Add --line-delay"),)


def _of_corners(joint: Joint, names: tuple[str, ...], c: int) -> tuple[Reason, ...]:
    fit, name, found = joint.fit, names[c], []
    weight, kept = fit.found[c], fit.problem.cameras[c].views.weight > 0
    lost = 1 - kept.sum() / max(weight.sum(), 1)
    if lost > _LOST:
        verdict = Verdict.FAIL if lost > _MOSTLY_LOST else Verdict.CHECK
        text = f"{100 * lost:.0f} % of the corners fit no trajectory that the IMU allows: wrong stamps, a wrong board file, or blur"
        found.append(Reason(verdict, f"{name}: {text}"))
    factor, limits = fit.factors[f"camera {c}"], _NOISIER["camera"]
    if factor > limits[0]:
        text = f"its corners are {factor:.1f} times noisier than the detector says"
        cause = "stamps that jitter, a rolling shutter, a wrong board or lens model"
        found.append(Reason(Verdict.FAIL if factor > limits[1] else Verdict.CHECK, f"{name}: {text}: {cause}"))
    return tuple(found)


def _of_all(
    joint: Joint, checks: Checks, imus: tuple[str, ...], jitter: bool, wrong: list[str], wrong_imus: Sequence[dict[str, str]]
) -> tuple[Reason, ...]:
    fit, imu = joint.fit, imus[0]
    found = []
    if not fit.converged:
        found.append(Reason(Verdict.FAIL, "the fit did not settle: cameras and IMU do not fit together, or the motion tells too little"))
    if wrong:
        found = [Reason(Verdict.FAIL, text) for text in wrong]
    else:
        found += [Reason(Verdict.FAIL, text) for each in wrong_imus for text in dict.fromkeys(each.values())]
        kinds = [(i, kind, name, j) for j, name in enumerate(imus) for i, kind in enumerate(WORDS) if not wrong_imus[j]]
        asked = [each for each in kinds if each[-1] or not jitter]
        found += [reason for each in asked for reason in _of_samples(joint, *each)]
        found += _of_scale(joint, checks, imu)
    found += gaps_of_imu(joint, imu)
    if untold := [name for name, told in zip(imus, joint.imus, strict=True) if not np.all(told.walks)]:
        have = f"{' and '.join(untold)} {'has' if len(untold) == 1 else 'have'}"
        text = f"{have} no random walks in the rig file, a consumer IMU's were taken: run calibkit allan on an hour at rest, add --rig"
        found.append(Reason(Verdict.CHECK, text))
    if checks.halves is not None and (apart := float(np.max(np.abs(checks.halves.z)))) > _HALVES_APART:
        text = f"the two halves of the recording disagree by {apart:.1f} sigma"
        found.append(Reason(Verdict.CHECK, f"{text}: something moved or drifts, or errors that their sigmas do not hold"))
    n = joint.frames_left_out
    if n:
        found.append(
            Reason(
                Verdict.CHECK,
                f"{counted(n, 'frame')} with a board {'lies' if n == 1 else 'lie'} outside of what {imu} recorded, or at its ends",
            )
        )
    return tuple(found)


def _of_scale(joint: Joint, checks: Checks, imu: str) -> list[Reason]:
    fit, found = joint.fit, []
    prior = fit.problem.gravity
    off = float(np.linalg.norm(fit.x.gravity)) - prior.size
    if abs(off) > _GRAVITY_OFF * prior.sigma:
        text = (
            f"gravity comes out as {off + prior.size:.3f} m/s^2: {imu}'s accelerometer has a wrong scale or unit, or the board another size"
        )
        found.append(Reason(Verdict.FAIL, text))
    scale, sigma = checks.board_scale
    if abs(scale - 1) > max(_SCALE_OFF, _SURE * sigma):
        text = f"the board seems {scale:.4f} +- {sigma:.2g} times the size that its file says, by {imu}'s accelerations"
        found.append(Reason(Verdict.FAIL, f"{text}: measure it, or check {imu}'s scale"))
    return found


def _of_samples(joint: Joint, i: int, kind: str, imu: str, j: int) -> list[Reason]:
    found = []
    factor, (check, fail) = joint.fit.factors[of_imu(kind, j)], _NOISIER[kind]
    if factor > check:
        than = "its noise density says" if joint.imus[j].densities[i] else "its samples scatter from one to the next"
        text = f"{imu}'s {WORDS[kind]} is {factor:.1f} times noisier than {than}: vibration, a wrong unit or density?"
        found.append(Reason(Verdict.FAIL if factor > fail else Verdict.CHECK, text))
    if factor < 1 / check and joint.imus[j].densities[i]:
        text = f"{imu}'s {WORDS[kind]} is {1 / factor:.1f} times less noisy than its noise density says: another unit, or inflated?"
        found.append(Reason(Verdict.CHECK, f"{text} White noise is weighed as it is, its random walk is not"))
    lost = 1 - float(np.mean(joint.fit.problem.imus[j].keep[:, i]))
    if lost > _LOST:
        verdict = Verdict.FAIL if lost > _MOSTLY_LOST else Verdict.CHECK
        text = f"{100 * lost:.0f} % of the samples of {imu}'s {WORDS[kind]} fit no smooth motion: shocks, or wrong samples"
        found.append(Reason(verdict, text))
    return found


def known(statuses: tuple[Status, ...], where: slice) -> Status:
    """Return the worst of some parameters' statuses."""
    order = (Status.DETERMINED, Status.WEAK, Status.NOT_OBSERVABLE)
    return max(statuses[where], key=order.index)
