"""What a diagnosis says: for people, for `diagnosis.json`, for the report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from pred_core.diagnose.errors import EpisodeErrors, Gain
from pred_core.diagnose.gate import GateResult
from pred_core.diagnose.progress import Round
from pred_core.diagnose.refining import Refined
from pred_core.twin import Twin

OUTCOMES = ("none", "named", "group", "unknown")


@dataclass(frozen=True)
class Value:
    """A parameter of a cause."""

    value: float
    unit: str
    low: float  # 90 % interval, where `interval`
    high: float
    at_bound: bool = False
    interval: bool = True  # False: low and high are only the bounds of the search, nothing measured; null in the JSON


@dataclass(frozen=True)
class Cause:
    """One named cause."""

    id: str
    family: str
    probability: float
    parameters: Mapping[str, Value]
    measured: bool = False  # found by the model-free gate, corrected where data enter
    # Share of the excess that it closes: of its round's loss, or, corrected where data enter, of the error of whole
    # held-out episodes; None: there is no excess to take a share of.
    closed: float | None = 0.0
    p_adjusted: float = 1.0
    group: tuple[str, ...] = ()  # these data do not tell it apart from
    contradicted: str = ""  # what the data say against its law, the nearest there is; "" where they do not


@dataclass(frozen=True)
class Ranked:
    """One line of the ranking."""

    id: str
    family: str
    probability: float
    gain: float  # share of the excess loss it saves on the episodes it is judged on; 0 of what the gate measured
    p_adjusted: float
    rejected: str  # why it is not named; "" = it is
    values: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Errors:
    """Whole held-out episodes of one split."""

    split: str
    base: EpisodeErrors
    extended: EpisodeErrors
    floor: float | None  # [mm] of the reference's episodes of that split with its own twin
    gain: Gain


@dataclass(frozen=True)
class Diagnosis:
    """The whole answer."""

    outcome: str
    sentence: str
    causes: tuple[Cause, ...]
    ranking: tuple[Ranked, ...]
    errors: Errors
    errors_ood: Errors | None
    budget: Mapping[str, Any]  # named {id: mm}, learned, unexplained, floor
    not_identifiable: tuple[str, ...]
    not_testable: Mapping[str, str]  # candidate -> why
    next_motion: Mapping[str, Any] | None
    exploratory: bool
    notes: tuple[str, ...]
    gate: GateResult
    rounds: tuple[Round, ...]
    base_twin: Twin  # what was compared with
    twin: Twin  # carries what was named
    seconds: float
    seed: int
    session: int | None = None  # [ns] when the session of these episodes began; None: with the first of them
    more: bool = False  # beside what was named something is left that no candidate explains
    explained: float | None = None  # share of the motion in windows of held-out episodes; None: it hardly moves
    settings: Mapping[str, Any] = field(default_factory=dict)  # of the run
    refined: Refined | None = None
    seen: Mapping[str, float] = field(default_factory=dict)  # physics that only the gate found -> its size [mm]

    @property
    def p_adjusted(self) -> float:
        """The largest of the causes': all must hold. 1 where nothing was named."""
        return max((c.p_adjusted for c in self.causes), default=1.0)

    @property
    def judged_ids(self) -> set[str]:
        """Candidates that were fitted to the end, in any round, alone or with another."""
        return {i for seen in self.rounds for j, _, _ in seen.judged for i in j.trial.ids}

    def to_json(self) -> dict[str, Any]:
        """`diagnosis.json` (DESIGN.md, and beside it what the report shows).

        `low` and `high` of a parameter are null where no interval was measured (one recording, or so wide that it ends
        with the search on both sides), `low_mm` and `high_mm` of the gain where one episode gave none.
        """
        e = self.errors
        return {
            "outcome": self.outcome,
            "sentence": self.sentence,
            "exploratory": self.exploratory,
            "unexplained_rest": self.more,
            "causes": [_cause(c) for c in self.causes],
            "group": next(([c.id, *c.group] for c in self.causes if c.group), []),
            "ranking": [
                {"id": r.id, "family": r.family, "probability": r.probability, "gain": r.gain,
                 "p_adjusted": r.p_adjusted, "rejected": r.rejected, "values": dict(r.values)}
                for r in self.ranking
            ],
            "error_mm": _errors(e),
            "motion_explained": self.explained,
            "error_mm_ood": {} if self.errors_ood is None else _errors(self.errors_ood),
            "gain": {
                "mean_mm": e.gain.mean, **_span("low_mm", "high_mm", e.gain.low, e.gain.high, e.gain.episodes > 1),
                "episodes_improved": f"{e.gain.improved}/{e.gain.episodes}",
                "p_adjusted": self.p_adjusted,
            },
            "budget": dict(self.budget),
            "not_identifiable": list(self.not_identifiable),
            "not_testable": dict(self.not_testable),
            "next_motion": None if self.next_motion is None else dict(self.next_motion),
            "notes": list(self.notes),
            "base": None if self.refined is None else self.refined.to_json(),
            "gate": self.gate.to_json(),
            "seconds": self.seconds,
            "seed": self.seed,
            "settings": dict(self.settings),
        }  # fmt: skip


def _cause(c: Cause) -> dict[str, Any]:
    return {
        "id": c.id,
        "family": c.family,
        "probability": c.probability,
        "kind": "measurement" if c.measured else "physics",
        "closed": c.closed,
        "p_adjusted": c.p_adjusted,
        "group": list(c.group),
        "contradicted": c.contradicted,
        "parameters": {
            k: {
                "value": v.value,
                "unit": v.unit,
                **_span("low", "high", v.low, v.high, v.interval),
                "at_bound": v.at_bound,
            }
            for k, v in c.parameters.items()
        },
    }


def _span(lower: str, upper: str, low: float, high: float, known: bool) -> dict[str, float | None]:
    """Both ends of an interval by name; null where there is none."""
    return {lower: low if known else None, upper: high if known else None}


def _errors(e: Errors) -> dict[str, Any]:
    return {
        "base": e.base.mean,
        "extended": e.extended.mean,
        "floor": e.floor,
        "split": e.split,
        "episodes": {
            n: [float(a), float(b)] for n, a, b in zip(e.base.names, e.base.values, e.extended.values, strict=True)
        },
    }
