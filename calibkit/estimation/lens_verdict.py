"""What to say of a fitted lens: which numbers are known, why not, and which view would mend it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibkit.data.plural import counted
from calibkit.data.verdict import Reason, Status, Verdict
from calibkit.estimation.camera_problem import CameraViews
from calibkit.estimation.lens_fit import LensFit, instant_times
from calibkit.estimation.lens_trust import PixelEffect, ProjectionSigma, border_scales, orientations, pixel_effect, projection_sigma
from calibkit.estimation.model_choice import ModelScore
from calibkit.estimation.view_advice import best_view, region_of, seen_regions
from calibkit.geometry.so3 import Array
from calibkit.solver.trust import FEW_BLOCKS, WEAK, Covariance, grade

MIN_LOOKS = 3  # orientations, and seconds: two numbers of fx fy cx cy a look, and one look to check them
_WORSE_MODEL, _WRONG_MODEL = 1.1, 2.0  # held-out error over the best model's
_NO_MODEL_PX = 1.0
_RADIAL, _RINGS, _RADIAL_MOST = 0.25, 8, 20.0  # share of the squares, rings, px
_EXTRAPOLATED_PX = 1.0
_DROPPED_FRAMES = 0.1


@dataclass(frozen=True)
class LensJudgement:
    """One camera's verdict, in its parts."""

    statuses: tuple[Status, ...]  # by lens parameter
    reasons: tuple[Reason, ...]
    projection: ProjectionSigma


def judge_lens(fit: LensFit, c: int, covariance: Covariance, scores: Sequence[ModelScore]) -> LensJudgement:
    """Return what the recording says about camera c's lens."""
    where, views = fit.problem.lens_slices[c], fit.problem.cameras[c]
    camera, lens = fit.views[c].camera, fit.state.lenses[c]
    cov = covariance.corrected[where, where]
    projection = projection_sigma(views, lens, cov)
    hopeless = _no_model_fits(camera, scores) or _wrong_model(fit, c, scores)
    reasons = _frame_reasons(fit, c) if hopeless else [*_better_model(camera, views.model.name, scores), *_frame_reasons(fit, c)]
    too_few = _too_few_looks(fit, c)
    if too_few:
        reasons = [Reason(Verdict.FAIL, f"{camera}: {too_few}"), *hopeless, *reasons]
        return LensJudgement((Status.NOT_OBSERVABLE,) * len(lens), tuple(reasons), projection)
    effect = pixel_effect(views, lens, cov)
    moved = _involved(effect, cov)
    known = np.maximum(effect.parameters, np.where(moved, effect.weakest_px, 0.0))
    # A coefficient that others make up for to such an extent says nothing by itself, well as the pixels may be known.
    alone = np.sqrt(np.diag(cov)) / border_scales(fit.problem, fit.state.lenses)[where]
    known = np.where(alone > WEAK, np.maximum(known, WEAK), known)
    statuses = tuple(Status(grade(float(px))) for px in known)
    if hopeless:  # more views of a board that is not what the target says, or for a model that does not fit, would not help
        return LensJudgement(statuses, (*hopeless, *reasons), projection)
    reasons += _few_looks_reasons(fit, c)
    reasons += _direction_reasons(fit, c, covariance.variance_factor, cov, effect)
    reasons += _extrapolation_reasons(camera, views, lens, projection)
    return LensJudgement(statuses, tuple(reasons), projection)


def _looks(fit: LensFit, c: int) -> tuple[int, str]:
    """Return how many seconds have views of the board, or images where there are no stamps, and say so."""
    instants = fit.problem.cameras[c].instant
    looks = len(np.unique(np.floor(instant_times(fit)[instants])))
    span = f" within {looks} s" if fit.views[c].t_ns.any() else ""
    verb = "is" if len(instants) == 1 else "are"
    return looks, f"{counted(len(instants), 'view')}{span} {verb} {counted(looks, 'independent look')} at the board"


def _few_looks_reasons(fit: LensFit, c: int) -> list[Reason]:
    looks, told = _looks(fit, c)
    if looks >= FEW_BLOCKS:
        return []
    text = f"{told}, too few to show how far their errors are alike: sigmas take them as chance; record {FEW_BLOCKS} or more"
    return [Reason(Verdict.CHECK, f"{fit.views[c].camera}: {text}")]


def _too_few_looks(fit: LensFit, c: int) -> str:
    """Say why the views cannot tell a lens at all, or nothing."""
    looks, told = _looks(fit, c)
    if looks < MIN_LOOKS:
        return (
            f"the lens is not observable: {told}, at least {MIN_LOOKS} are needed; "
            "record 15 s or more with the board tilted 30 to 45 deg in all directions"
        )
    seen = orientations(fit.problem, fit, c)
    if seen.count < MIN_LOOKS:
        return (
            f"the lens is not observable: the board was always seen from nearly one side (normals within {np.degrees(seen.spread):.1f} "
            f"deg), so focal length and distance cannot be told apart; tilt the board 30 to 45 deg in all directions"
        )
    return ""


def _better_model(camera: str, model: str, scores: Sequence[ModelScore]) -> list[Reason]:
    mine = next((score for score in scores if score.model == model), None)
    if mine is None or mine.within or not mine.error_px > _WORSE_MODEL * scores[0].error_px:
        return []
    return [Reason(Verdict.CHECK, f"{camera}: {scores[0].model} fits this lens better: {_compared(mine, scores[0])}")]


def _wrong_model(fit: LensFit, c: int, scores: Sequence[ModelScore]) -> list[Reason]:
    """Say that the model is wrong where another errs by far less, what its residuals look like, and which to take."""
    views, camera = fit.problem.cameras[c], fit.views[c].camera
    mine = next((score for score in scores if score.model == views.model.name), None)
    if mine is None or mine.within or not mine.error_px > _WRONG_MODEL * scores[0].error_px:
        return []
    share, why = _radial_share(fit, c), ""
    if share > _RADIAL:
        lacks = "bends otherwise than its coefficients can" if len(views.model.parameter_names) > 4 else "has no distortion coefficients"
        why = f"it {lacks}, and {share:.0%} of the residuals' squares are one radial pattern around the image's centre; "
    text = f"{mine.model} is the wrong model for this lens: {why}{_compared(mine, scores[0])}; use --model {scores[0].model}"
    return [Reason(Verdict.FAIL, f"{camera}: {text}")]


def _compared(mine: ModelScore, best: ModelScore) -> str:
    return f"on held-out views {mine.model} errs by {mine.error_px:.2f} px, {best.model} by {best.error_px:.2f} px"


def _radial_share(fit: LensFit, c: int) -> float:
    """Return which share of the squares of all found corners' residuals rings around the principal point make: sum n_k m_k^2 / sum |r|^2.

    m_k is the mean radial residual of ring k, the rings of equal width; a corner counts with _RADIAL_MOST px at most.
    """
    _, every = fit.residuals(c)
    found = fit.observed[c] & every.seen
    arm = fit.problem.cameras[c].uv[found] - fit.state.lenses[c][2:4]
    px = every.px[found]
    px = px * np.minimum(1, _RADIAL_MOST / np.maximum(np.linalg.norm(px, axis=-1), 1e-12))[:, None]
    radius = np.linalg.norm(arm, axis=-1)
    radial = np.sum(px * arm, axis=-1) / np.maximum(radius, 1e-9)
    ring = np.minimum((radius / max(float(radius.max(initial=0)), 1e-9) * _RINGS).astype(int), _RINGS - 1)
    total, count = np.bincount(ring, radial, _RINGS), np.bincount(ring, minlength=_RINGS)
    return float(np.sum(total**2 / np.maximum(count, 1)) / max(float(np.sum(px**2)), 1e-12))


def _no_model_fits(camera: str, scores: Sequence[ModelScore]) -> list[Reason]:
    """Say that the board, not the lens, is wrong where every lens model errs alike."""
    best = min(scores, key=lambda score: score.error_px, default=None)
    if best is None or not best.error_px > _NO_MODEL_PX:
        return []
    text = f"no lens model fits, the best errs by {best.error_px:.2f} px on held-out views"
    causes = "check rows, columns and spacing in the target file; else the board is bent, or the images smeared by motion"
    return [Reason(Verdict.FAIL, f"{camera}: {text}: {causes}")]


def _involved(effect: PixelEffect, cov: Array) -> NDArray[np.bool_]:
    """Return which parameters the weakest motion moves by much of their sigma."""
    share = np.abs(effect.weakest) / np.sqrt(np.diag(cov))
    moved: NDArray[np.bool_] = share > 0.7 * share.max()
    return moved


def _frame_reasons(fit: LensFit, c: int) -> list[Reason]:
    camera = fit.views[c].camera
    bad = [view for view in fit.dropped if view.camera == camera]
    total = len(bad) + fit.views[c].n_frames
    if len(bad) <= _DROPPED_FRAMES * total:
        return []
    named = "; ".join(f"{view.label}: {view.why}" for view in bad[:3]) + ("; ..." if len(bad) > 3 else "")
    return [
        Reason(Verdict.CHECK, f"{camera}: {len(bad)} of {counted(total, 'view')} {'was' if len(bad) == 1 else 'were'} given up ({named})")
    ]


def _direction_reasons(fit: LensFit, c: int, variance_factor: float, cov: Array, effect: PixelEffect) -> list[Reason]:
    """Name what the lens's weakest motion moves, and the view that would help it most."""
    known = grade(effect.weakest_px)
    if known == "determined":
        return []
    names = np.array(fit.problem.cameras[c].model.parameter_names)[_involved(effect, cov)]
    # How far the lens has gone along that motion, as a row vector on the lens.
    advice = best_view(fit, c, cov, np.linalg.pinv(cov, rcond=1e-12, hermitian=True) @ effect.weakest, variance_factor)
    remedy = f"; add views with {advice.text} (ten of them: {advice.sigma_ratio:.0%} of today's sigma)" if advice else ""
    verdict = Verdict.CHECK if known == "weak" else Verdict.FAIL
    together = "together are" if len(names) > 1 else "is"
    text = f"{', '.join(names)} {together} {known}: pixels at the outermost corners are known to {effect.weakest_px:.1f} px{remedy}"
    return [Reason(verdict, f"{fit.views[c].camera}: {text}")]


def _extrapolation_reasons(camera: str, views: CameraViews, lens: Array, projection: ProjectionSigma) -> list[Reason]:
    """Name the part of the image where a point's pixel is not known, and whether a board was there: a part that the lens sees."""
    regions = [region_of(uv, views.image_size) for uv in projection.uv]
    in_view = np.isin(regions, list(seen_regions(views, lens))) & np.isfinite(projection.sigma)
    sigma = np.where(in_view, projection.sigma, -1.0)
    worst = int(np.argmax(sigma))
    if sigma[worst] <= _EXTRAPOLATED_PX:
        return []
    empty = "" if projection.seen[worst] else " (no board was seen there)"
    text = f"{regions[worst]} of the image{empty}: a point's pixel is known to {sigma[worst]:.1f} px only; bring the board there"
    return [Reason(Verdict.CHECK, f"{camera}: {text}")]
