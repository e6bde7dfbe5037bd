"""Settings of a training run. Defaults follow the paper's habits where they are known (notes beside each)."""

from __future__ import annotations

from dataclasses import dataclass

from pred_core.config import setting


@dataclass(frozen=True)
class TrainingConfig:
    """Everything that decides a run beside the data, the twin and the network's sizes."""

    steps: int = setting(2000, low=1, high=10_000_000, doc="optimiser steps")
    rollout: int = setting(20, low=1, high=1000, doc="periods K rolled out on own predictions per window (paper: 5)")
    batch: int = setting(16, low=1, high=4096, doc="windows a step, advanced as one batched state")
    learning_rate: float = setting(1e-3, low=1e-7, high=1.0, doc="Adam, cosine to zero (paper's code: 1e-4)")
    clip: float = setting(1.0, low=1e-6, high=1e6, doc="largest gradient norm")
    penalty: float = setting(0.01, unit="mm^2", low=0.0, high=1e6, doc="on the mean square of residual / cap")
    loss: str = setting(
        "square", choices=("square", "absolute", "smooth"), doc="of position errors [mm]; smooth: absolute beyond beta"
    )
    beta: float = setting(0.3, unit="mm", low=1e-6, high=1e6, doc="where a smooth loss turns from square to absolute")
    gradient: str = setting(
        "detached",
        choices=("detached", "ballistic", "differences"),
        doc="detached: each step answers for its own error (paper); ballistic: also for later ones, as if the "
        "backbone carried it on at constant velocity; differences: by the backbone's Jacobian (small objects)",
    )
    carry: int = setting(
        1,
        low=1,
        high=100_000,
        doc="windows in a row that go on from the model's own state, from the beginning of a recording; "
        "1: every window starts from a measurement (paper). Needed for backbones with memory",
    )
    azimuth: bool = setting(True, doc="show each window to the network at a random azimuth about gravity")
    noise_position: float = setting(0.0, unit="m", low=0.0, high=1.0, doc="standard deviation added to starts")
    noise_velocity: float = setting(0.0, unit="m/s", low=0.0, high=10.0, doc="standard deviation added to starts")
    average: float = setting(0.99, low=0.0, high=0.99999, doc="decay of the averaged weights that are kept")
    stride: int = setting(1, low=1, high=10_000, doc="frames between starts of windows")
    outlier: float = setting(
        0.0, low=0.0, high=1e6, doc="leave out train recordings whose backbone error exceeds this times the median"
    )
    holdout: float = setting(0.15, low=0.0, high=0.9, doc="share of train recordings that choose the step; 0: last")
    holdout_frames: int = setting(500, low=1, high=100_000, doc="longest rollout on held-out recordings [periods]")
    evaluate_every: int = setting(200, low=1, high=1_000_000, doc="optimiser steps between held-out rollouts")
    seed: int = setting(0, low=0, high=2**31 - 1, doc="of weights, order, starts, azimuth and holdout")
