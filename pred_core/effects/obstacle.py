"""A ball that stands where nobody told of."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pred_core.effects.algebra import Vec3, maximum, where
from pred_core.effects.effect import Effect, Parameter, ParticleContext

FREQUENCY = 200.0  # [rad/s] of a particle on the ball's surface: it sinks 5 mm in at 1 m/s
SKIN = 0.003  # [m] over which the push sets in


class Obstacle(Effect):
    """A fixed ball pushes out what is inside: f = m p n, p = max(w^2 s - 2 w v_n, 0), critically damped, no pull.

    s = depth^2 / 2 skin up to the depth of the skin, then depth - skin/2; damping sets in over the skin too. Friction
    takes mu p of what slides, and at w what is slower than mu p / w. The radius is seen from particle centres: the
    ball's own plus that of the object.
    """

    id = "obstacle"
    family = "obstacle"
    hooks = ("force",)
    parameters = (
        Parameter("radius", "m", 0.0, 0.5, typical=0.03, doc="of the ball, the object's own radius included"),
        Parameter("center", "m", -5.0, 5.0, size=3, typical=0.1, scan="solid", doc="in world"),
        Parameter("friction", "1", 0.0, 3.0, null=0.5, typical=0.3, doc="mu, coefficient of the object on the ball"),
    )
    confounded_with = ("attraction", "friction_patch", "table_height")

    @classmethod
    def force(cls, p: Mapping[str, Any], at: ParticleContext) -> Vec3:
        out = at.position - Vec3(*p["center"])
        distance = out.norm()
        normal = out * (1.0 / distance)
        depth = maximum(p["radius"][0] - distance, 0.0)
        shallow = depth < SKIN
        spring = where(shallow, depth * depth * (0.5 / SKIN), depth - 0.5 * SKIN)
        damper = where(shallow, depth * (2.0 / SKIN), 2.0)
        outward = at.velocity.dot(normal)
        push = maximum(FREQUENCY * FREQUENCY * spring - FREQUENCY * damper * outward, 0.0)
        slide, grip = at.velocity - normal * outward, p["friction"][0] * push
        return (normal * push - slide * (grip / (slide.norm() + grip / FREQUENCY))) * at.mass

    @classmethod
    def rate_bound(cls, p: Mapping[str, Any]) -> float:
        # Outwards 2 w of damping, and w that makes up for the frequency w, see `stability.py`; across, w of friction.
        return 3.0 * FREQUENCY if p["radius"][0] > 0.0 else 0.0
