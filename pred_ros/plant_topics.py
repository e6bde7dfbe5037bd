"""What the plant publishes: pictures as from cameras, poses and joints as from an arm's driver, time."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import PoseArray, PoseStamped
from rclpy.node import Node
from rclpy.publisher import Publisher
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image, JointState, PointCloud2
from std_msgs.msg import UInt8MultiArray

from pred_core.bag import images
from pred_core.bag.clouds import PointFrame
from pred_core.bag.grippers import PoseFrame
from pred_core.bag.wire import GRIPPER_CLOSED, GRIPPER_POSE, JOINT_STATES
from pred_core.plant.cameras import CameraConfig
from pred_core.plant.live.station import Moment, Picture
from pred_ros import arm_messages, convert, image_messages, qos

POSE_EVERY = 2  # ticks: gripper/pose at 75 Hz
CLOSED_EVERY = 150  # ticks: gripper/closed once a second too, for readers that came late
TRUTH = "~/truth"


class PlantTopics:
    """arm: publish what an arm's driver would; truth: publish the true rope, for scoring only."""

    def __init__(self, node: Node, cameras: tuple[CameraConfig, ...], arm: bool, truth: bool):
        self._cameras, self._ticks = cameras, 0
        self._closed: bool | None = None  # as published last
        self._pictures: dict[str, dict[str, Publisher]] = {
            c.name: {
                images.COLOR: node.create_publisher(Image, f"{c.name}/{images.COLOR}", qos.images()),
                images.DEPTH: node.create_publisher(Image, f"{c.name}/{images.DEPTH}", qos.images()),
                images.INFO: node.create_publisher(CameraInfo, f"{c.name}/{images.INFO}", qos.images()),
                images.POSE: node.create_publisher(PoseStamped, f"{c.name}/{images.POSE}", qos.latched()),
            }
            for c in cameras
        }
        self._clock = node.create_publisher(Clock, "/clock", 10)
        self._arm = arm
        if arm:
            self._pose = node.create_publisher(PoseArray, GRIPPER_POSE, qos.points_complete())
            self._flags = node.create_publisher(UInt8MultiArray, GRIPPER_CLOSED, qos.latched())
            self._joints = node.create_publisher(JointState, JOINT_STATES, 10)
        self._truth = node.create_publisher(PointCloud2, TRUTH, qos.points_complete()) if truth else None

    def begin(self, moment: Moment) -> None:
        """After a reset: camera poses, then the first moment."""
        for c in self._cameras:
            pose = image_messages.pose_to_message(moment.stamp, c.world_from_camera)
            self._pictures[c.name][images.POSE].publish(pose)
        self._ticks, self._closed = 0, None
        self.publish(moment)

    def publish(self, moment: Moment) -> None:
        """Everything of one tick; the clock last, so that what it wakes finds the rest."""
        for picture in moment.pictures:
            self._publish_picture(picture)
        if self._arm:
            self._publish_arm(moment)
        if self._truth is not None and moment.pictures:
            rope = moment.truth.rope
            ids, sure = np.arange(len(rope), dtype=np.uint32), np.ones(len(rope), np.float32)
            self._truth.publish(convert.points_to_cloud(PointFrame(moment.stamp, rope, ids, sure, None)))
        self._clock.publish(Clock(clock=convert.time_at(moment.stamp)))
        self._ticks += 1

    def _publish_picture(self, picture: Picture) -> None:
        out = self._pictures[picture.camera]
        out[images.INFO].publish(image_messages.frame_to_info(picture.camera, picture.frame))
        out[images.COLOR].publish(image_messages.frame_to_color(picture.camera, picture.frame))
        out[images.DEPTH].publish(image_messages.frame_to_depth(picture.camera, picture.frame))

    def _publish_arm(self, moment: Moment) -> None:
        truth = moment.truth
        if truth.closed != self._closed or self._ticks % CLOSED_EVERY == 0:
            self._closed = truth.closed
            self._flags.publish(convert.closed_to_message(arm_messages.closed_flag(truth.closed)))
        if self._ticks % POSE_EVERY and not moment.pictures:
            return
        pose = PoseFrame(moment.stamp, truth.gripper.position[None], truth.gripper.rotation[None])
        self._pose.publish(convert.pose_to_message(pose))
        if truth.joints:
            self._joints.publish(arm_messages.reading_to_joints(moment.stamp, truth.joints))
