"""Data of a spring-mass model written anew: plain numpy, float64, finer steps; no code of the simulator under test.

Springs with F = k (l/l0 - 1) + c dl/dt, bending of a line by angle, drag, ground with Coulomb friction,
semi-implicit Euler.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from pred_core.bag.dataset import Dataset, EpisodeEntry, write_dataset
from pred_core.bag.episode import write_episode
from pred_core.types import STANDARD_GRAVITY, Array, Episode, Grip, ObjectInfo, Tracks


@dataclass(frozen=True)
class Plant:
    """An object at rest, its springs, and the planted values."""

    kind: str
    rest: Array  # (N, 3) [m]
    springs: NDArray[np.int64]  # (S, 2) indices
    held: tuple[int, ...]  # particles that gripper 0, 1, ... holds, one each
    mass: float = 0.05  # [kg] of all particles
    stiffness: float = 30.0  # [N]
    damping: float = 0.02  # [N s/m]
    bending: float = 0.0  # [N m^2], lines only
    drag: float = 0.0  # [1/s]
    friction: float = 0.0
    ground: float | None = None  # [m]
    fps: float = 50.0  # [Hz]
    substeps: int = 40
    lead: float = 0.0  # [s] simulated before the recording begins, with more drag: the object comes to rest

    def particle_mass(self) -> Array:
        """(N, 1) [kg]: a line's ends stand for half an edge, elsewhere every particle weighs the same."""
        share = np.ones((len(self.rest), 1))
        if self.kind == "line":
            share[[0, -1]] = 0.5
        return self.mass * share / share.sum()

    def episodes(self, grips: Array, noise: float = 0.0, seed: int = 0) -> list[Episode]:
        """One episode for each gripper motion in (E, T, G, 3) [m], without the lead."""
        begin = round(self.lead * self.fps)
        tracks, grips = self.simulate(grips)[:, begin:], grips[:, begin:]
        tracks = tracks + np.random.default_rng(seed).normal(0.0, 1.0, tracks.shape) * noise
        return [self.episode(e, tracks[e], grips[e]) for e in range(len(grips))]

    def simulate(self, grips: Array) -> Array:
        """(E, T, N, 3) [m] for gripper positions (E, T, G, 3), whose first frame sits at the held particles."""
        count, frames = grips.shape[:2]
        h = 1.0 / self.fps / self.substeps
        x = np.repeat(self.rest[None], count, axis=0).astype(np.float64)
        x[:, self.held] = grips[:, 0]
        v, mass = np.zeros_like(x), self.particle_mass()
        i, j = self.springs.T
        length0 = np.linalg.norm(self.rest[j] - self.rest[i], axis=1)[:, None]
        gather = np.zeros((len(self.rest), len(self.springs)))  # (N, S) sums spring forces at their ends
        gather[i, np.arange(len(self.springs))] += 1.0
        gather[j, np.arange(len(self.springs))] -= 1.0
        out = [x.copy()]
        for t in range(1, frames):
            drag = self.drag if t > self.lead * self.fps else 6.0
            speed = (grips[:, t] - grips[:, t - 1]) * self.fps
            for s in range(self.substeps):
                d, u = x[:, j] - x[:, i], v[:, j] - v[:, i]
                length = np.linalg.norm(d, axis=2, keepdims=True)
                n = d / length
                pull = (self.stiffness * (length / length0 - 1) + self.damping * (u * n).sum(2, keepdims=True)) * n
                force = np.zeros_like(x)
                force += gather @ pull
                if self.bending:
                    force += self._bend(x)
                v += h * (force / mass + np.array(STANDARD_GRAVITY) - drag * v)
                if self.ground is not None:
                    low = x[..., 2] + h * v[..., 2] < self.ground
                    lift = np.where(low, (self.ground - x[..., 2]) / h - v[..., 2], 0.0)
                    slide = np.linalg.norm(v[..., :2], axis=2)
                    v[..., :2] *= (1 - np.minimum(1.0, self.friction * lift / np.maximum(slide, 1e-12)))[..., None]
                    v[..., 2] += lift
                x += h * v
                a = (s + 1) / self.substeps
                x[:, self.held] = (1 - a) * grips[:, t - 1] + a * grips[:, t]
                v[:, self.held] = speed
            out.append(x.copy())
        return np.stack(out, axis=1)

    def _bend(self, x: Array) -> Array:
        """Minus the gradient of EI/(2 l) |2 tan(angle/2)|^2 at every inner particle (Bergou 2008), numerically exact.

        |kb|^2 = 4 (1 - c)/(1 + c) with c the cosine between edges, so its derivative by c is -8/(1 + c)^2.
        """
        edge = np.diff(x, axis=1)
        length = np.linalg.norm(edge, axis=2, keepdims=True)
        t = edge / length
        a, b = t[:, :-1], t[:, 1:]
        c = (a * b).sum(2, keepdims=True)
        rest = np.linalg.norm(np.diff(self.rest, axis=0), axis=1)
        lbar = 0.5 * (rest[:-1] + rest[1:])[None, :, None]
        slope = -self.bending / (2 * lbar) * -8.0 / (1 + c) ** 2  # minus dE/dc
        ga = slope * (b - c * a) / length[:, :-1]  # force by moving the end of edge a
        gb = slope * (a - c * b) / length[:, 1:]
        force = np.zeros_like(x)
        force[:, :-2] -= ga
        force[:, 1:-1] += ga - gb
        force[:, 2:] += gb
        return force

    def episode(self, number: int, track: Array, grips: Array) -> Episode:
        """Tracks (T, N, 3) and gripper positions (T, G, 3) as an episode."""
        frames, count = track.shape[:2]
        stamps = 10**9 + np.arange(frames, dtype=np.int64) * round(1e9 / self.fps)
        held = np.full(count, -1, np.int32)
        held[list(self.held)] = np.arange(len(self.held))
        seen: NDArray[np.bool_] = np.logical_and.reduce(np.isfinite(track), axis=-1)
        rotation = torch.zeros(frames, len(self.held), 4)
        rotation[..., 0] = 1.0
        return Episode(
            name=f"ep{number:03d}",
            object=ObjectInfo("planted", self.kind),
            stamps=stamps,
            tracks=Tracks(stamps, track, np.arange(count, dtype=np.uint32), seen, np.asarray(seen, np.float32)),
            grips=Grip(
                torch.as_tensor(grips, dtype=torch.float32),
                rotation,
                torch.ones(frames, len(self.held), dtype=torch.bool),
            ),
            held=held,
            split="train",
            recording=number,
        )


def write(
    root: Path,
    plant: Plant,
    episodes: list[Episode],
    sigma: float | None = 0.0,
    gravity: tuple[float, float, float] = STANDARD_GRAVITY,
) -> Dataset:
    """The episodes as a data set of bags."""
    entries = []
    for e in episodes:
        write_episode(root / f"{e.name}.mcap", e)
        entries.append(EpisodeEntry(f"{e.name}.mcap", e.split, e.recording))
    return write_dataset(
        root,
        object=episodes[0].object,
        rate=plant.fps,
        entries=entries,
        sigma=sigma,
        gravity=gravity,
        held={p: g for g, p in enumerate(plant.held)},
        known={"mass": plant.mass},
    )


def line(count: int = 10, length: float = 0.45, height: float = 0.8, **values: object) -> Plant:
    """A line along x, springs between neighbours, hanging from its first particle or from both ends."""
    rest = np.zeros((count, 3))
    rest[:, 0] = np.linspace(0.0, length, count)
    rest[:, 2] = height
    springs = np.stack((np.arange(count - 1), np.arange(1, count)), axis=1)
    return Plant("line", rest, springs, **{"held": (0, count - 1), **values})  # type: ignore[arg-type]


def sheet(rows: int, columns: int, spacing: float = 0.05, reach: float = 1.5, **values: object) -> Plant:
    """A horizontal grid with springs to all particles within `reach` spacings, held at two corners."""
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    rest = np.stack((x.ravel(), y.ravel(), np.zeros(x.size)), axis=1) * spacing
    rest += np.random.default_rng(0).uniform(-0.05, 0.05, rest.shape) * spacing * np.array([1, 1, 0])
    d = np.linalg.norm(rest[:, None] - rest[None], axis=2)
    i, j = np.nonzero(np.triu(d <= reach * spacing, 1))
    return Plant("sheet", rest, np.stack((i, j), axis=1), **{"held": (0, columns - 1), **values})  # type: ignore[arg-type]


def waves(plant: Plant, episodes: int, seconds: float, seed: int = 0, size: float = 0.05, inward: float = 0.0) -> Array:
    """Gripper motions (E, T, G, 3) [m]: sums of two sines; two grippers come together by `inward` [m] in the lead."""
    rng = np.random.default_rng(seed)
    time = np.arange(round((plant.lead + seconds) * plant.fps)) / plant.fps - plant.lead
    shape = (episodes, 1, len(plant.held), 3, 2)
    rate, phase = rng.uniform(0.4, 1.6, shape), rng.uniform(0, 6.28, shape)
    amplitude = rng.uniform(0.3, 1.0, shape) * size
    angle = 2 * np.pi * rate * time[None, :, None, None, None] + phase
    motion = _fade(time / 0.4)[None, :, None, None] * (amplitude * np.sin(angle)).sum(-1)
    if inward:
        across = plant.rest[plant.held[1]] - plant.rest[plant.held[0]]
        across /= np.linalg.norm(across)
        together = inward / 2 * _fade((time + plant.lead) / 0.4)[None, :, None] * across
        motion[:, :, 0] += together
        motion[:, :, 1] -= together
    return np.asarray(plant.rest[list(plant.held)] + motion)


def _fade(x: Array) -> Array:
    x = np.clip(x, 0, 1)
    return np.asarray(x**2 * (3 - 2 * x))
