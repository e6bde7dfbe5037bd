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

# The walk: from before the end as it is now to past it, three samples side by side at every step.
WALK_BEFORE, WALK_PAST = 0.03, 0.05  # [m] more than a rough path overshoots, and than depth cuts off
WALK_STEP = 0.0005  # [m] a small part of a pixel, which is some millimetres at 1 m
DIRECTION_OVER = 0.03  # [m] of the line whose direction it goes on with: noise of its nodes turns shorter pieces
BESIDE = 0.5  # radii to either side of the middle: a fit that is off by less still has a sample on the line
START_SHARE = 0.5  # of WALK_BEFORE; a walk that is not on the line in this first part is beside it and tells nothing
LONGEST_HOLE = 0.006  # [m] without the line's colour that is no end yet: a highlight, a knot, a print
CLEAR_HOLES = 2  # holes past the end that nothing may stand before: else that, not the end, may stop the colour
OTHER_PART = 4.0  # radii: another part of the line nearer to the walk than two of its widths would be taken for its end

# What a picture shows of a point: stereo depth of a thin thing is off by millimetres, or that of what is behind it.
MUCH_OFF = 0.03  # [m] depth behind the line, or before it, from which on a pixel of its colour is something else
BEFORE = 0.006  # [m] nearer than the line by this: something stands before it
LEAST_SLANT = 0.2  # sine of the angle between ray and line; along the line its end cannot be seen

# The edge between two pixels: pure colours outermost, the mixed pixel in between.
EDGE_PIXELS = 2  # to either side of the last step on the line, within which the mixed pixel lies
MARGIN_PIXELS = 1  # more to either side
PURE_PIXELS = 2  # outermost ones whose middle is the colour of the line, or of what is behind it
LEAST_CONTRAST = 30.0  # grey levels between the two; noise of a few levels would decide what share of a pixel is line
HALF_STEP = 0.5  # an edge lies midway between two steps

LEAST_CORRECTION = 0.001  # [m] a smaller correction of an end is noise
MOST_KEPT = 200  # walks of an end: eight cameras at 25 Hz in the second in which a length may grow

ON_LINE, OFF_LINE, BLOCKED = 1, 0, -1  # what a picture shows at a point of the walk


class LineEnds:
    """How far the line goes on past each of its ends, in the middle of what several pictures say."""

    def __init__(self) -> None:
        self._past: tuple[list[float], list[float]] = ([], [])  # [m] past the end as it is now, of every walk

    def watch(self, nodes: Array, radius: float, views: Sequence[View], color: ColorModel | None) -> None:
        """Take in what new pictures say of the ends of nodes (N, 3) [m]."""
        for kept, line in zip(self._past, (nodes[::-1], nodes), strict=True):
            kept.extend(p for v in views if (p := past_end(line, radius, v, color)) is not None)
            del kept[:-MOST_KEPT]

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
    arc = np.arange(-WALK_BEFORE, WALK_PAST, WALK_STEP)  # (K,) [m] past the last node
    walk, ahead = _walk(nodes, arc)
    ray = walk - view.picture.world_from_camera[:3, 3]
    distance = np.linalg.norm(ray, axis=-1, keepdims=True)
    sideways = np.cross(ray / distance, ahead)
    slant = np.linalg.norm(sideways, axis=-1, keepdims=True)
    if slant.min() < LEAST_SLANT:
        return None
    sideways *= BESIDE * radius / slant
    shown = np.stack([_shown(walk + side * sideways, view, color) for side in (-1.0, 0.0, 1.0)])
    on_line, blocked = (shown == ON_LINE).any(axis=0), (shown == BLOCKED).any(axis=0)
    if not on_line[arc < -START_SHARE * WALK_BEFORE].any():
        return None
    hole = round(LONGEST_HOLE / WALK_STEP)
    last = _last_on(on_line, hole)
    if last + hole >= len(arc) or blocked[last : last + CLEAR_HOLES * hole].any():
        return None
    if _meets_itself(nodes, walk[: last + hole], radius):
        return None
    pixel = float(distance[last, 0] / (view.picture.intrinsics[0, 0] * slant[last, 0]))  # [m] of the line in a pixel
    edge = _edge(walk, last, max(1, round(pixel / WALK_STEP)), view.picture)
    # A rounded end stands out by its radius across the ray: by more along the line, where the ray is slanted.
    return float(np.interp(edge, np.arange(len(arc)), arc)) - radius / float(slant[last, 0])


def _last_on(on_line: NDArray[np.bool_], hole: int) -> int:
    """The last step on the line before more than `hole` steps without it."""
    on = np.flatnonzero(on_line)
    gaps = np.flatnonzero(np.diff(on) > hole)
    return int(on[gaps[0]] if len(gaps) else on[-1])


def _edge(walk: Array, last: int, pixel: int, frame: CameraFrame) -> float:
    """Where along the walk (K, 3), in steps, the line's colour gives way to what comes after step `last`.

    `pixel`: steps of the walk in a pixel. A pixel on the edge shows a mixture; its share is how far the line goes.
    """
    begin, end = last - EDGE_PIXELS * pixel, last + EDGE_PIXELS * pixel
    margin, pure = MARGIN_PIXELS * pixel, PURE_PIXELS * pixel
    if begin < margin or end + margin > len(walk):
        return last + HALF_STEP
    at = project(walk[begin - margin : end + margin], frame.intrinsics, frame.world_from_camera)[0].T
    color = np.stack([map_coordinates(frame.rgb[..., k].astype(np.float32), at[::-1], order=1) for k in range(3)], -1)
    line, behind = np.median(color[:pure], axis=0), np.median(color[-pure:], axis=0)
    contrast = line - behind
    if float(np.linalg.norm(contrast)) < LEAST_CONTRAST:
        return last + HALF_STEP
    share = np.clip((color - behind) @ contrast / float(contrast @ contrast), 0.0, 1.0)
    return begin - HALF_STEP + float(share[margin:-margin].sum())


def _shown(points: Array, view: View, color: ColorModel | None) -> NDArray[np.int64]:
    """(K,) of points (K, 3) [m] world: ON_LINE in the picture, OFF_LINE, or BLOCKED by something before it."""
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
        mine = color.matches(frame.rgb[v, u]) & ~(seen > depth + MUCH_OFF)  # NaN is no evidence
    otherwise = np.where(seen < depth - BEFORE, BLOCKED, OFF_LINE)
    state = np.where(mine & ~(seen < depth - MUCH_OFF), ON_LINE, otherwise)
    return np.where(inside, state, BLOCKED)


def _walk(nodes: Array, arc: Array) -> tuple[Array, Array]:
    """Points (K, 3) [m] at `arc` (K,) [m] past the last node, straight on beyond it, and directions (K, 3)."""
    back = nodes[::-1]
    length = _arc_length(back)
    behind = np.stack([np.interp(DIRECTION_OVER, length, back[:, k]) for k in range(3)])
    ahead = (nodes[-1] - behind) / np.linalg.norm(nodes[-1] - behind)
    inner = np.stack([np.interp(-arc, length, back[:, k]) for k in range(3)], axis=-1)
    return np.where((arc > 0.0)[:, None], nodes[-1] + arc[:, None] * ahead, inner), np.tile(ahead, (len(arc), 1))


def _arc_length(nodes: Array) -> Array:
    """(N,) [m] along the line from the first of nodes (N, 3)."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(nodes, axis=0), axis=-1))])


def _meets_itself(nodes: Array, walk: Array, radius: float) -> bool:
    """Whether another part of the line lies where the walk (K, 3) goes past the end."""
    arc = np.cumsum(np.linalg.norm(np.diff(nodes[::-1], axis=0), axis=-1))[::-1]
    other = nodes[:-1][arc > WALK_BEFORE + WALK_PAST]
    if not len(other):
        return False
    return bool(np.linalg.norm(walk[:, None] - other[None], axis=-1).min() < OTHER_PART * radius)


def extended(nodes: Array, first: float, last: float) -> Array:
    """A polyline (K, 3) whose ends lie farther out by `first` and `last` [m], along its direction; less: cut off."""
    for by in (last, first):
        if by < 0.0:
            arc = _arc_length(nodes)
            end = np.array([np.interp(arc[-1] + by, arc, nodes[:, k]) for k in range(3)])
            nodes = np.concatenate([nodes[arc < arc[-1] + by], end[None]])
        elif by > 0.0:
            nodes = np.concatenate([nodes, _walk(nodes, np.array([by]))[0]])
        nodes = nodes[::-1]
    return nodes
