"""Small episodes with known motion, shared by the tests of baselines and evaluation."""

from __future__ import annotations

import numpy as np
import torch

from pred_core.types import Array, Episode, Grip, ObjectInfo, Tracks


def episode_of(
    position: Array,
    held: list[int],
    *,
    name: str = "ep000",
    split: str = "test",
    recording: int = 0,
    hz: float = 100.0,
    visible: Array | None = None,
) -> Episode:
    """An episode whose grippers sit, unrotated, at the particles with held[i] = gripper index.

    position (T, P, 3) [m]; held (P,) gripper index or -1.
    """
    frames, count, _ = position.shape
    stamps = (np.arange(frames) * 1e9 / hz).astype(np.int64)
    grippers = max(held) + 1
    pose = np.stack([position[:, held.index(g)] for g in range(grippers)], 1) if grippers else np.zeros((frames, 0, 3))
    seen = np.isfinite(position).all(-1) if visible is None else np.asarray(visible, dtype=bool)
    tracks = Tracks(stamps, position, np.arange(count, dtype=np.uint32), seen, seen.astype(np.float32))
    rotation = torch.zeros(frames, grippers, 4)
    rotation[..., 0] = 1.0
    grips = Grip(torch.as_tensor(pose, dtype=torch.float32), rotation, torch.ones(frames, grippers, dtype=torch.bool))
    cable = ObjectInfo("cable", "line")
    return Episode(name, cable, stamps, tracks, grips, np.array(held, dtype=np.int32), split, recording)


def swinging_cable(seed: int, *, frames: int = 60, count: int = 6, hz: float = 100.0, split: str = "test",
                   recording: int = 0, name: str = "") -> Episode:
    """A line whose ends wander smoothly and whose middle is a quadratic function of them plus a small swing."""
    rng = np.random.default_rng(seed)
    time = np.arange(frames) / hz
    phase, rate = rng.uniform(0, 6.3, 6), rng.uniform(1, 4, 6)
    wave = 0.1 * np.sin(rate * time[:, None] + phase)  # (T, 6)
    left, right = wave[:, :3], wave[:, 3:] + np.array([0.5, 0.0, 0.0])
    s = np.linspace(0, 1, count)[None, :, None]
    position = (1 - s) * left[:, None] + s * right[:, None]
    span = np.linalg.norm(right - left, axis=1) ** 2
    position[:, :, 2] -= (0.3 - 0.4 * span)[:, None] * (s * (1 - s))[..., 0]
    position[:, :, 1] += 0.01 * np.sin(9 * time + rng.uniform(0, 6.3))[:, None] * (s * (1 - s))[..., 0]
    held = [0] + [-1] * (count - 2) + [1]
    return episode_of(position, held, name=name or f"ep{seed:03d}", split=split, recording=recording, hz=hz)
