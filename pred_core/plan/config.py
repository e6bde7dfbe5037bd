"""Settings of the planner: the motion, the search, the weights of the costs. Frozen, with unit and range."""

from __future__ import annotations

import math
from dataclasses import dataclass

from pred_core.config import setting
from pred_core.plan.slot import Slot


@dataclass(frozen=True)
class MotionConfig:
    """What a planned gripper motion may look like. The limits hold for every sample, not only for the plan."""

    horizon: float = setting(2.0, unit="s", low=0.1, high=30.0, doc="length of a plan; it ends at rest")
    knots: int = setting(8, low=3, high=200, doc="spline segments over the horizon")
    speed: float = setting(0.2, unit="m/s", low=0.001, high=5.0, doc="largest speed of a gripper")
    acceleration: float = setting(1.6, unit="m/s^2", low=0.01, high=100.0, doc="largest acceleration of a gripper")
    turn_speed: float = setting(0.8, unit="rad/s", low=0.0, high=10.0, doc="largest yaw rate; 0: it never turns")
    turn_acceleration: float = setting(6.4, unit="rad/s^2", low=0.01, high=500.0, doc="largest yaw acceleration")
    x_low: float = setting(0.22, unit="m", low=-3.0, high=3.0, doc="workspace box of the gripper, in world")
    x_high: float = setting(0.68, unit="m", low=-3.0, high=3.0, doc="workspace box")
    y_low: float = setting(-0.38, unit="m", low=-3.0, high=3.0, doc="workspace box")
    y_high: float = setting(0.38, unit="m", low=-3.0, high=3.0, doc="workspace box")
    z_low: float = setting(0.03, unit="m", low=-3.0, high=3.0, doc="workspace box")
    z_high: float = setting(0.58, unit="m", low=-3.0, high=3.0, doc="workspace box")


@dataclass(frozen=True)
class SearchConfig:
    """MPPI: how many samples, how wide, how sharply the good ones are preferred."""

    samples: int = setting(64, low=2, high=65536, doc="motions tried an iteration")
    iterations: int = setting(8, low=1, high=10_000, doc="most iterations a plan; a deadline may end it earlier")
    temperature: float = setting(0.1, unit="", low=1e-3, high=100.0, doc="in units of median less least cost")
    noise: float = setting(0.12, unit="m/s", low=0.0, high=5.0, doc="standard deviation of a knot's velocity")
    turn_noise: float = setting(1.0, unit="rad/s", low=0.0, high=10.0, doc="standard deviation of a knot's yaw rate")
    correlation: float = setting(0.7, unit="", low=0.0, high=0.99, doc="of the noise of neighbouring knots")
    finest: float = setting(0.25, unit="", low=0.01, high=1.0, doc="noise of the last sample over that of the first")
    shrink: float = setting(0.85, unit="", low=0.1, high=1.0, doc="noise of an iteration over that of the one before")
    ways: float = setting(0.0, unit="", low=0.0, high=0.9, doc="share of samples that lead to the goal (ways.py)")
    chunk: int = setting(32, low=1, high=65536, doc="samples a rollout call; the deadline is looked at in between")
    frames: int = setting(8, low=1, high=1000, doc="moments of a rollout the costs look at, the last one included")


@dataclass(frozen=True)
class CostConfig:
    """Weights of the costs [1 / unit of the cost] and what they need to know. A weight of 0 leaves a cost out."""

    goal: float = setting(1.0, unit="1/m", low=0.0, high=1e6, doc="two-sided chamfer distance to the goal, on the way")
    goal_end: float = setting(2.0, unit="1/m", low=0.0, high=1e6, doc="the same at the end of the plan")
    collision: float = setting(4.0, unit="1/m", low=0.0, high=1e6, doc="depth in fixtures and the table")
    hit: float = setting(5.0, unit="", low=0.0, high=1e6, doc="share of the time in which a hand touches a fixture")
    smoothness: float = setting(0.002, unit="s^2/m", low=0.0, high=1e6, doc="root mean square acceleration")
    workspace: float = setting(10.0, unit="1/m", low=0.0, high=1e6, doc="way of the gripper out of its box")
    stretch: float = setting(1.0, unit="", low=0.0, high=1e6, doc="strain beyond max_strain")
    passage: float = setting(0.0, unit="1/m", low=0.0, high=1e6, doc="of a line that crosses a slot beside its gap")
    through: float = setting(0.0, unit="", low=0.0, high=1e6, doc="of a line not through a slot as its goal is")
    max_strain: float = setting(0.05, unit="", low=0.0, high=10.0, doc="strain of a spring that costs nothing")
    margin: float = setting(0.003, unit="m", low=0.0, high=0.2, doc="the object keeps this far from fixtures")
    hand_margin: float = setting(0.003, unit="m", low=0.0, high=0.2, doc="hands keep this far from fixtures")
    finger_radius: float = setting(0.013, unit="m", low=0.0, high=0.3, doc="of the gripper's fingers, a capsule")
    finger_length: float = setting(0.065, unit="m", low=0.0, high=1.0, doc="of that capsule, up from the tool centre")
    palm_radius: float = setting(0.05, unit="m", low=0.0, high=0.5, doc="of a second capsule above; 0: none")
    palm_length: float = setting(0.1, unit="m", low=0.0, high=1.0, doc="of that capsule, with its round ends")


@dataclass(frozen=True)
class PlannerConfig:
    """Everything the planner needs beside a twin, a goal and a state."""

    motion: MotionConfig = MotionConfig()
    search: SearchConfig = SearchConfig()
    costs: CostConfig = CostConfig()
    slot: Slot | None = setting(None, doc="a slot that stands in the scene; null: none")
    send: float = setting(1.0, unit="s", low=0.05, high=30.0, doc="part of a plan that is carried out before it stops")
    jump: float = setting(0.02, unit="m", low=0.0, high=0.5, doc="farthest a plan may begin from where the arm will be")
    turn_jump: float = setting(0.15, unit="rad", low=0.0, high=math.pi, doc="the same, turned")
