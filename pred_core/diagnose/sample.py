"""Recordings cut into consecutive windows that the simulator is compared with, and how much each residual counts.

Each window starts from the measured state, so that chaos has little time to grow; what a law remembers is carried
from the window before.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pred_core.bag.clock import on_even_clock
from pred_core.errors import DatasetError
from pred_core.identify.starts import track_noise
from pred_core.identify.windows import Windows, make_windows
from pred_core.train.recordings import Recording, align, start_frames
from pred_core.twin import Twin
from pred_core.types import Array, Episode

LATE = 3  # frames by which a window may start later, where the first is not complete


@dataclass(frozen=True)
class Sample:
    """Episodes of one set, as windows in order: all first windows, all second ones, ..."""

    names: tuple[str, ...]  # (E,) episodes
    groups: NDArray[np.int64]  # (E,) recording of each
    splits: tuple[str, ...]  # (E,)
    windows: Windows  # W windows
    episode: NDArray[np.int64]  # (W,) index into names
    order: NDArray[np.int64]  # (W,) which window of its episode
    frame: NDArray[np.int64]  # (W,) frame of its episode it starts at
    time: Tensor  # (W,) [s] of the session at its start
    noise: float  # [m] of the tracks

    @property
    def episodes(self) -> int:
        """Number of episodes E."""
        return len(self.names)

    def windows_of(self, episodes: Sequence[int]) -> NDArray[np.int64]:
        """Indices of the windows of some episodes, in the order `part` has them."""
        place = {e: n for n, e in enumerate(episodes)}
        keep = np.flatnonzero(np.isin(self.episode, list(episodes)))
        places = np.array([place[e] for e in self.episode[keep].tolist()])
        return np.asarray(keep[np.lexsort((places, self.order[keep]))])

    def part(self, episodes: Sequence[int]) -> Sample:
        """Only some episodes, in the given order."""
        place = {e: n for n, e in enumerate(episodes)}
        some = self.some(self.windows_of(episodes))
        return dataclasses.replace(
            some,
            names=tuple(self.names[e] for e in episodes),
            groups=self.groups[list(episodes)],
            splits=tuple(self.splits[e] for e in episodes),
            episode=np.array([place[e] for e in some.episode.tolist()], dtype=np.int64),
        )

    def some(self, windows: NDArray[np.int64]) -> Sample:
        """Only some windows; the list of episodes stays."""
        rows = torch.as_tensor(windows)
        return dataclasses.replace(
            self,
            windows=_windows_at(self.windows, rows),
            episode=self.episode[windows],
            order=self.order[windows],
            frame=self.frame[windows],
            time=self.time[rows],
        )

    def per_episode(self, values: Array) -> Array:
        """(..., E) mean over each episode's windows of values (..., W)."""
        count = np.bincount(self.episode, minlength=self.episodes)
        total = np.zeros((*values.shape[:-1], self.episodes))
        for w, e in enumerate(self.episode.tolist()):
            total[..., e] += values[..., w]
        return np.asarray(total / np.maximum(count, 1))


def make_sample(
    episodes: Sequence[Episode], twin: Twin, window: float, begin: int | None = None, settle: bool = True
) -> Sample:
    """Windows of `window` [s] of these episodes, one after the other, each as long as the others.

    `begin` [ns]: when the session began; absent: with the first episode. `settle`: starts are estimated over several
    frames, else raw from two. Raises: DatasetError if an episode is too short or has no complete frame to start from.
    """
    even = [on_even_clock(e) for e in episodes]
    period = twin.meta.period
    recordings = [align(e, twin.body, period) for e in even]
    begin = min(int(e.stamps[0]) for e in even) if begin is None else begin
    longest = max(len(r.position) for r in recordings) - 2
    steps = max(1, min(round(window / period), longest))
    pieces = max(1, longest // steps)
    steps = longest // pieces  # the whole episode is used
    rows = [(order, n, f) for n, r in enumerate(recordings) for order, f in enumerate(_starts(r, steps, pieces))]
    missing = sorted(set(range(len(even))) - {n for _, n, _ in rows})
    if missing:
        measured = torch.isfinite(recordings[missing[0]].position).all(dim=-1).sum(dim=0)
        least = int(measured.argmin())
        raise DatasetError(
            f"{even[missing[0]].name}: no window of {steps * period:.3g} s starts from two complete frames",
            got=f"{len(recordings[missing[0]].position)} frames, "
            f"id {int(twin.body.id[least])} in {int(measured[least])}",
            next_step="Leave the episode out, or give a shorter --window",
        )
    rows.sort()
    index = torch.tensor([(n, f) for _, n, f in rows], dtype=torch.int64)
    noise = max(track_noise(recordings), 1e-5)
    return Sample(
        names=tuple(e.name for e in even),
        groups=np.array([e.recording for e in even], dtype=np.int64),
        splits=tuple(e.split for e in even),
        windows=make_windows(recordings, index, steps, period, noise if settle else None),
        episode=np.array([n for _, n, _ in rows], dtype=np.int64),
        order=np.array([o for o, _, _ in rows], dtype=np.int64),
        frame=np.array([f for _, _, f in rows], dtype=np.int64),
        time=torch.tensor([(int(even[n].stamps[f]) - begin) * 1e-9 for _, n, f in rows], dtype=torch.float32),
        noise=noise,
    )


def _starts(recording: Recording, steps: int, pieces: int) -> list[int]:
    """Frames the windows start at: one after the other, a little later where a frame is not complete."""
    usable = start_frames(recording)
    last = len(recording.position) - 1
    starts = []
    for piece in range(pieces):
        wanted = 1 + piece * steps
        reach = min(wanted + LATE, last) if piece else last
        found = [f for f in range(wanted, reach) if bool(usable[f])]
        if found and (piece == 0 or found[0] + steps // 2 <= last):
            starts.append(found[0])
        elif piece == 0:
            return []
    return starts


def _windows_at(windows: Windows, keep: Tensor) -> Windows:
    def rows(values: Tensor, dim: int) -> Tensor:
        return values.index_select(dim, keep)

    s, g, p = windows.start, windows.start_grip, windows.grips
    return Windows(
        start=dataclasses.replace(
            s, position=rows(s.position, 0), velocity=rows(s.velocity, 0), held=rows(s.held, 0)
        ),
        start_grip=dataclasses.replace(
            g, position=rows(g.position, 0), rotation=rows(g.rotation, 0), closed=rows(g.closed, 0)
        ),
        grips=dataclasses.replace(
            p, position=rows(p.position, 1), rotation=rows(p.rotation, 1), closed=rows(p.closed, 1)
        ),
        target=rows(windows.target, 1),
        seen=rows(windows.seen, 1),
        held=rows(windows.held, 1),
        names=tuple(windows.names[k] for k in keep.tolist()),
        groups=tuple(windows.groups[k] for k in keep.tolist()),
    )
