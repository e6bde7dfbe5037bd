"""Who touched the slot: contacts of hand, arm and rope with the posts and of the hand with the table, as events."""

from __future__ import annotations

from dataclasses import dataclass, field

import mujoco
import numpy as np
from numpy.typing import NDArray

from pred_core.plant.live.mover import HAND
from pred_core.plant.live.slot import POSTS
from pred_core.plant.rope import GROUND

APART = 0.1  # [s] without contact: what comes after it is another collision
PAIRS = ("gripper on slot", "rope on slot", "gripper on table")
_POST, _TABLE, _ROPE, _HAND = 1, 2, 3, 4


@dataclass
class Touches:
    """Collisions since the reset, by pair: how many, and for how long."""

    count: dict[str, int] = field(default_factory=lambda: dict.fromkeys(PAIRS, 0))
    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(PAIRS, 0.0))


class TouchCounter:
    """Counts over the steps of one model."""

    def __init__(self, model: mujoco.MjModel, rope_geoms: NDArray[np.int64]):
        self._kind = np.zeros(model.ngeom, np.int64)
        self._kind[model.geom_contype == HAND] = _HAND
        self._kind[[model.geom(name).id for name in POSTS]] = _POST
        self._kind[model.geom(GROUND).id] = _TABLE
        self._kind[rope_geoms] = _ROPE
        self._rare = np.isin(self._kind, (_POST, _HAND))
        self._codes = {10 * _POST + _HAND: PAIRS[0], 10 * _POST + _ROPE: PAIRS[1], 10 * _TABLE + _HAND: PAIRS[2]}
        self.clear()

    def clear(self) -> None:
        """Begin anew."""
        self.touches = Touches()
        self._last: dict[str, float] = {}

    def see(self, data: mujoco.MjData, time: float, step: float) -> None:
        """Look at the contacts of the step of `step` [s] that ended at `time` [s]."""
        geoms = data.contact.geom
        if not self._rare[geoms].any():
            return
        kinds = np.sort(self._kind[geoms[data.contact.dist < 0.0]], axis=1)
        for code in np.unique(10 * kinds[:, 0] + kinds[:, 1]).tolist():
            pair = self._codes.get(code)
            if pair is None:
                continue
            if time - self._last.get(pair, -np.inf) > APART:
                self.touches.count[pair] += 1
            self._last[pair] = time
            self.touches.seconds[pair] += step
