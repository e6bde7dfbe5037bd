"""A second world, of the same kind as the simulator that predicts: particles and springs, in plain numpy.

Only here does "nothing is hidden" hold exactly: the predicted model can be right. The laws are those of the paper
(III-A: force per strain and a dashpot along each spring; ground contact without penetration, Coulomb friction),
written anew in float64 with a finer step; the parameters are drawn.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pred_core.bag.dataset import Dataset
from pred_core.config import setting, to_mapping
from pred_core.errors import DivergenceError
from pred_core.plant.case import Progress, write_case
from pred_core.plant.drive import poses
from pred_core.plant.hidden.effect import HiddenEffect
from pred_core.plant.motion import Motion
from pred_core.plant.posture import laid_angles
from pred_core.plant.sensing import SensorConfig
from pred_core.plant.session import EpisodePlan, SessionConfig
from pred_core.plant.world import FREE, LEAD, SETTLE, SETTLE_DRAG, Record
from pred_core.types import STANDARD_GRAVITY

Array = NDArray[np.float64]
RECORD_RATE = 300.0  # [Hz]
HELD = 2  # particles in the jaws
BATCH = 12  # episodes simulated side by side


@dataclass(frozen=True)
class SpringsConfig:
    """The planted physics. `draw_springs` draws the first four."""

    stiffness: float = setting(100.0, unit="N", low=1.0, high=1000.0, log=True, doc="force per unit strain of a spring")
    damping: float = setting(0.02, unit="N s/m", low=0.0, high=0.1, doc="dashpot along a spring")
    friction: float = setting(0.5, low=0.0, high=3.0, doc="Coulomb coefficient at the ground")
    reach: int = setting(2, low=1, high=4, doc="a particle is joined to so many neighbours on each side")
    length: float = setting(0.7, unit="m", low=0.05, high=5.0, doc="of the line")
    mass: float = setting(0.05, unit="kg", low=1e-4, high=10.0, doc="of the line")
    substeps: int = setting(40, low=1, high=1000, doc="of a record step, 1/300 s")


def draw_springs(seed: int) -> SpringsConfig:
    """Physics of a seed."""
    generator = np.random.default_rng([seed, 4])
    return SpringsConfig(
        stiffness=float(np.exp(generator.uniform(np.log(30.0), np.log(150.0)))),
        damping=float(np.exp(generator.uniform(np.log(0.005), np.log(0.05)))),
        friction=float(generator.uniform(0.3, 0.8)),
        reach=int(generator.integers(1, 4)),
    )


def write_springs_case(
    root: Path,
    seed: int,
    progress: Progress,
    *,
    session: SessionConfig | None = None,
    sensor: SensorConfig | None = None,
    springs: SpringsConfig | None = None,
) -> Dataset:
    """Write the data set of a seed, with nothing hidden. Finished bags of the same case are kept.

    Raises: DatasetError if `root` holds something else; DivergenceError if the springs are too stiff for their steps.
    """
    session, sensor, springs = session or SessionConfig(), sensor or SensorConfig(), springs or draw_springs(seed)

    def simulate(plans: Sequence[EpisodePlan]) -> Iterator[tuple[EpisodePlan, Record, Sequence[HiddenEffect]]]:
        for begin in range(0, len(plans), BATCH):
            part = plans[begin : begin + BATCH]
            records = simulate_springs([p.motion for p in part], springs, session.seconds, session.particles)
            for plan, record in zip(part, records, strict=True):
                yield plan, record, ()

    return write_case(
        root,
        truth={
            "world": "springs",
            "hidden": [],
            "seed": seed,
            "session": to_mapping(session),
            "sensor": to_mapping(sensor),
            "springs": to_mapping(springs),
            "format": 1,
        },
        simulate=simulate,
        session=session,
        sensor=sensor,
        seed=seed,
        known={"mass": springs.mass, "rest_length": springs.length, "ground": 0.0},
        progress=progress,
    )


def simulate_springs(
    motions: Sequence[Motion], springs: SpringsConfig, seconds: float, particles: int
) -> list[Record]:
    """Episodes side by side, semi-implicit Euler; records at 300 Hz, particles in material order."""
    dt = 1.0 / RECORD_RATE
    settle, lead = round(SETTLE * RECORD_RATE), round(LEAD * RECORD_RATE)
    count = settle + round(seconds * RECORD_RATE) + 2
    paths = [m.path(-SETTLE, count, dt) for m in motions]
    placed = [poses(p.position) for p in paths]
    origin, rotation = (np.stack([p[k] for p in placed]) for k in (0, 1))  # (E, T, 3), (E, T, 4)
    line = Line(springs, particles)
    x = np.stack([_laid(m, springs.length, particles) for m in motions])
    v = np.zeros_like(x)
    recorded = np.empty((len(motions), count - settle + lead, particles, 3))
    down = _down(rotation)
    jaws = line.spacing * np.arange(HELD)
    for k in range(count):
        row = k - settle + lead
        if row >= 0:
            recorded[:, row] = x
        drag = SETTLE_DRAG if (k - settle) * dt < -FREE else 0.0
        after = min(k + 1, count - 1)
        for sub in range(1, springs.substeps + 1):
            w = sub / springs.substeps
            at = (1.0 - w) * origin[:, k] + w * origin[:, after]
            axis = (1.0 - w) * down[:, k] + w * down[:, after]
            held = at[:, None] + jaws[None, :, None] * (axis / np.linalg.norm(axis, axis=1, keepdims=True))[:, None]
            x, v = line.step(x, v, held, drag, dt / springs.substeps)
    if not np.isfinite(x).all():
        raise DivergenceError("the springs' simulation became unstable", next_step="Use more substeps")
    time = dt * np.arange(-lead, recorded.shape[1] - lead, dtype=np.float64)
    records = []
    for e, motion in enumerate(motions):
        position = recorded[e, :, ::-1] if motion.variant == "regrasp" else recorded[e]
        reference = paths[e].position[settle - lead :]
        records.append(Record(time, np.ascontiguousarray(position), reference, reference))
    return records


class Line:
    """Springs between particles on a line, counted from the gripper."""

    def __init__(self, springs: SpringsConfig, particles: int):
        self.config = springs
        self.spacing = springs.length / (particles - 1)
        share = np.ones(particles)  # half of each neighbouring edge
        share[[0, -1]] = 0.5
        self.mass: Array = springs.mass * share / share.sum()  # (P,) [kg]

    def step(self, x: Array, v: Array, held: Array, drag: float, h: float) -> tuple[Array, Array]:
        """(position, velocity) (E, P, 3) after h [s]; `held` (E, HELD, 3) is where the jaws are then."""
        v = v + h * (self.force(x, v) / self.mass[:, None] - drag * v)
        v[..., 2] += h * STANDARD_GRAVITY[2]
        # Contact: no penetration after the step; friction takes at most mu times the normal change of velocity.
        gap = x[..., 2]
        stop = np.maximum(-np.maximum(gap, 0.0) / h - v[..., 2], 0.0)
        slide = np.sqrt(v[..., 0] ** 2 + v[..., 1] ** 2 + 1e-18)
        keep = 1.0 - np.minimum(self.config.friction * stop / slide, 1.0)
        v[..., :2] *= keep[..., None]
        v[..., 2] += stop
        moved = x + h * v
        moved[..., 2] += np.maximum(-gap, 0.0)
        v[:, :HELD] = (held - x[:, :HELD]) / h
        moved[:, :HELD] = held
        return moved, v

    def force(self, x: Array, v: Array) -> Array:
        """(E, P, 3) [N]: k (l / l0 - 1) + c dl/dt along each spring."""
        force = np.zeros_like(x)
        for reach in range(1, self.config.reach + 1):
            d = x[:, reach:] - x[:, :-reach]
            length = np.sqrt(np.einsum("epk,epk->ep", d, d))
            rate = np.einsum("epk,epk->ep", v[:, reach:] - v[:, :-reach], d) / length
            tension = self.config.stiffness * (length / (reach * self.spacing) - 1.0) + self.config.damping * rate
            pull = (tension / length)[..., None] * d
            force[:, :-reach] += pull
            force[:, reach:] -= pull
        return force


def _laid(motion: Motion, length: float, particles: int) -> Array:
    """First positions (P, 3) [m]: straight down, or slanting to the ground and flat on it."""
    spacing = length / (particles - 1)
    angle = laid_angles(motion, particles - 1, spacing, HELD - 1, 0.5e-3)
    yaw = float(motion.home[3])
    step = np.stack([-np.sin(angle) * np.cos(yaw), -np.sin(angle) * np.sin(yaw), -np.cos(angle)], axis=-1)
    return motion.home[:3] + spacing * np.concatenate([np.zeros((1, 3)), np.cumsum(step, axis=0)])


def _down(rotation: Array) -> Array:
    """The gripper's -z axis (..., 3) in world of rotations (..., 4) wxyz."""
    w, x, y, z = (rotation[..., k] for k in range(4))
    return -np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=-1)
