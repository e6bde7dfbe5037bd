"""Episodes of the cell as bags of the wire: what cameras, arm and tracker say, and nothing of the truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pred_core.bag import images
from pred_core.bag.clouds import PointFrame, make_tracker_points
from pred_core.bag.grippers import make_gripper_closed, make_gripper_pose
from pred_core.bag.wire import GRIPPER_CLOSED, GRIPPER_POSE, TRACKER_POINTS
from pred_core.bag.writer import BagWriter
from pred_core.errors import InputError
from pred_core.plant.live.station import TICK, Moment, Picture, Station
from pred_core.plant.live.teleop import Route

Array = NDArray[np.float64]
POSE_EVERY = 2  # ticks: gripper/pose at 75 Hz
LEAST = 0.9  # share of the pictures' instants that the tracker must give points for


class Watcher(Protocol):
    """A tracker, seen from here: it gets what cameras and arm send, and says where the particles are."""

    def pose(self, stamp: int, position: Array, rotation: Array, closed: bool) -> None:
        """A measured gripper pose (3,) [m], (4,) wxyz."""
        ...

    def pictures(self, pictures: tuple[Picture, ...]) -> PointFrame | None:
        """Pictures of one instant; None: the object is not found, or lost."""
        ...


@dataclass(frozen=True)
class Keeping:
    """How pictures are kept in a bag: compressed, depth without loss."""

    quality: int = 80  # of JPEG
    farthest: float = np.inf  # [m] depth beyond it is dropped, as a driver's range filter does


def record(
    path: Path, station: Station, route: Route, seconds: float, watcher: Watcher | None, keeping: Keeping | None
) -> None:
    """Lead the tool along the route for `seconds` [s] from the station's present moment, and write the bag.

    keeping None: pictures are shown to the tracker and not kept. Raises: InputError if the tracker sees the object too
    rarely; then no bag is left.
    """
    ticks = round(seconds / TICK)
    with BagWriter(path) as writer:
        _write_poses(writer, station)
        seen = total = 0
        moment = station.moment
        for k in range(ticks + 1):
            if k:
                moment = station.advance(route.at(k * TICK), 1)[0]
            if k % POSE_EVERY == 0 or moment.pictures:
                _write_arm(writer, moment)
                if watcher is not None:
                    pose = moment.truth.gripper  # what the arm measures
                    watcher.pose(moment.stamp, pose.position, pose.rotation, moment.truth.closed)
            if not moment.pictures:
                continue
            if keeping is not None:
                _write_pictures(writer, moment, keeping)
            if watcher is not None:
                points = watcher.pictures(moment.pictures)
                total, seen = total + 1, seen + (points is not None)
                if points is not None:
                    writer.write(TRACKER_POINTS, make_tracker_points(points), points.stamp)
        if watcher is not None and seen < LEAST * total:
            raise InputError(
                f"{path.name}: the tracker saw the rope too rarely",
                got=f"{seen} of {total} instants",
                allowed=f"{LEAST:.0%}",
                next_step="Use more cameras, or another seed",
            )


def _write_arm(writer: BagWriter, moment: Moment) -> None:
    pose = moment.truth.gripper
    writer.write(GRIPPER_POSE, make_gripper_pose(moment.stamp, pose.position[None], pose.rotation[None]), moment.stamp)
    writer.write(GRIPPER_CLOSED, make_gripper_closed(np.array([moment.truth.closed])), moment.stamp)


def _write_poses(writer: BagWriter, station: Station) -> None:
    for camera in station.cell.cameras:
        pose = camera.world_from_camera
        message = images.make_camera_pose(station.stamp, pose[:3, 3], images.rotation_of(pose))
        writer.write(f"{camera.name}/{images.POSE}", message, station.stamp)


def _write_pictures(writer: BagWriter, moment: Moment, keeping: Keeping) -> None:
    for picture in moment.pictures:
        name, frame = picture.camera, picture.frame
        height, width = frame.depth.shape
        info = images.make_camera_info(frame.stamp, name, frame.intrinsics, height, width)
        color = images.compress_color(frame.rgb, keeping.quality)
        depth = images.compress_depth(np.where(frame.depth <= keeping.farthest, frame.depth, np.float32(np.nan)))
        for topic, message in (
            (images.INFO, info),
            (images.COLOR_COMPRESSED, images.make_compressed(frame.stamp, name, "rgb8; jpeg compressed bgr8", color)),
            (images.DEPTH_COMPRESSED, images.make_compressed(frame.stamp, name, images.DEPTH_FORMAT, depth)),
        ):
            writer.write(f"{name}/{topic}", message, moment.stamp)
