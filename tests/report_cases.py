"""A hanging rope, recorded with a planted cause, and a small diagnosis of it put together by hand."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from pred_core.diagnose.errors import EpisodeErrors, episode_errors, gain_of
from pred_core.diagnose.evidence import Judged
from pred_core.diagnose.gate import GateCause, GateResult
from pred_core.diagnose.progress import Round
from pred_core.diagnose.result import Cause, Diagnosis, Errors, Ranked, Value
from pred_core.diagnose.trial import make_trial
from pred_core.effects import find_effect
from pred_core.frames import quaternion_from_rotation_vector
from pred_core.springmass import SpringMass, build_body
from pred_core.twin import Calibration, Extension, Twin, TwinMeta
from pred_core.types import Array, Episode, Grip, ObjectInfo, Physics, Scene, State, Tracks

COUNT, EDGE, PERIOD, NOISE = 10, 0.05, 1.0 / 30.0, 3e-4
HOME = np.array([0.0, 0.0, 0.8])  # [m]
LINEAR, QUADRATIC = 1.5, 2.0  # [1/s], [1/m]


def rope() -> Twin:
    """Ten particles, 45 cm, held at the first one, hanging from the gripper above a table that it does not reach."""
    rest = np.zeros((COUNT, 3))
    rest[:, 2] = -EDGE * np.arange(COUNT)
    physics = Physics(stiffness=20.0, damping=0.02, connection_threshold=1.5 * EDGE, max_springs=4)
    body = build_body("line", rest, 0.05, physics)
    return Twin(TwinMeta(object=ObjectInfo("rope", "line"), period=PERIOD), body, physics, Scene(ground=0.0))


def drag(id: str = "drag_linear", coefficient: float = LINEAR) -> tuple[Extension, ...]:
    """Drag with this coefficient."""
    return (find_effect(id).extension(coefficient=(coefficient,)),)


def motion(seed: int, frames: int, size: float = 0.08) -> tuple[Array, Array]:
    """A sway that begins at rest at HOME: places (T, 3) [m], rotation vectors (T, 3) [rad]."""
    rng, time = np.random.default_rng(seed), PERIOD * np.arange(frames)[:, None]
    fade = np.clip(time / 0.5, 0.0, 1.0) ** 2
    rate, phase = rng.uniform(0.4, 1.0, 6), rng.uniform(0.0, 6.28, 6)
    sway = fade * (np.sin(6.28 * rate * time + phase))
    return HOME + size * sway[:, :3] * (1.0, 1.0, 0.3), 5.0 * size * sway[:, 3:]


def recorded(
    twin: Twin, truth: Sequence[Extension], splits: Sequence[str], seed: int = 0, frames: int = 70, size: float = 0.08
) -> list[Episode]:
    """One episode a split, of the twin with `truth`, all in one batch; tracks have NOISE."""
    moves = [motion(seed + e, frames, size) for e in range(len(splits))]
    place = torch.tensor(np.stack([m[0] for m in moves], axis=1), dtype=torch.float32)[:, :, None]
    turn = quaternion_from_rotation_vector(torch.tensor(np.stack([m[1] for m in moves], axis=1)).float())[:, :, None]
    grips = Grip(place, turn, torch.ones(*place.shape[:-1], dtype=torch.bool))
    simulator = SpringMass(twin.body, twin.physics, twin.scene, period=PERIOD, extensions=tuple(truth))
    held = np.full(COUNT, -1, dtype=np.int32)
    held[0] = 0
    hanging = torch.tensor(twin.body.rest_position).float() + place[0]
    state = State(hanging, torch.zeros_like(hanging), torch.tensor(held).expand(len(splits), COUNT).contiguous())
    positions = simulator.rollout(simulator.start(state, grips.at(0)), grips.span(1, frames))
    x = torch.cat((hanging[None], positions)).double().numpy()
    x = x + np.random.default_rng(seed).normal(0.0, NOISE, x.shape)
    stamps = [np.asarray(1_000_000_000 * (1 + 10 * e) + 1e9 * PERIOD * np.arange(frames)).astype(np.int64)
              for e in range(len(splits))]  # fmt: skip
    seen = np.ones((frames, COUNT), dtype=bool)
    return [
        Episode(f"ep{e}", ObjectInfo("rope", "line"), stamps[e],
                Tracks(stamps[e], x[:, e], np.arange(COUNT, dtype=np.uint32), seen, seen.astype(np.float32)),
                Grip(grips.position[:, e], grips.rotation[:, e], grips.closed[:, e]), held, split, e)
        for e, split in enumerate(splits)
    ]  # fmt: skip


def judged(twin: Twin, id: str, coefficient: float, width: float, gain: Sequence[float]) -> Judged:
    """A fitted drag, its 90 % interval `width` wide."""
    trial = make_trial(twin, (find_effect(id),))
    knob = trial.space.knobs[0]
    return Judged(
        trial=trial,
        values={knob.name: coefficient},
        null={knob.name: 0.0},
        intervals={knob.name: (coefficient - width / 2, coefficient + width / 2)},
        gain=np.array(gain, dtype=float),
        acts=np.ones(len(gain), dtype=bool),
        extended=10.0 - np.array(gain, dtype=float),
        z=np.array([knob.coordinate(coefficient)]),
    )


def answer(twin: Twin, episodes: Sequence[Episode], outcome: str = "named", width: float = 0.1) -> Diagnosis:
    """A diagnosis of `episodes`, errors on those that are 'test' or on all: linear drag, quadratic drag behind it."""
    count = sum(e.split != "ood" for e in episodes)
    gains = np.linspace(1.0, 2.0, count)
    first = judged(twin, "drag_linear", LINEAR, width, gains.tolist())
    second = judged(twin, "drag_quadratic", QUADRATIC, width, (0.8 * gains).tolist())
    why = "" if outcome in ("named", "group") else "not significant (adjusted p 0.3)"
    rows = ((first, 0.001, why), (second, 0.001, why))
    seen = Round(np.full(count, 2.0), 0.2, (("drag_linear", 1.0), ("drag_quadratic", 0.9), ("wind", 0.2)), rows)
    group = ("drag_quadratic",) if outcome == "group" else ()
    span = Value(LINEAR, "1/s", LINEAR - width / 2, LINEAR + width / 2)
    cause = Cause("drag_linear", "drag", 0.9, {"coefficient": span}, False, 0.9, 0.001, group)
    named = outcome in ("named", "group")
    found = twin.replace(extensions=drag()) if named else twin
    test = [e for e in episodes if e.split == "test"] or list(episodes)
    base, extended = episode_errors(twin, test), episode_errors(found, test)
    errors = Errors(test[0].split, base, extended, 1.0, gain_of(base, extended, 0))
    spans = {"delay": ((-0.002, 0.004),)}
    delay = GateCause("delay", False, True, "small", "s", {"delay": (0.001,)}, spans, 0.5, 0.9, 0.2)
    gate = GateResult(
        (delay, GateCause("gripper_offset", False, False, "the gripper never turns")),
        Calibration(), Calibration(), NOISE, count, 0, {}, ("exploratory",),
    )  # fmt: skip
    left = max(extended.mean - 1.0, 0.0)
    return Diagnosis(
        outcome=outcome,
        sentence=f"The sentence of an answer that is {outcome}.",
        causes=(cause,) if named else (),
        ranking=(Ranked("drag_linear", "drag", 0.8, 0.9, 0.001, "" if named else "not significant"),
                 Ranked("drag_quadratic", "drag", 0.15, 0.7, 0.001, "saves less than drag_linear"),
                 Ranked("unknown", "unknown", 0.05, 0.0, 1.0, ""), Ranked("none", "none", 0.0, 0.0, 1.0, "")),
        errors=errors,
        errors_ood=None,
        budget={"named": {"drag_linear": base.mean - extended.mean} if named else {}, "learned": 0.0,
                "unexplained": left, "floor": min(1.0, extended.mean)},
        not_identifiable=("absolute mass",),
        not_testable={"gripper_offset": "the gripper never turns"},
        next_motion=None,
        exploratory=False,
        notes=(),
        gate=gate,
        rounds=(seen,),
        base_twin=twin,
        twin=found.replace(base=twin),
        seconds=1.0,
        seed=0,
    )  # fmt: skip


def with_errors(d: Diagnosis, base: Sequence[float], extended: Sequence[float], floor: float | None) -> Errors:
    """Errors [mm] of made-up episodes."""
    names = tuple(f"ep{n}" for n in range(len(base)))
    a, b = EpisodeErrors(names, np.array(base)), EpisodeErrors(names, np.array(extended))
    return Errors(d.errors.split, a, b, floor, gain_of(a, b, 0))
