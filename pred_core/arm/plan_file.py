"""A plan of gripper poses from a file: `next_motion.yaml` of `pred diagnose`."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np

from pred_core.arm.approach import TimedPoses
from pred_core.arm.follower import OVER, Plan, checked_poses, make_plan
from pred_core.arm.limits import GuardConfig
from pred_core.arm.plan_needs import as_parameters, needs_of
from pred_core.config import load_yaml
from pred_core.errors import ConfigError, InputError


def read_motion(path: Path, gripper: int = 0) -> tuple[str, TimedPoses, float]:
    """Frame, poses of one gripper, and how long [s] the object rests before.

    Raises: ConfigError for another layout, InputError for poses that no arm could follow (`checked_poses`).
    """
    values = load_yaml(path)
    try:
        trajectory: dict[str, Any] = values["trajectory"]
        points = trajectory["points"]
        times = np.array([float(p["time_from_start"]) for p in points])
        transforms = [p["transforms"][gripper] for p in points]
        position = np.array([t["translation"] for t in transforms], dtype=float)
        rotation = np.array([t["rotation"] for t in transforms], dtype=float)
        frame, rest = str(trajectory["frame_id"]), float(values.get("start", {}).get("rest_first", 0.0))
        fits = position.shape == (len(times), 3) and rotation.shape == (len(times), 4)
        if not (fits and len(times) and 0.0 <= rest < math.inf):
            raise ValueError(f"{len(times)} points of {position.shape[1:]} and {rotation.shape[1:]}, rest {rest}")
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        raise ConfigError(
            f"{path}: not a motion of gripper {gripper}",
            got=f"no {error}" if isinstance(error, KeyError) else str(error),
            allowed="trajectory: frame_id, points of time_from_start and transforms",
            next_step="Give the next_motion.yaml of pred diagnose",
        ) from error
    try:
        times, position, rotation = checked_poses(frame, times.tolist(), position, rotation)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return frame, TimedPoses(times, position, rotation), rest


def load_plan(path: Path, start: int, config: GuardConfig, gripper: int = 0) -> Plan:
    """The motion of one gripper, beginning at `start` [ns]. The arm must be at its first pose by then.

    Raises: ConfigError if the file has another layout, InputError for a plan that cannot be followed within `config`,
    with the parameters the arm needs for it.
    """
    frame, motion, _ = read_motion(path, gripper)
    anything = dataclasses.replace(config, speed=math.inf, angular_speed=math.inf)
    moments, position, rotation = motion.times.tolist(), motion.position, motion.rotation
    plan = make_plan(start, frame, moments, position, rotation, anything)  # all but its speeds, asked for here
    needs = needs_of(plan.times, plan.position, plan.rotation)
    if needs["speed"] > OVER * config.speed or needs["angular_speed"] > OVER * config.angular_speed:
        raise InputError(
            f"{path}: is too fast for this arm's guard",
            got=f"{needs['speed']:g} m/s and {needs['angular_speed']:g} rad/s",
            allowed=f"{config.speed:g} m/s and {config.angular_speed:g} rad/s",
            next_step=f"Where it is safe, give the arm node {as_parameters(needs, config)}",
        )
    return plan
