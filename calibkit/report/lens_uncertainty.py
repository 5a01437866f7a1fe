"""How well a point's pixel is known, over the image and over range, by the covariance of the lens: numbers and picture."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

from calibkit.geometry.so3 import hat
from calibkit.report.field import grid
from calibkit.report.look import ACCENT, INK, PALE
from calibkit.report.over_images import image_axes
from calibkit.report.view import Array, KnownLens, View, given

_COLUMNS, _CORNERS, _MOST_LINES = 40, 3000, 6
_RANGES = np.geomspace(0.1, 100, 40)  # m
_STEPS = np.array([1.0, 2.0, 5.0])


def camera_motion(lens: KnownLens, uv: Array, distance: Array) -> Array:
    """Return the turn and shift (6, p) of the camera (phi rad, t m) that best make up for each lens parameter over corners at distances.

    min sum |J + J_p (-[X]_x phi + t)|^2 over the corners X: what another lens changes in the board's poses tells nothing (as mrcal's
    differences and its uncertainty by the mean of the poses have it, Kogan 2021).
    """
    rays, valid = lens.model.unproject(uv, lens.params)
    J, J_p, points = _jacobians(lens, rays[valid], distance[valid])
    moved = np.concatenate([-J_p @ hat(points), J_p], axis=-1).reshape(-1, 6)
    found: Array = np.linalg.lstsq(moved, -J.reshape(-1, J.shape[-1]), rcond=None)[0]
    return found


def pixel_sigma(lens: KnownLens, motion: Array, uv: Array, distance: float) -> Array:
    """Return sigma (n,) px along the larger axis of where the points that pixels (n, 2) see at a distance are seen, NaN outside the lens.

    inf: far points, which the shift does not move.
    """
    rays, valid = lens.model.unproject(uv, lens.params)
    reach = min(distance, 1e9)
    J, J_p, points = _jacobians(lens, rays[valid], np.full(int(valid.sum()), reach))
    total = J + np.concatenate([-J_p @ hat(points), J_p], axis=-1) @ motion
    sigma = np.full(len(uv), np.nan)
    sigma[valid] = np.sqrt(np.maximum(np.linalg.eigvalsh(total @ lens.cov @ np.swapaxes(total, 1, 2))[:, -1], 0.0))
    return sigma


def _jacobians(lens: KnownLens, rays: Array, distance: Array) -> tuple[Array, Array, Array]:
    """Return du/dlens (n, 2, p), du/dX (n, 2, 3) and X (n, 3) of points on rays."""
    points = rays * distance[:, None]
    seen = lens.model.project(points, lens.params, jacobians=True)
    assert seen.J_params is not None
    assert seen.J_point is not None
    return seen.J_params, seen.J_point, points


def uncertainty(figure: Figure, view: View) -> None:
    """Draw sigma of a point's pixel over the image, at the boards' distance and far away, and over range."""
    lens, size = given(view.lens), given(view.image_size)
    some = np.flatnonzero(view.kept & np.isfinite(given(view.distance)))
    some = some[:: 1 + len(some) // _CORNERS]
    uv, distance = given(view.uv)[some], given(view.distance)[some]
    motion = camera_motion(lens, uv, distance)
    near, middle, far = np.quantile(distance, [0.05, 0.5, 0.95])
    shape = grid(size, _COLUMNS)
    at = np.stack(np.meshgrid(*(np.linspace(-0.5, length - 0.5, n) for length, n in zip(size, shape, strict=True))), axis=-1)
    axes = figure.subplots(1, 3, width_ratios=[1, 1, 0.85])
    for panel, reach, title in ((axes[0], float(middle), f"at {middle:.2g} m, where the boards were"), (axes[1], np.inf, "far away")):
        _map(panel, at, pixel_sigma(lens, motion, at.reshape(-1, 2), reach).reshape(at.shape[:2]))
        panel.plot(*uv[:: 1 + len(uv) // 600].T, ".", color=ACCENT, ms=1.2, mew=0, alpha=0.6, rasterized=True)
        image_axes(panel, size)
        panel.set_title(title)
    centre = given(view.centre)
    seen = given(view.uv)[view.kept]
    edge = seen[np.argmax(np.linalg.norm(seen - centre, axis=1))]
    places = (("centre", centre, "-", INK), ("half way out", (centre + edge) / 2, "--", ACCENT), ("outermost corner", edge, ":", "black"))
    for name, place, dash, colour in places:
        curve = np.concatenate([pixel_sigma(lens, motion, place[None], reach) for reach in _RANGES])
        axes[2].plot(_RANGES, curve, dash, color=colour, lw=1.5, label=name)
    axes[2].axvspan(float(near), float(far), color=PALE, alpha=0.5, lw=0)
    axes[2].set(xscale="log", yscale="log", xlabel="distance (m)", ylabel="sigma (px)", title="over distance; band: boards")
    for axis in (axes[2].xaxis, axes[2].yaxis):
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())
    axes[2].legend(frameon=False, fontsize=8)


def _map(panel: Axes, at: Array, sigma: Array) -> None:
    """Draw lines of equal sigma on grays."""
    known = np.isfinite(sigma)
    if not known.any():
        return
    low, high = np.quantile(sigma[known], [0.02, 0.98])
    steps = (_STEPS * 10.0 ** np.arange(-5, 5)[:, None]).ravel()
    levels = steps[(steps > 0.9 * low) & (steps < 1.1 * max(high, 1.5 * low))]
    levels = levels[:: 1 + len(levels) // _MOST_LINES]
    masked = np.ma.masked_invalid(np.maximum(sigma, 1e-9))
    panel.pcolormesh(
        at[..., 0],
        at[..., 1],
        np.log(masked),
        cmap="Greys",
        vmin=np.log(max(low, 1e-9)),
        vmax=np.log(8 * high),
        shading="gouraud",
        rasterized=True,
    )
    if len(levels):
        lines = panel.contour(at[..., 0], at[..., 1], masked, levels=levels, colors="black", linewidths=0.9)
        panel.clabel(lines, fmt=lambda value: f"{value:g} px", fontsize=7)
