"""Fitting candidates on both sets and cross-fitting them on the suspect one."""

from __future__ import annotations

import dataclasses
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student
from torch import Tensor

from pred_core.diagnose.config import DiagnoseConfig
from pred_core.diagnose.evidence import ACTS, FEWEST_ACTING, Judged
from pred_core.diagnose.fit import IN_FULL, USUAL, Target, fit, graduated, rho
from pred_core.diagnose.journal import Journal, vector
from pred_core.diagnose.left_out import without_each
from pred_core.diagnose.places import Start
from pred_core.diagnose.roll import Roller
from pred_core.diagnose.search import starts
from pred_core.diagnose.trial import Trial, make_trial, scanned
from pred_core.effects.effect import Effect
from pred_core.identify.space import Candidate
from pred_core.twin import Twin
from pred_core.types import Array

KEPT_STARTS = 4
ON_THE_WAY, STILL_FALLING = 3, 0.75  # times these steps are taken again, while the loss falls to this share
HARDLY = 0.02  # of the reference's loss: what a candidate saves there is no reason to take it for what is usual
QUICK, TRIED = 2, 2  # steps, and starts, of a candidate before it is told whether it goes on
TRUST, Z = 0.95, 1.645  # of a one-sided bound: 90 % between two; normal deviate of it
# Relative standard error of a parameter between two engines, beyond the scatter over recordings: from development
# cases. Engines differ most in sliding: a coefficient that is high in one acts like a lower one in another.
MISMATCH, SLIDING = 0.10, 0.30
SLIDES = ("friction", "patch", "drift", "slip")  # families
Tell = Callable[[str], None]
Effects = tuple[type[Effect], ...]


@dataclass(frozen=True)
class Bench:
    """The suspect set and, if there is one, the reference, each with the twin that describes it so far."""

    twin: Twin
    target: Target  # all episodes: to judge on
    fitted: Target  # its train episodes: to fit on
    reference_twin: Twin
    reference: Target | None
    config: DiagnoseConfig
    free: tuple[str, ...] = ()  # effects that were named: refitted with every further candidate
    physics: tuple[str, ...] = ()  # base parameters that every candidate refits: without a reference, all of them

    @property
    def train(self) -> NDArray[np.bool_]:
        """(E,) episodes of the suspect set that are fitted; the others only judge."""
        return np.array([s == "train" for s in self.target.roller.sample.splits])

    def trial(self, effects: Effects) -> Trial:
        """A candidate on the suspect set."""
        return make_trial(self.twin, effects, self.physics, self.free)

    def counting(self, usual: float) -> Bench:
        """The same where another loss is usual of a window."""
        return dataclasses.replace(
            self,
            target=self.target.counting(usual),
            fitted=self.fitted.counting(usual),
            reference=None if self.reference is None else self.reference.counting(usual),
        )

    def standing(self) -> Array:
        """(E,) losses of the suspect set as the twin is."""
        return standing_of(self.twin, self.target)


def standing_of(twin: Twin, target: Target) -> Array:
    """(E,) losses of a target as a twin is, whatever the body the target was made with."""
    roller = target.roller if twin.body is target.roller.twin.body else Roller(twin, target.roller.sample)
    u = roller.errors([Candidate(twin.physics, twin.extensions)], target.stride) * target.weights[..., None]
    return target.losses_of(u)[0]


def scaled(bench: Bench) -> Bench:
    """The bench whose windows count in full up to the median loss of the suspect set as the twin is."""
    space = make_trial(bench.twin, (), ()).space
    loss = bench.target.per_window(rho(bench.target.residuals(space, [space.start()])))
    return bench.counting(max(USUAL, float(np.median(loss))))


@dataclass(frozen=True)
class Screened:
    """A candidate and what a straight line promises of it."""

    effects: Effects
    trial: Trial
    starts: list[Start]
    promise: float
    null: Array  # coordinates (in the suspect set's space) of no change


def rng_of(seed: int, key: str) -> np.random.Generator:
    """A generator of its own for every piece, so that pieces do not depend on which ran before."""
    return np.random.default_rng([seed, zlib.crc32(key.encode())])


def screen(bench: Bench, effects: Effects, rng: np.random.Generator, journal: Journal, key: str) -> Screened:
    """Where to start a candidate, and how much it promises."""
    trial = bench.trial(effects)

    def find() -> list[list[object]]:
        found = starts(bench.fitted.counting(IN_FULL), trial, bench.config.places, rng)[:KEPT_STARTS]
        return [[s.z.tolist(), s.promise] for s in found]

    def read(rows: Any) -> Screened:
        found = [Start(vector(z, len(trial.space.knobs)), float(p)) for z, p in rows]
        return Screened(effects, trial, found, found[0].promise, trial.space.start())

    return journal.piece(key, find, read)


def quick(bench: Bench, screened: Screened, journal: Journal, key: str) -> tuple[Array, float]:
    """(coordinates, loss on the train episodes, windows in full) after a few steps from each start."""

    def find() -> list[object]:
        trial, fitted = screened.trial, bench.fitted.counting(IN_FULL)
        ends = [fit(fitted, trial.space, s.z, QUICK, most=trial.most, slopes=False) for s in screened.starts[:TRIED]]
        best = min(ends, key=lambda f: float(f.loss.mean()))
        before = float("inf")
        for _ in range(ON_THE_WAY):  # a strong cause is far from off: as long as it gains much, it is not there yet
            if float(best.loss.mean()) > STILL_FALLING * before:
                break
            before = float(best.loss.mean())
            best = fit(fitted, trial.space, best.z, QUICK, most=trial.most, slopes=False)
        return [best.z.tolist(), float(best.loss.mean())]

    size = len(screened.trial.space.knobs)
    return journal.piece(key, find, lambda found: (vector(found[0], size), float(found[1])))


def null_of(bench: Bench, screened: Screened, found: Array) -> Array:
    """Coordinates of "no change": what the reference says of the candidate's parameters, else off.

    What the engine and the object lack in common would otherwise count as a change. The reference is fitted with the
    same budget, from off and from where the suspect set led (`found`): a fit that ended early would look like a change.
    Where it gains HARDLY anything there, it is off: the reference may never have been where a cause acts.
    """
    trial = screened.trial
    if not bench.config.back_fit:
        return screened.null
    if bench.reference is None:
        return _back_fit(bench, screened, found)
    other = make_trial(bench.reference_twin, screened.effects, ())
    begins = [_like(trial, other, found)]
    if not any(scanned(e) for e in screened.effects):
        begins.append(other.space.start())
    ends = [graduated(bench.reference, other.space, z, bench.config.iterations, trial.most) for z in begins]
    best = min(ends, key=lambda f: float(f.loss.mean()))
    off = float(bench.reference.losses(other.space, [other.space.start()]).mean())
    if float(best.loss.mean()) > (1.0 - HARDLY) * off:
        return screened.null
    values = other.space.values(best.z)
    null = screened.null.copy()
    for n, knob in enumerate(trial.space.knobs):
        if knob.name in values:
            null[n] = knob.coordinate(values[knob.name])
    return null


def _back_fit(bench: Bench, screened: Screened, found: Array) -> Array:
    """The base alone, refined from where it stands and from where the candidate led it: a candidate must not gain by
    getting the base out of a local optimum."""
    base = make_trial(bench.twin, (), bench.physics, bench.free)
    begins = (base.space.start(), _like(screened.trial, base, found))
    ends = [graduated(bench.fitted, base.space, z, bench.config.iterations) for z in begins]
    best = min(ends, key=lambda f: float(f.loss.mean()))
    return _like(base, screened.trial, best.z)


def _like(source: Trial, target: Trial, z: Array) -> Array:
    """The same values in another trial's space."""
    values = source.space.values(z)
    result = target.space.start()
    for n, knob in enumerate(target.space.knobs):
        if knob.name in values:
            result[n] = knob.coordinate(values[knob.name])
    return result


def judge(bench: Bench, screened: Screened, journal: Journal, key: str) -> Judged:
    """Fit on the train episodes, cross-fit by recordings, compare with no change on every episode."""
    episodes = bench.target.roller.sample.episodes
    return journal.piece(key, lambda: _judge(bench, screened), lambda v: _judged(screened.trial, episodes, v))


def _judged(trial: Trial, episodes: int, values: Mapping[str, Any]) -> Judged:
    size = len(trial.space.knobs)
    z, null = vector(values["z"], size), vector(values["null"], size)
    return Judged(
        trial=trial,
        values=trial.space.values(z),
        null=trial.space.values(null),
        intervals=intervals(trial, z, null, np.stack([vector(p, size) for p in values["left_out"]])),
        gain=vector(values["gain"], episodes),
        acts=vector(values["moved"], episodes) > ACTS,
        extended=vector(values["extended"], episodes),
        z=z,
        excited=None if values["excited"] is None else int(values["excited"]),
    )


def _judge(bench: Bench, screened: Screened) -> dict[str, object]:
    """Plain values of a candidate: coordinates, those without each recording, gains and losses per episode."""
    trial, space, target = screened.trial, screened.trial.space, bench.target
    train = bench.train
    result = graduated(bench.fitted, trial.space, screened.starts[0].z, bench.config.iterations, trial.most)
    null = null_of(bench, screened, result.z)
    sample = target.roller.sample
    left_out = without_each(target, space, result, train)
    own = [any(k.name.startswith(f"{id}.") for id in trial.ids) for k in space.knobs]
    without = np.where(own, null, result.z)  # what is refitted beside it moves episodes in which it does nothing
    u = target.residuals(space, [null, result.z, without])
    losses = target.losses_of(u)
    extended = losses[1].copy()
    for group, other in left_out.items() if bench.config.cross_fit else ():
        mine = sample.groups == group  # also test episodes of that recording
        extended[mine] = other.loss[mine]
    moved = _moved(target, u[1] - u[2])
    few = int((moved > ACTS).sum()) < FEWEST_ACTING
    return {
        "z": result.z.tolist(),
        "null": null.tolist(),
        "left_out": [other.z.tolist() for other in left_out.values()] or [result.z.tolist()],
        "gain": (losses[0] - extended).tolist(),
        "extended": extended.tolist(),
        "moved": moved.tolist(),
        "excited": int((excitation(target, trial, result.z, without) > ACTS).sum()) if few else None,
    }


def excitation(target: Target, trial: Trial, z: Array, without: Array) -> Array:
    """(E,) standard deviations by which a typical change of what switches a trial on moves each episode from `without`
    it, where `z` has its place and shape: what the motions would show, whatever the fit made of the size.
    """
    there = without.copy()
    for n, knob in enumerate(trial.space.knobs):
        if n in trial.amplitudes:
            there[n] += 1.0 if without[n] + 1.0 <= knob.coordinate(knob.high) else -1.0
        elif any(knob.name.startswith(f"{id}.") for id in trial.ids):
            there[n] = z[n]
    one, other = target.residuals(trial.space, [without, there])
    return _moved(target, other - one)


def _moved(target: Target, difference: Tensor) -> Array:
    """(E,) root mean square of a difference of residuals (W, K, N, 3)."""
    return np.sqrt(np.maximum(target.per_episode(difference.square()[None])[0], 0.0))


def intervals(trial: Trial, z: Array, null: Array, left_out: Array) -> dict[str, tuple[float, float]]:
    """90 %, as values: the jackknife over recordings (Efron 1982) and what simulations of one rope differ by, relative
    to the change for what switches a cause on, to a typical change for where it is and how it is shaped. What is
    refitted beside the cause has the scatter alone."""
    groups = len(left_out)
    if groups < 2:
        return {k.name: (k.low, k.high) for k in trial.space.knobs}
    centre = left_out.mean(axis=0)
    error = np.sqrt((groups - 1) / groups * ((left_out - centre) ** 2).sum(axis=0))
    mismatch = SLIDING if set(trial.family.split("+")) & set(SLIDES) else MISMATCH
    # Of a place, a range, a power: a typical change (they have no "off"); of what is refitted beside: 0.
    size = np.array([float(any(k.name.startswith(f"{id}.") for id in trial.ids)) for k in trial.space.knobs])
    size[list(trial.amplitudes)] = np.abs(z - null)[list(trial.amplitudes)]
    width = np.hypot(student.ppf(TRUST, groups - 1) * error, Z * mismatch * size)
    return {
        k.name: (k.value(float(z[n] - width[n])), k.value(float(z[n] + width[n])))
        for n, k in enumerate(trial.space.knobs)
    }
