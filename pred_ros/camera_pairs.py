"""Colour and depth of each camera, paired by capture stamp, with its calibration and pose; newest pair only."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from pred_core.bag.wire import stamp_of
from pred_core.track.camera import Camera
from pred_core.types import CameraFrame

KEPT = 8  # pictures that wait for their partner


@dataclass
class _Inbox:
    camera: Camera
    color: dict[int, Any] = field(default_factory=dict)  # stamp [ns] -> sensor_msgs/Image
    depth: dict[int, Any] = field(default_factory=dict)
    ready: tuple[Any, Any] | None = None
    heard: float = -math.inf  # [s] on the clock given


class CameraPairs:
    """Messages go in from the executor's thread, pictures come out to the worker."""

    def __init__(self, names: Sequence[str], clock: Callable[[], float] = time.monotonic):
        """clock [s]: that silence is judged on; the one of the stamps if that may be slow."""
        self._clock = clock
        self._inboxes = {name: _Inbox(Camera(name)) for name in names}
        self._wake = threading.Condition()
        self._open = True
        self.dropped = 0  # pairs that a newer one replaced

    def add_image(self, name: str, kind: str, message: Any) -> None:
        """An image of `kind` color or depth; it waits for its partner of the same stamp."""
        inbox = self._inboxes[name]
        stamp = stamp_of(message)
        mine, other = (inbox.color, inbox.depth) if kind == "color" else (inbox.depth, inbox.color)
        with self._wake:
            inbox.heard = self._clock()
            mine[stamp] = message
            while len(mine) > KEPT:
                del mine[min(mine)]
            if stamp in other:
                self.dropped += inbox.ready is not None
                inbox.ready = (inbox.color.pop(stamp), inbox.depth.pop(stamp))
                self._wake.notify()

    def add_info(self, name: str, message: Any) -> None:
        """A camera_info. Raises: BagError for an uncalibrated camera."""
        with self._wake:
            self._inboxes[name].camera.add_info(message)

    def add_pose(self, name: str, message: Any) -> None:
        """A pose in world. Raises: BagError for another frame."""
        with self._wake:
            self._inboxes[name].camera.add_pose(message)

    def take(self, patience: float) -> dict[str, tuple[Any, Any]]:
        """Wait for pairs: of every camera heard of lately, or what has come `patience` [s] after the first."""
        with self._wake:
            while self._open and not self._ready():
                self._wake.wait()
            end = time.monotonic() + patience
            while self._open and self._missing() and (left := end - time.monotonic()) > 0.0:
                self._wake.wait(left)
            taken = {}
            for name, inbox in self._inboxes.items():
                if inbox.ready is not None:
                    taken[name], inbox.ready = inbox.ready, None
            return taken

    def close(self) -> None:
        """Wake the worker for good; `take` returns at once from now on."""
        with self._wake:
            self._open = False
            self._wake.notify_all()

    def silent(self, limit: float) -> list[str]:
        """Cameras without a picture for `limit` [s]."""
        now = self._clock()
        return [n for n, c in self._inboxes.items() if now - c.heard > limit]

    def picture(self, name: str, pair: tuple[Any, Any]) -> CameraFrame:
        """The picture of a pair. Raises: PredError, naming the camera, for what makes it unusable."""
        return self._inboxes[name].camera.picture(*pair)

    def _ready(self) -> bool:
        return any(c.ready is not None for c in self._inboxes.values())

    def _missing(self) -> bool:
        now = self._clock()
        return any(c.ready is None and now - c.heard < 0.5 for c in self._inboxes.values())
