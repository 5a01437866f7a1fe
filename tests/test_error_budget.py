"""What sigmas cost: the worked example, and lenses and transforms against draws through real projections."""

import numpy as np
import pytest
from drawn_rigs import COV_LENS, COV_T, camera, lens, offset, rig
from rigs import LENSES, T_CAM0_IMU0

from calibkit.data.rig import TRANSFORM_PARAMETERS, Estimate, Rig
from calibkit.data.transforms import make_time_offset, make_transform
from calibkit.data.verdict import Status
from calibkit.errors import BadInputError
from calibkit.estimation.error_budget import Cost, Use, budget, lens_costs, transform_jacobians
from calibkit.estimation.pixel_shift import known_lens, lens_shifts, transform_shifts
from calibkit.estimation.time_offset_result import smear
from calibkit.geometry import se3, so3
from calibkit.models.cameras import CAMERAS

PINHOLE = camera("pinhole-radtan", np.array([500, 500, 375.5, 239.5, 0, 0, 0, 0.0]), COV_LENS)


def of(costs: list[Cost], entry: str, term: str) -> Cost:
    return next(cost for cost in costs if (cost.entry, cost.term) == (entry, term))


def whitened(cov: np.ndarray, n: int, seed: int = 0) -> np.ndarray:
    """Draw n vectors whose mean is 0 and whose covariance is `cov` to the last digit: what is left to chance is of higher order."""
    d = np.random.default_rng(seed).normal(size=(n, len(cov)))
    d -= d.mean(axis=0)
    return d @ np.linalg.inv(np.linalg.cholesky(d.T @ d / n)).T @ np.linalg.cholesky(cov).T


def with_transform(name: str, T: np.ndarray, cov=COV_T, status=Status.DETERMINED, **more) -> Rig:
    _, a, b = name.split("_")
    return Rig(cameras={"cam0": PINHOLE}, transforms={name: make_transform(a, b, T, cov, status, **more)})


def test_worked_example_3() -> None:
    """5 ms at f = 500 px are 2.5 px at 1 rad/s and 7.5 px at 3; 2 cm are 2 cm/s at 1 rad/s."""
    dt = make_time_offset("imu0", "cam0", offset(0.0, 0.005))
    cov = np.diag([0.02**2, 0, 0, 0, 0, 0])
    given = Rig(cameras={"cam0": PINHOLE}, transforms={"T_cam0_imu0": make_transform("cam0", "imu0", T_CAM0_IMU0, cov, Status.DETERMINED)},
                time_offsets={"dt_imu0_cam0": dt})  # fmt: skip
    for rate, px in ((1.0, 2.5), (3.0, 7.5)):
        cost = of(budget(given, Use(rate, 10.0, 0.5)), "dt_imu0_cam0", "time offset (turning)")
        assert cost.px == pytest.approx(px)
        assert f"{cost.px:.2g} px" == smear(rate, 0.005, 500.0)
        assert cost.metres == pytest.approx(10.0 * rate * 0.005)
        assert cost.velocity == pytest.approx(0.5 * rate * 0.005)
    assert of(budget(given, Use(1.0)), "T_cam0_imu0", "lever arm").velocity == pytest.approx(0.02)
    moving = of(budget(given, Use(speed=3.0, range_m=6.0)), "dt_imu0_cam0", "time offset (moving)")
    assert (moving.metres, moving.px) == pytest.approx((0.015, 500 * 0.015 / 6))


@pytest.mark.parametrize(("name", "T"), [("T_cam0_imu0", T_CAM0_IMU0), ("T_imu0_cam0", se3.inverse(T_CAM0_IMU0))])
@pytest.mark.parametrize("range_m", [0.5, 10.0])
def test_a_transform_costs_what_draws_of_it_do(name: str, T: np.ndarray, range_m: float) -> None:
    base = with_transform(name, T)
    for part, term in ((slice(0, 3), "lever arm"), (slice(3, 6), "rotation")):
        cov = np.zeros((6, 6))
        cov[part, part] = COV_T[part, part]
        model, params = CAMERAS["pinhole-radtan"], known_lens("cam0", PINHOLE).params
        rays = known_lens("cam0", PINHOLE).rays()[1]
        p_cam = range_m * rays
        p_imu = se3.transform(se3.inverse(T_CAM0_IMU0), p_cam)
        uv, px, metres = model.project(p_cam, params).uv, [], []
        for d in whitened(COV_T[part, part], 100):
            step = np.zeros(6)
            step[part] = d
            drawn = se3.retract(T, step)
            moved = se3.transform(drawn if name == "T_cam0_imu0" else se3.inverse(drawn), p_imu)
            px.append(np.sum((model.project(moved, params).uv - uv) ** 2, axis=1))
            metres.append(np.sum((moved - p_cam) ** 2, axis=1))
        cost = of(budget(base, Use(range_m=range_m)), name, term)
        assert cost.px == pytest.approx(np.sqrt(np.mean(px)), rel=0.05)
        assert cost.metres == pytest.approx(np.sqrt(np.mean(metres)), rel=0.05)


def test_without_a_camera_the_points_are_all_around() -> None:
    name, rng = "T_imu1_imu0", np.random.default_rng(1)
    entry = rig().transforms[name]
    points = rng.normal(size=(2000, 3))
    points *= 10 / np.linalg.norm(points, axis=1)[:, None]
    for part, term in ((slice(0, 3), "lever arm"), (slice(3, 6), "rotation")):
        cost = of(budget(Rig(transforms={name: entry}), Use()), name, term)
        drawn = whitened(COV_T[part, part], len(points))
        moved = np.cross(drawn, points) if term == "rotation" else drawn
        assert cost.metres == pytest.approx(np.sqrt(np.mean(np.sum(moved**2, axis=1))), rel=0.05)
        assert cost.px is None
        assert (cost.acceleration is None) == (term == "lever arm")


@pytest.mark.parametrize("model", ["pinhole-radtan", "pinhole-equi"])
def test_a_lens_costs_what_draws_of_it_do(model: str) -> None:
    x = np.array(LENSES[model])
    one = known_lens("cam0", camera(model, x, COV_LENS))
    px, angle = lens_costs(one, COV_LENS)
    uv, rays = one.rays()
    seen, squares, angles = np.isfinite(rays).all(axis=1), [], []
    for d in whitened(COV_LENS, 16):
        other = known_lens("cam0", camera(model, x + d, COV_LENS))
        turned = next(shift for shift in lens_shifts(one, other) if shift.what == "turned along")
        squares.append(turned.rms**2)
        back = CAMERAS[model].unproject(uv[seen] - turned.moved[seen], x)[0]
        angles.append(np.nanmean(np.sum((back - rays[seen]) ** 2, axis=1)))
    assert px == pytest.approx(np.sqrt(np.mean(squares)), rel=0.05)
    assert angle == pytest.approx(np.sqrt(np.mean(angles)), rel=0.05)


def test_turning_along_takes_out_what_a_turn_explains() -> None:
    old = known_lens("cam0", camera("pinhole-radtan", lens(), None))
    new = known_lens("cam0", camera("pinhole-radtan", lens() + np.array([0, 0, 3.0, -2.0, 0, 0, 0, 0]), None))
    as_it_is, turned, *moved = lens_shifts(old, new)
    assert as_it_is.length == pytest.approx(np.sqrt(13))
    assert turned.rms < 0.3 * as_it_is.rms
    assert [shift.range_m for shift in moved] == [0.5, 2.0, np.inf]
    for way in np.random.default_rng(0).normal(size=(20, 3)):  # no other turn does better
        uv, rays = old.rays()
        around = new.pixels(rays @ so3.exp(np.array([2.0, 3.0, 0]) / 458 + 1e-3 * way).T) - uv
        assert np.sqrt(np.nanmean(np.sum(around**2, axis=1))) >= turned.rms


def test_the_implied_motion_is_the_one_that_fits_all_ranges() -> None:
    old = known_lens("cam0", camera("pinhole-radtan", lens(), None))
    new = known_lens("cam0", camera("pinhole-radtan", lens() * np.array([1.01, 1.01, 1, 1, 1, 1, 1, 1]), None))
    shifts = {(shift.what, shift.range_m): shift.rms for shift in lens_shifts(old, new)}
    near, far = shifts["turned and moved along", 0.5], shifts["turned and moved along", np.inf]
    assert near < shifts["turned along", np.inf]  # a longer lens looks like one that is nearer, but not at all ranges
    assert far == pytest.approx(shifts["turned along", np.inf], rel=0.01)


@pytest.mark.parametrize("name", ["T_cam0_imu0", "T_imu0_cam0"])
def test_the_shift_of_a_moved_camera_falls_with_the_range_and_of_a_turned_one_stays(name: str) -> None:
    def moved(step: list[float]) -> dict[float, float]:
        T = se3.inverse(se3.retract(se3.inverse(T_CAM0_IMU0), np.array(step)))  # in the camera's frame
        pair = [with_transform(name, X if name == "T_cam0_imu0" else se3.inverse(X)) for X in (T_CAM0_IMU0, T)]
        return {shift.range_m: shift.rms for shift in transform_shifts(name, *pair) if shift.what == "cam0, alone"}

    along_x = moved([0.001, 0, 0, 0, 0, 0])
    assert along_x[2.0] == pytest.approx(along_x[0.5] / 4, rel=0.01)
    assert along_x[np.inf] == pytest.approx(0.0, abs=1e-6)
    about_y = moved([0, 0, 0, 0, 0.001, 0])
    assert about_y[0.5] == pytest.approx(about_y[np.inf], rel=1e-6)
    assert about_y[np.inf] == pytest.approx(0.5 * 1.15, rel=0.15)  # f phi in the middle, more towards the sides


def test_the_lens_that_changed_with_its_camera_counts_with_it() -> None:
    """The centre moved by what the camera turned back: together they move pixels less than each alone."""
    turn = se3.make(so3.exp(np.array([0, 0.004, 0])), np.zeros(3))
    old = with_transform("T_cam0_imu0", T_CAM0_IMU0)
    new = with_transform("T_cam0_imu0", turn @ T_CAM0_IMU0)
    params = known_lens("cam0", PINHOLE).params + np.array([0, 0, -2.0, 0, 0, 0, 0, 0])
    new = new.model_copy(update={"cameras": {"cam0": camera("pinhole-radtan", params, COV_LENS)}})
    far = {shift.what: shift.rms for shift in transform_shifts("T_cam0_imu0", old, new) if np.isinf(shift.range_m)}
    assert far["cam0, alone"] > 2.0
    assert far["cam0, with the lens"] < 0.7


def test_costs_are_in_order_and_what_is_not_known_comes_first() -> None:
    statuses = {name: Status.NOT_OBSERVABLE if name == "p_z" else Status.DETERMINED for name in TRANSFORM_PARAMETERS}
    part = with_transform("T_cam0_imu0", T_CAM0_IMU0, COV_T, Status.NOT_OBSERVABLE, statuses=statuses)
    known = rig()
    mixed = known.model_copy(
        update={
            "transforms": {**part.transforms, "T_cam1_cam0": make_transform("cam1", "cam0", np.eye(4))},
            "time_offsets": {"dt_imu0_cam0": make_time_offset("imu0", "cam0", offset(None, None))},
        }
    )
    costs = budget(mixed, Use())
    assert [(cost.entry, cost.term) for cost in costs if cost.known == "unbounded"] == [
        ("T_cam0_imu0", "lever arm"),
        ("dt_imu0_cam0", "time offset (turning)"),
    ]
    assert {cost.entry for cost in costs if cost.known == "unknown"} == {"T_cam1_cam0"}
    assert all(cost.px is None and cost.metres is None for cost in costs if cost.known != "known")
    assert [cost.known for cost in costs] == ["unbounded"] * 2 + ["unknown"] * 2 + ["known"] * 2
    metres = [cost.metres for cost in budget(known, Use())]
    assert metres == sorted(metres, reverse=True)
    assert "joint" in of(costs, "T_cam0_imu0", "rotation").remedy


def test_a_shutter_costs_at_the_first_row() -> None:
    rolling = PINHOLE.model_copy(update={"line_delay": Estimate(value=2e-5, unit="s", sigma=1e-7, status=Status.DETERMINED)})
    cost = of(budget(Rig(cameras={"cam0": rolling}), Use(rate=2.0)), "cam0", "line delay (first row)")
    assert cost.px == pytest.approx(500 * 2.0 * 240 * 1e-7)


def test_a_lens_that_sees_nothing_is_named() -> None:
    nothing = camera("pinhole-radtan", np.array([0.0] * 8), COV_LENS)
    with pytest.raises(BadInputError, match="cam0: no pixel of its image sees anything"):
        budget(Rig(cameras={"cam0": nothing}), Use())


def test_a_lens_that_is_not_observable_leaves_the_camera_without_pixels() -> None:
    values = {**PINHOLE.parameters, "p1": Estimate(value=None, status=Status.NOT_OBSERVABLE)}
    blind = PINHOLE.model_copy(update={"parameters": values, "covariance": None})
    costs = budget(with_transform("T_cam0_imu0", T_CAM0_IMU0).model_copy(update={"cameras": {"cam0": blind}}), Use())
    assert of(costs, "cam0", "lens").known == "unbounded"
    assert of(costs, "T_cam0_imu0", "rotation").px is None
    assert of(costs, "T_cam0_imu0", "rotation").metres > 0
    across, pixels = transform_jacobians("T_cam0_imu0", with_transform("T_cam0_imu0", T_CAM0_IMU0).transforms["T_cam0_imu0"], Rig(), 1.0)
    assert (across.shape, pixels) == ((6, 3, 6), None)
