"""A centreline of even nodes through the points that several cameras see of a line object.

Gauss-Newton over nodes x_j: each point pulls its nearest segment across the line only (along the line nothing can be
seen), plus length, bending, the gripper's grasp and a motion prior. Points lie on the surface towards their camera, a
mean of pi/4 radius before the centreline.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from pred_core.config import setting
from pred_core.track.band import ChainSystem
from pred_core.types import Array

SURFACE = np.pi / 4  # mean over its width of how far a cylinder's surface stands out, in radii


@dataclass(frozen=True)
class LineFitConfig:
    """Weights of the fit, as standard deviations."""

    across: float = setting(0.004, unit="m", low=1e-4, high=0.1, doc="of one point; neighbours share their errors")
    depth_ratio: float = setting(2.0, low=1.0, high=20.0, doc="standard deviation along the ray over across it, at 1 m")
    stretch: float = setting(0.01, low=1e-4, high=1.0, doc="of a segment's length, relative")
    curvature: float = setting(15.0, unit="1/m", low=0.1, high=1000.0, doc="of a bend")
    gate: float = setting(0.012, unit="m", low=1e-3, high=0.2, doc="distance at which a point loses its pull")
    reach: float = setting(0.05, unit="m", low=1e-3, high=0.5, doc="the same in the first iteration")
    iterations: int = setting(6, low=1, high=100)


@dataclass(frozen=True)
class Cloud:
    """Points of all cameras at one instant."""

    points: Array  # (M, 3) [m] world, moved behind the surface onto the centreline
    rays: Array  # (M, 3) unit
    depth: Array  # (M,) [m]
    view: Array  # (M,) index of the camera
    age: Array  # (M,) [s] before the instant of the fit


@dataclass(frozen=True)
class Anchors:
    """What else is known of nodes: targets (N, 3) [m] with information (N, 3, 3) [1/m^2]."""

    target: Array
    information: Array


@dataclass(frozen=True)
class LineFit:
    """The outcome."""

    nodes: Array  # (N, 3) [m] world
    covariance: Array  # (N, 3, 3) [m^2]
    support: Array  # (N,) weight of the points at a node
    views: Array  # (V, N) the same per camera
    off: Array  # (V,) [m] median distance of the points of each camera; NaN where it has none
    residual: float  # [m] root mean square distance of accepted points
    explained: float  # share of the points that were accepted


def fit_line(
    nodes: Array,
    spacing: float,
    cloud: Cloud,
    radius: float,
    config: LineFitConfig,
    anchors: Anchors | None = None,
    velocity: Array | None = None,
    iterations: int | None = None,
) -> LineFit:
    """Fit nodes, starting from `nodes` (N, 3) [m]. `velocity` (N, 3) [m/s] moves older points to the fit's instant."""
    count = iterations or config.iterations
    gates = np.geomspace(max(config.reach, config.gate), config.gate, count)
    for gate in gates:
        matched = _match(nodes, cloud, radius, velocity)
        system = _assemble(nodes, spacing, radius, cloud, matched, float(gate), config, anchors)
        nodes = system.solve()
    matched = _match(nodes, cloud, radius, velocity)
    weight = _robust(matched.distance, config.gate)
    views = int(cloud.view.max()) + 1 if len(cloud.view) else 0
    near = (matched.segment + (matched.share > 0.5)).astype(int)
    support = np.zeros((views, len(nodes)))
    np.add.at(support, (cloud.view.astype(int), near), weight)
    total = float(weight.sum())
    return LineFit(
        nodes=nodes,
        covariance=system.covariance(),
        support=support.sum(axis=0),
        views=support,
        off=_view_medians(matched.distance, cloud),
        residual=float(np.sqrt((weight * matched.distance**2).sum() / total)) if total > 0 else float("nan"),
        explained=float((weight > 0.1).mean()) if len(weight) else 0.0,
    )


@dataclass(frozen=True)
class _Matched:
    points: Array  # (M, 3) at the fit's instant
    segment: Array  # (M,) int
    share: Array  # (M,) place along it, 0..1
    past: Array  # (M,) [m] how far beyond the rounding of the line's ends, signed; 0 elsewhere
    along: Array  # (M, 3) unit
    distance: Array  # (M,) [m]


def _match(nodes: Array, cloud: Cloud, radius: float, velocity: Array | None) -> _Matched:
    """The nearest segment of every point; the rounded end of the line, one radius long, counts as on the line."""
    points = cloud.points
    _, near = cKDTree(nodes).query(points)
    if velocity is not None and cloud.age.any():
        points = points + velocity[near] * cloud.age[:, None]
    edge = np.diff(nodes, axis=0)
    length = np.linalg.norm(edge, axis=-1)
    unit = edge / length[:, None]
    best, chosen = np.full(len(points), np.inf), np.zeros(len(points), int)
    where = np.zeros(len(points))
    for shift in (-1, 0):
        segment = np.clip(near + shift, 0, len(edge) - 1)
        free = np.einsum("ma,ma->m", points - nodes[segment], unit[segment])
        held = np.clip(free, 0.0, length[segment])
        away = points - nodes[segment] - held[:, None] * unit[segment]
        square = np.einsum("ma,ma->m", away, away)
        better = square < best
        best, chosen, where = (
            np.where(better, square, best),
            np.where(better, segment, chosen),
            np.where(better, free, where),
        )
    long = length[chosen]
    past = np.where((chosen == 0) & (where < -radius), where + radius, 0.0)
    past = np.where((chosen == len(edge) - 1) & (where > long + radius), where - long - radius, past)
    share = np.clip(where / long, 0.0, 1.0)
    across = points - nodes[chosen] - where[:, None] * unit[chosen]
    distance = np.sqrt(np.einsum("ma,ma->m", across, across) + past**2)
    return _Matched(points, chosen, share, past, unit[chosen], distance)


def without_view(cloud: Cloud, view: int) -> Cloud:
    """The cloud of the other cameras."""
    keep = cloud.view != view
    return Cloud(cloud.points[keep], cloud.rays[keep], cloud.depth[keep], cloud.view[keep], cloud.age[keep])


def view_distances(nodes: Array, cloud: Cloud, radius: float, velocity: Array | None) -> Array:
    """Median distance (V,) [m] of each camera's points from a line (N, 3); NaN for a camera without points."""
    return _view_medians(_match(nodes, cloud, radius, velocity).distance, cloud)


def _view_medians(distance: Array, cloud: Cloud) -> Array:
    count = int(cloud.view.max()) + 1 if len(cloud.view) else 0
    found = np.full(count, np.nan)
    for view in np.unique(cloud.view).astype(int):
        found[view] = np.median(distance[cloud.view == view])
    return found


def _robust(distance: Array, gate: float) -> Array:
    """Tukey's weight: 1 for a perfect point, 0 from twice the gate on."""
    return np.asarray(np.clip(1.0 - (distance / (2.0 * gate)) ** 2, 0.0, None) ** 2)


def _assemble(
    nodes: Array,
    spacing: float,
    radius: float,
    cloud: Cloud,
    matched: _Matched,
    gate: float,
    config: LineFitConfig,
    anchors: Anchors | None,
) -> ChainSystem:
    count = len(nodes)
    system = ChainSystem(count)
    _add_cloud(system, cloud, matched, _robust(matched.distance, gate), radius, config)
    system.add_spacing(nodes, spacing, 1.0 / (config.stretch * spacing) ** 2)
    system.add_bending(1.0 / (config.curvature * spacing**2) ** 2)
    if anchors is not None:
        system.add_points(anchors.information, anchors.target)
    return system


def _add_cloud(
    system: ChainSystem, cloud: Cloud, matched: _Matched, weight: Array, radius: float, config: LineFitConfig
) -> None:
    """Each point constrains its segment across the line, and along it only beyond an end."""
    if not len(weight):
        return
    count = len(system.diagonal)
    t, ray = matched.along, cloud.rays
    # Depth errors grow with the square of depth, errors across the ray with depth.
    across = 1.0 / (config.across * np.maximum(cloud.depth, 0.1)) ** 2
    loss = 1.0 - 1.0 / (config.depth_ratio * np.maximum(cloud.depth, 0.1)) ** 2
    eye = np.eye(3)
    information = eye - loss[:, None, None] * ray[:, :, None] * ray[:, None, :]
    plane = eye - t[:, :, None] * t[:, None, :]
    information = plane @ information @ plane
    out = matched.past != 0.0
    information[out] += t[out, :, None] * t[out, None, :]
    information *= (weight * across)[:, None, None]
    target = matched.points - (radius * np.sign(matched.past))[:, None] * t
    rhs = np.einsum("mab,mb->ma", information, target)
    s = matched.share
    features = np.concatenate(
        [
            ((1 - s) ** 2)[:, None] * information.reshape(-1, 9),
            (s * (1 - s))[:, None] * information.reshape(-1, 9),
            (s**2)[:, None] * information.reshape(-1, 9),
            (1 - s)[:, None] * rhs,
            s[:, None] * rhs,
        ],
        axis=1,
    )
    m = len(s)
    gather = csr_matrix((np.ones(m), (matched.segment, np.arange(m))), shape=(count - 1, m))
    sums = np.asarray(gather @ features)
    system.diagonal[:-1] += sums[:, :9].reshape(-1, 3, 3)
    system.next[:-1] += sums[:, 9:18].reshape(-1, 3, 3)
    system.diagonal[1:] += sums[:, 18:27].reshape(-1, 3, 3)
    system.right[:-1] += sums[:, 27:30]
    system.right[1:] += sums[:, 30:33]
