"""A small bag of four cameras: a rope led over the table beside the slot. It ships in bags/."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pred_core.plant.cameras import ring_of_cameras
from pred_core.plant.live.cell import WORKPLACE, Cell
from pred_core.plant.live.collect import Keeping, record
from pred_core.plant.live.station import Station
from pred_core.plant.live.teleop import TeleopConfig, draw_route

SEED = 11
RATE = 15.0  # [Hz] of each camera, as the twins of the cell step
SECONDS = 1.6
SLOWLY = TeleopConfig(slow=0.2, fast=0.25)  # m/s
KEPT = Keeping(quality=60, farthest=1.05)


def write_camera_sample(path: Path) -> None:
    """Write the bag: pictures of 320 x 240, compressed, camera poses, gripper; no tracker/points."""
    cameras = ring_of_cameras(target=WORKPLACE, distance=0.7, width=320, height=240, rate=RATE)
    with Cell(cameras=cameras) as cell:
        station = Station(cell)
        station.reset(SEED)
        route = draw_route(np.random.default_rng(SEED), "table", cell.reference, cell.slot, SECONDS, SLOWLY)
        record(path, station, route, SECONDS, None, KEPT)
