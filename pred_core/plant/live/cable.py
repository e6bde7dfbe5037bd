"""Cables of the stand-in world: drawn from a generator, within ranges of real ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pred_core.config import setting
from pred_core.plant.rope import RopeConfig


@dataclass(frozen=True)
class CableFamily:
    """Half widths of the draws around the nominal rope; all 0 gives the nominal rope."""

    length: float = setting(0.1, low=0.0, high=0.5, doc="share by which the length varies")
    mass: float = setting(0.3, low=0.0, high=0.9, doc="share by which the mass per metre varies")
    bending: float = setting(0.7, low=0.0, high=3.0, doc="natural log of the factor by which EI varies")
    friction: float = setting(0.15, low=0.0, high=0.5, doc="by which the Coulomb coefficient varies")


NOMINAL = RopeConfig(clamped=1)


def draw_cable(generator: np.random.Generator, family: CableFamily | None = None) -> RopeConfig:
    """A cable. Link length, and with it the time step that is stable, stay near those of the nominal rope."""
    family = family or CableFamily()
    u = generator.uniform(-1.0, 1.0, 4)
    longer = 1.0 + family.length * float(u[0])
    return RopeConfig(
        length=NOMINAL.length * longer,
        mass=NOMINAL.mass * longer * (1.0 + family.mass * float(u[1])),
        links=round(NOMINAL.links * longer),
        clamped=NOMINAL.clamped,
        radius=NOMINAL.radius,
        bending=NOMINAL.bending * float(np.exp(family.bending * u[2])),
        damping=NOMINAL.damping,
        armature=NOMINAL.armature,
        friction=NOMINAL.friction + family.friction * float(u[3]),
    )
