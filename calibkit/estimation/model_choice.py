"""Which lens model fits a camera: judged by the error on views that the fit did not see."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibkit.data.observations import BoardViews
from calibkit.errors import NotConvergedError
from calibkit.estimation.lens_fit import LensFit, fit_lenses, instant_times, refit
from calibkit.geometry.so3 import Array
from calibkit.models.cameras import CAMERAS

_FOLDS = 3
_SEGMENTS = 12  # the recording is cut into these, dealt to the folds in turn: neighbours in time stay together
_VIEWS = 60  # enough to tell models apart
_WORST_PX = 20.0  # what a corner counts at most: one that no pose of a wrong model reaches must not decide alone
_TIE = 1.02  # models closer than this are told apart by nothing that a user would see


@dataclass(frozen=True)
class HeldOut:
    """Errors on held-out views, whose poses alone were fitted."""

    rms_px: float  # over the corners that the fit kept
    error_px: Array  # (f, n) of the first camera, every found corner; inf outside the model's domain, NaN where none was found
    labels: tuple[str, ...]


def held_out(fit: LensFit) -> HeldOut | None:
    """Return the held-out errors of a fit by cross-validation over time, None where there are too few views."""
    m = len(fit.state.T_cam0_board)
    if m < 2 * _FOLDS:
        return None
    rank = np.argsort(np.argsort(instant_times(fit), kind="stable"), kind="stable")
    fold = rank * min(_SEGMENTS, m) // m % _FOLDS
    errors = [np.full(mask.shape, np.nan) for mask in fit.observed]
    for k in range(_FOLDS):
        train = refit(fit, [fold[camera.instant] != k for camera in fit.problem.cameras])
        test = refit(fit, [fold[camera.instant] == k for camera in fit.problem.cameras], lenses_of=train)
        for c, camera in enumerate(fit.problem.cameras):
            _, every = test.residuals(c)
            norms = np.linalg.norm(every.px, axis=-1)
            errors[c][fold[camera.instant] == k] = np.where(every.seen, norms, np.where(test.observed[c], np.inf, np.nan))
    kept = np.concatenate([error[mask] for error, mask in zip(errors, fit.kept, strict=True)])
    kept = kept[np.isfinite(kept)]
    return HeldOut(float(np.sqrt(np.mean(kept**2))), errors[0], fit.views[0].labels)


@dataclass(frozen=True)
class ModelScore:
    """How one model did: error over every corner that any model could keep."""

    model: str
    error_px: float  # rms, each corner counted with 20 px at most
    rms_px: float  # over the corners that it kept itself
    within: bool  # no worse than the best beyond chance


def compare_models(views: BoardViews, models: Sequence[str]) -> list[ModelScore]:
    """Return the models' scores, the one to choose first: of those within chance of the best, the one with the fewest parameters.

    Models that do not converge are left out; raises NotConvergedError when none does.
    """
    few = views.select(np.unique(np.linspace(0, views.n_frames - 1, min(views.n_frames, _VIEWS)).astype(int)))
    few = replace(few, labels=tuple(str(i) for i in range(few.n_frames)))  # stamps may repeat, these do not
    fits: dict[str, LensFit] = {}
    failure: NotConvergedError | None = None
    for model in models:
        try:
            fits[model] = fit_lenses([few], [model], (np.arange(few.n_frames),))
        except NotConvergedError as error:
            failure = error
    results = {model: result for model, fit in fits.items() if (result := held_out(fit)) is not None}
    if not results:
        if failure is not None:
            raise failure
        first = next(iter(fits))
        return [ModelScore(first, np.nan, np.nan, True)]
    per_view = _squares_by_view(few, fits, results)
    means = {model: float(np.mean(squares)) for model, squares in per_view.items()}
    best = min(means, key=lambda model: means[model])

    def within(model: str) -> bool:
        difference = per_view[model] - per_view[best]
        chance = float(np.std(difference) / np.sqrt(max(len(difference), 1)))
        return means[model] <= max(means[best] + chance, means[best] * _TIE**2)

    scores = [ModelScore(m, float(np.sqrt(means[m])), results[m].rms_px, within(m)) for m in results]
    return sorted(scores, key=lambda s: (not s.within, len(CAMERAS[s.model].parameter_names) if s.within else 0, s.error_px))


def _squares_by_view(views: BoardViews, fits: dict[str, LensFit], results: dict[str, HeldOut]) -> dict[str, Array]:
    """Return each model's mean squared error by view, over corners that at least one model kept; labels are the views' numbers."""
    shape = (views.n_frames, len(views.board.points))
    kept = np.zeros(shape, bool)
    errors = {}
    for model, result in results.items():
        rows = [int(label) for label in result.labels]
        kept[rows] |= fits[model].kept[0]
        errors[model] = np.full(shape, _WORST_PX)
        errors[model][rows] = np.fmin(result.error_px, _WORST_PX)
    some = kept.any(axis=1)
    count = kept[some].sum(axis=1)
    return {model: np.sum(np.where(kept, error, 0.0)[some] ** 2, axis=1) / count for model, error in errors.items()}
