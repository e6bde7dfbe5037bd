"""`pred plant rope`: the MuJoCo rope with something hidden in its world, as a data set."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from pred_core.bag.dataset import Dataset
from pred_core.config import to_mapping
from pred_core.errors import ConfigError, DivergenceError
from pred_core.plant.case import Progress, write_case
from pred_core.plant.hidden.effect import HiddenEffect
from pred_core.plant.hidden.library import check_extent, check_magnitude, find_entry, make_effect
from pred_core.plant.rope import RopeConfig, build_rope
from pred_core.plant.sensing import SensorConfig
from pred_core.plant.session import EpisodePlan, SessionConfig
from pred_core.plant.world import Record, World, run_episode

Hidden = tuple[tuple[str, float], ...]  # effect name, magnitude
PARTS = (1, 2, 4, 8)  # MuJoCo's steps in a `STEP`, one after the other until one holds
BEYOND = 1.15  # clamped lengths: how far from the end the second particle may be and count as held
BLOCKED = 1e-3  # [m] off its reference; the drive alone stays within a tenth of it


def write_rope_case(
    root: Path,
    hidden: Hidden,
    seed: int,
    progress: Progress,
    *,
    session: SessionConfig | None = None,
    sensor: SensorConfig | None = None,
    rope: RopeConfig | None = None,
    extent: float = 1.0,
) -> Dataset:
    """Write the data set of a seed with the hidden effects in it. Finished bags of the same case are kept.

    extent: times the effects' usual size in space (`make_effect`).
    Raises: ConfigError for an unknown effect or a magnitude out of range; DatasetError if `root` holds something else.
    """
    session, sensor, rope = session or SessionConfig(), sensor or SensorConfig(), rope or RopeConfig()
    check_extent(extent)
    for name, magnitude in hidden:
        check_magnitude(find_entry(name), magnitude)
    spacing, clamped = rope.length / (session.particles - 1), rope.clamped * rope.link_length
    if spacing > BEYOND * clamped:
        raise ConfigError(
            "tracked particles: the second one is not in the jaws, as `held` will say",
            got=f"{session.particles} particles, {1e3 * spacing:.0f} mm apart; {1e3 * clamped:.0f} mm are clamped",
            allowed=f"{int(np.ceil(1 + rope.length / (BEYOND * clamped)))} or more",
        )
    if len({name for name, _ in hidden}) != len(hidden):
        raise ConfigError("hidden effects", got=", ".join(n for n, _ in hidden), allowed="each once")

    def simulate(plans: Sequence[EpisodePlan]) -> Iterator[tuple[EpisodePlan, Record, Sequence[HiddenEffect]]]:
        for plan in plans:
            record, effects = simulate_rope(plan, hidden, seed, session.seconds, session.particles, rope, extent)
            yield plan, record, effects

    return write_case(
        root,
        truth={
            "world": "rope",
            "hidden": [{"effect": n, "magnitude": m, "unit": find_entry(n).unit} for n, m in hidden],
            "seed": seed,
            "session": to_mapping(session),
            "sensor": to_mapping(sensor),
            "rope": to_mapping(rope),
            "format": 1,
            **({"extent": extent} if extent != 1.0 else {}),
        },
        simulate=simulate,
        session=session,
        sensor=sensor,
        seed=seed,
        known={"mass": rope.mass, "rest_length": rope.length, "radius": rope.radius, "ground": 0.0},
        progress=progress,
    )


def simulate_rope(
    plan: EpisodePlan,
    hidden: Hidden,
    seed: int,
    seconds: float,
    particles: int,
    rope: RopeConfig | None = None,
    extent: float = 1.0,
) -> tuple[Record, tuple[HiddenEffect, ...]]:
    """One episode in MuJoCo: what happened, and the effects, fresh for this episode, that act on its measurement.

    A whip of the free end, or a rope that is laid into an obstacle, can be too fast for MuJoCo's step: such an episode,
    and no other, is simulated anew with a finer one. Raises: DivergenceError if the finest does not hold either, or if
    what is hidden keeps the gripper from where it is said to be.
    """
    for parts in PARTS:
        effects = tuple(make_effect(n, m, seed, place, extent) for place, (n, m) in enumerate(hidden))
        built = build_rope(rope or RopeConfig(), reversed=plan.motion.variant == "regrasp")
        world = World(built, effects, plan.start)
        try:
            record = run_episode(world, plan.motion, seconds, particles, parts)
        except DivergenceError as error:
            if parts == PARTS[-1]:
                raise DivergenceError(f"{plan.name}: {error}") from error
            continue
        break
    check_gripper(record, plan.name)
    return record, effects


def check_gripper(record: Record, name: str) -> None:
    """Raise DivergenceError if the gripper did not go where it was told: its recorded poses would be wrong."""
    off = float(np.linalg.norm((record.gripper - record.reference)[:, :3], axis=1).max())
    if off > BLOCKED:
        raise DivergenceError(
            f"{name}: what is hidden stands in the gripper's way",
            got=f"{1e3 * off:.1f} mm off its path",
            allowed=f"{1e3 * BLOCKED:g} mm",
            next_step="Use another seed, or a smaller magnitude",
        )
