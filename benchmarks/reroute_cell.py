"""The stand-in cell in lock-step, its arm behind follower and guard as in the arm node; and goals shown in it."""

from __future__ import annotations

import numpy as np

from pred_core.arm.follower import Follower, make_plan
from pred_core.arm.guard import Guard, Mode
from pred_core.arm.limits import GuardConfig
from pred_core.errors import InputError
from pred_core.plan.plan import Plan
from pred_core.plant.live.cell import Cell
from pred_core.plant.live.mover import Segment, ToolPose
from pred_core.plant.live.station import TICK, Moment, Station
from pred_core.plant.live.teleop import draw_route
from pred_core.types import Array

EVERY = 2  # ticks between set-points: 75 Hz
SPACING = 0.02  # [s] between the points of a plan that is sent
LIFETIME = 6.0  # [s] a plan is followed; the longest that trials send are 5 s
# The limits of config/nodes/plant.yaml.
GUARD = GuardConfig(rate=1.0 / (EVERY * TICK), x_high=0.65, z_high=0.35, clearance=0.015)
SHOWN = ("up", "down", "landed")  # moves of a demonstration
REST = 0.6  # [s] the rope is left alone before a goal is taken
SHOWINGS = 10  # most demonstrations for a goal


class DrivenCell:
    """One trial's cell and arm. `begin`, then `follow` plans and `advance`."""

    def __init__(self, cell: Cell, pictures: bool):
        """pictures: render the cell's cameras at their own rates."""
        self.station = Station(cell, pictures)
        self.guard, self._follower = Guard(GUARD), Follower(GUARD, LIFETIME)
        self._unreachable: str | None = None

    def begin(self, seed: int, way: Segment | None = None) -> Moment:
        """A start pose, then a scripted way if there is one; the guard is armed where the arm stands then."""
        moment = self.station.reset(seed)
        if way is not None:
            moment = go(self.station, way)
        pose = moment.truth.gripper
        self.guard.arm(pose.position, pose.rotation.tolist())
        return moment

    @property
    def fault(self) -> str | None:
        """Why the arm stopped for good; None while it follows."""
        return self.guard.line if self.guard.mode is Mode.FAULT else self._unreachable

    def follow(self, plan: Plan) -> str | None:
        """Hand a plan to the arm. Returns None, or why it was refused."""
        times, position, rotation = plan.points(SPACING)
        here = self.guard.setpoint
        assert here is not None  # armed by begin
        try:
            sent = make_plan(plan.start, "world", times.tolist(), position[:, 0], rotation[:, 0], GUARD)
            self._follower.accept(sent, (here.position, here.rotation), self.station.stamp)
        except InputError as error:
            return str(error)
        return None

    def advance(self, seconds: float) -> list[Moment]:
        """Let time go on for `seconds` [s], a whole number of set-points; to a pose out of the arm's reach, a fault."""
        moments: list[Moment] = []
        for _ in range(round(seconds / (EVERY * TICK))):
            try:
                moments += self.station.advance(self._setpoint(), EVERY)
            except InputError as error:  # as in the live cell, the arm's servo stops for good
                self._unreachable = str(error)
                break
            pose = moments[-1].truth.gripper
            self.guard.measured(pose.position, tuple(pose.rotation.tolist()))
        return moments

    def _setpoint(self) -> ToolPose | None:
        now = self.station.stamp
        if self.guard.mode in (Mode.HOLDING, Mode.MOVING, Mode.RAMPING):
            if self._follower.done(now):
                self.guard.finish()
                self._follower.clear()
            else:
                target = self._follower.target(now, self.guard.bounds.lag)
                if target is not None:
                    self.guard.command(target[0], target[1], now, now)
        setpoint = self.guard.tick(now)
        return None if setpoint is None else ToolPose(setpoint.position, np.array(setpoint.rotation))


def go(station: Station, way: Segment) -> Moment:
    """Lead the tool along a way with a smooth speed, and let the rope rest for REST."""
    count = round(way.seconds / TICK)
    for k in range(1, count + round(REST / TICK) + 1):
        s = min(1.0, k / count)
        station.advance(way.at(s**3 * (10.0 - 15.0 * s + 6.0 * s * s)), 1)
    return station.moment


def show_goal(cell: Cell, seed: int) -> Array:
    """(P, 3) [m] world: where the rope lies after a scripted arm has led it through the slot, from another start.

    This is the paper's pre-collected target configuration. Raises: InputError if no demonstration succeeds.
    """
    for attempt in range(SHOWINGS):
        station = Station(cell, pictures=False)
        home = station.reset(1_000_000 + SHOWINGS * seed + attempt).truth.gripper
        generator = np.random.default_rng([seed, 11, attempt])
        route = draw_route(generator, "slot", cell.reference, cell.slot, 1.0)
        last = len(SHOWN) - 1
        end = route.begin[last] + route.moves[last].seconds + REST
        for k in range(1, round(end / TICK) + 1):
            moved = min(k * TICK, route.begin[last] + route.moves[last].seconds)
            station.advance(route.at(moved), 1)
        if cell.judge().success:
            return station.moment.truth.rope
    raise InputError(f"no demonstration of {SHOWINGS} led the rope through the slot", got=f"seed {seed}, from {home}")
