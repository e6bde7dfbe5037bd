"""Bending by angle and the material frame of a line, in float64 torch; the twin of `source_bending.py`."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from pred_core.effects.effect import BendContext
from pred_core.frames import quaternion_rotate

if TYPE_CHECKING:
    from pred_core.springmass.reference import Reference

FOLD = 3e-4  # least 1 + t1.t2 with a finite curvature


@dataclass
class BendMemory:
    """What a rollout remembers between substeps."""

    twist: dict[int, Tensor] = field(default_factory=dict)  # per line (W,)
    director: dict[int, Tensor] = field(default_factory=dict)  # per line (W, 3)
    curvature: Tensor | None = None  # (W, B, 2)
    effects: dict[int, tuple[Tensor, ...]] = field(default_factory=dict)  # per effect, (W, B) each
    arrived: dict[tuple[int, int], tuple[Tensor, ...]] = field(default_factory=dict)  # effect, line: (W, 1) each


def bend_forces(
    sim: Reference, x: Tensor, held: Tensor, rotation: Tensor, time: Tensor, h: float, memory: BendMemory
) -> Tensor:
    """(W, N, 3) [N]: minus the gradient of EI/(2 lbar) |kb|^2, and the moments that effects add."""
    force = torch.zeros_like(x)
    if not sim.lines:
        return force
    i, j, k = torch.as_tensor(sim.body.bends, dtype=torch.long).T
    a, b = x[:, j] - x[:, i], x[:, k] - x[:, j]
    length_a, length_b = a.norm(dim=-1, keepdim=True), b.norm(dim=-1, keepdim=True)
    a, b = a / length_a, b / length_b
    q = 1.0 / (1.0 + _dot(a, b)).clamp_min(FOLD)
    weight = sim.bending * sim.bend_rows[:, 0] * (1.0 + _relative_stiffness(sim, time))
    alpha = -4.0 * weight[..., None] * q * q
    along_a, along_b = alpha * b, alpha * a
    if sim.hooks("bend"):
        first, second, directors = _moments(sim, x, held, rotation, time, h, memory, a, b, q, weight)
        moment = first[..., None] * directors[0] + second[..., None] * directors[1]
        triple = _dot(torch.linalg.cross(a, b), moment)
        along_a = along_a + 2.0 * q * (torch.linalg.cross(b, moment) - triple * q * b)
        along_b = along_b + 2.0 * q * (torch.linalg.cross(moment, a) - triple * q * a)
    along_a = (along_a - _dot(along_a, a) * a) / length_a
    along_b = (along_b - _dot(along_b, b) * b) / length_b
    return force.index_add(1, i, along_a).index_add(1, j, along_b - along_a).index_add(1, k, -along_b)


def line_tangents(sim: Reference, x: Tensor) -> Tensor:
    """(W, N, 3) unit vectors along the lines: along the mean of a particle's two edges; 0 where no line is."""
    tangent = torch.zeros_like(x)
    for begin, end in sim.lines:
        i, j, k = torch.as_tensor(sim.body.bends[begin:end], dtype=torch.long).T
        a, b = x[:, j] - x[:, i], x[:, k] - x[:, j]
        a, b = a / a.norm(dim=-1, keepdim=True), b / b.norm(dim=-1, keepdim=True)
        tangent[:, i[0]], tangent[:, k[-1]] = a[:, 0], b[:, -1]
        tangent[:, j] = (a + b) / (a + b).norm(dim=-1, keepdim=True)
    return tangent


def _moments(
    sim: Reference, x: Tensor, held: Tensor, rotation: Tensor, time: Tensor, h: float, memory: BendMemory, a: Tensor,
    b: Tensor, q: Tensor, weight: Tensor,
) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor]]:  # fmt: skip
    """Moments (W, B) along the two directors of each bend, and the directors (W, B, 3)."""
    bends = sim.body.bends
    curvature = 2.0 * q * torch.linalg.cross(a, b)
    d1, d2 = torch.zeros_like(a), torch.zeros_like(a)
    for number, (begin, end) in enumerate(sim.lines):
        ends = held[:, int(bends[begin, 0])], held[:, int(bends[end - 1, 2])]
        line = slice(begin, end)
        was = None if memory.curvature is None else memory.curvature[:, line]
        shape = a[:, line], b[:, line], curvature[:, line]
        u, twist = _start_frame(number, *shape, ends, rotation, memory, was, _end_twist(sim))
        memory.director[number], memory.twist[number] = u, twist
        d1[:, line], d2[:, line] = _directors(u, a[:, line], b[:, line], twist[:, None] * sim.bend_rows[line, 3])
    now = torch.stack((_dot(curvature, d1)[..., 0], _dot(curvature, d2)[..., 0]), -1)
    change = torch.zeros_like(now) if memory.curvature is None else now - memory.curvature
    memory.curvature = now
    counts = torch.cat([torch.full((e - s,), float(e - s), dtype=x.dtype) for s, e in sim.lines])[None]
    everywhere = BendContext(
        (now[..., 0], now[..., 1]), (change[..., 0], change[..., 1]), weight, sim.bend_rows[:, 1][None],
        counts, torch.tensor(h, dtype=x.dtype), sim.bend_rows[:, 2][None], time, (),
    )  # fmt: skip
    rows: list[list[Tensor]] = []
    for number, (begin, end) in enumerate(sim.lines):
        ends = held[:, int(bends[begin, 0])], held[:, int(bends[end - 1, 2])]
        rows += _along_line(sim, number, range(begin, end), everywhere, ends, memory)
    first, second, *kept = (torch.cat(column, 1) for column in zip(*rows, strict=True))
    for number, (effect, _) in enumerate(sim.hooks("bend")):
        memory.effects[number] = tuple(kept[: effect.bend_memory])
        kept = kept[effect.bend_memory :]
    return first, second, (d1, d2)


def _along_line(
    sim: Reference, line: int, places: range, everywhere: BendContext, ends: tuple[Tensor, Tensor], memory: BendMemory
) -> list[list[Tensor]]:
    """Per bend of a line: the two moments, then every effect's memory (W, 1), bend after bend: values are handed on."""
    benders = sim.hooks("bend")
    zero = torch.zeros_like(everywhere.weight[:, :1])
    handed = {n: (zero,) * effect.line_values for n, (effect, _) in enumerate(benders)}
    arrived = {n: memory.arrived.get((n, line), values) for n, values in handed.items()}
    rows = []
    for place in places:
        here = slice(place, place + 1)
        contexts = [
            replace(
                everywhere,
                curvature=tuple(k[:, here] for k in everywhere.curvature),
                change=tuple(k[:, here] for k in everywhere.change),
                weight=everywhere.weight[:, here], length=everywhere.length[:, here], arc=everywhere.arc[:, here],
                bends=everywhere.bends[:, here], handed=handed[n], arrived=arrived[n],
                memory=tuple(m[:, here] for m in memory.effects.get(n, ())) or (zero,) * effect.bend_memory,
                first_held=(ends[0] >= 0).to(zero.dtype)[:, None], last_held=(ends[1] >= 0).to(zero.dtype)[:, None],
            )
            for n, (effect, _) in enumerate(benders)
        ]  # fmt: skip
        shapes = {n: e.rest_shape(p, contexts[n]) for n, (e, p) in enumerate(benders) if "rest_shape" in e.hooks}
        row = [zero, zero]
        for n, (effect, p) in enumerate(benders):
            others = [shape for k, shape in shapes.items() if k != n and n in shapes]
            rest = sum((s[0] for s in others), 0.0), sum((s[1] for s in others), 0.0)
            m1, m2, after = effect.bend(p, replace(contexts[n], rest=rest))
            row[0], row[1] = row[0] + m1, row[1] + m2
            row += [v + zero for v in after[: effect.bend_memory]]
            handed[n] = after[effect.bend_memory :]
        rows.append(row)
    memory.arrived.update({(n, line): values for n, values in handed.items()})
    return rows


def _relative_stiffness(sim: Reference, time: Tensor) -> Tensor:
    """(1, 1) or (W, B): relative bending stiffness that effects add."""
    total = torch.zeros(1, 1, dtype=torch.float64)
    for effect, p in sim.hooks("bend_stiffness"):
        total = total + effect.bend_stiffness(p, sim.bend_rows[:, 2][None], time)
    return total


def _end_twist(sim: Reference) -> Tensor:
    """(1,) or (W,) [rad]: by how much effects turn the far end of a line."""
    total = torch.zeros(1, dtype=torch.float64)
    for effect, p in sim.hooks("bend"):
        if effect.end_twist:
            total = total + p[effect.end_twist][0].reshape(-1)
    return total


def _start_frame(
    number: int, a: Tensor, b: Tensor, curvature: Tensor, ends: tuple[Tensor, Tensor], rotation: Tensor,
    memory: BendMemory, was: Tensor | None, offset: Tensor,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Director u (W, 3) at a line's first edge and the twist (W,) from its first to its last edge."""
    at_first, at_last = ends[0] >= 0, ends[1] >= 0
    start, finish = a[:, 0], b[:, -1]
    u = _clamped(ends[0], -1.0, rotation, start)
    d = u
    for n in range(a.shape[1]):
        d = _carry(d, a[:, n], b[:, n])
    far = _clamped(ends[1], 1.0, rotation, finish)
    side = torch.linalg.cross(finish, d)
    angle = torch.atan2(_dot(far, side), _dot(far, d))[:, 0]
    known = memory.twist.get(number, torch.zeros_like(angle))
    change = angle - offset - known
    change = change - 2.0 * torch.pi * torch.round(change / (2.0 * torch.pi))
    twist = torch.where(at_first & at_last, known + change, torch.zeros_like(angle))
    u = torch.where((~at_first & at_last)[:, None], _turn(u, start, angle), u)
    loose = _carried_in_time(u, start, a, b, curvature, memory.director.get(number), was)
    return torch.where((~at_first & ~at_last)[:, None], loose, u), twist


def _carried_in_time(
    fallback: Tensor, start: Tensor, a: Tensor, b: Tensor, curvature: Tensor, last: Tensor | None, was: Tensor | None
) -> Tensor:
    """The director of a free line: the last one, turned so that the curvatures' components change least."""
    if last is None or was is None:
        return fallback
    u = last - _dot(last, start) * start
    u = u / u.norm(dim=-1, keepdim=True)
    d1, d2 = _directors(u, a, b, torch.zeros(a.shape[:2], dtype=a.dtype))
    k1, k2 = _dot(curvature, d1)[..., 0], _dot(curvature, d2)[..., 0]
    sine, cosine = (was[..., 0] * k2 - was[..., 1] * k1).sum(-1), (was[..., 0] * k1 + was[..., 1] * k2).sum(-1)
    return _turn(u, start, torch.atan2(sine, cosine))


def _directors(u: Tensor, a: Tensor, b: Tensor, turn: Tensor) -> tuple[Tensor, Tensor]:
    """(W, B, 3) mean of the frames of each bend's two edges, with u (W, 3) carried along."""
    d1, d2 = torch.zeros_like(a), torch.zeros_like(a)
    for n in range(a.shape[1]):
        after = _turn(_carry(u, a[:, n], b[:, n]), b[:, n], turn[:, n])
        d1[:, n] = 0.5 * (u + after)
        d2[:, n] = 0.5 * (torch.linalg.cross(a[:, n], u) + torch.linalg.cross(b[:, n], after))
        u = after
    return d1, d2


def _clamped(which: Tensor, up: float, rotation: Tensor, t: Tensor) -> Tensor:
    """The gripper's y axis across t; world y swung from the vertical where `which` is -1."""
    y = torch.tensor([0.0, 1.0, 0.0], dtype=t.dtype).expand_as(t)
    z = torch.tensor([0.0, 0.0, up], dtype=t.dtype)
    d = y - t[:, 1:2] / (1.0 + up * t[:, 2:]).clamp_min(1e-3) * (t + z)
    if rotation.shape[1]:
        index = which.clamp_min(0).long()[:, None, None].expand(-1, 1, 4)
        axis = quaternion_rotate(torch.gather(rotation, 1, index)[:, 0], y)
        d = torch.where((which >= 0)[:, None], axis, d)
    d = d - _dot(d, t) * t
    return d / d.norm(dim=-1, keepdim=True)


def _carry(d: Tensor, a: Tensor, b: Tensor) -> Tensor:
    return d - _dot(d, b) / (1.0 + _dot(a, b)).clamp_min(FOLD) * (a + b)


def _turn(d: Tensor, axis: Tensor, angle: Tensor) -> Tensor:
    return torch.cos(angle)[:, None] * d + torch.sin(angle)[:, None] * torch.linalg.cross(axis, d)


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(-1, keepdim=True)
