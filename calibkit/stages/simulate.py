"""Simulated recordings: a scenario's name -> a bag, its target.yaml and the truth as a rig file."""

import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calibkit.data.progress import Progress, silent
from calibkit.errors import BadInputError, one_line
from calibkit.io.atomic import write_atomic
from calibkit.io.bag_writer import STORAGES, CompressedPayload, ImuPayload, Sample, Stream, write_bag
from calibkit.io.rig_file import save_rig
from calibkit.io.target_file import dump_target
from calibkit.simulation.faults import apply_faults
from calibkit.simulation.render import Renderer, encode_jpeg
from calibkit.simulation.scenarios import SCENARIOS, Scenario
from calibkit.simulation.session import Session, simulate_session
from calibkit.simulation.truth import true_rig

_LONGEST_S = 4 * 3600.0


@dataclass(frozen=True)
class Simulated:
    """What was written."""

    session: Session
    bag: Path
    target: Path
    truth: Path


def simulate(
    scenario: str,
    out: Path,
    seed: int = 0,
    storage: str = "ros1",
    duration_s: float | None = None,
    faults: Sequence[str] = (),
    force: bool = False,
    progress: Progress = silent,
) -> Simulated:
    """Write a scenario's bag, target.yaml (with its faults) and truth.yaml (without) into the folder `out`."""
    chosen = _choose(scenario, storage, duration_s)
    session = apply_faults(simulate_session(chosen, seed), [*chosen.faults, *faults])
    bag = out / f"{scenario.replace('-', '_')}{STORAGES[storage].suffix}"
    done = Simulated(session, bag, out / "target.yaml", out / "truth.yaml")
    _make_room(out, (done.bag, done.target, done.truth), force)
    images = sum(len(track.stamp_ns) for track in session.tracks)
    # One count for all cameras: their streams are merged by time, and a terminal has room for one bar.
    count = progress(range(images), "rendering", images)
    write_bag(bag, _streams(session, count), storage)
    next(count, None)  # past its end, so that the bar goes
    write_atomic(done.target, dump_target(session.board_told), overwrite=force)
    save_rig(true_rig(session, scenario, faults), done.truth, force)
    return done


def _choose(name: str, storage: str, duration_s: float | None) -> Scenario:
    if name not in SCENARIOS:
        raise BadInputError(f"there is no scenario {one_line(name, 60)}: give one of {', '.join(SCENARIOS)}")
    if storage not in STORAGES:
        raise BadInputError(f"there is no bag format {one_line(storage, 60)}: give one of {', '.join(STORAGES)}")
    if duration_s is None:
        return SCENARIOS[name]
    if not 1.0 <= duration_s <= _LONGEST_S:
        raise BadInputError(f"a duration of {duration_s:g} s will not do: give 1 to {_LONGEST_S:g} s")
    return replace(SCENARIOS[name], duration_s=duration_s)


def _make_room(out: Path, files: Sequence[Path], force: bool) -> None:
    """Make the folder; refuse one with anything in it, unless forced: then remove earlier outputs of the same names."""
    if out.exists() and not out.is_dir():
        raise BadInputError(f"{one_line(out)}: is a file; give the name of a folder")
    if out.is_dir() and any(out.iterdir()) and not force:
        raise BadInputError(
            f"{one_line(out)}: has something in it; give another folder, or --force to overwrite an earlier recording in it"
        )
    try:
        out.mkdir(parents=True, exist_ok=True)
        for file in files:
            shutil.rmtree(file) if file.is_dir() else file.unlink(missing_ok=True)
    except OSError as error:
        raise BadInputError(f"{one_line(out)}: cannot be written ({one_line(error.strerror or error)}); give another folder") from None


def _streams(session: Session, count: Iterator[int]) -> list[Stream]:
    kind = "compressed" if session.scenario.jpeg_quality else "mono8"
    streams = [Stream(t.camera.topic, kind, t.camera.name, _images(session, i, count)) for i, t in enumerate(session.tracks)]
    if session.imu is not None and session.scenario.imu is not None:
        streams.append(Stream(session.scenario.imu.topic, "imu", session.scenario.imu.name, _imu_samples(session)))
    return streams


def _imu_samples(session: Session) -> Iterator[Sample]:
    imu = session.imu
    assert imu is not None
    for k in range(len(imu.t_ns)):
        yield Sample(int(session.imu_record_ns[k]), int(imu.t_ns[k]), ImuPayload(imu.gyro[k], imu.accel[k]))


def _images(session: Session, index: int, count: Iterator[int]) -> Iterator[Sample]:
    track, quality = session.tracks[index], session.scenario.jpeg_quality
    renderer = Renderer(track.camera, session.scenario.board, session.scenario.style)
    rng = session.image_rng(index)
    light = rng.uniform(0, 2 * np.pi)
    for k, T_cam_board in enumerate(session.T_cam_board(track)):
        next(count)
        image = renderer.render(T_cam_board, rng, light)
        payload = CompressedPayload("jpeg", encode_jpeg(image, quality)) if quality else image
        yield Sample(int(track.record_ns[k]), int(track.stamp_ns[k]), payload)
