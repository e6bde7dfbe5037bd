"""The cell at work: advances tick by tick, follows its servo or stamped poses, takes each camera's pictures on time."""

from __future__ import annotations

import dataclasses
import heapq
from dataclasses import dataclass

from pred_core.errors import InputError
from pred_core.plant.cameras import CameraConfig
from pred_core.plant.live.cell import Cell, Truth
from pred_core.plant.live.mover import Segment, ToolPose
from pred_core.plant.live.servo import Servo
from pred_core.plant.sensing import FIRST_STAMP
from pred_core.types import CameraFrame

TICK = 1.0 / 150.0  # [s]: two MuJoCo steps
PAUSE = 1_000_000_000  # [ns] between the last stamp before a reset and the first after it


@dataclass(frozen=True)
class Picture:
    """A camera's picture at the time it arrives."""

    camera: str
    frame: CameraFrame


@dataclass(frozen=True)
class Moment:
    """What a tick brought. Stamps run forwards over resets."""

    stamp: int  # [ns]
    truth: Truth
    pictures: tuple[Picture, ...]


class Station:
    """One cell and its clock. Use it from one thread; `servo` may be commanded from any."""

    def __init__(self, cell: Cell, pictures: bool = True):
        """pictures False: no camera is rendered."""
        self.cell, self.servo = cell, Servo()
        self._cameras: dict[str, CameraConfig] = {c.name: c for c in cell.cameras} if pictures else {}
        self._offset = 0  # [ns] added to the cell's stamps
        self._taken: dict[str, int] = {}  # pictures since the reset
        self._coming: list[tuple[float, str, CameraFrame]] = []  # captured, not yet arrived
        self._moment: Moment | None = None
        self._dead: tuple[str, ...] = ()
        self._bumped: tuple[str, ...] = ()

    @property
    def stamp(self) -> int:
        """[ns] now."""
        return self.cell.stamp + self._offset

    @property
    def moment(self) -> Moment:
        """The last one. Raises: InputError before the first reset."""
        if self._moment is None:
            raise InputError("plant: not reset yet")
        return self._moment

    def break_cameras(self, dead: tuple[str, ...], bumped: tuple[str, ...], seed: int) -> None:
        """Exactly these are dead or bumped from now on, also after a reset. Raises: ConfigError for an unknown name."""
        self.cell.faults.kill(dead)
        self.cell.faults.bump(bumped, seed)
        self._dead, self._bumped = dead, bumped

    def reset(self, seed: int) -> Moment:
        """Another start; time goes on. Raises: ConfigError if no start fits."""
        last = self.stamp if self._moment is not None else None
        truth = self.cell.reset(seed)
        self.break_cameras(self._dead, self._bumped, seed)
        self._offset = 0 if last is None else last + PAUSE - FIRST_STAMP
        self._taken, self._coming = dict.fromkeys(self._cameras, 0), []
        self.servo.stop()
        self.servo.clear()
        self._moment = self._observed(truth)
        return self._moment

    def tick(self) -> Moment:
        """Advance by one tick towards what the servo follows. Out of reach latches the servo's fault, and stops it."""
        cell = self.cell
        target = self.servo.reference(cell.reference, cell.time, TICK)
        try:
            truth = cell.step(target, TICK)
        except InputError as error:
            self.servo.fail(str(error))
            truth = cell.step(None, TICK)
        self._moment = self._observed(truth)
        return self._moment

    def advance(self, target: ToolPose | None, ticks: int) -> list[Moment]:
        """Advance by whole ticks so that the tool is at `target` at the end (None: stays). For lock-step.

        Raises: InputError for a pose too far for that time (nothing moves), or out of reach (on the way to it).
        """
        if ticks < 1:
            raise InputError("plant: ticks to advance", got=ticks, allowed="at least 1")
        begin = self.cell.reference
        segment = Segment(begin, begin if target is None else target, ticks * TICK)
        segment.check()
        moments = []
        for k in range(ticks):
            self._moment = self._observed(self.cell.step(segment.at((k + 1) / ticks), TICK))
            moments.append(self._moment)
        return moments

    def close(self) -> None:
        """Free the cameras."""
        self.cell.close()

    def _observed(self, truth: Truth) -> Moment:
        now = self.cell.time
        for name, config in self._cameras.items():
            if now + 0.5 * TICK >= config.phase + self._taken[name] / config.rate:
                self._taken[name] += 1
                frame = self.cell.look([name])[0]
                if frame is not None:
                    stamped = dataclasses.replace(frame, stamp=frame.stamp + self._offset)
                    heapq.heappush(self._coming, (now + config.delay, name, stamped))
        pictures = []
        while self._coming and self._coming[0][0] <= now + 1e-9:
            _, name, frame = heapq.heappop(self._coming)
            pictures.append(Picture(name, frame))
        return Moment(self.stamp, dataclasses.replace(truth, stamp=self.stamp), tuple(pictures))
