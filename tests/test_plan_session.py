"""Replanning faster than plans begin: joins, tracking, stops and lost plans, with the arm's own follower as the arm."""

from __future__ import annotations

import numpy as np
import pytest
from plan_cases import DOWN, HOME, Rigid, line_points, seen, settings

from pred_core.arm.follower import Follower, make_plan
from pred_core.arm.limits import GuardConfig
from pred_core.plan.costs import Objective
from pred_core.plan.course import Course
from pred_core.plan.goal_cost import GoalCost
from pred_core.plan.latency import Observation
from pred_core.plan.plan import NS, Plan
from pred_core.plan.planner import Planner
from pred_core.plan.session import Session, Timing

MOVE = np.array([0.3, -0.1, 0.1])  # [m]
TICK = 40_000_000  # [ns] planning takes: a sixth of the time until a plan begins
TIMING = Timing(budget=0.2, margin=0.05)
GUARD = GuardConfig(speed=0.5, x_low=-0.5, z_high=1.0)
# A point every 20 ms, straight in between: off a curve of 4 m/s^2 by a dt^2 / 8 = 0.2 mm.
JOIN = 5e-4  # [m]


class Cell:
    """A session, and an arm that follows exactly the plans that reach it."""

    def __init__(self) -> None:
        self.now = 10**9
        self.session = Session(self._planner, TIMING, lambda: self.now, clock=lambda: 0.0)
        self.session.set_goal(line_points() + MOVE)
        self.follower = Follower(GUARD, lifetime=5.0)
        self.here = HOME[0].copy()
        self.arrives = True  # plans reach the arm
        self.sent: list[Plan] = []
        self.joins: list[float] = []  # [m] from where the arm would have been to where a plan begins

    @staticmethod
    def _planner(goal: np.ndarray) -> Planner:
        search = settings(samples=24, iterations=6)
        return Planner(Rigid(), Objective([GoalCost(goal, None, 1.0, 2.0)]), search, np.random.default_rng(0))

    def observe(self) -> Observation:
        """The line in the gripper, 10 ms ago."""
        self.here = self.place(self.now - 10_000_000)
        shift = self.here - HOME[0]
        return seen(self.now - 10_000_000, tuple(shift))

    def place(self, stamp: int) -> np.ndarray:
        told = self.follower.target(stamp, 0.0)
        return self.here if told is None else told[0]

    def turn(self) -> Plan | None:
        """Observe, plan, and send what was found to the arm."""
        found = self.session.replan(self.observe())
        self.now += TICK
        if found is not None:
            self.session.commit(found)
            self.send(found)
        return found

    def send(self, plan: Plan) -> None:
        """As planner and arm node do it. Raises: InputError for a plan the arm refuses."""
        self.sent.append(plan)
        if not self.arrives:
            return
        times, position, rotation = plan.points(0.02)
        message = make_plan(plan.start, "world", times.tolist(), position[:, 0], rotation[:, 0], GUARD)
        self.follower.accept(message, (self.here, tuple(DOWN[0])), self.now)


@pytest.fixture
def cell() -> Cell:
    return Cell()


def test_plans_sent_faster_than_they_begin_are_all_accepted_and_the_arm_is_on_them(cell: Cell) -> None:
    for _ in range(60):
        cell.turn()
    counts = cell.session.counts
    assert counts.plans >= 50 and counts.fresh == 1 and counts.off_track == counts.late == counts.moving == 0
    # A plan is sent every 40 ms and begins 0.21 s later: about five wait at any time.
    assert max(a.start - b.start for a, b in zip(cell.sent[1:], cell.sent[:-1], strict=True)) < 0.1 * NS
    course = Course()
    course.add(cell.sent[0], 0)
    for plan in cell.sent[1:]:
        told = course.at(plan.start)
        assert plan.at(plan.start).position == pytest.approx(told.position, abs=1e-9)
        assert plan.at(plan.start).velocity == pytest.approx(told.velocity, abs=1e-9)
        course.add(plan, 0)
    assert np.linalg.norm(cell.here - HOME[0] - MOVE) < 0.05  # of 0.33 m; the noise of the search is in the rest


def test_a_stop_while_plans_wait_begins_where_the_arm_is_by_then(cell: Cell) -> None:
    while cell.session.counts.plans < 12:
        cell.turn()
    fast = cell.session.stop()
    assert fast is not None and cell.session.in_force is None
    # The plans that wait begin up to 0.2 s later: the stop is on the one before them.
    assert fast.start < cell.sent[-1].start
    cell.send(fast)
    expected = cell.place(fast.start - 1)  # before it begins, on the plan before
    assert np.linalg.norm(fast.at(fast.start).position[0] - expected) < JOIN
    assert np.linalg.norm(fast.at(fast.start).velocity[0, :3]) > 0.1  # it was on its way
    at_rest = cell.place(fast.end)
    assert cell.place(fast.end + 10**9) == pytest.approx(at_rest, abs=1e-9)  # nothing that waited moves it again


def test_lost_plans_are_noticed_and_planning_goes_on_once_the_arm_rests(cell: Cell) -> None:
    while cell.session.counts.plans < 8:
        cell.turn()
    cell.arrives = False
    while not cell.session.waiting:
        cell.turn()
    counts = cell.session.counts
    assert counts.off_track == 1 and 0.04 < cell.session.off < 0.1
    cell.arrives = True
    found = None
    places = [cell.here]
    while found is None:
        found = cell.turn()  # sends what is found: the arm accepts it
        places.append(cell.here)
    assert counts.fresh == 2 and counts.moving > 0
    # It rested within 1 mm for 0.1 s before, and the plan begins there at rest.
    assert np.linalg.norm(places[-1] - places[-3]) < 1e-3
    assert found.at(found.start).position[0] == pytest.approx(cell.here, abs=1e-9)
    assert not found.curve.velocity(np.zeros(1)).any()
    for _ in range(60):
        cell.turn()
    assert counts.off_track == 1 and np.linalg.norm(cell.here - HOME[0] - MOVE) < 0.1


def test_what_a_course_tells_between_plans() -> None:
    cell = Cell()
    while len(cell.sent) < 3:
        cell.turn()
    first, second, third = cell.sent
    course = Course()
    assert course.newest is None
    for plan in cell.sent:
        course.add(plan, 0)
    middle = (second.start + third.start) // 2
    assert course.at(middle).position == pytest.approx(second.at(middle).position, abs=1e-12)
    assert course.at(first.start - 1).position == pytest.approx(HOME, abs=1e-9)
    course.add(second, third.start)  # begins before the third, which is given up; the first is too old to matter
    assert course.newest is second
    assert course.at(first.start).position == pytest.approx(second.at(second.start).position, abs=1e-12)
