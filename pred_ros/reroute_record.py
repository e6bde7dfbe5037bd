"""What one run of the loop left behind: what the nodes said and saw, and the truth that only the judge reads."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from pred_core.plant.live.slot import SlotConfig
from pred_core.plant.live.success import Passage
from pred_core.types import Array

NS = 1e9
REST_SPEED = 0.004  # [m/s] of a gripper that stands still
REST_SPAN = 0.4  # [s] over which that is judged
SPEED_SPAN = 0.03  # [s] over which a speed is measured


@dataclass(frozen=True)
class Said:
    """A change of a node's diagnostic status."""

    stamp: int  # [ns] of the cell
    node: str
    level: int  # 0 OK, 1 WARN, 2 ERROR
    message: str


@dataclass(frozen=True)
class PlanSeen:
    """A plan on its way from the planner to the arm."""

    stamp: int  # [ns] when it was sent
    wall: float  # [s] on a monotonic clock, likewise
    start: int  # [ns] when it begins
    position: Array  # (K, 3) [m] of the gripper


@dataclass(frozen=True)
class View:
    """The camera whose pictures are kept."""

    name: str
    intrinsics: Array  # (3, 3) [px]
    world_from_camera: Array  # (4, 4)


@dataclass
class Record:
    """Stamps [ns] are the cell's; points (N, 3) [m] world."""

    slot: SlotConfig
    goal: Array
    truth: list[tuple[int, Array]] = field(default_factory=list)
    judged: list[tuple[int, Passage]] = field(default_factory=list)
    tracked: list[tuple[int, Array]] = field(default_factory=list)
    states: list[tuple[int, Array]] = field(default_factory=list)
    gripper: list[tuple[int, Array]] = field(default_factory=list)  # (3,) [m]
    plans: list[PlanSeen] = field(default_factory=list)
    planning: list[tuple[int, float, int]] = field(default_factory=list)  # stamp, [s] on the wall, motions tried
    said: list[Said] = field(default_factory=list)
    values: dict[str, dict[str, str]] = field(default_factory=dict)  # node -> newest values
    status: dict[str, Said] = field(default_factory=dict)  # node -> newest status
    pictures: list[tuple[int, bytes]] = field(default_factory=list)  # JPEG
    taken: int = 0  # pictures whose calibration came, which is small and hardly ever lost
    view: View | None = None
    events: list[tuple[int, str]] = field(default_factory=list)  # what the run itself did: faults, restarts
    now: int = 0  # [ns]
    begin: int = 0  # [ns] when arm and planner were enabled
    wall: float = 0.0  # [s] on the wall from then to the end
    fault: int | None = None  # [ns] when the fault began
    values_at_fault: dict[str, str] = field(default_factory=dict)  # of the plant, then

    def seconds(self, stamp: int) -> float:
        """[s] since the begin."""
        return (stamp - self.begin) / NS

    @property
    def success(self) -> bool:
        """By the newest truth."""
        return bool(self.judged) and self.judged[-1][1].success

    def succeeded_for(self) -> float:
        """[s] without a break up to now."""
        since = self.now
        for stamp, passage in reversed(self.judged):
            if not passage.success:
                break
            since = stamp
        return (self.now - since) / NS

    def at_rest(self) -> bool:
        """The gripper has hardly moved lately."""
        recent = [p for stamp, p in self.gripper[-200:] if self.now - stamp < REST_SPAN * NS]
        if len(recent) < 2:
            return False
        return float(np.linalg.norm(recent[-1] - recent[0])) < REST_SPEED * REST_SPAN

    def rests_from(self, stamp: int) -> int | None:
        """[ns] the first time at or after `stamp` from which the gripper stood still for `REST_SPAN`."""
        path = [(s, p) for s, p in self.gripper if s >= stamp]
        for before, now in _spans(path, REST_SPAN):
            if float(np.linalg.norm(now[1] - before[1])) < REST_SPEED * REST_SPAN:
                return before[0]
        return None

    def speed(self, begin: int, end: int) -> float:
        """[m/s] the largest of the measured gripper between two stamps, over `SPEED_SPAN`."""
        path = [(s, p) for s, p in self.gripper if begin <= s <= end]
        return max(
            (float(np.linalg.norm(b[1] - a[1])) / (b[0] - a[0]) * NS for a, b in _spans(path, SPEED_SPAN)), default=0.0
        )


def _spans(path: Sequence[tuple[int, Array]], seconds: float) -> Iterator[tuple[tuple[int, Array], tuple[int, Array]]]:
    """Of each moment of a path: the newest one that lies at least `seconds` [s] before it, and itself."""
    behind = 0
    for now in path:
        if now[0] - path[behind][0] < seconds * NS:
            continue
        while now[0] - path[behind + 1][0] >= seconds * NS:
            behind += 1
        yield path[behind], now
