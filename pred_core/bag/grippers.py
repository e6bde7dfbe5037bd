"""PoseArray of the grippers and their closed flags <-> numpy arrays. Quaternions are wxyz in arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pred_core.bag.clouds import check_extent
from pred_core.bag.wire import check_frame, make_header, message_type, stamp_of
from pred_core.errors import BagError

UNIT_TOLERANCE = 1e-3  # of a quaternion's norm; float32 sources round at 1e-7


@dataclass(frozen=True)
class PoseFrame:
    """One `gripper/pose` message."""

    stamp: int  # [ns] header
    position: NDArray[np.float64]  # (G, 3) [m] world
    rotation: NDArray[np.float64]  # (G, 4) wxyz world_from_gripper


def read_gripper_pose(message: Any, where: str) -> PoseFrame:
    """The gripper poses of a PoseArray. Raises: BagError if not in `world`, not finite or not a rotation."""
    check_frame(message, where)
    where = f"{where} at {stamp_of(message) * 1e-9:.3f} s"
    position = np.array([[p.position.x, p.position.y, p.position.z] for p in message.poses], float).reshape(-1, 3)
    rotation = np.array(
        [[p.orientation.w, p.orientation.x, p.orientation.y, p.orientation.z] for p in message.poses], float
    ).reshape(-1, 4)
    if not np.isfinite(position).all() or not np.isfinite(rotation).all():
        raise BagError(f"{where}: a gripper pose is not finite", next_step="Record only poses the arm reported")
    with np.errstate(over="ignore"):  # a damaged quaternion may be huge; infinity is not 1 either
        norm = np.linalg.norm(rotation, axis=-1)
    if (np.abs(norm - 1.0) > UNIT_TOLERANCE).any():
        raise BagError(f"{where}: a gripper quaternion has no unit norm", got=norm.tolist(), allowed="1 +- 0.001")
    check_extent(position, where)
    return PoseFrame(stamp_of(message), position, rotation / norm[:, None])


def make_gripper_pose(stamp: int, position: NDArray[np.float64], rotation: NDArray[np.float64]) -> Any:
    """A PoseArray of positions (G, 3) [m] and rotations (G, 4) wxyz in `world`."""
    pose = message_type("geometry_msgs/msg/Pose")
    point = message_type("geometry_msgs/msg/Point")
    quaternion = message_type("geometry_msgs/msg/Quaternion")
    poses = [
        pose(position=point(x=p[0], y=p[1], z=p[2]), orientation=quaternion(w=q[0], x=q[1], y=q[2], z=q[3]))
        for p, q in zip(np.asarray(position, float).tolist(), np.asarray(rotation, float).tolist(), strict=True)
    ]
    return message_type("geometry_msgs/msg/PoseArray")(header=make_header(stamp), poses=poses)


def read_gripper_closed(message: Any, where: str) -> NDArray[np.bool_]:
    """Closed flags (G,) of a UInt8MultiArray. Raises: BagError for a value other than 0 and 1."""
    data = np.asarray(message.data, np.uint8)
    if (data > 1).any():
        raise BagError(f"{where}: a closed flag is neither 0 nor 1", got=data.tolist(), allowed="0 open, 1 closed")
    return data.astype(bool)


def make_gripper_closed(closed: NDArray[np.bool_]) -> Any:
    """A UInt8MultiArray of closed flags (G,)."""
    dimension = message_type("std_msgs/msg/MultiArrayDimension")
    layout = message_type("std_msgs/msg/MultiArrayLayout")
    count = len(closed)
    return message_type("std_msgs/msg/UInt8MultiArray")(
        layout=layout(dim=[dimension(label="gripper", size=count, stride=count)], data_offset=0),
        data=np.asarray(closed, np.uint8),
    )
