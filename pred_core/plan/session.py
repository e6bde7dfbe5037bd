"""Replanning: which observation to plan from, when the plan begins, what is in force, when to stop."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pred_core.config import setting
from pred_core.errors import InputError
from pred_core.plan.curve import Curve, first_knots
from pred_core.plan.goal_cost import GoalCost
from pred_core.plan.latency import Observation, tracking_error
from pred_core.plan.plan import NS, Plan
from pred_core.plan.planner import Planner
from pred_core.types import Array


@dataclass(frozen=True)
class Timing:
    """How replanning treats time and progress."""

    budget: float = setting(0.3, unit="s", low=0.005, high=60.0, doc="for planning; the plan begins when it is over")
    margin: float = setting(0.05, unit="s", low=0.0, high=5.0, doc="beyond the budget, for the message to arrive")
    max_age: float = setting(0.5, unit="s", low=0.01, high=60.0, doc="oldest state that is planned from")
    off_track: float = setting(0.04, unit="m", low=0.001, high=1.0, doc="off the plan; the arm is not following then")
    reached: float = setting(0.0, unit="m", low=0.0, high=1.0, doc="chamfer distance that ends the task; 0: never")


@dataclass
class SessionCounts:
    """What happened so far; shown in the diagnostics."""

    plans: int = 0
    late: int = 0  # found after they should have begun; dropped
    off_track: int = 0  # plans in force given up because the arm did not follow


class Session:
    """One goal after another. `replan` is called with every observation there is time for."""

    def __init__(
        self,
        make: Callable[[Array], Planner],
        timing: Timing,
        now: Callable[[], int],
        *,
        clock: Callable[[], float] = time.monotonic,
    ):
        """make: a planner for a goal (Q, 3) [m]; now [ns]: the clock of the stamps; clock [s]: of the planner."""
        self._make, self._timing, self._now, self._clock = make, timing, now, clock
        self._planner: Planner | None = None
        self._warm = False
        self.in_force: Plan | None = None
        self.distance: float | None = None  # [m] chamfer distance of the last observation to the goal
        self.counts = SessionCounts()

    @property
    def has_goal(self) -> bool:
        """A usable goal was given."""
        return self._planner is not None

    @property
    def reached(self) -> bool:
        """The last observation was near enough to the goal."""
        return self.distance is not None and self.distance <= self._timing.reached

    def set_goal(self, points: Array) -> None:
        """Plan towards points (Q, 3) [m] world from now on. Raises: InputError; then there is no goal."""
        self._planner = self.distance = None
        self._planner = self._make(points)

    def reset(self) -> None:
        """Forget the plan in force and the last plan; the goal stays."""
        self.in_force = self.distance = None
        if self._planner is not None:
            self._planner.reset()

    def replan(self, seen: Observation) -> Plan | None:
        """The next plan; `commit` it when it is sent. None: goal reached, plan too late, or the first, slow run.

        Raises: InputError for no goal, a bad or old observation, or an unsafe plan; DivergenceError.
        """
        if self._planner is None:
            raise InputError("there is no goal", next_step="Publish goal/points")
        age = (self._now() - seen.stamp) / NS
        if not abs(age) <= self._timing.max_age:
            raise InputError("the state is too old" if age > 0 else "the state lies in the future",
                             got=f"{abs(age):.2f} s", allowed=f"{self._timing.max_age:g} s",
                             next_step="Check the predictor and the clocks")  # fmt: skip
        self.distance = self._goal_distance(seen)
        if self.reached:
            return None
        if self.in_force is not None and tracking_error(seen, self.in_force) > self._timing.off_track:
            self.counts.off_track += 1
            self.reset()
        if not self._warm:  # the first rollout compiles kernels; the second one shows how long a chunk takes
            for _ in range(2):
                self._planner.plan(seen, deadline=self._clock())
            self._planner.reset()
            self._warm = True
            return None
        begin = self._now() + round((self._timing.budget + self._timing.margin) * NS)
        deadline = self._clock() + self._timing.budget
        plan = self._planner.plan(seen, begin, in_force=self.in_force, deadline=deadline)
        if self._now() > plan.start:
            self.counts.late += 1
            return None
        return plan

    def commit(self, plan: Plan) -> None:
        """A plan was sent: it is in force now."""
        self.counts.plans += 1
        self.in_force = plan

    def stop(self) -> Plan | None:
        """The plan in force, ended as soon as it can be: within two knots after the margin. None: nothing moves."""
        force, self.in_force = self.in_force, None
        if self._planner is not None:
            self._planner.reset()
        stamp = self._now() + round(self._timing.margin * NS)
        if force is None or force.end <= stamp:
            return None
        here, spacing = force.at(stamp), force.curve.spacing
        knots = np.zeros((4, *here.velocity.shape))
        knots[:2] = first_knots(here.velocity, here.acceleration, spacing)
        curve = Curve(spacing, here.position, here.rotation, knots)
        nothing = np.zeros((0, 0, 3))
        return Plan(stamp, curve, curve, 0.0, {}, 0.0, nothing, np.zeros(0), 0, 0, 0.0, 0)

    def _goal_distance(self, seen: Observation) -> float | None:
        assert self._planner is not None
        for cost in self._planner.objective.costs:
            if isinstance(cost, GoalCost):
                return float(cost.distance(seen.state.position))
        return None
