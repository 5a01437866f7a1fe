"""The joint estimator's equations: Jacobians against differences, the banded core against dense algebra."""

from collections import Counter
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from calibkit.estimation import joint_places
from calibkit.estimation.camera_problem import CameraViews
from calibkit.estimation.joint_inertial import ImuBeside, ImuRows
from calibkit.estimation.joint_noise import draw
from calibkit.estimation.joint_parts import projected
from calibkit.estimation.joint_places import Places
from calibkit.estimation.joint_problem import Frames, GravityPrior, JointProblem
from calibkit.estimation.joint_state import EXTRAS, IMU_MODEL, M_A, M_G, PHI, CameraState, ImuState, JointState
from calibkit.geometry import se3, so3
from calibkit.geometry.so3 import Array
from calibkit.geometry.spline import Knots
from calibkit.models.cameras import CAMERAS
from calibkit.models.imu import ImuModel
from calibkit.solver.banded import Banded

LENS = np.array([461.2, 459.8, 366.7, 247.9, -0.28, 0.07, 2e-4, 2e-5])
KINDS = ("gyro", "accel", "gyro 1", "accel 1", "camera 0", "camera 1", "walk", "stays")


def small(order: int = 4, extras: tuple[str, ...] = (), seed: int = 0) -> tuple[JointProblem, JointState]:
    """Return a problem of a few knots with two cameras and two IMUs, measurements that nothing fits, and a state."""
    rng = np.random.default_rng(seed)
    knots = Knots(0.0, 0.1, order, 8)
    m = knots.controls
    grid = np.stack(np.meshgrid(np.arange(5) * 0.1, np.arange(4) * 0.1), axis=-1).reshape(-1, 2)
    points = np.concatenate([grid, np.zeros((len(grid), 1))], axis=1)
    imu, other = (
        ImuRows(
            np.sort(rng.uniform(0.05, 0.75, n)),
            rng.standard_normal((n, 3)),
            9 * rng.standard_normal((n, 3)),
            rng.uniform(0.1, 1, 6),
            rng.uniform(0.1, 1, 6),
            rng.random((n, 2)) > 0.1,
        )
        for n in (60, 40)
    )
    R = so3.exp(np.cumsum(0.1 * rng.standard_normal((m, 3)), axis=0)) @ np.diag([1.0, -1.0, -1.0])
    p = np.array([0.2, 0.15, 0.8]) + 0.05 * rng.standard_normal((m, 3))
    cameras, states = [], []
    for f in (9, 7):
        weight = rng.uniform(0.5, 2, (f, len(points))) * (rng.random((f, len(points))) > 0.2)
        uv = rng.uniform(0, 500, (f, len(points), 2))
        cameras.append(Frames(rng.uniform(0.05, 0.7, f), CameraViews(CAMERAS["pinhole-radtan"], np.arange(f), uv, weight, (752, 480))))
        T = se3.make(so3.exp(0.1 * rng.standard_normal(3)), 0.05 * rng.standard_normal(3))
        states.append(CameraState(T, 0.02 * rng.standard_normal(), LENS * (1 + 0.01 * rng.standard_normal(8))))
    models = [
        ImuModel(
            M_a=np.eye(3) + np.tril(0.1 * rng.standard_normal((3, 3))),
            M_g=np.eye(3) + np.tril(0.1 * rng.standard_normal((3, 3))),
            C_g_i=so3.exp(0.1 * rng.standard_normal(3)),
            A_g=0.01 * rng.standard_normal((3, 3)),
        )
        for _ in range(3)
    ]
    free = tuple(name for name in IMU_MODEL if name in extras)
    count = sum(EXTRAS[name] for name in free)
    problem = JointProblem(
        knots,
        points,
        imu,
        tuple(cameras),
        GravityPrior(9.8, 0.02),
        lens_priors=(None, (LENS, np.diag(1 / LENS**2))),
        extras=extras,
        beside=(ImuBeside(other, free, (models[2], np.diag(rng.uniform(1, 5, count))) if free else None),),
    )
    placed = se3.make(so3.exp(rng.standard_normal(3)), 0.2 * rng.standard_normal(3))
    biases = 0.1 * rng.standard_normal((2, m, 6))
    beside = ImuState(placed, 0.02, biases[1], models[1])
    return problem, JointState(R, p, biases[0], tuple(states), np.array([0.3, -9.0, 2.0]), 1.05, models[0], (beside,))


def costs_of(problem: JointProblem, x: JointState) -> Counter[str]:
    costs: Counter[str] = Counter()
    for part in problem.parts(x):
        costs[part.kind] += part.cost
    return costs


def gradient_of(problem: JointProblem, x: JointState, kind: str) -> tuple[Array, Array]:
    core, border = np.zeros(problem.border.knot * problem.knots.controls), np.zeros(problem.border.size)
    for part in problem.parts(x):
        if part.kind == kind:
            q = len(part.offsets)
            np.add.at(core, part.columns, part.N[:, :q, -1])
            np.add.at(border, np.broadcast_to(part.touch, (len(part.first), len(part.touch))), part.N[:, q:-1, -1])
    return core, border


@cache
def slopes(order: int, extras: tuple[str, ...]) -> dict[int, Counter[str]]:
    """Return d cost of each kind by unknowns of every sort, those of the border counted from the end."""
    problem, x = small(order, extras)
    m, knot, p, h = problem.knots.controls, problem.border.knot, problem.border.size, 1e-6
    out = {}
    for index in [*range(2 * knot, 4 * knot), *range(-1, -p - 1, -1)]:
        d_core, d_border = np.zeros(m * knot), np.zeros(p)
        (d_core if index >= 0 else d_border)[index] = h
        before, after = (costs_of(problem, problem.retract(x, sign * d_core.reshape(m, knot), sign * d_border)) for sign in (-1, 1))
        out[index] = Counter({kind: (after[kind] - before[kind]) / (2 * h) for kind in KINDS})
    return out


@pytest.mark.parametrize(("order", "extras"), [(6, ()), (4, tuple(EXTRAS))])
@pytest.mark.parametrize("kind", KINDS)
def test_the_jacobians_are_those_of_differences(order: int, extras: tuple[str, ...], kind: str) -> None:
    """d cost = -2 (J^T r) d for single unknowns of every sort: residuals are far from 0, so a wrong J shows."""
    core, border = gradient_of(*small(order, extras), kind)
    # The walk of turns (stays) takes d log(R^T R') for the difference of perturbations: right for small steps only.
    close = 0.05 if kind == "stays" else 1e-5
    scale = max(np.abs(core).max(), np.abs(border).max())
    for index, slope in slopes(order, extras).items():
        gradient = (core if index >= 0 else border)[index]
        assert -2 * gradient == pytest.approx(slope[kind], rel=close, abs=close * scale), index


def test_jacobians_between_samples_make_the_same_equations(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, x = small(6, (M_G, M_A, PHI))
    rng, n = np.random.default_rng(2), 400
    rows = replace(
        problem.imu,
        t=np.sort(rng.uniform(0.05, 0.75, n)),
        gyro=rng.standard_normal((n, 3)),
        accel=9 * rng.standard_normal((n, 3)),
        keep=rng.random((n, 2)) > 0.1,
    )
    problem, x = replace(problem, imu=rows, loss_scale=4.0), replace(x, imu=replace(x.imu, A_g=np.zeros((3, 3))))
    assert Places.of(problem.knots, *problem.knots.locate(rows.t), True).at is not None
    (cost, system), H = problem.linearize(x), dense(problem, x)
    monkeypatch.setattr(joint_places, "_WORTH", np.inf)
    (exact_cost, exact), exact_H = problem.linearize(x), dense(problem, x)
    root = np.sqrt(np.diag(exact_H))
    off = np.concatenate([(system.gradient_core - exact.gradient_core).ravel(), system.gradient_border - exact.gradient_border])
    assert cost == pytest.approx(exact_cost, rel=1e-12)
    assert np.abs((H - exact_H) / root[:, None] / root).max() < 2e-5
    assert np.abs(off / root).max() < 1e-5 * np.sqrt(cost)  # |J^T r| <= |J| |r|


def test_the_priors_gradient() -> None:
    problem, x = small()
    _, C, g = problem.prior(x)
    assert np.linalg.eigvalsh(C).min() > -1e-9
    m, p, h = problem.knots.controls, problem.border.size, 1e-6
    for index in range(p):
        d = np.eye(p)[index]
        ends = [problem.prior(problem.retract(x, np.zeros((m, problem.border.knot)), sign * h * d))[0] for sign in (-1, 1)]
        assert -2 * g[index] == pytest.approx((ends[1] - ends[0]) / (2 * h), rel=1e-4, abs=1e-3)


def dense(problem: JointProblem, x: JointState) -> Array:
    """Return the whole normal matrix, core first."""
    _, system = problem.linearize(x)
    assert isinstance(system.core, Banded)
    band, size = system.core.ab, system.core.ab.shape[1]
    A = np.zeros((size, size))
    for d in range(len(band)):
        A[np.arange(d, size), np.arange(size - d)] = band[d, : size - d]
    A = np.tril(A) + np.tril(A, -1).T
    B = system.border.reshape(size, -1)
    return np.block([[A, B], [B.T, system.corner]])


def test_the_step_is_that_of_the_dense_equations() -> None:
    problem, x = small()
    _, system = problem.linearize(x)
    H = dense(problem, x)
    core, border, _ = system.step()
    expected = np.linalg.solve(H, np.concatenate([system.gradient_core.ravel(), system.gradient_border]))
    np.testing.assert_allclose(np.concatenate([core.ravel(), border]), expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max())


def test_epochs_add_up_to_the_information_about_the_border() -> None:
    problem, x = small()
    _, system = problem.linearize(x)
    drawn = draw(system, 1)
    H = dense(problem, x)
    p = problem.border.size
    S = np.linalg.inv(np.linalg.inv(H)[-p:, -p:])
    np.testing.assert_allclose(drawn.S, S, rtol=1e-6, atol=1e-9 * np.abs(S).max())
    epochs = [projected(part, drawn.core_answer) for part in problem.parts(x)]
    _, C, g = problem.prior(x)
    np.testing.assert_allclose(sum(S.sum(axis=0) for S, _ in epochs) + C, drawn.S, rtol=1e-6, atol=1e-9 * np.abs(S).max())
    projected_gradient = system.gradient_border - drawn.core_answer.T @ system.gradient_core.ravel()
    np.testing.assert_allclose(sum(score.sum(axis=0) for _, score in epochs) + g, projected_gradient, rtol=1e-6, atol=1e-6)


def test_draws_have_the_inverse_as_covariance() -> None:
    problem, x = small()
    _, system = problem.linearize(x)
    drawn = draw(system, 4000)
    L = np.linalg.cholesky(dense(problem, x))
    white = L.T @ np.concatenate([drawn.core, drawn.border])
    np.testing.assert_allclose(white @ white.T / 4000, np.eye(len(white)), atol=0.1)


def test_a_wrong_sample_hardly_counts_where_the_loss_is_robust() -> None:
    problem, x = small()
    wild = replace(problem.imu, accel=np.where(np.arange(60)[:, None] == 30, 400.0, problem.imu.accel))
    robust = replace(problem, loss_scale=3.0)
    before, after = robust.linearize(x)[0], replace(robust, imu=wild).linearize(x)[0]
    assert after - before < 2 * 9 * np.log(1 + (800 / 0.1) ** 2 / 9)
