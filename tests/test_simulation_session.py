"""Scenarios, faults and the simulate stage: geometry and clocks agree with each other, faults do what they say, files are whole."""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest
from commands import Run

from calibkit.data.transforms import find_transform
from calibkit.errors import BadInputError
from calibkit.geometry import se3
from calibkit.io.recording import open_recording
from calibkit.io.rig_file import load_rig
from calibkit.io.target_file import load_target
from calibkit.models.imu import STANDARD_GRAVITY
from calibkit.simulation.faults import FAULTS, apply_faults
from calibkit.simulation.scenarios import SCENARIOS
from calibkit.simulation.session import START_NS, Session, simulate_session, simulate_views
from calibkit.simulation.truth import true_rig
from calibkit.stages.simulate import simulate

T = TypeVar("T")


def session(name: str = "cam-imu", seed: int = 0) -> Session:
    return simulate_session(SCENARIOS[name], seed)


@pytest.mark.parametrize("name", SCENARIOS)
@pytest.mark.parametrize("seed", range(3))
def test_the_board_stays_in_view(name: str, seed: int) -> None:
    views, _ = simulate_views(session(name, seed))
    seen = np.bincount(views.frame, minlength=views.n_images)
    assert np.mean(seen >= len(views.board.points) / 4) > 0.97


def test_the_sample_bag_covers_the_image_and_tilts() -> None:
    for seed in range(3):
        views, truth = simulate_views(session(seed=seed))
        width, height = views.image_size
        cells, _, _ = np.histogram2d(*views.uv.T, bins=[8, 6], range=[[0, width], [0, height]])
        assert cells.min() >= 10
        middle = se3.transform(truth.T_cam_board, views.board.points.mean(axis=0)[None])[:, 0]
        distance = np.linalg.norm(middle, axis=-1)
        tilt = np.degrees(np.arccos(-np.sum(truth.T_cam_board[:, :3, 2] * middle, axis=-1) / distance))
        assert np.mean(tilt > 25) > 0.2
        assert np.ptp(distance) > 0.3


def test_td_is_added_to_the_cameras_stamps() -> None:
    run = session()
    camera, track = run.scenario.cameras[0], run.tracks[0]
    assert camera.dt_imu_cam == 0.005
    assert np.all(track.t_true_ns == track.stamp_ns + 5_000_000)  # t_imu = t_cam + td
    assert np.all(track.record_ns > track.t_true_ns)
    views, _ = simulate_views(run)
    assert np.array_equal(views.t_ns, track.stamp_ns)


def test_the_camera_sees_the_board_from_where_the_imu_carries_it() -> None:
    run = session()
    track = run.tracks[0]
    T_cam_board = run.T_cam_board(track)
    T_world_imu = run.trajectory.at((track.t_true_ns - START_NS) * 1e-9).T_world_imu
    loop = T_world_imu @ track.camera.T_imu_cam @ T_cam_board
    assert np.abs(loop - run.T_world_board).max() < 1e-12


def test_board_poses_turn_as_the_gyro_says() -> None:
    run = session("stereo-imu")
    imu, camera = run.imu, run.scenario.cameras[1]
    assert imu is not None
    t = START_NS + np.arange(1_000_000_000, 9_000_000_000, 1_000_000)
    T = run.T_cam_board(replace(run.tracks[1], t_true_ns=t))
    omega_cam = se3.local(se3.inverse(T[:-1]), se3.inverse(T[1:]))[:, 3:] / 1e-3
    omega_imu = omega_cam @ camera.T_imu_cam[:3, :3].T
    at_samples = np.stack([np.interp(imu.t_ns, t[:-1] + 500_000, omega_imu[:, k]) for k in range(3)], axis=-1)
    inside = (imu.t_ns > t[1]) & (imu.t_ns < t[-2])
    error = (imu.gyro - at_samples)[inside] - run.scenario.imu.gyro_bias
    assert np.abs(error.mean(axis=0)).max() < 3e-4
    assert error.std() < 1.3 * 1.7e-4 * np.sqrt(200)


def test_the_parts_of_a_run_do_not_disturb_each_other() -> None:
    run = session()
    longer = simulate_session(replace(run.scenario, duration_s=20.0), 0)
    same = longer.T_cam_board(longer.tracks[0])[: len(run.tracks[0].stamp_ns)]
    assert np.abs(run.T_cam_board(run.tracks[0]) - same).max() < 1e-12  # rounding differs with array lengths before numpy 2
    other = session(seed=1)
    assert not np.allclose(run.T_cam_board(run.tracks[0]), other.T_cam_board(other.tracks[0]), atol=0.01)
    noisy, _ = simulate_views(run, noise_px=0.5)
    exact, truth = simulate_views(run, noise_px=0.0)
    assert np.array_equal(exact.uv, truth.uv)
    assert np.std(noisy.uv - truth.uv) == pytest.approx(0.5, rel=0.02)


def test_every_fault_changes_what_is_recorded_and_nothing_true() -> None:
    run = session()
    for name in FAULTS:
        spoilt = apply_faults(run, [name])
        recorded = (
            np.array_equal(spoilt.tracks[0].stamp_ns, run.tracks[0].stamp_ns)
            and np.array_equal(spoilt.imu.t_ns, run.imu.t_ns)
            and np.array_equal(spoilt.imu.accel, run.imu.accel)
            and np.array_equal(spoilt.imu.gyro, run.imu.gyro)
            and spoilt.board_told == run.board_told
        )
        assert not recorded, name
        assert spoilt.scenario == run.scenario
        assert spoilt.trajectory is run.trajectory
        # Frames that remain were truly taken when they were taken.
        assert np.isin(spoilt.tracks[0].t_true_ns, run.tracks[0].t_true_ns).all()
        assert len(spoilt.tracks[0].t_true_ns) == len(spoilt.tracks[0].stamp_ns) == len(spoilt.tracks[0].record_ns)
        assert len(spoilt.imu.t_ns) == len(spoilt.imu_record_ns) == len(spoilt.imu_truth.gyro_bias)


def test_faults_are_as_large_as_they_say() -> None:
    run = session()
    stamps, t = run.tracks[0].stamp_ns, run.imu.t_ns
    image = {name: apply_faults(run, [name]).tracks[0].stamp_ns for name in FAULTS}
    assert 0.8 < len(image["image-drops"]) / len(stamps) < 0.98
    assert np.diff(image["image-gap"]).max() == pytest.approx(3e9, abs=2e8)
    assert np.std(image["image-jitter"] - stamps) == pytest.approx(10e6, rel=0.25)
    assert 0.6 < len(image["image-drops-30"]) / len(stamps) < 0.8
    assert np.std(image["image-jitter-2"] - stamps) == pytest.approx(2e6, rel=0.25)
    assert np.all(image["image-late"] - stamps == 5_000_000_000)
    assert sorted(image["image-stamp"] - stamps)[-2:] == [0, 50_000_000]
    assert np.sum(np.diff(image["duplicate-stamps"]) == 0) == len(stamps) // 20
    assert np.sum(image["zero-stamp"] == 0) == 1
    assert np.all(image["zero-stamps"] == 0)
    assert np.diff(apply_faults(run, ["imu-gap"]).imu.t_ns).max() == pytest.approx(5e8, abs=1e7)
    assert np.sum(apply_faults(run, ["accel-spike"]).imu.accel == 400) == 1
    assert np.allclose(apply_faults(run, ["accel-in-g"]).imu.accel * STANDARD_GRAVITY.value, run.imu.accel)
    assert np.allclose(np.radians(apply_faults(run, ["gyro-in-deg"]).imu.gyro), run.imu.gyro)
    assert apply_faults(run, ["board-size"]).board_told.tag_size == pytest.approx(0.080)
    assert apply_faults(run, ["tag-spacing"]).board_told.spacing == pytest.approx(0.2)
    assert len(t) == 3000


def test_faults_of_the_cameras_clock_change_td_as_they_say() -> None:
    run = session()
    true, n = run.tracks[0].t_true_ns, len(run.tracks[0].t_true_ns)
    seconds = (run.tracks[0].stamp_ns - run.tracks[0].stamp_ns[0]) * 1e-9
    skewed, stepped = (true - apply_faults(run, [name]).tracks[0].stamp_ns for name in ("image-skew", "image-step"))  # td = t_imu - t_cam
    assert np.abs(skewed - (5e6 - 50e3 * seconds)).max() <= 1
    assert np.array_equal(stepped, np.where(np.arange(n) < n / 2, 5_000_000, -28_000_000))
    for name in ("image-skew", "image-step"):
        assert true_rig(apply_faults(run, [name]), name).time_offsets["dt_imu0_cam0"].offset.value == 0.005  # before the fault


def test_truth_of_a_rig_without_imu_is_told_from_the_first_camera() -> None:
    run = simulate_session(replace(SCENARIOS["stereo-imu"], imu=None), 0)
    rig = true_rig(run, "stereo")
    left, right = run.scenario.cameras
    found = find_transform(rig, "cam0", "cam1")
    assert found is not None
    assert np.allclose(left.T_imu_cam @ found[0], right.T_imu_cam)
    assert rig.time_offsets["dt_cam0_cam1"].offset.value == 0.0
    assert not rig.imus


@pytest.mark.parametrize("storage", ["ros1", "mcap", "db3"])
def test_a_recording_comes_back_as_it_was_simulated(storage: str, tmp_path: Path) -> None:
    done = simulate("cam-imu", tmp_path / "out", seed=3, storage=storage, duration_s=1.0)
    recording = open_recording([done.bag])
    run = done.session
    frames = list(recording.images("/cam0/image_raw"))
    assert [frame.t_ns for frame in frames] == run.tracks[0].stamp_ns.tolist()
    assert frames[0].decode().shape == (480, 752)
    imu = recording.imu("/imu0")
    assert np.array_equal(imu.t_ns, run.imu.t_ns)
    assert np.array_equal(imu.gyro, run.imu.gyro)
    assert recording.warnings == []
    assert load_target(done.target) == run.scenario.board
    rig = load_rig(done.truth)
    assert np.allclose(rig.transforms["T_imu0_cam0"].matrix, run.scenario.cameras[0].T_imu_cam)
    assert rig.time_offsets["dt_imu0_cam0"].offset.value == 0.005
    assert [p.value for p in rig.cameras["cam0"].parameters.values()] == run.scenario.cameras[0].params.tolist()
    assert rig.provenance[0].options["seed"] == 3


def test_raw_images_come_back_too(tmp_path: Path) -> None:
    done = simulate("checkerboard", tmp_path, duration_s=1.0)
    frames = list(open_recording([done.bag]).images("/cam0/image_raw"))
    assert len(frames) == 10
    assert frames[0].decode().dtype == np.uint8


def test_two_cameras_share_one_progress(tmp_path: Path) -> None:
    finished = []

    def progress(items: Iterable[T], what: str, total: int | None = None) -> Iterator[T]:
        yield from items
        finished.append((what, total))

    done = simulate("stereo-imu", tmp_path, duration_s=1.0, progress=progress)
    assert finished == [("rendering", 20)]
    recording = open_recording([done.bag])
    assert [len(list(recording.images(f"/cam{i}/image_raw"))) for i in (0, 1)] == [10, 10]


def test_zero_stamps_reach_the_file(tmp_path: Path) -> None:
    done = simulate("cam-imu", tmp_path, duration_s=1.0, faults=["zero-stamps"])
    recording = open_recording([done.bag])
    times = [frame.t_ns for frame in recording.images("/cam0/image_raw")]
    assert times == done.session.tracks[0].record_ns.tolist()  # the reader falls back to record times, and says so
    assert recording.warnings


def test_what_cannot_be_simulated_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("years of work")
    (tmp_path / "file").write_text("")
    refused = [
        (("no-such",), {}, "give one of cam-imu"),
        (("cam-imu",), {"storage": "csv"}, "give one of ros1"),
        (("cam-imu",), {"duration_s": 0.0}, "give 1 to"),
        (("cam-imu",), {"duration_s": float("nan")}, "give 1 to"),
        (("cam-imu",), {"faults": ["gremlins"]}, "give one of image-drops"),
        (("checkerboard",), {"faults": ["tag-spacing"]}, "AprilGrids only"),
        (("cam-imu",), {"faults": ["image-gap"], "duration_s": 2.0}, "longer duration"),
    ]
    for names, options, remedy in refused:
        with pytest.raises(BadInputError, match=remedy):
            simulate(names[0], tmp_path / "new", **options)
    assert not (tmp_path / "new").exists()
    with pytest.raises(BadInputError, match="--force"):
        simulate("cam-imu", tmp_path / "mine")
    with pytest.raises(BadInputError, match="is a file"):
        simulate("cam-imu", tmp_path / "file")
    assert [f.name for f in (tmp_path / "mine").iterdir()] == ["thesis.txt"]


def test_force_replaces_an_earlier_recording_and_nothing_else(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("years of work")
    first = simulate("cam-imu", tmp_path, seed=0, duration_s=1.0, force=True)
    before = first.bag.read_bytes()
    simulate("cam-imu", tmp_path, seed=1, duration_s=1.0, force=True)
    assert first.bag.read_bytes() != before
    simulate("cam-imu", tmp_path, seed=0, duration_s=1.0, force=True)
    assert first.bag.read_bytes() == before
    assert (tmp_path / "thesis.txt").read_text() == "years of work"


def test_the_command(run: Run, tmp_path: Path) -> None:
    code, out, err = run("simulate", "--list")
    assert (code, err) == (0, "")
    assert all(f"  {name} " in out for name in (*SCENARIOS, *FAULTS))

    folder = tmp_path / "out"
    code, out, err = run("simulate", "cam-imu", "-o", folder, "--duration", "1", "--format", "mcap", "--fault", "image-late")
    assert (code, err) == (0, "")
    assert out.splitlines()[0] == "images: 10 of /cam0/image_raw"
    assert sorted(f.name for f in folder.iterdir()) == ["cam_imu", "target.yaml", "truth.yaml"]

    for arguments, line in [
        (("simulate", "cam-imu", "-o", folder), f"{folder}: has something in it"),
        (("simulate", "cam-imu"), "simulate needs a scenario and a folder"),
        (("simulate", "[red]no", "-o", "x"), "there is no scenario [red]no"),
    ]:
        assert run(*arguments).mistake.startswith(line)
