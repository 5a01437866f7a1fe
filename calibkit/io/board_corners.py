"""Corners from files laid against the board that they are said to show."""

import numpy as np

from calibkit.data.observations import BoardViews
from calibkit.errors import BadInputError
from calibkit.io.source import CornerRows, seconds_text
from calibkit.models.board import Board

_AGREE_M = 1e-6
_ASSUMED_SIGMA_PX = 0.3  # of a good detector on real images; told in the warnings


def board_views(parts: list[CornerRows], board: Board, image_size: tuple[int, int]) -> BoardViews:
    """Return the corners of one camera as views of `board`; a file that does not fit the board or image is refused."""
    warnings = []
    for part in parts:
        _check(part, board, image_size)
    t_ns, corner = (np.concatenate([getattr(part, name) for part in parts]) for name in ("t_ns", "corner"))
    uv = np.concatenate([part.uv for part in parts])
    sigmas = [part.sigma_px for part in parts if part.sigma_px is not None]
    known = len(sigmas) == len(parts)
    sigma = np.concatenate(sigmas) if known else np.full(len(t_ns), _ASSUMED_SIGMA_PX)
    if not known:
        warnings.append(f"{parts[0].file} has no column sigma_px: {_ASSUMED_SIGMA_PX} px is assumed for all corners")
    frames, frame = np.unique(t_ns, return_inverse=True)
    order = np.lexsort((corner, frame))
    doubled = np.zeros(len(order), bool)
    doubled[1:] = (np.diff(frame[order]) == 0) & (np.diff(corner[order]) == 0)
    if doubled.any():
        warnings.append(f"{parts[0].file}: {np.sum(doubled)} corners come twice in a frame; the first is taken")
    rows = order[~doubled]
    return BoardViews(
        board=board,
        image_size=image_size,
        t_ns=frames,
        labels=tuple(seconds_text(int(t)) for t in frames),
        frame=frame[rows].astype(np.int32),
        corner=corner[rows].astype(np.int32),
        uv=uv[rows],
        sigma_px=sigma[rows],
        n_images=len(frames),
        warnings=tuple(warnings),
    )


def _check(part: CornerRows, board: Board, image_size: tuple[int, int]) -> None:
    rows, columns = board.shape
    title = f"the {board.kind} of {columns} x {rows}"
    if len(part.corner) and part.corner.max() >= len(board.points):
        raise BadInputError(f"{part.file}: tag {part.corner.max() // 4} is not on {title}: check --target")
    if part.xyz is not None and len(part.corner):
        off = np.abs(part.xyz - board.points[part.corner]).max(axis=1)
        worst = int(off.argmax())
        if not off[worst] <= _AGREE_M:
            where = ", ".join(f"{value:g}" for value in part.xyz[worst])
            raise BadInputError(
                f"{part.file}: tag {part.corner[worst] // 4} corner {part.corner[worst] % 4} lies at ({where}) m there, "
                f"{off[worst]:.3g} m from where {title} has it: check tagSize and tagSpacing of --target"
            )
    if np.any(part.uv < -1) or np.any(part.uv > np.array(image_size)):
        (left, top), (right, bottom) = part.uv.min(axis=0), part.uv.max(axis=0)
        raise BadInputError(
            f"{part.file}: corners lie outside of an image of {image_size[0]} x {image_size[1]}, "
            f"from ({left:.0f}, {top:.0f}) to ({right:.0f}, {bottom:.0f}) px: check --resolution"
        )
    if part.sigma_px is not None and not np.all((part.sigma_px > 0) & np.isfinite(part.sigma_px)):
        raise BadInputError(f"{part.file}: sigma_px must be positive")
