"""From a hand-eye fit to a result: the rig's transforms with their trust, what is to be said of it, and what the report draws."""

import numpy as np
from numpy.typing import NDArray

from calibkit.data.result import ResidualSet, Result
from calibkit.data.rig import Rig, Transform
from calibkit.data.transforms import make_transform
from calibkit.data.verdict import Reason, Status, Verdict, worst
from calibkit.errors import one_line
from calibkit.estimation.hand_eye import HandEyeFit
from calibkit.estimation.hand_eye_asked import Asked
from calibkit.estimation.hand_eye_doubts import suspects
from calibkit.estimation.hand_eye_facts import facts
from calibkit.estimation.hand_eye_known import doubted, parameter_statuses
from calibkit.estimation.hand_eye_lines import lines, methods_table
from calibkit.estimation.hand_eye_normal import SCALES
from calibkit.estimation.hand_eye_verdict import Judged, judge_hand_eye
from calibkit.geometry import so3
from calibkit.geometry.so3 import Array
from calibkit.solver.trust import directions

STAGE = "handeye"


def hand_eye_result(fit: HandEyeFit, asked: Asked) -> Result:
    """Return the result of stage `handeye`: X = T_1_2 and, where there is one, Z = T_w1_w2."""
    one, two, w1, w2 = fit.data.words.frames
    name, fixed = f"T_{one}_{two}", f"T_{w1}_{w2}"
    wrong = suspects(fit)
    judged = judge_hand_eye(name, fit, wrong, asked.doubts, asked.method)
    reasons = judged.reasons
    texts = [reason.text.removeprefix(f"{name}: ") for reason in reasons]
    entries = {name: _entry(one, two, fit.X, fit.cov_X, judged, texts)}
    if fit.Z is not None and fit.cov_Z is not None:
        entries[fixed] = _entry(w1, w2, fit.Z, fit.cov_Z, judged)
    unknown = {key: _unknown(entry) for key, entry in entries.items()}
    if unknown.get(fixed):
        reasons += (Reason(Verdict.FAIL, f"{fixed}: not observable, by the same poses: {', '.join(unknown[fixed])}"),)
    predicted = fit.predict(asked.predict) if asked.predict else None
    return Result(
        stage=STAGE,
        rig=Rig(transforms=entries),
        reasons=reasons,
        residuals=(_pose_set(name, fit, asked), _pair_set(name, fit)),
        facts={
            "hand_eye": {name: facts(fit, asked, wrong, predicted, fixed, judged.contradicted)},
            "frame_labels": {name: [one_line(label, 100) for label in fit.data.labels]},
            "lines": [*asked.lines, *lines(name, fixed, fit, asked, wrong, predicted)],
            "tables": [methods_table(fixed, fit)] if fit.methods else [],
        },
        not_observable=tuple(f"{key}.{parameter}" for key, parameters in unknown.items() for parameter in parameters),
    )


def _entry(a: str, b: str, T: Array, cov: Array, judged: Judged, reasons: list[str] | None = None) -> Transform:
    status, statuses = Status(directions(cov, SCALES)[0].grade), parameter_statuses(T, cov)
    if judged.contradicted:
        status, statuses = doubted(status), {key: doubted(value) for key, value in statuses.items()}
    return make_transform(a, b, T, cov, status, statuses=statuses, verdict=worst(judged.reasons), reasons=reasons or [])


def _unknown(entry: Transform) -> list[str]:
    return [key for key, status in entry.statuses.items() if status is Status.NOT_OBSERVABLE]


def _pose_set(name: str, fit: HandEyeFit, asked: Asked) -> ResidualSet:
    """Return what each pose leaves over: m, with its turn in rad beside it, both in frame 2; and where frame 1 was."""
    data, n = fit.data, len(fit.data.P)
    context: dict[str, NDArray[np.generic]] = {
        "turn": fit.residual[:, 3:],
        "kept": fit.kept,
        "frame": np.arange(n, dtype=np.int32),
        "place": data.P[:, :3, 3].copy(),
        "rotation": so3.to_quat(data.P[:, :3, :3]),
    }
    if asked.px is not None:
        context["px"] = asked.px
    t_ns = np.zeros(n, np.int64) if asked.t_ns is None else asked.t_ns
    sigma = np.sqrt(np.mean(fit.residual[fit.kept, :3] ** 2)) if fit.kept.any() else 1.0
    return ResidualSet(name, "m", t_ns, fit.residual[:, :3].copy(), np.full(n, max(float(sigma), 1e-12)), context)


def _pair_set(name: str, fit: HandEyeFit) -> ResidualSet:
    """Return the pairs of kept poses: their rotation vectors in frame 1, and the distance between A X and X B in m."""
    good = fit.kept[fit.pairs].all(axis=1)
    pairs = fit.pairs[good]
    R = fit.data.P[:, :3, :3]
    axis = so3.log(np.swapaxes(R[pairs[:, 0]], 1, 2) @ R[pairs[:, 1]])
    k = len(pairs)
    return ResidualSet(name, "m", np.zeros(k, np.int64), fit.pair_distance[good][:, None], np.ones(k), {"motion": axis})
