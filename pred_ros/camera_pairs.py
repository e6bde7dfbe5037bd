"""Colour and depth of each camera, paired by capture stamp, with its calibration and pose; newest pair only."""

from __future__ import annotations

import itertools
import math
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from pred_core.bag.wire import stamp_of
from pred_core.track.camera import Camera
from pred_core.types import CameraFrame

KEPT = 8  # pictures of a kind that wait for their partner
BACK = 1_000_000_000  # [ns] what waits and is ahead of a new picture by more is of a time before the clock went back
IDLE = 0.1  # [s] `take` waits for a first pair
LATELY = 0.5  # [s] a camera that sent something since is waited for
UNPAIRED = 1.0  # [s] of pictures of which none finds its partner: it is not waited for any more, and `why` says it
NO_PICTURES = "no pictures"
SPOKEN = {"color": ("colour", "depth"), "depth": ("depth", "colour")}  # kind -> it and its partner, in words


@dataclass
class _Inbox:
    camera: Camera
    color: dict[int, Any] = field(default_factory=dict)  # stamp [ns] -> sensor_msgs/Image, in order of arrival
    depth: dict[int, Any] = field(default_factory=dict)
    came: dict[str, float] = field(default_factory=dict)  # kind -> [s] of its newest picture, on the clock given
    ready: tuple[Any, Any] | None = None
    heard: float = -math.inf  # [s] when the newest pair was complete
    alone: float | None = None  # [s] when the first picture came that has waited since the newest pair


class CameraPairs:
    """Messages go in from the executor's thread, pictures come out to the worker."""

    def __init__(self, names: Sequence[str], clock: Callable[[], float] = time.monotonic):
        """clock [s]: that silence is judged on; the one of the stamps if that may be slow."""
        self._clock = clock
        self._inboxes = {name: _Inbox(Camera(name)) for name in names}
        self._wake = threading.Condition()
        self._open = True
        self.dropped = 0  # pairs that a newer one replaced
        self.unpaired = 0  # pictures that were given up without a partner

    def add_image(self, name: str, kind: str, message: Any) -> None:
        """An image of `kind` color or depth; it waits for its partner of the same stamp."""
        inbox = self._inboxes[name]
        stamp, now = stamp_of(message), self._clock()
        mine, other = (inbox.color, inbox.depth) if kind == "color" else (inbox.depth, inbox.color)
        with self._wake:
            inbox.came[kind] = now
            mine.pop(stamp, None)
            mine[stamp] = message
            if stamp in other:  # before anything is dropped: it may be one of these
                self.dropped += inbox.ready is not None
                inbox.ready = (inbox.color.pop(stamp), inbox.depth.pop(stamp))
                inbox.heard, inbox.alone = now, None
                self._wake.notify()
            elif inbox.alone is None:
                inbox.alone = now
            gone = [s for s in mine if s > stamp + BACK]
            for given_up in gone or list(mine)[:-KEPT]:
                del mine[given_up]
                self.unpaired += 1

    def add_info(self, name: str, message: Any) -> None:
        """A camera_info. Raises: BagError for an uncalibrated camera."""
        with self._wake:
            self._inboxes[name].camera.add_info(message)

    def add_pose(self, name: str, message: Any) -> None:
        """A pose in world. Raises: BagError for another frame."""
        with self._wake:
            self._inboxes[name].camera.add_pose(message)

    def take(self, patience: float) -> dict[str, tuple[Any, Any]]:
        """Wait for pairs: of every camera heard of lately, or what has come `patience` [s] after the first.

        Nothing where none comes within IDLE: whoever waits has other things to do.
        """
        with self._wake:
            idle = time.monotonic() + IDLE
            while self._open and not self._ready():
                if (left := idle - time.monotonic()) <= 0.0:
                    return {}
                self._wake.wait(left)
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
        """Cameras without a complete picture, colour and depth of one stamp, for `limit` [s]."""
        now = self._clock()
        return [n for n, c in self._inboxes.items() if not _within(now, c.heard, limit)]

    def why(self, name: str) -> str:
        """Why a camera that is silent is so, in words."""
        inbox, now = self._inboxes[name], self._clock()
        with self._wake:
            boxes = {"color": inbox.color, "depth": inbox.depth}
            coming = [kind for kind in boxes if boxes[kind] and _within(now, inbox.came[kind], UNPAIRED)]
            if not coming:
                return NO_PICTURES
            if len(coming) == 1:
                kind, lacking = SPOKEN[coming[0]]
                return f"{kind} without {lacking}; is the {lacking} stream on?"
            newest = (list(box)[-2:] for box in boxes.values())  # one of them may be a picture ahead just now
            off = min(abs(c - d) for c, d in itertools.product(*newest)) * 1e-6
        return f"stamps of colour and depth differ by {off:.6g} ms; does the driver give both one stamp?"

    def picture(self, name: str, pair: tuple[Any, Any]) -> CameraFrame:
        """The picture of a pair. Raises: PredError, naming the camera, for what makes it unusable."""
        return self._inboxes[name].camera.picture(*pair)

    def _ready(self) -> bool:
        return any(c.ready is not None for c in self._inboxes.values())

    def _missing(self) -> bool:
        now = self._clock()
        return any(c.ready is None and _pairs_lately(c, now) for c in self._inboxes.values())


def _pairs_lately(inbox: _Inbox, now: float) -> bool:
    """Whether a picture is to be expected: something came, and has not been waiting in vain for long."""
    newest = max(inbox.came.values(), default=-math.inf)
    return _within(now, newest, LATELY) and (inbox.alone is None or _within(now, inbox.alone, UNPAIRED))


def _within(now: float, then: float, limit: float) -> bool:
    """Whether `then` is at most `limit` [s] ago; what is of the future was before the clock went back."""
    return 0.0 <= now - then <= limit
