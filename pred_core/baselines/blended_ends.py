"""Blended ends: a free particle moves by a blend of the displacements of the two held ends of a line."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pred_core.baselines.holding import attach, carried_position, carry
from pred_core.dynamics import rollout_by_steps
from pred_core.errors import InputError
from pred_core.types import Grip, State

_START, _BLEND = "first_position", "blend"


@dataclass(frozen=True)
class BlendedEnds:
    """Displacement since the start, blended linearly along the material coordinate.

    The ends are the held particles with the least and the greatest coordinate; with one held particle (or
    several at one coordinate) the whole shape is carried along with it.
    """

    period: float  # [s]
    coordinate: Tensor  # (N,) material coordinate, growing along the line; any unit

    @classmethod
    def by_order(cls, period: float, count: int) -> BlendedEnds:
        """Particles evenly spaced in the order of the tracks, as in the published cable protocol."""
        return cls(period, torch.linspace(0.0, 1.0, count))

    def start(self, state: State, grip: Grip | None = None) -> State:
        """See `Dynamics.start`. Raises: InputError if nothing is held or particle counts differ."""
        held = state.held >= 0
        if state.held.shape[-1] != len(self.coordinate):
            raise InputError("blended ends: particle count", got=state.held.shape[-1], allowed=len(self.coordinate))
        if not bool(held.any(dim=-1).all()):
            raise InputError("blended ends: no particle is held", next_step="Leave this baseline out for free objects")
        coordinate = self.coordinate.to(state.position)
        low = torch.where(held, coordinate, torch.inf).argmin(dim=-1)
        high = torch.where(held, coordinate, -torch.inf).argmax(dim=-1)
        begin, end = coordinate[low][..., None], coordinate[high][..., None]
        span = torch.where(end > begin, end - begin, torch.ones_like(end))
        blend = ((coordinate - begin) / span).clamp(0.0, 1.0)
        memory = {_START: state.position, _BLEND: blend, "low_end": low[..., None], "high_end": high[..., None]}
        return attach(state, grip, **memory)

    def step(self, state: State, grip: Grip) -> State:
        """See `Dynamics.step`."""
        first = state.memory[_START]
        displacement = carried_position(state, grip) - first
        low = _take(displacement, state.memory["low_end"])
        high = _take(displacement, state.memory["high_end"])
        blend = state.memory[_BLEND][..., None]
        return carry(state, grip, first + (1.0 - blend) * low + blend * high, self.period)

    def rollout(self, state: State, grips: Grip) -> Tensor:
        """See `Dynamics.rollout`."""
        return rollout_by_steps(self, state, grips)


def _take(values: Tensor, index: Tensor) -> Tensor:
    """values (..., N, 3) at one particle each, index (..., 1): (..., 1, 3)."""
    return torch.gather(values, -2, index[..., None].expand(*index.shape, 3))
