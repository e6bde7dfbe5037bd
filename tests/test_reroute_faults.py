"""Every fault of the loop: what it does to the cell and when, which node must name it, and when the run counts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS is not installed")
pytest.importorskip("mujoco", reason="MuJoCo is not installed")

import rclpy
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from ros_bench import own_domain
from rosgraph_msgs.msg import Clock

from pred_core.bag.writer import BagWriter
from pred_core.plant.live.slot import SlotConfig
from pred_core.plant.live.success import Passage
from pred_ros import reroute
from pred_ros.commands import Interrupts
from pred_ros.reroute_faults import FAULTS, GONE
from pred_ros.reroute_record import PlanSeen, Record, Said
from pred_ros.reroute_verdict import Verdict, judge
from pred_ros.reroute_watch import Watch

S = 1_000_000_000  # [ns]
BEGIN = 3 * S  # of the fault
WARN, SPEED = 1, 0.25

# What each does, by time [s]; and one line that a node said in a real run with it.
SCRIPT: dict[str, tuple[list[tuple[object, ...]], tuple[str, str]]] = {
    "one_camera": ([(0.0, "dead", "cam0", "")], ("tracker", "tracking without cam0: no pictures")),
    "two_cameras": ([(0.0, "dead", "cam0,cam2", "")], ("tracker", "tracking without cam0, cam2: no pictures")),
    "silence": (
        [(0.0, "dead", "cam0,cam1,cam2,cam3", ""), (0.3, "dead", "", "")],
        ("tracker", "no pictures of any camera for 0.40 s; tracking again"),
    ),
    "tracker_killed": (
        [(0.0, "kill", "tracker"), (3.0, "restart", "tracker")],
        ("predictor", "no tracks for 1.0 s, model alone; after 2 s no state is given"),
    ),
    "predictor_killed": (
        [(0.0, "kill", "predictor"), (4.0, "restart", "predictor")],
        ("planner", "state/points stopped 0.6 s ago: no planning"),
    ),
    "planner_killed": (
        [(0.0, "kill", "planner"), (4.0, "restart", "planner")],
        ("planner", "says nothing any more: it has ended, or hangs"),
    ),
    "bumped_camera": (
        [(0.0, "dead", "", "cam1")],
        ("tracker", "cam1 sees the object 10 mm off: has it been moved? Calibrate it anew"),
    ),
    "slip": ([(0.0, "call", "/plant/slip")], ("tracker", "tracking; the object has slipped out of the gripper")),
}


class Diary:
    """Hands that write down what they are told to do."""

    def __init__(self) -> None:
        self.done: list[tuple[object, ...]] = []

    def break_cameras(self, dead: str, bumped: str) -> None:
        """Written down."""
        self.done.append(("dead", dead, bumped))

    def call(self, service: str) -> None:
        """Written down."""
        self.done.append(("call", service))

    def kill(self, node: str) -> None:
        """Written down."""
        self.done.append(("kill", node))

    def restart(self, node: str) -> None:
        """Written down."""
        self.done.append(("restart", node))


def judged(name: str, through: bool, *said: Said, hits: int = 0) -> Verdict:
    """A gripper that moves with 0.1 m/s for two seconds after the fault, then rests; plans up to its begin."""
    record = Record(SlotConfig(), np.zeros((1, 3)))
    times = np.arange(0.0, 12.0, 0.02)
    record.gripper = [(round(t * S), np.array([0.1 * min(t, 5.0), 0.0, 0.1])) for t in times.tolist()]
    record.now, record.fault = record.gripper[-1][0], BEGIN
    record.values["plant"] = {"collisions: gripper on slot": str(hits)}
    record.judged = [(record.now, Passage(through, 1, 0.3, 0.1, True))]
    record.plans = [PlanSeen(k * S, 0.0, k * S, np.zeros((2, 3))) for k in (1, 2)]
    record.said = list(said)
    return judge(record, 100.0, SPEED, FAULTS[name])


def test_every_fault_is_in_the_script() -> None:
    assert set(SCRIPT) == set(FAULTS)


@pytest.mark.parametrize("name", sorted(SCRIPT))
def test_what_a_fault_does_and_when(name: str) -> None:
    hands, times = Diary(), []
    for step in FAULTS[name].steps:
        step.do(hands)
        times.append(step.after)
    assert [(t, *done) for t, done in zip(times, hands.done, strict=True)] == SCRIPT[name][0]


@pytest.mark.parametrize("name", sorted(SCRIPT))
def test_a_fault_counts_if_it_was_named_the_arm_was_safe_and_the_task_done_where_it_can_be(name: str) -> None:
    fault, (node, line) = FAULTS[name], SCRIPT[name][1]
    told = Said(BEGIN + S // 2, node, WARN, line)
    good = judged(name, fault.reachable, told)
    assert good.fault is not None and good.fault.named == f"{node}: {line}" and good.fault.named_after == 0.5
    assert good.fault.stopped_after == pytest.approx(2.0, abs=0.05) and good.fault.plans_after == 0
    assert reroute.passed(good, fault)
    unsaid = judged(name, True, Said(BEGIN - S, node, WARN, line), Said(BEGIN + S, "evaluator", WARN, line))
    assert unsaid.fault is not None and unsaid.fault.named == "" and unsaid.fault.named_after is None
    assert not reroute.passed(unsaid, fault), "said before, or by a node that has nothing to do with it"
    assert not reroute.passed(judged(name, True, told, hits=1), fault), "the gripper has hit the slot"
    assert reroute.passed(judged(name, False, told), fault) is not fault.reachable


def test_a_node_without_diagnostics_is_said_to_be_gone_until_it_is_back(tmp_path: Path) -> None:
    """Two nodes report once a second of the cell's time; the planner from 3 s to 8 s does not."""
    record = Record(SlotConfig(), np.zeros((1, 3)))
    with own_domain(), BagWriter(tmp_path / "run.mcap") as writer:
        rclpy.init()
        watch = Watch(record, writer, None, Interrupts())
        try:
            for tenth in range(101):
                stamp = Time(sec=tenth // 10, nanosec=tenth % 10 * 10**8)
                watch._on_clock(Clock(clock=stamp))
                names = ["arm"] if 30 <= tenth < 80 else ["arm", "planner"]
                status = [DiagnosticStatus(name=n, level=DiagnosticStatus.OK, message="fine") for n in names]
                if tenth % 10 == 0:
                    watch._on_diagnostics(DiagnosticArray(status=status))
        finally:
            watch.close()
            rclpy.try_shutdown()
    said = [(s.node, round(s.stamp / S, 1), s.message) for s in record.said]
    # Heard last at 2 s: gone once more than 2.5 s have passed.
    assert said == [("arm", 0.0, "fine"), ("planner", 0.0, "fine"), ("planner", 4.6, GONE), ("planner", 8.0, "fine")]
    assert record.said[2].level == 2 and ("planner", GONE) in FAULTS["planner_killed"].named_by


def test_what_is_said_long_after_the_last_step_does_not_name_a_fault() -> None:
    node, line = SCRIPT["silence"][1]
    late = judged("silence", True, Said(BEGIN + round(10.4 * S), node, WARN, line))
    in_time = judged("silence", True, Said(BEGIN + round(10.2 * S), node, WARN, line))
    assert late.fault is not None and in_time.fault is not None
    assert (late.fault.named, in_time.fault.named_after) == ("", pytest.approx(10.2)), "10 s after the cameras are back"
