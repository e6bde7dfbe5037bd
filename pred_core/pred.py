"""PReD: a physics backbone plus a learned residual velocity (paper III-B).

    V^ = V_sim + dV,   X^ = X_sim + dV dt,   dV = 0 for held particles

Any `Dynamics` can be the backbone. All memory lives in `State.memory`: the backbone's under `base/`, the
network's under `residual/`, so a state can be forked, stacked and resumed like any other.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from pred_core.dynamics import Dynamics, corrected, rollout_by_steps
from pred_core.errors import DivergenceError, InputError
from pred_core.residual.encoder import shuffled_orders
from pred_core.residual.network import Buffer, Motion, ResidualNetwork, load_network
from pred_core.springmass import SpringMass
from pred_core.twin import Twin
from pred_core.types import Body, Grip, State

BASE = "base/"
PAST_POSITION = "residual/past_position"  # (..., N, 3) [m] world, one period before
PAST_VELOCITY = "residual/past_velocity"  # (..., N, 3) [m/s] world
WINDOW = "residual/window"  # (..., W, N, 3) initial estimates in units of the cap
COUNT = "residual/count"  # (...) int32 estimates in the window
FRAME = "residual/network_from_world"  # (..., 3, 3), only while training: azimuth the network sees the world at


@dataclass(frozen=True)
class Advance:
    """One step in its parts."""

    state: State  # one period later
    predicted: State  # what the backbone alone made of it
    residual: Tensor  # (..., N, 3) [m/s] world


class PReD:
    """A Dynamics: `base` corrected by `network`. Batched over leading axes; CPU and CUDA."""

    def __init__(self, base: Dynamics, network: ResidualNetwork, body: Body, shuffle: torch.Generator | None = None):
        """`shuffle`: draws the encoder's order of curves anew at every step (training); None: fixed."""
        self.base = base
        self.network = network
        self.arc = torch.as_tensor(body.arc, dtype=torch.float32, device=next(network.parameters()).device)
        self.shuffle = shuffle

    @property
    def period(self) -> float:
        """[s] the time one step covers."""
        return self.base.period

    def start(self, state: State, grip: Grip | None = None) -> State:
        """The state with empty memory: the frame before is extrapolated back at the present velocity.

        Raises: InputError if the particles are not those of the body.
        """
        if state.position.shape[-2] != len(self.arc):
            raise InputError(
                "the state does not fit the twin's body",
                got=f"{state.position.shape[-2]} particles",
                allowed=len(self.arc),
            )
        base = self.base.start(state, grip)
        leading = state.position.shape[:-2]
        buffer = Buffer.empty(leading.numel(), self.network.config.window, base.position)
        memory = _prefixed(base.memory)
        memory[PAST_POSITION] = base.position - base.velocity * self.period
        memory[PAST_VELOCITY] = base.velocity
        memory[WINDOW] = buffer.window.view(*leading, *buffer.window.shape[1:])
        memory[COUNT] = buffer.count.view(leading)
        return base.replace(memory=memory)

    @torch.no_grad()
    def step(self, state: State, grip: Grip) -> State:
        """The state one period later. Raises: InputError if `start` did not make its memory."""
        return self.advance(state, grip).state

    def corrected(self, state: State, position: Tensor, velocity: Tensor) -> State:
        """See `Correctable`: the frame before moves along, so that the network sees no jump."""
        base = corrected(self.base, self.base_state(state), position, velocity)
        memory = dict(state.memory) | _prefixed(base.memory)
        memory[PAST_POSITION] = memory[PAST_POSITION] + (position - state.position)
        memory[PAST_VELOCITY] = memory[PAST_VELOCITY] + (velocity - state.velocity)
        return base.replace(memory=memory)

    @torch.no_grad()
    def rollout(self, state: State, grips: Grip) -> Tensor:
        """Positions (T, ..., N, 3). Raises: DivergenceError naming the first step that is not finite."""
        positions = rollout_by_steps(self, state, grips)
        finite = torch.isfinite(positions).flatten(1).all(dim=1)
        if not bool(finite.all()):
            first = int((~finite).nonzero()[0, 0])
            raise DivergenceError(
                f"PReD left the finite numbers at step {first + 1}", next_step="Lower the cap or train longer rollouts"
            )
        return positions

    def advance(self, state: State, grip: Grip) -> Advance:
        """One step in its parts. Gradients flow to the network, never through the backbone."""
        if WINDOW not in state.memory:
            raise InputError("the state was not started by PReD", next_step="Call start(state, grip) first")
        with torch.no_grad():
            predicted = self.base.step(self.base_state(state), grip)
        residual, memory = self._residual(state, predicted)
        memory |= _prefixed(predicted.memory)
        corrected = State(
            position=predicted.position + residual * self.period,
            velocity=predicted.velocity + residual,
            held=predicted.held,
            memory=memory,
        )
        return Advance(corrected, predicted, residual)

    def base_state(self, state: State) -> State:
        """The state as the backbone sees it: its own memory, no gradient."""
        own = {k[len(BASE) :]: v for k, v in state.memory.items() if k.startswith(BASE)}
        return State(state.position.detach(), state.velocity.detach(), state.held, own)

    def _residual(self, state: State, predicted: State) -> tuple[Tensor, dict[str, Tensor]]:
        """Residual velocity (..., N, 3) [m/s] world, and the network's memory after this step."""
        leading = state.position.shape[:-2]
        memory = state.memory
        parts: tuple[Tensor, ...] = (
            state.position,
            state.velocity,
            memory[PAST_POSITION],
            memory[PAST_VELOCITY],
            predicted.position,
            predicted.velocity,
        )
        turn = memory.get(FRAME)
        if turn is not None:
            parts = tuple(p @ turn.transpose(-1, -2) for p in parts)
        motion = Motion(*(p.reshape(-1, *p.shape[-2:]) for p in parts))
        buffer = Buffer(memory[WINDOW].reshape(-1, *memory[WINDOW].shape[-3:]), memory[COUNT].reshape(-1))
        shuffle = None if self.shuffle is None else shuffled_orders(self.shuffle)
        residual, buffer = self.network(motion, buffer, self.period, self.arc, shuffle)
        residual = residual.view(state.position.shape)
        after = {PAST_POSITION: state.position, PAST_VELOCITY: state.velocity}
        if turn is not None:
            residual = residual @ turn
            after[FRAME] = turn
        after[WINDOW] = buffer.window.view(*leading, *buffer.window.shape[1:])
        after[COUNT] = buffer.count.view(leading)
        return torch.where((predicted.held < 0).unsqueeze(-1), residual, 0.0), after


def load_base(twin: Twin, device: str = "cpu", *, extensions: bool = True) -> Dynamics:
    """The twin's spring-mass simulator, with its extensions unless told otherwise, without its residual."""
    return SpringMass(
        twin.body,
        twin.physics,
        twin.scene,
        period=twin.meta.period,
        substeps=twin.meta.substeps,
        extensions=twin.extensions if extensions else (),
        device=device,
    )


def load_dynamics(
    twin: Twin, device: str = "cpu", *, extensions: bool = True, residual: bool = True
) -> Dynamics:
    """What the twin predicts with: its simulator, corrected by its residual if it has one.

    `extensions`, `residual`: False leaves them out, to see what they are worth.
    """
    base = load_base(twin, device, extensions=extensions)
    return with_residual(base, twin, device) if residual else base


def with_residual(base: Dynamics, twin: Twin, device: str | torch.device = "cpu") -> Dynamics:
    """`base` corrected by the twin's residual, or `base` itself where the twin has none."""
    if twin.residual is None:
        return base
    return PReD(base, load_network(twin.residual, device), twin.body)


def _prefixed(memory: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {BASE + key: value for key, value in memory.items()}
