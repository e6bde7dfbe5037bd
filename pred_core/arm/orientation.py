"""Rotations of a tool as tilt and yaw, in plain numbers: the guard turns every tick and tensors would be too slow.

R = exp(tilt_x, tilt_y, 0) Rz(yaw) R_upright. The tool axis depends on the tilt only, and |tilt| is its angle to the
vertical, so the tilt cone is a disc: a convex set, which averages never leave. Quaternions are wxyz tuples.
"""

from __future__ import annotations

import math

Quaternion = tuple[float, float, float, float]
Vector = tuple[float, float, float]

UP: Quaternion = (1.0, 0.0, 0.0, 0.0)
DOWN: Quaternion = (0.0, 1.0, 0.0, 0.0)  # half a turn about x
_SMALL = 1e-9


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """Hamilton product: rotate by b, then by a."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def conjugate(q: Quaternion) -> Quaternion:
    """Inverse of a unit quaternion."""
    return (q[0], -q[1], -q[2], -q[3])


def rotation_vector(q: Quaternion) -> Vector:
    """Logarithm of a unit quaternion [rad], of length at most pi."""
    w, x, y, z = q if q[0] >= 0.0 else (-q[0], -q[1], -q[2], -q[3])
    sine = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 * math.atan2(sine, w) / sine if sine > _SMALL else 2.0
    return (x * scale, y * scale, z * scale)


def from_rotation_vector(r: Vector) -> Quaternion:
    """Exponential of a rotation vector [rad]."""
    angle = math.sqrt(r[0] ** 2 + r[1] ** 2 + r[2] ** 2)
    scale = math.sin(0.5 * angle) / angle if angle > _SMALL else 0.5
    return (math.cos(0.5 * angle), r[0] * scale, r[1] * scale, r[2] * scale)


def angle_between(a: Quaternion, b: Quaternion) -> float:
    """Angle of the rotation from a to b [rad], 0 to pi."""
    w, x, y, z = multiply(b, conjugate(a))
    return 2.0 * math.atan2(math.sqrt(x * x + y * y + z * z), abs(w))


def slerp(a: Quaternion, b: Quaternion, share: float) -> Quaternion:
    """The rotation `share` (0 to 1) of the shorter way from a to b."""
    x, y, z = rotation_vector(multiply(b, conjugate(a)))
    return multiply(from_rotation_vector((x * share, y * share, z * share)), a)


def to_tilt_yaw(q: Quaternion, upright: Quaternion) -> Vector | None:
    """(tilt_x, tilt_y, yaw) [rad]; None where the tool axis is opposite to upright and yaw has no meaning."""
    w, x, y, z = multiply(q, conjugate(upright))
    norm = math.hypot(w, z)
    if norm < 1e-6:
        return None
    twist = (w / norm, 0.0, 0.0, z / norm)
    tilt_x, tilt_y, _ = rotation_vector(multiply((w, x, y, z), conjugate(twist)))
    return (tilt_x, tilt_y, 2.0 * math.atan2(twist[3], twist[0]))


def from_tilt_yaw(u: Vector, upright: Quaternion) -> Quaternion:
    """The unit quaternion of (tilt_x, tilt_y, yaw) [rad]."""
    yaw = (math.cos(0.5 * u[2]), 0.0, 0.0, math.sin(0.5 * u[2]))
    return multiply(multiply(from_rotation_vector((u[0], u[1], 0.0)), yaw), upright)


def wound(yaw: float, near: float, limit: float) -> float:
    """The yaw + 2 pi k nearest to `near` [rad] within +-limit; clipped to the limit if there is none."""
    turns = 2.0 * math.pi
    best = yaw + turns * round((near - yaw) / turns)
    if best > limit:
        best -= turns * math.ceil((best - limit) / turns)
    elif best < -limit:
        best += turns * math.ceil((-limit - best) / turns)
    if abs(best) <= limit:
        return best
    return min(max(math.remainder(yaw, turns), -limit), limit)
