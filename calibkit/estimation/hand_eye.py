"""Hand-eye: X of P X = Z Q from two sides' poses, robust, with covariance, what the poses leave open, and every closed form beside it."""

from dataclasses import dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits

from calibkit.data.verdict import Status
from calibkit.errors import BadInputError
from calibkit.estimation.hand_eye_advice import Advice, good_poses
from calibkit.estimation.hand_eye_compared import Method, Scatter, apart, methods_of, pairs_of, scatter
from calibkit.estimation.hand_eye_data import HandEyeData, Index, Mask
from calibkit.estimation.hand_eye_images import Corners
from calibkit.estimation.hand_eye_lag import Lag, lag
from calibkit.estimation.hand_eye_lens import LensEffect, lens_effect
from calibkit.estimation.hand_eye_noise import RobotNoise
from calibkit.estimation.hand_eye_normal import SCALES, believed, normal
from calibkit.estimation.hand_eye_open import Open, open_directions
from calibkit.estimation.hand_eye_pairs import Spectrum, motions, spectrum
from calibkit.estimation.hand_eye_refine import Refined, refine
from calibkit.estimation.hand_eye_robust import seed
from calibkit.estimation.hand_eye_trust import Trust, judge
from calibkit.geometry import se3
from calibkit.geometry.so3 import Array
from calibkit.solver import trust

_FEWEST = 2
_FEWEST_CHUNKS, _SHORTEST_CHUNK = 8, 5
_TRIED_ON = 600  # poses that a chunk's length is chosen by


@dataclass(frozen=True)
class Settings:
    """How to estimate."""

    seed: int = 0  # of the draws
    drift: bool | None = None  # the worlds drift apart, as odometries' do; None: in `motion`, what gives the smaller sigmas
    methods: bool = True  # solve by every closed form too
    robot: RobotNoise | None = None  # the arm's noise; None: told by the residuals


@dataclass(frozen=True)
class HandEyeFit:
    """X = T_1_2, and everything that says how good it is; covariances are of d in T exp(d), (rho m, phi rad)."""

    data: HandEyeData
    X: Array  # (4, 4)
    cov_X: Array  # (6, 6) as residuals are
    plain_cov_X: Array  # as if they were white
    Z: Array | None  # (4, 4) T_w1_w2, None where there are several
    cov_Z: Array | None
    plain_cov_Z: Array | None
    kept: Mask  # (n,) poses that took part
    residual: Array  # (n, 6) local(Z Q_i, P_i X), in frame 2
    chi2: Array  # (n,) of the residuals, 6 degrees of freedom
    pairs: Index  # (k, 2) chosen ones of all poses, also wrong ones
    pair_angle: Array  # (k,) rad between A X and X B
    pair_distance: Array  # (k,) m
    scatter: Scatter
    methods: dict[str, Method]
    noise: dict[str, float]  # sigmas: P_rotation rad, P_translation m or P_factor of the given covariance; likewise Q
    noise_assumed: bool  # too few poses to tell it
    spectrum: Spectrum  # of the kept poses' motions
    open: tuple[Open, ...]  # what is weak or not observable, the weakest first
    advice: tuple[Advice, ...]
    lag: Lag | None
    n_worlds: int
    converged: bool
    by_reach: bool  # an arm's turns and places contradict each other: its geometry is off, and places count less
    robot: RobotNoise | None  # what was stated of the arm's noise
    lens: LensEffect | None  # of corners: how well the lens is known, and how X follows it
    refined: Refined
    trusted: Trust

    @property
    def statuses(self) -> dict[str, Status]:
        """Return the status of p and of R as wholes: that of their least known direction."""
        found = {}
        for name, part in (("p", slice(0, 3)), ("R", slice(3, 6))):
            cov = self.cov_X[part, part] / SCALES[part, None] / SCALES[part]
            found[name] = Status(trust.grade(float(np.sqrt(np.linalg.eigvalsh(cov)[-1]))))
        return found

    def predict(self, n: int) -> Array:
        """Return the covariance of X (6, 6) that n more good poses would bring: turned by 30 deg or more about all axes."""
        return self.trusted.predict(n * good_poses(self.data, self.refined))


def calibrate_hand_eye(data: HandEyeData, settings: Settings | None = None, corners: Corners | None = None) -> HandEyeFit:
    """Return X with its covariance; BadInputError with fewer than two poses in any world.

    With each pose's corners, a robot's X is that of the least reprojection error, the robot's own noise beside it.
    """
    with threadpool_limits(1, user_api="blas"):  # the matrices are small: threads cost more than they bring
        return _calibrate(data, settings or Settings(), corners)


def _calibrate(data: HandEyeData, settings: Settings, corners: Corners | None) -> HandEyeFit:
    if data.n_worlds == 0 or np.bincount(data.world, minlength=data.n_worlds).min() < _FEWEST:
        raise BadInputError(f"hand-eye needs two poses at least and has {len(data.P)}: record 10 or more, turned about two axes or more")
    data = _in_chunks(data, settings)
    found, trusted, lens = _solve(data, settings, corners)
    late = lag(data, found, trusted.inflation)
    by_lag = (np.zeros((6, 6)),) * 2 if late is None else (np.outer(late.x, late.x), np.outer(late.z, late.z))
    cov_X = trusted.cov_X + by_lag[0]
    X, Z = found.X, found.Z
    pairs = pairs_of(data, np.ones(len(data.P), bool))
    good = pairs_of(data, found.kept)
    angle, distance = apart(motions(data.P, pairs) @ X, X @ motions(data.Q, pairs))
    one = data.n_worlds == 1
    return HandEyeFit(
        data=data,
        X=X,
        cov_X=cov_X,
        plain_cov_X=trusted.plain_X + by_lag[0],
        Z=Z[0] if one else None,
        cov_Z=trusted.cov_Z + by_lag[1] if one else None,
        plain_cov_Z=trusted.plain_Z + by_lag[1] if one else None,
        kept=found.kept,
        residual=se3.local(Z[data.world] @ data.Q, data.P @ X),
        chi2=found.chi2,
        pairs=pairs,
        pair_angle=angle,
        pair_distance=distance,
        scatter=scatter(data, X, found.kept),
        methods=methods_of(data, found, cov_X, good) if settings.methods and len(good) else {},
        noise=found.noise,
        noise_assumed=found.freedom == 0,
        spectrum=spectrum(motions(data.P, good)),
        open=trusted.open if late is None else open_directions(data, X, cov_X),
        advice=trusted.advice,
        lag=late,
        n_worlds=data.n_worlds,
        converged=found.converged,
        by_reach=found.by_reach,
        robot=settings.robot,
        lens=lens,
        refined=found,
        trusted=trusted,
    )


def _solve(data: HandEyeData, settings: Settings, corners: Corners | None = None) -> tuple[Refined, Trust, LensEffect | None]:
    """Return the optimum and how far it may be trusted; what is not known of the lens is in X's and Z's covariance."""
    found = refine(data, seed(data, np.random.default_rng(settings.seed)), corners, settings.robot)
    trusted = judge(data, found)
    if found.corners is None or found.sight is None:
        return found, trusted, None
    system = believed(data, found.C, found.C_P, found.kept, normal(data, found.M, found.C, found.e, found.kept))[1]
    variance = found.noise["Q_factor"] ** 2
    lens = lens_effect(data, system, found.M, found.C, found.e, found.kept, found.corners, found.sight, variance)
    if lens is None:
        return found, trusted, None
    cov_X = trusted.cov_X + lens.of_X(lens.cov)
    trusted = replace(
        trusted,
        cov_X=cov_X,
        plain_X=trusted.plain_X + lens.of_X(lens.plain),
        cov_Z=trusted.cov_Z + lens.of_Z(lens.cov),
        plain_Z=trusted.plain_Z + lens.of_Z(lens.plain),
        open=open_directions(data, found.X, cov_X),
    )
    return found, trusted, lens


def _in_chunks(data: HandEyeData, settings: Settings) -> HandEyeData:
    """Return the problem of a moving pair with a new world every so often, where drift makes that the better known X.

    Long chunks hold large turns, short ones little drift: the length is the one with the smallest covariance by the residuals themselves.
    """
    may = settings.drift if settings.drift is not None else data.setup == "motion"
    if not may or data.n_worlds > 1 or data.t_s is None:
        return data
    order = np.argsort(data.t_s, kind="stable")
    rank = np.empty(len(order), np.intp)
    rank[order] = np.arange(len(order))
    thin = order[:: max(1, len(order) // _TRIED_ON)]

    def cut(chunks: int) -> HandEyeData:
        return replace(data, world=rank * chunks // len(rank))

    counts = [1] if settings.drift is None else []
    chunks = _FEWEST_CHUNKS
    while chunks * _SHORTEST_CHUNK <= len(thin):
        counts.append(chunks)
        chunks *= 2
    if not counts:
        return data
    sizes = [np.linalg.slogdet(_solve(select(cut(c), thin), settings)[1].cov_X / SCALES[:, None] / SCALES)[1] for c in counts]
    return cut(counts[int(np.argmin(sizes))])


def select(data: HandEyeData, rows: Index) -> HandEyeData:
    """Return the problem of some of its poses; worlds are numbered anew."""

    def of(values: Array | None) -> Array | None:
        return None if values is None else values[rows]

    return replace(
        data,
        P=data.P[rows],
        Q=data.Q[rows],
        cov_P=of(data.cov_P),
        cov_Q=of(data.cov_Q),
        labels=tuple(data.labels[i] for i in rows),
        t_s=of(data.t_s),
        world=np.unique(data.world[rows], return_inverse=True)[1].astype(np.intp),
    )
