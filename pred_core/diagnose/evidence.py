"""What episodes say of each candidate by parameters of other recordings: gains, p values, who else explains it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from pred_core.diagnose.trial import Trial, scanned
from pred_core.effects import find_effect
from pred_core.types import Array

FLIPS = 20_000
DIGITS = 9  # of a sum of gains, as a share of their sizes: the unflipped draw must count, whatever its rounding
FEWEST_GROUPS = 10  # 2^-10 is the smallest p value they can show; with six a single quiet one decides
ACTS = 0.1  # standard deviations of a residual by which a cause must move an episode to count as acting in it
FEWEST_ACTING = 4  # episodes in which a cause must act to be named, and that it must be able to move to be testable
SLIGHT = 0.05  # of the mean gain: an episode that loses less is not worse
NESTED = 0.06  # of the best gain: with fewer parameters, so little less is the better name
SIMILAR = 0.1  # the same where it is also within one standard error
CONFIDENCE = 0.90  # of the set of causes that cannot be told apart
SHARED = 0.3  # overlap of where two candidates save: of one cause under two names 0.5 to 1, of drag and a table 0.1


@dataclass(frozen=True)
class Judged:
    """One candidate after its fit and cross-fit."""

    trial: Trial
    values: dict[str, float]  # knob -> fitted value, on all train episodes
    null: dict[str, float]  # knob -> value without the change: off, or what the reference says
    intervals: dict[str, tuple[float, float]]  # 90 %, by leaving out recordings
    # Parameters for an episode whose recording is fitted are one step from the joint fit, taken without that recording
    # (`left_out.without_each`); for any other they are the joint fit's.
    gain: Array  # (E,) loss saved on each episode
    acts: NDArray[np.bool_]  # (E,) it moves the episode by itself, whatever is refitted beside it
    extended: Array  # (E,) loss with it
    z: Array  # coordinates of `values`
    excited: int | None = None  # episodes that a typical change of it would move; None: not asked, it acts in enough

    @property
    def mean(self) -> float:
        """Mean gain over all episodes."""
        return float(self.gain.mean())

    @property
    def left(self) -> float:
        """Mean loss over all episodes with it: what names are ranked by, for each candidate has its own null."""
        return float(self.extended.mean())

    @property
    def parameters(self) -> int:
        """Numbers it frees beyond those every candidate has."""
        return sum("." in k.name for k in self.trial.space.knobs)

    @property
    def improved(self) -> tuple[int, int]:
        """(episodes that improve, episodes in which it acts)."""
        return int((self.gain[self.acts] > 0).sum()), int(self.acts.sum())

    @property
    def excites(self) -> bool:
        """Wherever its fit ended, these motions would show it: it acts in FEWEST_ACTING episodes, or would if it were
        there. A cause that ended at no change although it would act is absent.
        """
        return self._would_move >= min(FEWEST_ACTING, len(self.acts))

    @property
    def testable(self) -> bool:
        """These motions can show it. What acts in one place need be felt there in a single episode: few says something
        of the place its search ended at, not of all the others it was looked for in.
        """
        return self.excites or (self._would_move > 0 and any(scanned(find_effect(id)) for id in self.trial.ids))

    @property
    def _would_move(self) -> int:
        return max(int(self.acts.sum()), self.excited or 0)

    @property
    def worse(self) -> int:
        """Episodes it acts in that lose more than SLIGHT of the mean gain: less is no vote against it."""
        return int((self.gain[self.acts] < -SLIGHT * self.mean).sum())

    @property
    def at_bound(self) -> dict[str, bool]:
        """Knob -> it ended at a bound that is not its null."""
        return {
            k.name: k.at_bound(self.values[k.name]) and self.values[k.name] != k.null for k in self.trial.space.knobs
        }

    @property
    def excludes_null(self) -> bool:
        """The interval of a switch leaves out its null value."""
        return any(self.is_on(id) for id in self.trial.ids)

    def is_on(self, id: str) -> bool:
        """The interval of a switch of this effect leaves out its null; off, where the effect acts in a place: what the
        reference has in another place, or has not, says nothing of how strong it is here.
        """
        local = bool(scanned(find_effect(id)))
        for n in self.trial.amplitudes:
            knob = self.trial.space.knobs[n]
            if not knob.name.startswith(f"{id}."):
                continue
            null = knob.null if local else self.null[knob.name]
            low, high = self.intervals[knob.name]
            if low > null or high < null:
                return True
        return False


def family_wise(judged: Sequence[Judged], seed: int, groups: NDArray[np.int64] | None = None) -> Array:
    """(C,) p values, adjusted for these candidates: min-P over random sign flips (Westfall and Young 1993).

    Each candidate's mean gain is compared with its own flips, and the smallest of these p values with the smallest of
    every flip: so gains that lie in few episodes (a patch) are not held against what even ones could reach.

    `groups` (E,): recordings, whose episodes are flipped together; from fewer than FEWEST_GROUPS, which tell too
    little apart, episodes are flipped one by one. Parameters for a recording come from a step that leaves it out of
    the joint fit, and gains of its episodes are hardly alike where nothing is hidden: on 41 controls the intraclass
    correlation is -0.03 (median -0.08, 156 fits).

    "These candidates" are a round's finalists, chosen among all by a screening on the train episodes, which p leaves
    out; how often something is named where nothing is hidden is measured on controls (`benchmarks/hidden_effects.py`).
    """
    gains = np.stack([j.gain for j in judged])
    generator = np.random.default_rng(seed)
    unit = np.arange(gains.shape[1]) if groups is None else np.unique(groups, return_inverse=True)[1]
    if unit.max() + 1 < FEWEST_GROUPS:
        unit = np.arange(gains.shape[1])
    signs = generator.choice((-1.0, 1.0), size=(FLIPS, int(unit.max()) + 1))[:, unit]
    sums = np.concatenate((gains.sum(axis=1)[None], signs @ gains.T))  # (1 + F, C)
    sums = np.round(sums / np.maximum(np.abs(gains).sum(axis=1), 1e-300), DIGITS)  # equal sums must compare equal
    ordered = np.sort(sums, axis=0)
    least = np.stack([np.searchsorted(o, s, side="left") for o, s in zip(ordered.T, sums.T, strict=True)], axis=1)
    p = 1.0 - least / len(sums)  # share of draws, the unflipped one among them, with as large a sum
    return np.asarray((p.min(axis=1)[:, None] <= p[0]).mean(axis=0))


def rivals(judged: Sequence[Judged], best: Judged) -> list[tuple[Judged, float]]:
    """(candidate, standard errors by which `best` leaves less), best first: nothing else is below about 1.3."""
    rows = []
    for other in judged:
        difference = other.extended - best.extended
        error = float(difference.std(ddof=1)) / np.sqrt(len(difference))
        rows.append((other, float(difference.mean()) / error if error > 0 else 0.0))
    return sorted(rows, key=lambda row: row[1])


def elsewhere(one: Judged, other: Judged) -> bool:
    """Whether the two save in other episodes: then they are two causes, and not two names for one."""
    saved = [np.maximum(j.gain, 0.0) for j in (one, other)]
    if any(s.sum() == 0.0 for s in saved):
        return False
    return float(np.minimum(*(s / s.sum() for s in saved)).sum()) < SHARED


def set_limit(episodes: int) -> float:
    """Standard errors beyond which a candidate is told apart from the best."""
    return float(student.ppf(CONFIDENCE, max(episodes - 1, 1)))


def simplest(judged: Sequence[Judged], best: Judged) -> Judged:
    """The candidate with fewest parameters that is not worse than `best` by more than one standard error."""
    near = [
        j
        for j, z in rivals(judged, best)
        if j.parameters < best.parameters and j.left - best.left <= (SIMILAR if z <= 1.0 else NESTED) * best.mean
    ]
    return min(near, key=lambda j: (j.parameters, j.left), default=best)


def lack_of_fit(
    suspect: Array, reference: Array, seed: int, ground: NDArray[np.bool_], ground_of_reference: NDArray[np.bool_]
) -> float:
    """p value that episodes fit worse than the reference's: permutation of their log losses, one-sided.

    On the ground and in the air by themselves, because a cause may act in one of them only (Bonferroni).
    """
    generator = np.random.default_rng(seed)
    p = []
    for where in (True, False):
        one, other = suspect[ground == where], reference[ground_of_reference == where]
        if len(one) < 3 or len(other) < 3:
            continue
        both = np.log(np.concatenate((one, other)) + 1e-9)
        observed = both[: len(one)].mean() - both[len(one) :].mean()
        draws = np.array([generator.permutation(both) for _ in range(4000)])
        difference = draws[:, : len(one)].mean(axis=1) - draws[:, len(one) :].mean(axis=1)
        p.append(float((1 + (difference >= observed).sum()) / (1 + len(draws))))
    return min(1.0, len(p) * min(p)) if p else 1.0
