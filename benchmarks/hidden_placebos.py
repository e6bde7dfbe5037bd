"""Six laws that nothing obeys, among the candidates: how often a diagnosis falls for one.

    python benchmarks/hidden_placebos.py diagnose DATASET --twin TWIN ...

is `pred diagnose` with them in the library of this process alone. Each acts where a real cause could, and has one
parameter, as most real causes do, so that held-out episodes alone can refuse it.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from typing import Any

from pred_core.cli.main import main
from pred_core.effects import LIBRARY
from pred_core.effects.algebra import Vec3, sin
from pred_core.effects.effect import ContactContext, Effect, Parameter, ParticleContext

PREFIX = "placebo_"


class BodyForce(Effect):
    """f = m a sin(6 pi s) d: along a direction drawn once, up and down the object's material."""

    id = "placebo_body_force"
    family = "placebo"
    hooks = ("force",)
    parameters = (Parameter("strength", "m/s^2", -10.0, 10.0, typical=0.3, doc="a"),)
    direction = (0.48, -0.6, 0.64)

    @classmethod
    def force(cls, p: Mapping[str, Any], at: ParticleContext) -> Vec3:
        size = p["strength"][0] * at.mass * sin(at.arc * (6.0 * math.pi))
        x, y, z = cls.direction
        return Vec3(size * x, size * y, size * z)


class AgingDrag(Effect):
    """f = -m b (t / 60 s) v: air that thickens while one records."""

    id = "placebo_aging_drag"
    family = "placebo"
    hooks = ("force",)
    parameters = (Parameter("rate", "1/(s min)", 0.0, 10.0, typical=0.3, doc="b, drag gained a minute"),)

    @classmethod
    def force(cls, p: Mapping[str, Any], at: ParticleContext) -> Vec3:
        return at.velocity * (-p["rate"][0] * at.mass * (at.time / 60.0))

    @classmethod
    def rate_bound(cls, p: Mapping[str, Any]) -> float:
        return float(p["rate"][0]) * 10.0


class Layers(Effect):
    """f = m a sin(2 pi z / 5 cm) along the diagonal of the table: layers of air that push to and fro."""

    id = "placebo_layers"
    family = "placebo"
    hooks = ("force",)
    parameters = (Parameter("strength", "m/s^2", -10.0, 10.0, typical=0.3, doc="a"),)

    @classmethod
    def force(cls, p: Mapping[str, Any], at: ParticleContext) -> Vec3:
        size = p["strength"][0] * at.mass * sin(at.position.z * (2.0 * math.pi / 0.05))
        return Vec3(size * 0.7071, size * 0.7071, size * 0.0)


class StripedTable(Effect):
    """mu -> mu (1 + a sin(2 pi y / 4 cm)): stripes of other friction, narrower than anything that is measured."""

    id = "placebo_stripes"
    family = "placebo"
    hooks = ("contact",)
    parameters = (Parameter("change", "1", -1.0, 3.0, typical=0.3, doc="a"),)

    @classmethod
    def contact(cls, p: Mapping[str, Any], at: ContactContext) -> tuple[Any, Any]:
        return at.friction * p["change"][0] * sin(at.position.y * (2.0 * math.pi / 0.04)), 0.0


class BeadedMass(Effect):
    """m -> m (1 + a sin(8 pi s)): beads of mass along the object."""

    id = "placebo_beads"
    family = "placebo"
    hooks = ("inertia",)
    parameters = (Parameter("change", "1", -0.9, 0.9, typical=0.3, doc="a"),)

    @classmethod
    def inertia(cls, p: Mapping[str, Any], arc: Any) -> Any:
        return p["change"][0] * sin(arc * (8.0 * math.pi))


class RibbedStiffness(Effect):
    """EI -> EI (1 + a sin(10 pi s)): ribs of stiffness along the object."""

    id = "placebo_ribs"
    family = "placebo"
    hooks = ("bend_stiffness",)
    parameters = (Parameter("change", "1", -0.9, 0.9, typical=0.3, doc="a"),)

    @classmethod
    def bend_stiffness(cls, p: Mapping[str, Any], arc: Any, time: Any) -> Any:
        return p["change"][0] * sin(arc * (10.0 * math.pi))


PLACEBOS: tuple[type[Effect], ...] = (BodyForce, AgingDrag, Layers, StripedTable, BeadedMass, RibbedStiffness)


def register() -> None:
    """Put them into the library of this process."""
    LIBRARY.update({e.id: e for e in PLACEBOS})


if __name__ == "__main__":
    register()
    sys.exit(main())
