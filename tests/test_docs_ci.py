"""docs/ci: the workflow and the script say the same, the script runs it, and the limits that docs/ci.md names are there."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from test_report_limits import SIGNALS, a_rig

from calibkit.io.yaml_file import load_yaml
from calibkit.report.limits import check, read
from calibkit.report.parameters import rows
from calibkit.report.signals import PROBES
from calibkit.stages.limits_file import demands

ROOT = Path(__file__).parent.parent
CI = ROOT / "docs" / "ci"
SCRIPT = CI / "calibrate.sh"
STAGES = ["intrinsics", "timeoffset", "handeye", "report", "report"]


def calibrate(tmp_path, program, **environment):
    """Run the script with this program as calibkit; return its exit code and what it said."""
    (tmp_path / "bin").mkdir()
    shim = tmp_path / "bin" / "calibkit"
    shim.write_text(f"#!/bin/sh\n{program}\n")
    shim.chmod(0o755)
    path = {"PATH": f"{tmp_path / 'bin'}:{os.environ['PATH']}"}
    ended = subprocess.run(["sh", str(SCRIPT)], cwd=tmp_path, env={**os.environ, **path, **environment}, capture_output=True, text=True)
    return ended.returncode, ended.stdout


def test_the_workflow_runs_the_commands_of_the_script():
    (job,) = load_yaml(CI / "workflow.yml").data["jobs"].values()
    runs = [line for step in job["steps"] for line in step.get("run", "").splitlines()]
    asked = [line for line in runs if line.startswith("calibkit ")]
    assert asked == re.findall(r"^step (calibkit .*)$", SCRIPT.read_text(), re.MULTILINE)
    assert [line.split()[1] for line in asked] == STAGES
    samples = dict(re.findall(r'^: "\$\{(\w+):=(?:\$root/)?([^}]*)\}"', SCRIPT.read_text(), re.MULTILINE))
    assert job["env"] == samples
    assert all((ROOT / path).exists() for name, path in samples.items() if name != "OUT")
    after = [
        step for step in job["steps"] if step.get("name") not in ("install", "intrinsics") and "setup" not in step.get("uses", "checkout")
    ]
    assert all(step["if"] == "${{ !cancelled() }}" for step in after if not step.get("uses", "").startswith("actions/checkout"))
    assert any("GITHUB_STEP_SUMMARY" in line and "report.md" in line for line in runs)
    assert job["steps"][-1]["with"]["path"] == samples["OUT"]


@pytest.mark.parametrize(
    ("codes", "said"),
    [
        ({}, 0),
        ({"intrinsics": 1}, 1),
        ({"report": 1}, 1),
        ({"intrinsics": 1, "timeoffset": 3, "report": 1}, 3),
        ({"intrinsics": 3, "timeoffset": 4}, 4),
        ({"intrinsics": 4, "timeoffset": 2, "handeye": 3}, 2),
    ],
)
def test_the_script_runs_every_command_and_ends_with_the_gravest_code(tmp_path, codes, said):
    program = "".join(f"[ $1 = {stage} ] && exit {code}\n" for stage, code in codes.items()) + "exit 0"
    code, out = calibrate(tmp_path, program, OUT="here")
    assert code == said
    asked = [shlex.split(line) for line in out.splitlines() if line.startswith("$ ")]
    assert [words[2] for words in asked] == STAGES
    assert asked[0][3:] == f"{ROOT}/sample_bags/cam_imu.bag --target {ROOT}/sample_bags/target.yaml -o here/rig.yaml --force".split()


def test_the_script_stops_where_it_was_interrupted(tmp_path):
    code, out = calibrate(tmp_path, "exit 130")
    assert (code, out.count("$ calibkit")) == (130, 1)


@pytest.mark.slow
def test_the_script_calibrates_the_samples(tmp_path):
    code, out = calibrate(tmp_path, f'exec {shlex.quote(sys.executable)} -c "from calibkit.cli.main import main; main()" "$@"')
    assert code == 0, out
    made = {str(path.relative_to(tmp_path / "calibration")) for path in (tmp_path / "calibration").rglob("*.*")}
    assert {f"{name}{end}" for name in ("rig", "arm") for end in (".yaml", ".xml", "/report.html", "/report.md", "/report.json")} <= made
    for name in ("rig", "arm"):
        page = (tmp_path / "calibration" / name / "report.md").read_text()
        assert page.startswith("## calibkit: PASS")
        assert "### Limits" in page


@pytest.mark.slow
def test_the_limits_of_the_rig_hold_after_every_stage(run, tmp_path):
    """joint makes the lens anew without a held-out error of its own: a limit on it is on that of intrinsics."""
    rig = tmp_path / "rig.yaml"
    samples = [ROOT / "sample_bags" / "cam_imu.bag", "--target", ROOT / "sample_bags" / "target.yaml"]
    assert run("calibrate", *samples, "-o", rig).code == 0
    said = run("report", rig, "--limits", CI / "rig.limits.yaml")
    assert (said.code, said.err) == (0, "")
    assert "held_out_ratio      cam0 held-out rms over rms (intrinsics) " in said.out
    assert "reprojection_rms    cam0 reprojection rms (joint) " in said.out
    assert said.out.count("held-out rms over rms") == 1  # not among the signals that are judged


def test_the_page_names_every_signal_and_its_examples_are_limits():
    page = (ROOT / "docs" / "ci.md").read_text()
    table = dict(re.findall(r"^\| `(\w+)` \| ([^|]*) \|", page, re.MULTILINE))
    assert table == {probe.key: probe.unit or "-" for probe in PROBES}
    told = {signal.probe.key for signal in SIGNALS}
    examples = [example for example in re.findall(r"`([\w.]+=[^`= ]+)`", page) if example.split("=")[0] not in set(table) - told]
    assert len(examples) >= 12
    limits = [read(*example.split("="), example) for example in examples]
    assert len(check(limits, rows(a_rig()), SIGNALS)) >= len(examples)


def test_the_files_of_limits_are_read():
    assert len(demands(path=CI / "rig.limits.yaml").limits) == 6
    assert demands(path=CI / "rig.limits.yaml").require_observable
    assert len(demands(path=CI / "arm.limits.yaml").limits) == 5
