"""The closed forms of hand-eye: SPEC example 1, the seams, OpenCV 4 as the oracle, and motions that determine nothing."""

from itertools import combinations, product

import numpy as np
import pytest
from numpy.typing import NDArray

from calibkit.estimation.hand_eye_few_axes import SEEDS, no_axis, one_axis
from calibkit.estimation.hand_eye_methods import METHODS
from calibkit.estimation.hand_eye_pairs import Index, choose_motions, choose_pairs, motions, screw_mismatch, spectrum
from calibkit.estimation.hand_eye_world import SETUPS, WORLD_METHODS
from calibkit.geometry import se3, so3
from calibkit.opencv import cv2

Array = NDArray[np.float64]

METHOD_NAMES = sorted(METHODS)
WORLD_NAMES = sorted(WORLD_METHODS)
needs_opencv_4 = pytest.mark.skipif(not hasattr(cv2, "calibrateHandEye"), reason="OpenCV 5 has no calibrateHandEye to compare with")


def random_poses(rng: np.random.Generator, n: int, angle: float = 1.0, distance: float = 0.5) -> Array:
    return se3.make(so3.exp(angle * rng.normal(size=(n, 3))), distance * rng.normal(size=(n, 3)))


def with_noise(T: Array, rng: np.random.Generator, sigma_angle: float = 3e-3, sigma_p: float = 2e-3) -> Array:
    return T @ se3.make(so3.exp(sigma_angle * rng.normal(size=(len(T), 3))), sigma_p * rng.normal(size=(len(T), 3)))


def seen_as(X: Array, B: Array) -> Array:
    return X @ B @ se3.inverse(X)


def error(X: Array, truth: Array) -> tuple[float, float]:
    """rad, m."""
    return float(np.linalg.norm(so3.log(truth[:3, :3].T @ X[:3, :3]))), float(np.linalg.norm(X[:3, 3] - truth[:3, 3]))


def all_pairs(n: int) -> Index:
    """In OpenCV's order: from j to i for i < j."""
    return np.array([(j, i) for i, j in combinations(range(n), 2)])


X_SPEC = se3.make(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([0.1, -0.2, 0.3]))
BETA_SPEC = np.array([[0.0, 0, 1], [0, -1, 0]])
ALPHA_SPEC = np.array([[0.0, 0, 1], [1, 0, 0]])


def spec_motions(angle: float) -> tuple[Array, Array]:
    """SPEC example 1 at any angle, with slides along the axes."""
    p_b = np.array([[0.3, 0.1, -0.2], [0.2, -0.5, 0.1]])
    p_a = (seen_as(X_SPEC, se3.make(so3.exp(angle * BETA_SPEC), p_b)))[:, :3, 3]
    return se3.make(so3.exp(angle * ALPHA_SPEC), p_a), se3.make(so3.exp(angle * BETA_SPEC), p_b)


# ---- SPEC example 1 and the seams


@pytest.mark.parametrize("name", METHOD_NAMES)
@pytest.mark.parametrize("angle", [0.1, 0.5, 1.0, 2.0, 3.0, np.pi - 1e-2, np.pi - 1e-6, np.pi - 1e-9, np.pi])
def test_spec_example_1_is_exact(name: str, angle: float) -> None:
    X = METHODS[name](*spec_motions(angle), None)
    np.testing.assert_allclose(X, X_SPEC, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", METHOD_NAMES)
@pytest.mark.parametrize("angle", 10.0 ** np.arange(-12, -1))
def test_spec_example_1_of_small_motions_keeps_what_rounding_leaves(name: str, angle: float) -> None:
    X = METHODS[name](*spec_motions(angle), None)
    np.testing.assert_allclose(X[:3, :3], X_SPEC[:3, :3], rtol=0, atol=1e-16 / angle)


@pytest.mark.parametrize("name", METHOD_NAMES)
@pytest.mark.parametrize("signs", list(product([1, -1], [1, -1])))
def test_half_turns_are_tried_in_both_signs(name: str, signs: tuple[int, int]) -> None:
    """At 180 deg the logarithms' signs are chance; only the slides along the axes tell them apart, here between four rotations."""
    A, B = spec_motions(np.pi)
    off = np.array(signs)[:, None]
    for size in (1e-12, 1e-9, 1e-7):
        A = se3.make(so3.exp((np.pi + size * off) * ALPHA_SPEC), A[:, :3, 3])
        B = se3.make(so3.exp((np.pi - size * off) * BETA_SPEC), B[:, :3, 3])
        np.testing.assert_allclose(METHODS[name](A, B, None), X_SPEC, rtol=0, atol=max(10 * size, 1e-11))
    for seed in range(50):
        rng = np.random.default_rng(seed)
        A = with_noise(se3.make(so3.exp((np.pi + 1e-3 * off) * ALPHA_SPEC), A[:, :3, 3]), rng, 1e-3, 1e-3)
        assert error(METHODS[name](A, B, None), X_SPEC)[0] < 2e-2


@pytest.mark.parametrize("name", METHOD_NAMES)
def test_half_turns_among_noisy_motions_follow_the_others(name: str) -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        X = random_poses(rng, 1)[0]
        axes = rng.normal(size=(12, 3))
        angles = np.where(np.arange(12) < 6, np.pi + 2e-3 * rng.normal(size=12), 1.0)
        B = se3.make(so3.exp(axes / np.linalg.norm(axes, axis=1)[:, None] * angles[:, None]), rng.normal(size=(12, 3)))
        assert error(METHODS[name](with_noise(seen_as(X, B), rng, 1e-3, 1e-3), B, None), X)[0] < 3e-3


@pytest.mark.parametrize("name", sorted(set(METHODS) - {"andreff"}))
def test_three_half_turns_without_slides_have_one_answer(name: str) -> None:
    rng = np.random.default_rng(2)
    for _ in range(20):
        X = random_poses(rng, 1)[0]
        axes = rng.normal(size=(3, 3))
        B = se3.make(so3.exp(np.pi * axes / np.linalg.norm(axes, axis=1)[:, None]), np.zeros(3))
        X[:3, 3] = 0
        condition = float(np.linalg.cond(axes / np.linalg.norm(axes, axis=1)[:, None]))
        np.testing.assert_allclose(METHODS[name](seen_as(X, B), B, None), X, rtol=0, atol=1e-14 * condition**2)


@pytest.mark.parametrize("name", METHOD_NAMES)
@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 2.09, np.radians(120) - 1e-9, np.radians(120) + 1e-9, 2.1, 3.1, np.pi - 1e-9, np.pi])
def test_any_rotation_of_x_is_found(name: str, angle: float) -> None:
    """Tsai's Gibbs vector is infinite at 180 deg; at 120 deg the frame that it is solved in changes."""
    rng = np.random.default_rng(3)
    axes = [*np.eye(3), *(np.array(v) / np.linalg.norm(v) for v in ([1, 1, 0], [1, -1, 1], *rng.normal(size=(5, 3))))]
    X = se3.make(so3.exp(angle * np.array(axes)), rng.normal(size=(10, 3)))
    B = random_poses(rng, 60).reshape(10, 6, 4, 4)
    found = METHODS[name](X[:, None] @ B @ se3.inverse(X)[:, None], B, None)
    np.testing.assert_allclose(found, X, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", METHOD_NAMES)
@pytest.mark.parametrize("angle", [1e-6, 1e-4, 1e-2, 0.1, 1.0])
def test_noise_free_motions_give_x_to_rounding(name: str, angle: float) -> None:
    rng = np.random.default_rng(4)
    X = random_poses(rng, 100)
    B = random_poses(rng, 500, angle).reshape(100, 5, 4, 4)
    found = METHODS[name](X[:, None] @ B @ se3.inverse(X)[:, None], B, None)
    # 45 roundings: five random axes of 100 sets come near one line.
    assert np.abs(found - X)[..., :3, :3].max() < 1e-14 / angle
    assert np.abs(found - X)[..., :3, 3].max() < 1e-14 / angle**2


# ---- the same equation however it is asked


@pytest.mark.parametrize("name", METHOD_NAMES)
def test_a_batch_is_its_parts(name: str) -> None:
    rng = np.random.default_rng(5)
    A, B = random_poses(rng, 70).reshape(2, 5, 7, 4, 4), random_poses(rng, 70).reshape(2, 5, 7, 4, 4)
    A[0, 1, 3, :3, :3] = so3.exp(np.array([np.pi, 0, 0]))
    B[0, 1, 3, :3, :3] = so3.exp(np.array([0, np.pi, 0]))
    weights = rng.uniform(size=(2, 5, 7))
    whole = METHODS[name](A, B, weights)
    for i, j in product(range(2), range(5)):
        np.testing.assert_allclose(METHODS[name](A[i, j], B[i, j], weights[i, j]), whole[i, j], rtol=0, atol=1e-10)


@pytest.mark.parametrize("name", METHOD_NAMES)
def test_a_weight_is_a_number_of_repetitions(name: str) -> None:
    rng = np.random.default_rng(6)
    X = random_poses(rng, 1)[0]
    B = random_poses(rng, 6)
    A = with_noise(seen_as(X, B), rng)
    weights = np.array([1, 2, 0, 3, 1, 1])
    repeated = METHODS[name](np.repeat(A, weights, axis=0), np.repeat(B, weights, axis=0), None)
    np.testing.assert_allclose(METHODS[name](A, B, 5.0 * weights), repeated, rtol=0, atol=1e-12)
    assert np.abs(METHODS[name](A, B, None) - repeated).max() > 1e-5


@pytest.mark.parametrize("name", WORLD_NAMES)
def test_robot_world_weights_and_batches(name: str) -> None:
    rng = np.random.default_rng(7)
    X, Z = random_poses(rng, 2)
    P = random_poses(rng, 8)
    Q = with_noise(se3.inverse(Z) @ P @ X, rng)
    weights = np.array([1, 2, 0, 3, 1, 1, 1, 1])
    repeated = WORLD_METHODS[name](np.repeat(P, weights, axis=0), np.repeat(Q, weights, axis=0), None)
    weighted = WORLD_METHODS[name](np.stack([P, P[::-1]]), np.stack([Q, Q[::-1]]), 0.5 * np.stack([weights, weights[::-1]]))
    for both, one in zip(weighted, repeated, strict=True):
        np.testing.assert_allclose(both, [one, one], rtol=0, atol=1e-12)


@pytest.mark.parametrize("solve", [*METHODS.values(), *WORLD_METHODS.values(), one_axis, no_axis])
def test_what_cannot_be_solved_is_refused_at_the_door(solve) -> None:  # type: ignore[no-untyped-def]
    A = np.tile(np.eye(4), (3, 1, 1))
    for a, b, weights in (
        (A, A[:2], None),
        (A[0], A[0], None),
        (A[:0], A[:0], None),
        (A[:, :3], A[:, :3], None),
        (A * np.nan, A, None),
        (A, A, np.array([1, -1, 1])),
        (A, A, np.array([1, np.inf, 1])),
    ):
        with pytest.raises(ValueError, match="hand-eye needs"):
            solve(a, b, weights)


# ---- frames (SPEC section 1)


@pytest.mark.parametrize("name", WORLD_NAMES)
def test_frames_are_those_of_the_spec(name: str) -> None:
    rng = np.random.default_rng(8)
    T_base_gripper = random_poses(rng, 12)
    X, fixed = random_poses(rng, 2)
    i, j = np.triu_indices(12, 1)
    # Eye in hand: the target stands still in the base; eye to hand: the camera does, the target sits on the gripper.
    setups = {
        "eye-in-hand": (se3.inverse(T_base_gripper @ X) @ fixed, se3.inverse(T_base_gripper[i]) @ T_base_gripper[j]),
        "eye-to-hand": (se3.inverse(X) @ T_base_gripper @ fixed, T_base_gripper[i] @ se3.inverse(T_base_gripper[j])),
    }
    for setup, (T_cam_target, A) in setups.items():
        P, Q = SETUPS[setup](T_base_gripper, T_cam_target)
        pairs = np.stack([i, j], axis=-1)
        np.testing.assert_allclose(motions(P, pairs), A, rtol=0, atol=1e-13)
        np.testing.assert_allclose(motions(Q, pairs), T_cam_target[i] @ se3.inverse(T_cam_target[j]), rtol=0, atol=1e-13)
        np.testing.assert_allclose(WORLD_METHODS[name](P, Q, None), [X, fixed], rtol=0, atol=1e-12)
        np.testing.assert_allclose(METHODS["park"](A, motions(Q, pairs), None), X, rtol=0, atol=1e-12)
    P, Q = SETUPS["motion"](T_base_gripper, se3.inverse(fixed) @ T_base_gripper @ X)
    np.testing.assert_allclose(WORLD_METHODS[name](P, Q, None), [X, fixed], rtol=0, atol=1e-12)


# ---- OpenCV 4, the oracle: it uses all pairs, from j to i for i < j


# Seven poses, any two 30 to 110 deg apart: OpenCV's Tsai leaves out pairs of less than 15 deg and more than about 115 deg.
TURNS_APART = 0.8 * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])


def recorded(seed: int, turns: Array | None = None, noise: bool = True) -> tuple[Array, Array, Array]:
    """X of 109 deg, and T_base_gripper and T_cam_target of an eye in the hand."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    X = se3.make(so3.exp(1.9 * axis / np.linalg.norm(axis)), rng.normal(size=3) * 0.1)
    T_base_target = random_poses(rng, 1)[0]
    turns = rng.normal(size=(30, 3)) if turns is None else turns + 0.05 * rng.normal(size=turns.shape)
    T_base_gripper = se3.make(so3.exp(turns), 0.3 * rng.normal(size=turns.shape))
    T_target_cam = se3.inverse(T_base_target) @ T_base_gripper @ X
    if noise:
        T_base_gripper, T_target_cam = with_noise(T_base_gripper, rng), with_noise(T_target_cam, rng)
    return X, T_base_gripper, se3.inverse(T_target_cam)


def parts(T: Array) -> tuple[list[Array], list[Array]]:
    return list(T[:, :3, :3]), list(T[:, :3, 3])


def opencv_hand_eye(name: str, T_base_gripper: Array, T_cam_target: Array) -> Array:
    R, t = cv2.calibrateHandEye(*parts(T_base_gripper), *parts(T_cam_target), method=getattr(cv2, f"CALIB_HAND_EYE_{name.upper()}"))
    return se3.make(R, t[:, 0])


def from_all_pairs(name: str, T_base_gripper: Array, T_cam_target: Array) -> Array:
    P, Q = SETUPS["eye-in-hand"](T_base_gripper, T_cam_target)
    pairs = all_pairs(len(P))
    return METHODS[name](motions(P, pairs), motions(Q, pairs), None)


@needs_opencv_4
@pytest.mark.parametrize("name", METHOD_NAMES)
@pytest.mark.parametrize("noise", [False, True])
def test_methods_are_opencvs_on_the_same_pairs(name: str, noise: bool) -> None:
    for seed in range(10):
        _, T_base_gripper, T_cam_target = recorded(seed, TURNS_APART, noise)
        ours = from_all_pairs(name, T_base_gripper, T_cam_target)
        np.testing.assert_allclose(ours, opencv_hand_eye(name, T_base_gripper, T_cam_target), rtol=0, atol=1e-10)


@needs_opencv_4
@pytest.mark.parametrize("name", WORLD_NAMES)
@pytest.mark.parametrize("noise", [False, True])
def test_robot_world_methods_are_opencvs(name: str, noise: bool) -> None:
    """OpenCV solves T_cam_target X = Z T_gripper_base, and has X = T_target_base, Z = T_cam_gripper."""
    for seed in range(10):
        _, T_base_gripper, T_cam_target = recorded(seed, TURNS_APART, noise)
        T_gripper_base = se3.inverse(T_base_gripper)
        method = getattr(cv2, f"CALIB_ROBOT_WORLD_HAND_EYE_{name.upper()}")
        R_X, t_X, R_Z, t_Z = cv2.calibrateRobotWorldHandEye(*parts(T_cam_target), *parts(T_gripper_base), method=method)
        X, Z = WORLD_METHODS[name](T_cam_target, T_gripper_base, None)
        np.testing.assert_allclose(X, se3.make(R_X, t_X[:, 0]), rtol=0, atol=1e-10)
        np.testing.assert_allclose(Z, se3.make(R_Z, t_Z[:, 0]), rtol=0, atol=1e-10)


# ---- noise of 3 mrad and 2 mm


@pytest.mark.parametrize("name", METHOD_NAMES)
def test_noisy_poses_give_what_the_best_tools_give(name: str) -> None:
    """Medians of 0.08 deg and 1.35 mm at most: 30 poses turned by 0.6 rad a coordinate, one side noisy."""
    errors = []
    pairs = all_pairs(30)
    for seed in range(40):
        rng = np.random.default_rng(seed)
        X, P = random_poses(rng, 1, 1.0, 0.1)[0], random_poses(rng, 30, 0.6, 0.3)
        Q = with_noise(P @ X, rng)
        errors.append(error(METHODS[name](motions(P, pairs), motions(Q, pairs), None), X))
    angle, distance = np.median(errors, axis=0)
    assert np.degrees(angle) < 0.08
    assert distance < 1.35e-3


def test_tsai_is_as_good_where_x_is_a_half_turn() -> None:
    """Without another frame to solve in (OpenCV 4.14) the errors here are up to 65 deg, the median 4 deg."""
    for seed in range(20):
        X, T_base_gripper, T_cam_target = recorded(seed)
        half_turn = se3.make(so3.exp(np.pi * np.array([0.6, 0, 0.8])), X[:3, 3])
        T_cam_target = se3.inverse(half_turn) @ X @ T_cam_target
        found = from_all_pairs("tsai", T_base_gripper, T_cam_target)
        assert error(found, half_turn)[0] < 5e-3


# ---- motions that determine nothing


def degenerate_sets() -> dict[str, tuple[Array, Array, int]]:
    """Motions A and B without noise, and how many axes they turn about."""
    rng = np.random.default_rng(9)
    X = random_poses(rng, 1)[0]
    axis = rng.normal(size=3)
    one = se3.make(so3.exp(axis / np.linalg.norm(axis) * rng.uniform(-2, 2, (8, 1))), rng.normal(size=(8, 3)))
    half = se3.make(so3.exp(np.pi * np.tile(axis / np.linalg.norm(axis), (3, 1))), rng.normal(size=(3, 3)))
    shifts = se3.make(np.eye(3), rng.normal(size=(5, 3)))
    sets = {
        "one axis": (one, 1),
        "one axis without translation": (se3.make(one[:, :3, :3], np.zeros(3)), 1),
        "one motion": (one[:1], 1),
        "half turns about one axis": (half, 1),
        "translations": (shifts, 0),
        "one translation": (shifts[:1], 0),
        "rest": (np.tile(np.eye(4), (4, 1, 1)), 0),
        "a translation and a turn": (np.stack([shifts[0], one[0]]), 1),
        "tiny turns about one axis": (se3.make(so3.exp(1e-9 * so3.log(one[:, :3, :3])), one[:, :3, 3]), 1),
    }
    return {name: (seen_as(X, B), B, rank) for name, (B, rank) in sets.items()}


@pytest.mark.parametrize("name", list(degenerate_sets()))
@pytest.mark.parametrize("noise", [False, True])
def test_degenerate_motions_are_finite_and_seen(name: str, noise: bool) -> None:
    A, B, rank = degenerate_sets()[name]
    if noise:
        A = with_noise(A, np.random.default_rng(10), 1e-3, 1e-3)
    results = [solve(A, B, None) for solve in (*METHODS.values(), *SEEDS.values())]
    results += [solve(A, B, np.zeros(len(A))) for solve in (*METHODS.values(), *SEEDS.values())]
    results += [T for solve in WORLD_METHODS.values() for T in solve(A, B, None)]
    for X in results:
        assert np.isfinite(X).all()
        np.testing.assert_allclose(X[:3, :3] @ X[:3, :3].T, np.eye(3), rtol=0, atol=1e-12)
        assert np.linalg.det(X[:3, :3]) > 0
    if name != "tiny turns about one axis" or not noise:
        assert spectrum(A).rank(1e-3 if noise else 0.0) == rank


@pytest.mark.parametrize("name", ["tsai", "park", "horaud"])
def test_rounding_is_not_taken_for_the_way_along_a_lone_axis(name: str) -> None:
    for A, B, rank in degenerate_sets().values():
        if rank == 1 and np.ptp(B[:, :3, 3]) > 0:
            t = METHODS[name](A, B, None)[:3, 3]
            assert abs(t @ spectrum(A).axis_directions[:, 0]) < 1e-6 * np.linalg.norm(t)


def test_noise_alone_is_not_taken_for_an_axis() -> None:
    """One axis, 3 mrad of noise: at most 1 set in 100 is said to have two (150 sets: five or more would have a chance of 1 in 50)."""
    rng = np.random.default_rng(11)
    for n in (2, 5, 30, 300):
        turns = so3.exp(np.array([0.2, 0.5, -0.1]) * rng.uniform(-2, 2, (150, n, 1)))
        A = se3.make(turns @ so3.exp(3e-3 * rng.normal(size=(150, n, 3))), np.zeros(3))
        assert np.count_nonzero(spectrum(A).rank(3e-3) > 1) < 5
        turns = turns @ so3.exp(np.array([0, 0, 0.1]) * rng.normal(size=(150, n, 1)))
        assert np.count_nonzero(spectrum(se3.make(turns, np.zeros(3))).rank(3e-3) > 1) > 120


def test_spectrum_names_the_directions() -> None:
    A = se3.make(so3.exp(np.array([[0, 0, 1.0], [0, 0, -0.5], [0.2, 0, 0]])), np.zeros(3))
    found = spectrum(A)
    np.testing.assert_allclose(found.axes, [1.25, 0.04, 0], rtol=0, atol=1e-15)
    np.testing.assert_allclose(found.turn, [0.04, 1.25, 1.29], rtol=0, atol=1e-15)
    np.testing.assert_allclose(np.abs(found.axis_directions), np.eye(3)[:, [2, 0, 1]], rtol=0, atol=1e-15)
    # |R - I|^2 across the axis is 4 sin^2(angle / 2).
    about_z, about_x = 4 * (np.sin(0.5) ** 2 + np.sin(0.25) ** 2), 4 * np.sin(0.1) ** 2
    np.testing.assert_allclose(found.shift, [about_z + about_x, about_z, about_x], rtol=0, atol=1e-15)
    np.testing.assert_allclose(np.abs(found.shift_directions[:, 2]), [0, 0, 1], rtol=0, atol=1e-15)
    batched = spectrum(np.stack([A, A[::-1]]))
    np.testing.assert_allclose(batched.axes, [found.axes, found.axes], rtol=0, atol=1e-15)
    assert batched.rank(1e-3).tolist() == [2, 2]


def test_one_axis_gives_what_its_translations_tell() -> None:
    rng = np.random.default_rng(12)
    for name in ("one axis", "half turns about one axis", "a translation and a turn"):
        for _ in range(10):
            X = random_poses(rng, 1)[0]
            _, B, _ = degenerate_sets()[name]
            A = seen_as(X, B)
            found = one_axis(A, B, None)
            axis = spectrum(A).axis_directions[:, 0]
            np.testing.assert_allclose(found[:3, :3], X[:3, :3], rtol=0, atol=1e-12)
            np.testing.assert_allclose(found[:3, 3], X[:3, 3] - (X[:3, 3] @ axis) * axis, rtol=0, atol=1e-12)
    np.testing.assert_allclose(one_axis(np.stack([A, A]), np.stack([B, B]), None), [found, found], rtol=0, atol=1e-13)


def test_one_axis_with_opposed_frames() -> None:
    """The axis is z in one frame and nearly -z in the other: between the two there is no middle."""
    rng = np.random.default_rng(18)
    B = se3.make(so3.exp(rng.normal(size=(6, 1)) * [0, 0, 1.0]), rng.normal(size=(6, 3)))
    for off in (0.0, *10.0 ** np.arange(-16, 0)):
        X = se3.make(so3.exp(np.array([np.pi - off, 0, 0])), np.array([0.3, 0, 0]))
        np.testing.assert_allclose(one_axis(seen_as(X, B), B, None), X, rtol=0, atol=1e-13)


def test_one_axis_of_a_noisy_vehicle() -> None:
    """Planar motion: t along the axis stays 0 where a full closed form puts metres of noise there."""
    rng = np.random.default_rng(13)
    X = random_poses(rng, 1)[0]
    n = 200
    A = se3.make(so3.exp(np.array([0, 0, 0.5]) * rng.normal(size=(n, 1))), rng.normal(size=(n, 3)) * [1, 1, 0])
    B = with_noise(se3.inverse(X) @ A @ X, rng, 1e-3, 5e-3)
    found = one_axis(A, B, None)
    assert error(found, X)[0] < 2e-3
    np.testing.assert_allclose(found[:2, 3], X[:2, 3], rtol=0, atol=3e-3)
    assert abs(found[2, 3]) < 1e-2


def test_translations_alone_give_the_rotation() -> None:
    rng = np.random.default_rng(14)
    X = random_poses(rng, 1)[0]
    B = se3.make(np.eye(3), rng.normal(size=(4, 3)))
    np.testing.assert_allclose(no_axis(seen_as(X, B), B, None), se3.make(X[:3, :3], np.zeros(3)), rtol=0, atol=1e-14)


# ---- pairs


def test_screws_of_one_rig_agree() -> None:
    rng = np.random.default_rng(15)
    X = random_poses(rng, 1)[0]
    axes = rng.normal(size=(300, 3))
    angles = np.concatenate([rng.uniform(0.01, np.pi, 200), np.full(100, np.pi)])
    B = se3.make(so3.exp(axes / np.linalg.norm(axes, axis=1)[:, None] * angles[:, None]), rng.normal(size=(300, 3)))
    angle, slide = screw_mismatch(seen_as(X, B), B)
    np.testing.assert_allclose(angle, 0, rtol=0, atol=1e-13)
    np.testing.assert_allclose(slide, 0, rtol=0, atol=1e-11)
    beyond = se3.make(
        so3.exp((np.pi + 1e-9) * axes / np.linalg.norm(axes, axis=1)[:, None]), B[:, :3, 3]
    )  # the logarithm's axis turns round
    angle, slide = screw_mismatch(seen_as(X, beyond)[200:], B[200:])
    np.testing.assert_allclose(angle, 0, rtol=0, atol=2e-9)
    np.testing.assert_allclose(slide, 0, rtol=0, atol=1e-8)
    angle, slide = screw_mismatch(seen_as(X, B), np.roll(B, 1, axis=0))
    assert np.median(np.abs(angle)) > 0.1
    assert np.median(np.abs(slide)) > 0.1
    assert all(np.array_equal(v, np.zeros(1)) for v in screw_mismatch(np.eye(4)[None], se3.make(np.eye(3), np.ones((1, 3)))))


def information(v: Array) -> float:
    return float(np.linalg.slogdet(v.T @ v)[1])


def test_chosen_pairs_tell_more_than_chance_or_neighbours() -> None:
    rng = np.random.default_rng(16)
    poses = se3.make(so3.exp(rng.normal(size=(40, 3)) * [0.1, 0.3, 0.6]), rng.normal(size=(40, 3)))
    pairs = choose_pairs(poses, 40)
    assert pairs.shape == (40, 2)
    assert len(np.unique(np.sort(pairs, axis=1), axis=0)) == 40
    assert np.bincount(pairs.ravel()).max() <= 4

    def of(chosen: Index) -> float:
        return information(so3.to_quat(motions(poses, chosen)[:, :3, :3])[:, :3])

    every = np.array(list(combinations(range(40), 2)))
    by_chance = max(of(every[rng.choice(len(every), 40, replace=False)]) for _ in range(200))
    assert of(pairs) > by_chance + 1
    assert of(pairs) > of(np.stack([np.arange(39), np.arange(1, 40)], axis=1)) + 1


def test_first_chosen_axes_are_not_parallel() -> None:
    angles = np.array([[2.0, 0, 0], [1.9, 0.1, 0], [1.8, 0, 0.1], [0, 0.5, 0], [0, 0, 0.4], [0.001, 0, 0], [0, 0, 0]])
    A = se3.make(so3.exp(angles), np.arange(21.0).reshape(7, 3))
    assert choose_motions(A, 3).tolist() == [0, 3, 4]
    assert sorted(choose_motions(A, 100)) == [0, 1, 2, 3, 4]  # neither rest nor translation nor next to none
    assert choose_motions(A[5:], 3).tolist() == []


def test_too_few_poses_have_no_pairs() -> None:
    assert choose_pairs(np.eye(4)[None], 5).shape == (0, 2)
    assert choose_pairs(np.zeros((0, 4, 4)), 5).shape == (0, 2)
    assert choose_pairs(np.stack([np.eye(4), np.eye(4)]), 5).shape == (0, 2)
    assert choose_pairs(random_poses(np.random.default_rng(0), 2), 5).tolist() == [[0, 1]]


def test_long_recordings_have_their_pairs_spread() -> None:
    rng = np.random.default_rng(17)
    for n in (400, 20_000):
        poses = random_poses(rng, n)
        pairs = choose_pairs(poses, 60)
        assert len(pairs) == 60
        assert pairs.min() >= 0
        assert pairs.max() < n
        assert (pairs[:, 0] < pairs[:, 1]).all()
        assert np.bincount(pairs.ravel()).max() <= 2
        assert np.linalg.norm(so3.log(motions(poses, pairs)[:, :3, :3]), axis=-1).min() > 2
