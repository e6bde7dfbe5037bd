"""What a diagnosis knows between rounds: what was named, what each round saw."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field

from pred_core.diagnose.evidence import Judged
from pred_core.diagnose.journal import Journal
from pred_core.diagnose.judge import Bench, standing_of
from pred_core.identify.space import Candidate
from pred_core.twin import Twin
from pred_core.types import Array

SLOWER = 2.0  # times the substeps of the round before, from which its expected time must be there before the deadline


class OutOfTime(Exception):
    """A round is given up: what it found is in the journal."""


@dataclass(frozen=True)
class Named:
    """A cause that was accepted."""

    judged: Judged
    p_adjusted: float
    group: tuple[str, ...]  # others that these data do not tell apart from it
    closed: float  # share of the excess of its round that it closes
    round: int
    contradicted: str = ""  # what the data say against its law: it is only the nearest one; "" where they do not


@dataclass(frozen=True)
class Round:
    """What a round saw."""

    base: Array  # (E,) losses before it
    floor: float  # mean loss of the reference, or nothing
    screened: tuple[tuple[str, float], ...]  # candidate, promise
    judged: tuple[tuple[Judged, float, str], ...]  # candidate, adjusted p, why it was rejected ("" = accepted)
    excited: Mapping[str, int] = field(default_factory=dict)  # candidate that was not judged -> episodes it would move
    passed: Mapping[str, str] = field(default_factory=dict)  # candidate that cannot act here -> why


@dataclass
class Progress:
    """State of a diagnosis between rounds."""

    bench: Bench
    journal: Journal
    twins: list[Twin]  # before anything was named, and after each name
    deadline: float = math.inf  # [s] of `time.monotonic`, after which nothing more is begun
    latest: float = math.inf  # [s] the same, by which a round must be expected to end to be begun
    took: float = 0.0  # [s] of the last round; what the journal has of it took no time
    needed: float = 0.0  # substeps a period of the twin in the last round
    named: list[Named] = field(default_factory=list)
    rounds: list[Round] = field(default_factory=list)
    unknown: bool = False
    left: bool = False  # without a reference: in the end the twin explains less than is usual where nothing is hidden
    unknown_p: float = 1.0
    explained: float | None = None  # share of the motion, in the end; None: the object hardly moves
    well: bool = True  # the twin of this round explains the motion as far as is usual where nothing is hidden
    notes: list[str] = field(default_factory=list)
    first: Bench = field(init=False)  # before anything was named
    _whole: tuple[Bench, float] | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        self.first = self.bench

    def whole(self) -> float:
        """Excess loss before anything was named, in the units of the present round: the loss that counts as usual of a
        window falls with every name, and with it what a window that is far off counts."""
        if self._whole is None or self._whole[0] is not self.bench:
            bench, first = self.bench, self.first
            floor = 0.0 if bench.reference is None else standing_of(first.reference_twin, bench.reference).mean()
            self._whole = bench, float(standing_of(first.twin, bench.target).mean() - floor)
        return self._whole[1]

    def add(self, named: Named, bench: Bench) -> None:
        """Take a name, and the bench that has it."""
        self.named = [refitted(n, named.judged) for n in self.named]
        self.named.append(named)
        self.bench = bench
        self.twins.append(bench.twin)

    def replace(self, named: Named, instead: Named, bench: Bench) -> None:
        """Put another law, fitted with all that was named, in the place of one that the data contradict."""
        seen = self.rounds[named.round]
        rows = [
            (j, p, instead.contradicted if not why and j.trial.ids == named.judged.trial.ids else why)
            for j, p, why in seen.judged
        ]
        judged = (*rows, (instead.judged, instead.p_adjusted, ""))
        self.rounds[named.round] = dataclasses.replace(seen, judged=judged)
        self.named = [instead if n is named else refitted(n, instead.judged) for n in self.named]
        self.bench = bench
        self.twins[-1] = bench.twin

    def withdraw(self, bench: Bench) -> None:
        """Take back the last name and its round: the bench is as it was before."""
        self.named.pop()
        self.twins.pop()
        self.rounds.pop()
        self.bench = bench

    def expected(self) -> float:
        """[s] that another round takes, from the last one: what was named may need many more substeps."""
        return self.took * max(self.slower(), 1.0)

    def slower(self) -> float:
        """Times the substeps of the last round that another one needs: what was named may ask for more."""
        return self.substeps() / self.needed if self.needed else 1.0

    def substeps(self) -> float:
        """A period that the twin needs with all that was named."""
        twin, roller = self.bench.twin, self.bench.target.roller
        return max(roller.usual(), roller.demand(Candidate(twin.physics, twin.extensions)))

    def time_for_another(self) -> bool:
        """Whether another round may begin. One that is much slower than the last is known badly: it must end sooner."""
        if self.late(self.expected() if self.slower() > SLOWER else 0.0):
            return False
        return time.monotonic() + self.expected() <= self.latest

    def go_on(self, number: int) -> None:
        """Raise OutOfTime in the middle of a later round that takes longer than was expected; the first always ends."""
        if number and self.overdue():
            raise OutOfTime

    def overdue(self) -> bool:
        """Whether what has begun takes longer than was expected."""
        return time.monotonic() > self.latest

    def late(self, needs: float = 0.0) -> bool:
        """Whether the time is used up, or would be after `needs` [s] more."""
        return time.monotonic() + needs > self.deadline


def refitted(named: Named, later: Judged) -> Named:
    """An earlier name with the values it has beside a later one: they were fitted together. Its intervals move with
    them and get no shorter: for the later one the earlier is no change, so only the scatter over recordings is in its.
    """
    j = named.judged
    mine = set(j.values) & set(later.values)
    intervals = dict(j.intervals)
    for k in mine:
        value, (low, high), (least, most) = later.values[k], j.intervals[k], later.intervals[k]
        knob = next(q for q in later.trial.space.knobs if q.name == k)
        low, high = min(value + low - j.values[k], least), max(value + high - j.values[k], most)
        intervals[k] = (max(low, knob.low), min(high, knob.high))
    judged = dataclasses.replace(j, values={**j.values, **{k: later.values[k] for k in mine}}, intervals=intervals)
    return dataclasses.replace(named, judged=judged)
