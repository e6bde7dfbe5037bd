"""`pred plant rope`: the MuJoCo rope with something hidden in its world, as a data set."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from pred_core.bag.dataset import Dataset
from pred_core.config import to_mapping
from pred_core.errors import ConfigError
from pred_core.plant.case import Progress, write_case
from pred_core.plant.hidden.effect import HiddenEffect
from pred_core.plant.hidden.library import check_magnitude, find_entry, make_effect
from pred_core.plant.rope import RopeConfig, build_rope
from pred_core.plant.sensing import SensorConfig
from pred_core.plant.session import EpisodePlan, SessionConfig
from pred_core.plant.world import Record, World, run_episode

Hidden = tuple[tuple[str, float], ...]  # effect name, magnitude


def write_rope_case(
    root: Path,
    hidden: Hidden,
    seed: int,
    progress: Progress,
    *,
    session: SessionConfig | None = None,
    sensor: SensorConfig | None = None,
    rope: RopeConfig | None = None,
) -> Dataset:
    """Write the data set of a seed with the hidden effects in it. Finished bags of the same case are kept.

    Raises: ConfigError for an unknown effect or a magnitude out of range; DatasetError if `root` holds something else.
    """
    session, sensor, rope = session or SessionConfig(), sensor or SensorConfig(), rope or RopeConfig()
    for name, magnitude in hidden:
        check_magnitude(find_entry(name), magnitude)
    if len({name for name, _ in hidden}) != len(hidden):
        raise ConfigError("hidden effects", got=", ".join(n for n, _ in hidden), allowed="each once")

    def simulate(plans: Sequence[EpisodePlan]) -> Iterator[tuple[EpisodePlan, Record, Sequence[HiddenEffect]]]:
        for plan in plans:
            record, effects = simulate_rope(plan, hidden, seed, session.seconds, session.particles, rope)
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
        },
        simulate=simulate,
        session=session,
        sensor=sensor,
        seed=seed,
        known={"mass": rope.mass, "rest_length": rope.length, "radius": rope.radius, "ground": 0.0},
        progress=progress,
    )


def simulate_rope(
    plan: EpisodePlan, hidden: Hidden, seed: int, seconds: float, particles: int, rope: RopeConfig | None = None
) -> tuple[Record, tuple[HiddenEffect, ...]]:
    """One episode in MuJoCo: what happened, and the effects, fresh for this episode, that act on its measurement."""
    effects = tuple(make_effect(name, magnitude, seed, place) for place, (name, magnitude) in enumerate(hidden))
    built = build_rope(rope or RopeConfig(), reversed=plan.motion.variant == "regrasp")
    world = World(built, effects, plan.start)
    return run_episode(world, plan.motion, seconds, particles), effects
