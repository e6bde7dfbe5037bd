"""A plan of gripper poses from a file: `next_motion.yaml` of `pred diagnose`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pred_core.arm.approach import TimedPoses
from pred_core.arm.follower import Plan, make_plan
from pred_core.arm.limits import GuardConfig
from pred_core.config import load_yaml
from pred_core.errors import ConfigError


def read_motion(path: Path, gripper: int = 0) -> tuple[str, TimedPoses, float]:
    """Frame, poses of one gripper, and how long [s] the object rests before. Raises: ConfigError for another layout."""
    values = load_yaml(path)
    try:
        trajectory: dict[str, Any] = values["trajectory"]
        points = trajectory["points"]
        times = np.array([float(p["time_from_start"]) for p in points])
        transforms = [p["transforms"][gripper] for p in points]
        position = np.array([t["translation"] for t in transforms], dtype=float)
        rotation = np.array([t["rotation"] for t in transforms], dtype=float)
        frame, rest = str(trajectory["frame_id"]), float(values.get("start", {}).get("rest_first", 0.0))
        if not (position.shape == (len(times), 3) and rotation.shape == (len(times), 4) and len(times) and rest >= 0.0):
            raise ValueError(f"{len(times)} points of {position.shape[1:]} and {rotation.shape[1:]}, rest {rest}")
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        raise ConfigError(
            f"{path}: not a motion of gripper {gripper}",
            got=repr(error),
            allowed="trajectory: frame_id, points of time_from_start and transforms",
            next_step="Give the next_motion.yaml of pred diagnose",
        ) from error
    return frame, TimedPoses(times, position, rotation), rest


def load_plan(path: Path, start: int, config: GuardConfig, gripper: int = 0) -> Plan:
    """The motion of one gripper, beginning at `start` [ns]. The arm must be at its first pose by then.

    Raises: ConfigError if the file has another layout, InputError for a plan that cannot be followed within `config`.
    """
    frame, motion, _ = read_motion(path, gripper)
    return make_plan(start, frame, motion.times.tolist(), motion.position, motion.rotation, config)
