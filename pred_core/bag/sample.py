"""A small synthetic data set: a hanging cable whose two clamped ends are moved.

It stands in where no measured data are at hand. The cable is a chain of its own, finer than the tracks
(34 nodes for 12 particles), in plain numpy and float64; it shares no code with the simulator that predicts it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from pred_core.bag.dataset import Dataset, EpisodeEntry, write_dataset
from pred_core.bag.deform import FIRST_STAMP, Progress, claim_folder
from pred_core.bag.episode import write_episode
from pred_core.types import STANDARD_GRAVITY, Episode, Grip, ObjectInfo, Tracks

Array = NDArray[np.float64]
HELD = {0: 0, 1: 0, 10: 1, 11: 1}  # each gripper clamps the two particles at its end
CLAMPED = 4  # nodes a gripper holds: those of its two particles and the two between them


@dataclass(frozen=True)
class SampleCable:
    """The planted physics and the recording."""

    length: float = 0.99  # [m]
    mass: float = 0.05  # [kg]
    nodes: int = 34  # of the chain
    every: int = 3  # a particle is every third node
    axial: float = 300.0  # [N] force per unit strain
    bending: float = 3e-4  # [N m^2] EI
    rest_curvature: float = 0.6  # [1/m] the cable came off a spool
    axial_damping: float = 0.02  # [N s/m] along each segment
    drag: float = 0.4  # [1/s] force per mass and speed
    rate: float = 100.0  # [Hz]
    substeps: int = 100  # a frame; a segment's fastest motion needs steps below 0.38 ms
    seconds: float = 3.0  # [s] an episode
    settle: float = 2.0  # [s] at rest before it, with strong drag
    noise: float = 1e-4  # [m] standard deviation a coordinate
    splits: tuple[str, ...] = ("train", "train", "train", "train", "test", "test")
    seed: int = 7


def write_sample(root: Path, progress: Progress, cable: SampleCable | None = None) -> Dataset:
    """Simulate the episodes and write them as a data set. Raises: DatasetError if `root` holds something else."""
    cable = cable or SampleCable()
    claim_folder(root, {"source": "sample_cable", "synthetic": True, "seed": cable.seed, "format": 1})
    episodes = make_episodes(cable, np.random.default_rng(cable.seed), progress)
    for episode in episodes:
        write_episode(root / f"{episode.name}.mcap", episode)
    return write_dataset(
        root,
        object=episodes[0].object,
        rate=cable.rate,
        entries=[EpisodeEntry(f"{e.name}.mcap", e.split, e.recording) for e in episodes],
        sigma=cable.noise,
        held=HELD,
        known={"mass": cable.mass},
    )


def make_episodes(cable: SampleCable, generator: np.random.Generator, progress: Progress) -> list[Episode]:
    """The episodes, simulated side by side; each is a recording of its own."""
    batch, frames = len(cable.splits), round(cable.seconds * cable.rate)
    motion = _Motion.draw(generator, batch)
    times = np.arange(frames) / cable.rate
    node = _simulate(cable, motion, frames, progress)
    track = node[:, :, :: cable.every] + generator.normal(0.0, cable.noise, (batch, frames, 12, 3))
    poses = [motion.pose(t) for t in times]
    return [_episode(cable, e, track[e], poses) for e in range(batch)]


@dataclass(frozen=True)
class _Motion:
    """Gripper motion: sums of two sines an axis, faded in over half a second. Axes (episode, gripper, sine, xyz)."""

    amplitude: Array  # [m]
    frequency: Array  # [Hz]
    phase: Array  # [rad]
    tilt: Array  # (episode, gripper, 2) [rad] about y and z
    tilt_frequency: Array  # [Hz]

    @staticmethod
    def draw(generator: np.random.Generator, batch: int) -> _Motion:
        """Another motion for every episode and gripper."""
        shape = (batch, 2, 2, 3)
        return _Motion(
            generator.uniform(0.02, 0.06, shape),
            generator.uniform(0.3, 1.2, shape),
            generator.uniform(0.0, 2 * np.pi, shape),
            generator.uniform(0.1, 0.35, (batch, 2, 2)),
            generator.uniform(0.3, 0.9, (batch, 2, 2)),
        )

    def pose(self, time: float) -> tuple[Array, Array]:
        """Positions (E, 2, 3) [m] and rotations (E, 2, 4) wxyz of the grippers at `time` [s] (0: at rest)."""
        fade = np.clip(time / 0.5, 0.0, 1.0)
        fade = fade * fade * (3.0 - 2.0 * fade)
        swing = self.amplitude * np.sin(2 * np.pi * self.frequency * time + self.phase)
        home = np.array([[-0.32, 0.0, 0.8], [0.32, 0.0, 0.8]])
        position = home + fade * swing.sum(axis=2)
        half = 0.5 * fade * self.tilt * np.sin(2 * np.pi * self.tilt_frequency * time)
        (cy, sy), (cz, sz) = ((np.cos(half[..., i]), np.sin(half[..., i])) for i in range(2))
        return position, np.stack([cz * cy, -sz * sy, cz * sy, sz * cy], axis=-1)  # about y, then about z


def _simulate(cable: SampleCable, motion: _Motion, frames: int, progress: Progress) -> Array:
    """Node positions (E, frames, N, 3) [m], semi-implicit Euler."""
    spacing = cable.length / (cable.nodes - 1)
    mass = cable.mass / cable.nodes
    dt = 1.0 / (cable.rate * cable.substeps)
    grip = spacing * np.arange(CLAMPED)  # the clamped nodes lie on the gripper's x axis, inwards
    inward = np.stack([grip, -grip[::-1]])  # (gripper, node)
    position = np.repeat(_parabola(cable.length, cable.nodes)[None], len(motion.amplitude), axis=0)
    velocity = np.zeros_like(position)
    free = slice(CLAMPED, cable.nodes - CLAMPED)
    recorded = []
    settle = round(cable.settle * cable.rate)
    for frame in range(-settle, frames):
        drag = cable.drag if frame >= 0 else 5.0
        if frame >= 0:
            recorded.append(position.copy())
        for substep in range(cable.substeps):
            force = _force(cable, position, velocity, spacing)
            force[..., 2] += mass * STANDARD_GRAVITY[2]
            velocity += dt * (force / mass - drag * velocity)
            position[:, free] += dt * velocity[:, free]
            time = max(frame + (substep + 1) / cable.substeps, 0.0) / cable.rate
            _clamp(position, velocity, motion, time, inward, dt)
        if frame % 10 == 0:
            progress(frame + settle + 1, frames + settle, "simulated frames")
    return np.stack(recorded, axis=1)


def _clamp(position: Array, velocity: Array, motion: _Motion, time: float, inward: Array, dt: float) -> None:
    """Put the clamped nodes where the grippers hold them."""
    center, q = motion.pose(time)
    w, x, y, z = (q[..., i] for i in range(4))
    axis = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=-1)  # R e_x
    held = center[:, :, None] + inward[None, :, :, None] * axis[:, :, None]
    for gripper, nodes in enumerate((slice(0, CLAMPED), slice(-CLAMPED, None))):
        velocity[:, nodes] = (held[:, gripper] - position[:, nodes]) / dt
        position[:, nodes] = held[:, gripper]


def _force(cable: SampleCable, position: Array, velocity: Array, spacing: float) -> Array:
    """Axial springs with dashpots, and bending by the turning angle with a rest angle; (E, N, 3) [N]."""
    edge = np.diff(position, axis=1)
    length = np.linalg.norm(edge, axis=-1, keepdims=True)
    unit = edge / length
    closing = np.sum(np.diff(velocity, axis=1) * unit, axis=-1, keepdims=True)
    pull = (cable.axial * (length / spacing - 1.0) + cable.axial_damping * closing) * unit
    force = np.zeros_like(position)
    force[:, :-1] += pull
    force[:, 1:] -= pull
    # Bending energy EI / (2 h) (angle - rest angle)^2 at each inner node; its gradient by the two edges.
    a, b = unit[:, :-1], unit[:, 1:]
    cosine = np.sum(a * b, axis=-1, keepdims=True)
    sine = np.sqrt(np.maximum(1.0 - cosine * cosine, 0.0))
    angle = np.arctan2(sine, cosine)
    moment = cable.bending / spacing * (angle - cable.rest_curvature * spacing)
    scale = moment / np.maximum(sine, 1e-3)
    by_a = scale * (b - cosine * a) / length[:, :-1]  # minus the gradient by edge a
    by_b = scale * (a - cosine * b) / length[:, 1:]
    force[:, 1:-1] += by_a - by_b
    force[:, :-2] -= by_a
    force[:, 2:] += by_b
    return force


def _parabola(length: float, nodes: int) -> Array:
    """A first shape (N, 3): evenly spaced along a parabola of that length between the grippers' home places."""
    x = np.linspace(-0.32, 0.32, 4001)
    low, high = 0.0, 2.0
    for _ in range(60):
        sag = 0.5 * (low + high)
        z = 0.8 - sag * (1.0 - (x / 0.32) ** 2)
        arc = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(z)))])
        low, high = (sag, high) if arc[-1] < length else (low, sag)
    at = np.linspace(0.0, arc[-1], nodes)
    return np.stack([np.interp(at, arc, x), np.zeros(nodes), np.interp(at, arc, z)], axis=-1)


def _episode(cable: SampleCable, index: int, track: Array, poses: list[tuple[Array, Array]]) -> Episode:
    frames, count, _ = track.shape
    stamps = FIRST_STAMP + np.arange(frames, dtype=np.int64) * round(1e9 / cable.rate)
    seen = np.ones((frames, count), bool)
    held = np.full(count, -1, np.int32)
    for particle, gripper in HELD.items():
        held[particle] = gripper
    return Episode(
        name=f"ep{index:03d}",
        object=ObjectInfo("sample_cable", "line"),
        stamps=stamps,
        tracks=Tracks(stamps, track, np.arange(count, dtype=np.uint32), seen, seen.astype(np.float32)),
        grips=Grip(
            torch.as_tensor(np.stack([p[index] for p, _ in poses]), dtype=torch.float32),
            torch.as_tensor(np.stack([q[index] for _, q in poses]), dtype=torch.float32),
            torch.ones(frames, 2, dtype=torch.bool),
        ),
        held=held,
        split=cable.splits[index],
        recording=index,
    )
