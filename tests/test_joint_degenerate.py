"""What a motion leaves open is named and never given as a number; what it tells is right; rich motion raises no alarm."""

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from joint_samples import Recording, error_of, recorded

from calibkit.data.result import Result
from calibkit.data.verdict import Status, Verdict
from calibkit.estimation.joint import Joint
from calibkit.estimation.joint_trust import joint_trust
from calibkit.simulation import trajectory
from calibkit.simulation.trajectory import Motion

T, DT = "T_cam0_imu0", "dt_imu0_cam0"
P, R = ("p_x", "p_y", "p_z"), ("r_x", "r_y", "r_z")


def told(seed: int, motion: str) -> tuple[Recording, Joint, Result]:
    recording = recorded(seed, motion=motion)
    joint = recording.fitted()
    return recording, joint, recording.result(joint)


def right(recording: Recording, joint: Joint, part: slice) -> bool:
    """Whether parameters of T_cam_imu (rho, phi) and dt, in that order, lie within 4 sigma of the truth."""
    first = joint.fit.problem.border["T 0"].start
    where = slice(first + part.start, first + part.stop)
    sigma = np.sqrt(np.diag(joint_trust(joint.fit).cov))[where]
    return bool(np.all(np.abs(error_of(recording, joint)[where]) < 4 * sigma))


def unknown(result: Result) -> set[str]:
    """Return the parts of T and dt that are not observable."""
    return {name.split(".")[1] for name in result.not_observable if name.startswith((T, DT))}


def opened(result: Result) -> list[str]:
    return [reason.text for reason in result.reasons if reason.text.startswith(f"{T}: ") and "is not observable" in reason.text]


def to_add(result: Result) -> list[str]:
    lines = result.facts["lines"]
    assert isinstance(lines, list)
    heads = [i for i, line in enumerate(lines) if "to determine T and dt, add, for 10 s each:" in line]
    return [line.strip() for i in heads for line in lines[i + 1 :]]


def two_turns(result: Result) -> bool:
    """Whether turns about two axes are asked for: one leaves the lever arm along it open."""
    first, *rest = to_add(result)
    return "turn it" in first and "something is open still" in first and len(rest) == 1 and "T and dt are determined then" in rest[0]


def translation(recording: Recording, joint: Joint, result: Result) -> None:
    """The lever arm alone: accelerations tell rotation and offset."""
    assert unknown(result) == set(P)
    assert len(opened(result)) == 3
    assert two_turns(result)
    assert all(f"p of {T} along" in text and "turn about" in text for text in opened(result))
    assert right(recording, joint, slice(3, 7))
    assert abs(joint.fit.x.cameras[0].dt - recording.td) < 5e-4
    assert np.linalg.norm(error_of(recording, joint)[joint.fit.problem.border["T 0"]][3:]) < 5e-3


def single_axis(recording: Recording, joint: Joint, result: Result) -> None:
    """Turns about the camera's y, nearly the IMU's x, without translation: p along it, and R about it."""
    texts = opened(result)
    assert len(texts) == 2
    assert any(f"p of {T} along the imu0's x axis" in text for text in texts)
    assert any(f"R of {T} about the imu0's x axis" in text for text in texts)
    assert DT not in str(result.not_observable)
    assert right(recording, joint, slice(6, 7))


def planar(recording: Recording, joint: Joint, result: Result) -> None:
    """A vehicle on flat ground: only p along the axis of its turns, the camera's y, nearly the IMU's x."""
    texts = opened(result)
    assert len(texts) == 1
    assert f"p of {T} along the imu0's x axis" in texts[0]
    assert len(to_add(result)) == 1
    assert re.match(r"turn it about the camera's [xz] axis .* \(T and dt are determined then\)", to_add(result)[0])  # across its turns
    assert unknown(result) == {"p_y"}
    assert right(recording, joint, slice(3, 7))


def nothing(recording: Recording, joint: Joint, result: Result) -> None:
    """At rest and gliding: nothing at all."""
    assert unknown(result) == {*P, *R, "offset"}
    assert len(opened(result)) == 6
    assert two_turns(result)
    assert "repeats itself" not in str(result.reasons)
    assert result.rig.time_offsets[DT].offset.value is None


MOTIONS: dict[str, Callable[[Recording, Joint, Result], None]] = {
    "translation": translation,
    "single-axis": single_axis,
    "planar": planar,
    "static": nothing,
    "constant-velocity": nothing,
}


def check(motion: str, seed: int) -> None:
    recording, joint, result = told(seed, motion)
    assert result.exit_code == 3
    assert result.rig.transforms[T].status is Status.NOT_OBSERVABLE
    MOTIONS[motion](recording, joint, result)


@pytest.mark.parametrize("motion", ["planar"])
def test_what_a_motion_leaves_open_is_named(motion: str) -> None:
    check(motion, 0)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("motion", MOTIONS)
def test_what_a_motion_leaves_open_is_named_over_many_seeds(motion: str, seed: int) -> None:
    check(motion, seed)


@pytest.mark.slow
def test_a_swing_that_fits_at_two_offsets_has_none() -> None:
    """A pure sine of 1 Hz and images 2.3 s late: any whole number of periods fits alike."""
    recording = recorded(0, motion="swing")
    late = replace(recording, views=replace(recording.views, t_ns=recording.views.t_ns + 2_300_000_000))
    joint = late.fitted()
    result = late.result(joint)
    assert joint.rival is not None
    assert result.exit_code == 3
    assert result.rig.time_offsets[DT].offset.value is None
    assert any(
        re.match(f"{DT}: not observable: .* fits as well as .*: the motion repeats itself", reason.text) for reason in result.reasons
    )


@pytest.mark.slow
def test_a_swing_that_fits_at_two_offsets_is_told_apart_by_accelerations(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same swing, and moved about without a period: the fits from both offsets tell which is right."""
    monkeypatch.setitem(trajectory.MOTIONS, "swing", Motion((*trajectory.MOTIONS["swing"].sines, *trajectory.MOTIONS["translation"].sines)))
    recording = recorded(0, motion="swing")
    joint = recording.fitted()
    assert joint.turns[0].second is not None
    assert joint.rival is None
    offset = recording.result(joint).rig.time_offsets[DT].offset
    assert offset.value is not None
    assert offset.sigma is not None
    assert abs(offset.value - recording.td) < 4 * offset.sigma


def no_alarm(seed: int) -> None:
    recording = recorded(seed)
    result = recording.result(recording.fitted(), halves=True)
    assert result.verdict is Verdict.PASS, [reason.text for reason in result.reasons]
    assert result.exit_code == 0
    assert not to_add(result)


@pytest.mark.parametrize("seed", range(1))
def test_rich_motion_raises_no_alarm(seed: int) -> None:
    no_alarm(seed)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 100))
def test_rich_motion_raises_no_alarm_over_many_seeds(seed: int) -> None:
    no_alarm(seed)
