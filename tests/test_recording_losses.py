"""What a recording has lost is in the verdict, the rig file and the report of every stage that writes one; other warnings are not."""

from dataclasses import replace
from pathlib import Path

import pytest
from commands import Run
from report_samples import result

from calibkit.data.observations import Lost
from calibkit.data.rig import Rig
from calibkit.data.verdict import Verdict
from calibkit.io.recording import open_recording
from calibkit.io.rig_file import load_rig
from calibkit.stages.outputs import with_losses

SAMPLES = Path(__file__).parent.parent / "sample_bags"


def test_only_what_is_lost_and_only_what_the_stage_made_is_doubted() -> None:
    plain = result(thumbnails=0)
    warned = replace(plain, facts={**plain.facts, "warnings": ["stamps are odd"]})
    assert with_losses(warned, Rig()) is warned
    cut = replace(plain, facts={**plain.facts, "warnings": ["stamps are odd", Lost("a.bag is damaged"), Lost("a chunk")]})
    found = with_losses(cut, Rig())
    said = "a.bag is damaged (and 1 warning more): only what is left was calibrated from; record again if that is too little"
    assert (found.reasons[-1].verdict, found.reasons[-1].text) == (Verdict.CHECK, said)
    assert found.rig.cameras["cam0"].reasons[-1] == said
    assert found.rig.cameras["cam0"].verdict in (Verdict.CHECK, Verdict.FAIL)
    assert with_losses(cut, plain.rig).rig == plain.rig  # taken over as it was


@pytest.mark.slow
def test_half_a_recording_is_no_pass(run: Run, tmp_path: Path) -> None:
    bag, rig = tmp_path / "cut.bag", tmp_path / "rig.yaml"
    bag.write_bytes((SAMPLES / "cam_imu.bag").read_bytes()[:3_000_000])
    target = ["--target", SAMPLES / "target.yaml"]
    for words in (["intrinsics"], ["timeoffset", "--rig", rig], ["joint", "--rig", rig]):
        said = run(words[0], bag, *target, *words[1:], "-o", rig)
        assert said.code == 0
        assert "  CHECK cut.bag is damaged (it was not closed, or is cut)" in said.out
    made = load_rig(rig)
    for entry in (made.cameras["cam0"], made.time_offsets["dt_imu0_cam0"], made.transforms["T_cam0_imu0"]):
        assert entry.verdict is Verdict.CHECK
        assert sum(text.startswith("cut.bag is damaged") for text in entry.reasons) == 1
    report = run("report", rig)
    assert report.out.count("cut.bag is damaged") == 1
    assert run("report", rig, "--strict").code == 1


@pytest.mark.slow
def test_the_readers_say_which_warnings_are_losses(tmp_path: Path) -> None:
    bag = tmp_path / "cut.bag"
    bag.write_bytes((SAMPLES / "cam_imu.bag").read_bytes()[:500_000])
    warnings = open_recording([bag]).warnings
    assert "cut.bag is damaged" in warnings[0]
    assert all(isinstance(text, Lost) for text in warnings)
    assert open_recording([SAMPLES / "cam_imu.bag"]).warnings == []
