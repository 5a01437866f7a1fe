"""What may be wrong with cameras, and what a new recording's own calibration of them, without an IMU, says about it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from calibkit.estimation.diagnosis import Evidence, Suspect
from calibkit.estimation.joint_suspects import AXES, mount
from calibkit.estimation.lens_fit import LensFit
from calibkit.estimation.lens_trust import border_scales, lens_covariance
from calibkit.geometry import se3
from calibkit.geometry.so3 import Array
from calibkit.solver.levenberg_marquardt import minimise


@dataclass(frozen=True)
class KnownCamera:
    """One camera as the calibration under test has it; covariances are 0 where it has none."""

    lens: Array  # (l,)
    cov_lens: Array  # (l, l)
    T_cam_ref: Array | None = None  # beside the first camera; None: not known, or the first itself
    cov_T: Array | None = None  # (6, 6)


def lens_evidence(fit: LensFit, known: Sequence[KnownCamera], numbers: Sequence[int]) -> tuple[Evidence, tuple[Suspect, ...]]:
    """Return how a fit of new data wants cameras moved that see the board at once, and the suspects; `numbers` are the cameras' names.

    What the calibration under test does not know is free.
    """
    problem, state = fit.problem, fit.state
    # Weights from a covariance that few blocks tell lean on the directions in which it falls short by chance.
    covariance = lens_covariance(fit, least=1.0)
    S, _ = problem.information(state)
    information, scales = S.sum(axis=0) + problem.prior(state.lenses)[1], border_scales(problem, state.lenses)
    size = problem.border_size
    delta, cov, keep = np.zeros(size), covariance.corrected.copy(), np.ones(size, bool)
    for c, (was, lens, where) in enumerate(zip(known, state.lenses, problem.lens_slices, strict=True)):
        delta[where] = lens - was.lens
        cov[where, where] += was.cov_lens
        if c:
            at = problem.rig_slice(c)
            keep[at] = was.T_cam_ref is not None
            if was.T_cam_ref is not None and was.cov_T is not None:
                delta[at] = se3.local(was.T_cam_ref, state.T_cam_cam0[c])
                cov[at, at] += was.cov_T
    here, free = np.flatnonzero(keep), np.flatnonzero(~keep)
    coupling, own = information[np.ix_(here, free)], information[np.ix_(free, free)]
    information = information[np.ix_(here, here)] - coupling @ np.linalg.pinv(own, hermitian=True) @ coupling.T
    evidence = Evidence(delta[here], cov[np.ix_(here, here)], information, scales[here], float(max(covariance.blocks, 8)))
    suspects = _suspects(fit, numbers, [k.T_cam_ref is not None for k in known])
    return evidence, tuple(replace(each, columns=each.columns[here]) for each in suspects)


def together(parts: Sequence[tuple[Evidence, tuple[Suspect, ...]]]) -> tuple[Evidence, tuple[Suspect, ...]]:
    """Return the evidence of cameras that never see the board at once as one: their errors have nothing in common."""
    evidence = Evidence(
        np.concatenate([each.delta for each, _ in parts]),
        block_diag(*(each.cov for each, _ in parts)),
        block_diag(*(each.information for each, _ in parts)),
        np.concatenate([each.scales for each, _ in parts]),
        min(each.freedom for each, _ in parts),
    )
    suspects, start = [], 0
    for each, own in parts:
        for suspect in own:
            columns = np.zeros((len(evidence.delta), suspect.columns.shape[1]))
            columns[start : start + len(each.delta)] = suspect.columns
            suspects.append(replace(suspect, columns=columns))
        start += len(each.delta)
    return evidence, tuple(suspects)


def _suspects(fit: LensFit, numbers: Sequence[int], placed: Sequence[bool]) -> list[Suspect]:
    problem, unit = fit.problem, np.eye(fit.problem.border_size)
    found = []
    scale = np.zeros((problem.border_size, 1))
    for c, (k, lens, where) in enumerate(zip(numbers, fit.state.lenses, problem.lens_slices, strict=True)):
        columns = unit[:, where]
        focal = lens[:2] / lens[:2].mean()
        found += [Suspect(f"focal {k}", columns[:, :2] @ focal[:, None]), Suspect(f"focal lengths {k}", columns[:, :2])]
        found += [Suspect(f"centre {k}", columns[:, 2:4])]
        found += [Suspect(f"distortion {k}", columns[:, 4:])] if columns.shape[1] > 4 else []
        if c and placed[c]:
            at, T = unit[:, problem.rig_slice(c)], fit.state.T_cam_cam0[c]
            turns, shifts = mount(T)
            found += [Suspect(f"R_{axis} {k}", at @ turns[:, i : i + 1]) for i, axis in enumerate(AXES)]
            found += [Suspect(f"p_{axis} {k}", at @ shifts[:, i : i + 1]) for i, axis in enumerate(AXES)]
            # A board that is larger than its file says makes everything seem nearer: p' = p / (1 + e), rho = -R^T p e.
            scale[problem.rig_slice(c), 0] = np.append(-T[:3, :3].T @ T[:3, 3], np.zeros(3))
    return [*found, Suspect("board scale", scale)] if np.any(scale) else found


def with_poses(fit: LensFit, known: Sequence[KnownCamera]) -> LensFit:
    """Return the fit with the calibration under test held and the board's poses that suit it best; places that it lacks stay as found."""
    T = [own if was.T_cam_ref is None else was.T_cam_ref for own, was in zip(fit.state.T_cam_cam0, known, strict=True)]
    state = replace(fit.state, lenses=tuple(was.lens for was in known), T_cam_cam0=np.stack(T))
    solution = minimise(replace(fit.problem, free_lens=False, free_rig=False), state)
    return replace(fit, state=solution.x, converged=solution.converged)


def corners_rms(fit: LensFit) -> tuple[float, ...]:
    """Return the rms of each camera's corners that took part, px."""
    left = (fit.problem.residuals(fit.state, c) for c in range(len(fit.views)))
    return tuple(float(np.sqrt(np.sum(each.px[each.seen] ** 2) / max(int(each.seen.sum()), 1))) for each in left)
