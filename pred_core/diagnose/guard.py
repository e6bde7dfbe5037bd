"""The network must not hide causes: what of its force would a cause of the library have made?

The twin is rolled out with its network. Beside a step each candidate cause is switched on for one period in the same
state; where that leads is a column, where the network's velocity of that step leads is the other side. A family of
causes that explains more than `OPEN` of the network's variance, on recordings that the regression did not see,
reopens the case: a law that the simulation lacks is hidden in the weights.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from pred_core.diagnose.errors import WHOLE
from pred_core.diagnose.guard_forces import moments, roll, with_network
from pred_core.diagnose.guard_probes import probes_of
from pred_core.diagnose.guard_shares import Share, shares, together
from pred_core.diagnose.roll import Roller
from pred_core.diagnose.sample import make_sample
from pred_core.errors import TwinError
from pred_core.pred import PReD
from pred_core.residual import load_network
from pred_core.twin import Twin
from pred_core.types import Episode

OPEN = 0.1  # share of the network's variance from which a family reopens the case
LEVEL = 0.05  # p value that it needs, or the smallest that so few recordings can give
FEWEST = 6  # recordings for that level; fewer are exploratory
MOST_EPISODES = 24  # that are rolled out, dealt over the recordings
LONGEST = 5.0  # [s] of each


@dataclass(frozen=True)
class Guard:
    """What was found."""

    families: tuple[Share, ...]  # largest first
    joint: float  # share that all of them explain together
    reopened: tuple[str, ...]  # families; a later one adds more than `OPEN` to those before it
    alike: tuple[str, ...]  # families that pass alone, but add little to those
    speed: float  # [m/s] root mean square of what the network adds to a free particle a step
    period: float  # [s]
    episodes: int
    recordings: int
    untested: dict[str, str]  # effect -> why

    @property
    def sentence(self) -> str:
        """One line."""
        size = f"{self.speed / self.period:.3g} m/s^2"
        few = "" if self.recordings >= FEWEST else f"; exploratory, from {self.recordings} recordings"
        best = self.families[0]
        if not self.reopened:
            return (f"no cause in the network's force ({size}): no family explains {OPEN:.0%} of it, most "
                    f"{best.family} {_percent(best)}{few}")  # fmt: skip
        rows = {s.family: s for s in self.families}
        said = ", ".join(f"{f} {_percent(rows[f])}" for f in self.reopened)
        also = f" ({', '.join(self.alike)}: not told apart)" if self.alike else ""
        return f"the network hides a cause: of its force ({size}) is {said}{also}{few}"

    def to_json(self) -> dict[str, Any]:
        """`guard.json`."""
        return {
            "sentence": self.sentence,
            "reopened": list(self.reopened),
            "alike": list(self.alike),
            "joint": self.joint,
            "force_m_s2": self.speed / self.period,
            "episodes": self.episodes,
            "recordings": self.recordings,
            "exploratory": self.recordings < FEWEST,
            "families": [
                {"family": s.family, "share": s.share, "low_95": s.low, "high_95": s.high, "p": s.p,
                 "beyond_the_others": s.beyond, "effects": s.effects}
                for s in self.families
            ],
            "untested": self.untested,
        }  # fmt: skip


def network_guard(twin: Twin, episodes: Sequence[Episode], seed: int = 0) -> Guard:
    """What the twin's network does that a cause would do. `episodes` as recorded, any split.

    Raises: TwinError if the twin has no network; InputError if it adds nothing; DatasetError for one recording.
    """
    if twin.residual is None:
        raise TwinError("the twin has no network to question", next_step="Train one with: pred train")
    return guard_of(with_network(twin, load_network(twin.residual)), twin, episodes, seed)


def guard_of(model: PReD, twin: Twin, episodes: Sequence[Episode], seed: int = 0) -> Guard:
    """`network_guard` of any residual on the twin's backbone."""
    rng = np.random.default_rng(seed)
    begin = min(int(e.stamps[0]) for e in episodes)
    taken = _dealt(episodes, rng)
    sample = make_sample([twin.calibration.correct(e) for e in taken], twin, min(WHOLE, LONGEST), begin)
    sample = sample.some(np.flatnonzero(sample.order == 0))
    roller = Roller(twin, sample)
    path = roll(model, sample)
    force = torch.where(path.counts, path.added.norm(dim=-1), 0.0).movedim(0, 1).double().numpy()
    probes = probes_of(roller, force, rng)
    m = moments(path, roller, probes)
    families, joint = shares(m, probes.rows, rng)
    least = max(LEVEL, 2.0 ** (1 - len(m.groups)))
    passing = [s.family for s in families if s.share >= OPEN and s.low > 0.0 and s.p <= least]
    reopened: list[str] = []
    known = 0.0
    while True:
        gains = {f: together(m, probes.rows, (*reopened, f)) - known for f in passing if f not in reopened}
        best = max(gains, key=lambda f: gains[f], default="")
        if not best or gains[best] < OPEN:
            break
        reopened.append(best)
        known += gains[best]
    alike = tuple(f for f in passing if f not in reopened)
    return Guard(tuple(families), joint, tuple(reopened), alike, path.speed, twin.meta.period, len(taken),
                 len(m.groups), probes.untested)  # fmt: skip


def _dealt(episodes: Sequence[Episode], rng: np.random.Generator) -> list[Episode]:
    """At most MOST_EPISODES, from every recording about as many."""
    rank: dict[int, int] = {}
    rows = []
    for n in rng.permutation(len(episodes)).tolist():
        recording = episodes[n].recording
        rank[recording] = rank.get(recording, -1) + 1
        rows.append((rank[recording], n))
    return [episodes[n] for n in sorted(n for _, n in sorted(rows)[:MOST_EPISODES])]


def _percent(s: Share) -> str:
    return f"{100 * s.share:.0f} % [{100 * s.low:.0f}, {100 * s.high:.0f}]"
