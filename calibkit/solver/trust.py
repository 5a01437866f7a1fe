"""How far to trust an estimate, from the information S and the scores of independent blocks of the data, and nothing else."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_MIN_BLOCKS = 9
FEW_BLOCKS = 10  # up to as many, blocks cannot show that errors are smaller than white noise makes them
DETERMINED, WEAK = 3.0, 30.0  # limits of sigma along a direction, in units of what it must be known to

# What a parameter must be known to, by unit; a problem may override it (a lens coefficient: 1 px at the image's edge).
SCALES = {"rad": 1e-3, "m": 1e-3, "s": 1e-4, "px": 1.0, "": 1e-3}

Grade = Literal["determined", "weak", "not observable"]


@dataclass(frozen=True)
class Covariance:
    """Covariance of the calibration, as if residuals were white and as they are."""

    plain: Array  # s^2 S^-1
    corrected: Array  # S^-1 (sum_b g_b g_b^T) S^-1, small-sample corrected
    variance_factor: float  # s^2
    blocks: int

    @property
    def factors(self) -> Array:
        """Return the ratio of corrected to plain sigma per parameter."""
        ratio: Array = np.sqrt(np.diag(self.corrected) / np.diag(self.plain))
        return ratio


@dataclass(frozen=True)
class Direction:
    """One principal direction of the scaled covariance."""

    sigma: float  # along it, in units of the scales
    vector: Array  # (p,) in scaled units, unit length

    @property
    def grade(self) -> Grade:
        return grade(self.sigma)


def grade(sigma_over_scale: float) -> Grade:
    """Return the word for a sigma in units of what it must be known to."""
    if sigma_over_scale <= DETERMINED:
        return "determined"
    return "weak" if sigma_over_scale <= WEAK else "not observable"


def _inverse_root(S: Array, scales: Array) -> Array:
    """Return F with F F^T = S^-1; directions that S knows nothing of get a huge, finite variance."""
    values, vectors = np.linalg.eigh(S * scales[:, None] * scales)
    floor = max(values[-1], 1e-300) * 1e-15
    root: Array = scales[:, None] * vectors / np.sqrt(np.maximum(values, floor))
    return root


def covariance(
    S_blocks: Array, scores: Array, variance_factor: float, scales: Array, prior: Array | None = None, least: float = 0.0
) -> Covariance:
    """Return the sandwich covariance from each block's information (b, p, p) and score (b, p) at the optimum.

    Whitened by S^-1/2, block scores have covariance s^2 Z_b (I - Z_b) under white noise, Z_b the block's share of the
    information; (I - Z_b)^-1/2 makes the sum unbiased (the CR2 of Bell and McCaffrey 2002). With few blocks the sum is
    itself uncertain, so it is shrunk towards its mean factor with the weight of 2 p blocks (as Ledoit and Wolf 2004 do).
    `prior` (p, p) is information that no block holds, in their units: one more block, whose score is what it claims to be.
    No direction's variance comes out below `least` times the plain one.
    """
    p = S_blocks.shape[-1]
    prior = np.zeros((p, p)) if prior is None else prior
    F = _inverse_root(S_blocks.sum(axis=0) + prior, scales)
    values, vectors = np.linalg.eigh(F.T @ S_blocks @ F)
    # A block that carries nearly all the information of a direction cannot be checked by the others; cap its correction.
    gain = 1 / np.sqrt(np.clip(1 - values, 0.1, 1.0))
    h = np.einsum("bij,bj->bi", vectors * gain[:, None, :], np.einsum("bji,bj->bi", vectors, scores @ F))
    W = h.T @ h + variance_factor * F.T @ prior @ F
    blocks, pull = len(S_blocks), 2.0 * p
    W = (blocks * W + pull * np.trace(W) / p * np.eye(p)) / (blocks + pull)
    values, vectors = np.linalg.eigh(W)
    W = vectors * np.maximum(values, least * variance_factor) @ vectors.T
    return Covariance(variance_factor * F @ F.T, F @ W @ F.T, variance_factor, blocks)


def covariance_in_time(
    S: Array, scores: Array, t_s: Array, variance_factor: float, scales: Array, prior: Array | None = None, least: float = 0.0
) -> Covariance:
    """Return the covariance for information and scores of epochs at t_s, with blocks as long as the residuals are correlated.

    Blocks are 1, 2, 4, ... s long while at least nine remain; the length that shows the most correlation is taken (batch means
    grow with the length until they hold it all). That the corrected variance is below the plain one is believed in proportion to the
    blocks beyond ten: the sum over few of them falls short by chance, and 3 to 6 images had sigmas up to 1.6 times too small. It is never
    believed to be below `least` times the plain one.
    """
    choices: list[tuple[float, Array, Array]] = []
    length = 1.0
    while True:
        block = np.unique(np.floor((t_s - t_s.min()) / length), return_inverse=True)[1]
        count = int(block.max()) + 1
        if choices and count < _MIN_BLOCKS:
            break
        S_blocks, g_blocks = np.zeros((count, *S.shape[1:])), np.zeros((count, S.shape[-1]))
        np.add.at(S_blocks, block, S)
        np.add.at(g_blocks, block, scores)
        correlated = float(np.mean(covariance(S_blocks, g_blocks, variance_factor, scales, prior).factors ** 2))
        choices.append((correlated, S_blocks, g_blocks))
        length *= 2
    _, S_blocks, g_blocks = max(choices, key=lambda choice: choice[0])
    return covariance(S_blocks, g_blocks, variance_factor, scales, prior, least=max(least, min(1.0, FEW_BLOCKS / len(S_blocks))))


def directions(covariance: Array, scales: Array) -> list[Direction]:
    """Return the principal directions of the covariance in units of the scales, the weakest first."""
    values, vectors = np.linalg.eigh(covariance / scales[:, None] / scales)
    return [Direction(float(np.sqrt(max(values[i], 0.0))), vectors[:, i]) for i in range(len(values) - 1, -1, -1)]
