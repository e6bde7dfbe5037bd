"""A line object followed through time: start, predict, fit, notice when lost, start again."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pred_core.config import setting
from pred_core.track.color_model import ColorModel
from pred_core.track.estimate import Estimate, Prior, Status, odd_one, trace_confidence
from pred_core.track.grasp import Grasp, GraspConfig
from pred_core.track.line_ends import LEAST, LineEnds, extended
from pred_core.track.line_fit import (
    SURFACE,
    Anchors,
    Cloud,
    LineFit,
    LineFitConfig,
    fit_line,
    view_distances,
    without_view,
)
from pred_core.track.line_start import FoundLine, LineStartConfig, find_line, resample
from pred_core.track.line_width import radius_of
from pred_core.track.view import View
from pred_core.types import Array, Tracks

Poses = tuple[Array, Array]
OBSTACLE = 0.015  # [m] before a node, beyond errors of depth and of the fit
SAME_TIME = 10_000_000  # [ns]
GROWN = 0.03  # of the length: less is noise
STILL = 0.005  # [m] standard deviation of the motion prior of a particle in view, beside its acceleration


@dataclass(frozen=True)
class LineConfig:
    """What is known of the line, and how it is followed."""

    length: float = setting(0.0, unit="m", low=0.0, high=20.0, doc="0: measured when it is found")
    radius: float = setting(0.0, unit="m", low=0.0, high=0.1, doc="0: measured when it is found")
    particles: int = setting(61, low=4, high=400, doc="nodes, evenly along the line; ids count from end 0")
    points: int = setting(600, low=50, high=20000, doc="most points used of one camera")
    acceleration: float = setting(10.0, unit="m/s^2", low=0.1, high=1000.0, doc="that the motion prior allows for")
    bridge: float = setting(0.08, unit="m", low=0.0, high=0.5, doc="longest end hidden in a gripper's jaws")
    end_in_tool: bool = setting(True, doc="a held end is in the tool centre; false: where it is seen")
    seen: float = setting(1.5, low=0.1, high=100.0, doc="points of one camera at a particle that make it visible")
    doubt: float = setting(0.96, low=0.0, high=1.0, doc="points explained less nodes contradicted; below, look anew")
    lost: float = setting(0.5, low=0.0, high=1.0, doc="share of the points on the line below which it is lost")
    patience: float = setting(0.4, unit="s", low=0.0, high=10.0, doc="how long before it is searched anew")
    tolerance: float = setting(0.15, low=0.01, high=1.0, doc="relative difference of length when it is found again")
    growing: float = setting(1.0, unit="s", low=0.0, high=60.0, doc="for how long a measured length may still grow")
    fit: LineFitConfig = LineFitConfig()
    start: LineStartConfig = LineStartConfig()
    grasp: GraspConfig = GraspConfig()


class LineTracker:
    """Holds the line's nodes. Ids and arc length stay with the nodes, also when it is lost and found."""

    def __init__(self, config: LineConfig):
        self.config = config
        self.length, self.radius = config.length, config.radius
        self.grasp = Grasp(config.grasp)
        self.stamp = 0  # [ns] of the nodes
        self.nodes: Array | None = None  # (N, 3) [m] world
        self.velocity: Array = np.zeros((config.particles, 3))
        self._variance: Array = np.zeros(config.particles)  # (N,) [m^2] of the prediction
        self._bad_since: int | None = None
        self._pulled = False  # a gripper that it has slipped out of has pulled the nodes along
        self._found_at: int | None = None  # [ns] when its length was measured
        self._ends = LineEnds()
        self._closed: NDArray[np.bool_] = np.zeros(0, bool)

    @property
    def spacing(self) -> float:
        """Arc length between nodes [m]."""
        return self.length / (self.config.particles - 1)

    def start(self, views: Sequence[View], stamp: int, poses: Poses | None, closed: NDArray[np.bool_]) -> list[View]:
        """Look for the line. Returns the part of each view that is on it; nothing if it is not found."""
        found = _find(views, self.config.start)
        return [] if found is None else self._begin(found, views, stamp, poses, closed, self.length > 0.0)

    def _begin(
        self,
        found: FoundLine,
        views: Sequence[View],
        stamp: int,
        poses: Poses | None,
        closed: NDArray[np.bool_],
        known: bool,
    ) -> list[View]:
        """Nodes along what was found, of the `known` length or of the one they then have."""
        path = self._oriented(found.path, poses, closed)
        cuts = np.cumsum([len(v.pixel) for v in views])[:-1]
        members = [v.select(m) for v, m in zip(views, np.split(found.member, cuts), strict=True)]
        nodes = resample(path, self.config.particles)
        radius = self.config.radius or radius_of(members, nodes)
        cloud = self._cloud(members, stamp, radius)
        ends = self._ends_in_tools(nodes, poses, closed)
        nodes, length = _settle(nodes, cloud, radius, self.config, self.length if known else None, ends)
        if known and abs(length - self.length) > self.config.tolerance * self.length:
            return []
        if not known:
            self.length = length
            self._found_at = stamp if self._found_at is None else self._found_at
        self.radius, self.nodes, self.stamp = radius, nodes, stamp
        self.velocity = np.zeros_like(nodes)
        self._variance = np.full(len(nodes), STILL**2)
        self._bad_since, self._closed, self._ends = None, closed, LineEnds()
        self.grasp.bind(nodes, poses, closed)
        return members

    def update(
        self,
        views: Sequence[View],
        stamp: int,
        poses: Poses | None,
        prior: Prior | None = None,
        color: ColorModel | None = None,
    ) -> Estimate:
        """Follow the line to `stamp` [ns]. `prior` is used instead of constant velocity; `color` is the line's."""
        assert self.nodes is not None  # `start` has succeeded; the caller's bug otherwise
        cameras = tuple(v.camera for v in views)
        self._grow(views, stamp, poses)
        dt = max((stamp - self.stamp) * 1e-9, 0.0)
        expected, sigma = self._predict(dt, stamp, poses, prior)
        information = np.eye(3) / (sigma**2)[:, None, None]
        held, place = self.grasp.targets(poses)
        if self.grasp.watch(place, np.concatenate([v.points for v in views]), stamp):
            self.grasp.release()
            held, place = self.grasp.targets(poses)
            self._pulled = True
        if self._pulled and (anew := self._anew(views, poses)) is not None:
            expected, self.nodes, self.velocity, self._pulled = anew.copy(), anew, np.zeros_like(anew), False
            information = np.tile(np.eye(3) / self.config.fit.reach**2, (len(anew), 1, 1))
        information[held] = np.eye(3) / self.config.grasp.sigma**2
        expected[held] = place
        cloud = self._cloud([_near(v, expected, self.config.fit.reach) for v in views], stamp, self.radius)
        anchors = Anchors(expected, information)
        fit = fit_line(expected, self.spacing, cloud, self.radius, self.config.fit, anchors, self.velocity)
        odd = odd_one(fit.off)
        if odd is not None:  # a camera that has been moved pulls at the line: the others decide
            rest = without_view(cloud, odd)
            fit = fit_line(expected, self.spacing, rest, self.radius, self.config.fit, anchors, self.velocity)
            off = view_distances(fit.nodes, cloud, self.radius, self.velocity)
            fit = dataclasses.replace(fit, off=off)
            views = [v for k, v in enumerate(views) if k != odd]
        score = fit.explained - _contradicted(views, fit)
        if score < self.config.doubt:
            fit = self._second_opinion(fit, score, views, stamp, poses)
        fit = self._trim(fit, views, stamp, poses, color)
        visible = fit.views.max(axis=0, initial=0.0) >= self.config.seen
        self._advance(fit, dt, visible, sigma)
        self.stamp = stamp
        return self._estimate(fit, visible, self._judge(fit, views, stamp), cameras)

    def _grow(self, views: Sequence[View], stamp: int, poses: Poses | None) -> None:
        """The first pictures may have missed an end: start again where a later one shows more of the line."""
        if not self._growing(stamp):
            return
        found = _find(views, self.config.start)
        if found is None or found.length < (1.0 + GROWN) * self.length or not self._is_on(found.path):
            return
        self._begin(found, views, stamp, poses, self._closed, known=False)

    def _growing(self, stamp: int) -> bool:
        return self._found_at is not None and (stamp - self._found_at) * 1e-9 <= self.config.growing

    def _trim(
        self, fit: LineFit, views: Sequence[View], stamp: int, poses: Poses | None, color: ColorModel | None
    ) -> LineFit:
        """Where a measured length may still change: move free ends to where the pictures say that they are."""
        if not self._growing(stamp):
            return fit
        newest = max((v.stamp for v in views), default=0)
        self._ends.watch(fit.nodes, self.radius, [v for v in views if newest - v.stamp < SAME_TIME], color)
        tools = self._ends_in_tools(fit.nodes, poses, self._closed)
        first, last = self._ends.correction((bool(tools.information[0].any()), bool(tools.information[-1].any())))
        if max(abs(first), abs(last)) < LEAST:
            return fit
        nodes = resample(extended(fit.nodes, first, last), len(fit.nodes))
        for end in (0, -1):
            nodes[end] = tools.target[end] if tools.information[end].any() else nodes[end]
        self._ends.moved(first, last)
        self.length = float(np.linalg.norm(np.diff(nodes, axis=0), axis=-1).sum())
        self.grasp.bind(nodes, poses, self._closed)
        return dataclasses.replace(fit, nodes=nodes)

    def _is_on(self, path: Array) -> bool:
        """Whether the nodes lie on a path (K, 3)."""
        assert self.nodes is not None
        dense = resample(path, 4 * len(path))
        away = np.linalg.norm(self.nodes[:, None] - dense[None], axis=-1).min(axis=1)
        return bool(np.median(away) < self.config.fit.reach)

    def _ends_in_tools(self, nodes: Array, poses: Poses | None, closed: NDArray[np.bool_]) -> Anchors:
        """A held end is in the tool centre, which the jaws hide."""
        target, information = nodes.copy(), np.zeros((len(nodes), 3, 3))
        grips = np.zeros((0, 3)) if poses is None else poses[0][: len(closed)][closed[: len(poses[0])]]
        for gripper in grips if self.config.end_in_tool else ():
            end = min((0, -1), key=lambda e: float(np.linalg.norm(nodes[e] - gripper)))  # noqa: B023 (used at once)
            if np.linalg.norm(nodes[end] - gripper) < self.config.grasp.radius:
                target[end], information[end] = gripper, np.eye(3) / self.config.grasp.sigma**2
        return Anchors(target, information)

    def _second_opinion(
        self, fit: LineFit, score: float, views: Sequence[View], stamp: int, poses: Poses | None
    ) -> LineFit:
        """A fit from scratch, if it explains the pictures better than the one that followed the motion."""
        nodes = self._anew(views, poses)
        if nodes is None:
            return fit
        held, place = self.grasp.targets(poses)
        information, target = np.zeros((len(nodes), 3, 3)), nodes.copy()
        information[held], target[held] = np.eye(3) / self.config.grasp.sigma**2, place
        cloud = self._cloud(views, stamp, self.radius)
        anew = fit_line(nodes, self.spacing, cloud, self.radius, self.config.fit, Anchors(target, information))
        return anew if anew.explained - _contradicted(views, anew) > score + 0.02 else fit

    def _anew(self, views: Sequence[View], poses: Poses | None) -> Array | None:
        """Nodes (N, 3) from scratch; None if nothing of this length is found."""
        found = _find(views, self.config.start)
        if found is None or abs(found.length - self.length) > self.config.tolerance * self.length:
            return None
        return resample(self._oriented(found.path, poses, self._closed), self.config.particles)

    def _predict(self, dt: float, stamp: int, poses: Poses | None, prior: Prior | None) -> tuple[Array, Array]:
        """Expected nodes (N, 3) [m] and their standard deviation (N,) [m]."""
        assert self.nodes is not None
        expected = self.nodes + self.velocity * dt
        sigma = np.sqrt(self._variance + (0.5 * self.config.acceleration * dt**2) ** 2)
        if prior is not None:
            later = (stamp - prior.stamp) * 1e-9
            known = prior.id < len(expected)
            index = prior.id[known].astype(int)
            expected[index] = prior.position[known] + later * prior.velocity[known]
            sigma[index] = prior.sigma
        return expected, sigma

    def _advance(self, fit: LineFit, dt: float, visible: NDArray[np.bool_], sigma: Array) -> None:
        """Velocity and variance of the next prediction."""
        assert self.nodes is not None
        if dt > 0:
            measured = (fit.nodes - self.nodes) / dt
            blend = np.where(visible, 0.7, 0.3)[:, None]
            self.velocity = (1.0 - blend) * self.velocity + blend * measured
        grown = np.minimum(sigma**2, 0.1**2)
        self._variance = np.where(visible, STILL**2, grown)
        self.nodes = fit.nodes

    def _judge(self, fit: LineFit, views: Sequence[View], stamp: int) -> Status:
        """Lost is what explains too few of the candidates near and far for too long."""
        total = sum(len(v.pixel) for v in views)
        bad = total > 0 and fit.explained < self.config.lost
        if not bad:
            self._bad_since = None
            return "tracking"
        self._bad_since = stamp if self._bad_since is None else self._bad_since
        return "lost" if (stamp - self._bad_since) * 1e-9 >= self.config.patience else "tracking"

    def _estimate(self, fit: LineFit, visible: NDArray[np.bool_], status: Status, cameras: tuple[str, ...]) -> Estimate:
        count = self.config.particles
        confidence = trace_confidence(fit.covariance, visible)
        tracks = Tracks(np.int64(self.stamp), fit.nodes.copy(), np.arange(count, dtype=np.uint32), visible, confidence)  # type: ignore[arg-type]
        off = tuple(fit.off.tolist())
        return Estimate(
            tracks, fit.covariance, self.velocity.copy(), status, fit.residual, cameras, off, self.grasp.slipped
        )

    def _cloud(self, views: Sequence[View], stamp: int, radius: float) -> Cloud:
        """At most `points` of each view, moved from the surface onto the centreline."""
        picked = [v.select(np.arange(0, len(v.pixel), max(1, -(-len(v.pixel) // self.config.points)))) for v in views]
        rays = np.concatenate([v.rays for v in picked])
        return Cloud(
            np.concatenate([v.points for v in picked]) + SURFACE * radius * rays,
            rays,
            np.concatenate([v.depth for v in picked]),
            np.concatenate([np.full(len(v.pixel), i) for i, v in enumerate(picked)]),
            np.concatenate([np.full(len(v.pixel), (stamp - v.stamp) * 1e-9) for v in picked]),
        )

    def _oriented(self, path: Array, poses: Poses | None, closed: NDArray[np.bool_]) -> Array:
        """End 0 is where it was before; at first the end nearest to a closed gripper, else the one of smaller x."""
        if self.nodes is not None:
            there = resample(path, len(self.nodes))
            away, swapped = (float(np.abs(p - self.nodes).sum()) for p in (there, there[::-1]))
            return path if away <= swapped else path[::-1]
        grips = np.zeros((0, 3)) if poses is None else poses[0][: len(closed)][closed[: len(poses[0])]]
        if not len(grips):
            return path if path[0, 0] <= path[-1, 0] else path[::-1]
        ends = np.linalg.norm(path[[0, -1]][:, None] - grips[None], axis=-1)  # (2, G)
        path = path if ends[0].min() <= ends[1].min() else path[::-1]
        for gripper in grips[:2]:  # the jaws hide the end of what they hold
            for end in (0, -1):
                gap = float(np.linalg.norm(path[end] - gripper))
                if self.config.start.voxel < gap < self.config.bridge:
                    path = np.concatenate([gripper[None], path] if end == 0 else [path, gripper[None]])
        return path


def _find(views: Sequence[View], config: LineStartConfig) -> FoundLine | None:
    return find_line(np.concatenate([v.points for v in views]), np.concatenate([v.color for v in views]), config)


def _contradicted(views: Sequence[View], fit: LineFit) -> float:
    """Share of the nodes where no camera sees the line although nothing stands before it."""
    found = np.zeros(len(fit.nodes), bool)
    newest = max((v.stamp for v in views), default=0)
    for view in views:
        if newest - view.stamp < SAME_TIME:  # an older picture may have been true
            found |= view.unobstructed(fit.nodes, OBSTACLE)
    return float((found & (fit.support == 0)).mean())


def _near(view: View, nodes: Array, reach: float) -> View:
    """The points within the box around the nodes, `reach` [m] wider."""
    low, high = nodes.min(axis=0) - reach, nodes.max(axis=0) + reach
    keep = ((view.points >= low) & (view.points <= high)).all(axis=-1)
    return view if keep.all() else view.select(keep)


def _settle(
    nodes: Array, cloud: Cloud, radius: float, config: LineConfig, length: float | None, ends: Anchors
) -> tuple[Array, float]:
    """Fit from a rough path; without a given length the line takes the one its points have."""
    total = length
    for _ in range(8):
        edge = np.linalg.norm(np.diff(nodes, axis=0), axis=-1)
        spacing = (float(edge.sum()) if total is None else total) / (len(nodes) - 1)
        fit = fit_line(nodes, spacing, cloud, radius, config.fit, ends, iterations=3)
        nodes = fit.nodes if total is not None else resample(fit.nodes, len(nodes))
    return nodes, float(np.linalg.norm(np.diff(nodes, axis=0), axis=-1).sum())
