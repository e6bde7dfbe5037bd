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
from pred_core.track.line_fit import Anchors, Cloud, LineFitConfig, fit_line
from pred_core.types import Array

MAX_VOXELS = 20000  # more is not a line object but a mask that lets everything through
CHROMA = 0.08  # difference in share of red, green or blue that parts two things that touch
MOST_OF_IT = 0.99
SIDEWAYS = 0.7  # of a piece behind a hole, to the way ahead
LEAST_CELLS = 3  # of a piece behind a hole
MOSTLY = 0.9  # of its cells lie ahead and have the line's colour
THIN = 90  # percent of a line's points that are near to its middle
SETTLE_ROUNDS, SETTLE_ITERATIONS = 8, 3  # a length that is not known is after each round what the points have


@dataclass(frozen=True)
class LineStartConfig:
    """How a line is found."""

    voxel: float = setting(0.006, unit="m", low=1e-3, high=0.05, doc="resolution of the search")
    link: float = setting(0.016, unit="m", low=1e-3, high=0.2, doc="largest hole that is bridged along the line")
    bridge: float = setting(0.12, unit="m", low=0.0, high=0.5, doc="longest hole in the depth between pieces of it")
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
    _, label = connected_components(_graph(cells, pairs), directed=False)
    best: _Piece | None = None
    for piece in np.flatnonzero(np.bincount(label) * config.voxel >= 0.5 * config.shortest):
        made = _piece(cells, pairs, np.flatnonzero(label == piece), config)
        if made is not None and made.slenderness >= (config.slenderness if best is None else best.slenderness):
            best = made
    while best is not None and (bridge := next_piece(cells, chroma, label, best, config)) is not None:
        pairs = np.concatenate((pairs, [bridge]))
        label[label == label[bridge[1]]] = label[bridge[0]]
        longer = _piece(cells, pairs, np.flatnonzero(label == label[bridge[0]]), config)
        if longer is None or longer.length <= best.length:
            break
        best = longer
    return None if best is None else FoundLine(best.path, np.isin(owner, best.part), best.length)


@dataclass(frozen=True)
class _Piece:
    """A connected thing that may be the line, or a part of it."""

    part: NDArray[np.int64]  # its cells
    path: Array  # (K, 3) [m]
    length: float  # [m]
    slenderness: float


def _piece(cells: Array, pairs: NDArray[np.int64], part: NDArray[np.int64], config: LineStartConfig) -> _Piece | None:
    path = _order(cells[part], _graph(cells, pairs)[part][:, part], config)
    if path is None:
        return None
    total = float(np.linalg.norm(np.diff(path, axis=0), axis=-1).sum())
    spread = float(np.percentile(cKDTree(path).query(cells[part])[0], THIN))
    slender = total / max(2.0 * spread, config.voxel)
    return _Piece(part, path, total, slender) if total >= config.shortest else None


def _graph(cells: Array, pairs: NDArray[np.int64]) -> csr_matrix:
    # The square makes many short steps cheaper than one long: paths follow the line and do not cut its bends.
    length = np.linalg.norm(cells[pairs[:, 0]] - cells[pairs[:, 1]], axis=-1)
    return coo_matrix((length**2, (pairs[:, 0], pairs[:, 1])), shape=(len(cells),) * 2).tocsr()


def next_piece(
    cells: Array, chroma: Array, label: NDArray[np.int32], line: _Piece, config: LineStartConfig
) -> tuple[int, int] | None:
    """(cell of the line, cell beyond one of its ends) where the line goes on behind a hole in the depth; None: nowhere.

    What goes on has the line's colour, at least three cells, and lies ahead, the part of it that is
    near at least.
    """
    tone = np.median(chroma[line.part], axis=0)
    alike = np.abs(chroma - tone).max(axis=-1) < CHROMA
    mine = np.zeros(len(cells), bool)
    mine[line.part] = True
    found: list[tuple[float, tuple[int, int]]] = []
    for end, inner in ((line.path[0], line.path[min(3, len(line.path) - 1)]), (line.path[-1], line.path[-4:][0])):
        ahead = (end - inner) / max(float(np.linalg.norm(end - inner)), 1e-9)
        away = cells - end
        along = away @ ahead
        aside = np.linalg.norm(away - along[:, None] * ahead, axis=-1)
        inside = (along > 0.0) & (aside <= np.maximum(SIDEWAYS * along, 2.0 * config.voxel)) & alike
        far = np.linalg.norm(away, axis=-1)
        near = inside & ~mine & (far < config.bridge)
        for other in np.unique(label[near]):
            those = label == other
            first = those & (far < far[those].min() + config.bridge)
            if those.sum() >= LEAST_CELLS and inside[first].mean() > MOSTLY:
                begin = np.flatnonzero(near & those)
                nearest = int(begin[np.argmin(along[begin])])
                root = int(line.part[np.argmin(np.linalg.norm(cells[line.part] - cells[nearest], axis=-1))])
                found.append((float(along[nearest]), (root, nearest)))
    return min(found)[1] if found else None


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


def settle(
    nodes: Array, cloud: Cloud, radius: float, config: LineFitConfig, length: float | None, ends: Anchors
) -> tuple[Array, float]:
    """Nodes (N, 3) [m] fitted from a rough path, and their length [m]: the given one, else the one its points have."""
    for _ in range(SETTLE_ROUNDS):
        edge = np.linalg.norm(np.diff(nodes, axis=0), axis=-1)
        spacing = (float(edge.sum()) if length is None else length) / (len(nodes) - 1)
        fit = fit_line(nodes, spacing, cloud, radius, config, ends, iterations=SETTLE_ITERATIONS)
        nodes = fit.nodes if length is not None else resample(fit.nodes, len(nodes))
    return nodes, float(np.linalg.norm(np.diff(nodes, axis=0), axis=-1).sum())
