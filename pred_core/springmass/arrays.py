"""The static arrays of the kernel's `Model`, built once from Body and Scene."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from torch import Tensor

from pred_core.effects.effect import Effect
from pred_core.errors import TwinError
from pred_core.frames import quaternion_normalize, quaternion_to_matrix
from pred_core.springmass import kernel
from pred_core.springmass.topology import bend_lengths
from pred_core.twin import Extension
from pred_core.types import Array, Body, Box, Capsule, Fixture, Scene, Sphere

_SHAPES: dict[type, int] = {Sphere: 0, Capsule: 1, Box: 2}


@dataclass(frozen=True)
class ModelArrays:
    """Warp arrays that live as long as the simulator, and the scalars beside them."""

    arrays: dict[str, Any]
    scalars: dict[str, Any]

    @staticmethod
    def of(body: Body, scene: Scene, device: str) -> ModelArrays:
        """Everything of `Model` that does not change from call to call."""
        shapes = np.array([_SHAPES[type(f)] for f in scene.fixtures], dtype=np.int32)
        fixtures = np.array([fixture_row(f) for f in scene.fixtures], dtype=np.float64).reshape(-1, 16)
        floats: dict[str, Array] = {
            "spring_data": spring_rows(body),
            "bend_data": bend_rows(body),
            "particle_data": np.stack((body.friction_scale, body.arc), axis=1),
            "fixture_data": fixtures,
        }
        lines = chains(body)
        integers: dict[str, NDArray[np.int32]] = {
            "springs": body.springs,
            "bends": body.bends,
            "chains": lines,
            "fixture_shape": shapes,
        }
        arrays: dict[str, Any]
        arrays = {k: wp.array(v.astype(np.float32).ravel(), dtype=wp.float32, device=device) for k, v in floats.items()}
        arrays |= {k: wp.array(v.astype(np.int32).ravel(), dtype=wp.int32, device=device) for k, v in integers.items()}
        gx, gy, gz = scene.gravity
        scalars = {
            "particles": body.count,
            "spring_count": len(body.springs),
            "bend_count": len(body.bends),
            "fixture_count": len(shapes),
            "chain_count": len(lines),
            "has_ground": int(scene.ground is not None),
            "ground": scene.ground or 0.0,
            "gravity_x": gx,
            "gravity_y": gy,
            "gravity_z": gz,
            "radius": body.radius,
            "pusher_radius": scene.pusher_radius,
            "contact_distance": 2.0 * body.radius,
        }
        return ModelArrays(arrays, scalars)

    def model(self) -> Any:
        """A fresh `Model` struct with these values; the caller fills in what belongs to one call."""
        model = kernel.Model()
        for name, value in (*self.arrays.items(), *self.scalars.items()):
            setattr(model, name, value)
        return model


def spring_rows(body: Body) -> Array:
    """(5, S): 1/l0, l0, stiffness scale, damping scale, arc of the middle."""
    arc = body.arc[body.springs].mean(axis=1)
    return np.stack((1.0 / body.rest_length, body.rest_length, body.stiffness_scale, body.damping_scale, arc))


def bend_rows(body: Body) -> Array:
    """(B, 4): scale/lbar, lbar [m] (half of the two edges), arc, share of its line's twist."""
    if len(body.bends) == 0:
        return np.zeros((0, 4))
    lbar = bend_lengths(body)
    share = np.concatenate([lbar[a:b] / lbar[a:b].sum() for a, b in chains(body)])
    return np.stack((body.bend_scale / lbar, lbar, body.arc[body.bends[:, 1]], share), axis=1)


def chains(body: Body) -> NDArray[np.int32]:
    """(K, 2) first bend and one past the last of each line: runs of bends that continue each other."""
    if len(body.bends) == 0:
        return np.zeros((0, 2), dtype=np.int32)
    continues = (body.bends[1:, :2] == body.bends[:-1, 1:]).all(axis=1)
    edges = np.concatenate(([0], np.flatnonzero(~continues) + 1, [len(body.bends)]))
    return np.stack((edges[:-1], edges[1:]), axis=1).astype(np.int32)


def line_ends(body: Body) -> NDArray[np.int64]:
    """(2K, 2) both ends of each line: the last particle and the one next to it."""
    bends = np.asarray(body.bends, dtype=np.int64).reshape(-1, 3)
    lines = chains(body)
    return np.concatenate((bends[lines[:, 0], :2], bends[lines[:, 1] - 1, :0:-1]))


def fixture_row(fixture: Fixture) -> list[float]:
    """16 numbers as `source.CONTACT` reads them."""
    if isinstance(fixture, Sphere):
        row = [*fixture.center, *fixture.center, fixture.radius]
    elif isinstance(fixture, Capsule):
        row = [*fixture.start, *fixture.end, fixture.radius]
    else:
        world_from_box = quaternion_to_matrix(quaternion_normalize(torch.tensor(fixture.rotation, dtype=torch.float64)))
        row = [*fixture.center, *fixture.half_size, *world_from_box.T.flatten().tolist()]
    return row + [0.0] * (16 - len(row))


def mass_of_worlds(body: Body, per_world: list[tuple[Extension, ...]], effects: tuple[type[Effect], ...]) -> Tensor:
    """(W, N) [kg]: the body's masses with every `inertia` hook applied.

    Raises: TwinError if a mass is not positive.
    """
    arc = torch.as_tensor(body.arc)
    rows = []
    for extensions in per_world:
        factor = torch.ones_like(arc)
        for effect, extension in zip(effects, extensions, strict=True):
            if "inertia" in effect.hooks:
                factor = factor + effect.inertia(extension.parameters, arc)
        if bool((factor <= 0.0).any()):
            ids = ", ".join(e.id for e in effects if "inertia" in e.hooks)
            raise TwinError(f"effect '{ids}' makes a particle's mass negative", got=f"factor {float(factor.min()):.3g}",
                            allowed="above 0")  # fmt: skip
        rows.append(torch.as_tensor(body.mass) * factor)
    return torch.stack(rows).to(torch.float32)
