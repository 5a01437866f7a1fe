"""Poses between two frames of a tf tree, chained through transforms that come at different times."""

from collections import deque

import numpy as np
from numpy.typing import NDArray

from calibkit.data.observations import PoseSamples
from calibkit.errors import BadInputError, one_line
from calibkit.geometry import se3, so3
from calibkit.io.source import Edge

Array = NDArray[np.float64]
Times = NDArray[np.int64]
Edges = dict[tuple[str, str], Edge]
_LONGEST_BRIDGE = 5  # median intervals between two transforms to interpolate across


def _path(edges: Edges, parent: str, child: str) -> list[tuple[str, str]] | None:
    """Return the frame pairs from parent to child, breadth first."""
    neighbours: dict[str, list[str]] = {}
    for a, b in edges:
        neighbours.setdefault(a, []).append(b)
        neighbours.setdefault(b, []).append(a)
    came_from = {parent: parent}
    queue = deque([parent])
    while queue and child not in came_from:
        frame = queue.popleft()
        for other in neighbours.get(frame, []):
            if other not in came_from:
                came_from[other] = frame
                queue.append(other)
    if child not in came_from or parent not in neighbours:
        return None
    path = []
    while child != parent:
        path.append((came_from[child], child))
        child = came_from[child]
    return path[::-1]


def _matrices(edge: Edge) -> tuple[Times, Array]:
    """Return times, strictly increasing, and T_parent_child (n, 4, 4)."""
    t_ns, first = np.unique(edge.poses.t_ns, return_index=True)
    return t_ns, se3.make(so3.from_quat(edge.poses.q[first]), edge.poses.p[first])


def _at(t_ns: Times, T: Array, times: Times) -> tuple[Array, NDArray[np.bool_]]:
    """Return T interpolated (rotation and position apart) and where two transforms near enough bracket the time."""
    right = np.clip(np.searchsorted(t_ns, times), 1, max(len(t_ns) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(t_ns) - 1)
    span = t_ns[right] - t_ns[left]
    exact = (times == t_ns[left]) | (times == t_ns[right])
    typical = np.median(np.diff(t_ns)) if len(t_ns) > 1 else 0
    inside = (times >= t_ns[left]) & (times <= t_ns[right]) & (exact | (span <= _LONGEST_BRIDGE * typical))
    part = np.clip((times - t_ns[left]) / np.maximum(span, 1), 0, 1)[:, None]
    R_left, R_right = T[left, :3, :3], T[right, :3, :3]
    R = R_left @ so3.exp(part * so3.log(np.swapaxes(R_left, -1, -2) @ R_right))
    return se3.make(R, (1 - part) * T[left, :3, 3] + part * T[right, :3, 3]), inside


def chain(edges: Edges, parent: str, child: str, name: str) -> PoseSamples:
    """Return T_parent_child at the times of the slowest moving transform on the way; static ones hold always.

    At other transforms' times it is interpolated; times outside their data, or in a gap of it, are left out.
    """
    path = _path(edges, parent, child)
    if path is None:
        frames = sorted({frame for pair in edges for frame in pair})
        offered = one_line(", ".join(frames), 200) or "none"
        raise BadInputError(f"{name}: no tf from {one_line(parent, 60)} to {one_line(child, 60)}; the recording's frames: {offered}")
    steps = [(edges[a, b], False) if (a, b) in edges else (edges[b, a], True) for a, b in path]
    moving = [edge for edge, _ in steps if not edge.static]
    slowest = min(moving or [edge for edge, _ in steps], key=lambda edge: len(edge.poses.t_ns), default=None)
    if slowest is None or not all(len(edge.poses.t_ns) for edge, _ in steps):
        raise BadInputError(f"{name}: tf from {one_line(parent, 60)} to {one_line(child, 60)} holds no transform: name two frames")
    times = np.unique(slowest.poses.t_ns)
    T, keep = np.broadcast_to(np.eye(4), (len(times), 4, 4)), np.ones(len(times), bool)
    for edge, backwards in steps:
        t_ns, step = _matrices(edge)
        if edge.static:
            step = np.broadcast_to(step[-1], T.shape)
        else:
            step, inside = _at(t_ns, step, times)
            keep &= inside
        T = T @ (se3.inverse(step) if backwards else step)
    return PoseSamples(times[keep], so3.to_quat(T[keep, :3, :3]), T[keep, :3, 3].copy(), parent, child)
