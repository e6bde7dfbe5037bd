"""How much of what the network does a family of causes explains, on recordings it was not fitted to.

share = 1 - sum |y - A b|^2 / sum |y|^2 over all recordings, b fitted on the others; y, A: columns of `Moments`. Its
null: y with a random sign for every recording, so that a law that holds in one does not hold in another.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from pred_core.diagnose.guard_forces import Moments
from pred_core.diagnose.guard_probes import Probe
from pred_core.errors import DatasetError
from pred_core.types import Array

FLIPS = 256
DRAWS = 2000
MOST_FOLDS = 12
RIDGE = 1e-3  # of a column's own square: breaks ties of columns that are alike
QUIET = 1e-6  # [m] a column's usual size: below, the motions do not excite it


@dataclass(frozen=True)
class Share:
    """A family, alone."""

    family: str
    share: float  # of the variance of what the network does
    low: float  # 95 % interval over recordings
    high: float
    p: float  # family-wise: of as large a share of any family under random signs
    effects: dict[str, float]  # each effect of the family alone
    beyond: float  # what it adds to all other families


@dataclass(frozen=True)
class Model:
    """Columns that are always used, and effects of which one place is chosen on the recordings fitted to."""

    fixed: tuple[int, ...]
    places: tuple[tuple[int, ...], ...] = ()


def shares(m: Moments, probes: Sequence[Probe], rng: np.random.Generator) -> tuple[list[Share], float]:
    """(every family, largest first; the share of all of them together).

    Raises: DatasetError if there are fewer than two recordings.
    """
    if len(m.groups) < 2:
        raise DatasetError(
            "what explains a network is judged on recordings it was not fitted to",
            got="1 recording", allowed="2 or more", next_step="Give a data set with more recordings",
        )  # fmt: skip
    excited = _excited(m)
    models = {f: _model(probes, excited, family=f) for f in dict.fromkeys(p.family for p in probes)}
    models = {f: model for f, model in models.items() if model.fixed or model.places}
    if not models:
        raise DatasetError("no candidate cause moves the object in these episodes", next_step="Give others")
    effects = {i: _model(probes, excited, effect=i) for i in dict.fromkeys(p.effect for p in probes)}
    flips = _flips(len(m.groups), rng)
    squares = m.products[:, -1, -1]
    errors = {f: cross_fitted(m.products, model, flips) for f, model in models.items()}  # (F, G)
    explained = {f: 1.0 - e.sum(axis=1) / squares.sum() for f, e in errors.items()}
    highest = np.max(list(explained.values()), axis=0)
    joint = _alone(m, _all(models.values()))
    draws = rng.integers(0, len(squares), (DRAWS, len(squares)))
    rows = []
    for f in models:
        spread = 1.0 - errors[f][0][draws].sum(axis=1) / squares[draws].sum(axis=1)
        low, high = np.quantile(spread, (0.025, 0.975))
        p = float((highest >= explained[f][0] - 1e-12).mean())
        own = {i: _alone(m, effects[i]) for i in dict.fromkeys(p.effect for p in probes if p.family == f)
               if effects[i].fixed or effects[i].places}  # fmt: skip
        rest = _all(other for g, other in models.items() if g != f)
        beyond = joint - _alone(m, rest)
        rows.append(Share(f, float(explained[f][0]), float(low), float(high), p, own, beyond))
    return sorted(rows, key=lambda s: -s.share), joint


def together(m: Moments, probes: Sequence[Probe], families: Sequence[str]) -> float:
    """Share of several families."""
    excited = _excited(m)
    return _alone(m, _all(_model(probes, excited, family=f) for f in families))


def cross_fitted(products: Array, model: Model, flips: Array) -> Array:
    """(F, G) squared error on each recording; `flips` (F, G) are the signs of y."""
    groups = len(products)
    folds = [np.arange(n, groups, min(groups, MOST_FOLDS)) for n in range(min(groups, MOST_FOLDS))]
    result = np.empty((len(flips), groups))
    size = products.shape[1] - 1
    gram, slope, square = products[:, :size, :size], products[:, :size, -1], products[:, -1, -1]
    for fold in folds:
        rest = np.setdiff1d(np.arange(groups), fold)
        whole = gram[rest].sum(axis=0)
        b = flips[:, rest] @ slope[rest]  # (F, P)
        chosen = _chosen(whole, b, model)
        for columns in set(chosen):
            rows = np.array([n for n, c in enumerate(chosen) if c == columns])
            c = np.array(columns, dtype=np.int64)
            beta = _solved(whole[np.ix_(c, c)], b[np.ix_(rows, c)])
            for g in fold.tolist():
                fitted = np.einsum("fp,pq,fq->f", beta, gram[g][np.ix_(c, c)], beta)
                result[rows, g] = square[g] - 2.0 * flips[rows, g] * (beta @ slope[g][c]) + fitted
    return result


def _chosen(whole: Array, b: Array, model: Model) -> list[tuple[int, ...]]:
    """(F) columns used: of every localized effect the place that alone explains most."""
    rows: list[list[int]] = [list(model.fixed) for _ in range(len(b))]
    for places in model.places:
        c = np.array(places)
        best = c[np.argmax(b[:, c] ** 2 / np.maximum(np.diag(whole)[c], 1e-300), axis=1)]
        for row, place in zip(rows, best.tolist(), strict=True):
            row.append(place)
    return [tuple(row) for row in rows]


def _solved(gram: Array, b: Array) -> Array:
    """(F, P) coefficients, slightly ridged; a column that is zero gets none."""
    scale = np.sqrt(np.diag(gram))
    scale = np.where(scale > 0.0, scale, 1.0)
    normal = gram / np.outer(scale, scale) + RIDGE * np.eye(len(gram))
    return np.asarray(np.linalg.solve(normal, (b / scale).T).T / scale)


def _alone(m: Moments, model: Model) -> float:
    """Share of one model."""
    error = cross_fitted(m.products, model, np.ones((1, len(m.groups))))
    return 1.0 - float(error.sum() / m.products[:, -1, -1].sum())


def _all(models: Iterable[Model]) -> Model:
    rows = list(models)
    return Model(tuple(c for r in rows for c in r.fixed), tuple(p for r in rows for p in r.places))


def _model(probes: Sequence[Probe], excited: Array, family: str = "", effect: str = "") -> Model:
    fixed: list[int] = []
    places: dict[str, list[int]] = {}
    for n, p in enumerate(probes):
        if not excited[n] or (family and p.family != family) or (effect and p.effect != effect):
            continue
        if p.place < 0:
            fixed.append(n)
        else:
            places.setdefault(p.effect, []).append(n)
    return Model(tuple(fixed), tuple(tuple(v) for v in places.values()))


def _excited(m: Moments) -> Array:
    """(P,) bool: columns that act at all, beyond what single precision leaves."""
    return np.asarray(np.sqrt(np.einsum("gpp->gp", m.products).sum(axis=0)[:-1] / max(m.values, 1)) > QUIET)


def _flips(groups: int, rng: np.random.Generator) -> Array:
    """(F, G) signs, the first all +1; all of them where they are few. A common sign changes nothing."""
    if 2 ** (groups - 1) <= FLIPS:
        rows = [(1.0, *s) for s in itertools.product((1.0, -1.0), repeat=groups - 1)]
        return np.array(rows)
    drawn = rng.choice((-1.0, 1.0), (FLIPS, groups))
    drawn[0] = 1.0
    return np.asarray(drawn)
