"""Where a line object lies, found from scratch: the longest thin connected thing in the cloud, ordered end to end."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from pred_core.config import setting
from pred_core.track.color_model import of_same_hue
from pred_core.types import Array

MAX_VOXELS = 20000  # more is not a line object but a mask that lets everything through
CHROMA = 0.08  # difference in share of red, green or blue that parts two things that touch
MOST_OF_IT = 0.99
THIN = 90  # percent of a line's points that are near to its middle


@dataclass(frozen=True)
class LineStartConfig:
    """How a line is found."""

    voxel: float = setting(0.006, unit="m", low=1e-3, high=0.05, doc="resolution of the search")
    link: float = setting(0.016, unit="m", low=1e-3, high=0.2, doc="largest hole that is bridged along the line")
    shortest: float = setting(0.1, unit="m", low=0.01, high=5.0, doc="of a line object")
    slenderness: float = setting(6.0, low=1.0, high=1000.0, doc="least length over thickness")


@dataclass(frozen=True)
class FoundLine:
    """A first guess."""

    path: Array  # (K, 3) [m] world, end to end, about evenly spaced
    member: NDArray[np.bool_]  # (M,) points that belong to it
    length: float  # [m]


def find_line(points: Array, color: NDArray[np.uint8], config: LineStartConfig) -> FoundLine | None:
    """The most slender connected thing of one colour in points (M, 3) [m] world, colours (M, 3); None if there is none.

    What touches the line but has another colour (jaws, fixtures) does not belong to it.
    """
    found = _find(points, color, config)
    if found is None:
        return None
    same = of_same_hue(color, color[found.member])
    if same[found.member].mean() > MOST_OF_IT:
        return FoundLine(found.path, found.member & same, found.length)
    # Cells that hold a bit of both had joined them.
    again = _find(points[same], color[same], config)
    if again is None:
        return None
    member = np.zeros(len(points), bool)
    member[same] = again.member
    return FoundLine(again.path, member, again.length)


def _find(points: Array, color: NDArray[np.uint8], config: LineStartConfig) -> FoundLine | None:
    cells, chroma, owner = _voxels(points, color, config.voxel)
    if not 4 <= len(cells) <= MAX_VOXELS:
        return None
    pairs = cKDTree(cells).query_pairs(config.link, output_type="ndarray")
    apart = np.abs(chroma[pairs[:, 0]] - chroma[pairs[:, 1]]).max(axis=-1, initial=0.0)
    pairs = pairs[apart < CHROMA]
    if not len(pairs):
        return None
    # The square makes many short steps cheaper than one long: paths follow the line and do not cut its bends.
    length = np.linalg.norm(cells[pairs[:, 0]] - cells[pairs[:, 1]], axis=-1)
    graph = coo_matrix((length**2, (pairs[:, 0], pairs[:, 1])), shape=(len(cells),) * 2).tocsr()
    _, label = connected_components(graph, directed=False)
    best: FoundLine | None = None
    most = 0.0
    for component in range(int(label.max()) + 1):
        part = np.flatnonzero(label == component)
        if len(part) * config.voxel < 0.5 * config.shortest:
            continue
        path = _order(cells[part], graph[part][:, part], config)
        if path is None:
            continue
        total = float(np.linalg.norm(np.diff(path, axis=0), axis=-1).sum())
        spread = float(np.percentile(cKDTree(path).query(cells[part])[0], THIN))
        slender = total / max(2.0 * spread, config.voxel)
        if total >= config.shortest and slender >= max(config.slenderness, most):
            best, most = FoundLine(path, np.isin(owner, part), total), slender
    return best


def resample(path: Array, count: int) -> Array:
    """(count, 3) points evenly along a polyline (K, 3)."""
    step = np.linalg.norm(np.diff(path, axis=0), axis=-1)
    arc = np.concatenate([[0.0], np.cumsum(step)])
    at = np.linspace(0.0, arc[-1], count)
    return np.stack([np.interp(at, arc, path[:, k]) for k in range(3)], axis=-1)


def _voxels(points: Array, color: NDArray[np.uint8], size: float) -> tuple[Array, Array, NDArray[np.int64]]:
    """Mean point and mean share of each primary in every occupied cell (C, 3), and each point's cell.

    Cells of a single point are noise where most have more; their points get cell -1.
    """
    if not len(points):
        return np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, np.int64)
    key = np.floor((points - points.min(axis=0)) / size).astype(np.int64)
    extent = key.max(axis=0) + 1
    _, owner, count = np.unique(np.ravel_multi_index(key.T, extent), return_inverse=True, return_counts=True)
    owner = owner.ravel()
    mean = np.stack([np.bincount(owner, points[:, k]) for k in range(3)], axis=-1) / count[:, None]
    tone = np.stack([np.bincount(owner, color[:, k]) for k in range(3)], axis=-1) / count[:, None]
    chroma = tone / np.maximum(tone.sum(axis=-1, keepdims=True), 1.0)
    if float(np.median(count)) < 4:
        return mean, chroma, owner
    kept = count >= 2
    place = np.where(kept, np.cumsum(kept) - 1, -1)
    return mean[kept], chroma[kept], place[owner]


def _order(cells: Array, graph: csr_matrix, config: LineStartConfig) -> Array | None:
    """A smooth path (K, 3) between the two ends that are farthest apart along the graph."""
    first = int(np.argmax(_reach(graph, 0)))
    away = _reach(graph, first)
    last = int(np.argmax(away))
    far = dijkstra(graph, directed=False, indices=first, return_predecessors=True)[1]
    chain = [last]
    while far[chain[-1]] >= 0:
        chain.append(int(far[chain[-1]]))
    path = cells[chain]
    if len(path) < 3:
        return None
    count = max(int(np.linalg.norm(np.diff(path, axis=0), axis=-1).sum() / (2 * config.voxel)), 4)
    path = resample(path, count)
    for _ in range(3):  # pull the zigzag of a shortest path into the middle of the cells around it
        near = cKDTree(path).query(cells)[1]
        weight = np.bincount(near, minlength=len(path))
        filled = weight > 0
        mean = np.stack([np.bincount(near, cells[:, k], minlength=len(path)) for k in range(3)], axis=-1)
        path[filled] = mean[filled] / weight[filled, None]
        path[1:-1] = 0.25 * path[:-2] + 0.5 * path[1:-1] + 0.25 * path[2:]
        path = resample(path, count)
    return path


def _reach(graph: csr_matrix, start: int) -> Array:
    away = dijkstra(graph, directed=False, indices=start)
    return np.where(np.isfinite(away), away, -1.0)
