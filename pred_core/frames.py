"""Rotations and rigid transforms. Quaternions are wxyz; `a_from_b` maps coordinates in b to a."""

from __future__ import annotations

import torch
from torch import Tensor


def quaternion_normalize(q: Tensor) -> Tensor:
    """Unit quaternion, (..., 4) wxyz."""
    return q / q.norm(dim=-1, keepdim=True)


def quaternion_multiply(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton product a*b: rotate by b, then by a. (..., 4) wxyz."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        (
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ),
        dim=-1,
    )


def quaternion_conjugate(q: Tensor) -> Tensor:
    """Inverse of a unit quaternion, (..., 4) wxyz."""
    return q * q.new_tensor((1.0, -1.0, -1.0, -1.0))


def quaternion_rotate(q: Tensor, v: Tensor) -> Tensor:
    """Rotate vectors v (..., 3) by unit quaternions q (..., 4) wxyz; leading axes broadcast."""
    w, u = q[..., :1], q[..., 1:]
    u, v = torch.broadcast_tensors(u, v)
    t = 2.0 * torch.linalg.cross(u, v)
    return v + w * t + torch.linalg.cross(u, t)


def quaternion_from_rotation_vector(r: Tensor) -> Tensor:
    """Exponential map: rotation vector (..., 3) [rad] to unit quaternion (..., 4) wxyz."""
    angle = r.norm(dim=-1, keepdim=True)
    half = 0.5 * angle
    # sin(a/2)/a, with its limit 1/2 at a = 0.
    scale = torch.where(angle > 1e-8, torch.sin(half) / angle.clamp_min(1e-8), torch.full_like(angle, 0.5))
    return torch.cat((torch.cos(half), scale * r), dim=-1)


def quaternion_to_matrix(q: Tensor) -> Tensor:
    """Rotation matrix (..., 3, 3) of a unit quaternion (..., 4) wxyz."""
    eye = torch.eye(3, dtype=q.dtype, device=q.device)
    columns = [quaternion_rotate(q, eye[i].expand(*q.shape[:-1], 3)) for i in range(3)]
    return torch.stack(columns, dim=-1)


def rotation_about_z(angle: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) about world z by angle (...) [rad]."""
    c, s = torch.cos(angle), torch.sin(angle)
    zero, one = torch.zeros_like(c), torch.ones_like(c)
    rows = torch.stack((c, -s, zero, s, c, zero, zero, zero, one), dim=-1)
    return rows.reshape(*angle.shape, 3, 3)


def quaternion_to_rotation_vector(q: Tensor) -> Tensor:
    """Logarithm: unit quaternion (..., 4) wxyz to the rotation vector (..., 3) [rad] of at most pi."""
    q = torch.where(q[..., :1] < 0.0, -q, q)
    sine = q[..., 1:].norm(dim=-1, keepdim=True)
    angle = 2.0 * torch.atan2(sine, q[..., :1])
    # a / sin(a/2), with its limit 2 at a = 0.
    return q[..., 1:] * torch.where(sine > 1e-8, angle / sine.clamp_min(1e-8), torch.full_like(sine, 2.0))


def quaternion_slerp(a: Tensor, b: Tensor, weight: Tensor) -> Tensor:
    """Unit quaternions between a (weight 0) and b (weight 1), (..., 4) wxyz, the short way round. weight (...)."""
    turn = quaternion_to_rotation_vector(quaternion_multiply(quaternion_conjugate(a), b))
    return quaternion_multiply(a, quaternion_from_rotation_vector(weight.unsqueeze(-1) * turn))
