"""Projection uncertainty over image and range against lenses drawn from the covariance, the camera's motion found anew for each."""

import numpy as np
import pytest
from report_samples import SIZE, residual_set, result
from scipy.optimize import least_squares

from calibkit.data.transforms import make_covariance
from calibkit.geometry import se3
from calibkit.models.cameras import CAMERAS
from calibkit.report.figures import plates
from calibkit.report.lens_uncertainty import camera_motion, pixel_sigma
from calibkit.report.view import KnownLens, views

MODEL = CAMERAS["pinhole-radtan"]
LENS = np.array([460.0, 458, 366, 248, -0.28, 0.07, 2e-4, 2e-5])
DRAWS = 300


def known() -> KnownLens:
    A = np.random.default_rng(0).standard_normal((8, 8)) * np.array([0.3, 0.3, 0.2, 0.2, 1e-3, 1e-3, 1e-4, 1e-4])[:, None]
    return KnownLens(MODEL, LENS, A @ A.T)


@pytest.mark.slow
@pytest.mark.parametrize("distance", [0.3, 1.0, np.inf])
def test_sigma_is_the_scatter_of_drawn_lenses_once_the_camera_has_moved_along(distance: float) -> None:
    rng = np.random.default_rng(1)
    lens = known()
    uv, depth = rng.uniform([40, 30], [710, 450], (80, 2)), rng.uniform(0.5, 1.4, 80)
    at = np.array([[376.0, 240], [90, 80], [700, 440]])
    corners = MODEL.unproject(uv, LENS)[0] * depth[:, None]
    points = MODEL.unproject(at, LENS)[0] * min(distance, 1e7)
    moved = []
    for drawn in rng.multivariate_normal(LENS, lens.cov, DRAWS):
        seen = lambda x, X, drawn=drawn: MODEL.project(se3.transform(se3.retract(np.eye(4), x), X), drawn).uv  # noqa: E731
        best = least_squares(lambda x, seen=seen: (seen(x, corners) - uv).ravel(), np.zeros(6), x_scale="jac").x
        moved.append(seen(best, points) - at)
    scatter = [np.sqrt(np.linalg.eigvalsh(np.cov(np.array(moved)[:, i].T))[-1]) for i in range(len(at))]
    told = pixel_sigma(lens, camera_motion(lens, uv, depth), at, distance)
    np.testing.assert_allclose(told, scatter, rtol=0.13)  # 3 sigma of 300 draws


@pytest.mark.slow
def test_the_picture_is_there_where_the_covariance_is_known() -> None:
    made = result(residuals=residual_set(), thumbnails=0)
    assert "uncertainty" not in {plate.key for view in views(made) for plate in plates(view)}
    camera = made.rig.cameras["cam0"]
    with_covariance = camera.model_copy(update={"covariance": make_covariance(MODEL.parameter_names, known().cov)})
    made.rig.cameras["cam0"] = with_covariance
    (view,) = views(made)
    assert "uncertainty" in {plate.key for plate in plates(view)}
    assert view.image_size == SIZE
