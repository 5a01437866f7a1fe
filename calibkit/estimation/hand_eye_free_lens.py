"""The camera's entry where its lens was estimated with X: what these views tell of it, and whether it is still the rig's."""

from dataclasses import replace

import numpy as np
from scipy import special

from calibkit.data.result import Result
from calibkit.data.rig import Camera, Estimate, Reprojection
from calibkit.data.transforms import make_covariance
from calibkit.data.verdict import Reason, Status, Verdict, worst
from calibkit.estimation.hand_eye import HandEyeFit
from calibkit.estimation.hand_eye_images import Corners
from calibkit.estimation.hand_eye_lens import LensEffect
from calibkit.estimation.lens_trust import pixel_effect
from calibkit.models.cameras import CAMERAS
from calibkit.solver.trust import grade

_CHANCE = 1e-3  # of lenses that have not moved are told to have


def with_free_lens(result: Result, fit: HandEyeFit, found: Corners, lens: LensEffect, name: str, camera: Camera) -> Result:
    """Return the result with the camera `name` as the refinement has it, in place of the rig's, and what is to be said of it."""
    names = CAMERAS[camera.model].parameter_names
    effect = pixel_effect(found.grid, found.lens, lens.cov).parameters
    statuses = [Status(grade(float(px))) for px in effect]
    sigmas, plain = (np.sqrt(np.diag(cov)) for cov in (lens.cov, lens.plain))
    units = ("px",) * 4 + ("",) * (len(names) - 4)
    parameters = {
        key: Estimate(value=None, unit=unit, status=status)
        if status is Status.NOT_OBSERVABLE
        else Estimate(value=float(v), unit=unit, sigma=float(s), sigma_plain=float(s_plain), status=status)
        for key, unit, status, v, s, s_plain in zip(names, units, statuses, found.lens, sigmas, plain, strict=True)
    }
    unknown = tuple(f"{name}.{key}" for key, status in zip(names, statuses, strict=True) if status is Status.NOT_OBSERVABLE)
    reasons = _lens_reasons(name, found, lens, unknown)
    rms, rms_all = found.rms(fit.refined.M)
    used, seen = int(np.sum(found.grid.weight > 0)), int(np.sum(found.found > 0))
    texts = [f"estimated with {' and '.join(result.rig.transforms)}, as asked for (--free-intrinsics)"]
    entry = camera.model_copy(
        update={
            "parameters": parameters,
            "covariance": None if unknown else make_covariance(names, lens.cov),
            "reprojection": Reprojection(
                rms_px=rms, rms_all_px=rms_all, corners=used, corners_dropped=seen - used, frames=len(found.found)
            ),
            "verdict": worst(reasons),
            "reasons": [*texts, *(reason.text for reason in reasons)],
        }
    )
    moves = ", ".join(
        f"{key} {old:.6g} -> {new:.6g} +- {sigma:.2g}" for key, old, new, sigma in zip(names, found.start, found.lens, sigmas, strict=True)
    )
    lines = [*list(result.facts["lines"]), f"{name}, with its lens free: {moves}"]  # type: ignore[call-overload]
    return replace(
        result,
        rig=result.rig.model_copy(update={"cameras": {**result.rig.cameras, name: entry}}),
        reasons=(*result.reasons, *reasons),
        facts={**result.facts, "lines": lines, "lens": {name: {"before": found.start.tolist(), "after": found.lens.tolist()}}},
        not_observable=(*result.not_observable, *unknown),
    )


def _lens_reasons(name: str, found: Corners, lens: LensEffect, unknown: tuple[str, ...]) -> tuple[Reason, ...]:
    """Return that views do not tell the lens, or that it is another than the rig's by more than both their sigmas allow."""
    reasons = [Reason(Verdict.FAIL, f"{', '.join(unknown)}: not observable by these views: leave out --free-intrinsics")] if unknown else []
    cov = lens.cov if found.covariance is None else lens.cov + found.covariance
    d = found.lens - found.start
    chi2 = float(d @ np.linalg.pinv(cov, hermitian=True, rcond=1e-15) @ d)
    if chi2 > special.chdtri(len(d), _CHANCE):
        text = f"{name}: the lens of these images is not the rig's: freed, it moves by {np.sqrt(chi2 / len(d)):.2g} times its sigmas"
        reasons.append(Reason(Verdict.CHECK, f"{text}; was the focus or the zoom touched?"))
    return tuple(reasons)
