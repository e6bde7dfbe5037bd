"""A line that rests in an arc: it came off a spool."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from pred_core.effects.algebra import maximum, where
from pred_core.effects.effect import BendContext, Effect, Parameter
from pred_core.types import Array

TORSION = 0.77  # torsional over bending stiffness: 1/(1 + nu) of a round isotropic rod, nu = 0.3


class RestBow(Effect):
    """M = -(EI/l) r, r = l R(theta) kappa0: the bending moment vanishes at one curvature all along, not at zero.

    kappa0's two components are along the material axes. With the edge's length l, l kappa0 is the bend's unit
    2 tan(angle/2) for angles that are small from one edge to the next.

    A line with a rest curvature turns about its own axis until its arc lies as the line is bent. Its twist theta is
    quasi-static (Bergou et al. 2008, sec. 5): in equilibrium the torsional moment GJ theta' changes along the line by
    q = (EI/l) (k2 r1 - k1 r2) at each bend, is zero at a free end, and theta is zero in a gripper. theta' follows that
    by a share of each substep: a gradient step of the elastic energy, bounded by its steepest curvature.
    """

    id = "rest_bow"
    family = "rest_shape"
    version = 2
    hooks = ("bend", "rest_shape")
    parameters = (
        Parameter("curvature", "1/m", -20.0, 20.0, size=2, typical=1.0, doc="kappa0 along the two material axes"),
    )
    confounded_with = ("rest_curvature", "gripper_rotation", "gravity_offset", "bending_creep")
    bend_memory = 1  # twist over the bend [rad]
    line_values = 5  # sums up to here: turn (its cosine less 1, and sine), torque, torque at bends, steepness

    @classmethod
    def bend(cls, p: Mapping[str, Any], at: BendContext) -> tuple[Any, Any, tuple[Any, ...]]:
        first, second = cls.rest_shape(p, at)
        k1, k2 = at.curvature
        torque = at.weight * (k2 * first - k1 * second)
        aligned = at.weight * (k1 * first + k2 * second)
        _, _, before, at_bends, steepness = at.handed
        here = before + 0.5 * torque
        # The moment that the far end leaves: none at a free end; between two grippers as much as leaves no turn.
        only_first, only_last = at.first_held * (1.0 - at.last_held), at.last_held * (1.0 - at.first_held)
        level = only_first * at.arrived[2] + (1.0 - only_first - only_last) * at.arrived[3] / at.bends
        gj = TORSION * at.weight
        steepest = at.bends * at.arrived[4] / gj
        share = where(steepest > 0.0, 1.0 / (1.0 + steepest), 0.0)
        twist = at.memory[0] + share * ((level - here) / gj - at.memory[0])
        cosine, sine = _turned(1.0 + at.handed[0], at.handed[1], at.memory[0])
        cosine, sine = _turned(cosine, sine, at.memory[0])
        handed = (cosine - 1.0, sine, before + torque, at_bends + here, steepness + maximum(aligned, -aligned))
        return -(at.weight * first), -(at.weight * second), (twist, *handed)

    @classmethod
    def rest_shape(cls, p: Mapping[str, Any], at: BendContext) -> tuple[Any, Any]:
        cosine, sine = _turned(1.0 + at.handed[0], at.handed[1], at.memory[0])
        # Held at its last edge only, a line is turned there by nothing, and at its first by what it is back.
        back = at.last_held * (1.0 - at.first_held)
        c0, s0 = 1.0 + back * at.arrived[0], -(back * at.arrived[1])
        cosine, sine = c0 * cosine - s0 * sine, s0 * cosine + c0 * sine
        first, second = at.length * p["curvature"][0], at.length * p["curvature"][1]
        return cosine * first - sine * second, sine * first + cosine * second

    @classmethod
    def bend_bound(cls, p: Mapping[str, Any], length: Array) -> tuple[float, float]:
        k = math.hypot(*p["curvature"]) * float(length.max(initial=0.0))
        return max(0.5 * k, (1.0 + 0.25 * k * k) ** 2 / 8.0 - 1.0), 0.0  # as in `RestCurvature`


def _turned(cosine: Any, sine: Any, twist: Any) -> tuple[Any, Any]:
    """(cosine, sine) turned by half of a bend's twist: exactly a rotation, its angle to 0.2 % up to 0.6 rad."""
    t = 0.25 * twist
    d = 1.0 / (1.0 + t * t)
    c, s = (1.0 - t * t) * d, 2.0 * t * d
    return cosine * c - sine * s, sine * c + cosine * s
