"""Messages of the arm node <-> plain values; the other conversions are in convert.py."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import PoseArray
from numpy.typing import NDArray
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import MultiDOFJointTrajectory

from pred_core.arm.follower import MOST_POINTS, Plan, make_plan
from pred_core.arm.limits import GuardConfig
from pred_core.arm.protocol import Reading
from pred_core.bag.grippers import PoseFrame
from pred_core.bag.wire import check_frame, stamp_of
from pred_core.errors import InputError
from pred_ros import convert

COMMAND = "gripper/command"
PLAN = "plan/trajectory"
POINT_BYTES = 80  # on the wire, where a point has one transform and nothing else


def bytes_to_plan(data: bytes, config: GuardConfig) -> Plan:
    """The plan of the one gripper of this arm, of a message as it came: a large one takes too long to unpack.

    Raises: InputError for one that cannot be followed.
    """
    if len(data) > 2 * MOST_POINTS * POINT_BYTES:
        raise InputError(
            f"{PLAN}: too long to be read while the arm moves",
            got=f"{len(data):,} bytes, some {len(data) // POINT_BYTES:,} points",
            allowed=f"{MOST_POINTS:,} points",
            next_step="Send it in parts, or with points farther apart",
        )
    return message_to_plan(deserialize_message(data, MultiDOFJointTrajectory), config)


def message_to_plan(message: MultiDOFJointTrajectory, config: GuardConfig) -> Plan:
    """The plan of the one gripper of this arm. Raises: InputError for one that cannot be followed."""
    if len(message.joint_names) != 1:
        raise InputError(f"{PLAN}: one gripper an arm", got=list(message.joint_names), allowed="one name")
    for k, point in enumerate(message.points):
        if len(point.transforms) != 1:
            raise InputError(f"{PLAN}: point {k}", got=f"{len(point.transforms)} transforms", allowed="1")
    times = [p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in message.points]
    transforms = [p.transforms[0] for p in message.points]
    position = np.array([[t.translation.x, t.translation.y, t.translation.z] for t in transforms], float)
    rotation = np.array([[t.rotation.w, t.rotation.x, t.rotation.y, t.rotation.z] for t in transforms], float)
    stamp, frame = stamp_of(message), message.header.frame_id
    return make_plan(stamp, frame, times, position.reshape(-1, 3), rotation.reshape(-1, 4), config)


def message_to_command(message: PoseArray) -> tuple[int, list[float], list[float]]:
    """Stamp [ns], position [m] and rotation wxyz as they came: the guard judges the values.

    Raises: BagError for another frame than world, InputError unless there is exactly one pose.
    """
    check_frame(message, COMMAND)
    if len(message.poses) != 1:
        raise InputError(f"{COMMAND}: one gripper an arm", got=f"{len(message.poses)} poses", allowed="1")
    p, q = message.poses[0].position, message.poses[0].orientation
    return stamp_of(message), [p.x, p.y, p.z], [q.w, q.x, q.y, q.z]


def reading_to_pose(stamp: int, reading: Reading) -> PoseArray:
    """gripper/pose of one gripper at `stamp` [ns]."""
    return convert.pose_to_message(PoseFrame(stamp, reading.position[None], np.array([reading.rotation])))


def reading_to_joints(stamp: int, joints: dict[str, float]) -> JointState:
    """joint_states at `stamp` [ns]; angles [rad]."""
    return JointState(
        header=convert.header_at(stamp, ""), name=list(joints), position=[float(a) for a in joints.values()]
    )


def closed_flag(closed: bool) -> NDArray[np.bool_]:
    """gripper/closed of one gripper."""
    return np.array([closed])
