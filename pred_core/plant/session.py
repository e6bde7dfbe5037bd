"""Which episodes a session has: splits, regimes, variants, order, motions. The seed decides, and nothing hidden."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pred_core.config import setting
from pred_core.plant.motion import REGIMES, VARIANTS, Motion, draw_motion

PER_RECORDING = 3  # episodes
PAUSE = 3.0  # [s] between episodes of the session


@dataclass(frozen=True)
class SessionConfig:
    """How many episodes of which length."""

    train: int = setting(12, low=0, high=1000, doc="episodes to fit on, half in the air, half on the table")
    test: int = setting(6, low=0, high=1000, doc="episodes of the same family")
    ood: int = setting(6, low=0, high=1000, doc="faster, at another height, grasped at the other end, in turn")
    seconds: float = setting(5.0, unit="s", low=0.2, high=60.0, doc="length of an episode")
    particles: int = setting(30, low=8, high=200, doc="tracked material points, evenly along the rope")


@dataclass(frozen=True)
class EpisodePlan:
    """One episode before it happens."""

    index: int  # in the session
    split: str
    recording: int
    start: float  # [s] of the session
    motion: Motion

    @property
    def name(self) -> str:
        """Of the bag, without its ending."""
        return f"ep{self.index:03d}"

    def held(self, particles: int) -> dict[int, int]:
        """Particle id -> gripper: the two points in the jaws, at the end that is grasped."""
        if self.motion.variant == "regrasp":
            return {particles - 2: 0, particles - 1: 0}
        return {0: 0, 1: 0}


def plan_session(config: SessionConfig, seed: int) -> tuple[EpisodePlan, ...]:
    """The episodes in the order they happen; recordings come in a drawn order, so splits are spread over time."""
    recordings: list[list[tuple[str, str, str]]] = []
    for split, count in (("train", config.train), ("test", config.test), ("ood", config.ood)):
        for n in range(count):
            variant = VARIANTS[1 + n % 3] if split == "ood" else VARIANTS[0]
            regime = REGIMES[n % 2]
            if n % PER_RECORDING == 0:
                recordings.append([])
            recordings[-1].append((split, regime, variant))
    generator = np.random.default_rng([seed, 0])
    plans: list[EpisodePlan] = []
    for recording, chosen in enumerate(generator.permutation(len(recordings)).tolist()):
        for split, regime, variant in recordings[chosen]:
            index = len(plans)
            motion = draw_motion(np.random.default_rng([seed, 1, index]), regime, variant, config.seconds)
            plans.append(EpisodePlan(index, split, recording, index * (config.seconds + PAUSE), motion))
    return tuple(plans)
