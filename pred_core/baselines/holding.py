"""Held particles move rigidly with their gripper; what every baseline shares."""

from __future__ import annotations

import torch
from torch import Tensor

from pred_core.errors import InputError
from pred_core.frames import quaternion_conjugate, quaternion_rotate
from pred_core.types import Grip, State

OFFSET = "grip_offset"  # memory key: (..., N, 3) [m] where in its gripper a held particle sits


def attach(state: State, grip: Grip | None, **memory: Tensor) -> State:
    """`state` with the grip offset and further `memory` filled in.

    Raises: InputError if particles are held and no grip is given, or a gripper index does not exist.
    """
    if grip is None:
        if bool((state.held >= 0).any()):
            raise InputError("particles are held but no gripper pose is given", next_step="Pass the grip at the start")
        return state.replace(memory={OFFSET: torch.zeros_like(state.position), **memory})
    position, rotation, _ = _of_particles(state, grip)
    offset = quaternion_rotate(quaternion_conjugate(rotation), state.position - position)
    offset = torch.where((state.held >= 0)[..., None], offset, torch.zeros_like(offset))
    return state.replace(memory={OFFSET: offset, **memory})


def carry(state: State, grip: Grip, free_position: Tensor, period: float) -> State:
    """The next state: held particles where their gripper takes them, the others at `free_position` (..., N, 3) [m].

    A particle whose gripper is open stays where `free_position` puts it. Velocity is the difference over
    one period.
    """
    position = torch.where(_carried(state, grip)[..., None], carried_position(state, grip), free_position)
    return state.replace(position=position, velocity=(position - state.position) / period)


def carried_position(state: State, grip: Grip) -> Tensor:
    """Where the grippers take the particles, (..., N, 3) [m]; the state's own position for the free ones."""
    if grip.position.shape[-2] == 0:
        return state.position
    position, rotation, _ = _of_particles(state, grip)
    moved = position + quaternion_rotate(rotation, state.memory[OFFSET])
    return torch.where((state.held >= 0)[..., None], moved, state.position)


def _carried(state: State, grip: Grip) -> Tensor:
    if grip.position.shape[-2] == 0:
        return torch.zeros_like(state.held, dtype=torch.bool)
    return (state.held >= 0) & _of_particles(state, grip)[2]


def _of_particles(state: State, grip: Grip) -> tuple[Tensor, Tensor, Tensor]:
    """Pose and closedness of each particle's gripper: (..., N, 3), (..., N, 4), (..., N)."""
    grippers = grip.position.shape[-2]
    if int(state.held.max()) >= grippers:
        raise InputError("a particle is held by a gripper that does not exist", got=int(state.held.max()),
                         allowed=f"0 to {grippers - 1}")
    if grippers == 0:
        return (torch.zeros_like(state.position), _identity(state), torch.zeros_like(state.held, dtype=torch.bool))
    index = state.held.clamp_min(0).long()
    lead = torch.broadcast_shapes(index.shape[:-1], grip.position.shape[:-2])
    index = index.expand(*lead, index.shape[-1])
    position = grip.position.expand(*lead, grippers, 3)
    rotation = grip.rotation.expand(*lead, grippers, 4)
    closed = grip.closed.expand(*lead, grippers)
    return (
        torch.gather(position, -2, index[..., None].expand(*index.shape, 3)),
        torch.gather(rotation, -2, index[..., None].expand(*index.shape, 4)),
        torch.gather(closed, -1, index),
    )


def _identity(state: State) -> Tensor:
    return state.position.new_tensor((1.0, 0.0, 0.0, 0.0)).expand(*state.position.shape[:-1], 4)
