"""Who holds what: fixed by the gripper's closing and opening, in the gripper's own frame."""

from __future__ import annotations

import torch
from torch import Tensor

from pred_core.errors import InputError
from pred_core.frames import quaternion_conjugate, quaternion_normalize, quaternion_rotate
from pred_core.types import Grip, State


def grip_offsets(position: Tensor, held: Tensor, grip: Grip) -> Tensor:
    """Where held particles sit in their gripper's frame, (W, N, 3) [m]; zero for free particles."""
    index = held.clamp_min(0).long()
    p = torch.gather(grip.position, 1, index[..., None].expand(*index.shape, 3))
    q = torch.gather(grip.rotation, 1, index[..., None].expand(*index.shape, 4))
    offset = quaternion_rotate(quaternion_conjugate(quaternion_normalize(q)), position - p)
    return torch.where((held >= 0)[..., None], offset, torch.zeros_like(offset))


def check_grip(grip: Grip, worlds: int, held: Tensor) -> None:
    """Raise InputError unless poses are finite, rotations unit, and every held index has a gripper."""
    if grip.position.shape[0] != worlds:
        raise InputError("gripper poses", got=f"{grip.position.shape[0]} worlds", allowed=f"{worlds} as the state")
    if not (torch.isfinite(grip.position).all() and torch.isfinite(grip.rotation).all()):
        raise InputError("gripper pose is not finite", next_step="Stop the arm; check the source of gripper/pose")
    norm = grip.rotation.norm(dim=-1)
    if grip.rotation.numel() and bool((norm - 1.0).abs().max() > 1e-2):
        raise InputError("gripper rotation is not a unit quaternion (wxyz)", got=f"norm {float(norm.min()):.3g}")
    most = int(held.max()) if held.numel() else -1
    if most >= grip.position.shape[1]:
        raise InputError("held gripper index", got=most, allowed=f"below {grip.position.shape[1]} grippers")


def close_and_open(state: State, before: Grip, closed: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    """(held, offset) after grippers changed from `before.closed` to `closed` at the start of a period.

    A gripper that closes takes free particles within `radius` [m] of its origin; one that opens lets go.
    """
    held, offset = state.held, state.memory["grip_offset"]
    opened = before.closed & ~closed
    released = (held >= 0) & torch.gather(opened, 1, held.clamp_min(0).long())
    held = torch.where(released, torch.full_like(held, -1), held)
    for g in torch.nonzero((closed & ~before.closed).any(0)).flatten().tolist():
        distance = (state.position - before.position[:, g : g + 1]).norm(dim=-1)
        taken = (distance <= radius) & (held < 0) & (closed & ~before.closed)[:, g : g + 1]
        held = torch.where(taken, torch.full_like(held, g), held)
    fresh = grip_offsets(state.position, held, before)
    offset = torch.where(((held != state.held) & (held >= 0))[..., None], fresh, offset)
    return held, torch.where((held >= 0)[..., None], offset, torch.zeros_like(offset))


def held_entries(held: Tensor) -> tuple[Tensor, Tensor]:
    """((H, 2) int32 particle and gripper, (W, H) float 1 where that world holds it) over a batch (W, N)."""
    worlds = held.shape[0]
    same = bool((held == held[0]).all())
    table = held[:1] if same else held
    pairs = torch.nonzero(table >= 0)
    entries = torch.stack((pairs[:, 1], table[pairs[:, 0], pairs[:, 1]].long()), dim=1)
    entries = torch.unique(entries, dim=0).to(torch.int32)
    mask = held[:, entries[:, 0].long()] == entries[:, 1][None]
    return entries, mask.to(torch.float32).expand(worlds, len(entries))
