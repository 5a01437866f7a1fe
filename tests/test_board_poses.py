"""Board poses under a known lens, and the camera's turns between them: simulated truth, faults, and EuRoC's recording."""

from dataclasses import replace

import numpy as np
import pytest
from lens_samples import GRID, LENSES, board_views, scrambled
from test_intrinsics_real import EUROC, EUROC_SIZE
from test_intrinsics_real import board_views as recorded_views

from calibkit.data.observations import BoardViews
from calibkit.data.rig import Camera, Estimate
from calibkit.data.verdict import Status
from calibkit.errors import BadInputError
from calibkit.estimation import board_poses as module
from calibkit.estimation.board_poses import BoardPoses, board_poses
from calibkit.estimation.board_turns import turns_of_board
from calibkit.estimation.camera_problem import CameraProblem, LensState
from calibkit.estimation.flat_views import FlatViews
from calibkit.estimation.lens_fit import dense_views
from calibkit.geometry import se3, so3
from calibkit.models.board import Checkerboard
from calibkit.models.cameras import CAMERAS
from calibkit.simulation.camera import SimCamera, place_board, random_board_poses
from calibkit.simulation.corners import views_of_poses
from calibkit.simulation.scenarios import SCENARIOS
from calibkit.simulation.session import simulate_session, simulate_views

CHESS = Checkerboard(9, 6, 0.04, 0.04)
LENS = LENSES["pinhole-radtan"]


def given(camera: SimCamera) -> Camera:
    """Return the camera as a rig file gives it."""
    values = zip(camera.model.parameter_names, camera.params, strict=True)
    return Camera(resolution=camera.size, model=camera.model.name, parameters={name: Estimate(value=float(x)) for name, x in values})


def seen(camera: SimCamera, frames: int, seed: int, noise_px: float, board=GRID, **poses: float) -> tuple[BoardViews, np.ndarray]:
    """Return views of random poses, one frame each 50 ms, and their T_cam_board."""
    rng = np.random.default_rng(seed)
    T = random_board_poses(camera, board, frames, rng, **poses)
    views, truth = views_of_poses(camera, board, T, rng, noise_px, np.arange(1, frames + 1) * 50_000_000)
    return views, truth.T_cam_board


def errors(poses: BoardPoses, truth: np.ndarray) -> np.ndarray:
    """Return d with T_true exp(d) = T, (f, 6)."""
    return se3.local(truth[poses.frame], poses.T_cam_board)


def whitened(d: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """Return d (f, k) in units of its covariance: unit variance where that is right."""
    return np.linalg.solve(np.linalg.cholesky(cov), d[:, :, None])[:, :, 0]


@pytest.mark.parametrize("name", list(LENSES))
def test_without_noise_the_poses_are_the_true_ones(name):
    views, truth = seen(LENSES[name], 100, 0, 0.0)
    poses = board_poses(views, given(LENSES[name]))
    assert not poses.dropped
    assert poses.kept.all()
    assert np.abs(errors(poses, truth)).max() < 1e-9
    assert poses.sigma_px < 1e-6
    assert np.all(np.linalg.eigvalsh(poses.cov) > 0)


@pytest.mark.parametrize("name", list(LENSES))
def test_errors_are_as_large_as_the_covariance_says(name):
    views, truth = seen(LENSES[name], 300, 1, 0.2)
    poses = board_poses(replace(views, sigma_px=np.full(len(views.uv), 0.05)), given(LENSES[name]))  # the detector was too sure
    assert len(poses.t_ns) >= 298
    z = whitened(errors(poses, truth), poses.cov)
    assert 0.9 < np.sqrt(np.mean(z**2)) < 1.1  # 1800 numbers
    normalised = errors(poses, truth) / np.sqrt(np.einsum("fii->fi", poses.cov))
    assert np.all((np.sqrt(np.mean(normalised**2, axis=0)) > 0.86) & (np.sqrt(np.mean(normalised**2, axis=0)) < 1.14))  # 99.9 % of 300
    assert poses.sigma_px == pytest.approx(0.2, rel=0.01)


def test_what_the_record_says_of_its_frames_is_what_the_corners_say():
    views, _ = seen(LENS, 40, 2, 0.3)
    few = views.frame != 7
    few[np.flatnonzero(~few)[:5]] = True
    views = replace(views, frame=views.frame[few], corner=views.corner[few], uv=views.uv[few], sigma_px=views.sigma_px[few])
    poses = board_poses(views, given(LENS))
    assert poses.camera == "cam0"
    assert [(d.camera, d.label, d.why) for d in poses.dropped] == [("cam0", "frame 7", "fewer than 6 corners")]
    assert poses.labels == tuple(views.labels[i] for i in poses.frame)
    assert np.array_equal(poses.t_ns, views.t_ns[poses.frame])
    assert not poses.kept[views.frame == 7].any()
    for i, frame in enumerate(poses.frame):
        rows = poses.kept & (views.frame == frame)
        uv = LENS.model.project(se3.transform(poses.T_cam_board[i], GRID.points[views.corner[rows]]), LENS.params).uv
        assert poses.n_corners[i] == rows.sum()
        assert poses.rms[i] == pytest.approx(np.sqrt(np.mean(np.sum((views.uv[rows] - uv) ** 2, axis=1))), rel=1e-9)


def test_poses_are_the_least_squares_of_the_kept_corners_to_second_order():
    views, _ = seen(LENS, 60, 3, 0.5)
    poses = board_poses(views, given(LENS))
    grid = dense_views(views, "pinhole-radtan", np.arange(views.n_frames))
    kept = np.zeros(grid.weight.shape, bool)
    kept[views.frame, views.corner] = poses.kept
    problem = CameraProblem(GRID.points, (replace(grid, weight=np.where(kept, 1.0, 0.0)),), free_lens=False, free_rig=False)
    _, system = problem.linearize(LensState((LENS.params,), np.eye(4)[None], poses.T_cam_board))
    rest = np.linalg.norm(whitened(system.core.solve(system.gradient_core[:, :, None])[:, :, 0], poses.cov), axis=1)
    assert rest.max() < 1e-3


@pytest.mark.parametrize("name", ["pinhole-radtan", "pinhole-equi"])
def test_the_linearised_normal_equations_are_the_derivatives_of_the_squares(name):
    camera = LENSES[name]
    views = board_views(camera, 5, 4, 2.0)
    grid = dense_views(views, name, np.arange(5))
    flat = FlatViews.under(grid, camera.params, GRID.points)
    found = board_poses(views, given(camera)).T_cam_board
    T = se3.retract(found, 0.02 * np.random.default_rng(0).standard_normal((5, 6)))

    def cost(T):
        return flat.squares(T).sum(axis=1)

    A, g = flat.normal(T, np.ones_like)
    step = 1e-5 * np.eye(6)
    numeric = np.stack([(cost(se3.retract(T, d)) - cost(se3.retract(T, -d))) / 2e-5 for d in step], axis=1)
    assert -2 * g == pytest.approx(numeric, rel=1e-5, abs=1e-5 * np.abs(numeric).max()), (-2 * g, numeric)
    problem = CameraProblem(GRID.points, (grid,), free_lens=False, free_rig=False)
    _, system = problem.linearize(LensState((camera.params,), np.eye(4)[None], found))
    exact = np.linalg.inv(system.core.solve(np.tile(np.eye(6), (5, 1, 1))))
    scale = np.sqrt(np.einsum("fii->fi", exact))
    A, _ = flat.normal(found, np.ones_like)
    near = (A - exact) / scale[:, :, None] / scale[:, None, :]
    assert np.abs(near).max() < 0.02  # the lens is linearised 2 px beside


@pytest.mark.parametrize("name", list(LENSES))
def test_wrong_corners_change_nothing(name):
    clean, truth = seen(LENSES[name], 120, 5, 0.2)
    views, wrong = scrambled(clean, 0.15, 6)
    poses = board_poses(views, given(LENSES[name]))
    assert not poses.dropped
    taking_part = np.isin(views.frame, poses.frame)
    assert not np.any(poses.kept & wrong)
    assert np.mean(poses.kept[taking_part & ~wrong]) > 0.999
    assert 0.9 < np.sqrt(np.mean(whitened(errors(poses, truth), poses.cov) ** 2)) < 1.1
    assert poses.sigma_px == pytest.approx(0.2, rel=0.02)


def test_a_blurred_frame_has_its_own_sigma_and_a_hopeless_one_is_dropped():
    views, truth = seen(LENS, 60, 7, 0.2, fill=(0.4, 0.9))
    rng = np.random.default_rng(8)
    uv = views.uv.copy()
    for frame, extra in ((10, 0.8), (20, 8.0)):
        uv[views.frame == frame] += extra * rng.standard_normal((np.sum(views.frame == frame), 2))
    poses, clean = board_poses(replace(views, uv=uv), given(LENS)), board_poses(views, given(LENS))
    assert [d.label for d in poses.dropped] == ["frame 20"]
    assert "times worse than usual" in poses.dropped[0].why
    at, was = np.flatnonzero(poses.frame == 10)[0], np.flatnonzero(clean.frame == 10)[0]
    assert 2 < np.sqrt(poses.cov[at, 5, 5] / clean.cov[was, 5, 5]) < 5  # 0.82 px / 0.2 px / 1.5 = 2.7
    assert np.linalg.norm(whitened(errors(poses, truth), poses.cov)[at]) < 6
    assert poses.sigma_px == pytest.approx(0.2, rel=0.03)


def test_corners_on_one_line_are_no_pose():
    views, _ = seen(LENS, 30, 9, 0.2, CHESS)
    row = (views.frame != 4) | (views.corner < 9)
    views = replace(views, frame=views.frame[row], corner=views.corner[row], uv=views.uv[row], sigma_px=views.sigma_px[row])
    poses = board_poses(views, given(LENS))
    assert [d.label for d in poses.dropped] == ["frame 4"]


def orientation_errors(poses: BoardPoses, truth: np.ndarray) -> np.ndarray:
    """Return the angle between found and true orientation in units of its largest sigma."""
    return np.linalg.norm(errors(poses, truth)[:, 3:], axis=1) / np.sqrt(np.linalg.eigvalsh(poses.cov[:, 3:, 3:])[:, -1])


@pytest.mark.parametrize(("board", "fill"), [(CHESS, (0.04, 0.06)), (CHESS, (0.06, 0.1)), (Checkerboard(4, 3, 0.04, 0.04), (0.06, 0.1))])
def test_a_small_far_board_is_never_taken_for_its_reflection(board, fill):
    views, truth = seen(LENS, 500, 10, 0.2, board, fill=fill, max_tilt=1.1)
    poses = board_poses(views, given(LENS))
    ambiguous = [d for d in poses.dropped if "ambiguous" in d.why]
    assert len(ambiguous) > 20
    assert len(poses.t_ns) > 100
    assert orientation_errors(poses, truth).max() < 6


def test_a_near_board_is_never_ambiguous():
    views, truth = seen(LENS, 300, 11, 0.2, CHESS, fill=(0.2, 0.7), max_tilt=1.1)
    poses = board_poses(views, given(LENS))
    assert not [d for d in poses.dropped if "ambiguous" in d.why]
    assert orientation_errors(poses, truth).max() < 6


def test_a_recording_posed_in_slabs_has_the_same_poses(monkeypatch):
    views, _ = scrambled(seen(LENS, 50, 12, 0.2)[0], 0.05, 1)
    whole = board_poses(views, given(LENS))
    monkeypatch.setattr(module, "_SLAB_POINTS", 7 * 144)
    slabs = board_poses(views, given(LENS))
    assert np.array_equal(whole.frame, slabs.frame)
    assert np.array_equal(whole.kept, slabs.kept)
    assert np.linalg.norm(whitened(se3.local(whole.T_cam_board, slabs.T_cam_board), whole.cov), axis=1).max() < 0.05
    assert slabs.cov == pytest.approx(whole.cov, rel=0.02)


def without(camera: Camera, name: str) -> Camera:
    return camera.model_copy(update={"parameters": {**camera.parameters, name: Estimate(value=None, status=Status.NOT_OBSERVABLE)}})


@pytest.mark.parametrize(
    ("camera", "said"),
    [
        (without(given(LENS), "k2"), ["no value for k2", "calibkit intrinsics"]),
        (given(replace(LENS, size=(640, 480))), ["640 x 480", "752 x 480", "rig file"]),
        (given(replace(LENS, params=LENS.params * [-1, 1, 1, 1, 1, 1, 1, 1])), ["fx and fy must be positive"]),
    ],
)
def test_a_lens_that_cannot_be_used_is_refused_in_one_line(camera, said):
    with pytest.raises(BadInputError) as refused:
        board_poses(board_views(LENS, 5, 0), camera)
    text = str(refused.value)
    assert text.startswith("cam0: ")
    assert "\n" not in text
    assert all(part in text for part in said)


def test_views_without_any_pose_are_refused_with_the_commonest_reason():
    views = board_views(LENS, 12, 0)
    rows = views.corner < 5
    few = replace(views, frame=views.frame[rows], corner=views.corner[rows], uv=views.uv[rows], sigma_px=views.sigma_px[rows])
    with pytest.raises(BadInputError, match=r"cam0: no board poses .*6 corners.*check the target file"):
        board_poses(few, given(LENS))
    with pytest.raises(BadInputError, match="no image shows the board"):
        board_poses(views.select(np.zeros(views.n_frames, bool)), given(LENS))
    far, _ = seen(LENS, 8, 1, 0.3, Checkerboard(3, 2, 0.04, 0.04), fill=(0.02, 0.025))
    with pytest.raises(BadInputError, match=r"7 of 8 images: ambiguous.*nearer"):
        board_poses(far, given(LENS))


def moving(noise_px: float, rate_hz: float = 20.0, duration_s: float = 10.0, seed: int = 0):
    """Return a simulated session before a board, its views and their truth."""
    scenario = SCENARIOS["cam-imu"]
    camera = replace(scenario.cameras[0], rate_hz=rate_hz, dt_imu_cam=0.0)
    session = simulate_session(replace(scenario, cameras=(camera,), duration_s=duration_s), seed)
    return session, *simulate_views(session, noise_px)


def test_turns_are_the_cameras_in_its_own_axes():
    session, views, truth = moving(0.0)
    turns = turns_of_board(board_poses(views, given(truth.camera)))
    assert len(turns.first) == views.n_frames - 1
    R_board_cam = np.swapaxes(truth.T_cam_board[:, :3, :3], 1, 2)
    assert so3.exp(turns.angle) == pytest.approx(np.swapaxes(R_board_cam[:-1], 1, 2) @ R_board_cam[1:], abs=1e-9)
    # The gyroscope of a perfect IMU, in camera axes, in the middle of each turn.
    middle = (session.tracks[0].t_true_ns[:-1] + 0.025e9 - session.imu.t_ns[0]) * 1e-9
    omega_c = session.trajectory.at(middle).omega_i @ truth.camera.T_imu_cam[:3, :3]
    assert np.sqrt(np.mean(omega_c**2)) > 0.3
    assert turns.angle / turns.duration[:, None] == pytest.approx(omega_c, abs=0.02)


def test_the_covariance_of_the_orientations_is_in_the_cameras_axes():
    z = []
    for seed in range(40):
        _, views, truth = moving(0.3, duration_s=1.0)
        noise = np.random.default_rng(seed).standard_normal(views.uv.shape)
        poses = board_poses(replace(views, uv=truth.uv + 0.3 * noise), given(truth.camera))
        turns = turns_of_board(poses)
        assert turns.end_cov is not None
        R_true = np.swapaxes(truth.T_cam_board[poses.frame, :3, :3], 1, 2)
        R_found = np.swapaxes(poses.T_cam_board[:, :3, :3], 1, 2)
        e = so3.log(np.swapaxes(R_true, 1, 2) @ R_found)
        z.append(whitened(e, turns.end_cov))
        # The turns themselves: angle = true + e_last - e_first, to first order.
        true = so3.log(np.swapaxes(R_true[:-1], 1, 2) @ R_true[1:])
        assert turns.angle - true == pytest.approx(e[1:] - e[:-1], abs=0.1 * np.abs(e).max())
    z = np.concatenate(z)
    assert len(z) == 800
    assert 0.93 < np.sqrt(np.mean(z**2)) < 1.07  # pooled, 2400 numbers
    assert np.all((np.sqrt(np.mean(z**2, axis=0)) > 0.9) & (np.sqrt(np.mean(z**2, axis=0)) < 1.1))
    assert np.cov(z.T) == pytest.approx(np.eye(3), abs=0.15)


def test_stamps_out_of_order_doubled_or_far_apart_make_no_turns_of_their_own():
    _, views, truth = moving(0.0, duration_s=2.0)
    poses = board_poses(views, given(truth.camera))
    t_ns = poses.t_ns.copy()
    t_ns[5] = t_ns[4]  # the first of the two stays
    t_ns[20:] += 2_000_000_000
    shuffled = np.random.default_rng(0).permutation(len(t_ns))
    shuffled = np.concatenate([shuffled[shuffled != 5], [5]])
    mixed = replace(poses, t_ns=t_ns[shuffled], T_cam_board=poses.T_cam_board[shuffled], cov=poses.cov[shuffled])
    turns, plain = turns_of_board(mixed), turns_of_board(poses)
    assert np.all(np.diff(turns.t_ns) > 0)
    assert len(turns.first) == len(plain.first) - 2
    assert turns.duration.max() < 0.2
    assert turns.angle[:4] == pytest.approx(plain.angle[:4], abs=1e-12)
    whole = so3.exp(plain.angle[4]) @ so3.exp(plain.angle[5])
    assert so3.exp(turns.angle[4]) == pytest.approx(whole, abs=1e-9)
    assert turns.duration[4] == pytest.approx(0.1)


def test_images_without_stamps_make_no_turns():
    poses = board_poses(board_views(LENS, 5, 0), given(LENS))
    with pytest.raises(BadInputError, match="cam0: its images have no stamps"):
        turns_of_board(poses)


def test_euroc(data_dir):
    lens = np.array([458.654, 457.296, 367.215, 248.375, -0.28340811, 0.07395907, 0.00019359, 1.76187114e-05])
    camera = SimCamera(CAMERAS["pinhole-radtan"], lens, EUROC_SIZE)
    views = recorded_views(data_dir / "euroc_imu_april" / "cam0_corners.csv", EUROC, EUROC_SIZE)
    poses = board_poses(views, given(camera))
    print(len(poses.t_ns), "frames, median rms", np.median(poses.rms), "dropped", poses.dropped, "corners given up", np.sum(~poses.kept))
    assert len(poses.t_ns) >= 1400
    assert np.median(poses.rms) <= 0.46
    assert poses.rms.max() < 2
    assert 58 <= np.sum(~poses.kept) < 300
    turns = turns_of_board(poses)
    assert len(turns.first) == len(poses.t_ns) - 2  # one gap of 1.2 s
    # Against the gyroscope, its bias taken out: no turn is a flip (where 15 corners are seen the two poses are 0.9 rad apart).
    imu = np.loadtxt(data_dir / "euroc_imu_april" / "imu0.csv", delimiter=",", skiprows=1)
    t, gyro = (imu[:, 0] - imu[0, 0]) * 1e-9, imu[:, 1:4]
    turned = np.concatenate([np.zeros((1, 3)), np.cumsum(np.diff(t)[:, None] * (gyro[1:] + gyro[:-1]) / 2, axis=0)])
    R_imu_cam = [[0.0148655429818, -0.999880929698, 0.00414029679422], [0.999557249008, 0.0149672133247, 0.025715529948]]
    R_imu_cam = np.array([*R_imu_cam, [-0.0257744366974, 0.00375618835797, 0.999660727178]])
    at = np.stack([np.interp((turns.t_ns - imu[0, 0]) * 1e-9, t, turned[:, k]) for k in range(3)], axis=1)
    d = (at[turns.last] - at[turns.first]) @ R_imu_cam - turns.angle
    d -= np.median(d / turns.duration[:, None], axis=0) * turns.duration[:, None]
    assert np.abs(d).max() < 0.1
    assert np.percentile(np.abs(d), 99.5) < 0.01
    z = whitened(d, turns.end_cov[turns.first] + turns.end_cov[turns.last])
    assert 0.4 < np.median(np.abs(z)) / 0.6745 < 1.2  # neighbours share errors of lens and corners: less than white noise's


def test_the_board_held_upside_down_and_at_an_edge_has_its_pose_too():
    rolls = so3.exp(np.outer(np.linspace(-np.pi, np.pi, 9), [0.0, 0, 1]))
    T = place_board(GRID, rolls @ so3.exp(np.array([0.3, 0.2, 0])), np.array([0.25, -0.1, 0.8]))
    views, truth = views_of_poses(LENS, GRID, T, np.random.default_rng(0), 0.1)
    poses = board_poses(views, given(LENS))
    assert len(poses.t_ns) == 9
    assert orientation_errors(poses, truth.T_cam_board).max() < 5
