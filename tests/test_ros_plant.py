"""The plant node: the topics of real cameras and a real arm, two clocks, faults, and the arm node that drives it."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS is not installed")
pytest.importorskip("mujoco", reason="MuJoCo is not installed")

from geometry_msgs.msg import PoseArray, PoseStamped
from rclpy.parameter import Parameter
from ros_bench import Bench, bench_of
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image, JointState, PointCloud2
from std_msgs.msg import UInt8MultiArray
from std_srvs.srv import SetBool, Trigger
from test_arm_node import arm_world

from pred_core.arm import plant as plant_arm
from pred_core.arm.protocol import SetPoint
from pred_core.bag import images
from pred_core.bag.clouds import read_tracker_points
from pred_core.bag.grippers import PoseFrame, make_gripper_closed, make_gripper_pose
from pred_core.bag.playlist import find_clips
from pred_core.bag.wire import stamp_of
from pred_core.bag.writer import BagWriter
from pred_core.errors import BagError, InputError
from pred_core.plant.live import controller
from pred_core.plant.live.cell import Cell, CellConfig
from pred_core.plant.live.controller import Controller
from pred_core.plant.live.station import TICK, Station
from pred_ros import convert, qos
from pred_ros.diagnostics import ERROR, WARN
from pred_ros.paced_worker import PacedWorker
from pred_ros.plant_node import PlantNode
from pred_ros.player_node import PlayerNode

CAMERA_SAMPLE = Path(__file__).parents[1] / "bags" / "sample_cameras.mcap"

ROOM = {"x_low": 0.2, "x_high": 0.7, "clearance": 0.015, "rate": 50.0}
FAST = {"cameras": "0", "mover": "free"}
SMALL = {"cameras": "2", "width": "160", "height": "120", "camera_rate": "15.0"}


class World:
    """What hears the plant."""

    def __init__(self, bench: Bench):
        self.bench = bench
        self.clock: list[int] = []
        self.poses: list[PoseArray] = []
        self.closed: list[UInt8MultiArray] = []
        self.joints: list[JointState] = []
        self.truth: list[PointCloud2] = []
        self.color: dict[str, list[Image]] = {"cam0": [], "cam1": []}
        self.depth: list[Image] = []
        self.info: list[CameraInfo] = []
        self.camera_poses: list[PoseStamped] = []
        hear = bench.world.create_subscription
        hear(Clock, "/clock", self._on_clock, 100)
        hear(PoseArray, "gripper/pose", self.poses.append, qos.points_complete())
        hear(UInt8MultiArray, "gripper/closed", self.closed.append, qos.latched())
        hear(JointState, "joint_states", self.joints.append, 100)
        hear(PointCloud2, "/plant/truth", self.truth.append, qos.points_complete())
        for name, heard in self.color.items():
            hear(Image, f"{name}/color/image_raw", heard.append, qos.images())
        hear(Image, "cam0/depth/image_raw", self.depth.append, qos.images())
        hear(CameraInfo, "cam0/color/camera_info", self.info.append, qos.images())
        hear(PoseStamped, "cam0/pose", self.camera_poses.append, qos.latched())
        self.command_out = bench.world.create_publisher(PoseArray, "gripper/command", qos.command())
        bench.until(lambda: self.clock, "the clock")

    def _on_clock(self, message: Clock) -> None:
        self.clock.append(message.clock.sec * 10**9 + message.clock.nanosec)

    def ask(self, service: str, kind: Any = Trigger, **request: Any) -> Any:
        client = self.bench.world.create_client(kind, f"/plant/{service}")
        self.bench.until(client.service_is_ready, "the service")
        answer = client.call_async(kind.Request(**request))
        self.bench.until(answer.done, "an answer")
        return answer.result()

    def place(self) -> np.ndarray:
        p = self.poses[-1].poses[0].position
        return np.array([p.x, p.y, p.z])

    def command(self, place: np.ndarray, ahead: float) -> int:
        """A pose to be reached `ahead` [s] from now; returns its stamp."""
        stamp = self.clock[-1] + round(ahead * 1e9)
        q = self.poses[-1].poses[0].orientation
        self.bench.until(lambda: self.command_out.get_subscription_count() == 1, "the plant listens")
        self.command_out.publish(
            convert.pose_to_message(PoseFrame(stamp, place[None], np.array([[q.w, q.x, q.y, q.z]])))
        )
        return stamp


@contextmanager
def plant(**parameters: object) -> Iterator[World]:
    with bench_of(PlantNode, {k: str(v) for k, v in parameters.items()}, feeds=False) as bench:
        yield World(bench)


def lockstep(**more: object) -> Any:
    return plant(clock="step", drive="command", truth="true", **{**SMALL, **more})


def test_lock_step_speaks_the_wire_and_repeats_bit_for_bit() -> None:
    def run() -> tuple[World, bytes, list[int]]:
        with lockstep(seed=2) as world:
            world.bench.until(lambda: world.poses and world.closed and world.color["cam1"], "the first moment")
            first = world.clock[-1]
            time.sleep(0.2)
            world.bench.executor.spin_once(timeout_sec=0.1)
            assert world.clock[-1] == first == 1_000_000_000, "time stands still"
            stamp = world.command(world.place() + [0.0, 0.02, 0.02], 0.2)
            world.bench.until(lambda: world.clock[-1] >= stamp, "time goes on")
            world.bench.until(lambda: stamp_of(world.truth[-1]) == stamp, "the pictures of that time")
            world.bench.until(lambda: stamp_of(world.depth[-1]) == stamp, "depth")
            return world, bytes(world.depth[-1].data) + bytes(world.truth[-1].data), world.clock

    world, bits, clock = run()
    assert np.diff(clock) == pytest.approx(np.full(30, 1e9 / 150), abs=1.0), "0.2 s are 30 ticks"
    assert world.place() is not None and world.closed[-1].data.tolist() == [1]
    assert len(world.joints[-1].name) == 7
    color = images.read_color(world.color["cam0"][-1], "cam0")
    depth = images.read_depth(world.depth[-1], "cam0")
    assert color.shape == (120, 160, 3) and np.nanmedian(depth) == pytest.approx(1.0, abs=0.3)
    assert world.depth[-1].header.frame_id == "cam0_color_optical_frame"
    # The middle of the picture looks at the workplace, 1 m away: half of the pixels there measure it.
    pose, (k, _) = images.read_camera_pose(world.camera_poses[-1], "p"), images.read_camera_info(world.info[-1], "i")
    ray = pose[:3, :3] @ np.linalg.inv(k) @ [79.5, 59.5, 1.0]
    assert pose[:3, 3] + ray == pytest.approx([0.45, 0.0, 0.03], abs=1e-6)
    rope = read_tracker_points(world.truth[-1], "t").position
    assert np.linalg.norm(rope[0] - world.place()) < 0.002
    assert bits == run()[1], "the same seed, the same pictures and the same rope"


def test_lock_step_refuses_what_it_cannot_do_and_steps_on_request() -> None:
    with plant(clock="step", drive="command", **FAST) as world:
        world.bench.until(lambda: world.poses, "a pose")
        before = world.clock[-1]
        world.command(world.place(), -0.1)
        world.bench.until(lambda: world.bench.says(WARN, "its stamp says when"), "a refusal")
        world.command(world.place() + [1.0, 0.0, 0.0], 0.1)
        world.bench.until(lambda: world.bench.says(WARN, "too far for its time"), "another")
        assert world.clock[-1] == before
        answer = world.ask("step")
        assert answer.success
        world.bench.until(lambda: world.clock[-1] == before + 33_333_333 or world.clock[-1] == before + 33_333_334, "")


def test_a_bad_command_is_named_and_the_plant_goes_on() -> None:
    with plant(drive="command", **FAST) as world:
        world.bench.until(lambda: world.poses, "a pose")
        world.bench.until(lambda: world.command_out.get_subscription_count() == 1, "the plant listens")
        message = convert.pose_to_message(PoseFrame(world.clock[-1], world.place()[None], np.array([[0.0, 1, 0, 0]])))
        message.header.frame_id = "camera"
        world.command_out.publish(message)
        world.bench.until(lambda: world.bench.says(WARN, "gripper/command", "'camera'", "'world'"), "the frame")
        message.header.frame_id = "world"
        message.poses = [*message.poses, *message.poses]
        world.command_out.publish(message)
        world.bench.until(lambda: world.bench.says(WARN, "one gripper an arm", "2 poses"), "the number")
        message = convert.pose_to_message(PoseFrame(1, world.place()[None], np.array([[0.0, 1, 0, 0]])))
        world.command_out.publish(message)
        world.bench.until(lambda: world.bench.says(WARN, "stamp", "old", "use_sim_time"), "a stamp of another clock")
        here = world.place()

        def far() -> bool:  # the stamp must be of now, however busy the machine is
            world.command(1000.0 * here, 0.0)
            world.bench.executor.spin_once(timeout_sec=0.02)
            return bool(world.bench.says(WARN, "far from the gripper", "in metres"))

        world.bench.until(far, "millimetres")
        assert np.linalg.norm(world.place() - here) < 1e-3, "it has moved on a bad command"
        world.command(np.array([np.nan, 0.0, 0.1]), 0.0)
        world.bench.until(lambda: world.bench.says(WARN, "finite"), "NaN")
        now = world.clock[-1]
        world.bench.until(lambda: world.clock[-1] > now + 100_000_000, "time goes on")


def test_free_time_runs_and_publishes_its_factor() -> None:
    with plant(drive="command", factor="0.5", **FAST) as world:
        world.bench.until(lambda: len(world.clock) > 150, "two seconds")
        begin, wall = world.clock[-1], time.monotonic()
        goal = world.place() + [0.0, 0.0, 0.05]

        def there() -> bool:
            world.command(goal, 0.0)
            world.bench.executor.spin_once(timeout_sec=0.02)
            return bool(np.linalg.norm(world.place() - goal) < 0.003)

        world.bench.until(there, "it goes where it is told")
        world.bench.until(lambda: time.monotonic() - wall > 1.0, "a second")
        assert (world.clock[-1] - begin) * 1e-9 < 0.6 * (time.monotonic() - wall), "half of real time, not more"
        world.bench.node.heartbeat()
        factor = float(world.bench.node.diagnostics._values["real-time factor"])
        assert 0.05 < factor < 0.56


def test_faults_by_parameter_and_service() -> None:
    with lockstep(mover="free", step=0.2) as world:
        world.bench.until(lambda: world.color["cam0"] and world.color["cam1"], "both cameras")
        refused = world.bench.node.set_parameters([Parameter("dead_cameras", value="cam5")])[0]
        assert not refused.successful and "unknown camera 'cam5'" in refused.reason
        assert world.bench.node.set_parameters([Parameter("dead_cameras", value="cam1")])[0].successful
        seen = len(world.color["cam1"])
        assert world.ask("step").success
        world.bench.until(lambda: len(world.color["cam0"]) >= 3, "the other one lives")
        assert len(world.color["cam1"]) == seen
        same = world.bench.node.set_parameters([Parameter("gap", value=0.05)])[0]
        assert not same.successful and "while the plant is active" in same.reason
        assert world.ask("slip").success
        assert "nothing in them" in world.ask("jaws", SetBool, data=False).message
        before = world.clock[-1]
        assert world.ask("reset").success
        world.bench.until(lambda: world.clock[-1] > before, "time goes on over a reset")
        assert "the rope in them" in world.ask("jaws", SetBool, data=True).message


def test_an_arm_drives_it_through_the_port_and_stops_when_it_is_silent() -> None:
    with plant(port="0", **FAST) as world:
        world.bench.until(lambda: len(world.clock) > 10, "it runs")
        assert not world.poses, "gripper/pose is the arm node's then"
        port = int(world.bench.node.diagnostics._values["port"])
        arm = plant_arm.connect_plant(port=port)
        start = arm.read()
        assert start.ready and start.closed and start.message == "idle"
        setpoint = SetPoint(start.position + [0.0, 0.0, 0.03], start.rotation, np.zeros(3), np.zeros(3))
        with pytest.raises(InputError, match="before the arm was enabled"):
            arm.command(setpoint)
        arm.begin()

        def there() -> bool:
            arm.command(setpoint)
            return bool(arm.read().position[2] > start.position[2] + 0.028)

        world.bench.until(there, "it follows")
        far = SetPoint(start.position + [0.0, 0.0, 0.3], start.rotation, np.zeros(3), np.zeros(3))
        arm.command(far)
        begin = world.clock[-1]
        world.bench.until(lambda: world.clock[-1] - begin > 5e8, "half a second of silence")
        height = arm.read().position[2]
        # 0.1 s at 1 m/s, the controller's own limit, and some stopping
        assert height < start.position[2] + 0.03 + 0.15
        begin = world.clock[-1]
        world.bench.until(lambda: world.clock[-1] - begin > 2e8, "more silence")
        assert arm.read().position[2] == pytest.approx(height, abs=1e-3), "at rest"
        arm.stop()
        arm.close()
        with socket.create_connection(("127.0.0.1", port)) as raw:
            for line in (b"nonsense\n", b"[1]\n", b'{"do": "fly"}\n', b'{"do": "command"}\n'):
                raw.sendall(line)
                assert json.loads(raw.recv(4096))["ok"] is False
    assert plant_arm.PORT == controller.PORT


def test_the_arm_node_follows_commands_with_it_and_stops_at_its_fault() -> None:
    """The guard's set-points at 50 Hz, on two free clocks, move the stand-in arm where it is told."""
    station = Station(Cell(CellConfig(), cameras=()), pictures=False)
    moment = station.reset(1)
    served = Controller(station.servo, lambda: station.moment.truth, lambda: station.cell.time, 0)

    def tick() -> None:
        station.tick()

    worker = PacedWorker(tick, TICK, lambda: 1.0, lambda _: None, lambda: None)
    home = moment.truth.gripper.position
    try:
        with arm_world(arm="plant", port=served.port, source="command", **ROOM) as world:
            world.bench.until(lambda: world.joints and len(world.joints[-1].name) == 7, "joint angles")
            assert world.place() == pytest.approx(home, abs=2e-3)
            assert world.enable().success
            goal = home + [0.0, 0.02, 0.06]
            q = moment.truth.gripper.rotation

            def there() -> bool:
                pose = PoseFrame(world.now(), goal[None], q[None])
                world.command_out.publish(convert.pose_to_message(pose))
                world.bench.executor.spin_once(timeout_sec=0.02)
                return bool(np.linalg.norm(world.place() - goal) < 2e-3)

            world.bench.until(there, "the arm is where it was told to be")
            station.servo.fail("somebody pressed the red button")
            world.bench.until(lambda: world.bench.says(ERROR, "red button"), "the fault is latched")
            assert not world.enable().success
    finally:
        worker.end()
        served.close()


def test_nobody_at_the_port_is_said() -> None:
    with pytest.raises(InputError, match="nobody at 127.0.0.1:9.*Start the plant node"):
        plant_arm.connect_plant(port=9, patience=0.2)


@pytest.mark.parametrize("answer", [b"SSH-2.0-OpenSSH\r\n", b"[1]\n", b"{}\n", b"\xff\xfe\n"])
def test_somebody_else_at_the_port_is_said(answer: bytes) -> None:
    ours, theirs = socket.socketpair()
    arm = plant_arm.PlantArm(ours)
    theirs.sendall(answer)
    with pytest.raises(InputError, match="not the plant's protocol"):
        arm.read()
    theirs.close()
    arm.close()


def test_the_sample_bag_plays_as_live_cameras() -> None:
    color: list[Image] = []
    depth: list[Image] = []
    poses: dict[str, list[PoseStamped]] = {f"cam{k}": [] for k in range(4)}
    with bench_of(PlayerNode, {"bag": str(CAMERA_SAMPLE), "factor": "1.0", "wait_for": "1"}, feeds=False) as bench:
        hear = bench.world.create_subscription
        hear(Image, "cam2/color/image_raw", color.append, qos.images())
        hear(Image, "cam2/depth/image_raw", depth.append, qos.images())
        hear(Image, "cam0/color/image_raw", lambda _: None, qos.images())
        hear(PoseArray, "gripper/pose", lambda _: None, qos.points_complete())
        for name, heard in poses.items():
            hear(PoseStamped, f"{name}/pose", heard.append, qos.latched())
        bench.until(lambda: bench.node.exit_code == 0, "the end of the bag")
        bench.until(lambda: len(color) == 25 and len(depth) == 25, "1.6 s at 15 Hz are 25 pictures")
    assert all(poses.values())
    picture, metres = images.read_color(color[-1], "c"), images.read_depth(depth[-1], "d")
    assert picture.shape == (240, 320, 3) and color[-1].encoding == "rgb8" and depth[-1].encoding == "16UC1"
    assert np.nanmedian(metres) == pytest.approx(0.7, abs=0.2), "the cameras stand 0.7 m away"
    # The rope is orange, (0.85, 0.36, 0.08): red at least 1.6 times green, hundreds of pixels.
    red, green = picture[..., 0].astype(int), picture[..., 1].astype(int)
    assert np.count_nonzero((red > 90) & (red > 1.6 * green)) > 300


def test_a_bag_without_anything_to_play_is_refused(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "poses.mcap") as writer:
        for k in range(3):
            stamp = (k + 1) * 10**9
            writer.write("gripper/pose", make_gripper_pose(stamp, np.zeros((1, 3)), np.array([[1.0, 0, 0, 0]])), stamp)
            writer.write("gripper/closed", make_gripper_closed(np.array([True])), stamp)
    with pytest.raises(BagError, match="no topic 'tracker/points'"):
        find_clips(tmp_path / "poses.mcap")
    with pytest.raises(BagError, match="no pictures of cameras"):
        find_clips(tmp_path / "poses.mcap", points=False)
