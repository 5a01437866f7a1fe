"""The joint estimator as one least-squares problem: corners, gyroscope, accelerometer and bias walks on one continuous-time trajectory.

gyro, accel  as `joint_inertial` has them
corner uv - project(T_cam_imu T_world_imu(t + dt)^-1 P; lens)
walk   b_{j+1} - b_j ~ N(0, walk^2 h)
(Furgale, Rehder, Siegwart 2013; the trajectory as in `geometry.spline`.)
"""

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from calibkit.estimation.camera_problem import CameraViews, Shutter, corner_products, map_views
from calibkit.estimation.joint_inertial import ImuBeside, ImuRows, inertial_parts, inertial_residuals
from calibkit.estimation.joint_parts import Index, Part, assemble
from calibkit.estimation.joint_state import (
    DRIFTING,
    LINE,
    LINE_SCALE,
    Border,
    JointState,
    biases,
    model_step,
    retract,
)
from calibkit.geometry import se3
from calibkit.geometry.so3 import Array
from calibkit.geometry.spline import Knots, Steps, Turning, basis, turning
from calibkit.models.imu import ImuModel
from calibkit.solver.arrowhead import Arrowhead

# The first damping. Of what corners say of a camera whose path is known, some ten millionths are left along some directions once it is not:
# damped by a millionth of the former, one step there becomes many.
DAMPING = 1e-9
_CHUNK = 2000  # IMU samples worked on at once: memory stays flat
# A trajectory that nothing measures stays as it moves: what moves more than this has sensors of its own to say so.
_TURN_CHANGE, _ACCELERATION = 200.0, 100.0  # rad/s^2, m/s^2
# The outermost control points hang on a few samples with a hundredth of their weight: a bad frame there must not wind one half round.
_ENDS, _END_TURN = 2, 0.05  # rad, of neighbouring steps


@dataclass(frozen=True)
class Frames:
    """One camera's corners; each view has its own time."""

    t: Array  # (f,) s on the camera's clock
    views: CameraViews  # `instant` is not used
    bias_px: float = 0.0  # what the detector always errs by at one place of the image


@dataclass(frozen=True)
class GravityPrior:
    size: float  # m/s^2
    sigma: float


@dataclass(frozen=True)
class Drift:
    """What cameras' parameters may go with: time, or a temperature."""

    name: str
    t: Array  # (k,) s
    value: Array  # (k,) linear between

    def at(self, t: Array) -> Array:
        out: Array = np.interp(t, self.t, self.value)
        return out


@dataclass(frozen=True)
class Seen:
    """One camera's frames on the trajectory."""

    i: Index  # (f,) segment
    value: Array  # (f, order) of the basis
    at: Turning
    T_cam_board: Array  # (f, 4, 4)
    twist: Array  # (f, 6) how the board's points move in the camera frame, rho + phi x p, 1/s


@dataclass(frozen=True)
class JointProblem:
    """All measurements of a recording."""

    knots: Knots
    points: Array  # (n, 3) m, the board's corners
    imu: ImuRows
    cameras: tuple[Frames, ...]
    gravity: GravityPrior
    loss_scale: float = np.inf  # Cauchy's, in sigmas
    lens_priors: tuple[tuple[Array, Array] | None, ...] = ()  # lens and information (l, l) of each camera, where it is known
    imu_prior: tuple[ImuModel, Array] | None = None  # and information about what is free of it, in the order of IMU_MODEL
    extras: tuple[str, ...] = ()  # of joint_state.EXTRAS: what else is free
    drifts: tuple[Drift, ...] = ()
    held: bool = False  # the calibration, and the trajectory alone is free
    beside: tuple[ImuBeside, ...] = ()  # further IMUs

    @property
    def imus(self) -> tuple[ImuRows, ...]:
        return self.imu, *(each.rows for each in self.beside)

    def with_imus(self, imus: Sequence[ImuRows]) -> "JointProblem":
        """Return the problem with other samples."""
        beside = tuple(replace(each, rows=rows) for each, rows in zip(self.beside, imus[1:], strict=True))
        return replace(self, imu=imus[0], beside=beside)

    @property
    def border(self) -> Border:
        sizes = tuple(len(frames.views.model.parameter_names) for frames in self.cameras)
        return Border(sizes, self.extras, tuple(drift.name for drift in self.drifts), tuple(each.extras for each in self.beside))

    def retract(self, x: JointState, core: Array, border: Array) -> JointState:
        return retract(x, self.border, core, border)

    def linearize(self, x: JointState) -> tuple[float, Arrowhead]:
        return self.assembled(self.parts(x), x)

    def assembled(self, parts: Iterable[Part], x: JointState) -> tuple[float, Arrowhead]:
        """Return the cost and the normal equations of its parts at x."""
        cost, system = assemble(parts, self.knots.controls, self.border.knot, self.knots.order, self.border.size)
        if self.held:
            p = self.border.size
            return cost, Arrowhead(system.core, np.zeros_like(system.border), np.eye(p), system.gradient_core, np.zeros(p))
        prior_cost, C, g = self.prior(x)
        return cost + prior_cost, Arrowhead(system.core, system.border, system.corner + C, system.gradient_core, system.gradient_border + g)

    def prior(self, x: JointState) -> tuple[float, Array, Array]:
        """Return what is known beforehand: its cost, information (p, p) and gradient (p,)."""
        p = self.border.size
        C, g = np.zeros((p, p)), np.zeros(p)
        size = float(np.linalg.norm(x.gravity))
        J = x.gravity / size / self.gravity.sigma
        r = (self.gravity.size - size) / self.gravity.sigma
        where = self.border["gravity"]
        C[where, where], g[where] = np.outer(J, J), J * r
        cost = r * r
        for c, prior in enumerate(self.lens_priors):
            if prior is not None:
                where, (lens, information) = self.border[f"lens {c}"], prior
                off = lens - x.cameras[c].lens
                C[where, where], g[where] = information, information @ off
                cost += float(off @ information @ off)
        for j, (imu, known) in enumerate(zip(x.imus, (self.imu_prior, *(each.prior for each in self.beside)), strict=True)):
            if known is not None:
                model, information = known
                at, steps = self.border.of_model(j), model_step(imu.model, model)
                off = np.concatenate([steps[name] for name in self.border.free_of(j)])
                C[np.ix_(at, at)], g[at] = information, information @ off
                cost += float(off @ information @ off)
        return cost, C, g

    def parts(self, x: JointState) -> Iterator[Part]:
        """Yield the normal equations' pieces at x."""
        steps, border = Steps.of(x.R), self.border
        chunks = [(j, slice(start, start + _CHUNK)) for j, rows in enumerate(self.imus) for start in range(0, len(rows.t), _CHUNK)]

        def inertial(chunk: tuple[int, slice]) -> tuple[Part, Part]:
            j, some = chunk
            return inertial_parts(x, self.knots, steps, border, self.imus[j], j, some, self.loss_scale)

        with ThreadPoolExecutor(2) as pool:  # numpy lets go of the GIL in its kernels
            for pair in pool.map(inertial, chunks):
                yield from pair
        for c in range(len(self.cameras)):
            yield from self.frame_parts(x, steps, c)
        for j in range(len(self.imus)):
            yield self._walk(x, j)
        yield self._stays(x, steps)

    def imu_residuals(self, x: JointState, j: int = 0) -> Array:
        """Return IMU j's measured minus predicted (n, 6): rad/s, m/s^2."""
        return inertial_residuals(x, self.knots, self.imus[j], j)

    def seen(self, x: JointState, steps: Steps, c: int, jacobians: bool = False) -> "Seen":
        """Return how camera c's frames lie before the board."""
        camera = x.cameras[c]
        i, u = self.knots.locate(self.cameras[c].t + camera.dt)
        value, rate = basis(self.knots, u), basis(self.knots, u, 1)
        at = turning(x.R, steps, i, value, rate, jacobians)
        near = i[:, None] + np.arange(self.knots.order)
        position, velocity = (np.einsum("nl,nlk->nk", w, x.p[near]) for w in (value, rate))
        moving = np.concatenate([(np.swapaxes(at.R, 1, 2) @ velocity[..., None])[..., 0], at.omega], axis=1)
        T = camera.T_cam_imu @ se3.inverse(se3.make(at.R, position))
        return Seen(i, value, at, T, -moving @ se3.adjoint(camera.T_cam_imu).T)

    def shutter(self, x: JointState, c: int, twist: Array, rows: slice = slice(None)) -> Shutter | None:
        """Return how late the corners of some frames are read; None where all rows are read at once."""
        free, delay, views = LINE in self.extras, x.cameras[c].line_delay, self.cameras[c].views
        if not free and delay == 0:
            return None
        row = views.uv[rows, :, 1] - (views.image_size[1] - 1) / 2
        return Shutter(twist[rows], delay * row, LINE_SCALE * row if free else None)

    def frame_parts(self, x: JointState, steps: Steps, c: int) -> Iterator[Part]:
        """Yield what camera c's corners say."""
        frames, camera, k = self.cameras[c], x.cameras[c], self.knots.order
        seen = self.seen(x, steps, c, jacobians=True)
        i, value, at, T, twist = seen.i, seen.value, seen.at, seen.T_cam_board, seen.twist
        RT = np.swapaxes(at.R, 1, 2)
        # A point's motion in the camera frame, by the knots, T_cam_imu and dt: rho - R^T dp and phi - dR in the IMU's.
        into = se3.adjoint(camera.T_cam_imu)
        by_knot = np.zeros((len(i), 6, k, 6))
        by_knot[:, :3, :, 3:] = -value[:, None, :, None] * RT[:, :, None, :]
        by_knot[:, 3:, :, :3] = -at.dR
        motion = np.concatenate([into @ by_knot.reshape(len(i), 6, -1), np.broadcast_to(into, (len(i), 6, 6)), twist[..., None]], axis=2)

        def products(rows: slice) -> tuple[slice, Array, float]:
            shutter = self.shutter(x, c, twist, rows)
            return rows, *corner_products(self.points, frames.views, rows, T[rows], camera.lens, self.loss_scale, shutter)

        border = self.border
        offsets = (border.knot * np.arange(k)[:, None] + np.arange(6)).ravel()
        where = border.camera(c)
        for rows, G, cost in map_views(frames.views, products):
            M, moving = motion[rows], motion.shape[-1]
            by_motion = G[:, :, :6] @ M
            N = np.empty((len(G), *np.add(G.shape[1:], moving - 6)))
            N[:, :moving, :moving] = np.swapaxes(M, 1, 2) @ by_motion[:, :6]
            N[:, moving:, :moving] = by_motion[:, 6:]
            N[:, :moving, moving:] = np.swapaxes(by_motion[:, 6:], 1, 2)
            N[:, moving:, moving:] = G[:, 6:, 6:]
            corners = int(np.count_nonzero(frames.views.weight[rows]))
            t, touch = (frames.t + camera.dt)[rows], np.arange(where.start, where.stop)
            yield self._drifting(Part(f"camera {c}", t, border.knot * i[rows], offsets, touch, N, cost, 2 * corners), c)

    def _drifting(self, part: Part, c: int) -> Part:
        """Return camera c's part with the columns of drifts: those of its first parameters times what they go with."""
        if not self.drifts:
            return part
        n, q, unit = len(part.first), len(part.offsets), np.eye(part.N.shape[-1])
        moved = [drift.at(part.t_s)[:, None, None] * unit[:, q : q + DRIFTING] for drift in self.drifts]
        same, left = (np.broadcast_to(columns, (n, *columns.shape)) for columns in (unit[:, :-1], unit[:, -1:]))
        chain = np.concatenate([same, *moved, left], axis=2)
        where = [self.border[f"{drift.name} {c}"] for drift in self.drifts]
        touch = [part.touch, *(np.arange(block.start, block.stop) for block in where)]
        return replace(part, touch=np.concatenate(touch), N=np.swapaxes(chain, 1, 2) @ part.N @ chain)

    def _walk(self, x: JointState, j: int) -> Part:
        """IMU j's biases walk: information 1 / (walk^2 h) ties each knot's to the next one's."""
        m, scale = self.knots.controls, 1 / (self.imus[j].walk * np.sqrt(self.knots.spacing))
        K = np.zeros((m - 1, 6, 13))
        K[:, np.arange(6), np.arange(6)] = -scale
        K[:, np.arange(6), np.arange(6, 12)] = scale
        K[:, :, -1] = -scale * np.diff(x.imus[j].bias, axis=0)
        own, knot = np.arange(biases(j).start, biases(j).stop), self.border.knot
        return self._products("walk", knot, np.concatenate([own, knot + own]), K)

    def _stays(self, x: JointState, steps: Steps) -> Part:
        """Neighbouring steps of rotation and position are alike to h^2 times a great acceleration: what bridges gaps of all sensors."""
        m, h2 = self.knots.controls, self.knots.spacing**2
        scale = np.tile(np.repeat([1 / (h2 * _TURN_CHANGE), 1 / (h2 * _ACCELERATION)], 3), (m - 2, 1))
        scale[[*range(_ENDS), *range(-_ENDS, 0)], :3] = max(1 / _END_TURN, scale[0, 0])
        K = np.zeros((m - 2, 6, 19))
        for knot, factor in enumerate((1.0, -2.0, 1.0)):
            K[:, np.arange(6), 6 * knot + np.arange(6)] = factor * scale
        K[:, :3, -1] = -scale[:, :3] * np.diff(steps.d, axis=0)
        K[:, 3:, -1] = -scale[:, 3:] * np.diff(x.p, 2, axis=0)
        knot = self.border.knot
        return self._products("stays", knot, (knot * np.arange(3)[:, None] + np.arange(6)).ravel(), K)

    def _products(self, kind: str, knot: int, offsets: Index, K: Array) -> Part:
        """Return the part of rows K (n, r, q), those of each knot after the other."""
        first, N = np.arange(len(K)), np.swapaxes(K, 1, 2) @ K
        t, cost = self.knots.middle(first), float(np.sum(K[..., -1] ** 2))
        return Part(kind, t, knot * first, offsets, np.arange(0), N, cost, K.shape[0] * K.shape[1])
