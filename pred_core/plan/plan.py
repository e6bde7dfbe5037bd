"""A plan: the motion found, the part of it that is carried out, and how it was found."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pred_core.errors import InputError
from pred_core.plan.config import PlannerConfig
from pred_core.plan.curve import Curve
from pred_core.plan.knots import Beginning
from pred_core.types import Array

NS = 1e9
CHECK_STEP = 0.02  # [s] between the moments a plan is checked at
TOLERANCE = 1.02  # times a limit; interpolation and rounding


@dataclass(frozen=True)
class Plan:
    """Gripper poses from `start` on. What is sent is `sent`: the first part of `curve`, then a stop."""

    start: int  # [ns] when the first pose is due
    curve: Curve  # the whole motion, as simulated
    sent: Curve  # what is carried out unless a newer plan replaces it
    cost: float
    parts: dict[str, float]  # cost by name
    still: float  # cost of standing still, simulated alike; NaN where it was not tried
    predicted: Array  # (F, N, 3) [m] world, the object at `times`
    times: Array  # (F,) [s] after start
    motions: int  # simulated
    iterations: int  # finished
    seconds: float  # the planning took
    steps: int  # periods of a simulated motion
    history: tuple[tuple[float, float], ...] = field(default=())  # (seconds, best cost) after each chunk

    def at(self, stamp: int) -> Beginning:
        """Pose, velocity and acceleration of the sent motion at `stamp` [ns]; at its ends before and after it."""
        seconds = np.array([(stamp - self.start) / NS])
        position, rotation = self.sent.poses(seconds)
        inside = 0.0 <= seconds[0] < self.sent.seconds
        nothing = np.zeros((len(position[0]), 4))
        return Beginning(
            position[0],
            rotation[0],
            self.sent.velocity(seconds)[0] if inside else nothing,
            self.sent.acceleration(seconds)[0] if inside else nothing,
        )

    @property
    def end(self) -> int:
        """[ns] when the sent motion is at rest."""
        return self.start + round(self.sent.seconds * NS)

    def points(self, spacing: float) -> tuple[Array, Array, Array]:
        """Times (T,) [s] after start, positions (T, G, 3) [m], rotations (T, G, 4) wxyz of what is sent.

        The last two points are the same pose: who follows them may wait there.
        """
        count = max(2, int(np.ceil(self.sent.seconds / spacing)) + 1)
        times = np.linspace(0.0, self.sent.seconds, count)
        times = np.append(times, times[-1] + spacing)
        position, rotation = self.sent.poses(times)
        return times, position, rotation


def check_plan(curve: Curve, beginning: Beginning, config: PlannerConfig) -> None:
    """What may leave the planner. `beginning`: where the arm will be when the motion starts.

    Raises: InputError for a value that is not finite, a jump from where the arm will be or between two moments, a
    speed over the limit, or a way out of the workspace.
    """
    motion = config.motion
    times = np.arange(0.0, curve.seconds + CHECK_STEP, CHECK_STEP)
    position, rotation = curve.poses(times)
    if not (np.isfinite(position).all() and np.isfinite(rotation).all()):
        raise InputError("the plan has a pose that is not finite", next_step="Check the state and the twin")
    off = float(np.linalg.norm(position[0] - beginning.position, axis=-1).max())
    angle = float(_angles(rotation[0], beginning.rotation).max())
    if off > config.jump or angle > config.turn_jump:
        raise InputError(
            "the plan begins with a jump", got=f"{1e3 * off:.0f} mm, {angle:.2f} rad from where the arm will be",
            allowed=f"{1e3 * config.jump:.0f} mm, {config.turn_jump:.2f} rad", next_step="Plan from the measured pose",
        )  # fmt: skip
    moved = np.linalg.norm(np.diff(position, axis=0), axis=-1) / CHECK_STEP
    turn = _angles(rotation[1:], rotation[:-1]) / CHECK_STEP
    first = curve.knots[:2]
    fastest = max(motion.speed, float(np.linalg.norm(first[..., :3], axis=-1).max()))
    fastest_turn = max(motion.turn_speed, float(np.abs(first[..., 3]).max()))
    if moved.max() > TOLERANCE * fastest or turn.max() > TOLERANCE * fastest_turn + 1e-6:
        raise InputError(
            "the plan jumps", got=f"{moved.max():.2f} m/s, {turn.max():.2f} rad/s",
            allowed=f"{motion.speed:g} m/s, {motion.turn_speed:g} rad/s",
        )  # fmt: skip
    box = np.array([[motion.x_low, motion.y_low, motion.z_low], [motion.x_high, motion.y_high, motion.z_high]])
    slack = config.jump + max(0.0, float(np.maximum(box[0] - position[0], position[0] - box[1]).max()))
    out = np.maximum(box[0] - position, position - box[1]).max(axis=(1, 2))
    if float(out.max()) > slack:
        raise InputError(
            "the plan leaves the workspace", got=f"{1e3 * out.max():.0f} mm outside",
            allowed=f"{box[0].tolist()} to {box[1].tolist()} m",
        )  # fmt: skip


def _angles(a: Array, b: Array) -> Array:
    """Angles (...) [rad] between rotations (..., 4)."""
    dot = np.abs((a * b).sum(-1))
    chord = np.sqrt(np.maximum(2.0 - 2.0 * np.minimum(dot, 1.0), 0.0))
    return np.asarray(4.0 * np.arcsin(np.minimum(0.5 * chord, 1.0)))
