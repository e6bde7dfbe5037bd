"""Universal Robots arms through ur_rtde: servoL every tick, watchdog kicked, servoStop at the end.

servoL ignores its speed and acceleration arguments: the limits are the guard's, and `StepCheck` holds them here once
more. A protective stop is never released from here; a person does that at the pendant.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

import numpy as np

from pred_core.arm.orientation import from_rotation_vector, rotation_vector
from pred_core.arm.placement import Placement
from pred_core.arm.protocol import Reading, SetPoint
from pred_core.arm.step_check import StepCheck
from pred_core.errors import ConfigError, InputError

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
LOOKAHEAD = 0.1  # [s] smoothing of servoL, 0.03 to 0.2
GAIN = 300.0  # stiffness of servoL, 100 to 2000
WATCHDOG = 10.0  # [Hz] the controller stops the arm when set-points come more rarely
DECELERATION = 2.0  # [m/s^2] of servoStop
RUNNING = 7  # robot mode of an arm with brakes released and program allowed


class RtdeControl(Protocol):
    """What is used of `rtde_control.RTDEControlInterface`."""

    def servoL(self, pose: list[float], v: float, a: float, time: float, lookahead: float, gain: float) -> bool: ...
    def servoStop(self, a: float) -> bool: ...
    def setWatchdog(self, min_frequency: float) -> bool: ...
    def kickWatchdog(self) -> bool: ...
    def isProgramRunning(self) -> bool: ...
    def reuploadScript(self) -> bool: ...
    def stopScript(self) -> None: ...
    def disconnect(self) -> None: ...


class RtdeReceive(Protocol):
    """What is used of `rtde_receive.RTDEReceiveInterface`."""

    def isConnected(self) -> bool: ...
    def getActualTCPPose(self) -> list[float]: ...
    def getActualQ(self) -> list[float]: ...
    def getRobotMode(self) -> int: ...
    def isProtectiveStopped(self) -> bool: ...
    def isEmergencyStopped(self) -> bool: ...
    def disconnect(self) -> None: ...


class UrArm:
    """A UR whose base stands at `placement`; one set-point every `period` [s]."""

    def __init__(
        self, control: RtdeControl, receive: RtdeReceive, placement: Placement, period: float, check: StepCheck
    ):
        self._control, self._receive, self._placement = control, receive, placement
        self._period, self._check = period, check
        self._following = False

    def read(self) -> Reading:
        """Pose, joints and safety state from the receive interface. Raises: InputError without connection."""
        if not self._receive.isConnected():
            raise InputError("ur: connection lost", next_step="Check cable and controller, then start the node again")
        with _one_line():
            pose = np.array(self._receive.getActualTCPPose(), float)
            angles = [float(q) for q in self._receive.getActualQ()]
        if pose.shape != (6,) or not np.isfinite(pose).all():
            raise InputError("ur: the controller reports no pose", got=pose.tolist())
        position, rotation = self._placement.to_world(
            pose[:3], from_rotation_vector((float(pose[3]), float(pose[4]), float(pose[5])))
        )
        joints = dict(zip(JOINTS, angles, strict=True))
        trouble = self._trouble()
        return Reading(position, rotation, not trouble, trouble or "running", None, joints)

    def begin(self) -> None:
        """Start following. Raises: InputError in a protective or emergency stop, or when the script does not run."""
        reading = self.read()
        if not reading.ready:
            raise InputError(f"ur: {reading.message}", next_step="Clear it at the pendant, then enable again")
        with _one_line():
            if not self._control.isProgramRunning() and not self._control.reuploadScript():
                raise InputError("ur: the control script does not run", next_step="Set the pendant to remote control")
            if not self._control.setWatchdog(WATCHDOG):
                raise InputError("ur: the controller took no watchdog", next_step="Start the node again")
        self._check.restart(reading.position, reading.rotation)
        self._following = True

    def command(self, setpoint: SetPoint) -> None:
        """servoL to the set-point. Raises: InputError for a step that is too long, or a stop of the arm."""
        if not self._following:
            raise InputError("ur: a set-point before the arm was enabled")
        trouble = self._trouble()
        if trouble:
            raise InputError(f"ur: {trouble}")
        self._check.check(setpoint, "ur")
        position, rotation = self._placement.to_base(setpoint.position, setpoint.rotation)
        pose = [*position.tolist(), *rotation_vector(rotation)]
        with _one_line():
            # Order: pose, speed and acceleration (both ignored by the controller), time, lookahead, gain.
            if not self._control.servoL(pose, 0.0, 0.0, self._period, LOOKAHEAD, GAIN):
                raise InputError("ur: servoL was refused", next_step="Look at the pendant's log")
            if not self._control.kickWatchdog():
                raise InputError("ur: the watchdog could not be kicked")

    def stop(self) -> None:
        """servoStop, which decelerates on the controller."""
        self._check.forget()
        if self._following:
            self._following = False
            with _one_line():
                self._control.servoStop(DECELERATION)

    def close(self) -> None:
        """Stop, end the script, disconnect."""
        try:
            self.stop()
        finally:
            with _one_line():
                self._control.stopScript()
                self._control.disconnect()
                self._receive.disconnect()

    def _trouble(self) -> str:
        """Why the arm would not move, '' if it would."""
        if self._receive.isEmergencyStopped():
            return "emergency stop"
        if self._receive.isProtectiveStopped():
            return "protective stop"
        mode = self._receive.getRobotMode()
        return "" if mode == RUNNING else f"robot mode {mode}, not running ({RUNNING})"


def connect_ur(host: str, placement: Placement, period: float, check: StepCheck) -> UrArm:
    """Connect to a controller. Raises: ConfigError without ur_rtde, InputError if nobody answers."""
    try:
        from rtde_control import RTDEControlInterface
        from rtde_receive import RTDEReceiveInterface
    except ImportError as error:
        raise ConfigError("ur_rtde is not installed", next_step="pip install ur-rtde") from error
    try:
        receive = RTDEReceiveInterface(host)
        return UrArm(RTDEControlInterface(host), receive, placement, period, check)
    except RuntimeError as error:
        raise InputError(f"ur: no controller at {host}", got=error, next_step="Check address and network") from error


@contextmanager
def _one_line() -> Iterator[None]:
    """The driver's own errors (a lost connection, a script that ended), as one line."""
    try:
        yield
    except RuntimeError as error:
        raise InputError("ur: the driver failed", got=error, next_step="Look at the pendant's log") from error
