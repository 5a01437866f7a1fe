"""From a hand-eye fit to a result: the rig's transforms with their trust, what is to be said of it, and what the report draws."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from calibkit.data.result import ResidualSet, Result
from calibkit.data.rig import Rig, Transform
from calibkit.data.transforms import make_transform
from calibkit.data.verdict import Reason, Status, Verdict, worst
from calibkit.errors import one_line
from calibkit.estimation.hand_eye import HandEyeFit, Method
from calibkit.estimation.hand_eye_doubts import Suspect, suspects
from calibkit.estimation.hand_eye_refine import SCALES
from calibkit.estimation.hand_eye_verdict import Doubts, judge_hand_eye
from calibkit.geometry import so3
from calibkit.geometry.so3 import Array
from calibkit.solver.trust import directions, grade

STAGE = "handeye"
REFINED = "refined"
_WORST = 5


@dataclass(frozen=True)
class Asked:
    """What the stage knows beside the poses."""

    method: str = REFINED
    predict: int = 0
    t_ns: NDArray[np.int64] | None = None  # (n,)
    px: Array | None = None  # (n,) rms of the corners against what the robot's pose predicts
    lines: tuple[str, ...] = ()  # how the poses were found and paired
    doubts: Doubts = field(default_factory=Doubts)


def hand_eye_result(fit: HandEyeFit, asked: Asked) -> Result:
    """Return the result of stage `handeye`: X = T_1_2 and, where there is one, Z = T_w1_w2."""
    words = fit.data.words
    one, two, w1, w2 = words.frames
    name, fixed = f"T_{one}_{two}", f"T_{w1}_{w2}"
    wrong = suspects(fit)
    reasons = judge_hand_eye(name, fit, wrong, asked.doubts, asked.method)
    texts = [reason.text.removeprefix(f"{name}: ") for reason in reasons]
    chosen = fit.methods.get(asked.method)
    X, cov = (fit.X, fit.cov_X) if chosen is None else (chosen.X, None)
    entries = {name: _entry(one, two, X, fit.cov_X, cov is not None, reasons=texts, verdict=worst(reasons))}
    if fit.Z is not None and fit.cov_Z is not None:
        entries[fixed] = _entry(w1, w2, fit.Z, fit.cov_Z, chosen is None, verdict=worst(reasons))
    if fixed in entries and entries[fixed].status is Status.NOT_OBSERVABLE:
        reasons += (Reason(Verdict.FAIL, f"{fixed}: not observable, by the same poses"),)
    unknown = tuple(key for key, entry in entries.items() if entry.status is Status.NOT_OBSERVABLE)
    predicted = fit.predict(asked.predict) if asked.predict else None
    return Result(
        stage=STAGE,
        rig=Rig(transforms=entries),
        reasons=reasons,
        residuals=(_pose_set(name, fit, asked), _pair_set(name, fit)),
        facts={
            "hand_eye": {name: _facts(fit, asked, wrong, predicted, fixed)},
            "frame_labels": {name: [one_line(label, 100) for label in fit.data.labels]},
            "lines": [*asked.lines, *_lines(name, fixed, fit, asked, wrong, predicted)],
            "tables": [_methods_table(fixed, fit)] if fit.methods else [],
        },
        not_observable=unknown,
    )


def _entry(a: str, b: str, T: Array, cov: Array, with_cov: bool, verdict: Verdict, reasons: list[str] | None = None) -> Transform:
    status = Status(directions(cov, SCALES)[0].grade)
    return make_transform(a, b, T, cov if with_cov else None, status, verdict=verdict, reasons=reasons or [])


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


def _lines(name: str, fixed: str, fit: HandEyeFit, asked: Asked, wrong: tuple[Suspect, ...], predicted: Array | None) -> list[str]:
    n, kept = len(fit.data.P), int(fit.kept.sum())
    lines = [f"{name} ({fit.data.setup}): {kept} of {n} poses used"]
    lines += [f"  {text}" for text in known_parts(name, fit)]
    size = f"{np.degrees(fit.scatter.angle):.3g} deg, {1e3 * fit.scatter.distance:.3g} mm rms"
    each = "" if fit.n_worlds == 1 else f", each of {fit.n_worlds} stretches about its own"
    lines.append(f"  scatter of {fixed}, which should be one transform: {size}{each}")
    if asked.px is not None and fit.kept.any():
        lines.append(f"  the board where the robot's poses say it is, in the images: rms {_rms(asked.px[fit.kept]):.3g} px")
    lines.append(f"  noise, {'assumed (too few poses tell it)' if fit.noise_assumed else 'told by the residuals'}: {_noise(fit)}")
    lines += [
        f"  left out: {one_line(s.label, 60)} ({np.degrees(s.angle):.3g} deg, {1e3 * s.distance:.3g} mm){': ' + s.why if s.why else ''}"
        for s in wrong[:_WORST]
    ]
    if len(wrong) > _WORST:
        lines.append(f"  and {len(wrong) - _WORST} more (--json has them all)")
    lines.append(f"  worst pairs: {'; '.join(_worst_pairs(fit))}")
    if predicted is not None:
        now, then = _sigmas(fit.cov_X), _sigmas(predicted)
        lines.append(
            f"  with {asked.predict} more good poses: p to {1e3 * then[0]:.2g} mm instead of {1e3 * now[0]:.2g}, "
            f"R to {np.degrees(then[1]):.2g} deg instead of {np.degrees(now[1]):.2g} (weakest axis)"
        )
    if asked.method != REFINED:
        lines.append(f"  written is X by {asked.method}, as asked for, without a covariance; the numbers above are the refined one's")
    return lines


def known_parts(name: str, fit: HandEyeFit) -> list[str]:
    """Return p and R with their sigmas, along frame 1's axes, or along the directions that are known where not all are."""
    R, one = fit.X[:3, :3], fit.data.words.frames[0]
    v = so3.log(R)
    J = np.linalg.inv(so3.right_jacobian(v))
    p_cov, R_cov = R @ fit.cov_X[:3, :3] @ R.T, J @ fit.cov_X[3:, 3:] @ J.T
    statuses = fit.statuses
    lines = []
    if statuses["p"] is not Status.NOT_OBSERVABLE:
        lines.append(f"p = {_triple(1e3 * fit.X[:3, 3], 1e3 * np.sqrt(np.diag(p_cov)))} mm")
    else:
        known = _known_directions(fit.X[:3, 3], p_cov)
        lines.append(f"p of {name}, in {one}'s axes: {'; '.join(known)}; the rest is not known" if known else f"p of {name} is not known")
    if statuses["R"] is not Status.NOT_OBSERVABLE:
        lines.append(f"R = exp{_triple(np.degrees(v), np.degrees(np.sqrt(np.diag(R_cov))))} deg")
    else:
        lines.append(f"R of {name} is not known as a whole")
    return lines


def _known_directions(p: Array, cov: Array) -> list[str]:
    """Return p along frame 1's axes that are known, or along the directions that are where these are no axes."""
    along = [d.vector for d in directions(cov, np.full(3, SCALES[0])) if d.grade != "not observable"]
    axes = [e for e in np.eye(3) if grade(float(np.sqrt(e @ cov @ e)) / SCALES[0]) != "not observable"]
    said = []
    for u in axes if len(axes) == len(along) else along:
        u = u * np.sign(u[np.argmax(np.abs(u))])
        where = "xyz"[int(np.argmax(u))] if u.max() == 1 else "({:.2f}, {:.2f}, {:.2f})".format(*(u.round(2) + 0.0))
        said.append(f"{1e3 * float(u @ p):+.2f} +- {1e3 * float(np.sqrt(u @ cov @ u)):.2g} mm along {where}")
    return said


def _triple(values: Array, sigmas: Array) -> str:
    digits = int(np.clip(2 - np.floor(np.log10(max(float(sigmas.min()), 1e-9))), 2, 6)) - 1
    both = (", ".join(f"{x:{sign}.{digits}f}" for x in part) for part, sign in ((values, "+"), (sigmas, "")))
    return "({}) +- ({})".format(*both)


_NOISE = {  # by the kind of noise: words, and what its sigma is shown in
    "rotation": ("turned by {:.2g} deg", float(np.degrees(1.0))),
    "translation": ("placed by {:.2g} mm", 1e3),
    "factor": ("off by {:.2g} times the sigmas that were told", 1.0),
}


def _noise(fit: HandEyeFit) -> str:
    one, two, _, _ = fit.data.words.frames
    sides = {"P": one if fit.data.setup == "motion" else "the robot", "Q": two}
    said = []
    for key, value in fit.noise.items():
        side, kind = key.split("_")
        words, unit = _NOISE[kind]
        said.append(f"{sides[side]} {words.format(value * unit)}")
    return ", ".join(said) + " (a coordinate)"


def _methods_table(fixed: str, fit: HandEyeFit) -> list[list[str]]:
    """Return every way of solving in a row: its difference to the refined X and the scatter it leaves."""
    head = ["method", "turned (deg)", "shifted (mm)", f"scatter of {fixed} (deg)", "(mm)", ""]
    rows = [[REFINED, "", "", f"{np.degrees(fit.scatter.angle):.4f}", f"{1e3 * fit.scatter.distance:.3f}", ""]]
    rows += [
        [key, *(f"{value:.{digits}f}" for value, digits in zip(_numbers(m), (4, 3, 4, 3), strict=True)), "FAILED" if m.failed else ""]
        for key, m in fit.methods.items()
    ]
    return [head, *rows]


def _numbers(method: Method) -> tuple[float, ...]:
    scatter = method.scatter
    return (float(np.degrees(method.angle)), 1e3 * method.distance, float(np.degrees(scatter.angle)), 1e3 * scatter.distance)


def _worst_pairs(fit: HandEyeFit) -> list[str]:
    """Return the pairs of kept poses that fit worst by the sum of their parts over the middle one's."""
    return [
        f"{one_line(fit.data.labels[i], 60)} - {one_line(fit.data.labels[j], 60)} {np.degrees(fit.pair_angle[k]):.2g} deg "
        f"{1e3 * fit.pair_distance[k]:.2g} mm"
        for k in worst_pairs(fit, 3)
        for i, j in [fit.pairs[k]]
    ]


def worst_pairs(fit: HandEyeFit, most: int) -> list[int]:
    """Return rows of fit.pairs between kept poses, the worst first."""
    good = np.flatnonzero(fit.kept[fit.pairs].all(axis=1))
    if not len(good):
        return []
    a, d = fit.pair_angle[good], fit.pair_distance[good]
    size = a / max(float(np.median(a)), 1e-12) + d / max(float(np.median(d)), 1e-12)
    return [int(k) for k in good[np.argsort(-size, kind="stable")[:most]]]


def _facts(fit: HandEyeFit, asked: Asked, wrong: tuple[Suspect, ...], predicted: Array | None, fixed: str) -> dict[str, object]:
    """Return everything in SI units, for machines."""
    data, spectrum = fit.data, fit.spectrum
    return {
        "setup": data.setup,
        "frames": list(data.words.frames),
        "equation": "P X = Z Q; A X = X B with A = P_i^-1 P_j, B = Q_i^-1 Q_j",
        "poses": len(data.P),
        "poses_kept": int(fit.kept.sum()),
        "worlds": fit.n_worlds,
        "written": asked.method,
        "X": fit.X.tolist(),
        "X_covariance": fit.cov_X.tolist(),
        "X_covariance_plain": fit.plain_cov_X.tolist(),
        "status": {part: status.value for part, status in fit.statuses.items()},
        "fixed_transform": fixed,
        "scatter": {"angle": fit.scatter.angle, "distance": fit.scatter.distance},
        "noise": {key: _finite(value) for key, value in fit.noise.items()},
        "noise_assumed": fit.noise_assumed,
        "methods": {key: _method_facts(m) for key, m in fit.methods.items()},
        "residuals": _residual_facts(fit, asked.px),
        "left_out": [{"pose": s.label, "angle": s.angle, "distance": s.distance, "guess": s.why} for s in wrong],
        "worst_pairs": [
            {
                "poses": [data.labels[int(i)] for i in fit.pairs[k]],
                "angle": float(fit.pair_angle[k]),
                "distance": float(fit.pair_distance[k]),
            }
            for k in worst_pairs(fit, 20)
        ],
        "spectrum": {
            "axes_rad2": spectrum.axes.tolist(),
            "axis_directions": spectrum.axis_directions.T.tolist(),
            "translation": spectrum.shift.tolist(),
            "translation_directions": spectrum.shift_directions.T.tolist(),
            "motions": spectrum.n,
        },
        "open": [{"what": o.text, "sigma_over_scale": o.sigma, "grade": o.grade} for o in fit.open],
        "advice": [{"what": a.text, "sigma_over_scale": a.sigma, "then": a.sigma_then} for a in fit.advice],
        "lag": None if fit.lag is None else {"dt": fit.lag.dt, "sigma": fit.lag.sigma, "share": fit.lag.share},
        "predict": None
        if predicted is None
        else {
            "poses": asked.predict,
            "X_covariance": predicted.tolist(),
            "sigma_p": _sigmas(predicted)[0],
            "sigma_R": _sigmas(predicted)[1],
        },
    }


def _method_facts(method: Method) -> Mapping[str, object]:
    scatter = {"angle": _finite(method.scatter.angle), "distance": _finite(method.scatter.distance)}
    return {
        "X": [[_finite(x) for x in row] for row in method.X.tolist()],
        "angle": _finite(method.angle),
        "distance": _finite(method.distance),
        "scatter": scatter,
        "failed": bool(method.failed),
    }


def _residual_facts(fit: HandEyeFit, px: Array | None) -> dict[str, list[object]]:
    size = np.linalg.norm(fit.residual.reshape(-1, 2, 3), axis=2)
    found: dict[str, list[object]] = {
        "pose": list(fit.data.labels),
        "angle": size[:, 1].tolist(),
        "distance": size[:, 0].tolist(),
        "kept": fit.kept.tolist(),
    }
    return found if px is None else {**found, "px": [_finite(x) for x in px.tolist()]}


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _rms(values: Array) -> float:
    values = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")


def _sigmas(cov: Array) -> tuple[float, float]:
    """Return the sigma of p (m) and of R (rad) along the weakest direction of each."""
    p, R = (float(np.sqrt(max(np.linalg.eigvalsh(cov[part, part])[-1], 0.0))) for part in (slice(0, 3), slice(3, 6)))
    return p, R
