"""The plant: the stand-in cell as a robot's drivers would show it. Other nodes cannot tell.

Out: camN/color/image_raw, camN/depth/image_raw, camN/color/camera_info, camN/pose, /clock; with `drive: command` also
what an arm's driver publishes (gripper/pose, gripper/closed, joint_states), which with `drive: controller` comes from
the arm node (arm:=plant) that commands through the controller's port.
In: gripper/command, with `drive: command`. On a free clock the gripper goes there, if the stamp (of /clock) is of now
and the place near, and stops 0.1 s after the last one; in lock-step time stands still until
a command comes with a later stamp, which is when the gripper shall be there, or until `~/step`.
Services: ~/reset (another start, by the seed), ~/step, ~/slip (the rope slips out of the jaws), ~/jaws (SetBool),
~/clear (ends a fault of the arm). Parameters dead_cameras, bumped_cameras, factor and seed may change at any time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, NoReturn

import numpy as np
from geometry_msgs.msg import PoseArray
from numpy.typing import NDArray
from std_srvs.srv import SetBool, Trigger

from pred_core.bag.wire import GRIPPER_COMMAND
from pred_core.config import setting
from pred_core.errors import ConfigError, InputError, PredError
from pred_core.plant.cameras import ring_of_cameras
from pred_core.plant.live.cell import WORKPLACE, Cell, CellConfig
from pred_core.plant.live.controller import PORT, Controller
from pred_core.plant.live.mover import make_pose
from pred_core.plant.live.slot import SlotConfig
from pred_core.plant.live.station import TICK, Station
from pred_ros import arm_messages, qos, shell
from pred_ros.diagnostics import ERROR, OK, WARN
from pred_ros.paced_worker import PacedWorker
from pred_ros.plant_topics import PlantTopics
from pred_ros.shell import Shell

SLOW = 0.8  # of the factor asked for
LONGEST = 10.0  # [s] a command may lie ahead in lock-step
STALE, AHEAD = 0.1, 0.1  # [s] on a free clock: age of a command, and how far its stamp may lie ahead
JUMP = 0.1  # [m] on a free clock: from the gripper to a command
LIVE = ("dead_cameras", "bumped_cameras", "factor", "seed")  # parameters that may change at any time


@dataclass(frozen=True)
class PlantConfig(CellConfig):
    """Parameters of the plant node."""

    clock: str = setting("free", choices=("free", "step"), doc="time runs by itself, or when the loop asks")
    factor: float = setting(1.0, unit="x real time", low=0.01, high=100.0, doc="speed of a free clock, at most")
    seed: int = setting(0, low=0, high=2**31 - 1, doc="start pose and noise; ~/reset begins with it again")
    step: float = setting(1 / 30, unit="s", low=TICK, high=LONGEST, doc="what ~/step advances by")
    drive: str = setting("controller", choices=("controller", "command"), doc="an arm node's port, or gripper/command")
    port: int = setting(PORT, low=0, high=65535, doc="of the controller, on this machine only; 0: any free one")
    cameras: int = setting(4, low=0, high=8, doc="around the slot")
    camera_rate: float = setting(10.0, unit="Hz", low=0.1, high=75.0, doc="pictures a second of each camera")
    camera_delay: float = setting(0.0, unit="s", low=0.0, high=1.0, doc="from capture to arrival")
    distance: float = setting(1.0, unit="m", low=0.3, high=5.0, doc="of the cameras from the slot")
    width: int = setting(640, unit="px", low=64, high=1920, doc="of a picture")
    height: int = setting(480, unit="px", low=48, high=1200, doc="of a picture")
    gap: float = setting(0.024, unit="m", low=0.01, high=0.5, doc="between the posts of the slot")
    dead_cameras: str = setting("", doc="names, separated by commas: they deliver nothing")
    bumped_cameras: str = setting("", doc="names: moved by 5 mm and 1 degree, still reporting the old pose")
    truth: bool = setting(False, doc="publish the true rope on ~/truth, for scoring; no other node may read it")
    autostart: bool = setting(True, doc="configure and activate without a lifecycle manager")


class PlantNode(Shell):
    """One worker owns the cell, its clock and its cameras; the executor hands it what topics and services ask."""

    NAME: ClassVar[str] = "plant"
    CONFIG: ClassVar[type] = PlantConfig
    PICTURES: ClassVar[bool] = True

    def __init__(self) -> None:
        super().__init__()
        self._worker: PacedWorker | None = None
        self._controller: Controller | None = None
        self._begun = False

    def setup(self) -> None:
        """Build the cell, make publishers and services. Raises: ConfigError."""
        config: PlantConfig = self.config
        if abs(config.step / TICK - round(config.step / TICK)) > 1e-6:
            raise ConfigError("step", got=f"{config.step} s", allowed="multiples of 1/150 s")
        ring = ring_of_cameras(config.cameras, WORKPLACE, config.distance, width=config.width, height=config.height)
        cameras = tuple(replace(c, rate=config.camera_rate, delay=config.camera_delay) for c in ring)
        _check_names(config)
        self._station = Station(Cell(config, slot=SlotConfig(gap=config.gap), cameras=cameras))
        self._topics = PlantTopics(self, cameras, config.drive == "command", config.truth)
        for name, job in (("reset", self._reset), ("step", self._step), ("slip", self._slip), ("clear", self._clear)):
            self.create_service(Trigger, f"~/{name}", self._server(job))
        self.create_service(SetBool, "~/jaws", self._on_jaws)

    def start(self) -> None:
        """Reset the cell and let it run. Raises: ConfigError if the port is taken."""
        self._begun = False
        if self.config.drive == "command":
            self._heard: Any = self.create_subscription(PoseArray, GRIPPER_COMMAND, self._on_command, qos.command())
        else:
            self._controller = Controller(
                self._station.servo,
                lambda: self._station.moment.truth,
                lambda: self._station.cell.time,
                self.config.port,
            )
            self.diagnostics.value("port", str(self._controller.port))
        self._worker = PacedWorker(self._tick, TICK, self._pace, self._refused, self._station.close)
        self._first = self._worker.submit(self._reset)
        self._watch = self.create_timer(0.1, self._check_worker)

    def stop(self) -> None:
        """End the worker, hang up."""
        if self._worker is None:
            return
        self.destroy_timer(self._watch)
        if self._controller is not None:
            self._controller.close()
            self._controller = None
        else:
            self.destroy_subscription(self._heard)
        self._worker.end()
        self._worker = None

    def changed(self, config: PlantConfig) -> None:
        """Faults, factor and seed may change while it runs."""
        _check_names(config)
        if self._worker is None:
            return
        differ = [f.name for f in fields(config) if getattr(config, f.name) != getattr(self.config, f.name)]
        fixed = [name for name in differ if name not in LIVE]
        if fixed:
            raise ConfigError(f"'{fixed[0]}' cannot change while the plant is active", next_step="Deactivate it first")
        self._worker.submit(lambda: self._apply_faults(config))

    def heartbeat(self) -> None:
        """Clock, collisions, faults."""
        if self._worker is None:
            return
        factor = self._worker.real_time_factor
        self.diagnostics.value("real-time factor", f"{factor:.2f}")
        for pair, count in self._station.cell.touches.count.items():
            self.diagnostics.value(f"collisions: {pair}", str(count))
        if self._station.servo.fault:
            self.report(ERROR, self._station.servo.fault)
        elif self.config.clock == "step":
            self.report(OK, "lock-step")
        elif factor < SLOW * self.config.factor:
            self.report(WARN, f"time runs slower than the factor {self.config.factor:g} that was asked for")
        else:
            self.report(OK, "running")

    # Called by the executor.

    def _on_command(self, message: PoseArray) -> None:
        self.diagnostics.seen(GRIPPER_COMMAND)
        if self._worker is not None:
            self._worker.submit(lambda: self._obey(message))

    def _server(self, job: Callable[[], str]) -> Callable[[Trigger.Request, Trigger.Response], Trigger.Response]:
        def serve(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            response.success, response.message = self._ask(job)
            return response

        return serve

    def _on_jaws(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        response.success, response.message = self._ask(lambda: self._move_jaws(bool(request.data)))
        return response

    def _ask(self, job: Callable[[], str]) -> tuple[bool, str]:
        return (False, "not active") if self._worker is None else self._worker.ask(job)

    def _check_worker(self) -> None:
        if self._worker is None:
            return
        failure = self._worker.failure or (self._first.exception() if self._first.done() else None)
        if isinstance(failure, PredError):
            self.fail(failure)
        elif failure is not None:
            raise failure

    # Below: the worker.

    def _pace(self) -> float | None:
        return self.config.factor if self.config.clock == "free" and self._begun else None

    def _tick(self) -> None:
        self._topics.publish(self._station.tick())

    def _refused(self, error: PredError) -> None:
        self.diagnostics.count("refused")
        self.diagnostics.value("last refusal", str(error))
        self.report(WARN, f"refused: {error}")

    def _reset(self) -> str:
        config: PlantConfig = self.config
        self._apply_faults(config)
        moment = self._station.reset(config.seed)
        if config.drive == "command":
            self._station.servo.begin()
        self._topics.begin(moment)
        self._begun = True
        return f"seed {config.seed}, time {moment.stamp * 1e-9:.3f} s"

    def _apply_faults(self, config: PlantConfig) -> str:
        self._station.break_cameras(_names(config.dead_cameras), _names(config.bumped_cameras), config.seed)
        return "set"

    def _step(self) -> str:
        if self.config.clock != "step":
            raise InputError("plant: time runs by itself", next_step="Start the plant with clock:=step")
        for _ in range(round(self.config.step / TICK)):
            self._tick()
        return f"time {self._station.stamp * 1e-9:.6f} s"

    def _obey(self, message: PoseArray) -> str:
        stamp, position, rotation = arm_messages.message_to_command(message)
        pose, station = make_pose(np.array(position), np.array(rotation)), self._station
        if self.config.clock == "free":
            self._check_command(stamp, np.array(position))
            station.servo.command(pose, np.zeros(3), np.zeros(3), station.cell.time)
            return "followed"
        ahead = (stamp - station.stamp) * 1e-9
        if not 0.5 * TICK < ahead < LONGEST:
            raise InputError(
                f"{GRIPPER_COMMAND}: in lock-step its stamp says when the gripper shall be there",
                got=f"{ahead:.4f} s from now",
                allowed=f"1/150 to {LONGEST:g} s",
            )
        for moment in station.advance(pose, round(ahead / TICK)):
            self._topics.publish(moment)
        return "reached"

    def _check_command(self, stamp: int, position: NDArray[np.float64]) -> None:
        """Raises: InputError for a command of another time than now, or far from the gripper."""
        age = (self._station.stamp - stamp) * 1e-9
        if not -AHEAD <= age <= STALE:
            raise InputError(
                f"{GRIPPER_COMMAND}: stamp",
                got=f"{age:.3f} s old" if age > 0.0 else f"{-age:.3f} s ahead",
                allowed=f"at most {STALE:g} s old, {AHEAD:g} s ahead",
                next_step="Stamp it with the time of /clock (use_sim_time)",
            )
        off = float(np.linalg.norm(position - self._station.moment.truth.gripper.position))
        if off > JUMP:
            raise InputError(
                f"{GRIPPER_COMMAND}: far from the gripper",
                got=f"{off:.3f} m",
                allowed=f"{JUMP:g} m",
                next_step="Send poses on the way there, in metres",
            )

    def _slip(self) -> str:
        self._station.cell.jaws.slip()
        return "the rope is out of the jaws"

    def _clear(self) -> str:
        self._station.servo.clear()
        return "no fault"

    def _move_jaws(self, close: bool) -> str:
        jaws = self._station.cell.jaws
        if close:
            jaws.close()
        else:
            jaws.open()
        return f"{'closed' if jaws.closed else 'open'}, {'the rope in them' if jaws.holds else 'nothing in them'}"


def _names(listed: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in listed.split(",") if name.strip())


def _check_names(config: PlantConfig) -> None:
    known = [f"cam{k}" for k in range(config.cameras)]
    for name in (*_names(config.dead_cameras), *_names(config.bumped_cameras)):
        if name not in known:
            raise ConfigError(f"unknown camera '{name}'", allowed=", ".join(known) or "none: cameras is 0")


def main() -> NoReturn:
    """Entry point of `ros2 run pred_ros plant`."""
    shell.main(PlantNode)


if __name__ == "__main__":
    main()
