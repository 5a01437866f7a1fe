"""Hand-eye in the images: what corners say, honest sigmas of both setups, wrong poses and corners, robots of every kind, a free lens."""

import json
import re
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import Run
from numpy.typing import NDArray
from scipy.stats import chi2

from calibkit.data.observations import BoardViews
from calibkit.data.rig import Camera, Estimate, Rig
from calibkit.data.transforms import make_covariance
from calibkit.data.verdict import Status, Verdict
from calibkit.estimation.board_poses import board_poses
from calibkit.estimation.hand_eye import HandEyeFit, Settings, calibrate_hand_eye
from calibkit.estimation.hand_eye_data import of_recording
from calibkit.estimation.hand_eye_images import corners_of
from calibkit.estimation.hand_eye_noise import RobotNoise
from calibkit.geometry import se3, so3
from calibkit.io.rig_file import load_rig, save_rig
from calibkit.io.target_file import dump_target
from calibkit.models.board import AprilGrid, Board, Checkerboard
from calibkit.models.cameras import CAMERAS
from calibkit.simulation.camera import SimCamera, random_board_poses
from calibkit.simulation.corners import views_of_poses

Array = NDArray[np.float64]
SIM = SimCamera(CAMERAS["pinhole-radtan"], np.array([461.2, 459.8, 366.7, 247.9, -0.28, 0.07, 2e-4, 2e-5]), (752, 480))
GRID = AprilGrid(6, 6, 0.088, 0.3)
SETUPS = ("eye-in-hand", "eye-to-hand")
REACH = 1.0  # m
NOISE_PX = 0.2
ROBOT = RobotNoise(np.deg2rad(0.05), 3e-4)
FAST, SLOW = 5, 100


def seeds(fast: int = FAST, slow: int = SLOW) -> list:
    return [pytest.param(fast, id=f"{fast} seeds"), pytest.param(slow, id="all seeds", marks=pytest.mark.slow)]


def lens(params: Array = SIM.params, cov: Array | None = None) -> Camera:
    names = SIM.model.parameter_names
    return Camera(
        resolution=SIM.size,
        model=SIM.model.name,
        parameters={name: Estimate(value=float(v), status=Status.GIVEN) for name, v in zip(names, params, strict=True)},
        covariance=None if cov is None else make_covariance(names, cov),
    )


def recorded(
    setup: str, seed: int, n: int = 20, robot: RobotNoise = ROBOT, noise_px: float = NOISE_PX, board: Board = GRID
) -> tuple[Array, Array, BoardViews, np.random.Generator]:
    """X, an arm's poses T_base_gripper with noise, at REACH from its base on average, and the corners in its images."""
    rng = np.random.default_rng(seed)
    T = random_board_poses(SIM, board, n, rng, fill=(0.4, 0.8))
    views, _ = views_of_poses(SIM, board, T, rng, noise_px)
    X, fixed = (se3.make(so3.exp(rng.normal(size=3)), 0.1 * rng.normal(size=3)) for _ in range(2))
    G = fixed @ se3.inverse(T) @ se3.inverse(X) if setup == "eye-in-hand" else X @ T @ se3.inverse(fixed)
    away = rng.normal(size=3)
    base = se3.make(np.eye(3), REACH * away / np.linalg.norm(away) - G[:, :3, 3].mean(axis=0))
    noise = np.concatenate([robot.translation * rng.normal(size=(n, 3)), robot.rotation * rng.normal(size=(n, 3))], axis=1)
    return X if setup == "eye-in-hand" else base @ X, se3.retract(base @ G, noise), views, rng


def solve(
    setup: str, G: Array, views: BoardViews, camera: Camera | None = None, free: bool = False, robot: RobotNoise | None = None
) -> tuple[HandEyeFit, HandEyeFit]:
    """The fit in the images, and that of board poses with their covariance."""
    camera = camera or lens()
    poses = board_poses(views, camera)
    data = of_recording(setup, G[poses.frame], poses.T_cam_board, poses.cov)
    settings = Settings(methods=False, robot=robot)
    return calibrate_hand_eye(data, settings, corners_of(views, poses, camera, free)), calibrate_hand_eye(data, settings)


def error(fit: HandEyeFit, X: Array) -> Array:
    return se3.local(X, fit.X)


def assert_honest(errors: list[Array], covs: list[Array], slow: bool) -> None:
    """STYLE test 6: 99.9 % chi-squared bands; a few seeds tell of a gross lie only."""
    z = np.array([e / np.sqrt(np.diag(cov)) for e, cov in zip(errors, covs, strict=True)])
    rms = np.sqrt(np.mean(z**2, axis=0))
    size = len(errors[0])
    pooled = float(np.sqrt(np.mean([e @ np.linalg.solve(cov, e) / size for e, cov in zip(errors, covs, strict=True)])))
    print("rms of error / sigma", rms.round(2), "pooled", round(pooled, 3))
    each, together = (np.sqrt(chi2.ppf([0.0005, 0.9995], len(z)) / len(z)), (0.8, 1.25)) if slow else ((0.1, 2.1), (0.6, 1.5))
    assert np.all((rms > each[0]) & (rms < each[1]))
    assert together[0] < pooled < together[1]


# ---- what corners say


def test_corners_measure_each_pose_and_how_it_follows_the_lens() -> None:
    """Q from corners linearised off the optimum is the view's own best pose; with another lens it moves by -K d."""
    _, _, views, rng = recorded("eye-in-hand", 0, 6)
    poses = board_poses(views, lens())
    corners = corners_of(views, poses, lens())
    M = se3.inverse(poses.T_cam_board)
    sight = corners.at(M)
    np.testing.assert_allclose(se3.local(M, sight.Q), 0, rtol=0, atol=1e-7)
    of_M = se3.adjoint(poses.T_cam_board) @ poses.cov @ np.swapaxes(se3.adjoint(poses.T_cam_board), 1, 2)
    np.testing.assert_allclose(sight.cov, of_M, rtol=0, atol=1e-5 * np.abs(of_M).max())  # of the step before the last
    near = corners.at(se3.retract(M, 1e-4 * rng.normal(size=(6, 6))))
    np.testing.assert_allclose(se3.local(sight.Q, near.Q), 0, rtol=0, atol=1e-6)
    step = np.array([1e-2] * 4 + [1e-5] * 4)
    for k in range(8):
        d = np.zeros(8)
        d[k] = step[k]
        there, back = (replace(corners, lens=corners.lens + sign * d).at(M) for sign in (1, -1))
        moved = se3.local(back.Q, there.Q) / (2 * d[k])
        np.testing.assert_allclose(moved, -sight.K[:, :, k], rtol=0, atol=2e-3 * np.abs(sight.K[:, :, k]).max())


def test_the_lens_score_is_the_slope_of_what_views_leave() -> None:
    _, _, views, _ = recorded("eye-in-hand", 1, 6)
    off = SIM.params + np.array([0.5, -0.5, 0.3, 0.2, 1e-3, -1e-3, 1e-4, 1e-4])
    poses = board_poses(views, lens(off))
    corners = corners_of(views, poses, lens(off), free=True)

    def left(params: Array) -> float:
        now, M = replace(corners, lens=params), se3.inverse(poses.T_cam_board)
        for _ in range(4):
            M = now.at(M).Q
        return now.at(M).chi2

    score = corners.at(se3.inverse(poses.T_cam_board)).score.sum(axis=0)
    for k, h in enumerate([1e-2] * 4 + [1e-5] * 4):
        d = np.eye(8)[k] * h
        slope = (left(off + d) - left(off - d)) / (2 * h)
        assert slope == pytest.approx(-2 * score[k], rel=1e-3, abs=1e-3 * np.abs(score).max() / 1e3)


# ---- honest, and the same as of poses where these are Gaussian


@pytest.mark.parametrize("setup", SETUPS)
def test_without_noise_x_is_exact(setup: str) -> None:
    X, G, views, _ = recorded(setup, 2, 12, RobotNoise(0, 0), 0.0)
    for robot in (None, ROBOT, RobotNoise(0, 0)):
        fit = solve(setup, G, views, robot=robot)[0]
        assert fit.converged
        np.testing.assert_allclose(fit.X, X, rtol=0, atol=1e-9)


@pytest.mark.parametrize("n_seeds", seeds())
@pytest.mark.parametrize("setup", SETUPS)
def test_sigmas_are_honest(setup: str, n_seeds: int) -> None:
    errors, covs = [], []
    for s in range(n_seeds):
        X, G, views, _ = recorded(setup, s)
        fit = solve(setup, G, views)[0]
        assert fit.converged
        assert fit.lens is None
        errors.append(error(fit, X))
        covs.append(fit.cov_X)
    assert_honest(errors, covs, n_seeds >= SLOW)


@pytest.mark.parametrize("setup", SETUPS)
def test_where_a_view_tells_its_pose_well_images_and_poses_give_the_same(setup: str) -> None:
    """Where residuals do not raise the noise that corners and robot are told to have: images and poses would each tell it by their own."""
    same, told = 0, (ROBOT.rotation, ROBOT.translation)
    for s in range(40):
        if same == 2:
            break
        _, G, views, _ = recorded(setup, s, noise_px=0.05)
        of_images, of_poses = solve(setup, G, views, robot=ROBOT)
        taken = [fit.noise[kind] for fit in (of_images, of_poses) for kind in ("P_rotation", "P_translation")]
        if of_poses.noise["Q_factor"] == 1 and np.allclose(taken, (*told, *told), rtol=1e-6):
            same += 1
            sigma = np.sqrt(np.diag(of_images.cov_X))
            np.testing.assert_array_less(np.abs(se3.local(of_poses.X, of_images.X)), 0.01 * sigma)
            np.testing.assert_allclose(np.sqrt(np.diag(of_poses.cov_X)), sigma, rtol=0.01)
    assert same >= 2


@pytest.mark.parametrize("n_seeds", seeds())
def test_what_the_robots_noise_is_told_to_be_is_taken(n_seeds: int) -> None:
    errors, covs = [], []
    for s in range(n_seeds):
        robot = RobotNoise(np.deg2rad(0.1), 1e-4)
        X, G, views, _ = recorded("eye-to-hand", s, 12, robot)
        fit = solve("eye-to-hand", G, views, robot=robot)[0]
        assert robot.rotation <= fit.noise["P_rotation"] < 1.6 * robot.rotation  # residuals may raise it
        assert robot.translation <= fit.noise["P_translation"] < 1.6 * robot.translation
        errors.append(error(fit, X))
        covs.append(fit.cov_X)
    assert_honest(errors, covs, n_seeds >= SLOW)


@pytest.mark.parametrize("n_seeds", seeds())
def test_exact_poses_of_an_exact_robot(n_seeds: int) -> None:
    errors, covs = [], []
    for s in range(n_seeds):
        X, G, views, _ = recorded("eye-in-hand", s, 20, RobotNoise(0, 0))
        fit = solve("eye-in-hand", G, views, robot=RobotNoise(0, 0))[0]
        assert fit.kept.all()
        errors.append(error(fit, X))
        covs.append(fit.cov_X)
    assert_honest(errors, covs, n_seeds >= SLOW)


def test_exact_poses_of_a_robot_that_is_not_cost_accuracy() -> None:
    """What --robot-noise exact is warned of: rms over seeds, against the robot's own noise told by the residuals."""
    off = {"told": 0.0, "exact": 0.0}
    for s in range(FAST):
        X, G, views, _ = recorded("eye-in-hand", s, 20, RobotNoise(np.deg2rad(0.1), 5e-4))
        off["told"] += float(np.sum(error(solve("eye-in-hand", G, views)[0], X)[3:] ** 2))
        off["exact"] += float(np.sum(error(solve("eye-in-hand", G, views, robot=RobotNoise(0, 0))[0], X)[3:] ** 2))
    assert off["exact"] > 1.5**2 * off["told"]


# ---- robust


@pytest.mark.parametrize("n_seeds", seeds(3))
@pytest.mark.parametrize("setup", SETUPS)
def test_thirty_per_cent_wrong_robot_poses_are_left_out(setup: str, n_seeds: int) -> None:
    errors, covs = [], []
    for s in range(n_seeds):
        X, G, views, rng = recorded(setup, s, 30)
        wrong = rng.permutation(30)[:9]
        G[wrong] = G[np.roll(wrong, 1)]
        fit = solve(setup, G, views)[0]
        assert not fit.kept[wrong].any()
        assert fit.converged
        errors.append(error(fit, X))
        covs.append(fit.cov_X)
    assert_honest(errors, covs, n_seeds >= SLOW)


def test_wrong_corners_are_given_up() -> None:
    for s in range(3):
        _, G, views, rng = recorded("eye-in-hand", s)
        clean = solve("eye-in-hand", G, views)[0]
        wrong = rng.permutation(len(views.uv))[: len(views.uv) // 20]
        uv = views.uv.copy()
        uv[wrong] += rng.uniform(5, 40, (len(wrong), 2))
        fit = solve("eye-in-hand", G, replace(views, uv=uv))[0]
        assert fit.refined.corners is not None
        given_up = np.sum((fit.refined.corners.found > 0) & (fit.refined.corners.grid.weight == 0))
        assert len(wrong) <= given_up < len(wrong) + 0.01 * len(uv)
        # Without 5 % of the corners X moves by sqrt(5 %) sigma where their noise is all there is.
        assert np.all(np.abs(se3.local(clean.X, fit.X)) < 4 * np.sqrt(0.05) * np.sqrt(np.diag(clean.cov_X)))


# ---- robots whose places contradict their turns


@pytest.mark.parametrize("n_seeds", seeds())
def test_white_noise_is_seldom_taken_for_an_arm_out_of_shape(n_seeds: int) -> None:
    """One in a hundred by intention."""
    flagged = [solve(setup, *recorded(setup, s, 16)[1:3])[0].by_reach for setup in SETUPS for s in range(n_seeds)]
    assert np.mean(flagged) <= 0.05


@pytest.mark.parametrize("n_seeds", seeds())
def test_an_arm_out_of_shape_is_found_out_and_its_places_count_less(n_seeds: int) -> None:
    """Places turned by 0.1 deg against the turns: no residual shows it, X's R is half of it off."""
    off, flagged = np.zeros((n_seeds, 2)), 0
    quiet = RobotNoise(np.deg2rad(0.03), 1e-4)
    for s in range(n_seeds):
        X, G, views, rng = recorded("eye-in-hand", s, 28, quiet)
        axis, middle = rng.normal(size=3), G[:, :3, 3].mean(axis=0)
        G[:, :3, 3] = middle + (G[:, :3, 3] - middle) @ so3.exp(np.deg2rad(0.1) * axis / np.linalg.norm(axis))
        told, white = solve("eye-in-hand", G, views)[0], solve("eye-in-hand", G, views, robot=quiet)[0]
        off[s] = [np.linalg.norm(error(fit, X)[3:]) for fit in (told, white)]
        assert told.converged
        flagged += told.by_reach
    print("flagged", flagged / n_seeds, "rms deg", np.degrees(np.sqrt(np.mean(off**2, axis=0))))
    assert flagged > n_seeds / 2
    assert np.sum(off[:, 0] ** 2) < 0.6 * np.sum(off[:, 1] ** 2)


# ---- the lens


@pytest.mark.parametrize("n_seeds", seeds(slow=200))
@pytest.mark.parametrize("setup", SETUPS)
def test_a_free_lens_finds_its_focal_length_and_both_sigmas_are_honest(setup: str, n_seeds: int) -> None:
    wrong = SIM.params * np.array([1.005, 1.005, 1, 1, 1, 1, 1, 1])
    errors, covs, lens_errors, lens_covs, held = [], [], [], [], []
    for s in range(n_seeds):
        X, G, views, _ = recorded(setup, s)
        fit = solve(setup, G, views, lens(wrong), free=True)[0]
        assert fit.converged
        assert fit.lens is not None
        assert fit.refined.corners is not None
        errors.append(error(fit, X))
        covs.append(fit.cov_X)
        lens_errors.append(fit.refined.corners.lens - SIM.params)
        lens_covs.append(fit.lens.cov)
        held.append(error(solve(setup, G, views, lens(wrong))[0], X))
    assert_honest(errors, covs, n_seeds >= SLOW)
    assert_honest(lens_errors, lens_covs, n_seeds >= SLOW)
    assert np.sqrt(np.mean(np.square(lens_errors)[:, :2])) < 0.5  # px, of 2.3
    assert np.sum(np.square(errors)) < np.sum(np.square(held))


@pytest.mark.parametrize("n_seeds", seeds(4, 50))
def test_a_free_lens_holds_what_the_detector_always_errs_by(n_seeds: int) -> None:
    """A bias of each part of the image that no number of images averages out, told and not."""
    bias, z = 0.1, {True: [], False: []}
    for s in range(n_seeds):
        _, G, views, rng = recorded("eye-in-hand", s, noise_px=0.1)
        patch = np.clip(views.uv / views.image_size * (4, 3), 0, (3, 2)).astype(int)
        field = bias * rng.normal(size=(4, 3, 2))
        views = replace(views, uv=(views.uv + field[patch[:, 0], patch[:, 1]]).astype(views.uv.dtype))
        for told, off in z.items():
            fit = solve("eye-in-hand", G, replace(views, sigma_bias_px=bias * told), lens(), free=True)[0]
            assert fit.lens is not None
            assert fit.refined.corners is not None
            off.append((fit.refined.corners.lens - SIM.params) / np.sqrt(np.diag(fit.lens.cov)))
    with_it, without = (np.sqrt(np.mean(np.square(z[told]))) for told in (True, False))
    print("error over sigma", with_it, "without the bias", without)
    assert 0.5 < with_it < 1.5
    assert without > 1.4 * with_it


def with_a_rigs_lens(free: bool, n_seeds: int) -> tuple[list[Array], list[Array]]:
    """Errors and covariances of X where the lens is off by draws of its covariance."""
    cov = np.diag(np.array([1.0, 1.0, 1.0, 1.0, 3e-3, 3e-3, 2e-4, 2e-4]) ** 2)
    errors, covs = [], []
    for s in range(n_seeds):
        X, G, views, rng = recorded("eye-in-hand", s, 12)
        params = SIM.params + np.sqrt(np.diag(cov)) * rng.normal(size=8)
        fit = solve("eye-in-hand", G, views, lens(params, cov), free)[0]
        assert fit.lens is not None
        errors.append(error(fit, X))
        covs.append(fit.cov_X)
    return errors, covs


@pytest.mark.parametrize("n_seeds", seeds())
def test_a_free_lens_keeps_to_what_the_rig_knows_of_it(n_seeds: int) -> None:
    assert_honest(*with_a_rigs_lens(True, n_seeds), n_seeds == SLOW)


@pytest.mark.parametrize("n_seeds", seeds())
def test_a_held_lens_brings_its_covariance_on_the_safe_side(n_seeds: int) -> None:
    """What a wrong lens leaves over counts as noise, too: X's sigma is up to 1.7 times too wide, never too small."""
    errors, covs = with_a_rigs_lens(False, n_seeds)
    rms = np.sqrt(np.mean(np.square(errors) / np.array([np.diag(cov) for cov in covs]), axis=0))
    print("rms of error / sigma", rms.round(2))
    assert np.all(rms < (1.24 if n_seeds == SLOW else 2.1))
    assert np.all(rms > 1 / 1.8 if n_seeds == SLOW else 0.1)


# ---- fast


def test_28_images_of_408_corners_take_less_than_a_second() -> None:
    X, G, views, _ = recorded("eye-in-hand", 0, 28, board=Checkerboard(24, 17, 0.015, 0.015))
    poses = board_poses(views, lens())
    data = of_recording("eye-in-hand", G, poses.T_cam_board, poses.cov)
    start = time.thread_time()
    fit = calibrate_hand_eye(data, Settings(methods=False), corners_of(views, poses, lens()))
    assert time.thread_time() - start < 1.0  # CPU seconds; 0.15 on a quiet machine
    assert np.linalg.norm(error(fit, X)[:3]) < 1e-3


# ---- the command


def files(folder: Path, views: BoardViews, G: Array, camera: Camera) -> tuple[object, ...]:
    """A corner file, one pose a row, the board and a rig with the lens; and the command's words for them."""
    t_ns = 10**18 + 10**9 * np.arange(views.n_frames)
    lines = [f"{t_ns[f]},{c // 4},{c % 4},{u:.6f},{v:.6f}" for f, c, (u, v) in zip(views.frame, views.corner, views.uv, strict=True)]
    (folder / "corners.csv").write_text("\n".join(["t [ns],tag_id,corner_idx,u [px],v [px]", *lines]) + "\n")
    (folder / "poses.txt").write_text("".join(" ".join(f"{x:.12f}" for x in T.ravel()) + "\n" for T in G))
    (folder / "target.yaml").write_text(dump_target(views.board))
    save_rig(Rig(cameras={"cam0": camera}), folder / "lens.yaml")
    named = {name: folder / file for name, file in (("--poses", "poses.txt"), ("--target", "target.yaml"), ("--rig", "lens.yaml"))}
    return (folder / "corners.csv", *(word for pair in named.items() for word in pair))


def test_the_command_frees_the_lens_and_writes_it_as_asked_for(run: Run, tmp_path: Path) -> None:
    X, G, views, _ = recorded("eye-in-hand", 0)
    wrong = SIM.params * np.array([1.005, 1.005, 1, 1, 1, 1, 1, 1])
    asked = files(tmp_path, views, G, lens(wrong, np.diag((1e-3 * np.abs(SIM.params)) ** 2)))
    held, free = tmp_path / "held.yaml", tmp_path / "free.yaml"
    said = run("handeye", *asked, "-o", held)
    assert said.code == 0, said
    assert "the lens held, its covariance in X's" in said.out
    assert load_rig(held).cameras == load_rig(tmp_path / "lens.yaml").cameras
    said = run("handeye", *asked, "--free-intrinsics", "-o", free, "--json", tmp_path / "h.json")
    assert said.code == 0, said
    assert "cam0, with its lens free: fx 463.506 -> 46" in said.out
    camera = load_rig(free).cameras["cam0"]
    fx = camera.parameters["fx"]
    assert fx.value is not None
    assert fx.sigma is not None
    assert abs(fx.value - 461.2) < 4 * fx.sigma < 2
    assert camera.covariance is not None
    assert camera.reprojection is not None
    assert camera.reprojection.rms_px == pytest.approx(NOISE_PX * np.sqrt(2), rel=0.1)
    assert "as asked for (--free-intrinsics)" in camera.reasons[0]
    assert any("the lens of these images is not the rig's" in reason for reason in camera.reasons)
    assert camera.verdict is Verdict.CHECK
    assert np.linalg.norm(se3.local(X, np.array(load_rig(free).transforms["T_gripper_cam0"].matrix))[:3]) < 1e-3
    refined = json.loads((tmp_path / "h.json").read_text())["facts"]["handeye"]["refinement"]
    assert refined["in_images"]
    assert refined["free_intrinsics"]
    # The same images again: what the rig knows of the lens is theirs, and counts once.
    again = tmp_path / "again.yaml"
    assert run("handeye", *asked[:-1], free, "--free-intrinsics", "-o", again).code == 0
    assert load_rig(again).cameras["cam0"].parameters["fx"].sigma > 0.8 * fx.sigma


def test_the_command_takes_a_robots_noise_and_says_where_it_is_not_exact(run: Run, tmp_path: Path) -> None:
    _, G, views, _ = recorded("eye-in-hand", 0)
    asked = files(tmp_path, views, G, lens())
    given = run("handeye", *asked, "--robot-noise", "0.6,0.1")
    assert given.code == 0, given
    assert "the robot turned by 0.1 deg, the robot placed by 0.6 mm" in given.out
    fine = run("handeye", *asked, "--robot-noise", "0.05,0.005")
    assert "20 of 20 poses used" in fine.out
    assert re.search("CHECK T_gripper_cam0: the robot's turns err by (8|9|1.) times what --robot-noise states", fine.out), fine.out
    exact = run("handeye", *asked, "--robot-noise", "exact")
    assert exact.code == 0, exact
    assert "CHECK T_gripper_cam0: with exact robot poses the corners are off by" in exact.out
    for words, mistake in (
        (("--robot-noise", "0.3"), "write auto, exact, or MM,DEG"),
        (("--robot-noise", "-1,0.1"), "write auto, exact, or MM,DEG"),
        (("--robot-noise", "nan,0.1"), "write auto, exact, or MM,DEG"),
    ):
        assert mistake in run("handeye", *asked, *words).mistake
    pairs = ("--pairs", tmp_path / "poses.txt", "--pairs", tmp_path / "poses.txt")
    assert "needs images of a board" in run("handeye", *pairs, "--free-intrinsics").mistake
    assert "leave it out of --setup motion" in run("handeye", *pairs, "--setup", "motion", "--robot-noise", "exact").mistake
