"""The eye of a run: writes every message of the loop into a bag, keeps what the report needs, asks services."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray, PoseStamped
from rcl_interfaces.srv import SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image, JointState, PointCloud2
from std_msgs.msg import UInt8MultiArray
from trajectory_msgs.msg import MultiDOFJointTrajectory

from pred_core.bag import images
from pred_core.bag.clouds import read_tracker_points
from pred_core.bag.wire import (
    GOAL_POINTS,
    GRIPPER_CLOSED,
    GRIPPER_POSE,
    JOINT_STATES,
    PLAN_TRAJECTORY,
    PREDICTION_POINTS,
    STATE_POINTS,
    TRACKER_POINTS,
    stamp_of,
)
from pred_core.bag.writer import BagWriter
from pred_core.errors import InputError
from pred_core.plant.live.success import judge_passage
from pred_ros import convert, planner_messages, qos
from pred_ros.commands import Interrupts
from pred_ros.reroute_faults import GONE
from pred_ros.reroute_record import NS, PlanSeen, Record, Said, View

DIAGNOSTICS = "/diagnostics"
TRUTH = "plant/truth"
JPEG_QUALITY = 80
SILENT = 2.5  # [s] of the cell's time without diagnostics, which come once a second: the node has ended or hangs
ERROR = 2  # level of what is said of it
ANSWER, AGAIN = 120.0, 8.0  # [s] on the wall for a service, and until it is asked again


class Watch:
    """Spin it from one thread; there it raises KeyboardInterrupt. Nothing of the truth goes into the bag."""

    def __init__(self, record: Record, writer: BagWriter, camera: str | None, interrupts: Interrupts):
        """camera: whose pictures are kept, None: none."""
        self.record, self._writer, self._camera = record, writer, camera
        self._interrupts = interrupts
        self._heard: dict[str, int] = {}  # node -> [ns] its newest diagnostics
        self.node = rclpy.create_node("watch")
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._goal_out = self.node.create_publisher(PointCloud2, GOAL_POINTS, qos.latched())
        complete = qos.points_complete()
        self.node.create_subscription(Clock, "/clock", self._on_clock, 100)
        self.node.create_subscription(PointCloud2, TRUTH, self._on_truth, complete)
        self._keep(PointCloud2, TRACKER_POINTS, complete, self._on_tracked)
        self._keep(PointCloud2, STATE_POINTS, complete, self._on_state)
        self._keep(PointCloud2, PREDICTION_POINTS, complete)
        self._keep(PointCloud2, GOAL_POINTS, qos.latched())
        self._keep(PoseArray, GRIPPER_POSE, complete, self._on_pose)
        self._keep(UInt8MultiArray, GRIPPER_CLOSED, qos.latched())
        self._keep(JointState, JOINT_STATES, QoSProfile(depth=100))
        self._keep(MultiDOFJointTrajectory, PLAN_TRAJECTORY, QoSProfile(depth=10), self._on_plan)
        self._keep(DiagnosticArray, DIAGNOSTICS, QoSProfile(depth=100), self._on_diagnostics)
        if camera is not None:
            self._intrinsics: Any = None
            self._camera_pose: Any = None
            self._keep(PoseStamped, f"{camera}/{images.POSE}", qos.latched(), self._on_camera_pose)
            self._keep(CameraInfo, f"{camera}/{images.INFO}", qos.images(), self._on_info)
            self.node.create_subscription(Image, f"{camera}/{images.COLOR}", self._on_picture, qos.images())

    def spin(self, seconds: float) -> None:
        """Take what comes for so long [s] on the wall."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0:
            self._executor.spin_once(timeout_sec=left)
            self._interrupts.check()

    def close(self) -> None:
        """Leave the graph."""
        self._executor.shutdown()
        self.node.destroy_node()

    def publish_goal(self) -> None:
        """Say where the rope shall be."""
        self._goal_out.publish(planner_messages.goal_to_cloud(self.record.now, self.record.goal))

    def ask(self, kind: Any, service: str, request: Any) -> Any:
        """A service's answer. Raises: InputError if none comes.

        It asks again now and then: for a while a node that was killed looks as if it were still there.
        """
        client = self.node.create_client(kind, service)
        answer: Any = None
        begin = asked = time.monotonic()
        try:
            while time.monotonic() - begin < ANSWER:
                if answer is not None and answer.done():
                    return answer.result()
                if client.service_is_ready() and (answer is None or time.monotonic() - asked > AGAIN):
                    answer, asked = client.call_async(request), time.monotonic()
                self._executor.spin_once(timeout_sec=0.05)
                self._interrupts.check()
            raise InputError(f"{service} does not answer within {ANSWER:g} s")
        finally:
            self.node.destroy_client(client)

    def set_parameter(self, node: str, name: str, value: object) -> None:
        """Set a parameter of a running node. Raises: InputError with its reason."""
        request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
        result = self.ask(SetParameters, f"/{node}/set_parameters", request).results[0]
        if not result.successful:
            raise InputError(f"{node}: {name} was not set", got=result.reason)

    def event(self, text: str) -> None:
        """Note what the run itself does."""
        self.record.events.append((self.record.now, text))

    def _keep(
        self, kind: Any, topic: str, profile: QoSProfile, handler: Callable[[Any], None] | None = None
    ) -> None:
        """Into the bag as it came, then to the handler."""
        package, name = kind.__module__.split(".")[0], kind.__name__

        def take(data: bytes) -> None:
            self._writer.write_raw(topic, f"{package}/msg/{name}", bytes(data), self.record.now)
            if handler is not None:
                handler(deserialize_message(data, kind))

        self.node.create_subscription(kind, topic, take, profile, raw=True)

    def _on_clock(self, message: Clock) -> None:
        self.record.now = message.clock.sec * 10**9 + message.clock.nanosec
        for node, stamp in self._heard.items():
            if self.record.now - stamp > SILENT * NS and self.record.status[node].message != GONE:
                self._say(Said(self.record.now, node, ERROR, GONE))

    def _on_truth(self, message: PointCloud2) -> None:
        frame = read_tracker_points(message, TRUTH)
        self.record.truth.append((frame.stamp, frame.position))
        if self.record.gripper:
            passage = judge_passage(frame.position, self.record.gripper[-1][1], self.record.slot)
            self.record.judged.append((frame.stamp, passage))

    def _on_tracked(self, message: PointCloud2) -> None:
        frame = convert.cloud_to_points(message)
        self.record.tracked.append((frame.stamp, frame.position))

    def _on_state(self, message: PointCloud2) -> None:
        stamp, _, state = convert.cloud_to_state(message, STATE_POINTS)
        self.record.states.append((stamp, state.position.numpy().astype(np.float64)))

    def _on_pose(self, message: PoseArray) -> None:
        pose = convert.message_to_pose(message)
        self.record.gripper.append((pose.stamp, pose.position[0]))

    def _on_plan(self, message: MultiDOFJointTrajectory) -> None:
        places = [p.transforms[0].translation for p in message.points]
        position = np.array([[t.x, t.y, t.z] for t in places])
        self.record.plans.append(PlanSeen(self.record.now, time.monotonic(), stamp_of(message), position))

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            node = status.name.lstrip("/")
            said = Said(self.record.now, node, int.from_bytes(status.level, "little"), status.message)
            self._heard[node] = self.record.now
            before = self.record.status.get(node)
            if before is None or (before.level, before.message) != (said.level, said.message):
                self._say(said)
            values = {v.key: v.value for v in status.values}
            known = self.record.values.get(node, {})
            self.record.values[node] = values
            if node == "planner" and "planning [s]" in values and values["planning [s]"] != known.get("planning [s]"):
                row = (self.record.now, float(values["planning [s]"]), int(values["motions tried"]))
                self.record.planning.append(row)

    def _say(self, said: Said) -> None:
        self.record.status[said.node] = said
        self.record.said.append(said)

    def _on_info(self, message: CameraInfo) -> None:
        self._intrinsics = images.read_camera_info(message, f"{self._camera}/{images.INFO}")[0]
        self.record.taken += 1

    def _on_camera_pose(self, message: PoseStamped) -> None:
        pose = images.read_camera_pose(message, f"{self._camera}/{images.POSE}")
        self._camera_pose = pose

    def _on_picture(self, message: Image) -> None:
        assert self._camera is not None
        stamp = stamp_of(message)
        jpeg = images.compress_color(images.read_color(message, self._camera), JPEG_QUALITY)
        self.record.pictures.append((stamp, jpeg))
        if self.record.view is None and self._intrinsics is not None and self._camera_pose is not None:
            self.record.view = View(self._camera, self._intrinsics, self._camera_pose)
        packed = images.make_compressed(stamp, self._camera, "rgb8; jpeg compressed bgr8", jpeg)
        self._writer.write(f"{self._camera}/{images.COLOR_COMPRESSED}", packed, self.record.now)


