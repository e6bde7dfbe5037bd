"""The simulator's plain twin: the same equations in float64 torch, one loop over substeps. For tests only.

Forces, contact and grippers follow `source.py` and `source_contact.py` line by line in meaning, not in form;
effects run through the same laws, here on tensors. Bending stands in `reference_bending.py`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pred_core.effects.algebra import Vec3
from pred_core.effects.effect import ContactContext, Effect, GripContext, ParticleContext, SlideContext, SpringContext
from pred_core.frames import quaternion_normalize, quaternion_rotate, quaternion_to_matrix
from pred_core.springmass import grasp
from pred_core.springmass.arrays import bend_rows, chains, mass_of_worlds
from pred_core.springmass.collision import candidate_pairs, connected_within
from pred_core.springmass.parameters import effects_of, extensions_per_world
from pred_core.springmass.reference_bending import BendMemory, bend_forces, line_tangents
from pred_core.springmass.source_contact import WAY_OUT
from pred_core.twin import Extension
from pred_core.types import Body, Box, Fixture, Grip, Physics, Scene, Sphere, State

TINY = 1e-18
GripMemory = dict[int, tuple[Tensor, ...]]  # per effect with a `boundary` hook: (W, N) each


def column(values: Sequence[float]) -> Tensor:
    """(W, 1) float64."""
    return torch.tensor(values, dtype=torch.float64)[:, None]


@dataclass
class Reference:
    """One object in W worlds; the arguments mean what they mean in `SpringMass`."""

    body: Body
    physics: Sequence[Physics]
    scene: Scene = Scene()
    period: float = 0.01
    substeps: int = 1
    extensions: Sequence[Any] = ()
    spring_mask: Tensor | None = None
    self_collision: bool = False

    def __post_init__(self) -> None:
        per_world: list[tuple[Extension, ...]] = extensions_per_world(self.extensions, len(self.physics))
        worlds = len(self.physics)
        per_world = [per_world[w % len(per_world)] for w in range(worlds)]
        self.effects = effects_of(per_world)
        self.values: list[dict[str, tuple[Tensor, ...]]] = []
        for number, effect in enumerate(self.effects):
            rows = [e[number].parameters for e in per_world]
            self.values.append(
                {q.name: tuple(column([r[q.name][k] for r in rows]) for k in range(q.size)) for q in effect.parameters}
            )
        self.mass = mass_of_worlds(self.body, per_world, self.effects).double().expand(worlds, -1)
        self.stiffness = column([p.stiffness for p in self.physics])
        self.damping = column([p.damping for p in self.physics])
        self.friction = column([p.ground_friction for p in self.physics]) * torch.as_tensor(self.body.friction_scale)
        self.bending = column([p.bending_stiffness for p in self.physics])
        self.arc = torch.as_tensor(self.body.arc)[None]
        self.bend_rows = torch.as_tensor(bend_rows(self.body))
        self.near = connected_within(self.body) if self.self_collision else None
        self.lines = [(int(a), int(b)) for a, b in chains(self.body)]

    def rollout(self, state: State, grips: Grip) -> tuple[Tensor, Tensor]:
        """Positions (T, W, N, 3) and the last velocities (W, N, 3), from a state that `SpringMass.start` made."""
        h = self.period / self.substeps
        memory = state.memory
        before = Grip(memory["grip_position"].double(), memory["grip_rotation"].double(), memory["grip_closed"])
        x, v = state.position.double(), state.velocity.double()
        held, offset = state.held, memory["grip_offset"].double()
        begun = memory["time"].double()[:, None]
        bend_memory = BendMemory()
        kept = {
            n: (torch.zeros_like(x[..., 0]),) * effect.grip_memory
            for n, (effect, _) in enumerate(self.hooks("boundary"))
        }
        out, pairs = [], None
        for t in range(grips.position.shape[0]):
            turned = _near(grips.rotation[t].double(), before.rotation)
            after = Grip(grips.position[t].double(), turned, grips.closed[t])
            now = State(x, v, held, {"grip_offset": offset})
            was, (held, offset) = held, grasp.close_and_open(now, before, after.closed, self.scene.grasp_radius)
            kept = {n: tuple(m.masked_fill(held != was, 0.0) for m in values) for n, values in kept.items()}
            if self.near is not None:
                nexts = Grip(after.position[None], after.rotation[None], after.closed[None])
                pairs = candidate_pairs(self.body, self.near, State(x, v, held), before, nexts, self.period).long()
            for sub in range(self.substeps):
                time = begun + (t * self.substeps + sub) * h
                alpha = sub / self.substeps
                rotation = quaternion_normalize((1 - alpha) * before.rotation + alpha * after.rotation)
                force = self.spring_forces(x, v, time)
                force = force + bend_forces(self, x, held, rotation, time, h, bend_memory)
                if pairs is not None:
                    force = force + self.pair_forces(x, v, pairs, h)
                x, v, load = self.integrate(x, v, force, before, after, alpha, time, h)
                x, v, kept = self.hold(x, v, load, held, offset, kept, before, after, sub, time + h, h)
            before = after
            out.append(x)
        return torch.stack(out), v

    def hooks(self, hook: str) -> list[tuple[type[Effect], dict[str, tuple[Tensor, ...]]]]:
        """Effects that act through `hook`, with their parameters (W, 1)."""
        return [(e, v) for e, v in zip(self.effects, self.values, strict=True) if hook in e.hooks]

    def spring_forces(self, x: Tensor, v: Tensor, time: Tensor) -> Tensor:
        """(W, N, 3) [N]: k (l/l0 - 1) + c dl/dt along each spring (paper III-A)."""
        body = self.body
        i, j = torch.as_tensor(body.springs, dtype=torch.long).T
        d, u = x[:, j] - x[:, i], v[:, j] - v[:, i]
        length = (d.square().sum(-1) + TINY).sqrt()
        rate = (u * d).sum(-1) / length
        rest = torch.as_tensor(body.rest_length)[None]
        k = self.stiffness * torch.as_tensor(body.stiffness_scale)
        c = self.damping * torch.as_tensor(body.damping_scale)
        tension = k * (length / rest - 1.0) + c * rate
        arc = 0.5 * (self.arc[:, i] + self.arc[:, j])
        for effect, p in self.hooks("spring"):
            tension = tension + effect.spring(p, SpringContext(length, rest, rate, k, c, arc, time))
        if self.spring_mask is not None:
            tension = tension * self.spring_mask
        f = (tension / length)[..., None] * d
        return torch.zeros_like(x).index_add(1, i, f).index_add(1, j, -f)

    def pair_forces(self, x: Tensor, v: Tensor, pairs: Tensor, h: float) -> Tensor:
        """(W, N, 3) [N] that stop approaching pairs at two radii."""
        i, j = pairs.T
        d = x[:, j] - x[:, i]
        length = (d.square().sum(-1) + TINY).sqrt()
        normal = d / length[..., None]
        rate = ((v[:, j] - v[:, i]) * normal).sum(-1)
        gap = length - 2.0 * self.body.radius
        wanted = torch.where(gap > 0, -gap / h, -0.05 * gap / h)
        share = self.mass[:, i] * self.mass[:, j] / (self.mass[:, i] + self.mass[:, j])
        f = ((wanted - rate).clamp_min(0.0) * share / h)[..., None] * normal
        return torch.zeros_like(x).index_add(1, i, -f).index_add(1, j, f)

    def integrate(
        self, x: Tensor, v: Tensor, force: Tensor, before: Grip, after: Grip, alpha: float, time: Tensor, h: float
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Semi-implicit Euler with contact: pusher, fixtures, ground. (x, v, all forces but contact)."""
        scene, radius = self.scene, self.body.radius
        place, speed, tangent = Vec3.of(x), Vec3.of(v), Vec3.of(line_tangents(self, x))
        for effect, p in self.hooks("force"):
            f = effect.force(p, ParticleContext(place, speed, self.mass, self.arc, time, tangent))
            force = force + torch.stack([torch.as_tensor(c) + torch.zeros_like(x[..., 0]) for c in (f.x, f.y, f.z)], -1)
        gravity = torch.tensor(scene.gravity, dtype=torch.float64)
        load = force + self.mass[..., None] * gravity
        v = v + h * (force / self.mass[..., None] + gravity)
        out = torch.zeros_like(x)
        if scene.pusher_radius > 0.0:
            for g in range(after.position.shape[1]):
                origin = (1 - alpha) * before.position[:, g] + alpha * after.position[:, g]
                d = x - origin[:, None]
                distance = (d.square().sum(-1) + TINY).sqrt()
                gap = distance - scene.pusher_radius - radius
                gap = torch.where(after.closed[:, g : g + 1], torch.full_like(gap, 1e9), gap)
                moving = ((after.position[:, g] - before.position[:, g]) / self.period)[:, None]
                v, push = press(gap, d / distance[..., None], moving, self.friction, v, h)
                out = out + push
        still = torch.zeros(3, dtype=torch.float64)
        for fixture in scene.fixtures:
            gap, normal = fixture_gap(fixture, x)
            v, push = press(gap - radius, normal, still, self.friction, v, h)
            out = out + push
        if scene.ground is not None:
            mu, height = self.friction, torch.full_like(self.friction, scene.ground)
            for effect, p in self.hooks("contact"):
                more, lift = effect.contact(p, ContactContext(place, Vec3.of(v), self.friction, time))
                mu, height = (mu + more).clamp_min(0.0), height + lift
            up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand_as(x)
            v, push = press(x[..., 2] - height - radius, up, still, mu, v, h)
            out = out + push
        return x + h * v + out, v, load

    def hold(
        self, x: Tensor, v: Tensor, load: Tensor, held: Tensor, offset: Tensor, kept: GripMemory, before: Grip,
        after: Grip, sub: int, time: Tensor, h: float,
    ) -> tuple[Tensor, Tensor, GripMemory]:  # fmt: skip
        """Held particles follow their grippers, with the velocity of that motion. (x, v, what grips keep)."""
        if before.position.shape[1] == 0:
            return x, v, kept
        on = (held >= 0)[..., None]
        index = held.clamp_min(0).long()

        def of(values: Tensor) -> Tensor:
            return torch.gather(values, 1, index[..., None].expand(*index.shape, values.shape[-1]))

        p0, p1, q0, q1 = (of(v) for v in (before.position, after.position, before.rotation, after.rotation))
        speed = (p1 - p0) / self.period

        def turned(alpha: float) -> tuple[Tensor, tuple[Vec3, Vec3, Vec3]]:
            q = quaternion_normalize((1 - alpha) * q0 + alpha * q1)
            axes = quaternion_to_matrix(q)
            return q, (Vec3.of(axes[..., :, 0]), Vec3.of(axes[..., :, 1]), Vec3.of(axes[..., :, 2]))

        def lever(alpha: float, when: Tensor, kept: GripMemory) -> Tensor:
            q, axes = turned(alpha)
            r = arm = quaternion_rotate(q, offset)
            for number, (effect, p) in enumerate(self.hooks("boundary")):
                place = Vec3.of((1 - alpha) * p0 + alpha * p1 + r)
                d = effect.boundary(p, GripContext(place, Vec3.of(speed), Vec3.of(arm), axes, when, kept[number]))
                r = r + torch.stack([torch.as_tensor(c) + torch.zeros_like(r[..., 0]) for c in (d.x, d.y, d.z)], -1)
            return r

        alpha = (sub + 1) / self.substeps
        last = lever(sub / self.substeps, time - h, kept)
        same = ((held[:, :, None] == held[:, None, :]) & on).double()  # (W, N, N) of one gripper
        pull, mass = same @ load, (same @ self.mass[..., None])[..., 0].clamp_min(TINY)
        for number, (effect, p) in enumerate(self.hooks("boundary")):
            if effect.grip_memory:
                step = torch.tensor(h, dtype=x.dtype)
                at = SlideContext(Vec3.of(pull), mass, turned(alpha)[1], step, time, kept[number])
                moved = effect.slide(p, at)
                kept = kept | {number: tuple(torch.where(on[..., 0], m, torch.zeros_like(m)) for m in moved)}
        now = lever(alpha, time, kept)
        target = (1 - alpha) * p0 + alpha * p1 + now
        return torch.where(on, target, x), torch.where(on, speed + (now - last) / h, v), kept


def press(gap: Tensor, normal: Tensor, moving: Tensor, mu: Tensor, v: Tensor, h: float) -> tuple[Tensor, Tensor]:
    """Velocity after a non-penetrating contact with Coulomb friction, and what a substep takes of the way out [m]."""
    relative = v - moving
    vn = (relative * normal).sum(-1)
    cut = (-gap.clamp_min(0.0) / h - vn).clamp_min(0.0)
    tangential = relative - vn[..., None] * normal
    slide = (tangential.square().sum(-1) + TINY).sqrt()
    lost = (mu * cut / slide).clamp_max(1.0)
    v = v + cut[..., None] * normal - lost[..., None] * tangential
    return v, (-gap).clamp(0.0, WAY_OUT * h)[..., None] * normal


def fixture_gap(fixture: Fixture, x: Tensor) -> tuple[Tensor, Tensor]:
    """Signed distance (...) [m] and outward normal (..., 3) of a fixture at points (..., 3)."""
    if isinstance(fixture, Box):
        q = quaternion_normalize(torch.tensor(fixture.rotation, dtype=torch.float64))
        world_from_box = quaternion_to_matrix(q)
        local = (x - torch.tensor(fixture.center, dtype=torch.float64)) @ world_from_box
        sign = torch.where(local < 0, -1.0, 1.0).double()
        beyond = local.abs() - torch.tensor(fixture.half_size, dtype=torch.float64)
        outside = beyond.clamp_min(0.0).norm(dim=-1)
        inside = beyond.amax(-1).clamp_max(0.0)
        face = torch.nn.functional.one_hot(beyond.argmax(-1), 3).double()
        away = beyond.clamp_min(0.0) / outside.clamp_min(1e-12)[..., None]
        normal = torch.where((outside > 0)[..., None], away, face) * sign
        return outside + inside, normal @ world_from_box.T
    ends = (fixture.center, fixture.center) if isinstance(fixture, Sphere) else (fixture.start, fixture.end)
    a, b = (torch.tensor(e, dtype=torch.float64) for e in ends)
    along = b - a
    square = float(along.square().sum())
    s = (((x - a) @ along) / square).clamp(0.0, 1.0) if square > 0 else torch.zeros_like(x[..., 0])
    d = x - a - s[..., None] * along
    distance = (d.square().sum(-1) + TINY).sqrt()
    return distance - fixture.radius, d / distance[..., None]


def _near(rotation: Tensor, before: Tensor) -> Tensor:
    """The sign of each quaternion that is nearest to its predecessor."""
    return torch.where((rotation * before).sum(-1, keepdim=True) < 0, -rotation, rotation)
