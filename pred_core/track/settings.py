"""The tracker's settings as one flat set: parameters of the node `tracker`, flags and file of `pred track`."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pred_core.config import load_yaml, setting
from pred_core.errors import ConfigError, nearest
from pred_core.track.line_config import LineConfig
from pred_core.track.point_follower import PointFollower
from pred_core.track.surface_tracker import SurfaceConfig
from pred_core.track.tracker import MOST_CAMERAS, Masks, Tracker, TrackerConfig
from pred_core.track.workspace import Workspace
from pred_core.types import Box

PREFIX = re.compile(r"/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")  # of topics' names
NODE = "tracker"  # its section in a file of ROS parameters
ONLY_LIVE = ("autostart", "prior", "prior_sigma", "use_sim_time")  # parameters that mean nothing for a recorded bag


@dataclass(frozen=True)
class TrackerSettings:
    """What is tracked, where, and with what."""

    cameras: str = setting("cam0 cam1 cam2 cam3", doc="prefixes of the cameras' topics, 1 to 8")
    kind: str = setting("line", choices=("line", "sheet", "volume"), doc="geometry class of the object")
    x_low: float = setting(-0.6, unit="m", low=-10.0, high=10.0, doc="workspace in world")
    x_high: float = setting(0.6, unit="m", low=-10.0, high=10.0)
    y_low: float = setting(-0.6, unit="m", low=-10.0, high=10.0)
    y_high: float = setting(0.6, unit="m", low=-10.0, high=10.0)
    z_low: float = setting(0.0, unit="m", low=-10.0, high=10.0)
    z_high: float = setting(1.0, unit="m", low=-10.0, high=10.0)
    table: float = setting(0.0, unit="m", low=-10.0, high=10.0, doc="height of the table's top")
    fixtures: str = setting("", doc="boxes to ignore: 'x y z hx hy hz; ...' centre and half size [m]")
    length: float = setting(0.0, unit="m", low=0.0, high=20.0, doc="of a line; 0: measured when it is found")
    radius: float = setting(0.0, unit="m", low=0.0, high=0.1, doc="of a line; 0: measured when it is found")
    particles: int = setting(61, low=4, high=5000, doc="of the object")
    arm_radius: float = setting(0.0, unit="m", low=0.0, high=0.3, doc="of the arm above each gripper; 0: none in view")
    arm_start: float = setting(0.05, unit="m", low=-0.5, high=0.5, doc="of it, along the gripper's +z")
    arm_end: float = setting(0.4, unit="m", low=-0.5, high=2.0, doc="of it, along the gripper's +z")
    masks: str = setting("", doc="folder with SAM 2, which follows the object's masks; empty: masks without weights")
    detector: str = setting("", doc="folder with Grounding DINO, which finds the object for `masks`")
    object: str = setting("", doc="what `detector` looks for, e.g. white rope")
    points: str = setting(
        "", choices=("", "cotracker3", "tapnext"), doc="model that follows the points of a sheet or volume; empty: flow"
    )
    points_folder: str = setting("", doc="folder with that model's weights")
    patience: float = setting(0.03, unit="s", low=0.0, high=1.0, doc="wait for the other cameras after the first")


def make_tracker(settings: TrackerSettings) -> Tracker:
    """The tracker the settings describe. Raises: ConfigError."""
    cameras = parse_cameras(settings.cameras)
    tracker = Tracker(tracker_config(settings), cameras, _learned_masks(settings), _learned_points(settings))
    tracker.fixtures = parse_fixtures(settings.fixtures)
    return tracker


def tracker_config(settings: TrackerSettings) -> TrackerConfig:
    """The tracker's own configuration."""
    low, high = (settings.x_low, settings.y_low, settings.z_low), (settings.x_high, settings.y_high, settings.z_high)
    return TrackerConfig(
        kind=settings.kind,
        arm_radius=settings.arm_radius,
        arm_start=settings.arm_start,
        arm_end=settings.arm_end,
        workspace=Workspace(low, high, settings.table),
        line=LineConfig(length=settings.length, radius=settings.radius, particles=settings.particles),
        surface=SurfaceConfig(particles=settings.particles),
    )


def parse_cameras(text: str) -> list[str]:
    """'cam0, cam1' -> ['cam0', 'cam1']. Raises: ConfigError for none, too many, a repeated or an impossible one."""
    names = text.replace(",", " ").split()
    fine = all(PREFIX.fullmatch(name) for name in names)
    if not fine or not 1 <= len(set(names)) == len(names) <= MOST_CAMERAS:
        raise ConfigError(
            "parameter 'cameras'",
            got=repr(text),
            allowed=f"1 to {MOST_CAMERAS} different prefixes of topics: letters, digits, _ and /, no digit first",
            next_step="Name them, e.g. 'cam0 cam1'",
        )
    return names


def parse_fixtures(text: str) -> tuple[Box, ...]:
    """'x y z hx hy hz; ...' -> boxes. Raises: ConfigError."""
    boxes = []
    for item in filter(str.strip, text.split(";")):
        try:
            x, y, z, a, b, c = (float(v) for v in item.replace(",", " ").split())
        except ValueError as error:
            raise ConfigError(
                "parameter 'fixtures'", got=repr(item), allowed="six numbers a box: x y z hx hy hz"
            ) from error
        if not (np.isfinite((x, y, z)).all() and 0.0 < min(a, b, c) <= max(a, b, c) < np.inf):
            raise ConfigError(
                "parameter 'fixtures'", got=repr(item), allowed="a finite centre and half sizes above 0 [m]"
            )
        boxes.append(Box((x, y, z), (a, b, c)))
    return tuple(boxes)


def read_settings_file(path: Path) -> dict[str, Any]:
    """What a file of ROS parameters (config/nodes/tracker.yaml, reroute.yaml) sets for the tracker.

    Parameters that mean nothing for a recorded bag are left out. Raises: ConfigError.
    """
    content = load_yaml(path)
    section = content.get(NODE) if isinstance(content, Mapping) else None
    values = section.get("ros__parameters") if isinstance(section, Mapping) else None
    if not isinstance(values, Mapping):
        raise ConfigError(
            f"{path}: no settings of the tracker",
            allowed=f"{NODE}: {{ros__parameters: {{...}}}}, as in config/nodes/tracker.yaml",
        )
    known = [f.name for f in dataclasses.fields(TrackerSettings)]
    for key in values:
        if key not in known and key not in ONLY_LIVE:
            raise ConfigError(f"{path}: unknown key '{key}'", next_step=nearest(str(key), (*known, *ONLY_LIVE)))
    return {key: value for key, value in values.items() if key in known}


def _learned_masks(settings: TrackerSettings) -> Masks | None:
    """The learned masks that are asked for. Raises: ConfigError without weights, packages or a name."""
    if not settings.masks and not settings.detector:
        return None
    from pred_core.track.learned_masks import load_named_object  # torch: seconds, which nobody else here needs

    return load_named_object(settings.object, Path(settings.detector), Path(settings.masks))


def _learned_points(settings: TrackerSettings) -> PointFollower | None:
    """The learned point tracks that are asked for. Raises: ConfigError without weights or packages, or for a line."""
    if not settings.points:
        if settings.points_folder:
            raise ConfigError("parameter 'points_folder' without 'points'", allowed="points: cotracker3 or tapnext")
        return None
    if settings.kind == "line":
        raise ConfigError(
            "parameter 'points'", got=f"'{settings.points}' for a line", allowed="kind: sheet or volume",
            next_step="Leave it out: a line is followed by its centreline",
        )  # fmt: skip
    if not settings.points_folder:
        raise ConfigError(
            "parameter 'points_folder' is empty", allowed=f"the folder with the weights of {settings.points}",
            next_step="Name it, or leave 'points' out: optical flow needs no weights",
        )  # fmt: skip
    from pred_core.track.learned_points import load_points  # torch: seconds, which nobody else here needs

    return load_points(settings.points, Path(settings.points_folder))
