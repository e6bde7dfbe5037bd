"""What goes wrong with cameras: they die, or somebody bumps them and nobody notices."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from pred_core.errors import ConfigError, nearest
from pred_core.plant.cameras import CameraConfig
from pred_core.plant.live.mover import matrix_of, quaternion_of

Array = NDArray[np.float64]
BUMP_SHIFT = 0.005  # [m]
BUMP_TURN = float(np.deg2rad(1.0))  # [rad]


class CameraFaults:
    """Which cameras are dead, and where bumped ones really are."""

    def __init__(self, configs: Iterable[CameraConfig]):
        self._poses = {c.name: c.world_from_camera for c in configs}
        self.dead: frozenset[str] = frozenset()
        self.bumped: dict[str, Array] = {}  # world_from_camera (4, 4)

    def kill(self, names: Iterable[str]) -> None:
        """Exactly these deliver nothing from now on; none: all live. Raises: ConfigError for an unknown name."""
        self.dead = frozenset(self._checked(names))

    def bump(self, names: Iterable[str], seed: int, shift: float = BUMP_SHIFT, turn: float = BUMP_TURN) -> None:
        """Exactly these stand `shift` [m] and `turn` [rad] off, in directions drawn from the seed, and report the old
        pose. Raises: ConfigError for an unknown name."""
        self.bumped = {
            name: _moved(self._poses[name], np.random.default_rng([seed, 7, number]), shift, turn)
            for number, name in enumerate(self._poses)
            if name in self._checked(names)
        }

    def _checked(self, names: Iterable[str]) -> tuple[str, ...]:
        asked = tuple(names)
        for name in asked:
            if name not in self._poses:
                raise ConfigError(f"unknown camera '{name}'", next_step=nearest(name, self._poses))
        return asked


def _moved(pose: Array, generator: np.random.Generator, shift: float, turn: float) -> Array:
    out = pose.copy()
    direction, axis = (v / np.linalg.norm(v) for v in generator.standard_normal((2, 3)))
    out[:3, 3] += shift * direction
    out[:3, :3] = matrix_of(quaternion_of(turn * axis)) @ pose[:3, :3]
    return out
