"""Kalibr's AprilGrid in an image: a few tags found by OpenCV, the rest grown from them over the board.

Each tag next to known ones is predicted by its neighbourhood (so that a lens may bend the board), its corners fitted, its code
verified. No tag is believed for its own sake: it must lie where its neighbours say, and carry its own code.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibkit.detection import april_tags
from calibkit.detection.corner_fit import Smoothed, saddle, smooth, symmetry
from calibkit.detection.found import NOTHING, Detection, Image, Tags, to_8_bit
from calibkit.detection.plane_maps import apply, homographies, in_line, local_maps, predict
from calibkit.errors import BadInputError
from calibkit.models.board import AprilGrid

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_WIDE, _NARROW = 0.16, 0.12  # saddle windows in tag sides, for far and near starts
_RADIUS = 0.18  # of the final window: inside the border and the small squares, blur included
_BRIGHT = np.array([-1.0, 1.0, -1.0, 1.0])  # x y is negative where it is white around a tag's corners 0 and 2
_REACH = 1.0  # tag sides over which neighbours tell how a lens bends
_OUT_OF_LINE = 0.05  # tag sides
_ENOUGH = 8  # corners to predict others from
_STARTS = 8  # seeds whose homographies are tried: enough that some are right
_WELL_INSIDE = 0.1  # tag sides from the image's border: a tag foretold there is found, of 2453 in a video but for two
_KEPT = 0.7  # of the tags foretold, where a board is followed
_AGREE = 0.35  # tag sides by which a lens may bend the board away from one homography


@dataclass(frozen=True)
class _Effort:
    """How hard tags are sought from others."""

    reaches: tuple[float, ...]  # steps from known tags: the second leaps over those that are hidden
    tries: tuple[tuple[float, float], ...]  # saddle window, and how far out of view a tag may be foretold, in tag sides


# A second try knows more: the corners that the first one found towards the known tags foretell the others
_SEARCH = _Effort((1.5, 2.9), ((_NARROW, _AGREE), (_NARROW, 0.1), (_WIDE, 0.1)))
_FOLLOW = _Effort((1.5,), ((_NARROW, 0.1), (_WIDE, 0.1)))


def detect(image: Image, board: AprilGrid) -> Detection:
    """Return the corners of the tags wholly in view; none where fewer than two tags fit together."""
    n = board.columns * board.rows
    if n > april_tags.N_TAGS:
        raise BadInputError(
            f"an AprilGrid of {board.columns} x {board.rows} needs {n} tags, the family 36h11 has {april_tags.N_TAGS}: use fewer"
        )
    smoothed = smooth(image)
    read = Tags()
    for tags, corners in april_tags.seeds(to_8_bit(image)):
        found = _from_seeds(smoothed, board, tags, corners)
        if len(found.corner):
            return found
        read = max(read, found.tags, key=lambda tags: tags.on_board + tags.foreign)
    return replace(NOTHING, tags=read)


def follow(image: Image, board: AprilGrid, corner: NDArray[np.int32], uv: Array) -> Detection | None:
    """Return what `detect` would, from where corners (n,) are thought to be (n, 2); None where too few of their tags are."""
    tags, first, count = np.unique(corner // 4, return_index=True, return_counts=True)
    corners = uv[first[count == 4, None] + np.arange(4)]
    in_view = _inside(image, corners).all(1)
    tags, corners = tags[count == 4][in_view], corners[in_view]
    if len(tags) < 2:
        return None
    smoothed = smooth(image)
    xy = _tags(board)
    seed, seen = _read(smoothed, tags, corners)
    if seen.sum() < max(2, _KEPT * len(tags)):
        return None
    uv, fitted, missed = _grow(smoothed, xy, 1 + board.spacing, seed[: len(xy)], np.flatnonzero(seen), _FOLLOW)
    if missed:
        return None
    return replace(_finish(smoothed, xy, board.spacing, uv, fitted), tags=Tags(int(seen.sum())))


def _from_seeds(image: Smoothed, board: AprilGrid, tags: NDArray[np.int32], corners: Array) -> Detection:
    xy = _tags(board)
    seed, seen = _read(image, tags, corners)
    foreign = int(seen[len(xy) :].sum())
    seed, seen = seed[: len(xy)], seen[: len(xy)]
    first = np.flatnonzero(seen)
    if len(first) >= 2:
        first = first[_largest_agreement(xy[first], seed[first])]
    uv, fitted, _ = _grow(image, xy, 1 + board.spacing, seed, first, _SEARCH)
    known = fitted.any(1)
    if known.sum() >= 2:
        counts = Tags(int(seen.sum()), int((seen & ~known).sum()), foreign)
        return replace(_finish(image, xy, board.spacing, uv, fitted), tags=counts)
    counts = Tags(int(seen.sum()), max(int(seen.sum()) - 1, 0), foreign)  # no two agree; a lone one contradicts nothing
    return replace(NOTHING, tags=counts)


def _tags(board: AprilGrid) -> Array:
    """Return the tags' corners (t, 4, 2) in tag sides."""
    out: Array = (board.points[:, :2] / board.tag_size).reshape(-1, 4, 2)
    return out


def _read(image: Smoothed, tags: NDArray[np.int32], corners: Array) -> tuple[Array, Mask]:
    """Return the corners (t, 4, 2) of first guesses that hold up, four saddles and the code, NaN elsewhere; and which tags (t,) do.

    Of all tags there are, those that the board does not have too.
    """
    corners, ok = _fit(image, corners, _WIDE)
    good = ok.all(1) & april_tags.verify(image, tags, corners)
    seed, seen = np.full((april_tags.N_TAGS, 4, 2), np.nan), np.zeros(april_tags.N_TAGS, bool)
    seed[tags[good]], seen[tags[good]] = corners[good], True
    return seed, seen


def _largest_agreement(xy: Array, corners: Array) -> Mask:
    """Return the most tags (n,) that the homography of some two neighbouring tags foretells, all four corners of each."""
    n = len(xy)
    centre = xy.mean(1)
    some = np.unique(np.linspace(0, n - 1, min(n, _STARTS)).astype(int))
    apart = np.linalg.norm(centre[some, None] - centre, axis=-1)
    apart[np.arange(len(some)), some] = np.inf
    partner = np.argsort(apart, axis=1)[:, : min(3, n - 1)]
    first = np.repeat(some, partner.shape[1])
    pair = np.zeros((len(first), n))
    pair[np.arange(len(first)), first] = pair[np.arange(len(first)), partner.ravel()] = 1
    H = homographies(xy.reshape(-1, 2), corners.reshape(-1, 2), np.repeat(pair, 4, axis=1))
    error = np.linalg.norm(apply(H, xy.reshape(-1, 2)).reshape(-1, n, 4, 2) - corners, axis=-1).max(-1)
    agree = error < _AGREE * _sides(corners)
    best: Mask = agree[agree.sum(1).argmax()]
    return best


def _sides(corners: Array) -> Array:
    side: Array = np.linalg.norm(corners - np.roll(corners, 1, axis=-2), axis=-1).mean(-1)
    return side


def _fit(image: Smoothed, corners: Array, window: float) -> tuple[Array, Mask]:
    """Return the tags' corners (n, 4, 2) moved to saddles near them, and which (n, 4) have one; the others stay."""
    x = (corners[:, 1] - corners[:, 0] + corners[:, 2] - corners[:, 3]) / 2
    y = (corners[:, 3] - corners[:, 0] + corners[:, 2] - corners[:, 1]) / 2
    J = np.repeat(window * np.stack([x, y], axis=-1), 4, axis=0)
    uv, found = saddle(image, corners.reshape(-1, 2), J, np.tile(_BRIGHT, len(corners)))
    moved = uv.reshape(-1, 4, 2)
    ok: Mask = (
        found.reshape(-1, 4) & (np.linalg.norm(moved - corners, axis=-1) < 1.5 * window * _sides(corners)[:, None]) & _inside(image, moved)
    )
    return np.where(ok[..., None], moved, corners), ok


def _inside(image: Image | Smoothed, corners: Array) -> Mask:
    return np.asarray(((corners > 1) & (corners < np.array(image.shape[::-1]) - 2)).all(-1))


def _grow(image: Smoothed, xy: Array, step: float, seed: Array, first: NDArray[np.intp], effort: _Effort) -> tuple[Array, Mask, int]:
    """Return the corners uv (t, 4, 2) of all tags that the seeds of the `first` (k,) lead to, and which (t, 4) were fitted.

    And how many tags are missing that should be in view. Each tag next to known ones starts from its seed where that is near the place
    foretold, else from there.
    """
    uv, fitted = np.zeros_like(xy), np.zeros(xy.shape[:2], bool)
    uv[first], fitted[first] = seed[first], True
    centre = xy.mean(1)
    apart = np.linalg.norm(centre[:, None] - centre, axis=-1) / step
    known: Mask = np.asarray(fitted.any(1))
    asked, missed = known.copy(), 0
    for reach in effort.reaches:
        neighbour = apart < reach
        ask = np.flatnonzero(~asked & neighbour[:, known].any(1))
        while len(ask):
            tried = _try(image, xy, step, uv, fitted, seed, ask, effort)
            asked[ask] = True
            missed += int((tried.in_view & ~tried.good).sum())
            found = ask[tried.good]
            uv[found], fitted[found] = tried.corners[tried.good], tried.ok[tried.good]
            known[found] = True
            ask = np.flatnonzero(~known & neighbour[:, found].any(1))  # tags with a new neighbour to lead to them
    return uv, fitted, missed


@dataclass(frozen=True)
class _Tried:
    """What came of looking for tags at foretold places."""

    corners: Array  # (m, 4, 2)
    ok: Mask  # (m, 4) saddles
    good: Mask  # (m,) three saddles or more and the code
    in_view: Mask  # (m,) foretold to be, at the last


def _try(image: Smoothed, xy: Array, step: float, uv: Array, fitted: Mask, seed: Array, ask: NDArray[np.intp], effort: _Effort) -> _Tried:
    """Look for the tags `ask` (m,). Where only the corners towards the known tags are found, they help to foretell the others once more."""
    uv, fitted = uv.copy(), fitted.copy()
    m = len(ask)
    out = _Tried(np.zeros((m, 4, 2)), np.zeros((m, 4), bool), np.zeros(m, bool), np.zeros(m, bool))
    todo = np.arange(m)
    for window, beyond in effort.tries:
        start = predict(xy[fitted], uv[fitted], xy[ask[todo]], step)
        seeds, slack = seed[ask[todo]], _AGREE * _sides(start)
        near = np.linalg.norm(seeds - start, axis=-1).max(1) < slack  # NaN is not
        start = np.where(near[:, None, None], seeds, start)
        outside = np.maximum(-start, start - image.shape[::-1]).max((1, 2))
        in_view = outside < beyond * _sides(start)
        out.in_view[todo] = outside < -_WELL_INSIDE * _sides(start)
        todo, start = todo[in_view], start[in_view]
        if not len(todo):
            break
        corners, ok = _fit(image, start, window)
        enough, inside = ok.sum(1) >= 3, _inside(image, corners).all(1)
        good = enough & inside
        good[good] = april_tags.verify(image, ask[todo[good]].astype(np.int32), corners[good])
        out.corners[todo], out.ok[todo], out.good[todo] = corners, ok, good
        uv[ask[todo]], fitted[ask[todo]] = corners, ok
        todo = todo[~good & (inside | ~enough)]  # three corners say where the fourth is: out of view
        if not len(todo):
            break
    return out


def _finish(image: Smoothed, xy: Array, spacing: float, uv: Array, fitted: Mask) -> Detection:
    """Pin down every corner of the known tags; those that found no saddle, or one out of line, start where the others say."""
    step = 1 + spacing
    corner = np.flatnonzero(np.repeat(fitted.any(1), 4))
    sure, side = fitted.reshape(-1)[corner], np.repeat(_sides(uv), 4)[corner]
    xy, start = xy.reshape(-1, 2)[corner], uv.reshape(-1, 2)[corner]
    maps, misfit = local_maps(xy, start, _REACH)
    sure = sure & in_line(misfit, _OUT_OF_LINE * side)
    for _ in range(2):
        if not sure.all() and sure.sum() >= _ENOUGH:
            start[~sure] = predict(xy[sure], start[sure], xy[~sure][:, None], step)[:, 0]
            maps, _ = local_maps(xy, start, _REACH)
        fit = symmetry(image, start, maps, min(_RADIUS, 0.6 * spacing), _BRIGHT[corner % 4])
        start = fit.uv
        maps, misfit = local_maps(xy, start, _REACH)
        sure = fit.ok & in_line(misfit, _OUT_OF_LINE * side)
        if sure.all():
            break
    return Detection(corner[sure].astype(np.int32), fit.uv[sure], fit.sigma_px[sure])
