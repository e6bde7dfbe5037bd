"""What is evaluated: twins in three stages, and the baselines. Each is rebuilt for every fold."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pred_core.baselines import BlendedEnds, ConstantVelocity, LastResidual, Persistence, fit_static_regression
from pred_core.calibration import Calibration
from pred_core.dynamics import Dynamics
from pred_core.effects import find_effect
from pred_core.errors import ConfigError, DatasetError, TwinError, nearest
from pred_core.evaluate.splits import HashedFold
from pred_core.pred import load_dynamics
from pred_core.twin import Twin
from pred_core.types import Episode

BASELINES = ("persistence", "constant-velocity", "blended-ends", "static-regression", "last-residual")
DIAGNOSIS = "pred diagnose"  # what it writes as `found_by` into the evidence of an extension
Build = Callable[[Sequence[Episode], Sequence[Episode], int | None], Dynamics]


@dataclass(frozen=True)
class Model:
    """`build(test, train, fold)`: the Dynamics for a fold (None: the published split).

    It reads of `test` only what every start needs (period, particle count, what is held), never motion.
    """

    name: str
    digest: str  # changes whenever predictions may change
    build: Build
    fold_twins: int | None = None  # number of twins for the folds of a grouped split; None: it refits itself
    lacking: str = ""  # why the fold twins are not this model; "": they are
    fitted_on: tuple[str, ...] = ()  # sha256 of the bags the twin saw
    fold_fitted_on: tuple[tuple[str, ...], ...] = ()  # the same of every fold twin; empty where it stores none
    drifts: bool = False  # something in it changes over a session: its predictions go by the session's clock


@dataclass(frozen=True)
class NamedTwin:
    """A twin to evaluate; `folds` are twins fitted without each fold of the grouped split (or none)."""

    name: str  # "" = the stages are called spring-mass, extended and pred
    twin: Twin
    folds: tuple[Twin, ...] = ()


def twin_models(named: NamedTwin) -> list[Model]:
    """The stages of a twin: spring-mass alone, with extensions, with the learned residual.

    An unnamed twin gives one model a stage it has; a named one gives itself in full. The spring-mass stage of a twin
    that carries its base is that base, which was identified by itself; parameters refitted together with
    extensions would make a straw man of it.
    """
    twin = named.twin
    if named.name:
        return [_twin_model(named.name, named, extensions=True, residual=True)]
    if twin.base is not None:
        models = [_base_model(named, twin.base)]
    else:
        models = [_twin_model("spring-mass", named, extensions=False, residual=False)]
    if twin.extensions:
        models.append(_twin_model("extended", named, extensions=True, residual=False))
    if twin.residual is not None:
        models.append(_twin_model("pred", named, extensions=True, residual=True))
    return models


def baseline_models(names: Sequence[str], base: NamedTwin | None) -> list[Model]:
    """Baselines by name. `base`: the twin whose last residual is repeated.

    Raises: ConfigError for an unknown name, or for last-residual without a twin.
    """
    return [_baseline(name, base) for name in names]


def check_fits(twin: Twin, episode: Episode, name: str) -> None:
    """Raise TwinError unless the twin's particles are those of the episode, in the same order."""
    if np.array_equal(twin.body.id, episode.tracks.id):
        return
    raise TwinError(
        f"twin '{name}' does not fit {episode.name}: particle ids differ",
        got=f"{twin.body.count} particles, ids {_short(twin.body.id)}",
        allowed=f"{len(episode.tracks.id)} particles, ids {_short(episode.tracks.id)}",
        next_step="Identify a twin on this data set: pred identify DATASET --out TWIN",
    )


def shared_calibration(twins: Sequence[NamedTwin]) -> Calibration:
    """What the data are corrected by, for every model alike: the calibration of the twins that have one.

    Raises: TwinError if two have different ones.
    """
    found = Calibration()
    for named in twins:
        for twin in (named.twin, *named.folds):
            if twin.calibration.identity or twin.calibration == found:
                continue
            if not found.identity:
                raise TwinError(
                    "twins have different calibrations", got=f"'{named.name}' differs from one before it",
                    next_step="Evaluate them one by one",
                )
            found = twin.calibration
    return found


def check_unseen(model: Model, folds: Sequence[HashedFold]) -> None:
    """Raise TwinError if a fold twin was fitted on a bag its fold tests. A twin that stores no hashes passes."""
    for index, (fold, seen) in enumerate(zip(folds, model.fold_fitted_on, strict=False)):
        leaked = [e.bag for e, sha in zip(fold.test, fold.test_hashes, strict=True) if sha in set(seen)]
        if leaked:
            raise TwinError(
                f"'{model.name}': the twin of fold {index} was fitted on {leaked[0]}, which that fold tests",
                got=f"{len(leaked)} of {len(fold.test)} tested bags",
                allowed="none",
                next_step="Fit it without that fold's recordings, with the same --folds",
            )


def _base_model(named: NamedTwin, base: Twin) -> Model:
    bases = tuple(t.base for t in named.folds if t.base is not None)
    if len(bases) == len(named.folds):
        return _twin_model("spring-mass", NamedTwin("", base, bases), extensions=True, residual=False)
    model = _twin_model("spring-mass", NamedTwin("", base), extensions=True, residual=False)
    return dataclasses.replace(model, fold_twins=len(named.folds), lacking="fold twins have no base")


def _lacking(named: NamedTwin, extensions: bool, residual: bool) -> str:
    """In which part the fold twins differ from the twin; "" if in none that this model uses."""
    for index, fold in enumerate(named.folds):
        if residual and (fold.residual is None) != (named.twin.residual is None):
            return "fold twins have no residual" if fold.residual is None else "only the fold twins have a residual"
        have, wanted = ({e.id for e in t.extensions} for t in (fold, named.twin))
        if extensions and have != wanted:
            return (f"the twin of fold {index} has extensions {', '.join(sorted(have)) or 'none'}, the twin has "
                    f"{', '.join(sorted(wanted)) or 'none'}")
    return ""


def _twin_model(name: str, named: NamedTwin, *, extensions: bool, residual: bool) -> Model:
    def build(test: Sequence[Episode], train: Sequence[Episode], fold: int | None) -> Dynamics:
        if fold is not None and fold >= len(named.folds):
            raise TwinError(
                f"'{name}' has no twin for fold {fold}", got=f"{len(named.folds)} fold twins",
                next_step="Fit one without that fold's recordings and pass --fold-twins",
            )
        twin = named.twin if fold is None else named.folds[fold]
        check_fits(twin, test[0], name)
        return load_dynamics(twin, extensions=extensions, residual=residual)

    twins = (named.twin, *named.folds)
    drifts = extensions and any(_drifts(t) and not (residual and t.residual is not None) for t in twins)
    digests = [t.digest() for t in twins]
    return Model(
        name, f"{' '.join(digests)} extensions={extensions} residual={residual}", build, len(named.folds),
        _lacking(named, extensions, residual), named.twin.meta.data, tuple(t.meta.data for t in named.folds),
        drifts,
    )  # fmt: skip


def _drifts(twin: Twin) -> bool:
    """Whether a diagnosis found that something drifts. `pred identify` and `pred train` have the clock of what drifts
    at 0 wherever they start, so what they make is scored on that clock."""
    return any(find_effect(e.id).family == "drift" and e.evidence.get("found_by") == DIAGNOSIS for e in twin.extensions)


def _baseline(name: str, base: NamedTwin | None) -> Model:
    if name not in BASELINES:
        raise ConfigError(f"unknown baseline '{name}'", next_step=nearest(name, BASELINES))
    if name == "last-residual":
        if base is None:
            raise ConfigError("last-residual repeats the residual of a twin", next_step="Name one with --twin")
        stage = _twin_model(f"last-residual on {base.name or 'the twin'}", base, extensions=True, residual=False)
        return dataclasses.replace(
            stage, name=name, digest=f"{name} {stage.digest}", build=lambda *args: LastResidual(stage.build(*args))
        )
    return Model(name, name, _BUILD[name])


def _persistence(test: Sequence[Episode], train: Sequence[Episode], fold: int | None) -> Dynamics:
    return Persistence(test[0].period)


def _constant_velocity(test: Sequence[Episode], train: Sequence[Episode], fold: int | None) -> Dynamics:
    return ConstantVelocity(test[0].period)


def _blended_ends(test: Sequence[Episode], train: Sequence[Episode], fold: int | None) -> Dynamics:
    if test[0].object.kind != "line":
        raise DatasetError("blended-ends is defined for lines", got=test[0].object.kind)
    return BlendedEnds.by_order(test[0].period, len(test[0].tracks.id))


def _static_regression(test: Sequence[Episode], train: Sequence[Episode], fold: int | None) -> Dynamics:
    return fit_static_regression(train)


_BUILD: dict[str, Build] = {
    "persistence": _persistence,
    "constant-velocity": _constant_velocity,
    "blended-ends": _blended_ends,
    "static-regression": _static_regression,
}


def _short(ids: np.ndarray) -> str:
    listed = ids.tolist()
    return str(listed) if len(listed) <= 6 else f"[{listed[0]}, {listed[1]}, ..., {listed[-1]}]"
