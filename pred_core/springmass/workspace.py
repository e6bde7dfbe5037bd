"""The buffers of one size of call: packed once, reused by every call of that size."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from torch import Tensor

from pred_core.effects.effect import Effect
from pred_core.springmass import kernel


@dataclass(frozen=True)
class Size:
    """What fixes the shapes of a call's buffers."""

    worlds: int
    periods: int
    grippers: int
    held: int


class Workspace:
    """Packed tensors of a call, the Warp structs over them, and the launch that runs on them."""

    def __init__(
        self, size: Size, body: tuple[int, int, int], constants: dict[str, Tensor], model: Any, lanes: int,
        effects: tuple[type[Effect], ...], staged: bool, device: str,
    ):  # fmt: skip
        particles, memory, lines = body
        loads = particles if any(e.grip_memory for e in effects) else 0
        tangents = particles if any(e.reads_tangent for e in effects) else 0
        self.framed = any("bend" in e.hooks for e in effects)
        blocks = -(-size.worlds // lanes)
        self.lanes, self.staged, self.device, self.model = lanes, staged, device, model
        wide = kernel.stride(lanes, staged)
        shapes = {
            "position": (blocks, particles, wide, lanes),
            "velocity": (blocks, particles, wide, lanes),
            "force": (blocks, particles, wide, lanes),
            "held_mask": (blocks, size.held, lanes),
            "held_offset": (blocks, size.held, 3, lanes),
            "held_lever": (blocks, size.held, 3, lanes),
            "grips": (blocks, size.periods + 1, size.grippers, 8, lanes),
            "frame_grip": (blocks, lines, 2, lanes),
            "memory": (blocks, memory, lanes),
            "load": (blocks, loads, 3, lanes),
            "tangent": (blocks, tangents, 3, lanes),
            "time": (blocks, lanes),
            "steps": (blocks, lanes),
            "trajectory_out": (size.periods, blocks * lanes, particles, 3),
        }
        self.tensors = {name: torch.zeros(shape, device=device) for name, shape in shapes.items()}
        self.bytes = sum(tensor.nbytes for tensor in self.tensors.values())
        self.position = self.tensors["position"][:, :, :3]
        self.velocity = self.tensors["velocity"][:, :, :3]
        record = kernel.Worlds()
        for name, tensor in {**self.tensors, **constants}.items():
            setattr(record, name, wp.from_torch(tensor.flatten(), dtype=wp.float32))
        record.clock = wp.zeros(1, dtype=wp.int32, device=device)
        self._keep = constants
        self.record = record
        model.blocks, model.periods, model.grippers, model.held_count = blocks, size.periods, size.grippers, size.held
        model.memory_count = memory
        self.run = kernel.build(effects, lanes, staged)
        self._command: Any = None

    def launch(self) -> None:
        """Run all periods on what the buffers hold; results are left in them."""
        model = self.model
        if not self.staged:
            if self._command is None:
                self._command = wp.launch(
                    self.run, dim=model.blocks, inputs=[model, self.record], device=self.device, record_cmd=True
                )
            self._command.launch()
            return
        bends = model.chain_count if self.framed else model.bend_count
        sizes = (model.spring_count, max(bends, model.pair_count), model.particles, model.held_count)
        self.record.clock.zero_()
        kernel.launch_staged(self.run, model, self.record, model.periods, self.device, sizes)

    def changed(self) -> None:
        """The model's values were changed: the recorded launch takes them anew."""
        self._command = None
