"""The whole identification: layout, global search, refinement, held-out check, twin."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from pred_core.bag.dataset import Dataset
from pred_core.errors import DatasetError
from pred_core.identify.body import Layout, lay_out
from pred_core.identify.config import IdentifyConfig
from pred_core.identify.problem import Problem, draw_windows, make_windows
from pred_core.identify.refine import Refined, refine
from pred_core.identify.search import Journal, Restart, search, trimmed
from pred_core.identify.sensitivity import sensitivities
from pred_core.identify.space import Candidate, SearchSpace, search_space
from pred_core.identify.starts import track_noise
from pred_core.identify.topology import Topology
from pred_core.train.recordings import Recording, align, split_groups
from pred_core.twin import Extension, Twin, TwinMeta
from pred_core.types import Body, Episode, Physics

Tell = Callable[[str], None]
DISCRETE = ("connection_threshold", "max_springs")  # steps, not slopes: CMA-ES alone
MOST_WINDOWS = 64  # of a short refinement stage


@dataclass(frozen=True)
class Identified:
    """The twin and what the report shows."""

    twin: Twin
    values: dict[str, dict[str, object]]  # per knob: value, unit, spread, sensitivity, at_bound, interval
    restarts: list[dict[str, object]]
    fitted_mm: float
    held_out_mm: float | None
    windows: dict[str, float]  # episode -> error over its whole length [mm]
    left_out: tuple[str, ...]
    noise_mm: float
    seconds: float
    seed: int

    def summary(self) -> dict[str, object]:
        """What `identify.json` holds: all but the twin."""
        return {
            "parameters": self.values,
            "restarts": self.restarts,
            "error_mm": {"fitted": self.fitted_mm, "held_out": self.held_out_mm, "episodes": self.windows},
            "left_out": list(self.left_out),
            "track_noise_mm": self.noise_mm,
            "seconds": self.seconds,
            "seed": self.seed,
        }


def identify(
    dataset: Dataset, episodes: Sequence[Episode], config: IdentifyConfig, journal_path: Path | None, tell: Tell,
    command: str = "",
) -> Identified:
    """Fit a twin to the train episodes. Held-out recordings check the fit, then the refinement uses all.

    Raises: DatasetError or ConfigError on unusable data or settings.
    """
    begin = time.monotonic()
    layout = lay_out(dataset, episodes, config)
    period = float(np.median([e.period for e in episodes]))
    recordings = [align(e, layout.body, period) for e in episodes]
    generator = torch.Generator().manual_seed(config.seed)
    many = len({r.group for r in recordings}) > 1 and config.hold_out > 0
    fitted, held_out = split_groups(recordings, config.hold_out, generator) if many else (recordings, [])
    noise = dataset.sigma if dataset.sigma is not None else track_noise(list(recordings))
    fit = _Fit(layout, period, noise if config.estimate_starts else None, config, generator, tell)
    space = _space(layout, config)
    coarse = SearchSpace(tuple(k for k in space.knobs if not k.profile), space.physics, space.extensions)

    journal = Journal(journal_path, {"config": repr(config), "data": [r.name for r in recordings]})
    restarts = fit.search(fitted, coarse, journal)
    best = coarse.candidate(restarts[0].z)
    check = fit.check(best, held_out, "CMA-ES") if held_out else None
    polished, refined = fit.refine(fitted, space, best)
    if held_out:
        check = fit.check(polished, held_out, "refined")
        polished, refined = fit.refine(recordings, space, polished, stages=config.stages[-1:])
    body = fit.body(polished.physics)
    problem = fit.problem(recordings, config.stages[-1], body=body)
    losses = problem.losses([polished])[0]
    values = _report(space, coarse, polished, restarts, refined, problem)
    notes = [] if layout.mass_known else [f"mass is nominal ({config.mass:g} kg): motion alone does not show it"]
    meta = TwinMeta(
        object=dataset.object,
        period=period,
        substeps=max(problem.substeps(polished), 1),
        created_by=command,
        data=tuple(dataset.sha256(e) for e in dataset.select("train")),
        notes=tuple(notes),
    )
    physics_report = {k: {a: b for a, b in v.items() if a not in ("value", "unit")} for k, v in values.items() if "." not in k}
    return Identified(
        twin=Twin(meta, body, polished.physics, layout.scene, _with_evidence(polished, values), None, physics_report),
        values=values,
        restarts=[{"seed": r.seed, "loss_mm": 1e3 * r.loss, **coarse.values(r.z)} for r in restarts],
        fitted_mm=1e3 * float(trimmed(losses[None])[0]),
        held_out_mm=check,
        windows={n: 1e3 * float(v) for n, v in zip(problem.windows.names, losses, strict=True)},
        left_out=refined.left_out if refined is not None else (),
        noise_mm=1e3 * noise,
        seconds=time.monotonic() - begin,
        seed=config.seed,
    )


@dataclass(frozen=True)
class _Fit:
    """What every stage of one identification shares."""

    layout: Layout
    period: float
    noise: float | None
    config: IdentifyConfig
    generator: torch.Generator
    tell: Tell

    def problem(
        self, recordings: Sequence[Recording], seconds: float, *, body: Body | None = None,
        topology: Topology | None = None, most: int | None = None,
    ) -> Problem:  # fmt: skip
        """Windows of `seconds` over the recordings."""
        steps = round(min(seconds, 1e6) / self.period)
        count = most or (MOST_WINDOWS if seconds < 1e6 else len(recordings))
        index = draw_windows(recordings, steps, max(count, 1), torch.Generator().manual_seed(self.config.seed))
        longest = max(len(r.position) for r in recordings) - 2
        windows = make_windows(recordings, index, min(steps, longest), self.period, self.noise)
        return Problem(body or self.layout.body, self.layout.scene, self.period, windows, self.config.substeps, topology)

    def topology(self) -> Topology | None:
        """The union of springs, if their rule is searched at all."""
        if not set(DISCRETE) & set(self.config.parameters):
            return None
        return Topology(self.layout.body, self.layout.longest, 8 if self.layout.body.kind == "line" else 24)

    def body(self, physics: Physics) -> Body:
        """The body with the springs these parameters make."""
        topology = self.topology()
        return self.layout.body if topology is None else topology.body(physics)

    def search(self, recordings: Sequence[Recording], space: SearchSpace, journal: Journal) -> list[Restart]:
        """The global search."""
        c = self.config
        problem = self.problem(recordings, c.window, topology=self.topology(), most=c.windows)
        self.tell(f"search: {len(space.knobs)} parameters, {problem.windows.count} windows of {c.window:g} s")
        begin = time.monotonic()
        fresh = len(journal.stored) == 0

        def report(done: int, planned: int, loss: float) -> None:
            left = (time.monotonic() - begin) / max(done, 1) * (planned - done) if fresh else float("nan")
            self.tell(f"search: {done}/{planned} candidates, best {1e3 * loss:.2f} mm, about {left:.0f} s left")

        seeds = [c.seed + k for k in range(c.restarts)]
        return search(problem, space, seeds=seeds, evaluations=c.evaluations, journal=journal, report=report)

    def refine(
        self, recordings: Sequence[Recording], space: SearchSpace, start: Candidate, stages: Sequence[float] = ()
    ) -> tuple[Candidate, Refined | None]:
        """The local refinement of everything continuous, window lengths in order.

        Knobs with several starts are tried from each through all stages but the last; the best goes on.
        """
        body = self.body(start.physics)
        knobs = tuple(k for k in space.knobs if k.name not in DISCRETE)
        if self.config.iterations == 0 or not knobs:
            return start, None
        local = SearchSpace(knobs, start.physics, start.extensions).at(start)
        seconds = list(stages or self.config.stages)
        trials = [start]
        for n, knob in enumerate(local.knobs):
            for value in knob.starts if len(seconds) > 1 else ():
                z = local.start()
                z[n] = knob.coordinate(value)
                trials.append(local.candidate(z))
        ends = [self._stages(recordings, local, trial, body, seconds[:-1]) for trial in trials]
        if len(trials) > 1:
            ends.sort(key=lambda end: end[1].loss if end[1] is not None else np.inf)
        return self._stages(recordings, local, ends[0][0], body, seconds[-1:])

    def _stages(
        self, recordings: Sequence[Recording], space: SearchSpace, start: Candidate, body: Body, stages: Sequence[float]
    ) -> tuple[Candidate, Refined | None]:
        refined = None
        for seconds in stages:
            problem = self.problem(recordings, seconds, body=body)
            local = space.at(start)

            def report(done: int, planned: int, loss: float, problem: Problem = problem) -> None:
                length = problem.windows.target.shape[0] * self.period
                self.tell(
                    f"refine: {problem.windows.count} windows of {length:.1f} s, step {done}/{planned}, {1e3 * loss:.3f} mm"
                )

            refined = refine(problem, local, local.start(), self.config.iterations, self.config.stride, report)
            start = local.candidate(refined.z)
        return start, refined

    def check(self, candidate: Candidate, recordings: Sequence[Recording], stage: str) -> float:
        """Error [mm] on recordings that were not fitted."""
        problem = self.problem(recordings, self.config.stages[-1], body=self.body(candidate.physics))
        error = 1e3 * float(trimmed(problem.losses([candidate]))[0])
        self.tell(f"held-out check ({stage}): {error:.2f} mm on {len(recordings)} episodes not fitted")
        return error


def _space(layout: Layout, config: IdentifyConfig) -> SearchSpace:
    """Knobs with the connection rule bounded by the object's own spacing."""
    names = [n for n in config.parameters if n != "ground_friction" or layout.scene.ground is not None]
    if layout.body.kind != "line":
        names = [n for n in names if n != "bending_stiffness" or len(layout.body.bends)]
    physics = dataclasses.replace(
        Physics(), connection_threshold=layout.shortest, max_springs=2 if layout.body.kind == "line" else 8,
        bending_stiffness=1e-3 if "bending_stiffness" in names else 0.0,
    )  # fmt: skip
    space = search_space(physics, names, config.effects)
    knobs = []
    for knob in space.knobs:
        if knob.name == "connection_threshold":
            knob = dataclasses.replace(
                knob, low=layout.shortest, high=layout.longest, scale=np.log(layout.longest / layout.shortest) / 6
            )
        if knob.name == "max_springs":
            knob = dataclasses.replace(knob, low=2 if layout.body.kind == "line" else 4, high=8 if layout.body.kind == "line" else 24, scale=2.0)
        knobs.append(knob)
    return SearchSpace(tuple(knobs), space.physics, space.extensions)


def _with_evidence(candidate: Candidate, values: dict[str, dict[str, object]]) -> tuple[Extension, ...]:
    return tuple(
        dataclasses.replace(e, evidence={k.split(".", 1)[1]: v for k, v in values.items() if k.startswith(e.id + ".")})
        for e in candidate.extensions
    )


def _report(
    space: SearchSpace, coarse: SearchSpace, best: Candidate, restarts: list[Restart], refined: Refined | None,
    problem: Problem,
) -> dict[str, dict[str, object]]:
    """Per knob: value, unit, spread over restarts, interval, sensitivity, bound flag."""
    here = space.at(best)
    sensitivity = sensitivities(problem, here)
    names = [k.name for k in here.knobs if refined is not None and k.name not in DISCRETE]
    searched = {k.name for k in coarse.knobs}
    result: dict[str, dict[str, object]] = {}
    for n, knob in enumerate(here.knobs):
        entry: dict[str, object] = {
            "value": round(knob.start) if knob.name == "max_springs" else knob.start,
            "unit": knob.unit,
            "low": knob.low,
            "high": knob.high,
            "sensitivity": sensitivity[n],
            "at_bound": bool(knob.at_bound(knob.start)),
        }
        if knob.name in searched:
            spread = [coarse.values(r.z)[knob.name] for r in restarts if r.loss <= 1.05 * restarts[0].loss]
            entry["spread"] = [min(spread), max(spread)]
        if refined is not None and knob.name in names:
            width = 1.96 * float(np.sqrt(max(refined.covariance[names.index(knob.name), names.index(knob.name)], 0.0)))
            entry["interval"] = [knob.value(-width), knob.value(width)]
        result[knob.name] = entry
    return result


def train_episodes(dataset: Dataset) -> list[Episode]:
    """The train split, read into memory. Raises: DatasetError if it is empty."""
    episodes = list(dataset.episodes("train"))
    if not episodes:
        raise DatasetError(f"{dataset.root}: no train episodes")
    return episodes
