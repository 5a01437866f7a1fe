"""What corners err by together: the size of the detectors' bias term (BIAS_PX) from lens errors on simulated recordings.

python benchmarks/detector_bias.py [--step 3]

A lens' error e has covariance C0 + b^2 C1: C0 the corners' noise, C1 a bias of 1 px for each place of the image. b of the greatest
likelihood is told for recordings that the value was set on, and once more for others, which it is judged by.
"""

import argparse
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibkit.data.observations import BoardViews
from calibkit.detection.boards import detect
from calibkit.detection.find import BIAS_PX
from calibkit.estimation.lens_fit import fit_lenses
from calibkit.estimation.lens_trust import lens_covariance
from calibkit.models.board import AprilGrid
from calibkit.simulation.camera import RenderStyle, SimCamera
from calibkit.simulation.render import Renderer
from calibkit.simulation.scenarios import SCENARIOS, Scenario
from calibkit.simulation.session import simulate_session

Array = NDArray[np.float64]
HARSH = {"style": RenderStyle(blur_px=0.9, noise=4.0, lighting=0.6)}
SMALL_TAGS = {"board": AprilGrid(7, 5, 0.06, 0.25), "distance": 0.55}


def _camera(params: list[float], size: tuple[int, int]) -> dict[str, tuple[SimCamera, ...]]:
    return {"cameras": (replace(SCENARIOS["cam-imu"].cameras[0], params=np.array(params), size=size),)}


WIDE = _camera([420, 421, 640, 400, -0.31, 0.11, -3e-4, 1e-4], (1280, 800))
LONG = {**_camera([700, 701, 322, 241, -0.05, 0.02, 1e-4, 1e-4], (640, 480)), "distance": 1.1}
Runs = list[tuple[str, int, dict[str, object]]]
SET_ON: Runs = [
    ("cam-imu", 11, {}),
    ("fisheye-imu", 12, {}),
    ("checkerboard", 13, {}),
    ("charuco", 14, {}),
    ("cam-imu", 15, {}),
    ("fisheye-imu", 16, {}),
]
JUDGED_BY: Runs = [
    *(("stereo-imu", 21, {}), ("cam-imu", 22, HARSH), ("cam-imu", 23, WIDE), ("cam-imu", 24, LONG), ("cam-imu", 25, SMALL_TAGS)),
    *(
        ("fisheye-imu", 26, HARSH),
        ("fisheye-imu", 27, SMALL_TAGS),
        ("checkerboard", 28, HARSH),
        ("checkerboard", 29, WIDE),
        ("charuco", 30, HARSH),
    ),
]
CIRCLES_SET_ON: Runs = [("circlegrid", 17, {}), ("circlegrid", 18, {})]
CIRCLES_JUDGED_BY: Runs = [("circlegrid", 31, HARSH), ("circlegrid", 32, {}), ("circlegrid", 33, {})]


@dataclass(frozen=True)
class LensError:
    """A lens minus its truth, and the covariances of corner noise and of a bias of 1 px."""

    error: Array  # (p,)
    noise: Array  # (p, p)
    bias: Array  # (p, p)

    def covariance(self, bias_px: float) -> Array:
        return self.noise + bias_px**2 * self.bias


def look(scenario: Scenario, seed: int, step: int) -> LensError:
    """Simulate a recording, find the board in every step-th image of its last camera, fit the lens."""
    session = simulate_session(scenario, seed)
    track = session.tracks[-1]
    camera, renderer, rng = track.camera, Renderer(track.camera, scenario.board, scenario.style), np.random.default_rng(seed)
    poses = session.T_cam_board(track)
    instants = range(0, len(poses), step)
    found = [detect(renderer.render(poses[i], rng), scenario.board) for i in instants]
    seen = [(i, detection) for i, detection in zip(instants, found, strict=True) if len(detection.corner) >= 4]
    views = BoardViews(
        board=scenario.board,
        image_size=camera.size,
        t_ns=np.array([1e9 * i / camera.rate_hz for i, _ in seen], np.int64),
        labels=tuple(str(i) for i, _ in seen),
        frame=np.repeat(np.arange(len(seen), dtype=np.int32), [len(detection.corner) for _, detection in seen]),
        corner=np.concatenate([detection.corner for _, detection in seen]),
        uv=np.concatenate([detection.uv for _, detection in seen]),
        sigma_px=np.concatenate([detection.sigma_px for _, detection in seen]),
        camera=camera.name,
        n_images=len(instants),
    )
    fit = fit_lenses([views], [camera.model.name], (np.arange(views.n_frames),))
    noise = lens_covariance(fit).corrected
    both = lens_covariance(replace(fit, views=(replace(views, sigma_bias_px=1.0),))).corrected
    return LensError(fit.state.lenses[0] - camera.params, noise, both - noise)


def likely(errors: list[LensError]) -> tuple[float, float, float]:
    """Return b of the maximum likelihood in px, and its 95 % interval by the likelihood's profile."""
    grid = np.geomspace(2e-4, 0.1, 120)
    value = np.zeros(len(grid))
    for e in errors:
        for k, b in enumerate(grid):
            L = np.linalg.cholesky(e.covariance(b))
            value[k] -= 0.5 * np.sum(np.linalg.solve(L, e.error) ** 2) + np.log(np.diag(L)).sum()
    inside = grid[value > value.max() - 1.92]
    return float(grid[value.argmax()]), float(inside.min()), float(inside.max())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--step", type=int, default=3, help="take every n-th image")
    step = parser.parse_args().step
    for title, runs in (
        ("set on", SET_ON),
        ("judged by", JUDGED_BY),
        ("circles, set on", CIRCLES_SET_ON),
        ("circles, judged by", CIRCLES_JUDGED_BY),
    ):
        errors = []
        print(f"--- {title}: errors in sigma with the term as it is, over the lens' parameters")
        for name, seed, changes in runs:
            scenario = replace(SCENARIOS[name], **changes)  # type: ignore[arg-type]
            error = look(scenario, seed, step)
            z = error.error / np.sqrt(np.diag(error.covariance(BIAS_PX[scenario.board.kind])))
            print(f"{name:14} seed {seed} {','.join(changes) or '-':18} {np.round(z, 1)}  fx {error.error[0]:+.4f} px", flush=True)
            errors.append(error)
        print("most likely bias {:.4f} px ({:.4f} to {:.4f})".format(*likely(errors)))


if __name__ == "__main__":
    main()
