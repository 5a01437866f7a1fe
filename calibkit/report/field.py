"""Structure in residuals that noise does not have: what repeats at one place of the image, and what neighbours share."""

from dataclasses import dataclass

import numpy as np

from calibkit.report.view import Array, Index, View, given

MAX_BLOCKS = 100
COLUMNS = 10  # of the grid over the image's width
RINGS = 8


@dataclass(frozen=True)
class Repeating:
    """The part of a signal that is the same in every frame, by cell."""

    mean: Array  # (c, k) mean in each cell
    sigma: Array  # (c, k) its standard error between frames; NaN below two frames
    count: Index  # (c,) rows
    size: float  # root mean square over the rows of the repeating part, cleared of noise
    significance: float  # in sigma of what independent frames would give


def repeating(values: Array, cell: Index, n_cells: int, frame: Index) -> Repeating:
    """Return what of values (n, k) repeats at the same cell in different frames.

    With s_cb the sum of the values in cell c and block b of frames, n_cb their number and N_c = sum_b n_cb, products of different
    blocks hold no noise: |f_c|^2 = (|sum_b s_cb|^2 - sum_b |s_cb|^2) / (N_c^2 - sum_b n_cb^2), and size^2 is its mean over the rows.
    Were the blocks independent, the variance of size^2 would be 2 sum_{b != d} K_bd^2, K_bd = sum_c w_c d_cb . d_cd with d the sums less
    their cell's mean. Frames are joined into at most MAX_BLOCKS blocks in order, because the frames of a video share their errors.
    """
    block, n_blocks = _blocks(frame)
    k = values.shape[1]
    flat = block * n_cells + cell
    counts = np.bincount(flat, minlength=n_blocks * n_cells).reshape(n_blocks, n_cells).astype(float)
    sums = np.stack([np.bincount(flat, values[:, j], n_blocks * n_cells).reshape(n_blocks, n_cells) for j in range(k)], axis=-1)
    total = counts.sum(axis=0)
    pairs = total**2 - np.sum(counts**2, axis=0)
    met_again = pairs > 0  # cells that two blocks have seen: the others tell nothing
    weight = np.where(met_again, total / np.where(met_again, pairs, 1), 0) / max(total[met_again].sum(), 1)  # (c,)
    mean = sums.sum(axis=0) / np.maximum(total, 1)[:, None]
    seen = np.sum(counts > 0, axis=0)
    unbiased = np.where(seen > 1, seen / np.maximum(seen - 1, 1), np.nan)[:, None]  # of the spread around the mean of as many blocks
    about = sums - counts[..., None] * mean
    power = np.sum(weight[:, None] * (sums.sum(axis=0) ** 2 - np.sum(sums**2, axis=0)))
    scaled = (about * np.sqrt(weight[:, None] * np.nan_to_num(unbiased))).reshape(n_blocks, -1)
    products = scaled @ scaled.T
    noise = np.sqrt(2 * (np.sum(products**2) - np.sum(np.diag(products) ** 2)))
    return Repeating(
        mean=mean,
        sigma=np.sqrt(np.sum(about**2, axis=0) * unbiased) / np.maximum(total, 1)[:, None],
        count=total.astype(np.intp),
        size=float(np.sqrt(max(power, 0.0))),
        significance=float(power / noise) if noise > 0 else 0.0,
    )


def _blocks(frame: Index) -> tuple[Index, int]:
    n_frames = int(frame.max()) + 1 if len(frame) else 1
    n_blocks = min(n_frames, MAX_BLOCKS)
    return frame * n_blocks // n_frames, n_blocks


def grid(size: tuple[int, int], columns: int = COLUMNS) -> tuple[int, int]:
    """Return columns and rows of nearly square cells over an image of width, height px."""
    return columns, int(np.clip(round(columns * size[1] / size[0]), 1, 4 * columns))


def cells(uv: Array, size: tuple[int, int], shape: tuple[int, int]) -> Index:
    """Return the cell row * columns + column of each pixel (n, 2); pixels outside count to the cell at the border."""
    x, y = (np.clip((uv[:, i] + 0.5) / size[i] * n, 0, n - 1).astype(np.intp) for i, n in enumerate(shape))
    cell: Index = y * shape[0] + x
    return cell


def over_image(view: View) -> tuple[Repeating, tuple[int, int]]:
    """Return the mean residual by cell of a grid over the image, and the grid's columns and rows."""
    size = given(view.image_size)
    shape = grid(size)
    cell = cells(given(view.uv)[view.kept], size, shape)
    return repeating(view.raw[view.kept], cell, shape[0] * shape[1], given(view.frame)[view.kept]), shape


def over_radius(view: View) -> tuple[Repeating, Repeating, Array]:
    """Return the mean radial and tangential residual by ring around the principal point, and the rings' edges in px.

    Radial is positive outwards, tangential clockwise as seen (x right, y down).
    """
    arm = given(view.uv)[view.kept] - given(view.centre)
    radius = np.linalg.norm(arm, axis=1)
    unit = arm / np.maximum(radius, 1e-9)[:, None]
    raw, frame = view.raw[view.kept], given(view.frame)[view.kept]
    edges = np.linspace(0, radius.max() + 1e-6, RINGS + 1)
    ring = np.clip(np.digitize(radius, edges) - 1, 0, RINGS - 1)
    radial = np.sum(raw * unit, axis=1)[:, None]
    tangential = (unit[:, 0] * raw[:, 1] - unit[:, 1] * raw[:, 0])[:, None]
    return repeating(radial, ring, RINGS, frame), repeating(tangential, ring, RINGS, frame), edges


def neighbour_correlation(view: View) -> tuple[float, int]:
    """Return the correlation of residuals of neighbouring corners in the same frame, and how many pairs there were.

    rho = 2 sum r_i . r_j / sum (|r_i|^2 + |r_j|^2) over corners with ids i, j = i + 1. Where the ids jump from the end of a row of the
    board to the next, the pixels are far apart: pairs beyond twice their frame's median distance are left out.
    """
    frame, corner = given(view.frame)[view.kept], given(view.corner)[view.kept]
    order = np.lexsort([corner, frame])
    frame, corner = frame[order], corner[order]
    uv, raw = given(view.uv)[view.kept][order], view.raw[view.kept][order]
    first = np.flatnonzero((np.diff(frame) == 0) & (np.diff(corner) == 1))
    distance = np.linalg.norm(uv[first + 1] - uv[first], axis=1)
    near = distance <= 2 * _median_by(frame[first], distance, len(view.labels))[frame[first]]
    first = first[near]
    energy = np.sum(raw[first] ** 2 + raw[first + 1] ** 2)
    return (float(2 * np.sum(raw[first] * raw[first + 1]) / energy) if energy > 0 else 0.0), len(first)


def _median_by(group: Index, values: Array, n: int) -> Array:
    """Return the lower median of the values of each group (n,), NaN where a group is empty; groups come sorted."""
    order = np.lexsort([values, group])
    count = np.bincount(group, minlength=n)
    start = np.cumsum(count) - count
    out = np.full(n, np.nan)
    some = count > 0
    out[some] = values[order][(start + (count - 1) // 2)[some]]
    return out
