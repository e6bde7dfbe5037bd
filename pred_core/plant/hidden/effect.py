"""What a hidden effect is: something done to the world that the data do not tell."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pred_core.plant.rope import RopeModel

if TYPE_CHECKING:
    from pred_core.plant.world import World

Array = NDArray[np.float64]


class HiddenEffect:
    """Base: does nothing. A subclass overrides the places where it acts, and speaks MuJoCo there.

    Every effect gets its magnitude and a generator for what else it needs (directions, places); the world draws
    motions and noise from other generators, so they are the same for every effect of a seed.
    """

    extent: float = 1.0  # times the effect's usual size in space: a range, a radius, a share of the rope

    def __init__(self, magnitude: float, generator: np.random.Generator):
        self.magnitude = magnitude
        self.generator = generator

    def build(self, rope: RopeModel) -> None:
        """Change the model before it is compiled."""

    def begin(self, world: World) -> None:
        """Change the compiled model, once an episode, before it settles."""

    def act(self, world: World) -> None:
        """Every step, between MuJoCo's position and velocity stage and its forces."""

    @property
    def delay(self) -> float:
        """How old what the tracker reports is [s]."""
        return 0.0

    def observe(self, position: Array) -> Array:
        """What the tracker reports of positions (T, P, 3) [m] world."""
        return position


Make = Callable[[float, np.random.Generator], HiddenEffect]


@dataclass(frozen=True)
class Entry:
    """One line of the table of hidden effects."""

    name: str
    family: str
    law: str
    unit: str
    minimum: float  # magnitude from which it is meant to be noticed; cases take 1, 3 or 10 times as much
    high: float  # largest magnitude that makes sense
    make: Make
    low: float = 0.0  # smallest magnitude; 0 is always "nothing hidden"
    unlisted: bool = False  # outside what a diagnosis is expected to have a name for
