"""Camera frames <-> messages; the checks of what is read are those of `pred_core.bag.images`."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion
from sensor_msgs.msg import CameraInfo, Image

from pred_core.bag import images
from pred_core.types import CameraFrame
from pred_ros import convert


def frame_to_color(camera: str, frame: CameraFrame) -> Image:
    """camN/color/image_raw in rgb8."""
    return color_to_message(camera, frame.stamp, frame.rgb)


def frame_to_depth(camera: str, frame: CameraFrame) -> Image:
    """camN/depth/image_raw in 16UC1 millimetres, 0 = none (REP-118): what depth cameras send."""
    return depth_to_message(camera, frame.stamp, frame.depth)


def color_to_message(camera: str, stamp: int, rgb: images.Color) -> Image:
    """A picture (H, W, 3) as rgb8."""
    return _image(camera, stamp, "rgb8", np.ascontiguousarray(rgb))


def depth_to_message(camera: str, stamp: int, depth: images.Depth) -> Image:
    """Depth (H, W) [m] as 16UC1."""
    return _image(camera, stamp, "16UC1", images.millimetres(depth))


def frame_to_info(camera: str, frame: CameraFrame) -> CameraInfo:
    """camN/color/camera_info, no distortion."""
    height, width = frame.depth.shape
    k = np.asarray(frame.intrinsics, float)
    info = CameraInfo(header=convert.header_at(frame.stamp, images.optical_frame(camera)), height=height, width=width)
    info.distortion_model, info.d = "plumb_bob", [0.0] * 5
    info.k, info.r = k.ravel(), np.eye(3).ravel()
    info.p = np.concatenate([k, np.zeros((3, 1))], axis=1).ravel()
    return info


def pose_to_message(stamp: int, world_from_camera: np.ndarray) -> PoseStamped:
    """camN/pose: the optical frame (4, 4) in world."""
    x, y, z = (float(v) for v in world_from_camera[:3, 3])
    w, i, j, k = (float(v) for v in images.rotation_of(world_from_camera))
    pose = Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(w=w, x=i, y=j, z=k))
    return PoseStamped(header=convert.header_at(stamp), pose=pose)


def _image(camera: str, stamp: int, encoding: str, pixels: np.ndarray) -> Image:
    height, width = pixels.shape[:2]
    step = width * pixels.itemsize * (pixels.shape[2] if pixels.ndim == 3 else 1)
    header = convert.header_at(stamp, images.optical_frame(camera))
    message = Image(header=header, height=height, width=width, encoding=encoding, is_bigendian=0, step=step)
    # Assigning bytes to `data` would check them one by one; the array the message already has takes them at once.
    message.data.frombytes(pixels.tobytes())
    return message
