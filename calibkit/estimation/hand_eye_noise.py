"""How large the noise on either side of a hand-eye problem is: given, or told by the residuals; in variances theta of kinds of noise."""

from dataclasses import dataclass

import numpy as np
from scipy import special

from calibkit.estimation.hand_eye_data import HandEyeData, Mask
from calibkit.estimation.hand_eye_normal import believed, each, inverse, normal
from calibkit.geometry.so3 import Array

ASSUMED_SIGMAS = (1e-3, 1e-3)  # rad, m: where the poses are too few to tell
_FACTORS = (1.0, 3.0)  # that a given covariance may be too small by: what corners err by together is not in it
_FEWEST = 3  # poses whose residuals tell of noise
_CHANCE = 1e-2  # of arms with white noise are taken for others: that costs accuracy, to miss one costs honesty
_SAME = 1e-3
_SINGULAR = 3.0  # of the residuals' freedom; set by sets of 3 to 6 poses, 8 and more hardly feel it
_FINEST = 1e-14  # variance: nothing is known to better than 0.1 urad and 0.1 um


@dataclass(frozen=True)
class RobotNoise:
    """Sigmas of a robot's pose, per coordinate, that are known beforehand; 0 and 0: its poses are exact."""

    rotation: float  # rad
    translation: float  # m

    @property
    def exact(self) -> bool:
        return self.rotation == 0 and self.translation == 0


def names(data: HandEyeData) -> tuple[str, ...]:
    """Return what each kind of noise is a sigma of."""
    sides = (("P", data.cov_P), ("Q", data.cov_Q))
    return tuple(f"{s}_{kind}" for s, cov in sides for kind in (("rotation", "translation") if cov is None else ("factor",)))


def on_P(data: HandEyeData) -> int:
    """Return how many of the kinds are P's."""
    return 2 if data.cov_P is None else 1


def first(data: HandEyeData, e: Array, robot: RobotNoise | None, in_images: bool) -> tuple[Array, Array, Array]:
    """Return variances to start from, what the seed left over shared by both sides, and the least and the most that they may be."""
    rho, phi = np.mean(e**2, axis=0).reshape(2, 3).mean(axis=1) if len(e) else (0.0, 0.0)
    if len(e) < _FEWEST:
        rho, phi = ASSUMED_SIGMAS[1] ** 2, ASSUMED_SIGMAS[0] ** 2
    factors = (_FACTORS[0] ** 2, _FACTORS[1] ** 2)
    if robot is not None and robot.exact:
        factors = (1.0, np.inf)  # the corners take all of it
    elif in_images:
        factors = (_FINEST, np.inf)  # thousands of corners tell their own
    # The fit of few poses takes one kind of noise all, whose likelihood then has no end: sigmas of 4 poses were 30 times too small.
    share = min(1.0, _SINGULAR / max(6 * (len(e) - data.n_worlds - 1), 1)) if robot is None else 0.0
    bounds = {
        "rotation": (phi / 2, max(share * phi / 2, _FINEST), 9 * phi),
        "translation": (rho / 2, max(share * rho / 2, _FINEST), 9 * rho),
        "factor": (1.0, *factors),
    }
    theta, least, most = np.array([bounds[name.split("_")[1]] for name in names(data)]).T
    most = np.maximum(most, least)
    if robot is not None and data.cov_P is None:
        # A stated repeatability is often finer than what the arm's geometry is worth: residuals may raise it.
        least[:2] = np.maximum([robot.rotation**2, robot.translation**2], _FINEST)
        most[:2] = least[:2] if robot.exact else np.maximum(most[:2], least[:2])
    return np.clip(theta, least, most), least, most


def by_reach(data: HandEyeData, kept: Mask, theta: Array) -> Array:
    """Return the variances of an arm whose angle errors are its joints', which move the hand by its reach times as much."""
    out: Array = theta.copy()
    if data.cov_P is None and data.words.arm and kept.any():
        out[1] = max(theta[1], theta[0] * float(np.median(np.sum(data.P[kept, :3, 3] ** 2, axis=1))))
    return out


def contradicts(data: HandEyeData, M: Array, e: Array, kinds: Array, theta: Array, kept: Mask, freedom: int) -> bool:
    """Return whether an arm's turns and places tell R apart as no white noise makes them (Hausman 1978).

    Under white noise X by maximum likelihood and X with places weighed less, by the arm's reach, differ by V = cov(reach) - cov(ML).
    Where R differs by more, the arm's errors depend on its pose (its geometry is not what it thinks): 28 poses of a real one had a chi2
    of 62 where chance leaves 16, and R was turned by 0.07 deg, five of its sigmas, by its places.
    """
    loose = by_reach(data, kept, theta)
    if not freedom or np.array_equal(loose, theta):
        return False
    on = on_P(data)
    C, C_loose = weighed(kinds, theta), weighed(kinds, loose)
    both = []
    for noise, values in ((C, theta), (C_loose, loose)):
        system = normal(data, M, noise, e, kept)
        both.append(believed(data, noise, weighed(kinds[:, :on], values[:on]), kept, system, chance=False)[1])
    ml, reach = both
    d = reach.cov @ reach.gradient - ml.cov @ ml.gradient
    RW = np.swapaxes(reach.J_X, 1, 2) @ reach.W * (kept & reach.active)[:, None, None]
    V = (reach.cov @ np.sum(RW @ C @ np.swapaxes(RW, 1, 2), axis=0) @ reach.cov - ml.cov)[3:, 3:]
    values, vectors = np.linalg.eigh(V)
    tells = values > _SAME * np.linalg.eigvalsh(ml.cov[3:, 3:])[-1]  # elsewhere the two have the same R
    count = int(tells.sum())
    if not count:
        return False
    chi2 = float(np.sum((vectors[:, tells].T @ d[3:]) ** 2 / values[tells]))
    # Either kind of noise is told by half of the residuals.
    return bool(chi2 > count * special.fdtri(count, freedom / 2, 1 - _CHANCE))


def freedom(data: HandEyeData, kept: Mask) -> int:
    """Return how many residuals are left over to tell the noise by: none from less than two motions."""
    count = np.bincount(data.world, kept, data.n_worlds)
    motions = int(np.sum(np.maximum(count - 1, 0)))
    return 6 * (motions - 1) if motions > 1 else 0


def told(kinds: Array, theta: Array, e: Array, spread: Array, beside: tuple[float, float] | None = None) -> Array:
    """Return the variances after two steps of Horn's (1975) iterated almost unbiased estimator, restricted likelihood's: never negative.

    theta_k <- theta_k (sum e^T C^-1 G_k C^-1 e) / (sum tr(Pi G_k)), Pi = C^-1 - C^-1 J cov J^T C^-1, with `spread` J cov J^T (n, 6, 6).
    `beside` is the sum of squares of one sigma, and their number, of other residuals that the last kind is the noise of.
    """
    W = inverse(weighed(kinds, theta))
    # What the fit has not taken: a share that hardly changes, and that is 0 to rounding where a kind of noise is all taken.
    left = np.maximum(np.einsum("nij,nkij->k", W - W @ spread @ W, kinds) / np.einsum("nij,nkij->k", W, kinds), 1e-3)
    squares, number = np.zeros(len(theta)), np.zeros(len(theta))
    if beside is not None:
        squares[-1], number[-1] = beside
    for _ in range(2):
        W = inverse(weighed(kinds, theta))
        We = W @ e[:, :, None]
        found = np.einsum("nij,nkij->k", We @ np.swapaxes(We, 1, 2), kinds) + squares / theta**2
        theta = theta * found / (left * np.einsum("nij,nkij->k", W, kinds) + number / theta) + 1e-3 * _FINEST
    return theta


def weighed(kinds: Array, theta: Array) -> Array:
    """Return each pose's covariance (n, 6, 6)."""
    return each(lambda some: np.einsum("nkij,k->nij", some, theta), kinds)


def mean_diagonal(kinds: Array, theta: Array) -> Array:
    """Return the variances (6,) summed over poses."""
    out: Array = np.einsum("nkii,k->i", kinds, theta)
    return out
