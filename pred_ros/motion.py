"""`pred_motion next_motion.yaml`: has the arm node execute the motion that `pred diagnose` proposed.

The arm node must run with `source: plan`, be enabled, and allow the motion's speed, acceleration and length. The object
is in the jaws. The arm goes straight and slowly to where the motion begins, rests there as long as the file says,
and moves. What the arm refuses, or a fault on the way, ends this with the arm's own line. Whatever ends it, Ctrl-C too,
while the arm moves stops the arm.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray, Quaternion, Transform, Vector3
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import Trigger
from trajectory_msgs.msg import MultiDOFJointTrajectory, MultiDOFJointTrajectoryPoint

from pred_core.arm.approach import TimedPoses, with_approach
from pred_core.arm.follower import MOST_POINTS
from pred_core.arm.limits import MOST_LIFETIME
from pred_core.arm.plan_file import read_motion
from pred_core.bag.grippers import PoseFrame
from pred_core.bag.wire import GRIPPER_POSE
from pred_core.errors import ConfigError, InputError
from pred_ros import convert, dead_ports, qos, transport
from pred_ros.arm_messages import PLAN
from pred_ros.commands import Interrupts, run_command
from pred_ros.diagnostics import ERROR, OK, WARN

PATIENCE = 25.0  # [s] for the arm node to be there; after one of us was killed it can take 20 s until it is found
AHEAD = 0.3  # [s] between sending and the beginning
ANSWER = 1.0  # [s] for the arm's stop, and after the end for what it has to say of it
SILENT = 5.0  # [s] in which the arm, which says how many plans it took once a second, must have taken this one
ARRIVED = 0.02  # [m] from the last pose
REFUSED = " refused"  # how the arm's counters of what it refused end
ACCEPTED = "count: plans"  # the arm's counter of plans that it follows
SHOWN = 1.0  # [s] between two lines of progress


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point. Returns 0 done, 2 bad input, a refusal or a fault, 130 interrupted."""
    parser = argparse.ArgumentParser(prog="pred_motion", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("file", type=Path, help="next_motion.yaml of pred diagnose")
    parser.add_argument("--gripper", type=int, default=0, help="whose motion in the file (default: 0)")
    parser.add_argument("--approach", type=float, default=0.05, metavar="M/S", help="speed to its beginning (0.05)")
    args = parser.parse_args(argv)
    return run_command("pred_motion", lambda: go(args))


def go(args: argparse.Namespace) -> int:
    """Read, send, follow to the end. Raises: PredError."""
    if not 0.001 <= args.approach <= 0.5:
        raise ConfigError("--approach", got=args.approach, allowed="0.001 to 0.5 m/s")
    _, motion, rest = read_motion(args.file, args.gripper)
    with Interrupts() as interrupts, transport.added(transport.variables(pictures=False)):
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        with dead_ports.avoided():
            sender = Sender(interrupts)
        try:
            sender.execute(motion, args.approach, rest)
        finally:
            sender.close()
            rclpy.try_shutdown()
    return 0


class RefusedError(InputError):
    """The arm does not follow the plan."""


class Sender:
    """Sends one plan to the arm node and watches it."""

    def __init__(self, interrupts: Interrupts) -> None:
        self._interrupts = interrupts
        self._node = Node("motion")
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._pose: PoseFrame | None = None
        self._said: tuple[bytes, str] | None = None
        self._refusals = self._accepted = 0  # of plans and commands, and of plans, as the arm counts them
        self._node.create_subscription(PoseArray, GRIPPER_POSE, self._on_pose, qos.poses_live())
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        self._stop = self._node.create_client(Trigger, "/arm/stop")
        self._out = self._node.create_publisher(MultiDOFJointTrajectory, PLAN, qos.plans())

    def close(self) -> None:
        """Let go of the node."""
        self._executor.shutdown()
        self._node.destroy_node()

    def execute(self, motion: TimedPoses, speed: float, rest: float) -> None:
        """To the beginning with `speed` [m/s], `rest` [s], the motion. Raises: InputError with what went wrong."""
        heard = {
            GRIPPER_POSE: lambda: self._pose is not None,
            "the arm's /diagnostics": lambda: self._said is not None,  # what it has refused before is not about this
            f"a reader of {PLAN}": lambda: self._out.get_subscription_count() > 0,
        }
        if not self._until(lambda: all(there() for there in heard.values()), PATIENCE):
            raise InputError(
                "no arm node",
                got="no " + ", no ".join(name for name, there in heard.items() if not there()),
                next_step="Start one: arm --ros-args -p arm:=..., then call /arm/enable",
            )
        pose = self._pose
        assert pose is not None
        w, x, y, z = (float(v) for v in pose.rotation[0])
        whole = with_approach(motion, pose.position[0], (w, x, y, z), speed, rest)
        seconds = float(whole.times[-1])
        if seconds > MOST_LIFETIME or len(whole.times) > MOST_POINTS:
            raise InputError(
                "the motion, with the way to its beginning, is too long for one plan",
                got=f"{seconds:.0f} s, {len(whole.times):,} points",
                allowed=f"{MOST_LIFETIME:g} s, {MOST_POINTS:,} points",
                next_step="Bring the arm near to its beginning, or split it",
            )
        print(f"{seconds:.1f} s, {seconds - float(motion.times[-1] - motion.times[0]):.1f} s of it to the beginning")
        begin = self._now() + round(AHEAD * 1e9)
        self._said = None
        self._out.publish(_message(begin, whole))
        try:
            self._follow(begin, seconds)
        except RefusedError:
            raise
        except BaseException:  # the arm would go on to the end of the plan
            stopped = self._stop.call_async(Trigger.Request())
            self._until(stopped.done, ANSWER)
            raise
        off = float(np.linalg.norm(self._place() - whole.position[-1]))
        if off > ARRIVED:
            line = "the arm is not where the motion ends"
            raise InputError(line, got=f"{1e3 * off:.0f} mm off", next_step=self._last())
        print("done")

    def _follow(self, begin: int, seconds: float) -> None:
        """Until the end. Raises: RefusedError; InputError for an error. A warning, which may be of before, is shown."""
        end, shown, warned = begin + round((seconds + ANSWER) * 1e9), 0.0, ""
        refusals, accepted, taken = self._refusals, self._accepted, False
        while self._now() < end:
            self._spin()
            level, line = self._said or (OK, "")
            taken = taken or self._accepted > accepted
            if not taken and self._refusals > refusals:  # those that come later are of others
                raise RefusedError(f"arm: {line}")
            if not taken and self._now() > begin + round(SILENT * 1e9):
                raise InputError("the arm has not said that it takes the motion", got=line or "nothing")
            if level == ERROR:
                raise InputError(f"arm: {line}")
            if level == WARN and line != warned:
                warned = line
                print(f"arm: {line}", flush=True)
            gone = (self._now() - begin) * 1e-9
            if gone - shown >= SHOWN:
                shown = gone
                print(f"{min(gone, seconds):.0f} of {seconds:.0f} s", flush=True)

    def _until(self, true: Callable[[], bool], limit: float) -> bool:
        end = time.monotonic() + limit
        while time.monotonic() < end:
            if true():
                return True
            self._spin()
        return False

    def _spin(self) -> None:
        self._executor.spin_once(timeout_sec=0.05)
        self._interrupts.check()

    def _now(self) -> int:
        return int(self._node.get_clock().now().nanoseconds)

    def _place(self) -> np.ndarray:
        assert self._pose is not None
        return self._pose.position[0]

    def _last(self) -> str:
        return "" if self._said is None else f"The arm says: {self._said[1]}"

    def _on_pose(self, message: PoseArray) -> None:
        self._pose = convert.message_to_pose(message)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.rsplit("/", 1)[-1] == "arm":
                self._said = (status.level, status.message)
                counts = {v.key: int(v.value) for v in status.values if v.value.isdigit()}
                refused = sum(number for what, number in counts.items() if what.endswith(REFUSED))
                self._refusals = max(self._refusals, refused)
                self._accepted = max(self._accepted, counts.get(ACCEPTED, 0))


def _message(stamp: int, poses: TimedPoses) -> MultiDOFJointTrajectory:
    points = []
    for t, (x, y, z), (w, i, j, k) in zip(
        poses.times.tolist(), poses.position.tolist(), poses.rotation.tolist(), strict=True
    ):
        pose = Transform(translation=Vector3(x=x, y=y, z=z), rotation=Quaternion(w=w, x=i, y=j, z=k))
        point = MultiDOFJointTrajectoryPoint(transforms=[pose])
        point.time_from_start.sec, point.time_from_start.nanosec = divmod(round(t * 1e9), 10**9)
        points.append(point)
    return MultiDOFJointTrajectory(header=convert.header_at(stamp), joint_names=["gripper0"], points=points)


if __name__ == "__main__":
    raise SystemExit(main())
