"""A hand-eye calibration for machines: everything in SI units."""

from collections.abc import Mapping

import numpy as np

from calibkit.estimation.hand_eye import HandEyeFit
from calibkit.estimation.hand_eye_asked import Asked
from calibkit.estimation.hand_eye_compared import Method
from calibkit.estimation.hand_eye_doubts import Suspect
from calibkit.estimation.hand_eye_known import doubted
from calibkit.estimation.hand_eye_lines import weakest_sigmas, worst_pairs
from calibkit.geometry.so3 import Array


def facts(
    fit: HandEyeFit, asked: Asked, wrong: tuple[Suspect, ...], predicted: Array | None, fixed: str, contradicted: bool
) -> dict[str, object]:
    """Return everything in SI units, for machines."""
    data, spectrum = fit.data, fit.spectrum
    statuses = {part: doubted(status) if contradicted else status for part, status in fit.statuses.items()}
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
        "status": {part: status.value for part, status in statuses.items()},
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
            "sigma_p": weakest_sigmas(predicted)[0],
            "sigma_R": weakest_sigmas(predicted)[1],
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
