"""Start poses: the rope lies in a drawn curve on the near side of the slot, its end in the gripper above the table."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pred_core.config import setting
from pred_core.errors import ConfigError
from pred_core.plant.live.slot import SlotConfig
from pred_core.plant.rope import RopeConfig

Array = NDArray[np.float64]
APART = 0.03  # [m] between strands of the rope on the table
DRAWS = 5000
DESCENT = 3.0  # times its height: the length of rope that leads from the gripper to the table


@dataclass(frozen=True)
class StartFamily:
    """Where starts are drawn, in the slot's axes (x through the gap, near side negative)."""

    x_low: float = setting(-0.18, unit="m", low=-1.0, high=0.0, doc="of the gripper")
    x_high: float = setting(-0.08, unit="m", low=-1.0, high=0.0, doc="of the gripper")
    y: float = setting(0.1, unit="m", low=0.0, high=0.5, doc="largest offset of the gripper across")
    z_low: float = setting(0.05, unit="m", low=0.02, high=0.5, doc="height of the gripper")
    z_high: float = setting(0.09, unit="m", low=0.02, high=0.5, doc="height of the gripper")
    turn: float = setting(0.6, unit="rad", low=0.0, high=3.2, doc="largest turn of the gripper from the way through")
    sway: float = setting(1.1, unit="rad", low=0.0, high=3.0, doc="largest amplitude of the rope's changing direction")
    far: float = setting(-0.45, unit="m", low=-2.0, high=0.0, doc="the rope lies before this x and nowhere beyond")
    near: float = setting(-0.045, unit="m", low=-1.0, high=0.0, doc="the rope keeps so far from the posts")
    side: float = setting(0.22, unit="m", low=0.01, high=1.0, doc="largest offset of the rope across")


@dataclass(frozen=True)
class Start:
    """One start."""

    gripper: Array  # (3,) [m] world, tool centre; the rope's end is there
    yaw: float  # [rad] of the tool's x axis in world; the rope leaves backwards, along -x
    nodes: Array  # (links + 1, 3) [m] world, from the gripper on


def draw_start(
    generator: np.random.Generator, rope: RopeConfig, slot: SlotConfig, family: StartFamily | None = None
) -> Start:
    """A start. Raises: ConfigError if none of the draws fits the space the family allows."""
    family = family or StartFamily()
    for _ in range(DRAWS):
        grip = np.array(
            [
                generator.uniform(family.x_low, family.x_high),
                generator.uniform(-family.y, family.y),
                generator.uniform(family.z_low, family.z_high),
            ]
        )
        turn = generator.uniform(-family.turn, family.turn)
        nodes = _curve(generator, rope, family, grip, turn)
        if _fits(nodes, family):
            pose = slot.world_from_slot
            return Start(grip @ pose[:3, :3].T + pose[:3, 3], slot.yaw + turn, nodes @ pose[:3, :3].T + pose[:3, 3])
    raise ConfigError(
        "no start pose fits",
        got=f"a rope of {rope.length:.2f} m between x {family.far} and {family.near}, y +-{family.side}",
        next_step="Give it more space or a shorter rope",
    )


def _curve(generator: np.random.Generator, rope: RopeConfig, family: StartFamily, grip: Array, turn: float) -> Array:
    """Nodes (links + 1, 3) in the slot's axes: two drawn bends in the plane, a smooth descent to the table."""
    s = (np.arange(rope.links) + 0.5) / rope.links
    amplitude = generator.uniform(-family.sway, family.sway, 2)
    waves = np.array([generator.uniform(0.4, 0.9), generator.uniform(0.9, 1.6)])
    # Both begin at zero, so that the rope leaves the jaws straight.
    heading = turn + np.pi + (amplitude * (1.0 - np.cos(np.pi * waves * s[:, None]))).sum(axis=1)
    along = rope.link_length * np.arange(rope.links + 1)
    share = np.clip((along - rope.clamped * rope.link_length) / (DESCENT * grip[2]), 0.0, 1.0)
    z = grip[2] - (grip[2] - rope.radius) * share * share * (3.0 - 2.0 * share)
    flat = np.sqrt(rope.link_length**2 - np.diff(z) ** 2)
    steps = flat[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    xy = grip[:2] + np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    return np.concatenate([xy, z[:, None]], axis=1)


def _fits(nodes: Array, family: StartFamily) -> bool:
    x, y = nodes[:, 0], nodes[:, 1]
    if x.min() < family.far or x.max() > family.near or np.abs(y).max() > family.side:
        return False
    apart = np.linalg.norm(nodes[:, None, :2] - nodes[None, :, :2], axis=-1)
    order = np.arange(len(nodes))
    return bool((apart[np.abs(order[:, None] - order) > 4] > APART).all())
