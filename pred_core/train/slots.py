"""Rollouts that go on from one optimiser step to the next: the model's own states over whole recordings.

A backbone with memory (friction inside a cable) starts from rest, as a recording does; a window cut out of the
middle would start it with the wrong memory. Slots start at the beginning of a recording and hand their state,
without its gradient, from window to window, so training also sees the drift of long rollouts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from pred_core.types import State


@dataclass(frozen=True)
class Slots:
    """B running rollouts."""

    state: State  # leading axis B, detached
    place: Tensor  # (B, 2) int64 recording, frame the state stands at
    left: Tensor  # (B,) int64 windows before the slot starts anew

    def moved(self, state: State, steps: int) -> Slots:
        """The slots after a window of `steps` periods that ended in `state`."""
        return Slots(state, self.place + torch.tensor([0, steps]), self.left - 1)

    def tensors(self) -> dict[str, Tensor]:
        """Everything, by name, for a checkpoint."""
        named = {"place": self.place, "left": self.left}
        named |= {name: getattr(self.state, name) for name in ("position", "velocity", "held")}
        return named | {f"memory/{key}": value for key, value in self.state.memory.items()}

    @classmethod
    def restored(cls, named: dict[str, Tensor], device: torch.device) -> Slots:
        """The inverse of `tensors`."""
        parts = {k: v.to(device) for k, v in named.items() if k not in ("place", "left")}
        memory = {k.removeprefix("memory/"): v for k, v in parts.items() if k.startswith("memory/")}
        return cls(
            State(parts["position"], parts["velocity"], parts["held"], memory), named["place"], named["left"]
        )


def refill(
    slots: Slots | None,
    lengths: Tensor,
    steps: int,
    carry: int,
    number: int,
    draw: Callable[[int], Tensor],
    start: Callable[[Tensor], State],
    generator: torch.Generator,
) -> Slots:
    """Slots that all have a window of `steps` periods ahead; used-up ones start anew.

    lengths (R,): frames of each recording. draw(n): places (n, 2) to start at. start(places): states there.
    The first time the windows left are drawn, so that slots stand at different times of their recordings.
    """
    if slots is None:
        place = draw(number)
        return Slots(start(place), place, torch.randint(1, carry + 1, (number,), generator=generator))
    recording, frame = slots.place.unbind(1)
    old = (slots.left <= 0) | (frame + steps >= lengths[recording])
    if not bool(old.any()):
        return slots
    rows = old.nonzero()[:, 0]
    place, left = slots.place.clone(), slots.left.clone()
    place[rows], left[rows] = draw(len(rows)), carry
    fresh = start(place[rows])
    state = slots.state
    memory = {key: _put(value, rows, fresh.memory[key]) for key, value in state.memory.items()}
    merged = State(
        _put(state.position, rows, fresh.position),
        _put(state.velocity, rows, fresh.velocity),
        _put(state.held, rows, fresh.held),
        memory,
    )
    return Slots(merged, place, left)


def _put(whole: Tensor, rows: Tensor, part: Tensor) -> Tensor:
    return whole.index_copy(0, rows.to(whole.device), part)
