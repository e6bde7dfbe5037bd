"""The planner: from an observation to the lowest-cost gripper motion found in the time there is."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from pred_core.dynamics import Dynamics
from pred_core.errors import DivergenceError
from pred_core.plan.config import PlannerConfig
from pred_core.plan.costs import Objective
from pred_core.plan.course import Course
from pred_core.plan.curve import Curve, first_knots
from pred_core.plan.knots import KnotLimits
from pred_core.plan.latency import Departure, Observation, departure
from pred_core.plan.plan import NS, Plan, check_plan
from pred_core.plan.rollouts import Rollouts, Simulation
from pred_core.plan.search import draw_noise, move_mean
from pred_core.plan.ways import draw_ways
from pred_core.types import Array

Watch = Callable[[Rollouts, Array], None]  # sampled motions and their costs (K,), for markers and pictures


@dataclass
class _Best:
    """The best motion so far."""

    cost: float = np.inf
    knots: Array = field(default_factory=lambda: np.zeros(0))  # (S + 2, G, 4)
    predicted: Array = field(default_factory=lambda: np.zeros(0))  # (F, N, 3)
    parts: dict[str, float] = field(default_factory=dict)


class Planner:
    """MPPI over gripper motions. Keeps the last plan as the first guess of the next one (`reset` forgets it)."""

    def __init__(
        self,
        dynamics: Dynamics,
        objective: Objective,
        config: PlannerConfig,
        generator: np.random.Generator,
        *,
        clock: Callable[[], float] = time.monotonic,
        watch: Watch | None = None,
        goal: Array | None = None,
    ):
        """clock [s]: what deadlines refer to; goal (Q, 3) [m]: where `search.ways` lead, None: there are none.

        Raises: ConfigError for an empty workspace.
        """
        self.objective = objective
        self.config = config
        self._dynamics, self._generator, self._clock, self._watch = dynamics, generator, clock, watch
        motion, search = config.motion, config.search
        self._limits, self._goal = KnotLimits(motion), goal
        self._simulation = Simulation(dynamics, motion.horizon, motion.knots, search.frames)
        self._last: Plan | None = None
        self._chunk_seconds = 0.0  # the slowest of the last plan

    def reset(self) -> None:
        """Forget the last plan."""
        self._last = None

    def plan(
        self,
        seen: Observation,
        begin: int | None = None,
        *,
        in_force: Plan | Course | None = None,
        deadline: float | None = None,
    ) -> Plan:
        """The best motion that begins at `begin` [ns] (default: at the observation), found before `deadline`.

        deadline: [s] on `clock`; at least one chunk of samples is tried even if that is late; None: all iterations.
        in_force: what the arm follows until then; the plan continues it without a jump in pose, velocity or
        acceleration. Raises: InputError for a bad observation or result, DivergenceError if nothing could be simulated.
        """
        started = self._clock()
        start = departure(self._dynamics, seen, seen.stamp if begin is None else begin, in_force)
        here = start.beginning
        first = first_knots(here.velocity, here.acceleration, self._limits.spacing)
        best, still, history, motions, iterations = self._search(start, first, seen, started, deadline)
        curve = Curve(self._limits.spacing, here.position, here.rotation, best.knots)
        check_plan(curve, here, self.config)
        frames = np.array(self._simulation.frames)
        self._last = Plan(
            start=start.stamp,
            curve=curve,
            sent=curve.stopping(self.config.send),
            cost=best.cost,
            parts=best.parts,
            still=still,
            predicted=best.predicted,
            times=(frames + 1) * self._dynamics.period,
            motions=motions,
            iterations=iterations,
            seconds=self._clock() - started,
            steps=self._simulation.steps,
            history=tuple(history),
        )
        return self._last

    def _search(
        self, start: Departure, first: Array, seen: Observation, started: float, deadline: float | None
    ) -> tuple[_Best, float, list[tuple[float, float]], int, int]:
        search = self.config.search
        closed, here = seen.closed(), start.beginning
        mean = self._first_guess(start.stamp, len(here.position))
        best, still, motions = _Best(), np.nan, 0
        history: list[tuple[float, float]] = []
        slowest = 0.0
        for iteration in range(search.iterations):
            noise = draw_noise(search, (self._limits.free, search.samples, *mean.shape[1:]), iteration, self._generator)
            samples = mean[:, None] + noise
            if iteration == 0:
                samples[:, 1] = 0.0  # stand still
            self._lead(samples, here.position)
            knots = self._limits.apply(samples, first, here.position)
            costs = np.full(search.samples, np.inf)
            for begin in range(0, search.samples, search.chunk):
                chunk = slice(begin, min(begin + search.chunk, search.samples))
                since = self._clock()
                if deadline is not None and motions and since + max(slowest, self._chunk_seconds) > deadline:
                    self._chunk_seconds = slowest
                    return self._found(best, motions), still, history, motions, iteration
                rollouts = self._simulation.run(start.state, here, closed, knots[:, chunk])
                costs[chunk], parts = self.objective(rollouts)
                if self._watch is not None:
                    self._watch(rollouts, costs[chunk])
                self._keep_best(best, rollouts, costs[chunk], parts)
                motions += len(costs[chunk])
                if iteration == 0 and begin == 0 and search.chunk > 1:
                    still = float(costs[1])
                slowest = max(slowest, self._clock() - since)
                history.append((self._clock() - started, best.cost))
            mean = move_mean(knots[2:-2], costs, search.temperature)
        self._chunk_seconds = slowest
        return self._found(best, motions), still, history, motions, search.iterations

    def _lead(self, samples: Array, here: Array) -> None:
        """Replace the widest samples by ways to the goal, in place."""
        count = int(self.config.search.ways * (samples.shape[1] - 2))
        if self._goal is not None and count:
            speed = self.config.motion.speed
            samples[:, 2 : 2 + count] = draw_ways(self._goal, here, count, speed, self._limits, self._generator)

    def _found(self, best: _Best, motions: int) -> _Best:
        if not np.isfinite(best.cost):
            raise DivergenceError(f"none of {motions} planned motions could be simulated",
                                  next_step="Check the twin and the state")  # fmt: skip
        return best

    def _keep_best(self, best: _Best, rollouts: Rollouts, costs: Array, parts: dict[str, Array]) -> None:
        k = int(np.argmin(costs))
        if costs[k] < best.cost:
            best.cost = float(costs[k])
            best.knots = rollouts.knots[:, k].copy()
            best.predicted = rollouts.position[list(rollouts.frames), k].cpu().numpy()
            best.parts = {name: float(values[k]) for name, values in parts.items()}

    def _first_guess(self, stamp: int, grippers: int) -> Array:
        """Free knots (M, G, 4): the last plan from `stamp` on, at rest after its end; or rest."""
        guess = np.zeros((self._limits.free, grippers, 4))
        if self._last is None or self._last.curve.knots.shape[1] != grippers:
            return guess
        old = self._last.curve.knots
        shift = (stamp - self._last.start) / NS / self._limits.spacing
        if shift < 0.0:
            return guess
        at = np.arange(self._limits.free) + 2 + shift
        k = np.floor(at).astype(int)
        padded = np.concatenate((old, np.zeros((1, *old.shape[1:]))))
        share = (at - k)[:, None, None]
        before, after = np.minimum(k, len(old)), np.minimum(k + 1, len(old))
        return (1.0 - share) * padded[before] + share * padded[after]
