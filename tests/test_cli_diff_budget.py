"""`calibkit diff` and `calibkit budget`: tables, verdicts, files and exit codes."""

import json
from pathlib import Path

import numpy as np
import pytest
from commands import Run
from drawn_rigs import COV_LENS, camera, lens, offset, rig
from rigs import T_CAM0_IMU0

from calibkit.data.rig import Estimate, Imu, Rig
from calibkit.data.transforms import make_time_offset, make_transform
from calibkit.data.verdict import Status
from calibkit.geometry import se3, so3
from calibkit.io.rig_file import save_rig


@pytest.fixture
def old(tmp_path: Path) -> Path:
    save_rig(rig(np.random.default_rng(1)), tmp_path / "old.yaml")
    return tmp_path / "old.yaml"


def saved(folder: Path, **update) -> Path:
    """Another calibration of the rig, with these sections instead of its own."""
    save_rig(rig(np.random.default_rng(2)).model_copy(update=update), folder / "new.yaml")
    return folder / "new.yaml"


def late(ms: float) -> dict[str, object]:
    return {"time_offsets": {"dt_cam0_imu0": make_time_offset("cam0", "imu0", offset(0.008 + ms * 1e-3))}}


def other_lens() -> dict[str, object]:
    return {"cameras": {"cam0": camera("pinhole-radtan", lens() + np.array([5, 5, 0, 0, 0.01, 0, 0, 0]), COV_LENS)}}


def test_chance_alone_is_no_change(run: Run, old: Path, tmp_path: Path) -> None:
    said = run("diff", old, saved(tmp_path))
    assert (said.code, said.err) == (0, "")
    assert said.out.splitlines()[-1] == "nothing changed beyond chance: 6 entries judged (a false alarm in any of them: 1%)"


def test_a_clock_that_moved_is_a_change_whichever_way_round_it_is_written(run: Run, old: Path, tmp_path: Path) -> None:
    said = run("diff", old, saved(tmp_path, **late(1.0)))
    assert said.code == 1
    assert said.out.splitlines()[-1].startswith("dt_imu0_cam0: changed by -1.0")
    assert said.out.splitlines()[-1].count(" px at 1 rad/s (z ") == 1


def test_a_lens_that_changed_is_told_with_pixels_place_and_z_and_drawn(run: Run, old: Path, tmp_path: Path) -> None:
    new, out, data = saved(tmp_path, **other_lens()), tmp_path / "report", tmp_path / "diff.json"
    said = run("diff", old, new, "--report", out, "--json", data)
    assert said.code == 1
    assert "cam0: the lens changed: up to " in said.out
    assert " of all parameters together)" in said.out
    assert (out / "cam0-shift.png").read_bytes().startswith(b"\x89PNG")
    assert said.out.splitlines()[-2:] == [f"written: {out / 'cam0-shift.png'}", f"written: {data}"]
    told = json.loads(data.read_text())
    assert told["schema"] == "calibkit-diff/1"
    assert told["changed"] == ["cam0.lens"]
    found = told["entries"][0]
    assert (found["entry"], found["what"], found["freedom"]) == ("cam0", "lens", 8)
    assert found["parameters"][0].keys() == {"name", "unit", "old", "new", "change", "sigma", "z", "note"}
    assert [(each["what"], each["range_m"]) for each in told["pixel_shifts"]["cam0"]] == [
        ("as it is", None), ("turned along", None), *(("turned and moved along", r) for r in (0.5, 2.0, None)),
    ]  # fmt: skip
    as_it_is, turned = told["pixel_shifts"]["cam0"][:2]
    assert turned["rms_px"] <= as_it_is["rms_px"]
    again = (out / "cam0-shift.png").read_bytes()
    assert run("diff", old, new, "--report", out).mistake.endswith("exists already; give another name, or --force to overwrite it")
    assert run("diff", old, new, "--report", out, "--force").code == 1
    assert (out / "cam0-shift.png").read_bytes() == again


def test_the_same_file_twice_is_no_change(run: Run, old: Path) -> None:
    said = run("diff", old, old)
    assert said.code == 0
    assert said.out == "nothing changed: all that both have is the same to the last digit\n"


@pytest.mark.slow
def test_noise_without_a_sigma_is_told_by_its_ratio_and_what_is_the_same_is_left_out(run: Run, tmp_path: Path) -> None:
    def noisy(name: str, density: float | None) -> Path:
        known = {} if density is None else {"gyro_noise_density": Estimate(value=density, unit="rad/s/sqrt(Hz)")}
        save_rig(rig().model_copy(update={"imus": {"imu0": Imu(topic="/imu0", **known)}}), tmp_path / name)
        return tmp_path / name

    quiet = noisy("quiet.yaml", 1e-4)
    said = run("diff", quiet, noisy("loud.yaml", 1e-3))
    assert (said.code, said.out.splitlines()[-2:]) == (
        0, ["imu0's gyro_noise_density 10 times: no sigma to judge it by", "nothing could be judged"],
    )  # fmt: skip
    assert "\n21 parameters are the same in both and left out\n" in said.out
    assert "cam0 fx" not in said.out
    assert "only in OLD: imu0's noise" in run("diff", quiet, noisy("silent.yaml", None)).out


@pytest.mark.slow
def test_a_camera_turned_in_place_did_not_move(run: Run, tmp_path: Path) -> None:
    def rig_of(name: str, a: str, b: str, T: np.ndarray) -> Path:
        cov = np.diag([1e-8] * 6)
        kept = {"imus": {}, "time_offsets": {}, "transforms": {f"T_{a}_{b}": make_transform(a, b, T, cov, Status.DETERMINED)}}
        save_rig(rig().model_copy(update=kept), tmp_path / name)
        return tmp_path / name

    turn = se3.make(so3.exp(np.array([0, np.radians(0.5), 0])), np.zeros(3))
    step = se3.make(np.eye(3), np.array([0.003, 0, 0]))
    for a, b in (("cam0", "imu0"), ("imu0", "cam0")):  # either way round
        T_imu_cam = se3.inverse(T_CAM0_IMU0)
        old, turned, moved = (
            rig_of(f"{name}_{a}.yaml", a, b, T if a == "imu0" else se3.inverse(T))
            for name, T in (("old", T_imu_cam), ("turned", T_imu_cam @ turn), ("moved", T_imu_cam @ step))
        )
        assert ": cam0 turned by 0.5 deg about its y axis and did not move as imu0 sees it: pixels" in run("diff", old, turned).out
        assert ": cam0 did not turn and moved by 3 mm as imu0 sees it: pixels" in run("diff", old, moved).out


def test_what_only_one_file_has_is_listed(run: Run, old: Path, tmp_path: Path) -> None:
    said = run("diff", old, saved(tmp_path, transforms={}))
    assert (said.code, "only in OLD: T_cam0_imu0, T_imu1_imu0" in said.out) == (0, True)


def test_what_is_not_observable_has_no_number(run: Run, old: Path, tmp_path: Path) -> None:
    gone = {"time_offsets": {"dt_imu0_cam0": make_time_offset("imu0", "cam0", offset(None, None))}}
    said = run("diff", old, saved(tmp_path, **gone))
    row = next(line for line in said.out.splitlines() if line.startswith("dt_imu0_cam0 offset"))
    assert said.code == 0
    value = rig(np.random.default_rng(1)).time_offsets["dt_imu0_cam0"].offset.value
    assert row.split() == ["dt_imu0_cam0", "offset", f"{value:.9g}", "s", "not", "observable", "in", "NEW"]


def test_files_with_nothing_in_common_are_refused(run: Run, old: Path, tmp_path: Path) -> None:
    save_rig(Rig(cameras={"cam7": rig().cameras["cam0"]}), tmp_path / "new.yaml")
    assert "have no entry in common" in run("diff", old, tmp_path / "new.yaml").mistake


@pytest.mark.parametrize("words", [["diff", "old.yaml", "none.yaml"], ["budget", "none.yaml"]])
def test_a_missing_file_is_named(run: Run, old: Path, monkeypatch: pytest.MonkeyPatch, words: list[str]) -> None:
    monkeypatch.chdir(old.parent)
    assert "none.yaml" in run(*words).mistake


@pytest.mark.parametrize("words", [["diff", "old.yaml", "old.yaml", "--json", "old.yaml"], ["budget", "old.yaml", "--json", "old.yaml"]])
def test_an_output_over_an_input_is_refused(run: Run, old: Path, monkeypatch: pytest.MonkeyPatch, words: list[str]) -> None:
    monkeypatch.chdir(old.parent)
    before = old.read_bytes()
    assert "is an input of this command, too" in run(*words, "--force").mistake
    assert old.read_bytes() == before


def test_the_budget_is_a_table_in_order_with_a_remedy(run: Run, old: Path, tmp_path: Path) -> None:
    data = tmp_path / "budget.json"
    said = run("budget", old, "--rate", "90deg/s", "--range", "500 cm", "--speed", "36km/h", "--json", data)
    assert (said.code, said.err) == (0, "")
    assert "One sigma of each, at 1.57 rad/s, 5 m and 10 m/s" in said.out
    assert said.out.splitlines()[-2].startswith("most of what is known: ")
    told = json.loads(data.read_text())
    assert (told["schema"], told["use"]) == ("calibkit-budget/1", {"rate_rad_s": np.pi / 2, "range_m": 5.0, "speed_m_s": 10.0})
    sizes = [cost["at_range_m"] for cost in told["costs"]]
    assert sizes == sorted(sizes, reverse=True)
    first = told["costs"][0]
    assert f"{first['entry']}'s {first['term']} costs" in said.out
    assert first["remedy"] in said.out


def test_what_is_not_observable_has_no_bound(run: Run, tmp_path: Path) -> None:
    gone = {"time_offsets": {"dt_imu0_cam0": make_time_offset("imu0", "cam0", offset(None, None))}}
    said = run("budget", saved(tmp_path, **gone))
    assert said.code == 1
    assert "dt_imu0_cam0: the cost of its time offset (turning) is unbounded, it is not observable: calibkit timeoffset" in said.out


def test_what_was_given_has_an_unknown_cost(run: Run, tmp_path: Path) -> None:
    said = run("budget", saved(tmp_path, time_offsets={"dt_imu0_cam0": make_time_offset("imu0", "cam0", offset(0.005, None))}))
    assert said.code == 0
    assert "unknown is what these cost, they were given without a sigma: dt_imu0_cam0 (time offset (turning))" in said.out


@pytest.mark.parametrize(
    ("option", "text", "told"),
    [
        ("--rate", "1", "write a number with its unit, such as 1rad/s (rad/s, deg/s)"),
        ("--rate", "1m/s", "write a number with its unit, such as 1rad/s (rad/s, deg/s)"),
        ("--range", "10rad/s", "write a number with its unit, such as 1m (m, cm, mm)"),
        ("--range", "0m", "must be above 0 and at most 1e+06"),
        ("--range", "1e9m", "must be above 0 and at most 1e+06"),
        ("--speed=-1m/s", None, "write a number with its unit, such as 1m/s (m/s, cm/s, mm/s, km/h)"),
        ("--speed", "nanm/s", "write a number with its unit, such as 1m/s (m/s, cm/s, mm/s, km/h)"),
    ],
)
def test_a_wrong_unit_is_one_line(run: Run, old: Path, option: str, text: str | None, told: str) -> None:
    assert told in run("budget", old, *([option] if text is None else [option, text])).mistake


def test_a_rig_of_imus_alone_has_no_budget(run: Run, tmp_path: Path) -> None:
    new = saved(tmp_path, cameras={}, transforms={}, time_offsets={})
    assert "holds no camera, transform or time offset" in run("budget", new).mistake
