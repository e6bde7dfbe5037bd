"""Sheets and volumes: flow from picture to picture, first-seen patches, absolute lifting, a rigidity graph.

A particle's pixel is lifted with the depth measured there, never a velocity integrated, so errors do not add up.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from pred_core.config import setting
from pred_core.track.estimate import Estimate, Prior, Status, trace_confidence
from pred_core.track.flow import Gray, depth_at, follow_pixels, gray_of
from pred_core.track.grasp import Grasp, GraspConfig
from pred_core.track.point_follower import PointFollower
from pred_core.track.rigidity import RigidityGraph
from pred_core.track.template import Templates
from pred_core.track.view import View, pixel_rays, project
from pred_core.types import Array, CameraFrame, Tracks

Poses = tuple[Array, Array]
CELL = 0.01  # [m]
ANCHORED, FLOWED, HELD = 4.0, 1.0, 50.0  # weights of one measurement
NOBODY = np.zeros(0, dtype=np.int64)
FOLLOWED = 0.7  # share of what a camera sees that a learned model must follow there, else it begins anew


@dataclass(frozen=True)
class SurfaceConfig:
    """How a sheet or a volume is followed."""

    particles: int = setting(400, low=20, high=5000, doc="on the surface")
    stiffness: float = setting(2.0, low=1e-3, high=1e3, doc="of the rigidity graph against one measurement")
    agree: float = setting(0.02, unit="m", low=1e-3, high=0.2, doc="largest difference from what neighbours expect")
    occluder: float = setting(0.02, unit="m", low=1e-3, high=0.2, doc="depth before a particle that hides it")
    jump: float = setting(0.06, unit="m", low=1e-3, high=0.5, doc="largest error of the expected depth")
    least: int = setting(10, low=3, high=1000, doc="particles measured before it counts as lost")
    patience: float = setting(1.0, unit="s", low=0.0, high=20.0, doc="without enough measurements before it is lost")
    grasp: GraspConfig = GraspConfig()


@dataclass
class _Eye:
    """What is remembered of one camera."""

    gray: Gray
    frame: CameraFrame
    templates: Templates
    follower: PointFollower | None = None
    followed: NDArray[np.int64] = field(default_factory=lambda: NOBODY)  # particles, in the follower's order


class SurfaceTracker:
    """Holds the particles; ids count from 0 and stay. One that is lost and found again goes on with new ids."""

    def __init__(self, config: SurfaceConfig, follower: PointFollower | None = None):
        """`follower`: a learned model, asked for pixels before optical flow is."""
        self.config, self._follower = config, follower
        self.grasp = Grasp(config.grasp)
        self.stamp = 0
        self.position: Array | None = None  # (P, 3) [m] world
        self._first_id = 0  # a sheet found again has new material points, so it gets new ids
        self.velocity: Array = np.zeros((0, 3))
        self._eyes: dict[str, _Eye] = {}
        self._measured_at = 0

    def start(
        self,
        views: Sequence[View],
        frames: Mapping[str, CameraFrame],
        stamp: int,
        poses: Poses | None,
        closed: NDArray[np.bool_],
    ) -> bool:
        """Spread particles evenly over the points of all cameras."""
        points = np.concatenate([v.points for v in views])
        if len(points) < 4 * self.config.particles:
            return False
        self._first_id += 0 if self.position is None else len(self.position)
        position = spread(_largest_part(points), self.config.particles)
        self.position, self.stamp, self._measured_at = position, stamp, stamp
        self.velocity = np.zeros_like(position)
        self.graph = RigidityGraph(position)
        self._tangents = _tangent_pairs(position, self.graph)
        self.grasp.bind(position, poses, closed)
        self._eyes = {}
        self._remember(frames, position, np.ones(len(position), bool))
        return True

    def update(
        self, frames: Mapping[str, CameraFrame], stamp: int, poses: Poses | None, prior: Prior | None = None
    ) -> Estimate:
        """Follow to `stamp` [ns] with new pictures of some cameras."""
        assert self.position is not None  # `start` has succeeded; the caller's bug otherwise
        dt = max((stamp - self.stamp) * 1e-9, 0.0)
        expected = self.position + dt * self.velocity
        if prior is not None:
            row = prior.id.astype(np.int64) - self._first_id
            known = (row >= 0) & (row < len(expected))
            later = (stamp - prior.stamp) * 1e-9
            expected[row[known]] = prior.position[known] + later * prior.velocity[known]
        total, weight = np.zeros_like(expected), np.zeros(len(expected))
        for camera, frame in frames.items():
            measured, strength = self._measure(camera, frame, expected)
            total += strength[:, None] * np.where(strength[:, None] > 0, measured, 0.0)
            weight += strength
        visible = weight > 0
        held, place = self.grasp.targets(poses)
        total[held] += HELD * place
        weight[held] += HELD
        target = np.where(weight[:, None] > 0, total / np.maximum(weight, 1e-9)[:, None], expected)
        faint = np.maximum(weight, 0.02)  # unmeasured particles lean on their expected place a little
        fitted = self.graph.solve(expected, target, faint, self.config.stiffness)
        off = np.linalg.norm(target - fitted, axis=-1) > self.config.agree
        off[held] = False
        if off.any():  # measurements that neighbours contradict
            fitted = self.graph.solve(fitted, target, np.where(off, 0.02, faint), self.config.stiffness)
            visible &= ~off
        if dt > 0:
            self.velocity = 0.4 * self.velocity + 0.6 * (fitted - self.position) / dt
        self.position, self.stamp = fitted, stamp
        self._remember(frames, fitted, visible)
        if visible.sum() >= self.config.least:
            self._measured_at = stamp
        return self._estimate(weight, target, visible, tuple(frames))

    def _measure(self, camera: str, frame: CameraFrame, expected: Array) -> tuple[Array, Array]:
        """Where one camera sees the particles, (P, 3) [m], and weights (P,), 0 where it does not."""
        assert self.position is not None
        strength, points = np.zeros(len(expected)), np.zeros_like(expected)
        eye = self._eyes.get(camera)
        if eye is None or not np.array_equal(eye.frame.world_from_camera, frame.world_from_camera):
            return points, strength
        before = _turned(self.graph.rotations(self.position), eye.templates.offset)
        turn = self.graph.rotations(expected)
        after = _turned(turn, eye.templates.offset)
        old, old_depth = project(self.position + before, frame.intrinsics, frame.world_from_camera)
        guess, guessed_depth = project(expected + after, frame.intrinsics, frame.world_from_camera)
        usable = eye.templates.seen & _in_view(old, old_depth, eye.frame, self.config.occluder)
        usable &= np.isfinite(guess).all(axis=-1)
        gray = gray_of(frame.rgb)
        index, found = _followed(eye, frame, usable)
        rest = np.setdiff1d(np.flatnonzero(usable), index)
        flowed, good = follow_pixels(eye.gray, gray, old[rest], guess[rest])
        index, found = np.concatenate([index, rest[good]]), np.concatenate([found, flowed[good]])
        if not len(index):
            return points, strength
        tangents = self._projected_tangents(expected, turn, frame)
        found, correlation = eye.templates.match(gray, index, found, tangents[index])
        depth = depth_at(frame.depth, found)
        ray = pixel_rays(frame, found[:, 0], found[:, 1])
        lifted = ray * depth[:, None] + frame.world_from_camera[:3, 3]
        # Noise of stereo depth grows with its square; something much nearer or farther is another thing.
        near = np.abs(depth - guessed_depth[index]) < self.config.jump
        keep = np.isfinite(depth) & near
        index, lifted = index[keep], lifted[keep]
        points[index] = lifted - after[index]
        strength[index] = np.where(correlation[keep] > 0, ANCHORED, FLOWED) / np.maximum(depth[keep], 0.3) ** 2
        return points, strength

    def _remember(self, frames: Mapping[str, CameraFrame], position: Array, visible: NDArray[np.bool_]) -> None:
        """Keep each picture, and the patches of particles that are seen in it for the first time."""
        for camera, frame in frames.items():
            eye = self._eyes.get(camera)
            templates = eye.templates if eye else Templates.empty(len(position))
            gray = gray_of(frame.rgb)
            same = eye is not None and np.array_equal(eye.frame.world_from_camera, frame.world_from_camera)
            follower, followed = (eye.follower, eye.followed) if eye is not None and same else (None, NOBODY)
            fresh = visible & ~templates.seen
            if fresh.any():
                turn = self.graph.rotations(position)
                pixel, depth = project(position, frame.intrinsics, frame.world_from_camera)
                new = np.flatnonzero(fresh & _in_view(pixel, depth, frame, self.config.occluder, border=10))
                ray = pixel_rays(frame, pixel[:, 0], pixel[:, 1])
                seen = depth_at(frame.depth, np.where(np.isfinite(pixel), pixel, -1.0))
                offset = _turned(np.swapaxes(turn, 1, 2), ray * (seen - depth)[:, None])
                templates.keep(gray, new, pixel, self._projected_tangents(position, turn, frame), offset)
            self._eyes[camera] = _Eye(gray, frame, templates, follower, followed)
            if self._follower is not None:
                self._follow(self._eyes[camera], position, visible)

    def _follow(self, eye: _Eye, position: Array, visible: NDArray[np.bool_]) -> None:
        """See to it that a learned model follows what the camera sees: it begins anew where that is too little."""
        assert self._follower is not None
        offset = _turned(self.graph.rotations(position), eye.templates.offset)
        pixel, depth = project(position + offset, eye.frame.intrinsics, eye.frame.world_from_camera)
        seen = visible & eye.templates.seen & _in_view(pixel, depth, eye.frame, self.config.occluder)
        mine = np.flatnonzero(seen)
        if len(mine) and np.isin(mine, eye.followed).mean() < FOLLOWED:
            eye.follower = eye.follower or self._follower.another()
            eye.follower.start(eye.frame.rgb, pixel[mine])
            eye.followed = mine

    def _projected_tangents(self, position: Array, turn: Array, frame: CameraFrame) -> Array:
        """Two tangents (P, 2, 2) of the surface in the picture, as columns [px]."""
        pixel, _ = project(position, frame.intrinsics, frame.world_from_camera)
        first, second = self._tangents
        turned = np.einsum("pab,pbc->pac", turn, np.stack([first, second], -1))
        step = 0.005  # [m]
        columns = [
            (project(position + step * turned[:, :, k], frame.intrinsics, frame.world_from_camera)[0] - pixel) / step
            for k in range(2)
        ]
        found = np.stack(columns, axis=-1)
        return np.where(np.isfinite(found), found, 0.0)  # behind the camera: never matched

    def _estimate(self, weight: Array, target: Array, visible: NDArray[np.bool_], cameras: tuple[str, ...]) -> Estimate:
        assert self.position is not None
        late = (self.stamp - self._measured_at) * 1e-9
        status: Status = "lost" if late > self.config.patience else "tracking"
        # A measurement of weight 1 is 4 mm; without any, the graph's slack about it.
        sigma = np.where(visible, 0.004 / np.sqrt(np.maximum(weight, 0.25)), 0.02)
        covariance = sigma[:, None, None] ** 2 * np.eye(3)
        tracks = Tracks(
            np.int64(self.stamp),  # type: ignore[arg-type]
            self.position.copy(),
            self._first_id + np.arange(len(self.position), dtype=np.uint32),
            visible,
            trace_confidence(covariance, visible),
        )
        error = np.linalg.norm(target - self.position, axis=-1)[visible]
        residual = float(np.sqrt((error**2).mean())) if len(error) else float("nan")
        return Estimate(tracks, covariance, self.velocity.copy(), status, residual, cameras)


def _followed(eye: _Eye, frame: CameraFrame, usable: NDArray[np.bool_]) -> tuple[NDArray[np.int64], Array]:
    """(particles (M,), their pixels (M, 2)) that a learned model sees in this picture; none without one."""
    if eye.follower is None:
        return NOBODY, np.zeros((0, 2))
    pixel, seen = eye.follower.follow(frame.rgb)
    seen = seen & usable[eye.followed] & np.isfinite(pixel).all(axis=-1)
    return eye.followed[seen], pixel[seen]


def _turned(turn: Array, vectors: Array) -> Array:
    """Rotations (P, 3, 3) of vectors (P, 3)."""
    return np.asarray(np.einsum("pab,pb->pa", turn, vectors))


def _largest_part(points: Array) -> Array:
    """The points (M, 3) of the largest connected thing."""
    cells, owner = np.unique(np.floor(points / CELL).astype(np.int64), axis=0, return_inverse=True)
    pairs = cKDTree(cells).query_pairs(2.0, output_type="ndarray")
    graph = csr_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(cells),) * 2)
    label = connected_components(graph, directed=False)[1][owner.ravel()]
    return points[label == np.bincount(label).argmax()]


def spread(points: Array, count: int) -> Array:
    """(count, 3) of points (M, 3), far from each other (farthest-point sampling), each the mean of those around it."""
    step = max(1, len(points) // 20000)
    pool = points[::step]
    chosen = [int(np.argmin(np.linalg.norm(pool - np.median(pool, axis=0), axis=-1)))]
    away = np.linalg.norm(pool - pool[chosen[0]], axis=-1)
    for _ in range(count - 1):
        chosen.append(int(away.argmax()))
        away = np.minimum(away, np.linalg.norm(pool - pool[chosen[-1]], axis=-1))
    seeds = pool[chosen]
    tree = cKDTree(pool)
    around = tree.query(seeds, k=min(12, len(pool)))[1]
    return np.asarray(pool[around].mean(axis=1))


def _in_view(pixel: Array, depth: Array, frame: CameraFrame, occluder: float, border: int = 2) -> NDArray[np.bool_]:
    """(P,) inside the picture, with depth measured there that agrees."""
    height, width = frame.depth.shape
    inside: NDArray[np.bool_] = np.asarray(np.isfinite(pixel).all(axis=-1))
    safe = np.where(inside[:, None], pixel, -1.0)
    inside &= (safe >= border).all(axis=-1) & (safe[:, 0] < width - border) & (safe[:, 1] < height - border)
    seen = depth_at(frame.depth, safe)
    with np.errstate(invalid="ignore"):
        return np.asarray(inside & (np.abs(seen - depth) < occluder))


def _tangent_pairs(rest: Array, graph: RigidityGraph) -> tuple[Array, Array]:
    """Two unit vectors (P, 3) along the surface at rest: the main directions of each neighbourhood."""
    _, _, v = np.linalg.svd(graph.offset, full_matrices=False)
    return v[:, 0], v[:, 1]
