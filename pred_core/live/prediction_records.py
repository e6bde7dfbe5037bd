"""What goes in and out of the predictor's bookkeeping."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray

from pred_core.bag.grippers import PoseFrame
from pred_core.types import Grip, State


@dataclass(frozen=True)
class Rules:
    """How the predictor treats time. `period` [s] is the twin's."""

    max_gap: float = 0.1  # [s] between two poses; a longer hole ends the run
    horizon: float = 0.0  # [s] predicted beyond the newest pose, the gripper moving on at its last velocity
    correct: str = "none"  # none: open loop from the start | tracks: restart from what every frame measured


@dataclass(frozen=True)
class Pose:
    """One measured gripper pose with the closed flags that held when it arrived."""

    pose: PoseFrame
    closed: NDArray[np.bool_]  # (G,)
    lap: int  # counts jumps back in time

    @property
    def time(self) -> tuple[int, int]:
        """(lap, stamp [ns]): grows along the stream."""
        return self.lap, self.pose.stamp

    def grip(self) -> Grip:
        """As the simulator reads it."""
        return grip_of(self.pose.position, self.pose.rotation, self.closed)


@dataclass(frozen=True)
class Prediction:
    """What one step gave."""

    stamp: int  # [ns] of the newest measured pose used
    state: State  # at `stamp`
    ahead_stamp: int  # [ns] stamp + horizon
    ahead: State  # at `ahead_stamp`


@dataclass
class Counts:
    """What happened so far; shown in the diagnostics."""

    runs: int = 0
    steps: int = 0
    interpolated: int = 0  # steps whose pose lay between two measured ones
    unused_poses: int = 0  # faster than the period
    gaps: int = 0  # holes in the poses that ended a run
    jumps: int = 0  # jumps back in time
    dropped_frames: int = 0  # tracker frames that waited too long for poses, or whose stamps were out of line
    dropped_poses: int = 0  # poses that waited too long for tracker frames, or whose stamps were out of line
    waiting_for: list[int] = field(default_factory=list)  # particle ids a start lacks
    spacing: float = 1.0  # periods between the two frames that were last refused as a start


def grip_of(position: NDArray[np.float64], rotation: NDArray[np.float64], closed: NDArray[np.bool_]) -> Grip:
    """Poses (G, 3) [m], (G, 4) wxyz and flags (G,) as the simulator reads them."""
    return Grip(
        torch.as_tensor(position, dtype=torch.float32),
        torch.as_tensor(rotation, dtype=torch.float32),
        torch.as_tensor(closed),
    )
