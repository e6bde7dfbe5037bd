"""The stages of one identification: global search, local refinement, held-out check."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from pred_core.identify.body import Layout
from pred_core.identify.config import IdentifyConfig
from pred_core.identify.journal import Journal
from pred_core.identify.problem import Problem
from pred_core.identify.refine import Refined, refine
from pred_core.identify.search import Restart, search, trimmed
from pred_core.identify.space import DISCRETE, Candidate, SearchSpace
from pred_core.identify.topology import Topology
from pred_core.identify.windows import draw_windows, make_windows
from pred_core.springmass.stability import MOST_SUBSTEPS
from pred_core.train.recordings import Recording
from pred_core.types import Body, Physics

Tell = Callable[[str], None]
FINALISTS = 2  # of the starts of a refinement, that see the longest windows
MOST_WINDOWS = 112  # of a refinement stage shorter than an episode
# Substeps are chosen at half the stability limit. A search that ends there may be refined beyond, still stable: at the
# wall every small step would be charged and nothing could move.
ROOM = 1.7
SUBSTEP = 5e-4  # [s] the shortest of a search unless the user says otherwise


@dataclass(frozen=True)
class Stages:
    """What every stage shares. `noise` [m]: window starts are estimated with it; None: raw from two frames."""

    layout: Layout
    topology: Topology | None  # the union of springs, if their rule is searched at all
    period: float  # [s]
    noise: float | None
    config: IdentifyConfig
    tell: Tell

    def problem(
        self,
        recordings: Sequence[Recording],
        seconds: float,
        *,
        count: int | None = None,
        body: Body | None = None,
        topology: Topology | None = None,
        most_substeps: int | None = None,
        room: float = 1.0,
    ) -> Problem:
        """Windows of `seconds` over the recordings; whole recordings where they are shorter. See `Problem`."""
        longest = max(len(r.position) for r in recordings) - 2
        steps = min(round(min(seconds, 1e6) / self.period), longest)
        most = count or max(MOST_WINDOWS, len(recordings))
        index = draw_windows(recordings, steps, most, torch.Generator().manual_seed(self.config.seed))
        windows = make_windows(recordings, index, steps, self.period, self.noise)
        bound = most_substeps or self.most_substeps
        return Problem(body or self.layout.body, self.layout.scene, self.period, windows, bound, topology, room)

    @property
    def most_substeps(self) -> int:
        """Substeps a period at most."""
        return self.config.substeps or max(1, round(self.period / SUBSTEP))

    def whole(self, recordings: Sequence[Recording]) -> Problem:
        """The longest windows, with all springs that were searched and no bound on stiffness: to judge with."""
        longest = self.config.stages[-1]
        return self.problem(recordings, longest, topology=self.topology, most_substeps=MOST_SUBSTEPS)

    def body(self, physics: Physics) -> Body:
        """The body with the springs these parameters make."""
        return self.layout.body if self.topology is None else self.topology.body(physics)

    def search(self, recordings: Sequence[Recording], space: SearchSpace, journal: Journal) -> list[Restart]:
        """The global search."""
        c = self.config
        problem = self.problem(recordings, c.window, count=c.windows, topology=self.topology)
        self.tell(f"search: {len(space.knobs)} parameters, {problem.windows.count} windows of {c.window:g} s")
        begin = time.monotonic()

        def report(done: int, planned: int, loss: float) -> None:
            fresh = done - journal.replayed
            line = f"search: {done}/{planned} candidates, best {1e3 * loss:.2f} mm"
            if fresh > 0:
                line += f", at most {(time.monotonic() - begin) / fresh * (planned - done):.0f} s left"
            self.tell(line)

        seeds = [c.seed + k for k in range(c.restarts)]
        return search(problem, space, seeds=seeds, evaluations=c.evaluations, journal=journal, report=report)

    def refine(
        self, recordings: Sequence[Recording], space: SearchSpace, start: Candidate, seconds: Sequence[float]
    ) -> tuple[Candidate, Refined | None]:
        """The local refinement of everything continuous, over windows of these lengths in order.

        Knobs that were not searched start at their first start where they are off; each other start of one of them
        is tried too, through all lengths but the last, and the best two go through the last.
        """
        knobs = tuple(k for k in space.knobs if k.name not in DISCRETE)
        if self.config.iterations == 0 or not knobs:
            return start, None
        local = SearchSpace(knobs, start.physics, start.extensions).at(start)
        trials = [start]
        if len(seconds) > 1:
            first = local.start()
            for n, knob in enumerate(local.knobs):
                if knob.starts and knob.start == knob.null:
                    first[n] = knob.coordinate(knob.starts[0])
            trials = [local.candidate(first)]
            for n, knob in enumerate(local.knobs):
                for value in knob.starts[1:]:
                    z = first.copy()
                    z[n] = knob.coordinate(value)
                    trials.append(local.candidate(z))
        if len(trials) > 1:
            ends = [self._lengths(recordings, local, trial, seconds[:-1])[0] for trial in trials]
            trials = sorted(ends, key=lambda end: self._score(recordings, end))[:FINALISTS]
        finals = [self._lengths(recordings, local, trial, seconds[-1:]) for trial in trials]
        return min(finals, key=lambda end: self._score(recordings, end[0]))

    def _score(self, recordings: Sequence[Recording], candidate: Candidate) -> float:
        """Error [m] on the best 90 % of the longest windows: the same windows' rule for every candidate."""
        return float(trimmed(self.whole(recordings).losses([candidate]))[0])

    def _lengths(
        self, recordings: Sequence[Recording], space: SearchSpace, start: Candidate, seconds: Sequence[float]
    ) -> tuple[Candidate, Refined | None]:
        refined = None
        for length in seconds:
            problem = self.problem(recordings, length, body=self.body(start.physics), room=ROOM)
            local = space.at(start)
            steps = len(problem.windows.target)
            title = f"refine: {problem.windows.count} windows of {steps * self.period:.1f} s"

            def report(done: int, planned: int, loss: float, title: str = title) -> None:
                self.tell(f"{title}, step {done}/{planned}, {1e3 * loss:.3f} mm")

            stride = min(self.config.stride, steps)
            refined = refine(problem, local, local.start(), self.config.iterations, stride, report, self.config.shrink)
            start = local.candidate(refined.z)
        return start, refined

    def check(self, candidate: Candidate, recordings: Sequence[Recording], stage: str) -> float:
        """Error [mm] on recordings that were not fitted."""
        error = 1e3 * float(trimmed(self.whole(recordings).losses([candidate]))[0])
        self.tell(f"held-out check ({stage}): {error:.2f} mm on {len(recordings)} episodes not fitted")
        return error
