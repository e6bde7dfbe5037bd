"""Where and when the error sits: a twin replayed over recordings, its error against what may explain it.

Conditional means with bands from drawing whole episodes, never frames (Politis, Romano and Wolf 1999, ch. 3: samples
of one recording are not independent).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pred_core.calibration import Calibration
from pred_core.diagnose.roll import FARTHEST, Roller
from pred_core.diagnose.sample import Sample, make_sample
from pred_core.identify.space import Candidate
from pred_core.twin import Twin
from pred_core.types import Array, Episode

WINDOW = 1.0  # [s] between two starts from data: an error is shown where it arises, not where it grew to
LAG = 2  # frames to either side of a measured velocity
TOUCHING = 0.003  # [m] above the table a particle's surface counts as touching, or three times the noise
BINS = 10
FEWEST = 3  # episodes a bin needs to be drawn
DRAWS = 2000


@dataclass(frozen=True)
class Feature:
    """Something the error is held against."""

    key: str
    label: str  # with its unit


FEATURES = (
    Feature("along", "place along the object (0 = its first particle)"),
    Feature("height", "height [m]"),
    Feature("speed", "speed of the particle [m/s]"),
    Feature("contact", "on the table"),
    Feature("session", "time in the recordings [s]"),
    Feature("distance", "distance to the gripper [m]"),
    Feature("drive", "speed of the gripper [m/s]"),
    Feature("since", "time since it started from data [s]"),
)


@dataclass(frozen=True)
class Replay:
    """One twin over recordings, restarted from data every WINDOW."""

    name: str  # "base", "extended", "reference"
    error: Array  # (W, K, N, 3) [m] measured minus predicted; 0 where not seen
    seen: NDArray[np.bool_]  # (W, K, N)
    episode: NDArray[np.int64]  # (W,) which episode
    episodes: int
    place: Array  # (W, K, N, 3) [m] world, measured; NaN where not seen
    features: Mapping[str, Array]  # key -> (W, K, N); NaN where it is not known

    @property
    def size(self) -> Array:
        """(W, K, N) [m] length of the error."""
        return np.asarray(np.linalg.norm(self.error, axis=-1))


@dataclass(frozen=True)
class Curve:
    """Mean error [mm] in bins of a feature, with a 95 % band over episodes; NaN: too few episodes there."""

    center: Array  # (B,) mean of the feature in the bin
    mean: Array  # (B,)
    low: Array  # (B,)
    high: Array  # (B,)


def replay(
    name: str, twin: Twin, episodes: Sequence[Episode], calibration: Calibration, begin: int | None = None
) -> Replay:
    """The twin over these episodes as `calibration` corrects them. `begin` [ns]: when the session began.

    Raises: DatasetError if an episode has no complete frame to start from.
    """
    corrected = [calibration.correct(e) for e in episodes]
    sample = make_sample(corrected, twin, WINDOW, begin)
    error = Roller(twin, sample).errors([Candidate(twin.physics, twin.extensions)])[0]
    w = sample.windows
    seen = w.seen.movedim(0, 1)
    place = torch.where(seen[..., None], w.target.movedim(0, 1), torch.nan).double()
    return Replay(
        name=name,
        error=-error.double().numpy(),
        seen=seen.numpy(),
        episode=sample.episode,
        episodes=sample.episodes,
        place=place.numpy(),
        features={k: v.expand(seen.shape).double().numpy() for k, v in _features(twin, sample, place).items()},
    )


def _features(twin: Twin, sample: Sample, place: Tensor) -> dict[str, Tensor]:
    """Key -> tensor that broadcasts to (W, K, N). `place` (W, K, N, 3) [m], NaN where not seen."""
    w, period = sample.windows, twin.meta.period
    steps = place.shape[1]
    frame = period * torch.arange(1, steps + 1, dtype=torch.float64)
    ground = twin.scene.ground
    found = {
        "along": torch.as_tensor(twin.body.arc).double(),
        "height": place[..., 2] - (ground or 0.0),
        "speed": _velocity(place, period).norm(dim=-1),
        "session": (sample.time.double()[:, None] + frame)[..., None],
        "since": frame[:, None],
    }
    if ground is not None:
        above = place[..., 2] - ground - twin.body.radius
        touching = (above < max(TOUCHING, 3.0 * sample.noise)).double()
        found["contact"] = torch.where(above.isfinite(), touching, torch.nan)
    grips = torch.cat((w.start_grip.position[None], w.grips.position)).movedim(0, 1).double()  # (W, K + 1, G, 3)
    if grips.shape[2]:
        found["distance"] = (place[..., None, :] - grips[:, 1:, None]).norm(dim=-1).amin(dim=-1)
        speed = _velocity(grips, period)[:, 1:].norm(dim=-1).amax(dim=-1)
        found["drive"] = speed[..., None]
    return found


def _velocity(place: Tensor, period: float) -> Tensor:
    """(W, K, ..., 3) [m/s] by central differences over LAG frames to either side."""
    steps = place.shape[1]
    at = torch.arange(steps)
    before, after = (at - LAG).clamp_min(0), (at + LAG).clamp_max(steps - 1)
    seconds = ((after - before).clamp_min(1) * period).reshape(1, -1, *[1] * (place.dim() - 2))
    return (place[:, after] - place[:, before]) / seconds


def edges_of(replay: Replay, key: str, bins: int = BINS) -> Array:
    """Edges (B + 1,) of bins that hold equally much; of a feature with few values, one bin a value."""
    values = replay.features[key][replay.seen & np.isfinite(replay.features[key])]
    if not len(values):
        return np.zeros(0)
    known = np.unique(values)
    if len(known) <= 3 * bins:
        half = np.diff(known).min() / 2 if len(known) > 1 else 0.5
        middles = (known[1:] + known[:-1]) / 2
        return np.concatenate(([known[0] - half], middles, [known[-1] + half]))
    edges = np.unique(np.quantile(values, np.linspace(0.0, 1.0, bins + 1)))
    edges[-1] = np.nextafter(edges[-1], np.inf)
    return np.asarray(edges)


def conditional(replay: Replay, key: str, edges: Array, generator: np.random.Generator) -> Curve:
    """Mean error in the bins of a feature."""
    feature = replay.features[key]
    keep = replay.seen & np.isfinite(feature)
    row = np.broadcast_to(replay.episode[:, None, None], keep.shape)[keep]
    values, bins = feature[keep], len(edges) - 1
    column = np.searchsorted(edges, values, side="right") - 1
    inside = (column >= 0) & (column < bins)
    cell = row[inside] * bins + column[inside]
    shape, total = (replay.episodes, bins), replay.episodes * bins

    def sums(weights: Array | None) -> Array:
        return np.bincount(cell, weights, minlength=total).reshape(shape).astype(np.float64)

    count = sums(None)
    error, place = sums(1e3 * replay.size[keep][inside]), sums(values[inside])
    enough = (count > 0).sum(axis=0) >= min(FEWEST, replay.episodes)
    drawn = generator.multinomial(replay.episodes, np.full(replay.episodes, 1.0 / replay.episodes), DRAWS)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean, center = error.sum(axis=0) / count.sum(axis=0), place.sum(axis=0) / count.sum(axis=0)
        means = (drawn @ error) / (drawn @ count)
    low, high = np.full(bins, np.nan), np.full(bins, np.nan)
    for b in np.flatnonzero(enough):
        low[b], high[b] = np.nanquantile(means[:, b], [0.025, 0.975])
    return Curve(center, np.where(enough, mean, np.nan), low, high)


@dataclass(frozen=True)
class Above:
    """The error seen from above, in square cells; NaN: too few episodes there."""

    x: Array  # (X + 1,) [m] edges
    y: Array  # (Y + 1,)
    mean: Array  # (Y, X) [mm] mean length of the error
    pull: Array  # (Y, X, 2) [mm] mean of measured minus predicted, along x and y


def grid_of(replays: Sequence[Replay], cells: int = 16) -> tuple[Array, Array]:
    """Edges in x and y of square cells over everything measured, at most `cells` a side."""
    every = np.concatenate([r.place[r.seen][:, :2] for r in replays])
    low, high = every.min(axis=0), every.max(axis=0)
    side = max(float((high - low).max()) / cells, 1e-3)
    count = [max(1, math.ceil(float(v) / side)) for v in high - low]
    middle = (low + high) / 2
    x, y = (m + side * (np.arange(n + 1) - n / 2) for m, n in zip(middle, count, strict=True))
    return x, y


def from_above(replay: Replay, x: Array, y: Array) -> Above:
    """Mean error in the cells of a grid."""
    place, error = replay.place[replay.seen][:, :2], 1e3 * replay.error[replay.seen]
    row = np.broadcast_to(replay.episode[:, None, None], replay.seen.shape)[replay.seen]
    column = np.clip(np.searchsorted(x, place[:, 0], side="right") - 1, 0, len(x) - 2)
    line = np.clip(np.searchsorted(y, place[:, 1], side="right") - 1, 0, len(y) - 2)
    shape = (len(y) - 1, len(x) - 1)
    cell, cells = line * shape[1] + column, shape[0] * shape[1]
    count = np.bincount(cell, minlength=cells).astype(np.float64)
    visits = np.bincount(np.unique(np.stack((cell, row)), axis=1)[0], minlength=cells)

    def mean(values: Array) -> Array:
        with np.errstate(invalid="ignore", divide="ignore"):
            result = np.bincount(cell, values, minlength=cells) / count
        return np.where(visits >= min(2, replay.episodes), result, np.nan).reshape(shape)

    size = np.minimum(np.linalg.norm(error, axis=1), 1e3 * FARTHEST)
    return Above(x, y, mean(size), np.stack((mean(error[:, 0]), mean(error[:, 1])), axis=-1))


def pull_along(replay: Replay, arc: Array) -> Array:
    """(N, 3) [mm] mean of measured minus predicted for each particle, along x, y, z; NaN: never seen. arc (N,)."""
    count = replay.seen.sum(axis=(0, 1)).astype(np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(1e3 * replay.error.sum(axis=(0, 1)) / count[:, None])[np.argsort(arc, kind="stable")]
