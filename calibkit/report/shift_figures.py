"""The picture of how far pixels move between two calibrations."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from calibkit.report.figures import rendered
from calibkit.report.look import ACCENT, INK
from calibkit.report.over_images import image_axes, round_down
from calibkit.report.view import Array

_COLUMNS = 24  # of arrows


def pixel_shift(fields: Sequence[tuple[str, Array, Array]], size: tuple[int, int]) -> bytes:
    """Return a PNG of fields beside each other: what it is, uv (g, 2) px, moved (g, 2) px with NaN where nothing is seen."""

    def draw(figure: Figure) -> None:
        for axes, (what, uv, moved) in zip(figure.subplots(1, len(fields), squeeze=False)[0], fields, strict=True):
            seen = np.isfinite(moved).all(axis=1)
            length = np.linalg.norm(moved[seen], axis=1)
            longest = float(np.max(length, initial=0.0)) or 1.0
            columns = len(np.unique(uv[:, 0]))
            shades = np.full(len(uv), np.nan)
            shades[seen] = length
            shown = axes.imshow(
                shades.reshape(-1, columns), cmap="Greys", vmin=0, vmax=1.6 * longest, extent=(-0.5, size[0] - 0.5, size[1] - 0.5, -0.5)
            )
            scale = longest / (1.5 * size[0] / _COLUMNS)
            arrows = axes.quiver(
                *uv[seen].T, *moved[seen].T, angles="xy", scale_units="xy", scale=scale, color=INK, width=0.003, pivot="mid"
            )
            key = round_down(longest)
            axes.quiverkey(arrows, 0.85, -0.2, key, f"{key:g} px", labelpos="W", color=INK)
            if len(length):
                axes.plot(*uv[seen][length.argmax()], "o", mfc="none", color=ACCENT, ms=10)
            image_axes(axes, size)
            figure.colorbar(shown, ax=axes, shrink=0.75, label="px").ax.set_ylim(0, longest)
            axes.set_title(f"far points, camera {what}: worst {longest:.2g} px (circle)")

    return rendered(3.2, draw, ("png",))["png"]
