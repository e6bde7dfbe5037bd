"""Messages <-> types, the only file that knows both. Bad content raises PredError; nothing is repaired.

Reading shares the checks of `pred_core.bag` (frame, field layout, NaN, extent, repeated ids), so that a
live message and the same message in a bag are accepted or refused alike.
"""

from __future__ import annotations

import numpy as np
import torch
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, PoseArray, Quaternion
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Header, UInt8MultiArray

from pred_core.bag.clouds import (
    STATE_LAYOUT,
    TRACKER_LAYOUT,
    PointFrame,
    check_extent,
    cloud_array,
    read_tracker_points,
)
from pred_core.bag.grippers import PoseFrame, read_gripper_closed, read_gripper_pose
from pred_core.bag.wire import (
    GRIPPER_CLOSED,
    GRIPPER_POSE,
    PREDICTION_POINTS,
    TRACKER_POINTS,
    WORLD,
    check_frame,
    stamp_of,
)
from pred_core.errors import InputError
from pred_core.types import State

NS = 1_000_000_000
_CODES = {"i4": PointField.INT32, "u4": PointField.UINT32, "f4": PointField.FLOAT32}


def time_at(stamp: int) -> Time:
    """builtin_interfaces/Time of an integer stamp [ns]."""
    return Time(sec=stamp // NS, nanosec=stamp % NS)


def header_at(stamp: int, frame: str = WORLD) -> Header:
    """Header with an integer stamp [ns]."""
    return Header(stamp=time_at(stamp), frame_id=frame)


def make_cloud(stamp: int, layout: dict[str, str], columns: dict[str, NDArray]) -> PointCloud2:
    """An unorganised little-endian cloud in `world`; `columns` holds (N,) values of each field of `layout`."""
    count = len(columns["x"])
    table = np.empty(count, np.dtype([(name, "<" + kind) for name, kind in layout.items()]))
    for name in layout:
        table[name] = columns[name]
    step = table.dtype.itemsize
    fields = [
        PointField(name=name, offset=4 * i, datatype=_CODES[kind], count=1)
        for i, (name, kind) in enumerate(layout.items())
    ]
    cloud = PointCloud2(header=header_at(stamp), height=1, width=count, fields=fields, is_bigendian=False)
    cloud.point_step, cloud.row_step, cloud.is_dense = step, step * count, True
    # Assigning bytes to `data` would check them one by one; the array the message already has takes them at once.
    cloud.data.frombytes(table.tobytes())
    return cloud


def points_to_cloud(frame: PointFrame) -> PointCloud2:
    """tracker/points of one instant (without colour)."""
    layout = {name: kind for name, kind in TRACKER_LAYOUT.items() if name != "rgb"}
    columns = {**_columns("xyz", frame.position), "id": frame.id, "confidence": frame.confidence}
    return make_cloud(frame.stamp, layout, columns)


def cloud_to_points(cloud: PointCloud2) -> PointFrame:
    """One tracker/points message. Raises: BagError for what the bag contract forbids."""
    return read_tracker_points(cloud, TRACKER_POINTS)


def state_to_cloud(stamp: int, ids: NDArray[np.uint32], state: State) -> PointCloud2:
    """state/points or prediction/points of one world at `stamp` [ns].

    Raises: InputError if a value is not finite: NaN never goes on the wire.
    """
    position, velocity = state.position.numpy(), state.velocity.numpy()
    if not (np.isfinite(position).all() and np.isfinite(velocity).all()):
        raise InputError("a state with values that are not finite is not published")
    moving = {**_columns("xyz", position), **_columns(("vx", "vy", "vz"), velocity)}
    return make_cloud(stamp, dict(STATE_LAYOUT), {**moving, "id": ids, "held": state.held.numpy()})


def cloud_to_state(cloud: PointCloud2, topic: str) -> tuple[int, NDArray[np.uint32], State]:
    """Stamp [ns], particle ids (N,) and `State` (without memory) of state/points or prediction/points.

    Raises: BagError for another frame or layout, or a state whose extent only millimetres explain (a prediction may
    go astray that far: it is scored as it is); InputError if a value is not finite.
    """
    check_frame(cloud, topic)
    table = cloud_array(cloud, STATE_LAYOUT, topic)
    position = np.stack([table[n] for n in ("x", "y", "z")], axis=-1).astype(np.float32)
    velocity = np.stack([table[n] for n in ("vx", "vy", "vz")], axis=-1).astype(np.float32)
    bad = ~np.isfinite(position + velocity).all(-1)
    if bad.any():
        ids = table["id"][bad][:5].tolist()
        raise InputError(f"{topic}: points of ids {ids} are not finite", allowed="finite metres")
    if topic != PREDICTION_POINTS:
        check_extent(position.astype(np.float64), topic)
    held = torch.from_numpy(table["held"].astype(np.int32))
    state = State(torch.from_numpy(position), torch.from_numpy(velocity), held)
    return stamp_of(cloud), table["id"].astype(np.uint32), state


def pose_to_message(frame: PoseFrame) -> PoseArray:
    """gripper/pose of one instant."""
    poses = []
    for p, (w, x, y, z) in zip(frame.position.tolist(), frame.rotation.tolist(), strict=True):
        poses.append(Pose(position=Point(x=p[0], y=p[1], z=p[2]), orientation=Quaternion(x=x, y=y, z=z, w=w)))
    return PoseArray(header=header_at(frame.stamp), poses=poses)


def message_to_pose(message: PoseArray) -> PoseFrame:
    """One gripper/pose message. Raises: BagError for what the bag contract forbids, InputError for no pose."""
    if not message.poses:
        raise InputError(f"{GRIPPER_POSE}: no pose", got="an empty PoseArray", allowed="one pose per gripper")
    return read_gripper_pose(message, GRIPPER_POSE)


def closed_to_message(closed: NDArray[np.bool_]) -> UInt8MultiArray:
    """gripper/closed, flags (G,)."""
    return UInt8MultiArray(data=[int(c) for c in closed])


def message_to_closed(message: UInt8MultiArray) -> NDArray[np.bool_]:
    """Closed flags (G,). Raises: BagError for a value other than 0 and 1."""
    return read_gripper_closed(message, GRIPPER_CLOSED)


def _columns(names: str | tuple[str, ...], values: NDArray) -> dict[str, NDArray]:
    return dict(zip(names, values.T, strict=True))
