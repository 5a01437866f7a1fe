"""A closed form's X in place of the refined one, as asked for, with the covariance that redrawing the noise shows it to have."""

from dataclasses import replace

import numpy as np

from calibkit.errors import BadInputError
from calibkit.estimation.hand_eye import HandEyeFit
from calibkit.estimation.hand_eye_compared import apart, pairs_of, scatter, solve
from calibkit.estimation.hand_eye_known import open_covariance
from calibkit.estimation.hand_eye_methods import METHODS
from calibkit.estimation.hand_eye_open import open_directions
from calibkit.estimation.hand_eye_pairs import motions
from calibkit.geometry import se3
from calibkit.geometry.so3 import Array

DRAWS = 100  # sigmas to 7 %
_FLOOR = 1e-10  # variance of rounding, m^2 and rad^2: what no noise moves is known to 10 um and 10 urad


def by_closed_form(fit: HandEyeFit, name: str) -> HandEyeFit:
    """Return the fit with X and Z by a closed form on the same poses; BadInputError where it cannot be had from them.

    Covariances are second moments about the refined X and Z, so a bias of the method is in them, of poses drawn anew: the adjusted ones
    with noise of the covariances that the residuals told, inflated as the refined X's is. What is not observable stays so: a closed form
    that picks the smallest p there does not scatter.
    """
    data, found = fit.data, fit.refined
    pairs = pairs_of(data, found.kept)
    if not len(pairs) or (name not in METHODS and data.n_worlds > 1):
        able = f"choose one of refined, {', '.join(METHODS)}" if len(pairs) else "leave out --method"
        raise BadInputError(f"--method {name} needs poses about one common world, which these are not: {able}")
    X, Z = solve(name, data, found.kept, pairs)
    rng = np.random.default_rng(0)
    true_P = found.Z[data.world] @ found.M @ se3.inverse(found.X)
    root_P, root_Q = (_root(C) for C in (found.C_P, found.C - found.C_P))
    carry = se3.adjoint(found.X)
    x, z = np.zeros((DRAWS, 6)), np.zeros((DRAWS, 6))
    for k in range(DRAWS):
        of_P, of_Q = (np.einsum("nij,nj->ni", root, rng.normal(size=(len(root), 6))) for root in (root_P, root_Q))
        drawn = replace(data, P=se3.retract(true_P, of_P @ carry.T), Q=se3.retract(found.M, of_Q))
        X_k, Z_k = solve(name, drawn, found.kept, pairs)
        x[k], z[k] = se3.local(found.X, X_k), se3.local(found.Z[0], Z_k[0])
    plain, cov = _moments(x, fit.trusted.inflation, fit.trusted.cov_X)
    clocks = fit.cov_X - fit.trusted.cov_X  # what the sigma of two streams' offset brings
    Z_plain, Z_cov = _moments(z, fit.trusted.inflation, fit.trusted.cov_Z)
    one = fit.Z is not None
    angle, distance = apart(motions(data.P, fit.pairs) @ X, X @ motions(data.Q, fit.pairs))
    return replace(
        fit,
        X=X,
        cov_X=cov + clocks,
        plain_cov_X=plain + clocks,
        Z=Z[0] if one else None,
        cov_Z=Z_cov if one else None,
        plain_cov_Z=Z_plain if one else None,
        residual=se3.local(Z[data.world] @ data.Q, data.P @ X),
        pair_angle=angle,
        pair_distance=distance,
        scatter=scatter(data, X, found.kept),
        open=open_directions(data, X, cov + clocks),
    )


def _moments(d: Array, inflation: float, cov: Array) -> tuple[Array, Array]:
    """Return the second moment of draws d (k, 6), with what is not observable by the refined covariance, and the inflated one."""
    hidden, plain = open_covariance(cov), d.T @ d / len(d) + _FLOOR * np.eye(6)
    return plain + hidden, plain * inflation + hidden


def _root(C: Array) -> Array:
    """Return F (..., 6, 6) with F F^T = C, which may be singular."""
    values, vectors = np.linalg.eigh(C)
    out: Array = vectors * np.sqrt(np.maximum(values, 0))[..., None, :]
    return out
