"""Who holds what: fixed by the gripper's closing and opening, in the gripper's own frame."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pred_core.errors import InputError
from pred_core.frames import quaternion_conjugate, quaternion_normalize, quaternion_rotate
from pred_core.types import Grip, State

LEAST_ACROSS = 0.1  # sine of the least angle between a gripper's y axis and the line it holds


def grip_offsets(position: Tensor, held: Tensor, grip: Grip) -> Tensor:
    """Where held particles sit in their gripper's frame, (W, N, 3) [m]; zero for free particles."""
    if grip.position.shape[1] == 0:
        return torch.zeros_like(position)
    index = held.clamp_min(0).long()
    p = torch.gather(grip.position, 1, index[..., None].expand(*index.shape, 3))
    q = torch.gather(grip.rotation, 1, index[..., None].expand(*index.shape, 4))
    offset = quaternion_rotate(quaternion_conjugate(quaternion_normalize(q)), position - p)
    return torch.where((held >= 0)[..., None], offset, torch.zeros_like(offset))


def check_grip(grip: Grip, worlds: int, held: Tensor) -> None:
    """Raise InputError unless poses are finite, rotations unit, and every held index has a gripper.

    `grip` has one leading axis, of `worlds` or of any length (then `worlds` is that length).
    """
    if grip.position.shape[0] != worlds:
        raise InputError("gripper poses", got=f"{grip.position.shape[0]} worlds", allowed=f"{worlds} as the state")
    check_poses(grip)
    most = int(held.max()) if held.numel() else -1
    if most >= grip.position.shape[1]:
        raise InputError("held gripper index", got=most, allowed=f"below {grip.position.shape[1]} grippers")


def check_poses(grip: Grip) -> None:
    """Raise InputError unless every pose is finite and every rotation a unit quaternion."""
    if not grip.rotation.numel():
        return
    error = float((grip.rotation.square().sum(-1) - 1.0).abs().max())
    total = error + float(grip.position.sum())
    if not (error <= 2e-2 and math.isfinite(total)):
        if not math.isfinite(total):
            raise InputError("gripper pose is not finite", next_step="Stop the arm; check the source of gripper/pose")
        off = f"norm off by {0.5 * error:.3g}"
        raise InputError("gripper rotation is not a unit quaternion (wxyz)", got=off)


def check_frames(position: Tensor, ends: Tensor, held: Tensor, grip: Grip) -> None:
    """Raise InputError where the y axis of a gripper that holds a line's end lies along the line: the frame of the
    line's bends is that axis across the line, and would be noise.

    position (W, N, 3) [m]; ends (K, 2) indices: a line's end and the particle next to it.
    """
    if not (grip.position.shape[1] and len(ends)):
        return
    which = held[:, ends[:, 0]]  # (W, K)
    index = which.clamp_min(0).long()[..., None].expand(*which.shape, 4)
    rotation = quaternion_normalize(torch.gather(grip.rotation, 1, index))
    axis = quaternion_rotate(rotation, position.new_tensor([0.0, 1.0, 0.0]).expand(*which.shape, 3))
    edge = position[:, ends[:, 1]] - position[:, ends[:, 0]]
    across = torch.linalg.cross(axis, edge).norm(dim=-1)
    wrong = (which >= 0) & (across < LEAST_ACROSS * edge.norm(dim=-1))
    if bool(wrong.any()):
        world, line = wrong.nonzero()[0].tolist()
        share = float(across[world, line] / edge[world, line].norm().clamp_min(1e-12))
        raise InputError(
            f"gripper {int(which[world, line])} holds the line with its y axis along it: its bends have no frame",
            got=f"{math.degrees(math.asin(min(share, 1.0))):.1f} degrees between them",
            allowed=f"{math.degrees(math.asin(LEAST_ACROSS)):.0f} degrees or more",
            next_step="Give the gripper's pose with y across the object, or leave out effects in bending",
        )


def flatten_grip(grip: Grip, lead: torch.Size, device: str) -> Grip:
    """Poses with leading axes `lead` (or fewer, then the same for all) as one leading axis, float32.

    Raises: InputError if a shape or type does not fit.
    """
    g = grip.position.shape[-2] if grip.position.dim() >= 2 else -1
    count, axes = lead.numel(), tuple(lead)
    shapes = (tuple(grip.position.shape), tuple(grip.rotation.shape), tuple(grip.closed.shape))
    fits = grip.position.shape[-2:] == (g, 3) and grip.rotation.shape[-2:] == (g, 4) and grip.closed.shape[-1:] == (g,)
    if not (fits and grip.position.is_floating_point() and grip.rotation.is_floating_point()):
        raise InputError("gripper poses", got=f"position, rotation, closed of shapes {shapes}",
                         allowed=f"{axes} + (G, 3), (G, 4) floats and (G,)")  # fmt: skip
    usual = grip.position.dtype == grip.rotation.dtype == torch.float32 and grip.closed.dtype == torch.bool
    if usual and grip.position.shape[:-2] == lead == grip.closed.shape[:-1] and len(lead) == 1:
        return Grip(grip.position.to(device), grip.rotation.to(device), grip.closed.to(device))
    try:
        return Grip(
            grip.position.expand(*lead, g, 3).reshape(count, g, 3).to(device, torch.float32),
            grip.rotation.expand(*lead, g, 4).reshape(count, g, 4).to(device, torch.float32),
            grip.closed.expand(*lead, g).reshape(count, g).to(device, torch.bool),
        )
    except RuntimeError as error:
        raise InputError("gripper poses do not fit the state", got=f"shapes {shapes}",
                         allowed=f"leading axes {axes}") from error  # fmt: skip


def close_and_open(state: State, before: Grip, closed: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    """(held, offset) after grippers changed from `before.closed` to `closed` at the start of a period.

    A gripper that closes takes free particles within `radius` [m] of its origin; one that opens lets go.
    """
    held, offset = state.held, state.memory["grip_offset"]
    if closed.shape[1] == 0:
        return held, offset
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
