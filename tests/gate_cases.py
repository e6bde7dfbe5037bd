"""Episodes of a gripper that moves smoothly at random and of two particles it holds, with planted errors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from pred_core.calibration import Calibration
from pred_core.frames import quaternion_from_rotation_vector, quaternion_rotate
from pred_core.twin import Twin, TwinMeta
from pred_core.types import Array, Body, Episode, Grip, ObjectInfo, Physics, Scene, Tracks

LEVERS = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -0.024]])  # [m] in the gripper's frame
NOISE = 7e-4  # [m]


def moving_episodes(
    seed: int,
    wrong: Calibration | None = None,
    *,
    count: int = 8,
    levers: Array = LEVERS,
    moves: float = 1.0,
    turns: float = 1.0,
    slide: float = 0.0,
    frames: int = 100,
) -> list[Episode]:
    """`wrong`: what the sensors report; its gripper offset moves what is held. slide [m/s] along the gripper's -z.

    moves, turns: shares of the usual motion, 1 being 15 cm of amplitude and 0.5 rad around a drawn home.
    """
    rng, wrong = np.random.default_rng(seed), wrong or Calibration()
    made = []
    for number in range(count):
        time = np.clip(np.arange(frames) / 30.0 + rng.normal(0.0, 1e-3, frames), 0.0, None)
        time = np.sort(time)
        home, still = rng.uniform(-0.2, 0.2, 3) * moves + (0.0, 0.0, 0.6), rng.uniform(-0.5, 0.5, 3) * turns
        size = rng.uniform(0.3, 1.0, (2, 6)) * ([0.075 * moves] * 3 + [0.25 * turns] * 3)
        rate, phase = rng.uniform(0.25, 0.9, (2, 6)), rng.uniform(0.0, 6.28, (2, 6))

        def pose(at: Array, home=home, still=still, size=size, rate=rate, phase=phase):  # type: ignore[no-untyped-def]
            sway = (size * np.sin(6.28 * rate * at[:, None, None] + phase)).sum(axis=1)
            return home + sway[:, :3], quaternion_from_rotation_vector(torch.as_tensor(still + sway[:, 3:]))

        place, turn = pose(time)
        then, turned = pose(time - wrong.delay)
        own = levers + np.array(wrong.gripper_offset) + (time * -slide)[:, None, None] * np.array([0.0, 0.0, 1.0])
        x = then[:, None] + quaternion_rotate(turned[:, None], torch.as_tensor(own)).numpy()
        y = wrong.report(x) + rng.normal(0.0, NOISE, x.shape)
        seen = rng.random(y.shape[:2]) > 0.02
        stamps = 1_000_000_000 + (time * 1e9).astype(np.int64) + np.arange(frames)
        tracks = Tracks(stamps, np.where(seen[..., None], y, np.nan), np.arange(2, dtype=np.uint32), seen,
                        seen.astype(np.float32))  # fmt: skip
        grips = Grip(torch.as_tensor(place[:, None]).float(), turn[:, None].float(), torch.ones(frames, 1).bool())
        made.append(Episode(f"ep{number}", ObjectInfo("rope", "line"), stamps, tracks, grips, np.zeros(2, np.int32),
                            "train", number))  # fmt: skip
    return made


def bare_twin(
    levers: Sequence[tuple[int, tuple[float, float, float]]] = (), calibration: Calibration | None = None,
    ground: float | None = 0.0,
) -> Twin:
    """A twin of two particles: the gate reads its levers, its calibration and its table."""
    ones = np.ones(2)
    body = Body("line", np.arange(2, dtype=np.uint32), np.array([[0.0, 0, 0], [0.024, 0, 0]]), ones,
                np.array([[0, 1]], np.int32), np.full(1, 0.024), np.ones(1), np.ones(1), ones, np.ones(2, bool),
                np.zeros(2, np.int32), np.zeros((0, 3), np.int32), np.zeros(0), np.arange(2.0), 0.004)  # fmt: skip
    return Twin(TwinMeta(levers=tuple(levers)), body, Physics(), Scene(ground=ground),
                calibration=calibration or Calibration())  # fmt: skip
