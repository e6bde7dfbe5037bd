"""One run of the loop as processes: start, enable, watch, break what shall break, judge, end."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import rclpy
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import SetBool, Trigger

from pred_core.bag.writer import BagWriter
from pred_core.errors import InputError, PredError
from pred_core.plant.live.slot import SlotConfig
from pred_core.types import Array
from pred_ros import transport
from pred_ros.commands import Interrupts
from pred_ros.processes import Children, free_domain, node_command, node_environment
from pred_ros.reroute_faults import Fault
from pred_ros.reroute_record import NS, Record
from pred_ros.reroute_watch import Watch

BAG = "run.mcap"
START = 300.0  # [s] on the wall until every node has loaded and the first state is there
STALLED = 120.0  # [s] on the wall in which the cell's time must go on
HOLD = 1.0  # [s] of the cell's time that the rope must stay in the slot
STILL = 3.0  # [s] after the last step of a fault that a resting arm is watched, where the task cannot go on
EVERY = 5.0  # [s] on the wall between two lines of progress
SHARED = ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE", "RMW_IMPLEMENTATION")
LOOK = 0.05  # [s] on the wall between two looks at processes and verdict

Show = Callable[[str], None]


@dataclass(frozen=True)
class Job:
    """What to run."""

    nodes: Mapping[str, Mapping[str, object]]  # node -> parameters
    goal: Array  # (Q, 3) [m] world
    out: Path
    limit: float  # [s] of the cell's time after the arm was enabled
    fault: Fault | None = None
    fault_at: float = 3.0  # [s] after the arm was enabled
    camera: str | None = "cam0"  # whose pictures are kept


class Loop:
    """The processes and what can be done to them (`Hands` of a fault)."""

    def __init__(self, job: Job, children: Children, watch: Watch):
        self._job, self._children, self._watch = job, children, watch
        self._record = watch.record
        self._names = {node: node for node in job.nodes}  # living node -> process
        self._starts = dict.fromkeys(job.nodes, 1)

    def start(self) -> None:
        """Start every node, wait for the first state, say the goal, enable planner and arm. Raises: PredError."""
        for node, parameters in self._job.nodes.items():
            self._children.start(node, node_command(node, parameters))
        record = self._record
        self.wait(lambda: bool(record.states) and bool(record.truth), START, "a state of the rope")
        self._watch.publish_goal()
        self.enable("planner")
        self.enable("arm")
        record.begin = record.now

    def enable(self, node: str) -> None:
        """Raises: InputError if it refuses."""
        answer = self._watch.ask(SetBool, f"/{node}/enable", SetBool.Request(data=True))
        if not answer.success:
            raise InputError(f"the {node} cannot be enabled", got=answer.message)

    def disable(self) -> None:
        """Planner and arm come to rest; who does not answer any more is left."""
        for node in ("planner", "arm"):
            if node in self._names:
                self._watch.ask(SetBool, f"/{node}/enable", SetBool.Request(data=False))

    def wait(self, condition: Callable[[], bool], limit: float, what: str) -> None:
        """Take messages until the condition holds. Raises: PredError if a node ends or `limit` [s] pass."""
        end = time.monotonic() + limit
        while not condition():
            self._watch.spin(LOOK)
            self.check()
            if time.monotonic() > end:
                lines = "; ".join(f"{n}: {s.message}" for n, s in self._record.status.items())
                raise PredError(f"not within {limit:g} s: {what}", got=lines or "no node says anything")

    def check(self) -> None:
        """Raises: PredError, with its own last line, if a node ended that nobody killed."""
        for name, process in self._children.running.items():
            if process.poll() is not None:
                line = self._children.last_line(name)
                raise PredError(f"the {name} ended with code {process.returncode}", got=line)

    # What a fault does.

    def break_cameras(self, dead: str, bumped: str) -> None:
        """Exactly these are dead or bumped from now on."""
        self._watch.set_parameter("plant", "dead_cameras", dead)
        self._watch.set_parameter("plant", "bumped_cameras", bumped)

    def call(self, service: str) -> None:
        """Raises: InputError if it is refused."""
        answer = self._watch.ask(Trigger, service, Trigger.Request())
        if not answer.success:
            raise InputError(f"{service} was refused", got=answer.message)

    def kill(self, node: str) -> None:
        """SIGKILL."""
        process = self._children.running.pop(self._names.pop(node))
        process.kill()
        process.wait()

    def restart(self, node: str) -> None:
        """Again, as at first; its output goes to a file of its own."""
        self._starts[node] += 1
        self._names[node] = f"{node}_{self._starts[node]}"
        self._children.start(self._names[node], node_command(node, self._job.nodes[node]))
        if node == "planner":
            self.enable(node)


def run(job: Job, show: Show) -> Record:
    """Run it to the end: success, the time limit, or a fault after which nothing moves. Leaves no process behind.

    Raises: PredError if a node ends by itself or nothing goes on; KeyboardInterrupt passes, the bag is kept then too.
    """
    environment = node_environment(free_domain())
    gap = float(str(job.nodes["plant"].get("gap", SlotConfig.gap)))
    record = Record(SlotConfig(gap=gap), job.goal)
    ended: BaseException | None = None
    # Pictures need shared memory, which is not safe from a killed process that has a part in it.
    pictures = job.camera is not None and (job.fault is None or job.fault.name != "tracker_killed")
    shared = {name: environment[name] for name in SHARED} | transport.variables(pictures, environment)
    with transport.added(shared), BagWriter(job.out / BAG) as writer, Interrupts() as interrupts:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        watch = Watch(record, writer, job.camera, interrupts)
        try:
            with Children(environment, job.out / "log") as children:
                loop = Loop(job, children, watch)
                show("starting the nodes")
                loop.start()
                since = time.monotonic()
                try:
                    _follow(job, loop, watch, show)
                finally:
                    record.wall = time.monotonic() - since
                loop.disable()
        except (KeyboardInterrupt, PredError) as reason:  # the bag is wanted then too
            ended = reason
        finally:
            watch.close()
            rclpy.try_shutdown()
    if ended is not None:
        raise ended
    return record


def _follow(job: Job, loop: Loop, watch: Watch, show: Show) -> None:
    record = watch.record
    waiting = list(job.fault.steps) if job.fault else []
    last = moved = time.monotonic()
    before, told = record.now, record.now
    while record.seconds(record.now) < job.limit:
        watch.spin(LOOK)
        loop.check()
        now = time.monotonic()
        if record.now != before:
            before, moved = record.now, now
        elif now - moved > STALLED:
            raise PredError(f"the cell's time has stood still for {STALLED:g} s")
        while waiting and record.seconds(record.now) >= job.fault_at + waiting[0].after:
            step = waiting.pop(0)
            watch.event(step.text)
            show(f"   {record.seconds(record.now):5.1f} s  FAULT: {step.text}")
            if record.fault is None:
                record.fault, record.values_at_fault = record.now, dict(record.values.get("plant", {}))
            step.do(loop)
        if now - last > EVERY:
            factor = (record.now - told) / NS / (now - last)
            show(progress(record, factor))
            last, told = now, record.now
        if record.success and record.succeeded_for() >= HOLD and not waiting:
            return
        if _given_up(job, record, bool(waiting)):
            return


def _given_up(job: Job, record: Record, waiting: bool) -> bool:
    """After a fault that ends the task: the arm has come to rest and stays there."""
    if job.fault is None or job.fault.reachable or waiting or record.fault is None:
        return False
    rest = record.rests_from(record.fault)
    return rest is not None and record.at_rest() and (record.now - rest) / NS > STILL


def progress(record: Record, factor: float) -> str:
    """One line of where things are."""
    values = record.values.get("planner", {})
    goal = values.get("distance to the goal [mm]", "–")
    said = "  ".join(f"{n}: {record.status[n].message}" for n in ("tracker", "predictor", "arm") if n in record.status)
    return (
        f"   {record.seconds(record.now):5.1f} s (x {factor:.2f})  {len(record.plans)} plans, {goal} mm from the goal"
        f"{', THROUGH' if record.success else ''}  |  {said}"
    )
