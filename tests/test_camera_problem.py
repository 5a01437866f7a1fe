"""The reprojection problem: its gradient and Gauss-Newton blocks against differences of its own residuals, for every model."""

from dataclasses import replace

import numpy as np
import pytest
from lens_samples import LENSES, T_CAM1_CAM0

from calibkit.estimation.camera_problem import CameraProblem, CameraViews, LensState
from calibkit.geometry import se3
from calibkit.models.board import Checkerboard
from calibkit.models.cameras import CAMERAS
from calibkit.simulation.camera import place_board, random_board_poses

BOARD = Checkerboard(6, 4, 0.05, 0.04)
INSTANTS = 3
OFF = 1e-3  # of the state from the truth, relative: the residuals must not vanish


def sample(models: tuple[str, ...], seed: int = 0, **options) -> tuple[CameraProblem, LensState]:
    """A problem of one or two cameras with noise, absent corners and uneven weights, and a state near its minimum.

    The second camera misses the first instant and sees the others in another order.
    """
    rng = np.random.default_rng(seed)
    T_cam_cam0 = np.stack([np.eye(4), T_CAM1_CAM0])[: len(models)]
    sims = [LENSES[model] for model in models]
    T_board = random_board_poses(sims[0], BOARD, INSTANTS, rng, fill=(0.2, 0.35))
    cameras = []
    for c, sim in enumerate(sims):
        instant = np.arange(INSTANTS) if c == 0 else np.array([2, 1])
        p = sim.model.project(se3.transform(T_cam_cam0[c] @ T_board[instant], BOARD.points), sim.params)
        uv = p.uv + 0.3 * rng.normal(size=p.uv.shape)
        weight = np.where(p.valid & (rng.random(p.valid.shape) > 0.2), rng.uniform(1, 5, p.valid.shape), 0.0)
        cameras.append(CameraViews(sim.model, instant, np.where(weight[..., None] > 0, uv, np.nan_to_num(uv)), weight, sim.size))
    state = LensState(tuple(sim.params * (1 + OFF * rng.normal(size=len(sim.params))) for sim in sims), T_cam_cam0, T_board)
    state = CameraProblem(BOARD.points, tuple(cameras)).retract(
        state, OFF * rng.normal(size=(INSTANTS, 6)), np.zeros(sum(len(s.params) for s in sims) + 6 * (len(sims) - 1))
    )
    return CameraProblem(BOARD.points, tuple(cameras), **options), state


def steps(problem: CameraProblem, state: LensState) -> np.ndarray:
    """A step for every unknown, core first, that moves no pixel by more than about 1e-3 px."""
    lenses = [[1e-4] * 4 + [1e-8] * (len(lens) - 4) for lens in state.lenses]
    return np.concatenate([np.full(6 * INSTANTS, 1e-7), *lenses, np.full(6 * (len(problem.cameras) - 1), 1e-7)])


def moved(problem: CameraProblem, state: LensState, index: int, by: float) -> LensState:
    step = np.zeros(6 * INSTANTS + problem.border_size)
    step[index] = by
    return problem.retract(state, step[: 6 * INSTANTS].reshape(-1, 6), step[6 * INSTANTS :])


def stacked(problem: CameraProblem, state: LensState) -> np.ndarray:
    """All residuals in sigmas, the priors' behind the corners', as one vector."""
    corners = [(problem.residuals(state, c).px * camera.weight[..., None]).ravel() for c, camera in enumerate(problem.cameras)]
    priors = [camera.model.prior(lens, camera.reach)[0] for camera, lens in zip(problem.cameras, state.lenses, strict=True)]
    return np.concatenate([*corners, *priors])


def dense(problem: CameraProblem, state: LensState) -> tuple[np.ndarray, np.ndarray]:
    """The arrowhead as one matrix H and gradient g."""
    _, system = problem.linearize(state)
    n = 6 * INSTANTS
    H = np.zeros((n + problem.border_size,) * 2)
    for i in range(INSTANTS):
        H[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = system.core.blocks[i]
    H[:n, n:] = system.border.reshape(n, -1)
    H[n:, :n], H[n:, n:] = H[:n, n:].T, system.corner
    return H, np.concatenate([system.gradient_core.ravel(), system.gradient_border])


RIGS = [*((model,) for model in CAMERAS), ("pinhole-radtan", "pinhole-equi"), ("pinhole-equi", "pinhole-radtan8")]


@pytest.mark.parametrize("loss", [np.inf, 2.0])
@pytest.mark.parametrize("models", RIGS, ids="+".join)
def test_the_gradient_is_the_slope_of_the_cost(models, loss):
    problem, state = sample(models, loss_scale=loss)
    _, g = dense(problem, state)
    slope = np.array(
        [
            (problem.linearize(moved(problem, state, i, h))[0] - problem.linearize(moved(problem, state, i, -h))[0]) / (2 * h)
            for i, h in enumerate(steps(problem, state))
        ]
    )
    np.testing.assert_allclose(-2 * g, slope, rtol=1e-5, atol=1e-6 * np.abs(slope).max())


@pytest.mark.parametrize("models", RIGS, ids="+".join)
def test_the_blocks_are_those_of_the_dense_jacobian(models):
    problem, state = sample(models)
    H, g = dense(problem, state)
    # Columns of the prediction's Jacobian: minus the residual's.
    J = np.stack(
        [
            (stacked(problem, moved(problem, state, i, -h)) - stacked(problem, moved(problem, state, i, h))) / (2 * h)
            for i, h in enumerate(steps(problem, state))
        ],
        axis=1,
    )
    size = np.sqrt(np.diag(H))
    np.testing.assert_allclose(H / size / size[:, None], J.T @ J / size / size[:, None], atol=1e-6)
    np.testing.assert_allclose(g / size, J.T @ stacked(problem, state) / size, rtol=1e-5, atol=1e-6 * np.abs(g / size).max())
    S, scores = problem.information(state)
    n = 6 * INSTANTS
    eliminated = np.linalg.solve(H[:n, :n], np.column_stack([H[:n, n:], g[:n]]))
    schur = np.column_stack([H[n:, n:], g[n:]]) - H[n:, :n] @ eliminated
    _, of_prior, score_of_prior = problem.prior(state.lenses)  # no instant's
    found = np.column_stack([S.sum(axis=0) + of_prior, scores.sum(axis=0) + score_of_prior])
    np.testing.assert_allclose(found, schur, rtol=1e-6, atol=1e-6 * np.abs(schur).max())


def test_an_absent_corner_counts_for_nothing_whatever_stands_in_its_place():
    problem, state = sample(("pinhole-radtan",))
    camera = problem.cameras[0]
    junk = replace(problem, cameras=(replace(camera, uv=np.where(camera.weight[..., None] > 0, camera.uv, 1e6)),))
    assert problem.linearize(state)[0] == junk.linearize(state)[0]
    assert np.array_equal(dense(problem, state)[1], dense(junk, state)[1])
    assert not junk.residuals(state, 0).seen[camera.weight == 0].any()
    assert np.all(junk.residuals(state, 0).px[camera.weight == 0] == 0)


def test_corners_behind_a_pinhole_cost_a_whole_image_and_pull_nothing():
    problem, state = sample(("pinhole-radtan",))
    behind = replace(state, T_cam0_board=state.T_cam0_board.copy())
    behind.T_cam0_board[1] = place_board(BOARD, np.eye(3), np.array([0.0, 0.0, -1.0]))
    cost, system = problem.linearize(behind)
    others = replace(problem, cameras=(replace(problem.cameras[0], weight=problem.cameras[0].weight * [[1.0], [0.0], [1.0]]),))
    lost = problem.cameras[0].weight[1]
    assert cost == pytest.approx(others.linearize(behind)[0] + np.sum((752 * lost) ** 2), rel=1e-12)
    assert cost > problem.linearize(state)[0]
    assert np.all(system.gradient_core[1] == 0)
    assert np.array_equal(system.gradient_border, others.linearize(behind)[1].gradient_border)
    dx, dc, _ = system.step(1e-4)  # an instant without corners stays where it is and breaks nothing
    assert np.all(dx[1] == 0)
    assert np.all(np.isfinite(dc))
    assert not problem.residuals(behind, 0).seen[1].any()


@pytest.mark.parametrize(("free_lens", "free_rig"), [(False, True), (True, False), (False, False)])
def test_what_is_held_does_not_move_and_the_rest_moves_as_if_it_were_a_constant(free_lens, free_rig):
    problem, state = sample(("pinhole-radtan", "pinhole-equi"), free_lens=free_lens, free_rig=free_rig)
    _, system = problem.linearize(state)
    dx, dc, _ = system.step()
    lens = np.arange(problem.border_size) < problem.lens_slices[-1].stop
    held = np.where(lens, not free_lens, not free_rig)
    assert np.all(dc[held] == 0)
    H, g = dense(replace(problem, free_lens=True, free_rig=True), state)
    free = np.concatenate([np.ones(6 * INSTANTS, bool), ~held])
    expected = np.linalg.solve(H[np.ix_(free, free)], g[free])
    np.testing.assert_allclose(np.concatenate([dx.ravel(), dc[~held]]), expected, rtol=1e-6, atol=1e-9)


def test_many_points_in_chunks_and_threads_give_what_few_do():
    problem, state = sample(("pinhole-radtan",))
    camera, times = problem.cameras[0], 1000  # 72000 points: eight chunks, two threads
    many = replace(
        problem,
        cameras=(
            replace(
                camera, instant=np.arange(INSTANTS * times), uv=np.tile(camera.uv, (times, 1, 1)), weight=np.tile(camera.weight, (times, 1))
            ),
        ),
    )
    cost, system = many.linearize(replace(state, T_cam0_board=np.tile(state.T_cam0_board, (times, 1, 1))))
    few_cost, few = problem.linearize(state)
    assert cost == pytest.approx(times * few_cost, rel=1e-12)
    np.testing.assert_allclose(system.corner, times * few.corner, rtol=1e-10)
    np.testing.assert_allclose(system.core.blocks, np.tile(few.core.blocks, (times, 1, 1)), rtol=1e-12)


@pytest.mark.parametrize("lens", ["usual", "near a pole", "beyond a pole"])
def test_the_rational_lens_prior_has_the_slope_it_states(lens):
    params = {"usual": (0.52, -0.03, 0.01), "near a pole": (-1.1, 0.2, 0.0), "beyond a pole": (-3.0, 0.5, 0.1)}[lens]
    model, x = CAMERAS["pinhole-radtan8"], np.array([500.0, 500, 320, 240, 0.3, -0.1, 0, 0, 0.02, *params])
    r, J = model.prior(x, 0.7)
    for k in range(len(x)):
        step = np.zeros(len(x))
        step[k] = 1e-6
        numeric = (model.prior(x + step, 0.7)[0] - model.prior(x - step, 0.7)[0]) / 2e-6
        np.testing.assert_allclose(J[:, k], numeric, rtol=1e-4, atol=1e-6)
    assert np.all(np.isfinite(r))


@pytest.mark.parametrize("model", ["pinhole-radtan", "pinhole-radtan5", "pinhole-equi"])
def test_lenses_whose_coefficients_cannot_cancel_have_no_prior(model):
    lens = CAMERAS[model].seed(500.0, (320.0, 240.0))
    r, J = CAMERAS[model].prior(lens, 0.7)
    assert r.shape == (0,)
    assert J.shape == (0, len(lens))
