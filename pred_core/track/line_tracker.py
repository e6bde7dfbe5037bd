"""A line object followed through time: start, predict, fit, notice when lost, start again."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pred_core.track.color_model import ColorModel
from pred_core.track.estimate import Estimate, Prior, Status, odd_one, trace_confidence
from pred_core.track.grasp import Grasp
from pred_core.track.line_cloud import cloud_of, contradicted, find_in, near, newest
from pred_core.track.line_config import LineConfig
from pred_core.track.line_ends import LEAST_CORRECTION, LineEnds, extended
from pred_core.track.line_fit import Anchors, Cloud, LineFit, fit_line, view_distances, without_view
from pred_core.track.line_grips import Poses, closed_grips, ends_in_tools, from_first_end
from pred_core.track.line_start import FoundLine, resample, settle
from pred_core.track.line_width import radius_of
from pred_core.track.view import View
from pred_core.types import Array, Tracks

GROWN = 0.03  # of the length: less is noise
STILL = 0.005  # [m] standard deviation of the motion prior of a particle in view, beside its acceleration
PATIENT = 1.0  # [s] for the held side of a line to be seen, before it is begun without
UNSEEN = 0.1  # [m] the same of one that has not been in view for long, at most
TRUST_SEEN, TRUST_UNSEEN = 0.7, 0.3  # share of the newest velocity of a particle that is in view, or is not
BETTER = 0.02  # of the score: a fit from scratch that explains less than this more is no better


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
        self._hidden_since: int | None = None  # [ns] when a line was first found away from every closed gripper
        self._ends = LineEnds()
        self._closed: NDArray[np.bool_] = np.zeros(0, bool)

    @property
    def spacing(self) -> float:
        """Arc length between nodes [m]."""
        return self.length / (self.config.particles - 1)

    def start(self, views: Sequence[View], stamp: int, poses: Poses | None, closed: NDArray[np.bool_]) -> list[View]:
        """Look for the line. Returns the part of each view that is on it; nothing if it is not found."""
        found = find_in(views, self.config.start)
        if found is None or (self.nodes is None and self._is_half_seen(found.path, stamp, poses, closed)):
            return []
        return self._begin(found, views, stamp, poses, closed, self.length > 0.0)

    def _is_half_seen(self, path: Array, stamp: int, poses: Poses | None, closed: NDArray[np.bool_]) -> bool:
        """No closed gripper is at what was found: the held side is hidden, and the nearer end may be the free one.

        It is waited for, but not longer than PATIENT.
        """
        grips = closed_grips(poses, closed)
        if not len(grips) or np.linalg.norm(path[:, None] - grips[None], axis=-1).min() <= self.config.bridge:
            return False
        self._hidden_since = stamp if self._hidden_since is None else self._hidden_since
        return (stamp - self._hidden_since) * 1e-9 < PATIENT

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
        ends = ends_in_tools(nodes, closed_grips(poses, closed), self.config)
        nodes, length = settle(nodes, cloud, radius, self.config.fit, self.length if known else None, ends)
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
        cloud = self._cloud([near(v, expected, self.config.fit.reach) for v in views], stamp, self.radius)
        anchors = Anchors(expected, information)
        fit = fit_line(expected, self.spacing, cloud, self.radius, self.config.fit, anchors, self.velocity)
        odd = odd_one(fit.off)
        if odd is not None:  # a camera that has been moved pulls at the line: the others decide
            rest = without_view(cloud, odd)
            fit = fit_line(expected, self.spacing, rest, self.radius, self.config.fit, anchors, self.velocity)
            off = view_distances(fit.nodes, cloud, self.radius, self.velocity)
            fit = dataclasses.replace(fit, off=off)
            views = [v for k, v in enumerate(views) if k != odd]
        score = fit.explained - contradicted(views, fit)
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
        found = find_in(views, self.config.start)
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
        self._ends.watch(fit.nodes, self.radius, newest(views), color)
        tools = ends_in_tools(fit.nodes, closed_grips(poses, self._closed), self.config)
        first, last = self._ends.correction((bool(tools.information[0].any()), bool(tools.information[-1].any())))
        if max(abs(first), abs(last)) < LEAST_CORRECTION:
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
        return anew if anew.explained - contradicted(views, anew) > score + BETTER else fit

    def _anew(self, views: Sequence[View], poses: Poses | None) -> Array | None:
        """Nodes (N, 3) from scratch; None if nothing of this length is found."""
        found = find_in(views, self.config.start)
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
            blend = np.where(visible, TRUST_SEEN, TRUST_UNSEEN)[:, None]
            self.velocity = (1.0 - blend) * self.velocity + blend * measured
        grown = np.minimum(sigma**2, UNSEEN**2)
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
        return cloud_of(views, stamp, radius, self.config.points)

    def _oriented(self, path: Array, poses: Poses | None, closed: NDArray[np.bool_]) -> Array:
        """End 0 is where it was before; at first the grippers say it."""
        if self.nodes is None:
            return from_first_end(path, closed_grips(poses, closed), self.config)
        there = resample(path, len(self.nodes))
        away, swapped = (float(np.abs(p - self.nodes).sum()) for p in (there, there[::-1]))
        return path if away <= swapped else path[::-1]
