"""One lock-step trial: see, plan with a twin, let the arm follow, until the rope is through the slot or time is up."""

from __future__ import annotations

import dataclasses
import itertools
import json
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from reroute_cell import DrivenCell, show_goal
from reroute_eyes import CameraEyes, Eyes, TrueEyes

from pred_core.config import setting
from pred_core.errors import DivergenceError, InputError, TwinError
from pred_core.metrics.chamfer import chamfer_two_sided
from pred_core.plan.config import PlannerConfig
from pred_core.plan.latency import Observation
from pred_core.plan.plan import Plan
from pred_core.plan.planner import Planner
from pred_core.plan.session import Session, Timing
from pred_core.plan.task import make_planner, planning_dynamics, scene_with_slot, with_gap
from pred_core.plant.cameras import ring_of_cameras
from pred_core.plant.live.cell import WORKPLACE, Cell, CellConfig
from pred_core.plant.live.slot import SlotConfig
from pred_core.plant.live.station import Moment
from pred_core.twin import Twin
from pred_core.types import Array

TICK = 1e-9  # [s] the planner's clock goes on by whenever it is asked: budgets are motions here, not seconds
MakePlanner = Callable[[Array, Callable[[], float]], Planner]  # of a goal (Q, 3) [m] and a clock [s]


@dataclass(frozen=True)
class TrialConfig:
    """What a trial is beside twin, planner settings and seed."""

    eyes: str = setting("truth", choices=("truth", "cameras"), doc="what the planner is shown")
    gap: float = setting(SlotConfig.gap, unit="m", low=0.01, high=0.1, doc="between the posts")
    cable: int = setting(0, low=0, high=2**31 - 1, doc="0: the nominal cable; else the seed of a drawn one")
    replan: float = setting(0.4, unit="s", low=0.1, high=5.0, doc="simulated time between plans")
    latency: float = setting(0.2, unit="s", low=0.01, high=2.0, doc="simulated time from an observation to its plan")
    limit: float = setting(16.0, unit="s", low=1.0, high=120.0, doc="simulated time of a trial")


def open_cell(config: TrialConfig, twin: Twin) -> Cell:
    """The cell of a trial; its cameras see once a period of the twin, its goals and starts are the same for all."""
    cameras = tuple(dataclasses.replace(c, rate=1.0 / twin.meta.period) for c in ring_of_cameras(target=WORKPLACE))
    made = CellConfig(cable=config.cable, particles=twin.body.count)
    return Cell(made, slot=SlotConfig(gap=config.gap), cameras=cameras)


def run_trial(
    twin: Twin,
    settings: PlannerConfig,
    config: TrialConfig,
    seed: int,
    goals: Path | None = None,
    eyes: Eyes | None = None,
) -> dict[str, Any]:
    """What happened, ready for JSON. goals: a folder that keeps the goal of each seed; eyes: instead of config's."""
    begun = time.process_time()
    check_twin(twin)
    with open_cell(config, twin) as cell:
        goal = goal_of(cell, config, seed, goals)
        cameras = config.eyes == "cameras"
        driven = DrivenCell(cell, cameras)
        slotted = with_gap(settings, config.gap)
        dynamics = planning_dynamics(twin, scene_with_slot(twin.scene, slotted))
        if eyes is None:
            eyes = CameraEyes(twin, cell, dynamics) if cameras else TrueEyes(twin)

        def make(points: Array, clock: Callable[[], float]) -> Planner:
            return make_planner(twin, points, slotted, seed, dynamics=dynamics, clock=clock)

        trial = Trial(driven, eyes, make, config, goal)
        outcome = trial.run(driven.begin(seed))
        touches = cell.touches
        return {
            "seed": seed,
            "outcome": outcome,
            "success": outcome == "through",
            "time": round(cell.time, 4),
            "chamfer": trial.chamfer,
            "replans": trial.replans,
            "refused": trial.refused,
            "session": dataclasses.asdict(trial.session.counts),
            "unseen": trial.unseen,
            "state_error_mm": trial.errors,
            "touch_count": touches.count,
            "touch_seconds": {k: round(v, 4) for k, v in touches.seconds.items()},
            "passage": dataclasses.asdict(cell.judge()),
            "goal": np.round(goal, 5).tolist(),
            "rope": np.round(driven.station.moment.truth.rope, 5).tolist(),
            "way": trial.way,
            "cpu_seconds": round(time.process_time() - begun, 2),
        }


class Trial:
    """The loop of one trial, and what it writes down. It plans with the planner node's `Session`."""

    def __init__(
        self, driven: DrivenCell, eyes: Eyes, make: MakePlanner, config: TrialConfig, goal: Array, slot: bool = True
    ):
        """slot False: the task is another one, and only time ends the trial."""
        self._slot = slot
        self._driven, self._eyes, self._config, self._goal = driven, eyes, config, goal
        clock = ticking()
        timing = Timing(budget=config.latency, margin=0.0)
        self.session = Session(lambda p: make(p, clock), timing, lambda: driven.station.stamp, clock=clock)
        self.session.set_goal(goal)
        self._warm = False
        self._began = 0.0  # [s] of the cell
        self.chamfer: list[tuple[float, float]] = []  # [s], [m] of the true rope to the goal
        self.replans: list[dict[str, float]] = []
        self.refused: list[str] = []  # plans that planner or arm refused, and why
        self.unseen = 0  # times there was nothing to plan from
        self.errors: list[float] = []  # [mm] mean of the observed state against the truth
        self.way: list[list[float]] = []  # gripper at every replan [m]

    def run(self, begin: Moment) -> str:
        """From `begin` until the rope is through at two looks in a row, the arm has stopped, or time is up."""
        cell = self._driven.station.cell
        self._eyes.see([begin])
        self._began = cell.time
        through = False
        while True:
            self._note()
            success = self._slot and cell.judge().success
            if success and through:
                return "through"
            through = success
            if self._driven.fault is not None:
                return f"arm stopped: {self._driven.fault}"
            if self._time() >= self._config.limit - 1e-6:
                return "time is up"
            if not success:
                self._replan()
            moments = self._driven.advance(self._config.replan)
            if moments:
                self._eyes.see(moments)

    def _replan(self) -> None:
        seen = self._eyes.observe()
        if seen is None:
            self.unseen += 1
            return
        truth = self._driven.station.moment.truth.rope
        self.errors.append(round(1e3 * float(np.linalg.norm(seen.state.position.numpy() - truth, axis=1).mean()), 3))
        wall, cpu = time.perf_counter(), time.process_time()
        plan = self._plan(seen)
        if plan is None:
            return
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        self.session.commit(plan)
        line = self._driven.follow(plan)
        if line is not None:
            self.refused.append(line)
            return
        self.replans.append({"at": self._time(), "wall": round(wall, 4), "cpu": round(cpu, 4), "cost": plan.cost,
                             "still": plan.still, "motions": plan.motions, "steps": plan.steps})  # fmt: skip

    def _plan(self, seen: Observation) -> Plan | None:
        try:
            if not self._warm:  # a session's first run compiles and plans nothing; no simulated time passes here
                self.session.replan(seen)
                self._warm = True
            return self.session.replan(seen)
        except (InputError, DivergenceError) as error:
            self.refused.append(str(error))
            return None

    def _note(self) -> None:
        truth = self._driven.station.moment.truth
        self.chamfer.append((self._time(), round(chamfer_two_sided(truth.rope, self._goal), 5)))
        self.way.append(np.round(truth.gripper.position, 4).tolist())

    def _time(self) -> float:
        return round(self._driven.station.cell.time - self._began, 3)


def ticking() -> Callable[[], float]:
    """A clock [s] that goes on by TICK whenever it is asked."""
    ticks = itertools.count()
    return lambda: TICK * next(ticks)


def goal_of(cell: Cell, config: TrialConfig, seed: int, goals: Path | None) -> Array:
    """(P, 3) [m] the goal of a seed: from the folder, else shown in the cell and kept there."""
    if goals is None:
        return show_goal(cell, seed)
    path = goals / f"gap{1e3 * config.gap:g}-cable{config.cable}-p{cell.config.particles}-{seed}.json"
    if not path.exists():
        goals.mkdir(parents=True, exist_ok=True)
        write_whole(path, np.round(show_goal(cell, seed), 6).tolist())
    return np.array(json.loads(path.read_text(encoding="utf-8")))


def write_whole(path: Path, value: Any) -> None:
    """JSON that is there whole or not at all."""
    partial = path.with_suffix(f".{os.getpid()}.part")  # another process may write the same
    partial.write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")
    partial.replace(path)


def check_twin(twin: Twin) -> None:
    """Raise TwinError unless the twin is a line whose particles are the cell's: evenly along it, from the jaws on."""
    even = np.linspace(0.0, 1.0, twin.body.count)
    if twin.body.kind != "line" or np.abs(twin.body.arc - even).max() > 0.01 or not twin.meta.held:
        raise TwinError("the twin is no rope of the cell", next_step="Make one with the command 'twin'")
