"""Packing worlds into lanes: (W, ...) tensors to (blocks, ..., lanes) and back."""

from __future__ import annotations

import torch
from torch import Tensor


def pack(values: Tensor, lanes: int) -> Tensor:
    """(W, ...) to contiguous float32 (blocks, ..., lanes); the last world fills unused lanes."""
    worlds = values.shape[0]
    blocks = -(-worlds // lanes)
    if lanes == 1:
        return values.to(torch.float32).contiguous().unsqueeze(-1)
    missing = blocks * lanes - worlds
    if missing:
        values = torch.cat((values, values[-1:].expand(missing, *values.shape[1:])))
    return values.to(torch.float32).reshape(blocks, lanes, *values.shape[1:]).movedim(1, -1).contiguous()


def unpack(packed: Tensor, worlds: int, lane_axis: int = -1, block_axis: int = 0) -> Tensor:
    """The inverse of `pack`: (blocks, ..., lanes) to (W, ...)."""
    moved = packed.movedim(lane_axis, block_axis + 1)
    shape = list(moved.shape)
    shape[block_axis : block_axis + 2] = [shape[block_axis] * shape[block_axis + 1]]
    return moved.reshape(shape).narrow(block_axis, 0, worlds)
