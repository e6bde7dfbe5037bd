"""Random motions as a person at a joystick makes them: from place to place, with rests, over the table or the slot."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pred_core.config import setting
from pred_core.errors import ConfigError
from pred_core.plant.live.mover import Segment, ToolPose, tool_down
from pred_core.plant.live.slot import SlotConfig

Array = NDArray[np.float64]
FAMILIES = ("table", "slot")  # on the near side only; over the slot to the far side and back
PEAK = 1.875  # greatest over mean speed of a minimum-jerk move
LONGEST = 60.0  # [s] of a route; more is asked for in several episodes


@dataclass(frozen=True)
class TeleopConfig:
    """Where and how fast. Places in the slot's axes (x through the gap, near side negative)."""

    far: float = setting(-0.28, unit="m", low=-1.0, high=0.0, doc="farthest x on the near side")
    near: float = setting(-0.08, unit="m", low=-1.0, high=0.0, doc="nearest x on the near side")
    side: float = setting(0.1, unit="m", low=0.0, high=0.5, doc="largest offset across")
    low: float = setting(0.02, unit="m", low=0.01, high=0.5, doc="lowest tool centre")
    high: float = setting(0.2, unit="m", low=0.02, high=0.6, doc="highest tool centre")
    over: float = setting(0.13, unit="m", low=0.11, high=0.6, doc="least height over the slot")
    beyond: float = setting(0.24, unit="m", low=0.05, high=1.0, doc="farthest x on the far side")
    turn: float = setting(0.5, unit="rad", low=0.0, high=3.1, doc="largest turn from the way through")
    slow: float = setting(0.08, unit="m/s", low=0.01, high=1.0, doc="slowest move, at its peak")
    fast: float = setting(0.3, unit="m/s", low=0.01, high=1.0, doc="fastest move, at its peak")
    rest: float = setting(0.4, unit="s", low=0.0, high=5.0, doc="longest rest between moves")


@dataclass(frozen=True)
class Route:
    """Moves one after the other, at rest before, between and after them."""

    moves: tuple[Segment, ...]
    begin: tuple[float, ...]  # [s] of each move

    def at(self, time: float) -> ToolPose:
        """The commanded pose at `time` [s]."""
        pose = self.moves[0].begin
        for move, begin in zip(self.moves, self.begin, strict=True):
            if time < begin:
                break
            s = min(1.0, (time - begin) / move.seconds)
            pose = move.at(s**3 * (10.0 - 15.0 * s + 6.0 * s * s))
        return pose


def draw_route(
    generator: np.random.Generator,
    family: str,
    home: ToolPose,
    slot: SlotConfig,
    seconds: float,
    config: TeleopConfig | None = None,
) -> Route:
    """Moves from `home` on that fill `seconds` [s]. Raises: ConfigError for an unknown family."""
    config = config or TeleopConfig()
    if family not in FAMILIES or not 0.0 < seconds <= LONGEST:
        raise ConfigError("route", got=f"{family}, {seconds} s", allowed=f"{FAMILIES}, up to {LONGEST:g} s")
    moves, begins, now, here = [], [], float(generator.uniform(0.2, 0.5)), home
    while now < seconds:
        for place in _places(generator, family, config):
            pose = slot.world_from_slot
            yaw = slot.yaw + float(generator.uniform(-config.turn, config.turn))
            there = ToolPose(pose[:3, :3] @ place + pose[:3, 3], tool_down(yaw))
            peak = float(generator.uniform(config.slow, config.fast))
            distance = float(np.linalg.norm(there.position - here.position))
            length = max(PEAK * distance / peak, 0.6)
            moves.append(Segment(here, there, length))
            begins.append(now)
            now += length + float(generator.uniform(0.0, config.rest))
            here = there
    return Route(tuple(moves), tuple(begins))


def _places(generator: np.random.Generator, family: str, c: TeleopConfig) -> list[Array]:
    """The next places (3,) in the slot's axes: some on the table, or once over the slot and back."""

    def near() -> Array:
        high = c.low + 0.03 if generator.random() < 0.6 else c.high  # mostly dragging
        low = np.array([c.far, -c.side, c.low])
        return generator.uniform(low, [c.near, c.side, high])

    if family == "table":
        return [near()]
    middle = 0.03  # [m] the hand passes over the gap, not over the ends of the posts
    up, down = (generator.uniform([x, -middle, c.over], [y, middle, c.high]) for x, y in ((-0.14, -0.1), (0.1, 0.16)))
    landed = generator.uniform([0.12, -middle, c.low + 0.02], [c.beyond, middle, c.low + 0.06])
    return [up, down, landed, down, up, near()]
