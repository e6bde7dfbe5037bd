"""The wire: names and types of the topics, and CDR messages without a ROS installation.

The same names live and in bags. They are relative: a recorder that resolved them writes a leading
slash, and a robot may have a namespace of its own, so topics are compared after `bare_topic`.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Iterable
from typing import Any

from rosbags.serde.errors import SerdeError
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from pred_core.errors import BagError, nearest

WORLD = "world"  # the only frame of points and gripper poses

TRACKER_POINTS = "tracker/points"
STATE_POINTS = "state/points"
PREDICTION_POINTS = "prediction/points"
GOAL_POINTS = "goal/points"
GRIPPER_POSE = "gripper/pose"
GRIPPER_COMMAND = "gripper/command"
GRIPPER_CLOSED = "gripper/closed"
PLAN_TRAJECTORY = "plan/trajectory"
JOINT_STATES = "joint_states"

POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
POSE_ARRAY = "geometry_msgs/msg/PoseArray"
BYTE_ARRAY = "std_msgs/msg/UInt8MultiArray"

TYPES: dict[str, str] = {
    TRACKER_POINTS: POINT_CLOUD,
    STATE_POINTS: POINT_CLOUD,
    PREDICTION_POINTS: POINT_CLOUD,
    GOAL_POINTS: POINT_CLOUD,
    GRIPPER_POSE: POSE_ARRAY,
    GRIPPER_COMMAND: POSE_ARRAY,
    GRIPPER_CLOSED: BYTE_ARRAY,
    PLAN_TRAJECTORY: "trajectory_msgs/msg/MultiDOFJointTrajectory",
    JOINT_STATES: "sensor_msgs/msg/JointState",
}
REQUIRED: tuple[str, ...] = (TRACKER_POINTS, GRIPPER_POSE, GRIPPER_CLOSED)

_PICTURE = re.compile(r"(.+?)/((?:color|depth)/.+)")

# What a damaged message makes the decoder raise; each becomes a BagError.
_DECODER_ERRORS = (SerdeError, ValueError, IndexError, KeyError, TypeError, AssertionError, OverflowError, MemoryError)


def bare_topic(topic: str) -> str:
    """The topic without its leading slash."""
    return topic.lstrip("/")


def camera_topics(topics: Iterable[str]) -> dict[str, tuple[str, str]]:
    """The topics of cameras: topic -> (prefix, what is below it), as `cam0/color/image_raw` -> (`cam0`, ...).

    A camera is whatever has topics below `color/` or `depth/`; its pose belongs to it.
    """
    bare = {topic: bare_topic(topic) for topic in topics}
    matches = {topic: match for topic, name in bare.items() if (match := _PICTURE.fullmatch(name))}
    poses = {f"{match.group(1)}/pose": match.group(1) for match in matches.values()}
    found = {topic: (match.group(1), match.group(2)) for topic, match in matches.items()}
    return found | {topic: (poses[name], "pose") for topic, name in bare.items() if name in poses}


@functools.cache
def typestore() -> Typestore:
    """The message definitions of ROS 2 Jazzy."""
    return get_typestore(Stores.ROS2_JAZZY)


def message_type(name: str) -> Any:
    """The message class of a type name. Raises: BagError for a type outside common_interfaces."""
    types = typestore().types
    if name not in types:
        raise BagError(f"unknown message type '{name}'", next_step=nearest(name, types))
    return types[name]


def decode(data: bytes, type_name: str, where: str) -> Any:
    """Message object of the CDR bytes `data`; `where` names topic and bag. Raises: BagError."""
    message_type(type_name)
    try:
        return typestore().deserialize_cdr(data, type_name)
    except _DECODER_ERRORS as error:
        raise BagError(f"{where}: a {type_name} message of {len(data)} bytes is damaged", got=repr(error)) from error


def encode(message: Any) -> bytes:
    """CDR bytes of a message object."""
    return bytes(typestore().serialize_cdr(message, message.__msgtype__))


def make_header(stamp: int, frame: str = WORLD) -> Any:
    """std_msgs/Header of a stamp [ns]."""
    seconds, nanoseconds = divmod(int(stamp), 1_000_000_000)
    time = message_type("builtin_interfaces/msg/Time")(sec=seconds, nanosec=nanoseconds)
    return message_type("std_msgs/msg/Header")(stamp=time, frame_id=frame)


def stamp_of(message: Any) -> int:
    """Header stamp [ns] of a message object."""
    return int(message.header.stamp.sec) * 1_000_000_000 + int(message.header.stamp.nanosec)


def check_frame(message: Any, where: str) -> None:
    """Raise BagError unless the header's frame is `world`."""
    frame = message.header.frame_id
    if frame != WORLD:
        raise BagError(
            f"{where}: frame_id is not '{WORLD}'",
            got=repr(frame),
            allowed=repr(WORLD),
            next_step="Transform to the table frame (z up) where the data are recorded",
        )
