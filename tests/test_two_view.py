"""Turns of a camera without a board: exact without noise, honest with it, whatever stands before the camera."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from calibkit.data.observations import FeatureTracks
from calibkit.data.rig import Camera, Estimate
from calibkit.data.verdict import Status
from calibkit.errors import BadInputError
from calibkit.estimation import epipolar
from calibkit.estimation.turns import Turns
from calibkit.estimation.two_view import turns_of_tracks
from calibkit.geometry import so3
from calibkit.simulation.features import Scene, simulate_tracks
from calibkit.simulation.scenarios import SCENARIOS
from calibkit.simulation.session import START_NS, Session, simulate_session
from calibkit.simulation.truth import true_rig

Array = NDArray[np.float64]
NEAR, FAR, WALL = Scene(), Scene(near=50, far=500), Scene(kind="wall")


def session(seed: int, duration_s: float = 8.0, name: str = "cam-imu", **changes: Any) -> Session:
    """About 1 rad/s before a camera of 20 Hz."""
    scenario = SCENARIOS[name]
    camera = replace(scenario.cameras[0], rate_hz=20.0)
    return simulate_session(replace(scenario, duration_s=duration_s, cameras=(camera,), **changes), seed)


def lens(run: Session) -> Camera:
    return true_rig(run, "test").cameras["cam0"]


def poses(run: Session, turns: Turns) -> tuple[Array, Array]:
    """T_world_cam at the stamps of turns, and the camera's rate in its own axes."""
    sim = run.scenario.cameras[0]
    state = run.trajectory.at((turns.t_ns - START_NS) * 1e-9 + sim.dt_imu_cam)
    return state.T_world_imu @ sim.T_imu_cam, state.omega_i @ sim.T_imu_cam[:3, :3]


def errors(run: Session, turns: Turns) -> Array:
    R = poses(run, turns)[0][:, :3, :3]
    out: Array = turns.angle - so3.log(np.swapaxes(R[turns.first], -1, -2) @ R[turns.last])
    return out


def covariance(turns: Turns) -> Array:
    """Of all turns together, (3 n, 3 n): adjacent ones share the noise of the frame between them."""
    assert turns.own_cov is not None
    assert turns.end_cov is not None
    n, k = len(turns.first), np.arange(len(turns.first))
    out = np.zeros((n, n, 3, 3))
    out[k, k] = turns.own_cov + turns.end_cov[turns.first] + turns.end_cov[turns.last]
    joined = np.flatnonzero(turns.joined)
    out[joined, joined - 1] = out[joined - 1, joined] = -turns.end_cov[turns.first[joined]]
    return out.transpose(0, 2, 1, 3).reshape(3 * n, 3 * n)


def whitened(run: Session, turns: Turns) -> Array:
    out: Array = np.linalg.solve(np.linalg.cholesky(covariance(turns)), errors(run, turns).ravel())
    return out


def time_offset(run: Session, turns: Turns, white: bool = False) -> tuple[float, float]:
    """The time offset that the turns' errors look like, beside a gyro bias, and its sigma."""
    rate = poses(run, turns)[1]
    J = (rate[turns.last] - rate[turns.first]).ravel()[:, None]
    A = np.concatenate([J, (turns.duration[:, None, None] * np.eye(3)).reshape(-1, 3)], axis=1)
    W = np.eye(len(A)) if white else np.linalg.inv(covariance(turns))
    P = np.linalg.inv(A.T @ W @ A)
    return float((P @ A.T @ W @ errors(run, turns).ravel())[0]), float(P[0, 0] ** 0.5)


@pytest.mark.parametrize("name", ["cam-imu", "fisheye-imu"])
def test_exact_without_noise(name: str) -> None:
    run = session(0, 4.0, name)
    turns = turns_of_tracks(simulate_tracks(run, noise_px=0.0), lens(run))
    assert len(turns.first) == 79
    assert np.array_equal(turns.last, turns.first + 1)
    assert np.array_equal(turns.t_ns, run.tracks[0].stamp_ns)
    assert np.abs(errors(run, turns)).max() < 1e-8


def honest(scene: Scene, seeds: int, **noise: float) -> tuple[Array, Array, float]:
    """Whitened errors of all turns, the time offset's normalised errors, and the share of pairs that gave a turn."""
    white, offsets, given = [], [], []
    for seed in range(seeds):
        run = session(seed)
        turns = turns_of_tracks(simulate_tracks(run, scene=scene, **noise), lens(run))
        offset, sigma = time_offset(run, turns)
        white.append(whitened(run, turns))
        offsets.append(offset / sigma)
        given.append(len(turns.first) / (len(turns.t_ns) - 1))
    return np.concatenate(white), np.array(offsets), float(np.mean(given))


@pytest.mark.parametrize(
    ("scene", "noise", "least"),
    [
        (NEAR, {}, 0.95),
        (NEAR, {"noise_px": 0.1, "drift_px": 0.3}, 0.95),  # as a tracker errs that goes from frame to frame
        (NEAR, {"outliers": 0.15}, 0.9),
        (Scene(2.0, 10.0), {}, 0.2),  # in steps of up to four frames
    ],
    ids=["near", "drift", "wrong tracks", "farther"],
)
def test_errors_are_as_large_as_stated(scene: Scene, noise: dict[str, float], least: float) -> None:
    white, _, given = honest(scene, 2, **noise)
    assert 0.8 < np.sqrt(np.mean(white**2)) < 1.25
    assert given > least


@pytest.mark.slow
def test_time_offset_is_honest_over_seeds() -> None:
    white, offsets, _ = honest(NEAR, 30)
    assert 0.8 < np.sqrt(np.mean(white**2)) < 1.25
    assert 0.60 < np.sqrt(np.mean(offsets**2)) < 1.44


def test_noise_of_a_frame_is_shared_by_its_two_turns_and_a_trackers_steps_are_not() -> None:
    run = session(1)
    shares = []
    for noise in ({"noise_px": 0.3}, {"noise_px": 0.02, "drift_px": 0.4}):
        turns = turns_of_tracks(simulate_tracks(run, **noise), lens(run))
        assert turns.own_cov is not None
        assert turns.end_cov is not None
        # About the optical axis, which no translation hides: the share of a turn's variance that is its first frame's.
        ends, own = np.median(turns.end_cov[turns.first, 2, 2]), np.median(turns.own_cov[:, 2, 2])
        shares.append(ends / (own + 2 * ends))
    assert shares[0] > 0.3  # 0.5 if all points were in both pairs, and the line across them the same
    assert shares[1] < 0.05


def test_steps_are_longer_where_one_frame_has_no_parallax() -> None:
    steps = []
    for scene in (NEAR, Scene(6, 30), FAR):
        run = session(0)
        turns = turns_of_tracks(simulate_tracks(run, scene=scene), lens(run))
        steps.append(float(np.median(turns.duration)) * 20)
        assert np.sqrt(np.mean(whitened(run, turns) ** 2)) < 1.25
        assert time_offset(run, turns)[1] < 0.15e-3
    assert steps[0] == pytest.approx(1)
    assert steps[1] >= 2


def test_turning_on_the_spot_and_distant_scenes_need_no_translation() -> None:
    run = session(0, motion="single-axis")
    turns = turns_of_tracks(simulate_tracks(run, scene=FAR), lens(run))
    assert len(turns.first) > 0.9 * len(turns.t_ns)
    assert np.sqrt(np.mean(errors(run, turns) ** 2)) < 3e-4  # 0.3 px of 200 points, f = 460 px: 0.7e-4
    assert np.sqrt(np.mean(whitened(run, turns) ** 2)) < 1.25


def test_a_wall_has_two_solutions_and_no_turn_is_taken_from_the_wrong_one() -> None:
    run = session(0, 20.0)
    turns = turns_of_tracks(simulate_tracks(run, scene=WALL), lens(run))
    assert 0.25 < len(turns.first) / len(turns.t_ns) < 0.75
    assert np.sqrt(np.mean(whitened(run, turns) ** 2)) < 1.25
    assert turns.own_cov is not None
    assert turns.end_cov is not None
    cov = turns.own_cov + turns.end_cov[turns.first] + turns.end_cov[turns.last]
    sigmas = np.linalg.norm(np.linalg.solve(np.linalg.cholesky(cov), errors(run, turns)[..., None])[..., 0], axis=-1)
    assert np.mean(sigmas > 5) < 0.02  # the other solution is off by 10 to 60


def test_plain_method_is_biased_beside_near_things_only() -> None:
    offsets = {}
    for name, scene in (("wall", WALL), ("far", FAR)):
        run = session(1, 20.0)
        turns = turns_of_tracks(simulate_tracks(run, scene=scene), lens(run), plain=True)
        offsets[name] = time_offset(run, turns, white=True)[0]
    assert 0.3e-3 < abs(offsets["wall"]) < 5e-3
    assert abs(offsets["far"]) < 0.05e-3
    run = session(1, 20.0)
    offset, sigma = time_offset(run, turns_of_tracks(simulate_tracks(run, scene=WALL), lens(run)))
    assert abs(offset) < min(4 * sigma, 0.4e-3)


def test_derivatives() -> None:
    rng = np.random.default_rng(0)
    p, n, h = 3, 40, 1e-6
    first, R = rng.normal(size=(p, 3, n)) * 0.3 + np.array([0, 0, 1.0])[:, None], so3.exp(0.1 * rng.normal(size=(p, 3)))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    last = np.swapaxes(R, -1, -2) @ (first + 0.02 * rng.normal(size=first.shape))
    J = rng.normal(size=(p, 2, 3, n))
    J -= np.einsum("pkcn,pcn->pkn", J, first)[:, :, None] * first[:, None]
    m = epipolar.Matches(first, last, J, np.ones((p, n)), np.zeros((p, n), np.intp))
    t = rng.normal(size=(p, 3))
    t /= np.linalg.norm(t, axis=-1, keepdims=True)
    basis = epipolar.tangent_basis(t)
    analytic = epipolar.jacobian(epipolar.residuals(m, R, t), basis)
    for k in range(5):
        ends = []
        for step in (h, -h):
            R_k, t_k = (so3.exp(step * np.eye(3)[k]) @ R, t) if k < 3 else (R, t + step * basis[..., k - 3])
            ends.append(epipolar.residuals(m, R_k, t_k).across)
        numeric = (ends[0] - ends[1]) / (2 * h)
        assert np.allclose(analytic[:, k], numeric, atol=1e-5 * np.abs(numeric).max()), (k, analytic[:, k], numeric)


def test_chunks_leave_no_seam(monkeypatch: pytest.MonkeyPatch) -> None:
    run = session(0, 4.0)
    tracks = simulate_tracks(run)
    whole = turns_of_tracks(tracks, lens(run))
    monkeypatch.setattr("calibkit.estimation.two_view._CHUNK", 20)
    parts = turns_of_tracks(tracks, lens(run))
    both, k, j = np.intersect1d(whole.first, parts.first, return_indices=True)
    assert len(both) > 75
    assert whole.end_cov is not None
    assert parts.end_cov is not None
    # Which tracks count as right is asked in each chunk by itself.
    assert np.median(np.abs(whole.angle[k] - parts.angle[j])) < 1e-6
    assert np.median(np.abs(whole.end_cov[20] - parts.end_cov[20])) < 0.1 * np.abs(whole.end_cov[20]).max()
    assert np.trace(parts.end_cov[20]) > 0


def with_tracks(tracks: FeatureTracks, rows: NDArray[np.generic]) -> FeatureTracks:
    return replace(tracks, frame=tracks.frame[rows], track=tracks.track[rows], uv=tracks.uv[rows])


def test_pairs_without_enough_points_are_left_out() -> None:
    run = session(0, 4.0)
    tracks = simulate_tracks(run)
    kept = tracks.frame != 30
    kept &= (tracks.frame != 50) | (np.arange(len(tracks.frame)) % 10 == 0)
    turns = turns_of_tracks(with_tracks(tracks, kept), lens(run))
    assert not {29, 30, 49, 50} & set(turns.first.tolist())
    assert len(turns.first) > 70


def test_points_that_tell_nothing_give_no_turn() -> None:
    run = session(0, 2.0)
    tracks = simulate_tracks(run)
    noise = np.random.default_rng(0).uniform(0, 480, tracks.uv.shape)
    for uv in (np.full_like(tracks.uv, 200.0), noise, tracks.uv + 1e6):
        with pytest.raises(BadInputError, match="no two frames share enough features"):
            turns_of_tracks(replace(tracks, uv=uv), lens(run))


def test_a_camera_at_rest_turns_by_no_more_than_its_noise() -> None:
    run = session(0, 4.0, motion="static")
    turns = turns_of_tracks(simulate_tracks(run), lens(run))
    assert np.sqrt(np.mean(whitened(run, turns) ** 2)) < 1.25
    assert np.abs(turns.angle).max() < 1e-3


def test_bad_input_is_one_line() -> None:
    run = session(0, 2.0)
    tracks = simulate_tracks(run)
    with pytest.raises(BadInputError, match="cam0: the images are 640x480, the camera in the rig file is 752x480"):
        turns_of_tracks(replace(tracks, image_size=(640, 480)), lens(run))
    with pytest.raises(BadInputError, match="no two frames share enough features"):
        turns_of_tracks(with_tracks(tracks, tracks.frame % 2 == 0), lens(run))
    unknown = lens(run).model_copy(
        update={"parameters": {**lens(run).parameters, "fx": Estimate(value=None, status=Status.NOT_OBSERVABLE)}}
    )
    with pytest.raises(BadInputError, match="run calibkit intrinsics first"):
        turns_of_tracks(tracks, unknown)


def test_records_are_checked() -> None:
    tracks = simulate_tracks(session(0, 1.0))
    with pytest.raises(ValueError, match="sorted by frame, then track"):
        with_tracks(tracks, np.arange(len(tracks.frame))[::-1])
    with pytest.raises(ValueError, match="must increase"):
        replace(tracks, t_ns=tracks.t_ns[::-1])
    with pytest.raises(BadInputError, match="not finite"):
        replace(tracks, uv=tracks.uv * np.nan)
