"""The joint estimate's sigmas mean what they say, and its errors are as small as the data allow, over seeds 0, 1, 2, ...

`pytest -m slow -s tests/test_joint_honest.py` prints the figures of docs/figures.md.
"""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from joint_samples import Recording, error_of, of_camera, recorded
from scipy.stats import chi2

from calibkit.estimation.joint import Joint
from calibkit.estimation.joint_noise import schur
from calibkit.estimation.joint_problem import Frames
from calibkit.estimation.joint_trust import joint_trust
from calibkit.geometry.so3 import Array
from calibkit.simulation.imu import SimImu, specific_force
from calibkit.simulation.session import START_NS, simulate_views
from calibkit.solver.levenberg_marquardt import minimise

MOST_OF_LIMIT = 1.3
POOLED = (0.8, 1.25)


@dataclass(frozen=True)
class Case:
    """How long, how exact, and about how far the limit lets rotation (deg), lever arm (mm) and offset (us) be known."""

    duration_s: float
    noise_px: float
    limit: tuple[float, float, float]


CASES = {"30 s, 0.2 px": Case(30.0, 0.2, (0.007, 0.35, 14.0)), "60 s, 0.03 px": Case(60.0, 0.03, (0.003, 0.19, 6.5))}


def cramer_rao(recording: Recording, joint: Joint, noise_px: float) -> Array:
    """Return the least covariance of T_cam_imu, dt and lens: the inverse information at the truth, with the true sigmas.

    The truth is what perfect measurements lead to; gravity and biases are as unknown as they are to the estimate.
    """
    fit, imu = joint.fit, SimImu()
    problem = fit.problem
    state = recording.session.trajectory.at(problem.imu.t)
    root = np.sqrt(imu.rate_hz)
    samples = replace(
        problem.imu,
        gyro=state.omega_i + imu.gyro_bias,
        accel=specific_force(state) + imu.accel_bias,
        sigma=np.repeat([imu.gyro_noise_density * root, imu.accel_noise_density * root], 3),
        walk=np.repeat([imu.gyro_random_walk, imu.accel_random_walk], 3),
        keep=np.ones_like(problem.imu.keep),
    )
    views, exact = simulate_views(recording.session, noise_px)
    frames = problem.cameras[0]
    uv = np.zeros((views.n_frames, len(problem.points), 2))
    uv[views.frame, views.corner] = exact.uv
    seen = np.where(fit.found[0], 1 / noise_px, 0.0)
    perfect = replace(
        problem, imu=samples, cameras=(Frames(frames.t, replace(frames.views, uv=uv[joint.frames[0]], weight=seen)),), loss_scale=np.inf
    )
    solution = minimise(perfect, fit.x, max_steps=10, tolerance=1e-3)
    assert np.linalg.norm(error_of(recording, replace(joint, fit=replace(fit, x=solution.x)))[perfect.border["T 0"]]) < 2e-5
    _, S = schur(perfect.linearize(solution.x)[1])
    where = perfect.border.camera(0)
    out: Array = np.linalg.inv(S)[where, where]
    return out


def band(n: int) -> tuple[float, float]:
    """Return the 99.9 % band of the rms of n normalised errors."""
    low, high = np.sqrt(chi2.ppf([0.0005, 0.9995], n) / n)
    return float(low), float(high)


def rms(x: Array) -> Array:
    out: Array = np.sqrt(np.mean(x**2, axis=0))
    return out


def check(name: str, seeds: int) -> None:
    case = CASES[name]
    errors, covs, limits = [], [], []
    for seed in range(seeds):
        recording = recorded(seed, case.duration_s, case.noise_px)
        assert recording.imu.t_ns[0] == START_NS  # the problem's times are the trajectory's
        joint = recording.fitted()
        where, cov = of_camera(joint, joint_trust(joint.fit))
        errors.append(error_of(recording, joint)[where])
        covs.append(cov)
        limits.append(cramer_rao(recording, joint, case.noise_px))
    error, cov, limit = np.array(errors), np.array(covs), np.array(limits)
    honest = rms(error / np.sqrt(np.einsum("nii->ni", cov)))
    pooled = float(np.sqrt(np.mean([e @ np.linalg.solve(C, e) / len(e) for e, C in zip(error, cov, strict=True)])))
    parts = {"rotation, deg": (slice(3, 6), np.degrees(1.0)), "lever arm, mm": (slice(0, 3), 1e3), "offset, us": (slice(6, 7), 1e6)}
    size = {
        key: (unit * np.sqrt(np.sum(rms(error[:, part]) ** 2)), unit * np.sqrt(np.mean(np.trace(limit[:, part, part], axis1=1, axis2=2))))
        for key, (part, unit) in parts.items()
    }
    least, most = band(seeds)
    told = ", ".join(f"{key} {got:.4g} (limit {bound:.4g})" for key, (got, bound) in size.items())
    line = f"{name}, {seeds} seeds: {told}; error over sigma {honest.round(2)} of {least:.2f}-{most:.2f}, whitened together {pooled:.2f}"
    print(line)
    assert np.all((honest > least) & (honest < most)), line
    if seeds >= 30:
        assert POOLED[0] < pooled < POOLED[1], line
        for (got, bound), published in zip(size.values(), case.limit, strict=True):
            assert got < MOST_OF_LIMIT * bound, line
            assert bound < 1.1 * published, line
    else:
        low, high = band(seeds * error.shape[1])
        assert low / 1.1 < pooled < high * 1.1, line  # the covariance itself is known to a tenth


@pytest.mark.parametrize("name", list(CASES)[:1])
def test_sigmas_are_honest(name: str) -> None:
    check(name, 3 if CASES[name].duration_s < 60 else 1)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_sigmas_are_honest_and_errors_at_the_limit_over_many_seeds(name: str) -> None:
    check(name, 30)
