"""Camera models: Jacobians, round trips, domains, and OpenCV as the outsider."""

import numpy as np
import pytest

from calibkit.models.cameras import CAMERAS, CameraModel
from calibkit.opencv import cv2

LENSES = {
    "pinhole-none": [458.6, 457.3, 367.2, 248.4],
    "pinhole-radtan": [458.6, 457.3, 367.2, 248.4, -0.283, 0.074, 2e-4, 2e-5],
    "pinhole-radtan5": [1056.2, 1056.3, 958.9, 587.1, -0.130, 0.0955, 3e-4, -2e-4, -0.045],
    "pinhole-radtan8": [610.0, 612.0, 640.0, 360.0, 0.4, -0.2, 1e-4, -3e-4, 0.05, 0.7, -0.1, 0.02],
    "pinhole-equi": [383.5, 384.5, 638.6, 477.5, 0.0404, -0.0492, 0.021, -0.00347],
}


def _points(model: CameraModel, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    limit = np.deg2rad(100 if model.name == "pinhole-equi" else 42)
    theta, phi, depth = rng.uniform(0, limit, 300), rng.uniform(-np.pi, np.pi, 300), rng.uniform(0.2, 5, 300)
    return depth[:, None] * np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)


def test_every_model_of_the_table_has_a_lens_here() -> None:
    assert set(LENSES) == set(CAMERAS)


@pytest.mark.parametrize("name", CAMERAS)
def test_jacobians_match_central_differences(name: str) -> None:
    model, params = CAMERAS[name], np.array(LENSES[name])
    points = np.concatenate([_points(model), [[1e-9, 0, 1.0], [1e-6, 1e-6, 2.0], [1e-3, -1e-4, 1.0], [0, 0, 1.0]]])
    got = model.project(points, params, jacobians=True)
    assert got.valid.all()
    assert got.J_point is not None
    assert got.J_params is not None
    for axis in range(3):
        h = 1e-6 * np.linalg.norm(points, axis=-1)
        step = np.zeros_like(points)
        step[:, axis] = h
        numeric = (model.project(points + step, params).uv - model.project(points - step, params).uv) / (2 * h[:, None])
        np.testing.assert_allclose(got.J_point[..., axis], numeric, rtol=2e-6, atol=1e-4)
    for k in range(len(params)):
        h_k = 1e-6 * max(1.0, abs(params[k]))
        step_k = np.zeros_like(params)
        step_k[k] = h_k
        numeric = (model.project(points, params + step_k).uv - model.project(points, params - step_k).uv) / (2 * h_k)
        np.testing.assert_allclose(got.J_params[..., k], numeric, rtol=2e-6, atol=1e-4)


@pytest.mark.parametrize("name", CAMERAS)
def test_unproject_is_the_inverse_of_project(name: str) -> None:
    model, params = CAMERAS[name], np.array(LENSES[name])
    points = _points(model, seed=1)
    rays, valid = model.unproject(model.project(points, params).uv, params)
    assert valid.all()
    np.testing.assert_allclose(rays, points / np.linalg.norm(points, axis=-1, keepdims=True), atol=1e-11)


@pytest.mark.parametrize("name", [name for name in CAMERAS if name != "pinhole-equi"])
def test_pinholes_agree_with_opencv(name: str) -> None:
    params = np.array(LENSES[name])
    points = _points(CAMERAS[name], seed=2)
    K = np.array([[params[0], 0, params[2]], [0, params[1], params[3]], [0, 0, 1]])
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, params[4:] if len(params) > 4 else None)
    np.testing.assert_allclose(CAMERAS[name].project(points, params).uv, expected[:, 0], atol=1e-9)


def test_equidistant_agrees_with_opencv() -> None:
    params = np.array(LENSES["pinhole-equi"])
    points = _points(CAMERAS["pinhole-radtan"], seed=3)
    K = np.array([[params[0], 0, params[2]], [0, params[1], params[3]], [0, 0, 1]])
    expected, _ = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), K, params[4:])
    np.testing.assert_allclose(CAMERAS["pinhole-equi"].project(points, params).uv, expected[:, 0], atol=1e-9)


@pytest.mark.parametrize("name", CAMERAS)
def test_points_outside_the_domain_are_not_valid(name: str) -> None:
    model, params = CAMERAS[name], np.array(LENSES[name])
    assert not model.project(np.array([[0.0, 0.0, -1.0]]), params).valid.any()
    if len(params) == 4:  # nothing folds
        assert not model.project(np.array([[1.0, 0.0, 0.01]]), params).valid.any()
        return
    folding = params.copy()
    folding[4], folding[5:] = -0.5, 0  # the radial map turns back at r2 = 2/3 (pinhole), theta2 = 2/3 (equidistant)
    r = np.sqrt(2 / 3)
    inside, outside = (np.tan(a) if name == "pinhole-equi" else a for a in (r * 0.999, r * 1.001))
    assert model.project(np.array([[inside, 0, 1.0]]), folding).valid.all()
    assert not model.project(np.array([[outside, 0, 1.0]]), folding).valid.any()
    _, valid = model.unproject(np.array([[folding[2] + 3000.0, folding[3]]]), folding)
    assert not valid.any()


@pytest.mark.parametrize("seed", range(100))
def test_rational_lenses_that_end_at_a_pole_are_inverted(seed: int) -> None:
    rng = np.random.default_rng(seed)
    model = CAMERAS["pinhole-radtan8"]
    params = np.array([480, 480, 320, 240, *rng.normal(0, 0.2, 2), 1e-4, 1e-4, *rng.normal(0, 0.1, 4)])
    radius, angle = rng.uniform(0, 0.6, 50), rng.uniform(-np.pi, np.pi, 50)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.ones(50)], axis=-1)
    seen = model.project(points, params)
    rays, valid = model.unproject(seen.uv, params)
    assert np.array_equal(valid, seen.valid)
    np.testing.assert_allclose((rays / rays[:, 2:])[valid], points[valid], atol=1e-9)
