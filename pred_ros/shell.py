"""What every node shares: parameters, lifecycle with autostart, diagnostics, signals, exit code.

A node is a subclass of `Shell` with three methods (`setup`, `start`, `stop`); its `main` is `run(TheNode)`. What they
make is destroyed by the shell at cleanup and shutdown.
"""

from __future__ import annotations

import math
import os
import re
import signal
import sys
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any, ClassVar, NoReturn, Protocol, cast

import rclpy
import rclpy.utilities
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import InvalidParameterTypeException, ParameterUninitializedException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.service import Service
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from rclpy.timer import Timer

from pred_core.errors import ConfigError, PredError
from pred_ros import dead_ports, parameters, transport
from pred_ros.diagnostics import ERROR, OK, WARN, Diagnostics
from pred_ros.processes import END_WITH_PARENT
from pred_ros.surroundings import Surroundings

BAD_INPUT = 2
POLL = 0.05  # [s] how soon a signal or the end of the work is noticed
REFUSAL_SHOWN = 2.0  # [s] how long a refused message stays the headline of the diagnostics
REFUSED = "refused message"
AGAIN = 5.0  # [s] after which a line that differs from an earlier one in its numbers only is said at once again
NUMBERS = re.compile(r"[-+]?\d[\d.]*(e[-+]?\d+)?")
HOW = "Give parameters as: {} --ros-args -p NAME:=VALUE, or --params-file FILE"


class NodeConfig(Protocol):
    """What the shell reads from a node's configuration."""

    @property
    def autostart(self) -> bool:
        """Configure and activate without waiting for a lifecycle manager."""


@dataclass(frozen=True)
class Made:
    """What a node has made so far."""

    publishers: set[Publisher]
    services: set[Service]
    subscriptions: set[Subscription]
    timers: set[Timer]


class Shell(LifecycleNode):
    """A lifecycle node with typed configuration. `exit_code` set to a number ends the process."""

    NAME: ClassVar[str]
    CONFIG: ClassVar[type]
    PICTURES: ClassVar[bool] = False  # it sends or takes pictures

    def __init__(self) -> None:
        super().__init__(self.NAME, automatically_declare_parameters_from_overrides=True)
        found = cast(dict[str, Parameter], self.get_parameters_by_prefix(""))
        given = {k: p.value for k, p in found.items() if not parameters.is_library_name(k)}
        for name in given:
            self.undeclare_parameter(name)
        self.config: Any = parameters.declare(self, self.CONFIG, given)
        parameters.follow(self, lambda: self.config, self._accept)
        self.exit_code: int | None = None
        self.bug: BaseException | None = None
        self.asked: list[int] = []  # the signals that asked the process to end
        self._refusal = ""
        self._told: dict[str, float] = {}  # a line without its numbers -> [s] when it was said at once
        self._shown: bytes = OK  # the level published last
        self.diagnostics = Diagnostics(self.get_fully_qualified_name(), self.seconds)
        self._diagnostics_out = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._timer = self.create_timer(1.0, self._heartbeat)
        self._surroundings = Surroundings(self)
        self._lookout = self.create_timer(1.0, self._look_around, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._own = self._made()  # outlives a cleanup

    def setup(self) -> None:
        """Build the core object and the publishers. May raise PredError."""
        raise NotImplementedError

    def start(self) -> None:
        """Subscribe and begin. May raise PredError."""
        raise NotImplementedError

    def stop(self) -> None:
        """End what `start` began; join threads. Called once, also after errors."""
        raise NotImplementedError

    def destroy_node(self) -> None:
        """Destroy the node and its lifecycle state machine: while that holds it, its shared memory stays."""
        super().destroy_node()
        self._state_machine.destroy_when_not_in_use()

    def heartbeat(self) -> None:
        """Called once a second before diagnostics go out."""

    def changed(self, config: Any) -> None:
        """A new configuration is about to hold. Raise PredError to refuse it."""

    def report(self, level: bytes, message: str) -> None:
        """Set the diagnostic status; a change is logged and published at once, but of lines that differ in their
        numbers only one in `AGAIN`: the others come with the next heartbeat.
        """
        if not self.diagnostics.status(level, message):
            return
        line, now = NUMBERS.sub("#", message), time.monotonic()
        news = now - self._told.get(line, -math.inf) >= AGAIN
        if news:
            self._told = {k: t for k, t in self._told.items() if now - t < AGAIN} | {line: now}
            self._log(level, message)
        if news or level != self._shown:
            self.publish_diagnostics()

    def _log(self, level: bytes, message: str) -> None:
        # The client library wants each severity at a place of its own.
        if level == OK:
            self.get_logger().info(message)
        elif level == WARN:
            self.get_logger().warning(message)
        else:
            self.get_logger().error(message)

    def publish_diagnostics(self) -> None:
        """Publish the diagnostic status now."""
        self._shown = self.diagnostics.level
        self._diagnostics_out.publish(self.diagnostics.message_at(self.get_clock().now().to_msg()))

    def seconds(self) -> float:
        """[s] For ages and deadlines: simulated time where there is one, it may be slower than the wall's."""
        clock: Any = self.get_clock()
        return clock.now().nanoseconds * 1e-9 if clock.ros_time_is_active else time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Sleep within `setup` or `start`. Raises: KeyboardInterrupt once a signal has asked the process to end."""
        time.sleep(seconds)
        if self.asked:
            raise KeyboardInterrupt

    def take(self, topic: str, action: Callable[..., None], *values: Any) -> None:
        """Count a message of a topic and act on it; what cannot be used is refused, and the node goes on."""
        self.diagnostics.seen(topic)
        self.diagnostics.count(f"messages on {topic}")
        try:
            action(*values)
        except PredError as error:
            self.refuse(error)

    def refuse(self, error: PredError) -> None:
        """Say that a message was refused."""
        self._refusal = f"refused: {error}"
        self.diagnostics.seen(REFUSED)
        self.diagnostics.count("refused messages")
        self.report(ERROR, self._refusal)

    @property
    def refusal(self) -> str:
        """The newest refusal while it is the headline of the diagnostics, else ''."""
        age = self.diagnostics.age(REFUSED)
        return self._refusal if age is not None and age < REFUSAL_SHOWN else ""

    def check_worker(self, worker: Future[None] | None) -> None:
        """End the process if its worker thread has ended: with one line on bad input, with its trace on a bug."""
        if worker is None or not worker.done():
            return
        try:
            worker.result()
        except PredError as error:
            self.fail(error)

    def fail(self, error: PredError) -> None:
        """End the process with one clear line, which the diagnostics have too; the logger would print it again."""
        if self.diagnostics.status(ERROR, str(error)):
            self.publish_diagnostics()
        print(f"{self.NAME}: {error}", file=sys.stderr, flush=True)
        self.exit_code = BAD_INPUT

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Lifecycle: build."""
        return self._attempt(self.setup)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Lifecycle: run."""
        return self._attempt(self.start)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Lifecycle: pause."""
        return self._attempt(self.stop)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Lifecycle: back to what it was before `setup`."""
        return self._attempt(self._release)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Lifecycle: end the work, from whatever state; the process ends by a signal."""
        return self._attempt(self._release)

    def _release(self) -> None:
        """Stop, then destroy what `setup` and `start` made."""
        self.stop()
        made = self._made()
        for publisher in made.publishers - self._own.publishers:
            self.destroy_publisher(publisher)
        for service in made.services - self._own.services:
            self.destroy_service(service)
        for subscription in made.subscriptions - self._own.subscriptions:
            self.destroy_subscription(subscription)
        for timer in made.timers - self._own.timers:
            self.destroy_timer(timer)

    def _made(self) -> Made:
        return Made(set(self.publishers), set(self.services), set(self.subscriptions), set(self.timers))

    def _attempt(self, action: Any) -> TransitionCallbackReturn:
        try:
            action()
        except PredError as error:
            self.fail(error)
            return TransitionCallbackReturn.FAILURE
        except BaseException as bug:  # the client library would swallow it; `run` raises it again
            self.bug = bug
            raise
        return TransitionCallbackReturn.SUCCESS

    def _accept(self, config: Any) -> None:
        self.changed(config)
        self.config = config

    def _heartbeat(self) -> None:
        self.heartbeat()
        self.publish_diagnostics()

    def _look_around(self) -> None:
        """On the wall's time: simulated time may stand still."""
        trouble = self._surroundings.trouble()
        if self.diagnostics.beside(trouble):
            if trouble:
                self._log(WARN, trouble)
            self.publish_diagnostics()


def run(node_class: type[Shell], args: list[str] | None = None) -> int:
    """Run one node until it is done, fails, or receives SIGINT or SIGTERM. Returns the exit code.

    0: done or asked to stop. 2: bad input, one line on stderr.
    """
    asked: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda received, _: asked.append(received))
    node: Shell | None = None
    try:
        with transport.added(transport.variables(node_class.PICTURES)), dead_ports.avoided():
            _begin(node_class.NAME, args)
            node = node_class()
            node.asked = asked
        return _spin(node)
    except PredError as error:
        print(f"{node_class.NAME}: {error}", file=sys.stderr, flush=True)
        return BAD_INPUT
    except (InvalidParameterTypeException, ParameterUninitializedException) as error:
        print(f"{node_class.NAME}: {error}", file=sys.stderr, flush=True)
        return BAD_INPUT
    except (KeyboardInterrupt, ExternalShutdownException):
        return 0
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()


def _begin(name: str, args: list[str] | None) -> None:
    """Start the client library. Raises: ConfigError for arguments that it cannot read, or that are not for it."""
    try:
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    except (RuntimeError, ValueError) as error:  # its own kinds of errors derive from these
        raise ConfigError("ROS arguments", got=str(error).split(", at /")[0], next_step=HOW.format(name)) from error
    stray = rclpy.utilities.remove_ros_args(args)[1 if args is None else 0 :]
    if stray:
        raise ConfigError("arguments that no node has", got=" ".join(stray), next_step=HOW.format(name))


def main(node_class: type[Shell]) -> NoReturn:
    """Entry point of a node: `run`, then leave at once.

    Everything is closed when `run` returns; unloading torch and Warp in the interpreter's own teardown takes up to
    two seconds on a busy machine, and a node that was told to stop must be gone.
    """
    code = run(node_class)
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def _spin(node: Shell) -> int:
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        if node.config.autostart:
            for transition in (node.trigger_configure, node.trigger_activate):
                if node.exit_code is None and not node.asked:
                    transition()
                if node.bug is not None:
                    raise node.bug
        parent = os.getppid() if END_WITH_PARENT in os.environ else None
        while node.exit_code is None and not node.asked and parent in (None, os.getppid()):
            executor.spin_once(timeout_sec=POLL)
        return node.exit_code or 0
    finally:
        node.stop()
        executor.shutdown()
