"""The tracker as the cell's recorder sees it: pictures in, `tracker/points` out, as between the nodes."""

from __future__ import annotations

import numpy as np

from pred_core.bag import images
from pred_core.bag.clouds import PointFrame
from pred_core.plant.live.cell import Cell
from pred_core.plant.live.station import Picture
from pred_core.track.line_config import LineConfig
from pred_core.track.tracker import Tracker, TrackerConfig
from pred_core.track.workspace import Workspace
from pred_core.types import Array, CameraFrame

PARTICLES = 30
ROOM = Workspace(low=(0.1, -0.55, 0.0), high=(0.75, 0.55, 0.45), table=0.0)
ARM_RADIUS, ARM_START, ARM_END = 0.07, -0.055, -0.45  # [m] along the tool's z axis, which points down


class TrackerWatcher:
    """One tracker for one episode. It knows the rig (cameras, table, slot) and nothing of the rope."""

    def __init__(self, cell: Cell):
        config = TrackerConfig(
            workspace=ROOM,
            line=LineConfig(particles=PARTICLES),
            arm_radius=ARM_RADIUS,
            arm_start=ARM_START,
            arm_end=ARM_END,
        )
        self._tracker = Tracker(config, [c.name for c in cell.cameras])
        self._tracker.fixtures = cell.slot.boxes

    def pose(self, stamp: int, position: Array, rotation: Array, closed: bool) -> None:
        """A measured gripper pose."""
        self._tracker.add_grip(stamp, position[None], rotation[None], np.array([closed]))

    def pictures(self, pictures: tuple[Picture, ...]) -> PointFrame | None:
        """Points of one instant, of pictures in whole millimetres as they go over the wire."""
        for picture in pictures:
            self._tracker.add_frame(picture.camera, _over_the_wire(picture.frame))
        estimate = self._tracker.step()
        if estimate is None or estimate.status != "tracking":
            return None
        tracks = estimate.tracks
        return PointFrame(int(tracks.stamp), tracks.position, tracks.id, tracks.confidence, None)


def _over_the_wire(frame: CameraFrame) -> CameraFrame:
    depth = images.metres(images.millimetres(frame.depth))
    return CameraFrame(frame.stamp, frame.rgb, depth, frame.intrinsics, frame.world_from_camera)
