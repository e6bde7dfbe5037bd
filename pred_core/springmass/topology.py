"""From particles to a Body: which springs and bends exist, and what each particle weighs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree, shortest_path
from scipy.spatial import cKDTree

from pred_core.errors import InputError
from pred_core.types import KINDS, Array, Body, Physics

Springs = NDArray[np.int32]
STRAIGHT = -0.9  # cosine of the angle at a particle between two edges that continue each other


def build_body(
    kind: str,
    rest_position: Array,
    total_mass: float,
    physics: Physics,
    *,
    id: NDArray[np.uint32] | None = None,
    rest_length: Array | None = None,
    radius: float = 0.0,
) -> Body:
    """A uniform Body over `rest_position` (N, 3) [m] with the springs `physics` asks for.

    `rest_length` (N-1,) [m], for a line, overrides the distances of consecutive particles.
    Raises: InputError for fewer than two particles, positions that are not finite, or a loose particle.
    """
    if kind not in KINDS:
        raise InputError("object kind", got=kind, allowed=", ".join(KINDS))
    position = np.asarray(rest_position, dtype=np.float64)
    if position.ndim != 2 or len(position) < 2 or not np.isfinite(position).all():
        raise InputError("rest positions", got=f"shape {position.shape}", allowed="(N, 3) finite, N at least 2")
    order = line_order(position) if kind == "line" else np.arange(len(position))
    arc = _arc(position, order, kind)
    springs = greedy_springs(position, physics.connection_threshold, physics.max_springs)
    length = np.linalg.norm(position[springs[:, 1]] - position[springs[:, 0]], axis=1)
    if rest_length is not None:
        length = _along_line(springs, order, np.asarray(rest_length, dtype=np.float64), length)
    bends = line_bends(order) if kind == "line" else straight_bends(position, springs)
    count = len(position)
    return Body(
        kind=kind,
        id=np.arange(count, dtype=np.uint32) if id is None else np.asarray(id, dtype=np.uint32),
        rest_position=position,
        mass=total_mass * _mass_share(position, order, kind),
        springs=springs,
        rest_length=length,
        stiffness_scale=np.ones(len(springs)),
        damping_scale=np.ones(len(springs)),
        friction_scale=np.ones(count),
        surface=np.ones(count, dtype=bool),
        region=np.zeros(count, dtype=np.int32),
        bends=bends,
        bend_scale=np.ones(len(bends)),
        arc=arc,
        radius=radius,
    )


def greedy_springs(position: Array, threshold: float, most: int) -> Springs:
    """Pairs nearer than `threshold` [m], shortest first, each added while both ends have fewer than `most`.

    The paper's rule (III-A). Returns (S, 2) int32 sorted by first particle, which keeps memory local.
    """
    pairs = cKDTree(position).query_pairs(threshold, output_type="ndarray").astype(np.int32)
    if len(pairs) == 0:
        return np.zeros((0, 2), np.int32)
    pairs.sort(axis=1)
    length = np.linalg.norm(position[pairs[:, 1]] - position[pairs[:, 0]], axis=1)
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0], length))]
    degree = np.zeros(len(position), dtype=np.int64)
    kept = np.zeros(len(pairs), dtype=bool)
    for n, (i, j) in enumerate(pairs):
        if degree[i] < most and degree[j] < most:
            kept[n] = True
            degree[i] += 1
            degree[j] += 1
    springs = pairs[kept]
    return np.ascontiguousarray(springs[np.lexsort((springs[:, 1], springs[:, 0]))])


def union_topology(position: Array, widest: float, most: int) -> tuple[Springs, NDArray[np.int32]]:
    """Springs of every max-springs setting up to `most` within `widest` [m], in one list.

    Returns (springs (S, 2), least (S, most)): `least[s, m-1]` is 1 where spring s exists with m springs a
    particle. A candidate's springs are `least[:, m-1] & (length <= threshold)`: greedy insertion by length
    makes a smaller threshold a prefix of a larger one.
    """
    sets = [{(i, j) for i, j in greedy_springs(position, widest, m).tolist()} for m in range(1, most + 1)]
    union = np.array(sorted(set().union(*sets)), dtype=np.int32).reshape(-1, 2)
    member = np.array([[tuple(p) in s for s in sets] for p in union.tolist()], dtype=np.int32).reshape(len(union), most)
    return union, member


def line_order(position: Array) -> NDArray[np.int64]:
    """Particles from one end of a line to the other: as given if that is a short path, else along the tree.

    "Short" is at most 1.5 times the minimum spanning tree.
    """
    count = len(position)
    distance = np.linalg.norm(position[:, None] - position[None], axis=2)
    tree = minimum_spanning_tree(distance)
    given = np.arange(count)
    if np.linalg.norm(np.diff(position, axis=0), axis=1).sum() <= 1.5 * tree.sum():
        return given
    reach = shortest_path(tree, directed=False)
    first = int(np.argmax(reach.max(axis=1)))
    order = np.argsort(reach[first], kind="stable")
    return order if order[0] < order[-1] else order[::-1].copy()


def line_bends(order: NDArray[np.int64]) -> Springs:
    """Consecutive triples along a line, (N-2, 3)."""
    return np.stack((order[:-2], order[1:-1], order[2:]), axis=1).astype(np.int32)


def straight_bends(position: Array, springs: Springs) -> Springs:
    """Pairs of springs that continue each other through a particle, straightest first, each spring end once."""
    neighbours: list[list[int]] = [[] for _ in range(len(position))]
    for i, j in springs.tolist():
        neighbours[i].append(j)
        neighbours[j].append(i)
    bends = []
    for at, around in enumerate(neighbours):
        if len(around) < 2:
            continue
        d = position[around] - position[at]
        d = d / np.linalg.norm(d, axis=1, keepdims=True)
        cosine = d @ d.T
        used: set[int] = set()
        every = np.stack(np.triu_indices(len(around), 1), axis=1).tolist()
        for a, b in sorted(every, key=lambda ab: cosine[ab[0], ab[1]]):
            if cosine[a, b] > STRAIGHT:
                break
            if a not in used and b not in used:
                used |= {a, b}
                bends.append((around[a], at, around[b]))
    return np.array(bends, dtype=np.int32).reshape(-1, 3)


def bend_edges(body: Body) -> Array:
    """(B, 2) [m] a bend's two edges at rest: a spring's rest length, or the distance where there is no spring."""
    springs = np.sort(body.springs, axis=1).astype(np.int64)
    keys = springs[:, 0] * body.count + springs[:, 1]
    order = np.argsort(keys)
    pairs = np.stack((body.bends[:, :2], body.bends[:, 1:]), axis=1)  # (B, 2, 2)
    ends = np.sort(pairs, axis=2).astype(np.int64)
    distance = np.linalg.norm(body.rest_position[ends[..., 1]] - body.rest_position[ends[..., 0]], axis=2)
    if not len(keys):
        return np.asarray(distance)
    wanted = ends[..., 0] * body.count + ends[..., 1]
    place = order[np.searchsorted(keys, wanted, sorter=order).clip(max=len(keys) - 1)]
    return np.where(keys[place] == wanted, body.rest_length[place], distance)


def bend_lengths(body: Body) -> Array:
    """(B,) [m] half the sum of a bend's two edges at rest, the length lbar it stands for."""
    return np.asarray(0.5 * bend_edges(body).sum(axis=1))


def loose_particles(count: int, springs: Springs) -> list[int]:
    """Particles not connected to particle 0 by springs; an object with any falls apart."""
    if len(springs) == 0:
        return list(range(1, count))
    graph = coo_matrix((np.ones(len(springs)), (springs[:, 0], springs[:, 1])), shape=(count, count))
    reached = breadth_first_order(graph, 0, directed=False, return_predecessors=False)
    return sorted(set(range(count)) - set(reached.tolist()))


def _arc(position: Array, order: NDArray[np.int64], kind: str) -> Array:
    arc = np.zeros(len(position))
    if kind == "line":
        along = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(position[order], axis=0), axis=1))))
        arc[order] = along / max(along[-1], 1e-12)
        return arc
    distance = np.linalg.norm(position - position[0], axis=1)
    return distance / max(distance.max(), 1e-12)


def _mass_share(position: Array, order: NDArray[np.int64], kind: str) -> Array:
    """Fractions of the mass: half of each neighbouring edge for a line, equal otherwise."""
    share = np.full(len(position), 1.0 / len(position))
    if kind == "line":
        edge = np.linalg.norm(np.diff(position[order], axis=0), axis=1)
        half = np.concatenate((edge, [0.0])) + np.concatenate(([0.0], edge))
        share[order] = half / half.sum()
    return share


def _along_line(springs: Springs, order: NDArray[np.int64], edge: Array, measured: Array) -> Array:
    """Rest lengths from given edge lengths: springs along the line take them, skip springs their sums."""
    if len(edge) != len(order) - 1:
        raise InputError("rest lengths of a line", got=f"{len(edge)} values", allowed=f"{len(order) - 1}")
    place = np.empty(len(order), dtype=np.int64)
    place[order] = np.arange(len(order))
    along = np.concatenate(([0.0], np.cumsum(edge)))
    at = place[springs]
    near = np.abs(at[:, 0] - at[:, 1]) == 1
    return np.where(near, np.abs(along[at[:, 0]] - along[at[:, 1]]), measured)
