"""Signed distances to fixtures, batched, on any device; negative inside."""

from __future__ import annotations

import torch
from torch import Tensor

from pred_core.frames import quaternion_normalize, quaternion_to_matrix
from pred_core.types import Box, Fixture, Sphere


def distance_to(fixture: Fixture, points: Tensor) -> Tensor:
    """Signed distance (...) [m] of points (..., 3) [m] world to the surface of a fixture."""
    if isinstance(fixture, Box):
        world_from_box = quaternion_to_matrix(quaternion_normalize(points.new_tensor(fixture.rotation)))
        local = (points - points.new_tensor(fixture.center)) @ world_from_box
        beyond = local.abs() - points.new_tensor(fixture.half_size)
        return beyond.clamp_min(0.0).norm(dim=-1) + beyond.amax(-1).clamp_max(0.0)
    ends = (fixture.center, fixture.center) if isinstance(fixture, Sphere) else (fixture.start, fixture.end)
    begin, way = points.new_tensor(ends[0]), points.new_tensor(ends[1]) - points.new_tensor(ends[0])
    share = ((points - begin) @ way / way.square().sum().clamp_min(1e-12)).clamp(0.0, 1.0)
    return (points - begin - share[..., None] * way).norm(dim=-1) - fixture.radius


def depth_in(fixtures: tuple[Fixture, ...], points: Tensor, keep: float | Tensor) -> Tensor:
    """(...) [m] how far points (..., 3) are inside the surfaces `keep` (...) [m] around fixtures; 0 outside all."""
    deepest = points.new_zeros(points.shape[:-1])
    for fixture in fixtures:
        deepest = torch.maximum(deepest, keep - distance_to(fixture, points))
    return deepest
