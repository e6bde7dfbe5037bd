"""A planner for one twin and one goal: what the command line and the node both build."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from pred_core.config import load_config
from pred_core.dynamics import Dynamics
from pred_core.errors import ConfigError
from pred_core.plan.collision_cost import CollisionCost, Hand
from pred_core.plan.config import PlannerConfig
from pred_core.plan.costs import Cost, Objective
from pred_core.plan.goal import check_goal
from pred_core.plan.goal_cost import GoalCost
from pred_core.plan.motion_costs import SmoothnessCost, WorkspaceCost
from pred_core.plan.passage_cost import PassageCost
from pred_core.plan.planner import Planner, Watch
from pred_core.plan.stretch_cost import StretchCost
from pred_core.plan.through_cost import ThroughCost
from pred_core.pred import with_residual
from pred_core.springmass import SpringMass
from pred_core.twin import Twin
from pred_core.types import Array, Body, Scene


def scene_with_slot(scene: Scene, config: PlannerConfig) -> Scene:
    """The scene, with the posts of the configured slot."""
    if config.slot is None:
        return scene
    return dataclasses.replace(scene, fixtures=scene.fixtures + config.slot.posts())


def planning_dynamics(twin: Twin, scene: Scene, device: str = "cpu") -> Dynamics:
    """What the twin predicts with in a scene; a world that diverges becomes NaN and does not stop the others."""
    base = SpringMass(
        twin.body,
        twin.physics,
        scene,
        period=twin.meta.period,
        substeps=twin.meta.substeps,
        extensions=twin.extensions,
        device=device,
        diverged_as_nan=True,
    )
    return with_residual(base, twin, device)


def workspace(config: PlannerConfig) -> tuple[Array, Array]:
    """Corners (3,), (3,) [m] world of the box that grippers stay in."""
    m = config.motion
    return np.array([m.x_low, m.y_low, m.z_low]), np.array([m.x_high, m.y_high, m.z_high])


def make_objective(body: Body, scene: Scene, goal: Array, config: PlannerConfig) -> Objective:
    """Every cost whose weight is not 0. `scene`: with its slot. goal (Q, 3) [m] world.

    Raises: InputError for an unusable goal (goal.py); ConfigError for a cost of the slot without one.
    """
    c = config.costs
    low, high = workspace(config)
    points = check_goal(goal, body, scene, low, high)
    seen = None if bool(body.surface.all()) else np.flatnonzero(body.surface).astype(np.int64)
    costs: list[Cost] = []
    if c.goal > 0.0 or c.goal_end > 0.0:
        costs.append(GoalCost(points, seen, c.goal, c.goal_end))
    if c.collision > 0.0:
        hand = Hand(c.finger_radius, c.finger_length, c.palm_radius, c.palm_length)
        costs.append(CollisionCost(scene, body, hand, c.collision, c.margin, hit=c.hit, hand_margin=c.hand_margin))
    if c.smoothness > 0.0:
        costs.append(SmoothnessCost(c.smoothness))
    if c.workspace > 0.0:
        costs.append(WorkspaceCost(low, high, c.workspace))
    if c.stretch > 0.0:
        costs.append(StretchCost(body, c.stretch, c.max_strain))
    for name, weight in (("passage", c.passage), ("through", c.through)):
        if weight > 0.0 and config.slot is None:
            raise ConfigError(f"costs.{name} needs a slot", got="slot: null", next_step="Give 'slot' or weight 0")
    if c.passage > 0.0 and config.slot is not None:
        costs.append(PassageCost(config.slot, body, c.passage))
    if c.through > 0.0 and config.slot is not None:
        costs.append(ThroughCost(config.slot, body, points, c.through))
    return Objective(costs)


def make_planner(
    twin: Twin,
    goal: Array,
    config: PlannerConfig,
    seed: int,
    *,
    device: str = "cpu",
    dynamics: Dynamics | None = None,
    clock: Callable[[], float] = time.monotonic,
    watch: Watch | None = None,
) -> Planner:
    """A planner that moves the twin's object to a goal (Q, 3) [m]. `dynamics`: instead of the twin's own."""
    scene = scene_with_slot(twin.scene, config)
    objective = make_objective(twin.body, scene, goal, config)
    chosen = planning_dynamics(twin, scene, device) if dynamics is None else dynamics
    generator = np.random.default_rng(seed)
    return Planner(chosen, objective, config, generator, clock=clock, watch=watch, goal=np.asarray(goal, float))


def load_settings(path: str) -> PlannerConfig:
    """The settings of a YAML file; '' = the defaults. Raises: ConfigError."""
    return PlannerConfig() if not path else load_config(PlannerConfig, Path(path))


def with_gap(settings: PlannerConfig, gap: float) -> PlannerConfig:
    """The settings with another gap [m] of their slot. Raises: ConfigError if they have no slot."""
    if settings.slot is None:
        raise ConfigError("the planner's settings have no slot", next_step="Use config/plan/slot.yaml")
    return dataclasses.replace(settings, slot=dataclasses.replace(settings.slot, gap=gap))
