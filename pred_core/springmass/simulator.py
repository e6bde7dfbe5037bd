"""`SpringMass`: the physics backbone as a Dynamics, batched over worlds."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
import warp as wp
from torch import Tensor

from pred_core.dynamics import FARTHEST
from pred_core.errors import ConfigError, DivergenceError, InputError
from pred_core.springmass import grasp, kernel
from pred_core.springmass.arrays import ModelArrays, chains, line_ends, mass_of_worlds
from pred_core.springmass.collision import candidate_pairs, connected_within
from pred_core.springmass.device import check_device
from pred_core.springmass.lanes import pack, pack_into, unpack
from pred_core.springmass.parameters import added_by, effects_of, extensions_per_world, parameter_rows
from pred_core.springmass.stability import choose_substeps
from pred_core.springmass.workspace import Size, Workspace
from pred_core.twin import Extension
from pred_core.types import Body, Grip, Physics, Scene, State

_KEPT_WORKSPACES = 8
_KEPT_BYTES = 1 << 28  # of buffers between calls; one call may need more
_NO_TURN = 3.0  # [rad] a twist below it is found again from the ends alone; beyond pi it would lose a turn


class SpringMass:
    """Spring-mass simulator (paper III-A) with bending by angle, contact and effect hooks.

    One `Physics` (and one list of extensions) serves any batch; a sequence of W gives each world its own, and
    the state must then have W worlds. `spring_mask` (W, S) switches springs per world. Float32 on `device`.
    Buffers are kept between calls: one thread uses one instance.

    Raises: ConfigError if the device is not here, the worlds' extensions are different effects, or a count does not
    match.
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
        check_device(device)
        self.body, self.scene, self.period, self.device = body, scene, period, device
        self.physics = [physics] if isinstance(physics, Physics) else list(physics)
        per_world = extensions_per_world(extensions, len(self.physics))
        self.worlds = max(len(self.physics), len(per_world))
        self.effects = effects_of(per_world)
        each = [self.physics[w % len(self.physics)] for w in range(self.worlds)]
        self._mass = mass_of_worlds(body, per_world, self.effects).to(device)
        masses = list(self._mass.double().cpu().numpy().repeat(self.worlds // len(self._mass), axis=0))
        if substeps is not None and substeps < 1:
            raise ConfigError("substeps a period", got=substeps, allowed="1 or more; None: by stability")
        if substeps is None:
            rows = [added_by(body, extensions) for extensions in per_world]
            added = [rows[w % len(rows)] for w in range(self.worlds)]
            substeps = choose_substeps(body, period, each, added, masses=masses)
        self.substeps = substeps
        self.diverged_as_nan = diverged_as_nan
        self.staged = device != "cpu" if staged is None else staged
        self._rows = parameter_rows(self.physics, per_world, self.effects).to(device)
        self._mask = spring_mask
        self._near = connected_within(body) if self_collision else None
        self._arrays = ModelArrays.of(body, scene, device)
        self._lines = chains(body)
        framed = any("bend" in e.hooks for e in self.effects)
        slots = 2 + sum(e.bend_memory for e in self.effects)
        values = 4 + sum(e.line_values for e in self.effects)
        # Per line the twist angle, a director and what hooks hand on; per bend two curvatures and what hooks keep.
        frame_size = values * len(self._lines) + slots * len(body.bends) if framed else 0
        self._line_ends = torch.as_tensor(line_ends(body)[: None if framed else 0], device=device)
        self._twists = slice(0, 4 * len(self._lines) if framed else 0, 4)
        self._grip_size = body.count * sum(e.grip_memory for e in self.effects)  # at the end: per slot and particle
        self._memory_size = frame_size + self._grip_size
        seen = framed or any(e.reads_tangent for e in self.effects)
        self._bends = len(body.bends) if seen or any(p.bending_stiffness != 0.0 for p in self.physics) else 0
        self._constants: dict[tuple[int, int], dict[str, Tensor]] = {}
        self._workspaces: dict[Size, tuple[Workspace, Tensor, Tensor]] = {}

    @property
    def grip_memory_size(self) -> int:
        """Values at the end of a world's effect memory that say how far held particles have moved in their grippers."""
        return self._grip_size

    def start(self, state: State, grip: Grip | None = None) -> State:
        """Fill in grip offsets, the pose they refer to, effect memory and the clock. See `Dynamics.start`.

        For causes that change over a session, set `memory["time"]` (W,) [s] to when in the session the rollout begins.
        """
        flat, lead = self._flatten(state)
        count = flat.position.shape[0]
        if grip is None:
            if bool((flat.held >= 0).any()):
                raise InputError("particles are held but no gripper pose is given", next_step="Call start(state, grip)")
            grip = Grip(torch.zeros(count, 0, 3), torch.zeros(count, 0, 4), torch.zeros(count, 0, dtype=torch.bool))
        else:
            grip = grasp.flatten_grip(grip, lead, self.device)
        grasp.check_grip(grip, count, flat.held)
        grasp.check_frames(flat.position, self._line_ends, flat.held, grip)
        memory = {
            "grip_position": grip.position,
            "grip_rotation": grip.rotation,
            "grip_closed": grip.closed,
            "grip_offset": grasp.grip_offsets(flat.position, flat.held, grip),
            "effects": torch.zeros(count, self._memory_size, device=self.device),
            "time": torch.zeros(count, device=self.device),
            "steps": torch.zeros(count, device=self.device),
        }
        return _unflatten(flat.replace(memory=memory), lead)

    def step(self, state: State, grip: Grip) -> State:
        """One period of `substeps` substeps. See `Dynamics.step`."""
        flat, lead = self._flatten(state)
        poses = grasp.flatten_grip(grip, lead, self.device)
        after, _ = self._advance(flat, Grip(poses.position[None], poses.rotation[None], poses.closed[None]), False)
        position = self._check(after.position[None])[0]
        return _unflatten(after.replace(position=position), lead)

    def corrected(self, state: State, position: Tensor, velocity: Tensor) -> State:
        """See `Correctable`: bends take their new shape as it is, as at a start, and the clock goes on.

        A bend's damping would else see the whole correction in one substep. Where the frame cannot be found again
        (nothing is held, or an end was turned by more than half a turn), it is kept, and damps the correction.
        """
        memory = dict(state.memory)
        twists = memory["effects"][..., self._twists]
        if twists.numel() and bool((state.held >= 0).any()) and float(twists.abs().max()) < _NO_TURN:
            memory["time"] = memory["time"] + memory["steps"] * self.period
            memory["steps"] = torch.zeros_like(memory["steps"])
        return state.replace(position=position, velocity=velocity, memory=memory)

    def rollout(self, state: State, grips: Grip) -> Tensor:
        """Positions (T, ..., N, 3) over T periods in one kernel call. See `Dynamics.rollout`."""
        return self.rollout_states(state, grips)[0]

    def rollout_states(self, state: State, grips: Grip) -> tuple[Tensor, State]:
        """`rollout` and the state after it."""
        flat, lead = self._flatten(state)
        periods = grips.position.shape[0] if grips.position.dim() > 2 else 0
        if periods == 0:
            raise InputError("grips of a rollout", got=f"shape {tuple(grips.position.shape)}", allowed="(T, ..., G, 3)")
        for _ in range(len(lead) - grips.position.dim() + 3):  # the same poses for every world
            grips = Grip(grips.position.unsqueeze(1), grips.rotation.unsqueeze(1), grips.closed.unsqueeze(1))
        stacked = grasp.flatten_grip(grips, torch.Size((periods, *lead)), self.device)
        stacked = Grip(*(v.unflatten(0, (periods, lead.numel())) for v in vars(stacked).values()))
        spans = [(t, t + 1) for t in range(periods)] if self._near is not None else _constant_spans(stacked.closed)
        parts = []
        for begin, end in spans:
            flat, trajectory = self._advance(flat, stacked.span(begin, end), True)
            parts.append(trajectory)
        positions = parts[0] if len(parts) == 1 else torch.cat(parts)
        checked = self._check(positions)
        if checked is not positions:
            flat = flat.replace(position=checked[-1])
        return checked.reshape(periods, *lead, self.body.count, 3), _unflatten(flat, lead)

    def _advance(self, state: State, grips: Grip, record: bool) -> tuple[State, Tensor]:
        """T periods with constant `closed`; state (W, ...), grips (T, W, G, ...). Returns (state, (T, W, N, 3))."""
        worlds = state.position.shape[0]
        memory = dict(state.memory)
        if "grip_offset" not in memory:
            raise InputError("the state was never started", next_step="Call start(state, grip) before step")
        before = Grip(memory["grip_position"], memory["grip_rotation"], memory["grip_closed"])
        if before.position.shape[1] != grips.position.shape[2]:
            raise InputError("grippers", got=grips.position.shape[2], allowed=f"{before.position.shape[1]} as at start")
        grasp.check_poses(grips)
        if not torch.equal(before.closed, grips.closed[0]):
            held, memory["grip_offset"] = grasp.close_and_open(state, before, grips.closed[0], self.scene.grasp_radius)
            memory["effects"] = self._regripped(memory["effects"], held != state.held)
            state = state.replace(held=held, memory=memory)
        work, held_particles = self._workspace(state.held, grips)
        tensors = work.tensors
        pack_into(work.position, state.position)
        pack_into(work.velocity, state.velocity)
        tensors["force"].zero_()  # a diverged world leaves its forces behind
        if len(held_particles):
            pack_into(tensors["held_offset"], memory["grip_offset"].index_select(1, held_particles))
        if grips.position.shape[2]:
            pack_into(tensors["grips"], _poses(before, grips))
        if self.effects:
            pack_into(tensors["time"], memory["time"])
            pack_into(tensors["steps"], memory["steps"])
        if self._memory_size:
            pack_into(tensors["memory"], memory["effects"])
        if self._near is not None:
            pairs = candidate_pairs(self.body, self._near, state, before, grips, self.period)
            work.model.pairs = wp.from_torch(pairs.flatten().contiguous(), dtype=wp.int32)
            work.model.pair_count = len(pairs)
            work.changed()
        work.launch()
        memory["grip_position"], memory["grip_rotation"] = grips.position[-1], grips.rotation[-1]
        memory["grip_closed"] = grips.closed[-1]
        if self._memory_size:
            memory["effects"] = unpack(tensors["memory"], worlds)
        memory["steps"] = memory["steps"] + grips.position.shape[0]
        position, velocity = unpack(work.position, worlds), unpack(work.velocity, worlds)
        trajectory = tensors["trajectory_out"][:, :worlds].clone() if record else position
        return State(position, velocity, state.held, memory), trajectory

    def _regripped(self, memory: Tensor, changed: Tensor) -> Tensor:
        """Effect memory (W, M) with what grips keep set to zero for particles (W, N) that another gripper has now."""
        if self._grip_size == 0:
            return memory
        grips = memory[:, -self._grip_size :].unflatten(1, (-1, self.body.count)).masked_fill(changed[:, None], 0.0)
        return torch.cat((memory[:, : -self._grip_size], grips.flatten(1)), dim=1)

    def _workspace(self, held: Tensor, grips: Grip) -> tuple[Workspace, Tensor]:
        """Buffers that fit the call, set up for who is held; and the particle of each held entry."""
        worlds = held.shape[0]
        for size, (work, known, particles) in self._workspaces.items():
            if (size.periods, size.grippers) == grips.position.shape[::2][:2] and torch.equal(known, held):
                return work, particles
        entries, mask = grasp.held_entries(held)
        size = Size(worlds, grips.position.shape[0], grips.position.shape[2], len(entries))
        kept = self._workspaces.pop(size, None)
        work = self._new_workspace(size) if kept is None else kept[0]
        while self._workspaces and (
            len(self._workspaces) >= _KEPT_WORKSPACES
            or work.bytes + sum(w.bytes for w, _, _ in self._workspaces.values()) > _KEPT_BYTES
        ):
            del self._workspaces[next(iter(self._workspaces))]
        lines = torch.as_tensor(self._lines, dtype=torch.long)
        bends = torch.as_tensor(self.body.bends, dtype=torch.long).reshape(-1, 3)
        ends = torch.stack((bends[lines[:, 0], 0], bends[lines[:, 1] - 1, 2]), dim=1).to(held.device)
        grippers = held[:, ends].to(torch.float32)  # (W, K, 2) at each line's first and last edge, -1 = none
        pack_into(work.tensors["frame_grip"], grippers)
        if len(entries):
            pack_into(work.tensors["held_mask"], mask)
        work.model.held = wp.from_torch(entries.flatten().contiguous(), dtype=wp.int32)
        work.model.loose = int(bool((grippers.amax(-1) < 0).any())) if len(lines) else 0
        work.changed()
        particles = entries[:, 0].long()
        self._workspaces[size] = (work, held.clone(), particles)
        return work, particles

    def _new_workspace(self, size: Size) -> Workspace:
        if self.worlds not in (1, size.worlds):
            raise InputError("worlds in the state", got=size.worlds, allowed=f"{self.worlds}, one for each Physics")
        lanes = 1 if size.worlds < kernel.FEW_WORLDS or self.staged else kernel.SIMD_LANES
        constants = self._world_constants(size.worlds, lanes)
        model = self._arrays.model()
        model.bend_count, model.parameter_count = self._bends, self._rows.shape[1]
        model.substeps, model.masked = self.substeps, int(self._mask is not None)
        model.substep = self.period / self.substeps
        model.inverse_substeps, model.inverse_period = 1.0 / self.substeps, 1.0 / self.period
        body = (self.body.count, self._memory_size, len(self._lines))
        return Workspace(size, body, constants, model, lanes, self.effects, self.staged, self.device)

    def _world_constants(self, worlds: int, lanes: int) -> dict[str, Tensor]:
        """Packed parameter rows, masses and spring masks of a batch; kept, because they do not change."""
        key = (worlds, lanes)
        if key not in self._constants:
            values = {"parameters": self._rows, "mass": self._mass, "inverse_mass": 1.0 / self._mass}
            if self._mask is not None:
                values["spring_mask"] = self._mask.to(self.device)
            self._constants[key] = {k: pack(v.expand(worlds, -1), lanes) for k, v in values.items()}
        return self._constants[key]

    def _flatten(self, state: State) -> tuple[State, torch.Size]:
        """One leading axis, float32. Raises: InputError on a wrong shape or type, or a value that is not finite."""
        n, p, v, h = self.body.count, state.position, state.velocity, state.held
        lead = p.shape[:-2]
        if p.shape[-2:] != (n, 3) or v.shape != p.shape or h.shape != p.shape[:-1]:
            got = f"position {tuple(p.shape)}, velocity {tuple(v.shape)}, held {tuple(h.shape)}"
            raise InputError("state", got=got, allowed=f"(..., {n}, 3), the same, (..., {n})")
        if not p.is_floating_point() or not v.is_floating_point() or h.is_floating_point() or h.dtype == torch.bool:
            raise InputError("state", got=f"{p.dtype}, {v.dtype}, {h.dtype}", allowed="floats, floats, integer indices")
        if len(lead) == 1 and p.dtype == v.dtype == torch.float32 and self.device == "cpu" == p.device.type:
            flat = state  # nothing to do: calls are short, every operation counts
        else:
            count = lead.numel()
            flat = State(
                p.reshape(count, n, 3).to(self.device, torch.float32),
                v.reshape(count, n, 3).to(self.device, torch.float32),
                h.reshape(count, n).to(self.device),
                {k: m.reshape(count, *m.shape[len(lead) :]) for k, m in state.memory.items()},
            )
        if not self.diverged_as_nan and not math.isfinite(float(flat.position.sum()) + float(flat.velocity.sum())):
            bad = ~torch.isfinite(flat.position + flat.velocity).all(-1)
            if bool(bad.any()):
                world, particle = torch.nonzero(bad)[0].tolist()
                raise InputError(f"state is not finite: particle {particle} of world {world}",
                                 next_step="Check what measured or predicted it")  # fmt: skip
        return flat, lead

    def _check(self, positions: Tensor) -> Tensor:
        """(T, W, N, 3) as given, or with NaN from where a world diverged, if it may. Raises: DivergenceError."""
        low, high = torch.aminmax(positions)
        if float(low) >= -FARTHEST and float(high) <= FARTHEST:  # false for NaN
            return positions
        bad = ~(positions.abs() <= FARTHEST).flatten(2).all(-1)  # (T, W)
        if self.diverged_as_nan:
            return positions.masked_fill((bad.cumsum(0) > 0)[..., None, None], math.nan)
        period, world = torch.nonzero(bad)[0].tolist()
        finite = bool(torch.isfinite(positions[period, world]).all())
        where = f"went farther than {FARTHEST:g} m from the origin" if finite else "left the finite numbers"
        raise DivergenceError(
            f"the simulation {where} at step {period + 1} of world {world}",
            got=f"{self.substeps} substeps a period", next_step="Use more substeps, or less stiffness and damping",
        )  # fmt: skip


def _poses(before: Grip, grips: Grip) -> Tensor:
    """(W, T+1, G, 8): position, rotation wxyz on the near side of its predecessor, closed."""
    position = torch.cat((before.position[None], grips.position))
    rotation = torch.cat((before.rotation[None], grips.rotation))
    closed = torch.cat((grips.closed[:1], grips.closed)).to(position.dtype)[..., None]
    dot = (rotation[1:] * rotation[:-1]).sum(-1, keepdim=True)
    if float(dot.min()) < 0.0:
        sign = torch.where(dot < 0, -1.0, 1.0)
        rotation = torch.cat((rotation[:1], rotation[1:] * sign.cumprod(0)))
    return torch.cat((position, rotation, closed), dim=-1).movedim(1, 0)


def _constant_spans(closed: Tensor) -> list[tuple[int, int]]:
    """[begin, end) spans of periods over which no world opens or closes a gripper."""
    changed = (closed[1:] != closed[:-1]).flatten(1).any(1)
    edges = [0, *(torch.nonzero(changed).flatten() + 1).tolist(), closed.shape[0]]
    return list(zip(edges[:-1], edges[1:], strict=True))


def _unflatten(state: State, lead: torch.Size) -> State:
    if len(lead) == 1:
        return state
    return State(
        state.position.reshape(*lead, *state.position.shape[1:]),
        state.velocity.reshape(*lead, *state.velocity.shape[1:]),
        state.held.reshape(*lead, *state.held.shape[1:]),
        {k: v.reshape((*lead, *v.shape[1:])) for k, v in state.memory.items()},
    )
