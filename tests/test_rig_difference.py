"""What changed between two calibrations: no false alarms, no changes missed, signs and frames, and what cannot be judged."""

import numpy as np
import pytest
from drawn_rigs import COV_LENS, COV_T, ENTRIES, SIGMA_DT, T_HALF_TURN, camera, lens, offset, rig
from rigs import T_CAM0_IMU0
from scipy.stats import binom, chi2, kstest, norm
from test_intrinsics_honest import CASES, Case

from calibkit.data.rig import TRANSFORM_PARAMETERS, Estimate, Imu, InputFile, Rig, StageRun
from calibkit.data.transforms import make_time_offset, make_transform
from calibkit.data.verdict import Status
from calibkit.estimation.camera_rig_seed import match_instants
from calibkit.estimation.lens_fit import fit_lenses
from calibkit.estimation.lens_trust import lens_covariance
from calibkit.estimation.rig_difference import FALSE_ALARM, Difference, EntryChange, difference
from calibkit.estimation.rig_values import inverse_transform, named_as, tangent_covariance
from calibkit.geometry import se3, so3


def entry(found: Difference, name: str, what: str | None = None) -> EntryChange:
    return next(each for each in found.entries if each.name == name and what in (None, each.what))


def with_transform(T: np.ndarray, cov=COV_T, name="T_cam0_imu0", **more) -> Rig:
    _, a, b = name.split("_")
    return Rig(transforms={name: make_transform(a, b, T, cov, **{"status": Status.DETERMINED} | more)})


@pytest.mark.parametrize("seeds", [300, pytest.param(4000, marks=pytest.mark.slow)])
def test_two_calibrations_of_one_rig_differ_by_chance_alone(seeds: int) -> None:
    p: dict[tuple[str, str], list[float]] = {}
    alarms = 0
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        found = difference(rig(rng), rig(rng))
        alarms += found.changed
        for each in found.entries:
            p.setdefault((each.name, each.what), []).append(each.p)
    print(f"{alarms} alarms in {seeds}")
    assert alarms <= binom.ppf(0.999, seeds, FALSE_ALARM)
    assert len(p) == ENTRIES
    assert min(kstest(each, "uniform").pvalue for each in p.values()) > 1e-3  # neither too many nor too few


def calibrated(case: Case, seed: int) -> Rig:
    """Return what intrinsics finds from simulated corners."""
    views = case.views(seed)
    fit = fit_lenses(views, [one.model.name for one in case.cameras], match_instants(views))
    cov, at, cameras = lens_covariance(fit).corrected, 0, {}
    for c, (one, x) in enumerate(zip(case.cameras, fit.state.lenses, strict=True)):
        here = slice(at, at + len(x))
        cameras[f"cam{c}"], at = camera(one.model.name, x, cov[here, here]), here.stop
    if len(cameras) == 1:
        return Rig(cameras=cameras)
    T = make_transform("cam1", "cam0", fit.state.T_cam_cam0[1], cov[at:, at:], Status.DETERMINED)
    return Rig(cameras=cameras, transforms={"T_cam1_cam0": T})


@pytest.mark.slow
@pytest.mark.parametrize(("name", "pairs"), [("pinhole-radtan", 100), ("pinhole-radtan and pinhole-equi", 60)])
def test_two_simulated_calibrations_of_one_rig_differ_by_chance_alone(name: str, pairs: int) -> None:
    """The sigmas are the estimator's own here, not the true ones."""
    alarms = sum(difference(*(calibrated(CASES[name], 2 * pair + k) for k in range(2))).changed for pair in range(pairs))
    print(f"{name}: {alarms} alarms in {pairs} pairs")
    assert alarms <= binom.ppf(0.999, pairs, FALSE_ALARM)


def test_sigmas_that_are_too_small_alarm() -> None:
    """The test above can fail."""
    rngs = [np.random.default_rng(seed) for seed in range(20)]
    assert sum(difference(rig(rng, 2.0), rig(rng, 2.0)).changed for rng in rngs) > 10


def moved(what: str, distance: float, rng: np.random.Generator | None = None, noise: np.random.Generator | None = None) -> Difference:
    """Compare the truth (or draws of it) with a rig one entry of which is off by `distance` joint sigmas in a random direction."""
    old, new = rig(noise), rig(noise)
    rng = rng or np.random.default_rng(0)

    def step(cov: np.ndarray) -> np.ndarray:
        way = rng.normal(size=len(cov))
        return np.linalg.cholesky(2 * cov) @ (distance * way / np.linalg.norm(way))

    if what == "lens":
        x = np.array([estimate.value for estimate in new.cameras["cam0"].parameters.values()]) + step(COV_LENS)
        change: dict[str, object] = {"cameras": {"cam0": camera("pinhole-radtan", x, COV_LENS)}}
    elif what == "transform":
        T = se3.retract(np.array(new.transforms["T_imu1_imu0"].matrix), step(COV_T))
        entry = make_transform("imu1", "imu0", T, COV_T, Status.DETERMINED)
        change = {"transforms": {**new.transforms, "T_imu1_imu0": entry}}
    else:
        value = new.time_offsets["dt_imu0_cam0"].offset.value + step(np.array([[SIGMA_DT**2]]))[0]
        change = {"time_offsets": {"dt_imu0_cam0": make_time_offset("imu0", "cam0", offset(float(value)))}}
    return difference(old, new.model_copy(update=change))


@pytest.mark.parametrize(("what", "freedom"), [("lens", 8), ("transform", 6), ("time offset", 1)])
def test_a_change_of_so_many_joint_sigmas_is_measured_as_that_and_found(what: str, freedom: int) -> None:
    for distance in (2.0, 6.0):
        found = moved(what, distance)
        changed = max(found.entries, key=lambda each: each.chi2 or 0.0)
        assert (changed.what, changed.freedom) == (what, freedom)
        assert changed.chi2 == pytest.approx(distance**2, rel=1e-3)
        assert [each for each in found.entries if each.changed] == ([changed] if distance == 6.0 else [])


def test_what_is_as_rare_as_three_and_a_half_sigmas_is_a_change_and_two_and_a_half_are_none() -> None:
    for what, freedom in (("lens", 8), ("transform", 6), ("time offset", 1)):
        for z, changed in ((2.5, False), (3.5, True)):
            found = moved(what, float(np.sqrt(chi2.isf(2 * norm.sf(z), freedom))))
            assert found.changed == changed
            assert max(each.z for each in found.entries if each.z is not None) == pytest.approx(z, rel=2e-3)


def test_noise_on_both_sides_hides_few_changes_of_seven_joint_sigmas() -> None:
    rngs = [np.random.default_rng(seed) for seed in range(30)]
    assert sum(moved("lens", 7.0, rng, rng).changed for rng in rngs) >= 28


def test_a_transform_the_other_way_round_is_the_same_transform() -> None:
    new = se3.retract(T_CAM0_IMU0, np.array([1e-3, -2e-3, 5e-4, 1e-3, 4e-4, -2e-4]))
    old = with_transform(T_CAM0_IMU0)
    straight = difference(old, with_transform(new))
    turned = difference(
        old, Rig(transforms={"T_imu0_cam0": inverse_transform("T_cam0_imu0", with_transform(new).transforms["T_cam0_imu0"])})
    )
    assert turned.only_old == turned.only_new == ()
    assert turned.entries[0].name == "T_cam0_imu0"
    assert turned.entries[0].chi2 == pytest.approx(straight.entries[0].chi2, rel=1e-9)
    for one, other in zip(straight.entries[0].parameters, turned.entries[0].parameters, strict=True):
        assert other.change == pytest.approx(one.change, rel=1e-9)
        assert other.sigma == pytest.approx(one.sigma, rel=1e-9)


def test_the_covariance_of_the_inverse_is_that_of_inverses() -> None:
    rng = np.random.default_rng(1)
    T = se3.retract(T_CAM0_IMU0, rng.multivariate_normal(np.zeros(6), COV_T, 20000))
    around = se3.local(se3.inverse(T_CAM0_IMU0), se3.inverse(T))
    claimed = tangent_covariance(inverse_transform("T_cam0_imu0", with_transform(T_CAM0_IMU0).transforms["T_cam0_imu0"]))
    root = np.linalg.inv(np.linalg.cholesky(claimed))
    assert root @ np.cov(around.T) @ root.T == pytest.approx(np.eye(6), abs=0.05)


def test_the_table_shows_p_and_the_rotation_vector_with_their_own_sigmas() -> None:
    rng = np.random.default_rng(2)
    d = rng.multivariate_normal(np.zeros(6), COV_T, 20000)
    T = se3.retract(T_CAM0_IMU0, d)
    x = np.concatenate([T[:, :3, 3], so3.log(T[:, :3, :3])], axis=1)
    rows = difference(with_transform(T_CAM0_IMU0), with_transform(T[0])).entries[0].parameters
    assert [row.name for row in rows] == list(TRANSFORM_PARAMETERS)
    assert [row.sigma for row in rows] == pytest.approx(np.sqrt(2) * x.std(axis=0), rel=0.02)
    assert [row.new for row in rows] == pytest.approx(x[0])


def test_half_a_turn_has_two_rotation_vectors_and_they_are_near_each_other() -> None:
    axis = so3.log(T_HALF_TURN[:3, :3]) / np.pi
    old, new = (se3.make(so3.exp(angle * axis), np.zeros(3)) for angle in (np.pi - 1e-4, np.pi + 1e-4))
    found = difference(with_transform(old), with_transform(new)).entries[0]
    assert np.linalg.norm([row.change for row in found.parameters]) == pytest.approx(2e-4, rel=1e-6)
    assert not found.changed


def test_a_time_offset_the_other_way_round_is_minus_that() -> None:
    old = Rig(time_offsets={"dt_imu0_cam0": make_time_offset("imu0", "cam0", offset(0.005))})
    new = Rig(time_offsets={"dt_cam0_imu0": make_time_offset("cam0", "imu0", offset(-0.006))})
    (found,) = difference(old, new).entries
    assert found.parameters[0].change == pytest.approx(0.001)
    assert found.z == pytest.approx(0.001 / (np.sqrt(2) * SIGMA_DT))
    (back,) = difference(new, old).entries
    assert (back.name, back.parameters[0].change) == ("dt_cam0_imu0", pytest.approx(0.001))


@pytest.mark.parametrize("gone", ["OLD", "NEW"])
def test_what_is_not_observable_has_no_number(gone: str) -> None:
    known = Rig(time_offsets={"dt_imu0_cam0": make_time_offset("imu0", "cam0", offset(0.005))})
    lost = Rig(time_offsets={"dt_imu0_cam0": make_time_offset("imu0", "cam0", offset(None, None))})
    (found,) = difference(*((lost, known) if gone == "OLD" else (known, lost))).entries
    (row,) = found.parameters
    assert (found.chi2, found.changed, row.change, row.z) == (None, False, None, None)
    assert row.note == f"not observable in {gone}"
    assert (row.old if gone == "OLD" else row.new) is None


def test_of_a_transform_the_known_part_is_judged() -> None:
    statuses = {name: Status.NOT_OBSERVABLE if name == "p_z" else Status.DETERMINED for name in TRANSFORM_PARAMETERS}
    part = with_transform(T_CAM0_IMU0, status=Status.NOT_OBSERVABLE, statuses=statuses)
    (found,) = difference(with_transform(se3.retract(T_CAM0_IMU0, np.full(6, 1e-4))), part).entries
    assert found.freedom == 5
    assert [row.change is None for row in found.parameters] == [False, False, True, False, False, False]
    (turned,) = difference(
        Rig(transforms={"T_imu0_cam0": with_transform(se3.inverse(T_CAM0_IMU0), name="T_imu0_cam0").transforms["T_imu0_cam0"]}), part
    ).entries
    assert turned.freedom == 3  # p_b_a = -R^T p_a_b is made of all of it
    whole = with_transform(T_CAM0_IMU0, status=Status.NOT_OBSERVABLE)
    assert difference(whole, whole.model_copy(update={"provenance": []})).entries[0].parameters[0].old is None


def test_a_number_that_was_given_is_exact_and_two_are_not_judged() -> None:
    given = with_transform(T_CAM0_IMU0, None, status=Status.GIVEN)
    off = se3.retract(T_CAM0_IMU0, np.array([0, 0, 0, 0.01, 0, 0]))
    one, two = (
        difference(given, with_transform(off)).entries[0],
        difference(given, with_transform(off, None, status=Status.GIVEN)).entries[0],
    )
    assert one.changed
    assert one.notes == ("OLD has no sigma: it is taken as exact",)
    assert (two.chi2, two.changed, two.notes) == (None, False, ("neither file has a sigma: not judged",))
    assert two.parameters[3].change != 0


def test_an_entry_that_was_taken_over_is_not_counted_as_measured_again() -> None:
    found = difference(rig(), rig())
    assert all(each.same and each.chi2 is None and not each.changed for each in found.entries)


def test_entries_of_one_file_alone_are_listed() -> None:
    found = difference(rig(), Rig(cameras={"cam1": rig().cameras["cam0"]}, time_offsets=rig().time_offsets))
    assert found.only_old == ("cam0", "T_cam0_imu0", "T_imu1_imu0", "imu0")
    assert found.only_new == ("cam1",)


def test_biases_are_shown_and_not_judged() -> None:
    new = rig()
    intrinsics = new.imus["imu0"].intrinsics
    values = intrinsics.parameters
    parameters = {
        **values,
        "b_g_x": values["b_g_x"].model_copy(update={"value": 0.5}),
        "M_a_xx": values["M_a_xx"].model_copy(update={"value": 1.0301}),
    }
    imu = new.imus["imu0"].model_copy(update={"intrinsics": intrinsics.model_copy(update={"parameters": parameters})})
    found = entry(difference(rig(), new.model_copy(update={"imus": {"imu0": imu}})), "imu0", "scale and axes")
    rows = {row.name: row for row in found.parameters}
    assert found.chi2 == pytest.approx(rows["M_a_xx"].z ** 2)
    assert rows["b_g_x"].note == "changes from start to start: not judged"
    assert rows["b_g_x"].change == pytest.approx(0.49)


def test_noise_is_compared_by_its_densities() -> None:
    quiet, loud = (Imu(gyro_noise_density=Estimate(value=value, sigma=1e-5, status=Status.DETERMINED)) for value in (1e-4, 2e-4))
    (found,) = difference(Rig(imus={"imu0": quiet}), Rig(imus={"imu0": loud})).entries
    assert (found.what, found.changed) == ("noise", True)
    assert found.z == pytest.approx(1e-4 / (np.sqrt(2) * 1e-5))


def lenses(old, new) -> EntryChange:
    return difference(Rig(cameras={"cam0": old}), Rig(cameras={"cam0": new})).entries[0]


def test_a_lens_of_a_wider_family_is_judged_as_one_of_it() -> None:
    wide = np.zeros((9, 9))
    wide[:8, :8], wide[8, 8] = COV_LENS, 1e-8
    size = (752, 480)
    small = camera("pinhole-radtan", lens(), COV_LENS)
    same = lenses(small, camera("pinhole-radtan5", np.append(lens(), 1e-4), wide, size))
    assert same.chi2 == pytest.approx(1.0, rel=1e-3)  # k3 is one sigma from the 0 that four coefficients say
    assert not same.changed
    off = lens() + np.array([5, 0, 0, 0, 0, 0, 0, 0])
    for pair in (
        (small, camera("pinhole-radtan5", np.append(off, 0.0), wide, size)),
        (camera("pinhole-radtan5", np.append(off, 0.0), wide, size), small),
    ):
        assert lenses(*pair).changed


def test_models_that_differ_by_more_than_a_pixel_is_known_to_are_not_judged() -> None:
    fisheye = camera("pinhole-equi", np.array([458.6, 457.3, 367.2, 248.4, 0, 0, 0, 0.0]), COV_LENS, (752, 480))
    found = lenses(camera("pinhole-radtan", lens(), COV_LENS), fisheye)
    assert (found.chi2, found.changed) == (None, False)
    assert "not judged" in found.notes[1]


def test_images_of_another_size_are_a_change() -> None:
    found = lenses(camera("pinhole-radtan", lens(), COV_LENS), camera("pinhole-radtan", lens() / 2, COV_LENS, (376, 240)))
    assert (found.chi2, found.changed) == (None, True)
    assert found.notes == ("images of 752x480 and 376x240: nothing of the lens can be compared",)


def made_from(seed: int, *runs: tuple[str, list[str]]) -> Rig:
    """A calibration whose stages read these files and made these entries."""
    provenance = [
        StageRun(stage="x", command="x", calibkit="0", inputs=[InputFile(name=name, sha256=f"{len(name):064d}")], made=made)
        for name, made in runs
    ]
    return rig(np.random.default_rng(seed)).model_copy(update={"provenance": provenance})


def test_one_recording_in_both_is_told_of_the_entries_made_from_it_and_one_board_is_not() -> None:
    old, lens = made_from(1, ("a.bag", [])), ["cameras.cam0"]
    assert difference(old, made_from(2, ("bb.bag", []))).notes == ()
    assert difference(made_from(1, ("board.yaml", [])), made_from(2, ("board.yaml", []))).notes == ()
    assert difference(old, made_from(2, ("a.bag", []))).notes[0].startswith("both were made from a.bag: errors in common")
    assert difference(old, old).notes == ()  # nothing is judged
    for name in ("T_cam0_imu0", "T_imu0_cam0"):  # in either direction
        new = made_from(2, ("a.bag", [*lens, f"transforms.{name}"]), ("bb.bag", lens))
        assert difference(old, new).notes[0].startswith("both were made from a.bag (T_cam0_imu0): ")
    every = [
        *lens,
        "transforms.T_cam0_imu0",
        "transforms.T_imu1_imu0",
        "time_offsets.dt_imu0_cam0",
        "imus.imu0.noise",
        "imus.imu0.intrinsics",
    ]
    assert difference(old, made_from(2, ("a.bag", every), ("bb.bag", every))).notes == ()


@pytest.mark.slow
def test_parts_of_one_file_alone_are_listed() -> None:
    imu, cam = rig().imus["imu0"], rig().cameras["cam0"]
    less = rig().model_copy(update={"imus": {"imu0": imu.model_copy(update={"gyro_random_walk": None, "intrinsics": None})}})
    assert (difference(less, rig()).only_old, difference(less, rig()).only_new) == (
        (),
        ("imu0's gyro_random_walk", "imu0's scale and axes"),
    )
    bare = rig().model_copy(update={"imus": {"imu0": Imu(intrinsics=imu.intrinsics)}})
    assert difference(rig(), bare).only_old == ("imu0's noise",)
    rolling = cam.model_copy(update={"line_delay": Estimate(value=3e-5, unit="s", sigma=1e-7, status=Status.DETERMINED)})
    assert difference(rig(), rig().model_copy(update={"cameras": {"cam0": rolling}})).only_new == ("cam0's line delay",)


def test_names_are_those_of_the_first_file() -> None:
    new = Rig(transforms={"T_imu0_cam0": inverse_transform("T_cam0_imu0", with_transform(T_CAM0_IMU0).transforms["T_cam0_imu0"])})
    turned = named_as(with_transform(T_CAM0_IMU0), new).transforms["T_cam0_imu0"]
    assert np.array(turned.matrix) == pytest.approx(T_CAM0_IMU0, abs=1e-12)
    assert tangent_covariance(turned) == pytest.approx(COV_T, rel=1e-9, abs=1e-18)
