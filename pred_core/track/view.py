"""One picture, checked and lifted: the pixels above the table, as points in world."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pred_core.bag.images import FARTHEST
from pred_core.errors import InputError
from pred_core.track.color_model import ColorModel
from pred_core.track.workspace import Workspace
from pred_core.types import Array, CameraFrame

Picture = NDArray[np.uint8]
ROTATION_TOLERANCE = 1e-3
SAMPLE = 4096  # pixels that judge the unit of a picture's depth


@dataclass(frozen=True)
class View:
    """Points of one picture that may belong to the object."""

    camera: str
    stamp: int  # [ns] capture time
    points: Array  # (M, 3) [m] world, on the surface
    rays: Array  # (M, 3) unit vectors from the camera to the points, world
    depth: Array  # (M,) [m]
    color: Picture  # (M, 3)
    pixel: NDArray[np.int64]  # (M,) row * width + column
    picture: CameraFrame  # the whole of it

    def select(self, keep: NDArray[np.bool_] | NDArray[np.int64]) -> View:
        """Some of the points."""
        return View(
            self.camera,
            self.stamp,
            self.points[keep],
            self.rays[keep],
            self.depth[keep],
            self.color[keep],
            self.pixel[keep],
            self.picture,
        )

    def unobstructed(self, points: Array, margin: float) -> NDArray[np.bool_]:
        """(P,) of points (P, 3) [m] world before which, by more than `margin` [m], the camera sees nothing."""
        frame = self.picture
        pixel, depth = project(points, frame.intrinsics, frame.world_from_camera)
        height, width = frame.depth.shape
        inside: NDArray[np.bool_] = np.asarray(np.isfinite(pixel).all(axis=-1))
        at = np.round(np.where(inside[:, None], pixel, -1.0)).astype(int)
        inside &= (at >= 0).all(axis=-1) & (at[:, 0] < width) & (at[:, 1] < height)
        found = np.zeros(len(points), bool)
        seen = at[inside]
        found[inside] = frame.depth[seen[:, 1], seen[:, 0]] > depth[inside] - margin  # NaN is no evidence
        return found


def check_frame(frame: CameraFrame, camera: str) -> None:
    """Raise InputError, naming the camera, for what no picture can be used with."""
    rows = frame.rgb.shape[:2]
    if frame.rgb.ndim != 3 or frame.rgb.shape[2] != 3 or frame.depth.shape != rows:
        raise InputError(
            f"{camera}: colour and depth do not fit",
            got=f"{frame.rgb.shape} and {frame.depth.shape}",
            allowed="(H, W, 3) and (H, W)",
            next_step="Publish depth registered to colour",
        )
    k = frame.intrinsics
    if k.shape != (3, 3) or not np.isfinite(k).all() or not (k[0, 0] > 0 and k[1, 1] > 0):
        got = k.tolist() if k.shape == (3, 3) else k.shape
        raise InputError(f"{camera}: not calibrated", got=got, next_step="Publish camera_info with K filled")
    pose = frame.world_from_camera
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise InputError(f"{camera}: its pose in world is missing", next_step=f"Publish {camera}/pose")
    turn = pose[:3, :3]
    if np.abs(turn @ turn.T - np.eye(3)).max() > ROTATION_TOLERANCE or np.linalg.det(turn) < 0:
        raise InputError(f"{camera}: its pose is not a rigid transform", got=np.round(turn, 3).tolist())
    if not np.isfinite(frame.depth).any():
        raise InputError(
            f"{camera}: no pixel has a depth",
            got=f"{frame.depth.size} x NaN",
            next_step="Check the depth stream and its unit",
        )
    sample = frame.depth.ravel()[:: max(1, frame.depth.size // SAMPLE)]
    known = sample[np.isfinite(sample)]
    middle = float(np.median(known)) if len(known) else 0.0
    if middle > FARTHEST:
        raise InputError(
            f"{camera}: implausible depth, are these millimetres?",
            got=f"{middle:.4g} m in the middle of all",
            allowed=f"up to {FARTHEST:g} m",
            next_step="Publish 32FC1 in metres, or 16UC1 in millimetres (REP-118)",
        )


class Lifter:
    """Lifts pictures of one camera. Remembers, for its pose, how deep the table is in every pixel."""

    def __init__(self, camera: str, workspace: Workspace):
        self.camera, self.workspace = camera, workspace
        self._key: tuple[bytes, bytes, tuple[int, ...]] | None = None
        self._limit: NDArray[np.float32] = np.zeros(0, np.float32)

    def lift(self, frame: CameraFrame, share: float, color: ColorModel | None = None) -> View:
        """Pixels of the colour, `share` of the clearance above the table, inside the box. Raises: InputError."""
        check_frame(frame, self.camera)
        self._prepare(frame, share)
        # A ray that sinks by s a metre of depth meets the height h at depth (camera height - h) / s.
        pixel = np.flatnonzero(frame.depth.ravel() < self._limit)
        if color is not None:
            pixel = pixel[color.matches(frame.rgb.reshape(-1, 3)[pixel])]
        return self.lift_pixels(frame, pixel)

    def lift_pixels(self, frame: CameraFrame, pixel: NDArray[np.int64]) -> View:
        """The given pixels that have a depth and lie inside the box."""
        width = frame.depth.shape[1]
        depth = frame.depth.ravel()[pixel].astype(np.float64)
        v, u = np.divmod(pixel, width)
        ray = pixel_rays(frame, u.astype(np.float64), v.astype(np.float64))
        points = ray * depth[:, None] + frame.world_from_camera[:3, 3]
        keep = self.workspace.contains(points)
        ray = ray[keep]
        return View(
            self.camera,
            frame.stamp,
            points[keep],
            ray / np.linalg.norm(ray, axis=-1, keepdims=True),
            depth[keep],
            frame.rgb.reshape(-1, 3)[pixel[keep]],
            pixel[keep],
            frame,
        )

    def _prepare(self, frame: CameraFrame, share: float) -> None:
        pose, k = frame.world_from_camera, frame.intrinsics
        key = (pose.tobytes() + np.float64(share).tobytes(), k.tobytes(), frame.depth.shape)
        if key == self._key:
            return
        height, width = frame.depth.shape
        v, u = np.mgrid[0:height, 0:width]
        rise = pixel_rays(frame, u.ravel().astype(np.float64), v.ravel().astype(np.float64))[:, 2]
        above = float(pose[2, 3]) - self.workspace.table - share * self.workspace.clearance
        with np.errstate(divide="ignore"):
            limit = np.where(rise < -1e-9, above / -rise, np.inf)
            limit = np.where(np.isfinite(limit), limit - share * self.workspace.depth_noise * limit**2, limit)
        self._limit, self._key = limit.astype(np.float32), key


def pixel_rays(frame: CameraFrame, u: Array, v: Array) -> Array:
    """World directions (M, 3) of pixels (u, v), of depth 1 m along the optical axis; pixel centres are whole."""
    k = frame.intrinsics
    y = (v - k[1, 2]) / k[1, 1]
    x = (u - k[0, 2] - k[0, 1] * y) / k[0, 0]
    return np.stack((x, y, np.ones_like(x)), axis=-1) @ frame.world_from_camera[:3, :3].T


def project(points: Array, intrinsics: Array, world_from_camera: Array) -> tuple[Array, Array]:
    """Pixels (M, 2) and depths (M,) [m] of points (M, 3) [m] world; NaN pixels behind the camera."""
    turn, place = world_from_camera[:3, :3], world_from_camera[:3, 3]
    local = (points - place) @ turn
    depth = local[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        pixel = (local @ intrinsics.T)[:, :2] / depth[:, None]
    pixel[depth <= 1e-6] = np.nan
    return pixel, depth
