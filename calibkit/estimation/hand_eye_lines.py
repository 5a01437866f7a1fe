"""A hand-eye calibration in lines for a terminal: what is known of X, what the poses leave over, and every method beside the others."""

import numpy as np

from calibkit.data.plural import plain
from calibkit.data.transforms import carry_parameters
from calibkit.data.verdict import Status
from calibkit.errors import one_line
from calibkit.estimation.hand_eye import HandEyeFit
from calibkit.estimation.hand_eye_asked import REFINED, Asked
from calibkit.estimation.hand_eye_compared import scatter
from calibkit.estimation.hand_eye_doubts import Suspect
from calibkit.estimation.hand_eye_known import position_covariance
from calibkit.estimation.hand_eye_normal import SCALES
from calibkit.estimation.hand_eye_redrawn import DRAWS
from calibkit.geometry import so3
from calibkit.geometry.so3 import Array
from calibkit.solver.trust import directions, grade

_WORST = 5


def lines(name: str, fixed: str, fit: HandEyeFit, asked: Asked, wrong: tuple[Suspect, ...], predicted: Array | None) -> list[str]:
    n, kept = len(fit.data.P), int(fit.kept.sum())
    how = "" if asked.method == REFINED else f", X by {asked.method} as asked for, its sigma by {DRAWS} draws of the noise"
    lines = [f"{name} ({fit.data.setup}): {kept} of {n} poses used{how}"]
    lines += [f"  {text}" for text in known_parts(name, fit)]
    size = f"{plain(np.degrees(fit.scatter.angle), 3)} deg, {plain(1e3 * fit.scatter.distance, 3)} mm rms"
    each = "" if fit.n_worlds == 1 else f", each of {fit.n_worlds} stretches about its own"
    lines.append(f"  scatter of {fixed}, which should be one transform: {size}{each}")
    if asked.px is not None and fit.kept.any():
        lines.append(f"  the board where the robot's poses say it is, in the images: rms {plain(_rms(asked.px[fit.kept]), 3)} px")
    lines.append(f"  noise, {_noise_source(fit)}: {_noise(fit)}")
    for each_wrong in wrong[:_WORST]:
        size = f"{plain(np.degrees(each_wrong.angle), 3)} deg, {plain(1e3 * each_wrong.distance, 3)} mm"
        lines.append(f"  left out: {one_line(each_wrong.label, 60)} ({size}){': ' + each_wrong.why if each_wrong.why else ''}")
    if len(wrong) > _WORST:
        lines.append(f"  and {len(wrong) - _WORST} more (--json has them all)")
    lines.append(f"  worst pairs: {'; '.join(_worst_pairs(fit))}")
    if predicted is not None:
        carry = carry_parameters(fit.X)
        then = np.sqrt(np.diag(carry @ predicted @ carry.T)) * np.repeat([1e3, np.degrees(1.0)], 3)
        p, R = (", ".join(plain(x) for x in part) for part in (then[:3], then[3:]))
        lines.append(f"  with {asked.predict} more good poses: p to ({p}) mm, R to ({R}) deg")
    return lines


def known_parts(name: str, fit: HandEyeFit) -> list[str]:
    """Return p and R with their sigmas, along frame 1's axes, or along the directions that are known where not all are."""
    X, one = fit.X, fit.data.words.frames[0]
    carry = carry_parameters(X)
    cov, p_cov = carry @ fit.cov_X @ carry.T, position_covariance(X, fit.cov_X)
    statuses = fit.statuses
    lines = []
    if statuses["p"] is not Status.NOT_OBSERVABLE:
        lines.append(f"p = {_triple(1e3 * X[:3, 3], 1e3 * np.sqrt(np.diag(p_cov)))} mm")
    else:
        known = _known_directions(X[:3, 3], p_cov)
        lines.append(f"p of {name}, in {one}'s axes: {'; '.join(known)}; the rest is not known" if known else f"p of {name} is not known")
    if statuses["R"] is not Status.NOT_OBSERVABLE:
        lines.append(f"R = exp{_triple(np.degrees(so3.log(X[:3, :3])), np.degrees(np.sqrt(np.diag(cov)[3:])))} deg")
    else:
        lines.append(_known_axis(name, fit) or f"R of {name} is not known")
    return lines


def _known_axis(name: str, fit: HandEyeFit) -> str:
    """Return how R is known where it is open about one axis alone: that axis of frame 2 and of frame 1 are one, R exp(a u) u = R u."""
    one, two, _, _ = fit.data.words.frames
    about, *others = directions(fit.cov_X[3:, 3:], SCALES[3:])[:2]
    if others[0].grade == "not observable":
        return ""
    u = about.vector * np.sign(about.vector[np.argmax(np.abs(about.vector))])
    there, here = ("({:.3f}, {:.3f}, {:.3f})".format(*(v.round(3) + 0.0)) for v in (u, fit.X[:3, :3] @ u))
    sigma = np.degrees(others[0].sigma * SCALES[3])
    return f"R of {name}: {two}'s axis {there} is {one}'s axis {here} to {plain(sigma)} deg; how far it is turned about it is not known"


def _known_directions(p: Array, cov: Array) -> list[str]:
    """Return p along frame 1's axes that are known, or along the directions that are where these are no axes."""
    along = [d.vector for d in directions(cov, np.full(3, SCALES[0])) if d.grade != "not observable"]
    axes = [e for e in np.eye(3) if grade(float(np.sqrt(e @ cov @ e)) / SCALES[0]) != "not observable"]
    said = []
    for u in axes if len(axes) == len(along) else along:
        u = u * np.sign(u[np.argmax(np.abs(u))])
        where = "xyz"[int(np.argmax(u))] if u.max() == 1 else "({:.2f}, {:.2f}, {:.2f})".format(*(u.round(2) + 0.0))
        said.append(f"{1e3 * float(u @ p):+.2f} +- {plain(1e3 * float(np.sqrt(u @ cov @ u)))} mm along {where}")
    return said


def _triple(values: Array, sigmas: Array) -> str:
    digits = int(np.clip(2 - np.floor(np.log10(max(float(sigmas.min()), 1e-9))), 2, 6)) - 1
    both = (", ".join(f"{x:{sign}.{digits}f}" for x in part) for part, sign in ((values, "+"), (sigmas, "")))
    return "({}) +- ({})".format(*both)


def _noise_source(fit: HandEyeFit) -> str:
    if fit.noise_assumed:
        return "assumed (too few poses tell it)"
    if fit.robot is None:
        return "told by the residuals"
    return "the robot's poses taken for exact" if fit.robot.exact else "the robot's as stated or, where residuals have more, theirs"


def _noise(fit: HandEyeFit) -> str:
    """Return each side's noise, of one coordinate: a told covariance as its corners' px where there are corners."""
    one, two, _, _ = fit.data.words.frames
    sides = {"P": one if fit.data.setup == "motion" else "the robot", "Q": two}
    corners = fit.refined.corners
    said = []
    for key, value in fit.noise.items():
        side, kind = key.split("_")
        if side == "P" and fit.robot is not None and fit.robot.exact:
            continue
        if kind == "rotation":
            said.append(f"{sides[side]} turned by {plain(np.degrees(value))} deg")
        elif kind == "translation":
            said.append(f"{sides[side]} placed by {plain(1e3 * value)} mm")
        elif side == "Q" and corners is not None:
            said.append(f"{two}'s corners off by {plain(corners.rms(fit.refined.M)[0] / np.sqrt(2))} px")
        else:
            said.append(f"{sides[side]}'s poses off by {plain(value)} times the sigmas that they came with")
    return ", ".join(said) + " (a coordinate)"


def methods_table(fixed: str, fit: HandEyeFit) -> list[list[str]]:
    """Return every way of solving in a row: its difference to the refined X, which means nothing where that is open, and its scatter."""
    head = ["method", "turned (deg)", "shifted (mm)", f"scatter of {fixed} (deg)", "(mm)", ""]
    known = [fit.statuses[part] is not Status.NOT_OBSERVABLE for part in ("R", "p")]
    refined = scatter(fit.data, fit.refined.X, fit.kept)
    rows = [[REFINED, "", "", f"{np.degrees(refined.angle):.4f}", f"{1e3 * refined.distance:.3f}", ""]]
    for key, m in fit.methods.items():
        turned, shifted = (f"{np.degrees(m.angle):.4f}" if known[0] else "", f"{1e3 * m.distance:.3f}" if known[1] else "")
        left = (f"{np.degrees(m.scatter.angle):.4f}", f"{1e3 * m.scatter.distance:.3f}")
        rows.append([key, turned, shifted, *left, "FAILED" if m.failed else ""])
    return [head, *rows]


def _worst_pairs(fit: HandEyeFit) -> list[str]:
    """Return the pairs of kept poses that fit worst by the sum of their parts over the middle one's."""
    return [
        f"{one_line(fit.data.labels[i], 60)} - {one_line(fit.data.labels[j], 60)} {plain(np.degrees(fit.pair_angle[k]))} deg "
        f"{plain(1e3 * fit.pair_distance[k])} mm"
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


def _rms(values: Array) -> float:
    values = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")


def weakest_sigmas(cov: Array) -> tuple[float, float]:
    """Return the sigma of p (m) and of R (rad) along the weakest direction of each."""
    p, R = (float(np.sqrt(max(np.linalg.eigvalsh(cov[part, part])[-1], 0.0))) for part in (slice(0, 3), slice(3, 6)))
    return p, R
