"""Where an arm's base stands in `world`: the only place where adapters change frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pred_core.arm.orientation import Quaternion, conjugate, multiply
from pred_core.arm.protocol import Array


def rotate(q: Quaternion, v: Array) -> Array:
    """Rotate a vector (3,) by a unit quaternion."""
    turned = multiply(multiply(q, (0.0, float(v[0]), float(v[1]), float(v[2]))), conjugate(q))
    return np.array(turned[1:])


@dataclass(frozen=True)
class Placement:
    """world_from_base: the base's origin (3,) [m] in world and its rotation wxyz."""

    origin: Array
    rotation: Quaternion

    def to_world(self, p_base: Array, q_base: Quaternion) -> tuple[Array, Quaternion]:
        """A pose in the base frame, in world."""
        return self.origin + rotate(self.rotation, p_base), multiply(self.rotation, q_base)

    def to_base(self, p_world: Array, q_world: Quaternion) -> tuple[Array, Quaternion]:
        """A pose in world, in the base frame."""
        back = conjugate(self.rotation)
        return rotate(back, p_world - self.origin), multiply(back, q_world)

    def vector_to_base(self, v_world: Array) -> Array:
        """A direction (3,) in world, in the base frame."""
        return rotate(conjugate(self.rotation), v_world)
