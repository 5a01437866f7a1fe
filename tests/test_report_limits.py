"""Limits: names, units, what they hold to, and the one line for those that mean nothing."""

import json

import numpy as np
import pytest
from report_samples import residual_set, result

from calibkit.data.rig import Estimate, Imu, Noise, Rig
from calibkit.data.transforms import make_time_offset, make_transform
from calibkit.data.verdict import Status, Verdict
from calibkit.errors import BadInputError
from calibkit.io.rig_file import save_rig
from calibkit.report.limits import check, read, require_observable
from calibkit.report.parameters import rows
from calibkit.report.signals import measure
from calibkit.report.view import views

COV = np.diag([1e-6, 4e-6, 9e-6, 1e-8, 1e-8, 4e-8])
DETERMINED = Status.DETERMINED


def known(value, sigma, unit="", status=DETERMINED):
    return Estimate(value=value, sigma=sigma, unit=unit, status=status)


def lost(unit=""):
    return Estimate(value=None, unit=unit, status=Status.NOT_OBSERVABLE)


def a_rig(dt=None):
    walk = known(2.5e-5, 4e-6, "rad/s^2/sqrt(Hz)", Status.WEAK)
    noise = Noise(white=known(1.7e-4, 5e-7, "rad/s/sqrt(Hz)"), flicker=known(1.5e-4, 5e-6, "rad/s"), walk=walk)
    return Rig(
        cameras=result(thumbnails=0).rig.cameras,
        imus={"imu0": Imu(noise={"gyro_x": noise})},
        transforms={"T_cam0_imu0": make_transform("cam0", "imu0", np.eye(4), COV, DETERMINED)},
        time_offsets={"dt_imu0_cam0": make_time_offset("imu0", "cam0", dt or known(-0.008, 2e-5, "s"))},
    )


SIGNALS = measure(views(result(residuals=residual_set(frames=12, outliers=3), thumbnails=0))[0])


def checked(*asked, rig=None):
    limits = [read(*one.split("="), f"--limit {one}") for one in asked]
    return check(limits, rows(rig or a_rig()), SIGNALS)


@pytest.mark.parametrize(
    ("asked", "measured", "holds"),
    [
        ("reprojection_rms=0.3px", "0.282 px", True),
        ("cam0.reprojection_rms= 0.25 px ", "0.282 px", False),
        ("image_coverage=87%", "87.5 %", True),  # at least
        ("image_coverage=88%", "87.5 %", False),
        ("tilt_range=1.2rad", "0.679 rad", False),
        ("held_out_ratio=1", "1.02", False),
        ("td.sigma=0.02ms", "0.02 ms", True),
        ("td.sigma=19.999us", "20 us", False),
        ("dt_imu0_cam0.sigma=19.999µs", "20 µs", False),
        ("td.sigma=0.25%", "0.25 % of the value", True),
        ("td.value=7.9ms", "-8 ms", False),  # how far from 0, whatever the sign
        ("td.value=8ms", "-8 ms", True),
        ("td.value=-9..-7ms", "-8 ms", True),
        ("td.value=7..9ms", "-8 ms", False),
        ("dt_imu0_cam0.offset.value=-0.1..0s", "-0.008 s", True),
        ("T.p_x.sigma=1.1mm", "1 mm", True),
        ("T_cam0_imu0.p_z.sigma=0.2cm", "0.3 cm", False),
        ("r_z.sigma=0.2mrad", "0.2 mrad", True),
        ("T.r_z.sigma=0.011deg", "0.0115 deg", False),
        ("cam0.fx.value=459..461px", "460 px", True),
        ("fx.sigma=0.01%", "0.00978 % of the value", True),
        ("k1.sigma=1.3e-4", "0.00012", True),
        ("imu0.gyro_x.white.sigma=4e-7rad/s/sqrt(Hz)", "5e-07 rad/s/sqrt(Hz)", False),
        ("gyro_x.walk.sigma=15%", "16 % of the value", False),
        ("gyro_x.flicker.sigma=0.001deg/s", "0.000286 deg/s", True),
    ],
)
def test_a_limit_converts_its_unit_and_says_what_it_found(asked, measured, holds):
    (found,) = checked(asked)
    assert (found.measured, found.holds) == (measured, holds)
    assert found.reason.verdict is (Verdict.PASS if found.holds else Verdict.FAIL)


def test_what_the_sentence_of_a_broken_limit_says():
    assert checked("cam0.reprojection_rms=0.25px")[0].reason.text == (
        "cam0: reprojection rms 0.282 px, beyond the limit ≤ 0.25 px (cam0.reprojection_rms)"
    )
    assert checked("image_coverage=100%")[0].limit == "≥ 100 %"
    assert checked("fx.value=459..461px")[0].limit == "459 to 461 px"


def test_short_names_stand_for_all_that_they_fit():
    assert [one.what for one in checked("T.p.sigma=10mm")] == ["p_x sigma", "p_y sigma", "p_z sigma"]
    assert [one.holds for one in checked("T.p.sigma=2mm")] == [True, True, False]
    assert [one.what for one in checked("T_cam0_imu0.r.sigma=10mrad")] == ["r_x sigma", "r_y sigma", "r_z sigma"]
    assert {(one.part, one.what) for one in checked("fx.sigma=1px")} == {("cam0", "fx sigma")}


def test_digits_show_on_which_side_of_its_limit_a_value_is():
    """Not "0.0149 ms, beyond 0.0149 ms"."""
    (found,) = checked("td.sigma=0.01999999ms")
    assert (found.measured, found.holds) == ("0.02 ms", False)
    (found,) = checked("td.sigma=0.02ms", rig=a_rig(known(-0.008, 2.0004e-5, "s")))
    assert (found.measured, found.holds) == ("0.020004 ms", False)


@pytest.mark.parametrize(
    ("dt", "why"),
    [
        (lost("s"), "not observable"),
        (Estimate(value=0.005, unit="s"), "not known (given)"),
    ],
)
def test_what_is_not_known_breaks_every_limit_on_it(dt, why):
    (found,) = checked("td.sigma=1e9s", rig=a_rig(dt))
    assert (found.holds, found.measured) == (False, why)
    assert found.reason.text == f"dt_imu0_cam0: offset sigma is {why}, beyond the limit ≤ 1e+09 s (td.sigma)"
    assert checked("td.value=1s", rig=a_rig(dt))[0].holds is (dt.value is not None)
    assert not checked("td.sigma=100%", rig=a_rig(dt))[0].holds


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ("reprojection_rms=0.3", "has no unit; reprojection rms of cam0 has px"),
        ("reprojection_rms=0.3mm", "has the unit mm; reprojection rms of cam0 has px"),
        ("reprojection_rms=30%", "has the unit %; reprojection rms of cam0 has px"),
        ("dropped_corners=3", "has no unit; corners dropped of cam0 has %"),
        ("td.sigma=0.1", "has no unit; offset sigma of dt_imu0_cam0 has s or ms or us or µs or %"),
        ("td.sigma=0.1px", "has the unit px; "),
        ("td.sigma=0.1MS", "has the unit MS; "),
        ("td.value=1%", "has the unit %; "),
        ("k1.sigma=0.1px", "has the unit px; k1 sigma of cam0 has none"),
        ("corners_dropped=3%", "nothing in this rig is called corners_dropped; did you mean dropped_corners?"),
        ("reprojecton_rms=1px", "nothing in this rig is called reprojecton_rms; did you mean reprojection_rms?"),
        ("cam1.reprojection_rms=1px", "nothing in this rig is called cam1.reprojection_rms; did you mean cam0.reprojection_rms?"),
        ("T_imu0_cam0.p.sigma=1mm", "did you mean T_cam0_imu0.p.sigma?"),
        ("T_gripper_cam0.p.sigma=1mm", "did you mean T_cam0_imu0.p.sigma?"),
        ("td=1ms", "did you mean"),
        ("pose_turn=1deg", "this rig's residuals do not tell pose_turn; leave this limit out"),
        ("zzzzzzz=1", "nothing in this rig is called zzzzzzz; docs/ci.md lists the names"),
        ("fx.sigma=", "is no limit; write a name, a number and its unit, such as reprojection_rms=0.3px"),
        ("=1px", "is no limit"),
        ("fx.sigma=px", "is no limit"),
        ("fx.sigma=nanpx", "is no limit"),
        ("fx.sigma=infpx", "is no limit"),
        ("fx.sigma=1,5px", "has the unit ,5px"),
        ("fx.sigma=1.5.2px", "has the unit .2px"),
        ("fx.sigma=-1px", "nothing can keep this limit"),
        ("fx.sigma=1e999px", "nothing can keep this limit"),
        ("fx.value=2..1px", "nothing can keep this limit"),
    ],
)
def test_a_limit_that_means_nothing_is_refused(asked, said):
    with pytest.raises(BadInputError) as error:
        checked(asked)
    assert str(error.value).startswith(f"--limit {asked}: ")
    assert said in str(error.value)


def test_a_rig_without_time_offsets_or_transforms_says_so():
    rig = a_rig().model_copy(update={"transforms": {}, "time_offsets": {}})
    for asked, what in (("td.sigma=1ms", "time offset"), ("T.p.sigma=1mm", "transform")):
        with pytest.raises(BadInputError, match=f"this rig has no {what}; leave this limit out"):
            checked(asked, rig=rig)


def test_required_observable_counts_the_weak_and_names_them():
    found = require_observable(rows(a_rig(lost("s"))))
    assert not found.holds
    assert found.note == "dt_imu0_cam0 offset not observable, imu0 gyro_x walk weak"
    assert "well observable 88.9 % (dt_imu0" in found.reason.text
    assert require_observable([row for row in rows(a_rig()) if row.status is DETERMINED]).holds
    assert require_observable([]).holds


# The command


@pytest.fixture
def rig_file(tmp_path):
    save_rig(a_rig(), tmp_path / "rig.yaml")
    return tmp_path / "rig.yaml"


def test_the_command_line_goes_before_the_file(run, rig_file):
    limits = rig_file.with_name("limits.yaml")
    limits.write_text("td.sigma: 1us\nk1.sigma: 0.001 # no unit\nT.p.sigma: 4 mm\n")
    said = run("report", rig_file, "--limits", limits)
    assert said.code == 1
    assert "FAIL  dt_imu0_cam0: offset sigma 20 us, beyond the limit ≤ 1 us (td.sigma)" in said.out
    eased = run("report", rig_file, "--limits", limits, "--limit", "td.sigma=0.1ms", "--json", rig_file.with_name("r.json"))
    assert eased.code == 0
    data = json.loads(rig_file.with_name("r.json").read_text())
    assert [one["name"] for one in data["limits"]] == ["td.sigma", "k1.sigma", *3 * ["T.p.sigma"]]
    assert data["limits"][0] == {
        "name": "td.sigma", "part": "dt_imu0_cam0", "stage": None, "what": "offset sigma", "value": pytest.approx(0.02), "low": None,
        "high": 0.1, "unit": "ms", "holds": True, "note": "",
    }  # fmt: skip


def test_require_observable_on_the_command_line_and_in_the_file(run, rig_file):
    assert run("report", rig_file).code == 0
    said = run("report", rig_file, "--require-observable")
    assert said.code == 1
    assert "(imu0 gyro_x walk weak), beyond the limit ≥ 100 % (require_observable)" in said.out
    limits = rig_file.with_name("limits.yaml")
    limits.write_text("require_observable: true\n")
    assert run("report", rig_file, "--limits", limits).code == 1


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("td.sigma: 1\n", "limits.yaml, line 1: td.sigma: 1: has no unit"),
        ("k1.sigma: 1\nfx.sgma: 1px\n", "limits.yaml, line 2: fx.sgma: 1px: nothing in this rig is called fx.sgma; did you mean fx.sigma?"),
        ("fx.sigma:\n  high: 1px\n", "limits.yaml, line 1: fx.sigma: {'high': '1px'}: is no limit"),
        ("fx.sigma: true\n", "is no limit"),
        ("fx.sigma:\n", "is no limit"),
        ("- fx.sigma\n", "holds no limits; write one a line"),
        ("require_observable: yes\n", "line 1: require_observable: is neither true nor false"),
        ("fx.sigma: 1px\nfx.sigma: 2px\n", "is given twice"),
        ("", "is empty"),
    ],
)
def test_a_wrong_file_of_limits_is_one_line(run, rig_file, content, said):
    limits = rig_file.with_name("limits.yaml")
    limits.write_text(content)
    assert said in run("report", rig_file, "--limits", limits, "--json", rig_file.with_name("r.json")).mistake
    assert not rig_file.with_name("r.json").exists()


def test_wrong_options_are_one_line_and_write_nothing(run, rig_file):
    for asked, said in [
        (["--limit", "td.sgma=1ms"], "--limit td.sgma=1ms: nothing in this rig is called td.sgma; did you mean td.sigma?"),
        (["--limit", "td.sigma=1ms", "--limit", "td.sigma=2ms"], "td.sigma is limited twice; keep one"),
        (["--limit", "reprojection_rms"], "--limit reprojection_rms: is no limit"),
        (["--limit", "reprojection_rms=0.3px"], "this rig's residuals do not tell reprojection_rms"),
        (["--limits", "gone.yaml"], "gone.yaml: cannot be read"),
        (["--limits", rig_file, "--json", rig_file], "is an input of this command, too"),
        (["--pictures", "pdf"], "--pictures: goes with --report DIR"),
        (["--pictures", "gif", "-o", rig_file.parent / "out"], "'gif' is not one of 'png', 'pdf', 'svg'"),
        (["--junit", rig_file], "is an input of this command, too"),
        (["--markdown", "-"], "output goes to files only"),
    ]:
        assert said in run("report", rig_file, *asked, *([] if "--json" in asked else ["--json", rig_file.parent / "r.json"])).mistake
    assert [path.name for path in rig_file.parent.iterdir()] == ["rig.yaml"]
