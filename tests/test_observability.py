"""What a motion leaves open, and the motion that mends it."""

from pathlib import Path

import pytest
from conftest import Run
from joint_samples import recorded
from recorded_files import write_session
from time_offset_samples import camera_session

from calibkit.estimation.added_motion import missing_motions, worst
from calibkit.estimation.joint_trust import joint_trust
from calibkit.io.rig_file import save_rig
from calibkit.simulation.truth import true_rig
from calibkit.solver.trust import DETERMINED

TARGET = Path(__file__).resolve().parent.parent / "sample_bags" / "target.yaml"
LACKS = {  # about which of the camera's axes a motion does not turn: the ones to add are among them
    "translation": {"x", "y", "z"},
    "single-axis": {"x", "z"},  # it turns about y alone
    "planar": {"x", "z"},
    "static": {"x", "y", "z"},
    "rich": set(),
}


def check_advice(motion: str, seed: int) -> None:
    joint = recorded(seed, 15.0, motion=motion).fitted()
    trust = joint_trust(joint.fit)
    found = missing_motions(joint.fit, trust)
    if not LACKS[motion]:
        assert found == ()
        return
    assert 1 <= len(found) <= 2
    for each in found:
        assert any(f"turn it about the camera's {axis} axis" in each.text for axis in LACKS[motion]), each.text
    assert worst(trust.cov, trust.scales, joint.fit) > 30
    assert found[-1].left < DETERMINED


def test_no_motion_is_asked_for_where_all_is_determined() -> None:
    check_advice("rich", 0)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("motion", LACKS)
def test_the_motion_to_add_is_named_over_seeds(motion: str, seed: int) -> None:
    check_advice(motion, seed)


def test_the_command_says_what_to_add(run: Run, tmp_path: Path) -> None:
    session = camera_session(0, 0.005, duration_s=10.0, motion="planar")
    write_session(tmp_path, session)
    save_rig(true_rig(session, "test").model_copy(update={"transforms": {}, "time_offsets": {}}), tmp_path / "rig.yaml")
    js = tmp_path / "out.json"
    sources = (tmp_path / "corners.csv", tmp_path / "imu.csv", "--target", TARGET, "--rig", tmp_path / "rig.yaml")
    said = run("observability", *sources, "--camera", "corners", "--imu", "imu", "--json", js)
    assert said.code == 3, said
    assert "p of T_cam0_imu0 along the imu0's x axis is not observable" in said.out
    assert "add, for 10 s each:" in said.out
    assert "(T and dt are determined then)" in said.out
    assert said.out.splitlines()[-2] == "NOT OBSERVABLE: this motion does not tell all of the calibration"
    assert '"motion": "turn it about the camera\'s ' in js.read_text()
