"""Camera intrinsics from board views: models chosen, lenses and camera positions fitted jointly, judged, put into a result."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibkit.data.observations import BoardViews
from calibkit.data.progress import Progress, silent
from calibkit.data.result import ResidualSet, Result
from calibkit.data.rig import Camera, Estimate, Reprojection, Rig, Transform
from calibkit.data.transforms import make_covariance, make_transform
from calibkit.data.verdict import Reason, Status, Verdict, worst
from calibkit.errors import NotConvergedError
from calibkit.estimation.camera_rig_seed import components, match_instants
from calibkit.estimation.lens_fit import LensFit, fit_lenses
from calibkit.estimation.lens_trust import border_scales, lens_covariance
from calibkit.estimation.lens_verdict import LensJudgement, judge_lens
from calibkit.estimation.model_choice import HeldOut, ModelScore, compare_models, held_out
from calibkit.estimation.view_choice import choose_views
from calibkit.models.cameras import CAMERAS
from calibkit.solver.trust import Covariance, directions

STAGE = "intrinsics"


@dataclass(frozen=True)
class CameraRequest:
    """One camera to calibrate."""

    views: BoardViews
    model: str | None = None  # None: chosen by held-out error
    topic: str | None = None


@dataclass(frozen=True)
class _Solved:
    """A component of cameras, solved and judged."""

    fit: LensFit
    covariance: Covariance
    judgements: tuple[LensJudgement, ...]
    held_out: HeldOut | None


def calibrate_cameras(requests: Sequence[CameraRequest], robust: bool = True, max_views: int = 1500, progress: Progress = silent) -> Result:
    """Return lenses, T_cam_cam0 between cameras that share views, covariances, verdicts and residuals of all cameras.

    Raises NotConvergedError naming the camera that has no solution.
    """
    scores = [compare_models(r.views, list(CAMERAS)) for r in progress(requests, "comparing lens models", len(requests))]
    models = [request.model or found[0].model for request, found in zip(requests, scores, strict=True)]
    instants = match_instants([request.views for request in requests])
    groups = components(instants)
    solved: list[_Solved] = []
    for group in progress(groups, "solving", len(groups)):
        of_group = [models[c] for c in group]
        views, shared = choose_views([requests[c].views for c in group], of_group, tuple(instants[c] for c in group), max_views)
        fit = fit_lenses(views, of_group, shared, robust)
        covariance = lens_covariance(fit)
        judged = tuple(judge_lens(fit, i, covariance, scores[c]) for i, c in enumerate(group))
        _refuse_unconverged(fit, judged)
        solved.append(_Solved(fit, covariance, judged, held_out(fit)))
    return _result(requests, groups, solved, scores)


def _refuse_unconverged(fit: LensFit, judged: Sequence[LensJudgement]) -> None:
    """Raise NotConvergedError where the solver did not end and no verdict tells why (a wrong model, too few looks)."""
    if fit.converged or any(reason.verdict is Verdict.FAIL for judgement in judged for reason in judgement.reasons):
        return
    names = ", ".join(views.camera for views in fit.views)
    raise NotConvergedError(f"{names}: the solver did not converge: check the target file against the board, or try another --model")


def _result(requests: Sequence[CameraRequest], groups: list[list[int]], solved: list[_Solved], scores: list[list[ModelScore]]) -> Result:
    cameras: dict[str, Camera] = {}
    transforms: dict[str, Transform] = {}
    residuals: list[ResidualSet] = []
    reasons: list[Reason] = []
    unknown: list[str] = []
    facts: dict[str, object] = {"frame_labels": {}, "models": {}, "covariance": {}, "dropped_frames": [], "projection_sigma": {}}
    for group, part in zip(groups, solved, strict=True):
        for i, c in enumerate(group):
            name = requests[c].views.camera
            cameras[name] = _camera(part, i, requests[c].topic)
            residuals.append(corner_set(part.fit, i))
            reasons += part.judgements[i].reasons
            unknown += [f"{name}.{p}" for p, e in cameras[name].parameters.items() if e.status is Status.NOT_OBSERVABLE]
            _camera_facts(facts, name, part, i, scores[c], requests[c])
        for i in range(1, len(group)):
            a, b = requests[group[i]].views.camera, requests[group[0]].views.camera
            transforms[f"T_{a}_{b}"] = entry = _transform(part, i, a, b)
            unknown += [f"T_{a}_{b}"] if entry.status is Status.NOT_OBSERVABLE else []
            reasons += [Reason(entry.verdict or Verdict.PASS, text) for text in entry.reasons]
    for group in groups[1:]:
        names = ", ".join(requests[c].views.camera for c in group)
        first = requests[groups[0][0]].views.camera
        never = "never sees" if len(group) == 1 else "never see"
        text = (
            f"{names}: {never} the board at the same moment as {first}, so the transform between them is not known; "
            "hold the board where both see it at once, with stamps of one clock"
        )
        reasons.append(Reason(Verdict.CHECK, text))
    order = {request.views.camera: i for i, request in enumerate(requests)}
    cameras = dict(sorted(cameras.items(), key=lambda item: order[item[0]]))
    return Result(STAGE, Rig(cameras=cameras, transforms=transforms), tuple(reasons), tuple(residuals), facts, (), tuple(unknown))


def _camera(part: _Solved, i: int, topic: str | None) -> Camera:
    fit, judged = part.fit, part.judgements[i]
    model, where = fit.problem.cameras[i].model, fit.problem.lens_slices[i]
    corrected, plain = (np.sqrt(np.diag(cov)[where]) for cov in (part.covariance.corrected, part.covariance.plain))
    units = ("px",) * 4 + ("",) * (len(model.parameter_names) - 4)
    parameters = {
        name: Estimate(value=None, unit=unit, status=status)
        if status is Status.NOT_OBSERVABLE
        else Estimate(value=float(value), unit=unit, sigma=float(sigma), sigma_plain=float(sigma_plain), status=status)
        for name, unit, status, value, sigma, sigma_plain in zip(
            model.parameter_names, units, judged.statuses, fit.state.lenses[i], corrected, plain, strict=True
        )
    }
    known = all(status is not Status.NOT_OBSERVABLE for status in judged.statuses)
    return Camera(
        topic=topic,
        resolution=fit.problem.cameras[i].image_size,
        model=model.name,
        equation=model.equation,
        parameters=parameters,
        covariance=make_covariance(model.parameter_names, part.covariance.corrected[where, where]) if known else None,
        reprojection=_reprojection(part, i),
        verdict=worst(judged.reasons),
        reasons=[reason.text for reason in judged.reasons],
    )


def _reprojection(part: _Solved, i: int) -> Reprojection:
    kept_px, all_px = part.fit.residuals(i)
    kept, found = part.fit.kept[i], part.fit.observed[i] & all_px.seen
    name = part.fit.views[i].camera
    return Reprojection(
        rms_px=_rms(kept_px.px[kept]),
        rms_all_px=_rms(all_px.px[found]),
        held_out_rms_px=part.held_out.rms_px if part.held_out else None,
        corners=int(kept.sum()),
        corners_dropped=int(part.fit.observed[i].sum() - kept.sum()),
        frames=part.fit.views[i].n_frames,
        frames_dropped=sum(view.camera == name for view in part.fit.dropped),
    )


def _rms(px: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> float:
    return float(np.sqrt(np.sum(px**2) / max(len(px), 1)))


def corner_set(fit: LensFit, i: int) -> ResidualSet:
    """Return every found corner's residual, rows in the order of the views; NaN where the model has no prediction."""
    _, every = fit.residuals(i)
    frame, corner = np.nonzero(fit.observed[i])
    raw = np.where(every.seen[..., None], every.px, np.nan)[frame, corner]
    grid, views = fit.problem.cameras[i], fit.views[i]
    weight = grid.weight[frame, corner]
    tilt = np.arccos(np.clip(np.abs(every.board_normal[:, 2]), 0, 1))
    return ResidualSet(
        sensor=views.camera,
        unit="px",
        t_ns=views.t_ns[frame],
        raw=raw,
        sigma=np.where(weight > 0, 1 / np.where(weight > 0, weight, 1.0), views.sigma_px),
        context={
            "uv": grid.uv[frame, corner],
            "corner": corner.astype(np.int32),
            "frame": frame.astype(np.int32),
            "kept": fit.kept[i][frame, corner],
            "distance": every.distance[frame, corner],
            "tilt": tilt[frame],
        },
    )


def _camera_facts(facts: dict[str, object], name: str, part: _Solved, i: int, scores: list[ModelScore], request: CameraRequest) -> None:
    """Note what the report and --json show beside the rig."""
    where = part.fit.problem.lens_slices[i]
    projection = part.judgements[i].projection
    entries: dict[str, object] = {
        "frame_labels": list(part.fit.views[i].labels),
        "models": {
            s.model: {
                "held_out_px": _or_none(s.error_px),
                "kept_rms_px": _or_none(s.rms_px),
                "fits": s.within,
                "asked": s.model == request.model,
            }
            for s in scores
        },
        "covariance": {
            "variance_factor": part.covariance.variance_factor,
            "blocks": part.covariance.blocks,
            "sigma_factors": dict(
                zip(part.fit.problem.cameras[i].model.parameter_names, part.covariance.factors[where].tolist(), strict=True)
            ),
        },
        "projection_sigma": {
            "uv": projection.uv.tolist(),
            "sigma_px": [_or_none(s) for s in projection.sigma.tolist()],
            "seen": projection.seen.tolist(),
        },
        "views": {"images": request.views.n_images, "with_board": request.views.n_frames, "used": part.fit.views[i].n_frames},
    }
    for key, value in entries.items():
        by_camera = facts.setdefault(key, {})
        assert isinstance(by_camera, dict)
        by_camera[name] = value
    listed = facts["dropped_frames"]
    assert isinstance(listed, list)
    listed += [{"camera": v.camera, "frame": v.label, "why": v.why} for v in part.fit.dropped if v.camera == name]


def _or_none(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _transform(part: _Solved, i: int, a: str, b: str) -> Transform:
    where = part.fit.problem.rig_slice(i)
    cov = part.covariance.corrected[where, where]
    weakest = directions(cov, border_scales(part.fit.problem, part.fit.state.lenses)[where])[0]
    status, reasons = Status(weakest.grade), []
    if any(set(part.judgements[k].statuses) == {Status.NOT_OBSERVABLE} for k in (0, i)):
        status, reasons = Status.NOT_OBSERVABLE, [f"T_{a}_{b} is not observable: it stands on a lens that is not"]
    elif status is not Status.DETERMINED:
        reasons = [f"T_{a}_{b} is {status.value} ({weakest.sigma:.0f} times 1 mm, 1 mrad): show both cameras the board nearer and longer"]
    verdict = {Status.DETERMINED: Verdict.PASS, Status.WEAK: Verdict.CHECK, Status.NOT_OBSERVABLE: Verdict.FAIL}[status]
    return make_transform(a, b, part.fit.state.T_cam_cam0[i], cov, status, verdict=verdict, reasons=reasons)
