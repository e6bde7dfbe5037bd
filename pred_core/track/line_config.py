"""What is known of a line object, and how it is followed."""

from __future__ import annotations

from dataclasses import dataclass

from pred_core.config import setting
from pred_core.track.grasp import GraspConfig
from pred_core.track.line_fit import LineFitConfig
from pred_core.track.line_start import LineStartConfig


@dataclass(frozen=True)
class LineConfig:
    """What is known of the line, and how it is followed."""

    length: float = setting(0.0, unit="m", low=0.0, high=20.0, doc="0: measured when it is found")
    radius: float = setting(0.0, unit="m", low=0.0, high=0.1, doc="0: measured when it is found")
    particles: int = setting(61, low=4, high=400, doc="nodes, evenly along the line; ids count from end 0")
    points: int = setting(600, low=50, high=20000, doc="most points used of one camera")
    acceleration: float = setting(10.0, unit="m/s^2", low=0.1, high=1000.0, doc="that the motion prior allows for")
    bridge: float = setting(0.08, unit="m", low=0.0, high=0.5, doc="longest end hidden in a gripper's jaws")
    end_in_tool: bool = setting(True, doc="a held end is in the tool centre; false: where it is seen")
    seen: float = setting(1.5, low=0.1, high=100.0, doc="points of one camera at a particle that make it visible")
    doubt: float = setting(0.96, low=0.0, high=1.0, doc="points explained less nodes contradicted; below, look anew")
    lost: float = setting(0.5, low=0.0, high=1.0, doc="share of the points on the line below which it is lost")
    patience: float = setting(0.4, unit="s", low=0.0, high=10.0, doc="how long before it is searched anew")
    tolerance: float = setting(0.15, low=0.01, high=1.0, doc="relative difference of length when it is found again")
    growing: float = setting(1.0, unit="s", low=0.0, high=60.0, doc="for how long a measured length may still grow")
    fit: LineFitConfig = LineFitConfig()
    start: LineStartConfig = LineStartConfig()
    grasp: GraspConfig = GraspConfig()
