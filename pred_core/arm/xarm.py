"""UFACTORY xArm through its SDK: Cartesian velocity (mode 5), each command good for 0.1 s: a dead-man by itself.

Millimetres exist in this file only. Errors of the arm are never cleared from here; a person does that, in Studio.
"""

from __future__ import annotations

import itertools
import socket
from typing import Any, Protocol

import numpy as np

from pred_core.arm.limits import Bounds
from pred_core.arm.orientation import (
    Quaternion,
    conjugate,
    from_rotation_vector,
    multiply,
    rotation_vector,
)
from pred_core.arm.placement import Placement
from pred_core.arm.protocol import Array, Reading, SetPoint
from pred_core.errors import ConfigError, InputError

MM = 1000.0
PORT = 502  # of the controller
PATIENCE = 3.0  # [s] to connect
DEAD_MAN = 0.1  # [s] after which the controller stops without a new command
VELOCITY_MODE, MOTION, HALT = 5, 0, 4  # set_mode, set_state
OLDEST_FIRMWARE = (1, 8, 0)  # earlier ones ignore the duration, which is the dead-man
GAIN = 4.0  # [1/s] of the pull from the measured pose to the set-point
HEADROOM = 1.2  # own limit: times the guard's speed limits, for the pull
FENCE_MARGIN = 0.03  # [m] of the controller's own fence around the workspace


class XArmApi(Protocol):
    """What is used of `xarm.wrapper.XArmAPI`. Every call returns a code, 0 is good, or (code, values)."""

    connected: bool
    version_number: tuple[int, int, int]

    def get_err_warn_code(self) -> tuple[int, list[float]]: ...
    def get_position(self, is_radian: bool) -> tuple[int, list[float]]: ...
    def get_servo_angle(self, is_radian: bool) -> tuple[int, list[float]]: ...
    def motion_enable(self, enable: bool) -> int: ...
    def set_mode(self, mode: int) -> int: ...
    def set_state(self, state: int) -> int: ...
    def set_reduced_tcp_boundary(self, boundary: list[int]) -> int: ...
    def set_fence_mode(self, on: bool) -> int | list[int]: ...
    def vc_set_cartesian_velocity(
        self, speeds: list[float], is_radian: bool, is_tool_coord: bool, duration: float
    ) -> int: ...
    def disconnect(self) -> Any: ...


class XArm:
    """An xArm whose base stands at `placement`; `bounds` sets its fence, the speeds [m/s], [rad/s] its own limit."""

    def __init__(self, api: XArmApi, placement: Placement, bounds: Bounds, speed: float, angular_speed: float):
        self._api, self._placement, self._bounds = api, placement, bounds
        self._speed, self._angular_speed = HEADROOM * speed, HEADROOM * angular_speed
        self._following = False
        self._seen: tuple[Array, Quaternion] | None = None  # measured last, world

    def read(self) -> Reading:
        """Pose, joints and error state, asked for now: the driver's own properties may be old.

        Raises: InputError without connection or answer.
        """
        if not self._api.connected:
            raise InputError("xarm: connection lost", next_step="Check cable and controller, then start the node again")
        pose = self._values("get_position", self._api.get_position(is_radian=True), 6)
        position, rotation = self._placement.to_world(pose[:3] / MM, _from_rpy(*(float(a) for a in pose[3:6])))
        angles = self._values("get_servo_angle", self._api.get_servo_angle(is_radian=True), 1)
        joints = {f"joint{k + 1}": float(a) for k, a in enumerate(angles)}
        errors = self._values("get_err_warn_code", self._api.get_err_warn_code(), 1)
        trouble = f"error {int(errors[0])}" if errors[0] else ""
        self._seen = (position, rotation)
        return Reading(position, rotation, not trouble, trouble or "no error", None, joints)

    def begin(self) -> None:
        """Fence, velocity mode, go. Raises: InputError on an error of the arm or a firmware without dead-man."""
        reading = self.read()
        if not reading.ready:
            raise InputError(f"xarm: {reading.message}", next_step="Clear it in Studio, then enable again")
        if tuple(self._api.version_number) < OLDEST_FIRMWARE:
            raise InputError(
                "xarm: this firmware has no dead-man for velocities",
                got=".".join(map(str, self._api.version_number)),
                allowed="1.8.0 or newer",
            )
        self._good("set_reduced_tcp_boundary", self._api.set_reduced_tcp_boundary(self._fence()))
        self._good("set_fence_mode", self._api.set_fence_mode(True))
        self._good("motion_enable", self._api.motion_enable(True))
        self._good("set_mode", self._api.set_mode(VELOCITY_MODE))
        self._good("set_state", self._api.set_state(MOTION))
        self._following = True

    def command(self, setpoint: SetPoint) -> None:
        """The set-point's velocity plus a pull from the pose read last towards its pose, limited once more.

        Raises: InputError before `begin`, or if the controller refuses it (it is in an error, or was stopped).
        """
        if not self._following or self._seen is None:
            raise InputError("xarm: a set-point before the arm was enabled")
        place, turned = self._seen
        off = np.array(rotation_vector(multiply(setpoint.rotation, conjugate(turned))))
        linear = _limited(setpoint.velocity + GAIN * (setpoint.position - place), self._speed)
        angular = _limited(setpoint.angular_velocity + GAIN * off, self._angular_speed)
        if not (np.isfinite(linear).all() and np.isfinite(angular).all()):
            raise InputError("xarm: a velocity is not finite", got=f"{linear.tolist()} {angular.tolist()}")
        self._send(self._placement.vector_to_base(linear), self._placement.vector_to_base(angular))

    def stop(self) -> None:
        """Zero velocity, then the halt state."""
        if self._following:
            self._following = False
            try:
                self._send(np.zeros(3), np.zeros(3))
            finally:
                self._good("set_state", self._api.set_state(HALT))

    def close(self) -> None:
        """Stop and disconnect."""
        try:
            self.stop()
        finally:
            self._api.disconnect()

    def _send(self, linear: Array, angular: Array) -> None:
        speeds = [*(MM * linear).tolist(), *angular.tolist()]
        code = self._api.vc_set_cartesian_velocity(speeds, is_radian=True, is_tool_coord=False, duration=DEAD_MAN)
        self._good("vc_set_cartesian_velocity", code)

    def _fence(self) -> list[int]:
        """The box in the base frame around the workspace: x max, x min, y max, ... [mm]."""
        corners = itertools.product(*zip(self._bounds.low, self._bounds.high, strict=True))
        base = np.array([self._placement.to_base(np.array(c), (1.0, 0.0, 0.0, 0.0))[0] for c in corners])
        high = np.ceil(MM * (base.max(0) + FENCE_MARGIN)).astype(int).tolist()
        low = np.floor(MM * (base.min(0) - FENCE_MARGIN)).astype(int).tolist()
        return [high[0], low[0], high[1], low[1], high[2], low[2]]

    def _good(self, call: str, answer: int | list[int]) -> None:
        code = answer[0] if isinstance(answer, list) else answer  # some calls return the whole reply
        if code != 0:
            raise InputError(f"xarm: {call} was refused", got=f"code {code}", next_step="Look at Studio's log")

    def _values(self, call: str, answer: tuple[int, list[float]], least: int) -> Array:
        code, values = answer
        self._good(call, code)
        array = np.array(values, float)
        if array.ndim != 1 or len(array) < least or not np.isfinite(array).all():
            raise InputError(f"xarm: {call} gave no pose", got=values)
        return array


def connect_xarm(
    host: str, placement: Placement, bounds: Bounds, speed: float, angular_speed: float, port: int = PORT
) -> XArm:
    """Connect to a controller. Raises: ConfigError without the SDK, InputError if nobody answers."""
    try:
        from xarm.wrapper import XArmAPI
    except ImportError as error:
        raise ConfigError("the xArm SDK is not installed", next_step="pip install xarm-python-sdk") from error
    try:  # the SDK itself would raise a bare Exception
        socket.create_connection((host, port), timeout=PATIENCE).close()
    except OSError as error:
        raise InputError(f"xarm: no controller at {host}", got=error, next_step="Check address and network") from error
    api = XArmAPI(host, is_radian=True)
    if not api.connected:
        raise InputError(f"xarm: the controller at {host} hung up", next_step="Start the node again")
    return XArm(api, placement, bounds, speed, angular_speed)


def _limited(vector: Array, most: float) -> Array:
    length = float(np.linalg.norm(vector))
    return vector * (most / length) if length > most else vector


def _from_rpy(roll: float, pitch: float, yaw: float) -> Quaternion:
    """Rz(yaw) Ry(pitch) Rx(roll) [rad], as the arm reports its orientation."""
    about_x, about_y = from_rotation_vector((roll, 0.0, 0.0)), from_rotation_vector((0.0, pitch, 0.0))
    return multiply(multiply(from_rotation_vector((0.0, 0.0, yaw)), about_y), about_x)
