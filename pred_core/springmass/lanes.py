"""Packing worlds into lanes: (W, ...) tensors to (blocks, ..., lanes) and back."""

from __future__ import annotations

import torch
from torch import Tensor


def pack(values: Tensor, lanes: int) -> Tensor:
    """(W, ...) to contiguous float32 (blocks, ..., lanes); the last world fills unused lanes."""
    worlds = values.shape[0]
    packed = torch.empty(-(-worlds // lanes), *values.shape[1:], lanes, device=values.device)
    pack_into(packed, values)
    return packed


def pack_into(packed: Tensor, values: Tensor) -> None:
    """Fill `packed` (blocks, ..., lanes) from (W, ...)."""
    blocks, lanes = packed.shape[0], packed.shape[-1]
    if lanes == 1:
        packed.squeeze(-1).copy_(values)
        return
    missing = blocks * lanes - values.shape[0]
    if missing:
        values = torch.cat((values, values[-1:].expand(missing, *values.shape[1:])))
    packed.movedim(-1, 1).copy_(values.reshape(blocks, lanes, *values.shape[1:]))


def unpack(packed: Tensor, worlds: int) -> Tensor:
    """A copy (W, ...) of packed (blocks, ..., lanes)."""
    if packed.shape[-1] == 1:
        return packed.squeeze(-1).clone()
    moved = packed.movedim(-1, 1).clone(memory_format=torch.contiguous_format)
    return moved.view(-1, *moved.shape[2:])[:worlds]
