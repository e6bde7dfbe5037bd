"""One camera on the wire: its calibration and pose, and the pictures they make of colour and depth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pred_core.bag import images
from pred_core.bag.wire import stamp_of
from pred_core.errors import InputError
from pred_core.types import Array, CameraFrame


@dataclass
class Camera:
    """What is known of a camera so far. Messages may be of any origin, a bag or a subscription."""

    name: str  # prefix of its topics
    intrinsics: Array | None = None  # (3, 3) [px]
    size: tuple[int, int] = (0, 0)  # height, width the calibration is for
    pose: Array | None = None  # (4, 4) world_from_camera

    def add_info(self, message: Any) -> None:
        """A camera_info. Raises: BagError for an uncalibrated camera."""
        self.intrinsics, self.size = images.read_camera_info(message, f"{self.name}/{images.INFO}")

    def add_pose(self, message: Any) -> None:
        """A pose in world. Raises: BagError for another frame."""
        self.pose = images.read_camera_pose(message, f"{self.name}/{images.POSE}")

    def picture(self, color: Any, depth: Any) -> CameraFrame:
        """Of an Image or CompressedImage each, of one stamp. Raises: PredError, naming the camera, if unusable."""
        name = self.name
        if self.intrinsics is None:
            raise InputError(f"{name}: calibration missing", next_step=f"Publish {name}/{images.INFO}")
        if self.pose is None:
            raise InputError(f"{name}: pose missing", next_step=f"Publish {name}/{images.POSE} in frame world, latched")
        if depth.header.frame_id != color.header.frame_id:
            raise InputError(
                f"{name}: depth is not registered to colour",
                got=f"frame_id {depth.header.frame_id!r}",
                allowed=repr(color.header.frame_id),
                next_step="Switch on the driver's depth alignment",
            )
        read_color = images.read_color_compressed if hasattr(color, "format") else images.read_color
        rgb = read_color(color, f"{name}/{images.COLOR}")
        if rgb.shape[:2] != self.size:
            raise InputError(f"{name}: calibration of another picture size", got=self.size, allowed=rgb.shape[:2])
        read_depth = images.read_depth_compressed if hasattr(depth, "format") else images.read_depth
        metres = read_depth(depth, f"{name}/{images.DEPTH}")
        return CameraFrame(stamp_of(color), rgb, metres, self.intrinsics, self.pose)
