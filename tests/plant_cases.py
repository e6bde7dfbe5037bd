"""Short worlds the plant tests share: the settling is cut, since laws of the moving rope do not need it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from pred_core.plant import springs, world
from pred_core.plant.motion import Motion, draw_motion
from pred_core.plant.rope import STEP, RopeConfig, build_rope
from pred_core.plant.sensing import SensorConfig
from pred_core.plant.session import EpisodePlan, SessionConfig
from pred_core.plant.world import World

TINY = SessionConfig(train=2, test=0, ood=0, seconds=0.3)
CLEAN = SensorConfig(noise=0.0, wander=0.0, jitter=0.0, lost=0.0, dropout=0.0, occlusions=0.0)


def hurry(patch: pytest.MonkeyPatch) -> None:
    """Episodes that begin 0.15 s after the rope was laid: it still sways, in the same way in every case."""
    for module in (world, springs):
        patch.setattr(module, "SETTLE", 0.15)
        patch.setattr(module, "FREE", 0.05)
        patch.setattr(module, "LEAD", 0.1)


def plan(regime: str, variant: str = "usual", seed: int = 5, seconds: float = 2.0) -> EpisodePlan:
    """One episode of a seed, at the session's beginning."""
    return EpisodePlan(0, "train", 0, 0.0, draw_motion(np.random.default_rng([seed, 1]), regime, variant, seconds))


def still(regime: str = "air") -> Motion:
    """A gripper that stands level at its home and never moves."""
    motion = plan(regime).motion
    home = motion.home.copy()
    home[3:] = (0.0, 0.0 if regime == "air" else home[4], 0.0)
    return dataclasses.replace(motion, home=home, sway=0.0 * motion.sway, step=0.0 * motion.step)


def free_rope(rope: RopeConfig | None = None, height: float = 4.0) -> World:
    """A rope nobody holds, straight down from `height` [m]."""
    free = World(build_rope(rope or RopeConfig(), gripper=False))
    free.data.qpos[2] = height
    return free


def run_free(free: World, seconds: float) -> None:
    """Let it move."""
    for _ in range(round(seconds / STEP)):
        free.step()
        free.time += STEP
