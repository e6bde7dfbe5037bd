"""Spring-mass simulator: the physics backbone."""

from pred_core.springmass.simulator import SpringMass
from pred_core.springmass.topology import build_body

__all__ = ["SpringMass", "build_body"]
