"""What is reported of every parameter: value, spread, interval, sensitivity, flags."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from pred_core.identify.interval import half_widths
from pred_core.identify.problem import Problem
from pred_core.identify.search import Restart
from pred_core.identify.sensitivity import FLOOR, knob_step, sensitivities
from pred_core.identify.space import DISCRETE, Candidate, SearchSpace

Values = dict[str, dict[str, Any]]
NEAR = 0.95  # of the substeps allowed: as stiff as they let it be
STIFFENS = 1.002  # a 10 % change that raises the substeps needed by more is one of those that press on the wall
CLOSE = 1.05  # times the best loss: restarts that count for the spread


@dataclass(frozen=True)
class Evidence:
    """One parameter. Fields that do not apply are absent from `values`."""

    value: float
    unit: str
    low: float  # bounds of the search
    high: float
    sensitivity: float  # relative change of the loss for a change of 10 %
    identifiable: bool  # the loss changes by a thousandth at least
    at_bound: bool  # on a bound, or as stiff as the substeps allowed
    spread: tuple[float, float] | None = None  # over the restarts that ended within 5 % of the best
    interval: tuple[float, float] | None = None  # local, 95 %, see `interval`

    def plain(self) -> dict[str, Any]:
        """As stored in JSON and YAML."""
        return {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(self).items() if v is not None}


def gather_evidence(
    problem: Problem,
    space: SearchSpace,
    searched: SearchSpace,
    best: Candidate,
    restarts: Sequence[Restart],
    most_substeps: float,
) -> Values:
    """Per knob of `space`, at `best`. `searched`: the knobs of the restarts; `most_substeps`: what it could use."""
    here = space.at(best)
    growth = sensitivities(problem, here)
    smooth = SearchSpace(tuple(k for k in here.knobs if k.name not in DISCRETE), here.physics, here.extensions)
    widths = dict(zip((k.name for k in smooth.knobs), half_widths(problem, smooth), strict=True))
    ends = [searched.values(r.z) for r in restarts if r.loss <= CLOSE * restarts[0].loss]
    demand = problem.demand(here.candidate(here.start()))
    result: Values = {}
    for n, (knob, sensitivity) in enumerate(zip(here.knobs, growth, strict=True)):
        stiffer = False
        if knob.name not in DISCRETE:
            more = here.start()
            more[n] = knob_step(knob)
            # A refinement stops just short of the wall: its next step would have been refused.
            stiffer = problem.demand(here.candidate(more)) > max(NEAR * most_substeps, STIFFENS * demand)
        shown = sensitivity >= FLOOR
        width = widths.get(knob.name) if shown else None
        spread = [end[knob.name] for end in ends if knob.name in end]
        result[knob.name] = Evidence(
            value=round(knob.start) if knob.name == "max_springs" else knob.start,
            unit=knob.unit,
            low=knob.low,
            high=knob.high,
            sensitivity=sensitivity,
            identifiable=shown,
            at_bound=knob.at_bound(knob.start) or stiffer,
            spread=(min(spread), max(spread)) if spread else None,
            interval=None if width is None else (knob.value(-width), knob.value(width)),
        ).plain()
    return result
