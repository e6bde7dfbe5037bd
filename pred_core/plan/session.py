"""Replanning: which observation to plan from, when the plan begins, what is in force, when to stop."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pred_core.config import setting
from pred_core.errors import InputError
from pred_core.plan.course import Course
from pred_core.plan.curve import Curve, first_knots
from pred_core.plan.goal_cost import GoalCost
from pred_core.plan.latency import Observation, tracking_error
from pred_core.plan.plan import NS, Plan
from pred_core.plan.planner import Planner
from pred_core.plan.start import check_start
from pred_core.types import Array

STILL = 1e-3  # [m] grippers that stay within this
RESTED = 0.1  # [s] for so long are at rest


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
    fresh: int = 0  # of these, begun at the measured pose at rest; the others continue what was sent before
    late: int = 0  # found after they should have begun; dropped
    off_track: int = 0  # times the plans in force were given up because the arm did not follow
    moving: int = 0  # observations not planned from: after giving up, the arm has to rest first


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
        self._course = Course()
        self._still: Observation | None = None  # since when the grippers have not moved
        self._must_rest = False  # what the arm does is not known
        self.off = 0.0  # [m] the arm was off its plan when it was last given up
        self.distance: float | None = None  # [m] chamfer distance of the last observation to the goal
        self.counts = SessionCounts()

    @property
    def has_goal(self) -> bool:
        """A usable goal was given."""
        return self._planner is not None

    @property
    def in_force(self) -> Plan | None:
        """The newest plan that was sent; the next one continues it."""
        return self._course.newest

    @property
    def waiting(self) -> bool:
        """Plans were given up and the arm still moves: where it will be is not known."""
        return self._must_rest

    @property
    def reached(self) -> bool:
        """The last observation was near enough to the goal."""
        return self.distance is not None and self.distance <= self._timing.reached

    def set_goal(self, points: Array) -> None:
        """Plan towards points (Q, 3) [m] world from now on. Raises: InputError; then there is no goal."""
        self.clear_goal()
        self._planner = self._make(points)

    def clear_goal(self) -> None:
        """Plan no more until there is another goal."""
        self._planner = self.distance = None

    def reset(self) -> None:
        """Forget the plans in force and the last plan; the goal stays. An arm under way must come to rest first."""
        self.distance = None
        self._give_up()

    def replan(self, seen: Observation) -> Plan | None:
        """The next plan; `commit` it when it is sent. It continues what was sent before; after that was given up, or at
        first, it begins at the measured pose at rest. None: goal reached, the arm must rest first, plan too late, or
        the first, slow run.

        Raises: InputError for no goal, a bad or old observation, a start out of reach (start.py), or an unsafe plan;
        DivergenceError.
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
        self._check_arm(seen)
        check_start(seen, self._planner.config.motion)
        if self._must_rest:
            self.counts.moving += 1
            return None
        if not self._warm:  # the first rollout compiles kernels; the second one shows how long a chunk takes
            for _ in range(2):
                self._planner.plan(seen, deadline=self._clock())
            self._planner.reset()
            self._warm = True
            return None
        begin = self._now() + round((self._timing.budget + self._timing.margin) * NS)
        deadline = self._clock() + self._timing.budget
        force = None if self.in_force is None else self._course
        plan = self._planner.plan(seen, begin, in_force=force, deadline=deadline)
        if self._now() > plan.start:
            self.counts.late += 1
            return None
        return plan

    def commit(self, plan: Plan) -> None:
        """A plan was sent: it is in force from its start on."""
        self.counts.plans += 1
        self.counts.fresh += self.in_force is None
        self._course.add(plan, self._now() - round(self._timing.max_age * NS))

    def stop(self) -> Plan | None:
        """What is carried out, ended as soon as it can be: within two knots after the margin. None: nothing moves."""
        force, stamp = self.in_force, self._now() + round(self._timing.margin * NS)
        if force is None or force.end <= stamp:
            self._give_up()
            return None
        here, spacing = self._course.at(stamp), force.curve.spacing
        self._give_up()
        knots = np.zeros((4, *here.velocity.shape))
        knots[:2] = first_knots(here.velocity, here.acceleration, spacing)
        curve = Curve(spacing, here.position, here.rotation, knots)
        nothing = np.zeros((0, 0, 3))
        return Plan(stamp, curve, curve, 0.0, {}, 0.0, nothing, np.zeros(0), 0, 0, 0.0, 0)

    def _give_up(self) -> None:
        """No plan is in force; where an arm that had one will be is not known until it rests."""
        self._must_rest |= self.in_force is not None
        self._course.clear()
        self._still = None
        if self._planner is not None:
            self._planner.reset()

    def _check_arm(self, seen: Observation) -> None:
        """Give up what the arm does not follow; notice when it rests."""
        if self.in_force is not None:
            off = tracking_error(seen, self._course)
            if off > self._timing.off_track:
                self.counts.off_track += 1
                self.off = off
                self._give_up()
        if self._must_rest:
            if self._still is None or _moved(seen, self._still):
                self._still = seen
            self._must_rest = (seen.stamp - self._still.stamp) / NS < RESTED

    def _goal_distance(self, seen: Observation) -> float | None:
        assert self._planner is not None
        for cost in self._planner.objective.costs:
            if isinstance(cost, GoalCost):
                return float(cost.distance(seen.state.position))
        return None


def _moved(now: Observation, before: Observation) -> bool:
    """True if a gripper is elsewhere than before; turns alone matter little, a plan begins at the turn measured."""
    if now.position.shape != before.position.shape:
        return True
    return bool(np.linalg.norm(now.position - before.position, axis=-1).max() > STILL)
