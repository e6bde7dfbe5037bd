"""What the diagnosis starts from: samples of both sets, the twin made as good as it gets on the reference, weights."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from pred_core.config import from_mapping
from pred_core.diagnose.config import DiagnoseConfig
from pred_core.diagnose.effort import say_effort
from pred_core.diagnose.fit import Fit, Target, fit, rho
from pred_core.diagnose.journal import Journal, vector
from pred_core.diagnose.judge import Bench, Tell, scaled
from pred_core.diagnose.roll import Roller
from pred_core.diagnose.sample import Sample, make_sample
from pred_core.diagnose.trial import Trial, make_trial
from pred_core.diagnose.weigh import Weights, misfit_of, seen_of, weigh
from pred_core.effects import effect_of, find_effect
from pred_core.effects.effect import Effect
from pred_core.errors import ConfigError, DatasetError
from pred_core.identify.space import Candidate, Knob
from pred_core.twin import Extension, Twin
from pred_core.types import Array, Episode, Physics

BASE = ("stiffness", "ground_friction", "bending_stiffness")  # refined; axial damping does not show
ROOM = 2.0  # times the substeps of the given twin that the refined one may need: identified for speed, it may stretch
WORST = 0.25  # [m] mean error of a twin that is not this object's
OWN_MISFIT = 0.02  # of the variance a base leaves that weights allow for without a reference
POLISH = 8  # steps of the base's refinement
TIMES = tuple(float(f) for f in np.geomspace(0.1, 10.0, 17))  # what each of its numbers is multiplied by first
CLOSER = (0.8, 0.9, 1.1, 1.25)  # the same once another valley was found, with weights that are of it
FEW, SWEEPS = 16, 4  # windows in which they are tried; how often, as long as it helps
VALLEY = 0.8  # of the loss to which the base was refined: what another start must come to, to take its place
SLOWER, FASTER = 0.5, 2.0  # of the loss that the base has: below it a point may need so many times what ROOM allows
GROWS = 1.3  # times the substeps of such a point that a refinement from it may need
TURNS = 0.97  # of the loss, to which another value must bring it to be taken: what does not act stays as it is


def base_fields(twin: Twin) -> tuple[str, ...]:
    """Physics fields that act in this twin and may be refined."""
    acts = {
        "ground_friction": twin.scene.ground is not None or bool(twin.scene.fixtures),
        "bending_stiffness": twin.physics.bending_stiffness > 0.0,
    }
    return tuple(f for f in BASE if acts.get(f, True))


def commission(
    twin: Twin,
    suspect: Sequence[Episode],
    reference: Sequence[Episode],
    config: DiagnoseConfig,
    tell: Tell,
    journal: Journal,
    session: int | None = None,
) -> Bench:
    """The bench. With a reference the base is refined on it and frozen; without one, on the suspect set's train
    episodes, and every candidate refits it.

    Raises: DatasetError if the twin does not describe the data at all.
    """
    sample = make_sample(suspect, twin, config.window, session, config.settle)
    known = make_sample(reference, twin, config.window, None, config.settle) if reference else None
    judged_on = known or sample
    frames = len(sample.windows.target)
    if config.stride > frames:
        raise ConfigError(
            "stride", got=f"{config.stride} frames", allowed=f"at most {frames}, the length of a window",
            next_step="Give a smaller --stride or a longer --window",
        )  # fmt: skip
    use = np.array([s == "train" for s in judged_on.splits])
    if not use.any():  # a reference of test episodes alone
        use[:] = True
    say_effort(Roller(twin, sample), config, tell)
    _check(Roller(twin, judged_on), judged_on, twin)
    given = twin
    twin = journal.piece(
        "base", lambda: values_of(_polish(given, judged_on, use, config, tell)), lambda v: with_stored(given, v)
    )
    roller = Roller(twin, judged_on)
    as_it_is = Candidate(twin.physics, twin.extensions)
    plain = _weigh(roller, as_it_is, config, None)
    errors = roller.errors([as_it_is], config.stride)[0]
    misfit = misfit_of(errors, seen_of(roller, config.stride), plain)
    if known is None:  # the suspect's own misfit holds what is looked for: little of it is taken as the model's
        misfit = OWN_MISFIT * misfit
    own = Roller(twin, sample)
    target = Target(own, _weigh(own, as_it_is, config, misfit), config.stride)
    other = None
    if known is not None:
        other = Target(roller, _weigh(roller, as_it_is, config, misfit), config.stride)
    physics = () if known is not None else base_fields(twin)
    train = np.flatnonzero(np.array([s == "train" for s in sample.splits]))
    return scaled(Bench(twin, target, target.part(train.tolist()), twin, other, config, (), physics))


def _weigh(roller: Roller, candidate: Candidate, config: DiagnoseConfig, misfit: Tensor | None) -> Weights:
    return weigh(roller, candidate, config.stride, misfit, config.seed, config.chaos_weights)


def with_values(twin: Twin, candidate: Candidate) -> Twin:
    """The twin at a point of a search."""
    return twin.replace(physics=candidate.physics, extensions=_kept_evidence(twin, candidate))


def _kept_evidence(twin: Twin, candidate: Candidate) -> tuple[Extension, ...]:
    known = {e.id: e.evidence for e in twin.extensions}
    return tuple(dataclasses.replace(e, evidence=known.get(e.id, {})) for e in candidate.extensions)


def values_of(twin: Twin) -> dict[str, Any]:
    """The values of a base that a refinement may change."""
    return {
        "physics": dataclasses.asdict(twin.physics),
        "extensions": [{k: list(v) for k, v in e.parameters.items()} for e in twin.extensions],
    }


def with_stored(twin: Twin, values: dict[str, Any]) -> Twin:
    """The twin at stored values. Raises: KeyError, TypeError or ValueError if they are not of this twin, or lie outside
    what their parameters allow."""
    extensions = tuple(
        dataclasses.replace(e, parameters={k: tuple(found[k]) for k in e.parameters})
        for e, found in zip(twin.extensions, values["extensions"], strict=True)
    )
    numbers = [*values["physics"].values(), *(v for e in extensions for row in e.parameters.values() for v in row)]
    vector(numbers, len(numbers))
    for e in extensions:
        effect_of(e)
    physics = {f.name: values["physics"][f.name] for f in dataclasses.fields(Physics)}  # all, none by its default
    return twin.replace(physics=from_mapping(Physics, physics, "physics"), extensions=extensions)


def _polish(twin: Twin, sample: Sample, use: NDArray[np.bool_], config: DiagnoseConfig, tell: Tell) -> Twin:
    """The base and what it already carries, refined on the sample with the loss the candidates are judged by."""
    most = ROOM * Roller(twin, sample).usual()
    times: tuple[float, ...] = TIMES
    for _ in range(2):  # the weights follow the parameters
        roller = Roller(twin, sample)
        weights = _weigh(roller, Candidate(twin.physics, twin.extensions), config, None)
        target = Target(roller, weights, config.stride)
        standing = tuple(find_effect(e.id) for e in twin.extensions)
        narrow = tuple(e for e in standing if sum(q.size for q in e.parameters) <= 4)
        trial = make_trial(twin, narrow, base_fields(twin))
        start = trial.space.start()
        before = target.losses(trial.space, [start])[0]
        result = fit(target, trial.space, start, POLISH, use, most / roller.usual())
        other = _elsewhere(target, trial, result.z, use, most, times)
        times = ()
        if other is not None and other.loss[use].mean() < VALLEY * result.loss[use].mean():
            result, times = other, CLOSER
            most = max(most, GROWS * roller.demand(trial.space.candidate(result.z)))
        tell(f"base: loss {before[use].mean():.3f} -> {result.loss[use].mean():.3f}")
        twin = with_values(twin, trial.space.candidate(result.z))
        if result.loss[use].mean() > TURNS * before[use].mean():
            break
    return twin


def _elsewhere(
    target: Target, trial: Trial, refined: Array, use: NDArray[np.bool_], most: float, times: Sequence[float]
) -> Fit | None:
    """A refinement from another point than the base; None if no point is better than `refined`.

    Each number of the twin is multiplied by `times` in turn, as far as `most` substeps a period allow: the loss along a
    stiffness that is three times too large has valleys of its own.
    """
    if not times:
        return None
    space, sample = trial.space, target.roller.sample
    windows = np.flatnonzero(use[sample.episode])
    few = target.some(windows[np.linspace(0, len(windows) - 1, min(FEW, len(windows))).astype(np.int64)])

    def losses(points: Sequence[Array]) -> Array:
        return few.per_window(rho(few.residuals(space, points))).mean(axis=1)

    best = space.start()
    standing, aim = losses([best, refined])
    least = standing
    numbers = [(n, k) for n, k in enumerate(space.knobs) if "." not in k.name]
    for _ in range(SWEEPS):
        before = least
        for n, knob in numbers:
            points = [_with_one(best, n, knob, factor * knob.value(float(best[n]))) for factor in times]
            needed = np.array([target.roller.demand(space.candidate(z)) for z in points])
            slow = (most < needed) & (needed <= FASTER * most)
            for bound, fits in ((np.inf, needed <= most), (SLOWER * standing, slow)):
                possible = [z for z, ok in zip(points, fits, strict=True) if ok]
                tried = losses(possible) if possible else np.array([np.inf])
                if tried.min() < min(TURNS * least, bound):
                    best, least = possible[int(tried.argmin())], float(tried.min())
        if least > TURNS * before:
            break
    if least >= aim:
        return None
    room = most / max(target.roller.usual(), target.roller.demand(space.candidate(best)))
    return fit(target, space, best, POLISH, use, max(room, GROWS))


def _with_one(z: Array, n: int, knob: Knob, value: float) -> Array:
    """`z` with another value of one knob, within its bounds."""
    other = z.copy()
    other[n] = knob.coordinate(float(np.clip(value, knob.low, knob.high)))
    return other


def refined(
    twin: Twin, target: Target, tell: Tell | None, steps: int = 8, beside: tuple[type[Effect], ...] = ()
) -> Twin:
    """The base, and effects `beside` it, refined on a target whose weights stay."""
    own = dataclasses.replace(target, roller=Roller(twin, target.roller.sample))
    trial = make_trial(twin, beside, base_fields(twin))
    result = fit(own, trial.space, trial.space.start(), steps)
    if tell is not None:
        tell(f"base: loss {result.loss.mean():.3f}")
    return with_values(twin, trial.space.candidate(result.z))


def _check(roller: Roller, sample: Sample, twin: Twin) -> None:
    """Raise DatasetError if the twin is far from the data from the beginning."""
    errors = roller.errors([Candidate(twin.physics, twin.extensions)], 2)[0]
    seen = seen_of(roller, 2)
    per = sample.per_episode((errors.norm(dim=-1).sum((1, 2)) / seen.sum((1, 2)).clamp_min(1)).double().numpy())
    worst = int(per.argmax())
    if float(np.median(per)) > WORST:
        raise DatasetError(
            f"{sample.names[worst]}: the twin diverges or is not of this object",
            got=f"a median error of {np.median(per):.2f} m",
            allowed=f"below {WORST} m",
            next_step="Identify a twin from this data set or its reference first",
        )
