"""What moves the tool: a free gripper or an arm behind one small protocol, and the references they follow."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from pred_core.errors import InputError

Array = NDArray[np.float64]
TOOL = "tool"
DOWN = np.array([0.0, 1.0, 0.0, 0.0])  # wxyz: the untilted tool's z axis points down
HAND = 2  # collision bit of hand and arm: they touch table and posts, not the rope and not each other
STEEL = (0.75, 0.76, 0.78, 1.0)
BLACK = (0.12, 0.12, 0.13, 1.0)
FINGER = 0.065  # [m] from the palm to the tool centre
LARGEST_SPEED = 2.0  # [m/s] of a reference
LARGEST_TURN = 8.0  # [rad/s]


@dataclass(frozen=True)
class ToolPose:
    """Pose of the tool centre."""

    position: Array  # (3,) [m] world
    rotation: Array  # (4,) wxyz, world_from_tool


@dataclass(frozen=True)
class Segment:
    """The reference of one step: from one pose to the next at constant speed."""

    begin: ToolPose
    end: ToolPose
    seconds: float

    @property
    def velocity(self) -> Array:
        """(3,) [m/s] world."""
        return (self.end.position - self.begin.position) / self.seconds

    @property
    def turn(self) -> Array:
        """(3,) [rad/s] world."""
        return rotation_between(self.begin.rotation, self.end.rotation) / self.seconds

    @property
    def stays(self) -> bool:
        """Begin and end are the same pose, bit for bit."""
        same = np.array_equal(self.begin.position, self.end.position)
        return same and np.array_equal(self.begin.rotation, self.end.rotation)

    def at(self, share: float) -> ToolPose:
        """The reference after `share` (0 to 1) of the step."""
        position = (1.0 - share) * self.begin.position + share * self.end.position
        turned = quaternion_of(share * rotation_between(self.begin.rotation, self.end.rotation))
        return ToolPose(position, multiply(turned, self.begin.rotation))

    def check(self) -> None:
        """Raises: InputError for a reference no mover would follow."""
        speed, turning = float(np.linalg.norm(self.velocity)), float(np.linalg.norm(self.turn))
        if not (speed <= LARGEST_SPEED and turning <= LARGEST_TURN):
            raise InputError(
                "plant: commanded pose is too far for its time",
                got=f"{speed:.3g} m/s, {turning:.3g} rad/s over {self.seconds:.3g} s",
                allowed=f"{LARGEST_SPEED:g} m/s, {LARGEST_TURN:g} rad/s",
            )


class Mover(Protocol):
    """Holds the tool. It adds its bodies to the model, among them one called TOOL, and drives them."""

    def build(self, spec: mujoco.MjSpec) -> None:
        """Add bodies and joints."""
        ...

    def bind(self, model: mujoco.MjModel) -> None:
        """Find them in the compiled model."""
        ...

    def place(self, data: mujoco.MjData, pose: ToolPose) -> None:
        """Stand still at a pose. Raises: InputError if it cannot be reached."""
        ...

    def aim(self, segment: Segment) -> None:
        """Follow this reference in the steps to come. Raises: InputError if it cannot be reached; nothing changes."""
        ...

    def push(self, data: mujoco.MjData, share: float) -> None:
        """Set the drive's forces of the MuJoCo step that ends after `share` (0 to 1) of the segment."""
        ...

    def joints(self, data: mujoco.MjData) -> dict[str, float]:
        """Joint angles [rad] by name; empty without joints."""
        ...


def make_pose(position: Array, rotation: Array) -> ToolPose:
    """A checked pose. Raises: InputError for a value that is not finite or a quaternion that is not a rotation."""
    p, q = np.array(position, float), np.array(rotation, float)
    if p.shape != (3,) or not np.isfinite(p).all():
        raise InputError("plant: commanded position", got=p.tolist(), allowed="three finite metres")
    norm = float(np.linalg.norm(q)) if q.shape == (4,) else 0.0
    if not abs(norm - 1.0) < 1e-3:
        raise InputError("plant: commanded rotation", got=q.tolist(), allowed="a unit quaternion wxyz")
    return ToolPose(p, q / norm)


def tool_down(yaw: float) -> Array:
    """(4,) wxyz: z down, x turned by `yaw` [rad] about world z."""
    return multiply(np.array([np.cos(0.5 * yaw), 0.0, 0.0, np.sin(0.5 * yaw)]), DOWN)


def multiply(a: Array, b: Array) -> Array:
    """Hamilton product of quaternions (4,): rotate by b, then by a."""
    out = np.empty(4)
    mujoco.mju_mulQuat(out, a, b)
    return out


def quaternion_of(rotation_vector: Array) -> Array:
    """(4,) wxyz of a rotation vector (3,) [rad]."""
    angle = float(np.linalg.norm(rotation_vector))
    out = np.empty(4)
    mujoco.mju_axisAngle2Quat(out, rotation_vector / angle if angle > 0.0 else np.array([0.0, 0.0, 1.0]), angle)
    return out


def rotation_between(a: Array, b: Array) -> Array:
    """Rotation vector (3,) [rad] in world that turns a into b, both (4,) wxyz; at most half a turn."""
    back = a * np.array([1.0, -1.0, -1.0, -1.0])
    out = np.empty(3)
    mujoco.mju_quat2Vel(out, multiply(b, back), 1.0)
    return out


def matrix_of(q: Array) -> Array:
    """(3, 3) of a quaternion (4,) wxyz."""
    out = np.empty(9)
    mujoco.mju_quat2Mat(out, q)
    return out.reshape(3, 3)


def quaternion_of_matrix(matrix: Array) -> Array:
    """(4,) wxyz of a rotation matrix (3, 3)."""
    out = np.empty(4)
    mujoco.mju_mat2Quat(out, np.ascontiguousarray(matrix).ravel())
    return out


def turn_onto(a: Array, b: Array) -> Array:
    """The smallest rotation (3, 3) that takes unit vector a onto b; they must not be opposite."""
    axis = np.cross(a, b)
    k = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    return np.eye(3) + k + k @ k / (1.0 + float(a @ b))


def add_hand(tool: mujoco.MjsBody) -> None:
    """Two fingers and a palm on the tool: about those of the xArm gripper. They touch table and posts."""

    def box(name: str, center: list[float], half: list[float], color: tuple[float, ...]) -> None:
        tool.add_geom(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=center,
            size=half,
            mass=0.0,
            contype=HAND,
            conaffinity=0,
            friction=[0.3, 0.005, 0.0001],
            rgba=list(color),
        )

    for name, side in (("finger_left", 1.0), ("finger_right", -1.0)):
        box(name, [0.0, side * 0.009, 0.005 - 0.5 * FINGER], [0.01, 0.004, 0.5 * FINGER], BLACK)
    box("palm", [0.0, 0.0, -FINGER - 0.05], [0.03, 0.05, 0.05], STEEL)
