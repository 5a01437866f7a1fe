"""The joint estimate: from the seed through a robust fit to plain least squares with the noise that the residuals show."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibkit.estimation.joint_noise import DRAWS, Component, Drawn, components, draw
from calibkit.estimation.joint_parts import Epochs, Part
from calibkit.estimation.joint_problem import DAMPING, JointProblem
from calibkit.estimation.joint_state import JointState, of_imu
from calibkit.geometry import se3
from calibkit.geometry.so3 import Array
from calibkit.geometry.spline import Steps
from calibkit.solver.arrowhead import Arrowhead
from calibkit.solver.levenberg_marquardt import minimise
from calibkit.solver.robust import scale_of_norms

_LOSS = 4.0  # sigmas
_OUTLIER_CORNER, _OUTLIER_SAMPLE = 4.5, 5.0  # sigmas: of plain noise one corner in 25 000, one sample in 65 000
_ROBUST_ROUNDS = 2
_ROUNDS = 3
_TIGHT = 1e-6  # of the cost: a chi-squared of 0.4 in a minute's data, and the last step gains most of that
_SETTLED = 0.02  # of a sigma's factor
_RAYLEIGH_3 = 1.5382  # median length of three standard normal numbers


@dataclass(frozen=True)
class JointFit:
    """The estimate and what it is judged by."""

    problem: JointProblem  # plain least squares, weights as found, what was given up without weight
    x: JointState
    system: Arrowhead
    drawn: Drawn
    epochs: Epochs
    found: tuple[NDArray[np.bool_], ...]  # (f, n) per camera: corners found
    factors: dict[str, float]  # real sigma over the stated one, by kind
    components: dict[str, Component]  # by the weights as found
    converged: bool
    steps: int


@dataclass(frozen=True)
class RoughFit:
    """Where the robust fit ends."""

    problem: JointProblem  # weights as found
    x: JointState
    found: tuple[Array, ...]  # (f, n) per camera: weights as the detector has them
    factors: dict[str, float]  # real sigma over the stated one, by kind
    steps: int


def fit_roughly(problem: JointProblem, x: JointState) -> RoughFit:
    """Return the robust fit from a start."""
    found = tuple(frames.views.weight for frames in problem.cameras)
    factors: dict[str, float] = {}
    # Wide open first: the seed's IMU sits in the camera.
    solution = minimise(replace(problem, loss_scale=_LOSS * 20), x, max_steps=4, tolerance=1e-3, damping=DAMPING)
    steps = solution.steps
    for _ in range(_ROBUST_ROUNDS):
        scales = _robust_scales(problem, solution.x, found)
        if _settled(scales) and factors:
            break
        problem = _rescaled(problem, scales, factors)
        solution = minimise(replace(problem, loss_scale=_LOSS), solution.x, max_steps=6, tolerance=1e-4, damping=DAMPING)
        steps += solution.steps
    return RoughFit(problem, solution.x, found, factors, steps)


def refine(rough: RoughFit) -> JointFit:
    """Return the maximum-likelihood trajectory and calibration without what the robust fit gave up."""
    found, factors, steps, x = rough.found, dict(rough.factors), rough.steps, rough.x
    problem = _without_outliers(rough.problem, x, found, factors)
    for rest in reversed(range(_ROUNDS)):
        solution = minimise(problem, x, max_steps=20, tolerance=_TIGHT, damping=DAMPING)
        x, steps = solution.x, steps + solution.steps
        parts, system, drawn = _linearised(problem, x)
        spent = components(parts, drawn)
        scales = {kind: part.factor for kind, part in spent.items() if kind not in ("walk", "stays")}
        if not rest or _settled(scales):
            break
        problem = _rescaled(problem, scales, factors)
    kept = tuple(weight > 0 for weight in found)
    return JointFit(problem, x, system, drawn, Epochs.of(parts, drawn.core_answer), kept, factors, spent, solution.converged, steps)


def around(problem: JointProblem, x: JointState) -> tuple[Arrowhead, Drawn, Epochs]:
    """Return the normal equations at x, states drawn from them, and what each epoch says of the border."""
    parts, system, drawn = _linearised(problem, x)
    return system, drawn, Epochs.of(parts, drawn.core_answer)


def _linearised(problem: JointProblem, x: JointState) -> tuple[list[Part], Arrowhead, Drawn]:
    parts = list(problem.parts(x))
    _, system = problem.assembled(parts, x)
    return parts, system, draw(system, DRAWS)


def _settled(scales: dict[str, float]) -> bool:
    return all(abs(np.log(scale)) < _SETTLED for scale in scales.values())


def corner_residuals(problem: JointProblem, x: JointState, c: int) -> tuple[Array, NDArray[np.bool_]]:
    """Return measured minus predicted corners of camera c (f, n, 2) px, and where the model has a prediction (f, n)."""
    frames, camera = problem.cameras[c], x.cameras[c]
    seen = problem.seen(x, Steps.of(x.R), c)
    in_camera = se3.transform(seen.T_cam_board, problem.points)
    shutter = problem.shutter(x, c, seen.twist)
    projection = frames.views.model.project(in_camera if shutter is None else shutter.moved(in_camera), camera.lens)
    return np.where(projection.valid[..., None], frames.views.uv - projection.uv, 0.0), projection.valid


def _robust_scales(problem: JointProblem, x: JointState, found: Sequence[Array]) -> dict[str, float]:
    """Return real over stated sigma of each kind, by the median length of its residuals."""
    scales: dict[str, float] = {}
    for j, rows in enumerate(problem.imus):
        r = problem.imu_residuals(x, j) / rows.sigma
        scales |= {of_imu(kind, j): float(np.median(np.linalg.norm(r[:, part], axis=1)) / _RAYLEIGH_3) for kind, part in _PARTS.items()}
    for c, weight in enumerate(found):
        px, valid = corner_residuals(problem, x, c)
        seen = (weight > 0) & valid
        scales[f"camera {c}"] = scale_of_norms((np.linalg.norm(px, axis=-1) * problem.cameras[c].views.weight)[seen])
    return scales


_PARTS = {"gyro": slice(0, 3), "accel": slice(3, 6)}


def _rescaled(problem: JointProblem, scales: dict[str, float], factors: dict[str, float]) -> JointProblem:
    """Return the problem with sigmas multiplied; `factors` keeps the products."""
    for kind, scale in scales.items():
        factors[kind] = factors.get(kind, 1.0) * scale
    imus = [
        replace(rows, sigma=rows.sigma * np.repeat([scales[of_imu(kind, j)] for kind in _PARTS], 3)) for j, rows in enumerate(problem.imus)
    ]
    cameras = tuple(
        replace(frames, views=replace(frames.views, weight=frames.views.weight / scales[f"camera {c}"]))
        for c, frames in enumerate(problem.cameras)
    )
    return replace(problem.with_imus(imus), cameras=cameras)


def _without_outliers(problem: JointProblem, x: JointState, found: Sequence[Array], factors: dict[str, float]) -> JointProblem:
    """Return the problem without samples and corners that noise does not explain."""
    imus = []
    for j, rows in enumerate(problem.imus):
        r = problem.imu_residuals(x, j) / rows.sigma
        keep = np.stack([np.linalg.norm(r[:, part], axis=1) <= _OUTLIER_SAMPLE for part in _PARTS.values()], axis=1)
        imus.append(replace(rows, keep=keep))
    cameras = []
    for c, (frames, weight) in enumerate(zip(problem.cameras, found, strict=True)):
        px, valid = corner_residuals(problem, x, c)
        fits = valid & (np.linalg.norm(px, axis=-1) * weight <= _OUTLIER_CORNER * factors[f"camera {c}"])
        cameras.append(replace(frames, views=replace(frames.views, weight=np.where(fits, frames.views.weight, 0.0))))
    return replace(problem.with_imus(imus), cameras=tuple(cameras))
