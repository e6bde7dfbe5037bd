"""`SpringMass`: the physics backbone as a Dynamics, batched over worlds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import warp as wp
from torch import Tensor

from pred_core.effects import find_effect
from pred_core.effects.effect import Effect
from pred_core.errors import ConfigError, DivergenceError, InputError
from pred_core.springmass import grasp, kernel
from pred_core.springmass.arrays import ModelArrays, mass_of_worlds
from pred_core.springmass.collision import candidate_pairs
from pred_core.springmass.lanes import pack, unpack
from pred_core.springmass.stability import choose_substeps
from pred_core.twin import Extension
from pred_core.types import Body, Grip, Physics, Scene, State


class SpringMass:
    """Spring-mass simulator (paper III-A) with bending by angle, contact and effect hooks.

    One `Physics` (and one list of extensions) serves any batch; a sequence of W gives each world its own, and
    the state must then have W worlds. `spring_mask` (W, S) switches springs per world. Float32 on `device`.

    Raises: ConfigError if the worlds' extensions are different effects or a count does not match.
    """

    def __init__(
        self,
        body: Body,
        physics: Physics | Sequence[Physics],
        scene: Scene = Scene(),  # noqa: B008 (frozen)
        *,
        period: float = 0.01,
        substeps: int | None = None,
        extensions: Sequence[Extension] | Sequence[Sequence[Extension]] = (),
        spring_mask: Tensor | None = None,
        self_collision: bool = False,
        device: str = "cpu",
        diverged_as_nan: bool = False,
        staged: bool | None = None,
    ):
        self.body, self.scene, self.period, self.device = body, scene, period, device
        self.physics = [physics] if isinstance(physics, Physics) else list(physics)
        per_world = _per_world(extensions, len(self.physics))
        self.worlds = max(len(self.physics), len(per_world))
        self.effects = _effects(per_world)
        self.substeps = substeps or choose_substeps(body, period, *_stiffest(self.physics, per_world))
        self.diverged_as_nan = diverged_as_nan
        self.staged = device != "cpu" if staged is None else staged
        self._rows = _parameter_rows(self.physics, per_world, self.effects).to(device)
        self._mass = mass_of_worlds(body, per_world, self.effects).to(device)
        self._mask = spring_mask
        self._self_collision = self_collision
        self._arrays = ModelArrays.of(body, scene, device)
        self._packed: dict[tuple[int, int], tuple[Tensor, Tensor, Tensor]] = {}
        self._memory_size = memory_size(self.effects, len(body.bends))

    def start(self, state: State, grip: Grip | None = None) -> State:
        """Fill in grip offsets, the pose they refer to, effect memory and the clock. See `Dynamics.start`."""
        flat, lead = self._flatten(state)
        count = flat.position.shape[0]
        if grip is None:
            if bool((flat.held >= 0).any()):
                raise InputError("particles are held but no gripper pose is given", next_step="Call start(state, grip)")
            grip = Grip(torch.zeros(count, 0, 3), torch.zeros(count, 0, 4), torch.zeros(count, 0, dtype=torch.bool))
        else:
            grip = _flatten_grip(grip, lead, self.device)
        grasp.check_grip(grip, count, flat.held)
        memory = {
            "grip_position": grip.position,
            "grip_rotation": grip.rotation,
            "grip_closed": grip.closed,
            "grip_offset": grasp.grip_offsets(flat.position, flat.held, grip),
            "effects": torch.zeros(count, self._memory_size, device=self.device),
            "time": torch.zeros(count, device=self.device),
        }
        return _unflatten(flat.replace(memory=memory), lead)

    def step(self, state: State, grip: Grip) -> State:
        """One period of `substeps` substeps. See `Dynamics.step`."""
        flat, lead = self._flatten(state)
        poses = _flatten_grip(grip, lead, self.device)
        after, _ = self._advance(flat, Grip(poses.position[None], poses.rotation[None], poses.closed[None]))
        self._check(after.position[None])
        return _unflatten(after, lead)

    def rollout(self, state: State, grips: Grip) -> Tensor:
        """Positions (T, ..., N, 3) over T periods in one kernel call. See `Dynamics.rollout`."""
        return self.rollout_states(state, grips)[0]

    def rollout_states(self, state: State, grips: Grip) -> tuple[Tensor, State]:
        """`rollout` and the state after it."""
        flat, lead = self._flatten(state)
        periods = grips.position.shape[0]
        stacked = _flatten_grip(grips, torch.Size((periods, *lead)), self.device)
        stacked = Grip(*(v.unflatten(0, (periods, lead.numel())) for v in vars(stacked).values()))
        spans = _constant_spans(flat.memory.get("grip_closed"), stacked.closed)
        if self._self_collision:
            spans = [(t, t + 1) for t in range(periods)]
        parts = []
        for begin, end in spans:
            flat, trajectory = self._advance(flat, stacked.span(begin, end))
            parts.append(trajectory)
        positions = torch.cat(parts)
        self._check(positions)
        return positions.reshape(periods, *lead, self.body.count, 3), _unflatten(flat, lead)

    def _advance(self, state: State, grips: Grip) -> tuple[State, Tensor]:
        """T periods with constant `closed`; state (W, ...), grips (T, W, G, ...). Returns (state, (T, W, N, 3))."""
        worlds = state.position.shape[0]
        if "grip_offset" not in state.memory:
            raise InputError("the state was never started", next_step="Call start(state, grip) before step")
        memory = dict(state.memory)
        before = Grip(memory["grip_position"], memory["grip_rotation"], memory["grip_closed"])
        grasp.check_grip(Grip(grips.position.flatten(1, 2)[None, 0], grips.rotation.flatten(1, 2)[None, 0],
                              grips.closed.flatten(1, 2)[None, 0]), 1, state.held[:0])  # fmt: skip
        if bool((before.closed != grips.closed[0]).any()):
            held, memory["grip_offset"] = grasp.close_and_open(state, before, grips.closed[0], self.scene.grasp_radius)
            state = state.replace(held=held, memory=memory)
        lanes = 1 if worlds == 1 or self.staged else kernel.SIMD_LANES
        entries, mask = grasp.held_entries(state.held)
        rows, mass, spring_mask = self._world_constants(worlds, lanes)
        periods = grips.position.shape[0]
        tensors: dict[str, Tensor] = {
            "position": pack(state.position, lanes).clone(),
            "velocity": pack(state.velocity, lanes).clone(),
            "mass": mass,
            "parameters": rows,
            "spring_mask": spring_mask,
            "held_mask": pack(mask, lanes),
            "held_offset": pack(memory["grip_offset"][:, entries[:, 0].long()], lanes),
            "grips": pack(_poses(before, grips), lanes),
            "frame_grip": pack(self._frame_grippers(state.held), lanes),
            "memory": pack(memory["effects"], lanes).clone(),
        }
        blocks = tensors["position"].shape[0]
        tensors["force"] = torch.zeros_like(tensors["position"])
        tensors["trajectory_out"] = torch.empty(blocks, periods, self.body.count, 3, lanes, device=self.device)
        model = self._arrays.model()
        model.grippers, model.held_count = grips.position.shape[2], len(entries)
        model.held = wp.from_torch(entries.flatten().contiguous(), dtype=wp.int32)
        if self._self_collision:
            pairs = candidate_pairs(self.body, state.position, state.velocity, self.period)
            model.pairs, model.pair_count = wp.from_torch(pairs.flatten().contiguous(), dtype=wp.int32), len(pairs)
        model.parameter_count, model.memory_count = rows.shape[1], self._memory_size
        model.periods, model.substeps, model.masked = periods, self.substeps, int(self._mask is not None)
        model.substep = self.period / self.substeps
        model.inverse_substeps, model.inverse_period = 1.0 / self.substeps, 1.0 / self.period
        model.time = float(memory["time"][0])
        record = wp_struct(tensors)
        self._launch(model, record, blocks, lanes, periods)
        memory["grip_position"], memory["grip_rotation"] = grips.position[-1], grips.rotation[-1]
        memory["grip_closed"] = grips.closed[-1]
        memory["effects"] = unpack(tensors["memory"], worlds)
        memory["time"] = memory["time"] + periods * self.period
        after = State(unpack(tensors["position"], worlds), unpack(tensors["velocity"], worlds), state.held, memory)
        return after, unpack(tensors["trajectory_out"], worlds).movedim(0, 1)

    def _launch(self, model: Any, record: Any, blocks: int, lanes: int, periods: int) -> None:
        run = kernel.build(self.effects, lanes, self.staged)
        if not self.staged:
            wp.launch(run, dim=blocks, inputs=[model, record], device=self.device)
            return
        bends = int(model.bend_count > 0)
        sizes = (model.spring_count, max(bends, model.pair_count), model.particles, model.held_count)
        kernel.launch_staged(run, model, record, blocks, periods, self.substeps, self.device, sizes)

    def _frame_grippers(self, held: Tensor) -> Tensor:
        """(W, 2): the gripper that carries the line's material frame at its first and last edge, -1 = none."""
        if len(self.body.bends) == 0:
            return torch.full((held.shape[0], 2), -1.0, device=held.device)
        first, last = int(self.body.bends[0, 0]), int(self.body.bends[-1, 2])
        return held[:, [first, last]].to(torch.float32)

    def _world_constants(self, worlds: int, lanes: int) -> tuple[Tensor, Tensor, Tensor]:
        """Packed parameter rows, masses and spring masks of a batch; kept, because they do not change."""
        if self.worlds not in (1, worlds):
            raise InputError("worlds in the state", got=worlds, allowed=f"{self.worlds}, one for each Physics given")
        key = (worlds, lanes)
        if key not in self._packed:
            mask = torch.ones(0) if self._mask is None else self._mask.to(self.device)
            self._packed[key] = (
                pack(self._rows.expand(worlds, -1), lanes),
                pack(self._mass.expand(worlds, -1), lanes),
                pack(mask.expand(worlds, -1), lanes) if self._mask is not None else mask,
            )
        return self._packed[key]

    def _flatten(self, state: State) -> tuple[State, torch.Size]:
        if state.position.shape[-2:] != (self.body.count, 3):
            raise InputError("state", got=f"shape {tuple(state.position.shape)}", allowed=f"(..., {self.body.count}, 3)")
        lead = state.position.shape[:-2]
        n, count = len(lead), lead.numel()
        flat = State(
            state.position.reshape(count, self.body.count, 3).to(self.device),
            state.velocity.reshape(count, self.body.count, 3).to(self.device),
            state.held.reshape(count, self.body.count).to(self.device),
            {k: v.reshape(count, *v.shape[n:]) for k, v in state.memory.items()},
        )
        return flat, lead

    def _check(self, positions: Tensor) -> None:
        """(T, W, N, 3): raise DivergenceError at the first period that is not finite."""
        if self.diverged_as_nan or bool(torch.isfinite(positions).all()):
            return
        bad = ~torch.isfinite(positions).flatten(2).all(-1)
        period, world = torch.nonzero(bad)[0].tolist()
        raise DivergenceError(
            f"the simulation left the finite numbers at step {period + 1} of world {world}",
            got=f"{self.substeps} substeps a period", next_step="Use more substeps, or less stiffness and damping",
        )


def memory_size(effects: tuple[type[Effect], ...], bends: int) -> int:
    """Values a world remembers: the twist angle, two curvatures a bend, and what `bend` hooks keep."""
    if not any("bend" in e.hooks for e in effects):
        return 0
    return 1 + bends * (2 + sum(e.bend_memory for e in effects))


def wp_struct(tensors: dict[str, Tensor]) -> Any:
    """The `Worlds` struct over these tensors (shared memory, no copy)."""
    record = kernel.Worlds()
    for name, tensor in tensors.items():
        setattr(record, name, wp.from_torch(tensor.flatten(), dtype=wp.float32))
    record.clock = wp.zeros(1, dtype=wp.int32, device=str(tensors["position"].device))
    return record


def _poses(before: Grip, grips: Grip) -> Tensor:
    """(W, T+1, G, 8): position, rotation wxyz on the near side of its predecessor, closed."""
    position = torch.cat((before.position[None], grips.position))
    rotation = torch.cat((before.rotation[None], grips.rotation))
    closed = torch.cat((grips.closed[:1], grips.closed)).to(position.dtype)[..., None]
    if rotation.shape[0] > 1 and rotation.numel():
        sign = torch.where((rotation[1:] * rotation[:-1]).sum(-1, keepdim=True) < 0, -1.0, 1.0)
        rotation = torch.cat((rotation[:1], rotation[1:] * sign.cumprod(0)))
    return torch.cat((position, rotation, closed), dim=-1).movedim(1, 0)


def _constant_spans(before: Tensor | None, closed: Tensor) -> list[tuple[int, int]]:
    """[begin, end) spans of periods over which no world opens or closes a gripper."""
    changes = [t for t in range(1, closed.shape[0]) if bool((closed[t] != closed[t - 1]).any())]
    edges = [0, *changes, closed.shape[0]]
    return list(zip(edges[:-1], edges[1:], strict=True))


def _flatten_grip(grip: Grip, lead: torch.Size, device: str) -> Grip:
    g = grip.position.shape[-2]
    count = int(torch.Size(lead).numel())
    return Grip(
        grip.position.expand(*lead, g, 3).reshape(count, g, 3).to(device, torch.float32),
        grip.rotation.expand(*lead, g, 4).reshape(count, g, 4).to(device, torch.float32),
        grip.closed.expand(*lead, g).reshape(count, g).to(device, torch.bool),
    )


def _unflatten(state: State, lead: torch.Size) -> State:
    return State(
        state.position.reshape(*lead, *state.position.shape[1:]),
        state.velocity.reshape(*lead, *state.velocity.shape[1:]),
        state.held.reshape(*lead, *state.held.shape[1:]),
        {k: v.reshape((*lead, *v.shape[1:])) for k, v in state.memory.items()},
    )


def _per_world(extensions: Any, worlds: int) -> list[tuple[Extension, ...]]:
    if len(extensions) and not isinstance(extensions[0], Extension):
        lists = [tuple(e) for e in extensions]
        if worlds not in (1, len(lists)):
            raise ConfigError("extensions per world", got=len(lists), allowed=f"{worlds}, as Physics")
        return lists
    return [tuple(extensions)]


def _effects(per_world: list[tuple[Extension, ...]]) -> tuple[type[Effect], ...]:
    ids = [[e.id for e in extensions] for extensions in per_world]
    if any(i != ids[0] for i in ids) or len(set(ids[0])) != len(ids[0]):
        raise ConfigError("extensions", got=ids[0], allowed="the same effects in every world, each once")
    effects = tuple(find_effect(i) for i in ids[0])
    for extensions in per_world:
        for effect, extension in zip(effects, extensions, strict=True):
            effect.check(extension)
    return effects


def _stiffest(
    physics: list[Physics], per_world: list[tuple[Extension, ...]]
) -> tuple[list[Physics], list[tuple[float, float]]]:
    """Each world's Physics and the bending stiffness and damping its effects add."""
    worlds = max(len(physics), len(per_world))
    bounds = []
    for extensions in per_world:
        pairs = [find_effect(e.id).bend_bound({k: v[0] for k, v in e.parameters.items()}) for e in extensions]
        bounds.append((sum(p[0] for p in pairs), sum(p[1] for p in pairs)))
    return [physics[w % len(physics)] for w in range(worlds)], [bounds[w % len(bounds)] for w in range(worlds)]


def _parameter_rows(
    physics: list[Physics], per_world: list[tuple[Extension, ...]], effects: tuple[type[Effect], ...]
) -> Tensor:
    """(W, Q): base parameters, then each effect's in declared order."""
    worlds = max(len(physics), len(per_world))
    rows = []
    for w in range(worlds):
        p = physics[w % len(physics)]
        row = [p.stiffness, p.damping, p.ground_friction, p.bending_stiffness]
        for effect, extension in zip(effects, per_world[w % len(per_world)], strict=True):
            row += [v for q in effect.parameters for v in extension.parameters[q.name]]
        rows.append(row)
    return torch.tensor(rows, dtype=torch.float32)
