"""Where a line ends in the pictures: the colour says it to a pixel, also where the depth has holes.

Stereo depth fails along edges, and around the end of a thin line everything is an edge: points of one instant end up to
ten millimetres early, and a rough path through them may overshoot. Here the line is walked along in every picture, past
its end, until its colour stops; over some pictures the middle of what was found is the end.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from pred_core.track.color_model import ColorModel
from pred_core.track.view import View, project
from pred_core.types import Array, CameraFrame

INSIDE, OUTSIDE = 0.03, 0.05  # [m] of the walk before and past the end
PACE = 0.0005  # [m]
HOLE = 0.006  # [m] without the line's colour that is no end yet
STRAIGHT = 0.03  # [m] of the line whose direction it goes on with
DEEPER, NEARER = 0.03, 0.006  # [m] from the line's depth: behind it, before it
LEAST_SLANT = 0.2  # sine of the angle between ray and line; along the line its end cannot be seen
LEAST_CONTRAST = 30.0  # grey levels between the line and what is behind it
LEAST = 0.001  # [m] a smaller correction of an end is noise
MOST = 200  # walks of an end that are kept


class LineEnds:
    """How far the line goes on past each of its ends, in the middle of what several pictures say."""

    def __init__(self) -> None:
        self._past: tuple[list[float], list[float]] = ([], [])  # [m] past the end as it is now, of every walk

    def watch(self, nodes: Array, radius: float, views: Sequence[View], color: ColorModel | None) -> None:
        """Take in what new pictures say of the ends of nodes (N, 3) [m]."""
        for kept, line in zip(self._past, (nodes[::-1], nodes), strict=True):
            kept.extend(p for v in views if (p := past_end(line, radius, v, color)) is not None)
            del kept[:-MOST]

    def correction(self, held: tuple[bool, bool]) -> tuple[float, float]:
        """[m] that the line has to be longer at end 0 and at the other; 0 where it is `held` or nobody sees it."""
        first, last = (
            0.0 if hold or not kept else float(np.median(kept)) for kept, hold in zip(self._past, held, strict=True)
        )
        return first, last

    def moved(self, first: float, last: float) -> None:
        """The ends have been moved outwards by so much [m]."""
        for kept, by in zip(self._past, (first, last), strict=True):
            kept[:] = [p - by for p in kept]


def past_end(nodes: Array, radius: float, view: View, color: ColorModel | None) -> float | None:
    """[m] that the line goes on past the last of nodes (N, 3), less the rounding of its end; negative: it ends before.

    None if this camera cannot tell: something stands before it, the picture ends, another part of the line is there.
    """
    step = np.arange(-INSIDE, OUTSIDE, PACE)
    walk, along = _walk(nodes, step)
    ray = walk - view.picture.world_from_camera[:3, 3]
    away = np.linalg.norm(ray, axis=-1, keepdims=True)
    side = np.cross(ray / away, along)
    slant = np.linalg.norm(side, axis=-1, keepdims=True)
    if slant.min() < LEAST_SLANT:
        return None
    side *= 0.5 * radius / slant
    states = np.stack([_look(walk + k * side, view, color) for k in (-1.0, 0.0, 1.0)])
    on, blocked = (states == ON).any(axis=0), (states == BLOCKED).any(axis=0)
    if not on[step < -0.5 * INSIDE].any():
        return None
    hole = round(HOLE / PACE)
    seen = np.flatnonzero(on)
    gaps = np.flatnonzero(np.diff(seen) > hole)
    last = int(seen[gaps[0]] if len(gaps) else seen[-1])
    if last + hole >= len(step) or blocked[last : last + 2 * hole].any():
        return None
    if _meets_itself(nodes, walk[: last + hole], radius):
        return None
    pixel = float(away[last, 0] / (view.picture.intrinsics[0, 0] * slant[last, 0]))
    edge = _edge(walk, last, max(1, round(pixel / PACE)), view.picture)
    # A rounded end stands out by its radius across the ray: by more along the line, where the ray is slanted.
    return float(np.interp(edge, np.arange(len(step)), step)) - radius / float(slant[last, 0])


def _edge(walk: Array, last: int, pixel: int, frame: CameraFrame) -> float:
    """Where along the walk (K, 3), in steps, the line's colour gives way to what comes after `last`.

    `pixel`: steps of the walk in a pixel. A pixel on the edge shows a mixture; its share is how far the line goes.
    """
    begin, end = last - 2 * pixel, last + 2 * pixel
    if begin < pixel or end + pixel > len(walk):
        return last + 0.5
    at = project(walk[begin - pixel : end + pixel], frame.intrinsics, frame.world_from_camera)[0].T
    color = np.stack([map_coordinates(frame.rgb[..., k].astype(np.float32), at[::-1], order=1) for k in range(3)], -1)
    line, behind = np.median(color[: 2 * pixel], axis=0), np.median(color[-2 * pixel :], axis=0)
    contrast = line - behind
    if float(np.linalg.norm(contrast)) < LEAST_CONTRAST:
        return last + 0.5
    share = np.clip((color - behind) @ contrast / float(contrast @ contrast), 0.0, 1.0)
    return begin - 0.5 + float(share[pixel:-pixel].sum())


ON, OFF, BLOCKED = 1, 0, -1


def _look(points: Array, view: View, color: ColorModel | None) -> NDArray[np.int64]:
    """(K,) of points (K, 3) [m] world: ON the line in the picture, OFF, or BLOCKED by something before it."""
    frame = view.picture
    pixel, depth = project(points, frame.intrinsics, frame.world_from_camera)
    height, width = frame.depth.shape
    at = np.round(np.where(np.isfinite(pixel), pixel, -1.0)).astype(int)
    inside = (at >= 0).all(axis=-1) & (at[:, 0] < width) & (at[:, 1] < height)
    u, v = np.where(inside[:, None], at, 0).T
    seen = frame.depth[v, u]
    if color is None:
        mine = np.isin(v * width + u, view.pixel)
    else:
        mine = color.matches(frame.rgb[v, u]) & ~(seen > depth + DEEPER)  # NaN is no evidence
    near = seen < depth - NEARER
    state = np.where(mine & ~(seen < depth - DEEPER), ON, np.where(near, BLOCKED, OFF))
    return np.where(inside, state, BLOCKED)


def _walk(nodes: Array, step: Array) -> tuple[Array, Array]:
    """Points (K, 3) [m] at arc lengths `step` (K,) past the last node, straight on beyond it, and directions (K, 3)."""
    back = nodes[::-1]
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(back, axis=0), axis=-1))])
    behind = np.stack([np.interp(STRAIGHT, arc, back[:, k]) for k in range(3)])
    ahead = (nodes[-1] - behind) / np.linalg.norm(nodes[-1] - behind)
    inner = np.stack([np.interp(-step, arc, back[:, k]) for k in range(3)], axis=-1)
    return np.where((step > 0.0)[:, None], nodes[-1] + step[:, None] * ahead, inner), np.tile(ahead, (len(step), 1))


def _meets_itself(nodes: Array, walk: Array, radius: float) -> bool:
    """Whether another part of the line lies where the walk (K, 3) goes past the end."""
    arc = np.cumsum(np.linalg.norm(np.diff(nodes[::-1], axis=0), axis=-1))[::-1]
    other = nodes[:-1][arc > INSIDE + OUTSIDE]
    if not len(other):
        return False
    return bool(np.linalg.norm(walk[:, None] - other[None], axis=-1).min() < 4.0 * radius)


def extended(nodes: Array, first: float, last: float) -> Array:
    """A polyline (K, 3) whose ends lie farther out by `first` and `last` [m], along its direction; less: cut off."""
    for by in (last, first):
        if by < 0.0:
            arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(nodes, axis=0), axis=-1))])
            end = np.array([np.interp(arc[-1] + by, arc, nodes[:, k]) for k in range(3)])
            nodes = np.concatenate([nodes[arc < arc[-1] + by], end[None]])
        elif by > 0.0:
            nodes = np.concatenate([nodes, _walk(nodes, np.array([by]))[0]])
        nodes = nodes[::-1]
    return nodes
