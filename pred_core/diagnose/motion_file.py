"""`next_motion.yaml`: the motion to record next, which an arm can carry out (`pred_core.arm.plan_file.load_plan`).

    format      1
    name, why, distance_mm, distance_sigma, rivals
    start       the recording and frame it begins like; rest_first [s]: how long the object rests there before
    limits      box [m], speeds [m/s], [rad/s] and acceleration [m/s^2] that it stays within
    arm         parameters that the arm node needs for it at least (`pred_core.arm.plan_needs`): its guard is slower
                unless told otherwise, and refuses the plan or lags behind it
    trajectory  trajectory_msgs/MultiDOFJointTrajectory field by field: header.frame_id as frame_id, joint_names,
                points with time_from_start [s] and transforms, one a gripper: translation [m], rotation wxyz.
                Starts and ends at rest; the last two points are the same pose.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from pred_core.arm.limits import GuardConfig
from pred_core.arm.plan_needs import as_parameters

FORMAT = 1
KEPT = ("name", "why", "distance_mm", "distance_sigma", "rivals", "start", "limits", "arm", "trajectory")


def for_the_arm(motion: Mapping[str, Any]) -> str:
    """What to give an arm node that has its usual parameters: "-p speed:=0.8 ..."; "" where they are enough."""
    return as_parameters(motion["arm"], GuardConfig())


def write_motion(path: Path, motion: Mapping[str, Any]) -> None:
    """Write the file."""
    plain = {"format": FORMAT, **{k: motion[k] for k in KEPT}}
    text = yaml.safe_dump(plain, sort_keys=False, allow_unicode=True, default_flow_style=None, width=120)
    path.write_text(text, encoding="utf-8")
