"""Colour and depth of each camera, paired by capture stamp, with its calibration and pose; newest pair only."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from pred_core.bag import images
from pred_core.bag.wire import stamp_of
from pred_core.errors import InputError
from pred_core.types import Array, CameraFrame

KEPT = 8  # pictures that wait for their partner


@dataclass
class _Camera:
    color: dict[int, Any] = field(default_factory=dict)  # stamp [ns] -> sensor_msgs/Image
    depth: dict[int, Any] = field(default_factory=dict)
    ready: tuple[Any, Any] | None = None
    intrinsics: Array | None = None
    size: tuple[int, int] = (0, 0)
    pose: Array | None = None
    heard: float = -math.inf  # [s] on the clock given


class CameraPairs:
    """Messages go in from the executor's thread, pictures come out to the worker."""

    def __init__(self, names: Sequence[str], clock: Callable[[], float] = time.monotonic):
        """clock [s]: that silence is judged on; the one of the stamps if that may be slow."""
        self._clock = clock
        self._cameras = {name: _Camera() for name in names}
        self._wake = threading.Condition()
        self._open = True
        self.dropped = 0  # pairs that a newer one replaced

    def add_image(self, name: str, kind: str, message: Any) -> None:
        """An image of `kind` color or depth; it waits for its partner of the same stamp."""
        camera = self._cameras[name]
        stamp = stamp_of(message)
        mine, other = (camera.color, camera.depth) if kind == "color" else (camera.depth, camera.color)
        with self._wake:
            camera.heard = self._clock()
            mine[stamp] = message
            while len(mine) > KEPT:
                del mine[min(mine)]
            if stamp in other:
                self.dropped += camera.ready is not None
                camera.ready = (camera.color.pop(stamp), camera.depth.pop(stamp))
                self._wake.notify()

    def add_info(self, name: str, message: Any) -> None:
        """A camera_info. Raises: BagError for an uncalibrated camera."""
        intrinsics, size = images.read_camera_info(message, f"{name}/{images.INFO}")
        with self._wake:
            self._cameras[name].intrinsics, self._cameras[name].size = intrinsics, size

    def add_pose(self, name: str, message: Any) -> None:
        """A pose in world. Raises: BagError for another frame."""
        pose = images.read_camera_pose(message, f"{name}/{images.POSE}")
        with self._wake:
            self._cameras[name].pose = pose

    def take(self, patience: float) -> dict[str, tuple[Any, Any]]:
        """Wait for pairs: of every camera heard of lately, or what has come `patience` [s] after the first."""
        with self._wake:
            while self._open and not self._ready():
                self._wake.wait()
            end = time.monotonic() + patience
            while self._open and self._missing() and (left := end - time.monotonic()) > 0.0:
                self._wake.wait(left)
            taken = {}
            for name, camera in self._cameras.items():
                if camera.ready is not None:
                    taken[name], camera.ready = camera.ready, None
            return taken

    def close(self) -> None:
        """Wake the worker for good; `take` returns at once from now on."""
        with self._wake:
            self._open = False
            self._wake.notify_all()

    def silent(self, limit: float) -> list[str]:
        """Cameras without a picture for `limit` [s]."""
        now = self._clock()
        return [n for n, c in self._cameras.items() if now - c.heard > limit]

    def picture(self, name: str, pair: tuple[Any, Any]) -> CameraFrame:
        """The picture of a pair. Raises: PredError, naming the camera, for what makes it unusable."""
        color, depth = pair
        camera = self._cameras[name]
        if camera.intrinsics is None:
            raise InputError(f"{name}: calibration missing", next_step=f"Publish {name}/{images.INFO}")
        if camera.pose is None:
            raise InputError(f"{name}: pose missing", next_step=f"Publish {name}/{images.POSE} in frame world, latched")
        if depth.header.frame_id != color.header.frame_id:
            raise InputError(
                f"{name}: depth is not registered to colour",
                got=f"frame_id {depth.header.frame_id!r}",
                allowed=repr(color.header.frame_id),
                next_step="Switch on the driver's depth alignment",
            )
        rgb = images.read_color(color, f"{name}/{images.COLOR}")
        if rgb.shape[:2] != camera.size:
            raise InputError(f"{name}: calibration of another picture size", got=camera.size, allowed=rgb.shape[:2])
        metres = images.read_depth(depth, f"{name}/{images.DEPTH}")
        return CameraFrame(stamp_of(color), rgb, metres, camera.intrinsics, camera.pose)

    def _ready(self) -> bool:
        return any(c.ready is not None for c in self._cameras.values())

    def _missing(self) -> bool:
        now = self._clock()
        return any(c.ready is None and now - c.heard < 0.5 for c in self._cameras.values())
