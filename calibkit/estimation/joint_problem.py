"""The joint estimator as one least-squares problem: corners, gyroscope, accelerometer and bias walks on one continuous-time trajectory.

gyro   w_meas - (M_g C_g_i omega(t) + A_g C_g_i f_meas + b_g)
accel  a_meas - (M_a R(t)^T (s p''(t) - g) + b_a)            s: the board's size over what its file says
corner uv - project(T_cam_imu T_world_imu(t + dt)^-1 P; lens)
walk   b_{j+1} - b_j ~ N(0, walk^2 h)
(Furgale, Rehder, Siegwart 2013; the trajectory as in `geometry.spline`.)
"""

from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibkit.estimation.camera_problem import CameraViews, Shutter, corner_products, map_views
from calibkit.estimation.joint_parts import Index, Part, assemble
from calibkit.estimation.joint_state import (
    A_G,
    DRIFTING,
    EXTRAS,
    IMU_MODEL,
    KNOT,
    LINE,
    LINE_SCALE,
    M_A,
    M_G,
    PHI,
    SCALE,
    Border,
    JointState,
    model_step,
    retract,
)
from calibkit.geometry import se3, so3
from calibkit.geometry.so3 import Array
from calibkit.geometry.spline import Knots, Steps, Turning, basis, turning
from calibkit.models.imu import ImuModel
from calibkit.solver.arrowhead import Arrowhead
from calibkit.solver.robust import cauchy

_CHUNK = 2000  # IMU samples worked on at once: memory stays flat
# A trajectory that nothing measures stays as it moves: what moves more than this has sensors of its own to say so.
_TURN_CHANGE, _ACCELERATION = 200.0, 100.0  # rad/s^2, m/s^2
# The outermost control points hang on a few samples with a hundredth of their weight: a bad frame there must not wind one half round.
_ENDS, _END_TURN = 2, 0.05  # rad, of neighbouring steps
EXTRAS_OF_IMU = {name: size for name, size in EXTRAS.items() if name != LINE}


@dataclass(frozen=True)
class ImuRows:
    """One IMU's samples, and how each is weighed."""

    t: Array  # (n,) s
    gyro: Array  # (n, 3) rad/s
    accel: Array  # (n, 3) m/s^2
    sigma: Array  # (6,) of one sample: gyro, accel
    walk: Array  # (6,) rad/s^2/sqrt(Hz), m/s^3/sqrt(Hz)
    keep: NDArray[np.bool_]  # (n, 2) gyro, accel


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

    @property
    def border(self) -> Border:
        sizes = tuple(len(frames.views.model.parameter_names) for frames in self.cameras)
        return Border(sizes, self.extras, tuple(drift.name for drift in self.drifts))

    def retract(self, x: JointState, core: Array, border: Array) -> JointState:
        return retract(x, self.border, core, border)

    def linearize(self, x: JointState) -> tuple[float, Arrowhead]:
        return self.assembled(self.parts(x), x)

    def assembled(self, parts: Iterable[Part], x: JointState) -> tuple[float, Arrowhead]:
        """Return the cost and the normal equations of its parts at x."""
        cost, system = assemble(parts, self.knots.controls, self.knots.order, self.border.size)
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
        if self.imu_prior is not None:
            model, information = self.imu_prior
            at, steps = self.border.of_model, model_step(x.imu, model)
            off = np.concatenate([steps[name] for name in IMU_MODEL if name in self.extras])
            C[np.ix_(at, at)], g[at] = information, information @ off
            cost += float(off @ information @ off)
        return cost, C, g

    def parts(self, x: JointState) -> Iterator[Part]:
        """Yield the normal equations' pieces at x."""
        steps = Steps.of(x.R)
        chunks = [slice(start, start + _CHUNK) for start in range(0, len(self.imu.t), _CHUNK)]
        with ThreadPoolExecutor(2) as pool:  # numpy lets go of the GIL in its kernels
            for pair in pool.map(lambda rows: self._imu(x, steps, rows), chunks):
                yield from pair
        for c in range(len(self.cameras)):
            yield from self.frame_parts(x, steps, c)
        yield self._walk(x)
        yield self._stays(x, steps)

    def imu_residuals(self, x: JointState) -> Array:
        """Return measured minus predicted (n, 6): rad/s, m/s^2."""
        steps = Steps.of(x.R)
        i, u = self.knots.locate(self.imu.t)
        value, rate, second = (basis(self.knots, u, r) for r in range(3))
        near = i[:, None] + np.arange(self.knots.order)
        at = turning(x.R, steps, i, value, rate, jacobians=False)
        acceleration = np.einsum("nl,nlk->nk", second, x.p[near])
        force = np.einsum("nji,nj->ni", at.R, x.board_scale * acceleration - x.gravity)
        accel = force @ x.imu.M_a.T + x.bias[i, 3:]
        gyro = at.omega @ (x.imu.M_g @ x.imu.C_g_i).T + self._felt(x, slice(None)) @ (x.imu.A_g @ x.imu.C_g_i).T + x.bias[i, :3]
        return np.concatenate([self.imu.gyro - gyro, self.imu.accel - accel], axis=1)

    def _felt(self, x: JointState, rows: slice) -> Array:
        """Return the specific force that samples felt (n, 3): as measured, its noise is nothing to A_g."""
        felt: Array = self.imu.accel[rows] @ np.linalg.inv(x.imu.M_a).T
        return felt

    def _imu(self, x: JointState, steps: Steps, rows: slice) -> tuple[Part, Part]:
        """Return what some samples of gyroscope and accelerometer say."""
        imu, k = self.imu, self.knots.order
        i, u = self.knots.locate(imu.t[rows])
        value, rate, second = (basis(self.knots, u, r) for r in range(3))
        at = turning(x.R, steps, i, value, rate)
        RT = np.swapaxes(at.R, 1, 2)
        acceleration = np.einsum("nl,nlk->nk", second, x.p[i[:, None] + np.arange(k)])
        force = (RT @ (x.board_scale * acceleration - x.gravity)[..., None])[..., 0]
        n, bias, model = len(i), x.bias[i], x.imu
        where = self.border.of_imu
        free = {name: np.zeros((n, 3, size)) for name, size in EXTRAS_OF_IMU.items() if name in self.extras}

        turns, sensitive, felt = model.M_g @ model.C_g_i, model.A_g @ model.C_g_i, self._felt(x, rows)
        extra = {"gravity": np.zeros((n, 3, 3)), **free}
        if M_G in free:
            extra[M_G] = by_lower(at.omega @ model.C_g_i.T)
        if PHI in free:
            extra[PHI] = -turns @ so3.hat(at.omega) - sensitive @ so3.hat(felt)
        if M_A in free:
            extra[M_A] = -sensitive @ np.linalg.inv(model.M_a) @ by_lower(felt)
        if A_G in free:
            extra[A_G] = np.einsum("rs,nc->nrsc", np.eye(3), felt @ model.C_g_i.T).reshape(n, 3, 9)
        rotation = KNOT * np.arange(k)[:, None] + np.arange(3)
        by_knot = turns @ at.domega.reshape(n, 3, -1)
        left = self.imu.gyro[rows] - at.omega @ turns.T - felt @ sensitive.T - bias[:, :3]
        K = np.concatenate([by_knot[..., :3], _eyes(n), by_knot[..., 3:], *extra.values(), left[..., None]], axis=2)
        offsets = np.concatenate([rotation[0], np.arange(6, 9), rotation[1:].ravel()])
        gyro = self._samples("gyro", K, imu.sigma[:3], imu.keep[rows, 0], i, offsets, where)

        motion = KNOT * np.arange(1, k)[:, None] + np.arange(6)
        by_knot = np.empty((n, 3, k, 6))
        by_knot[..., :3] = np.einsum("nab,nbkc->nakc", so3.hat(force), at.dR)
        by_knot[..., 3:] = x.board_scale * second[:, None, :, None] * RT[:, :, None, :]
        extra = {"gravity": -model.M_a @ RT, **free}
        if SCALE in free:
            extra[SCALE] = model.M_a @ RT @ acceleration[..., None]
        if M_A in free:
            extra[M_A] = by_lower(force)
        by_knot = model.M_a @ by_knot.reshape(n, 3, -1)
        left = self.imu.accel[rows] - force @ model.M_a.T - bias[:, 3:]
        K = np.concatenate([by_knot[..., :6], _eyes(n), by_knot[..., 6:], *extra.values(), left[..., None]], axis=2)
        offsets = np.concatenate([np.arange(6), np.arange(9, 12), motion.ravel()])
        return gyro, self._samples("accel", K, imu.sigma[3:], imu.keep[rows, 1], i, offsets, where)

    def _samples(self, kind: str, K: Array, sigma: Array, keep: NDArray[np.bool_], i: Index, offsets: Index, where: slice) -> Part:
        """Return the products of rows K (n, 3, q), weighed, by the segments i that they fall into."""
        K /= sigma[:, None]
        loss, down = cauchy(np.sum(K[..., -1] ** 2, axis=1), self.loss_scale)
        K *= (np.sqrt(down) * keep)[:, None, None]
        segment, N = _by_segment(K, i)
        touch, cost = np.arange(where.start, where.stop), float(np.sum(loss[keep]))
        return Part(kind, self.knots.middle(segment), segment, offsets, touch, N, cost, 3 * int(keep.sum()))

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

        offsets = (KNOT * np.arange(k)[:, None] + np.arange(6)).ravel()
        where = self.border.camera(c)
        for rows, G, cost in map_views(frames.views, products):
            f, moving, others = len(G), motion.shape[-1], G.shape[-1] - 6
            chain = np.zeros((f, 6 + others, moving + others))
            chain[:, :6, :moving] = motion[rows]
            chain[:, np.arange(6, 6 + others), np.arange(moving, moving + others)] = 1
            N = np.swapaxes(chain, 1, 2) @ G @ chain
            corners = int(np.count_nonzero(frames.views.weight[rows]))
            t, touch = (frames.t + camera.dt)[rows], np.arange(where.start, where.stop)
            yield self._drifting(Part(f"camera {c}", t, i[rows], offsets, touch, N, cost, 2 * corners), c)

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

    def _walk(self, x: JointState) -> Part:
        """Biases walk: information 1 / (walk^2 h) ties each knot's to the next one's."""
        m, scale = self.knots.controls, 1 / (self.imu.walk * np.sqrt(self.knots.spacing))
        K = np.zeros((m - 1, 6, 13))
        K[:, np.arange(6), np.arange(6)] = -scale
        K[:, np.arange(6), np.arange(6, 12)] = scale
        K[:, :, -1] = -scale * np.diff(x.bias, axis=0)
        offsets = np.concatenate([np.arange(6, 12), KNOT + np.arange(6, 12)])
        return _products("walk", self.knots, np.arange(m - 1), offsets, K)

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
        offsets = (KNOT * np.arange(3)[:, None] + np.arange(6)).ravel()
        return _products("stays", self.knots, np.arange(m - 2), offsets, K)


def _eyes(n: int) -> Array:
    return np.broadcast_to(np.eye(3), (n, 3, 3))


def by_lower(v: Array) -> Array:
    """Return d(M v) / d(M's six values) (n, 3, 6) for v (n, 3) and M lower triangular, row by row."""
    out = np.zeros((len(v), 3, 6))
    rows, columns = np.tril_indices(3)
    out[:, rows, np.arange(6)] = v[:, columns]
    return out


def _products(kind: str, knots: Knots, first: Index, offsets: Index, K: Array) -> Part:
    N = np.swapaxes(K, 1, 2) @ K
    return Part(kind, knots.middle(first), first, offsets, np.arange(0), N, float(np.sum(K[..., -1] ** 2)), K.shape[0] * K.shape[1])


def _by_segment(K: Array, i: Index) -> tuple[Index, Array]:
    """Return the segments that rows K (n, 6, q) fall into, sorted, and K^T K of each."""
    segment, row = np.unique(i, return_inverse=True)
    count = np.bincount(row)
    start = np.cumsum(count) - count
    slot = np.arange(len(i)) - start[row]  # times are sorted
    padded = np.zeros((len(segment), int(count.max()), *K.shape[1:]))
    padded[row, slot] = K
    padded = padded.reshape(len(segment), -1, K.shape[-1])
    return segment, np.swapaxes(padded, 1, 2) @ padded
