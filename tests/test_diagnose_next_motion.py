"""The motion that tells two causes apart: safe, better than another, and a plan that an arm takes."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import ArrayLike
from report_cases import LINEAR, NOISE, PERIOD, answer, drag, recorded, rope

from pred_core.arm.limits import GuardConfig
from pred_core.arm.plan_file import load_plan
from pred_core.arm.plan_needs import as_parameters, needs_of
from pred_core.config import load_yaml
from pred_core.diagnose.apart import Rolled, separation
from pred_core.diagnose.motion_file import write_motion
from pred_core.diagnose.motions import FAST, LONGEST, Limits, library, limits_of
from pred_core.diagnose.next_motion import compare, propose, rivals_of
from pred_core.errors import ConfigError, InputError
from pred_core.frames import quaternion_from_rotation_vector
from pred_core.springmass import SpringMass
from pred_core.twin import Twin
from pred_core.types import Array, Episode, Grip, State

SPLITS = ("train",) * 5 + ("test",) * 3


@pytest.fixture(scope="module")
def twin() -> Twin:
    return rope()


@pytest.fixture(scope="module")
def dragged(twin: Twin) -> list[Episode]:
    return recorded(twin, drag(), SPLITS)


def rolled(x: ArrayLike, slopes: ArrayLike | None = None, spread: float = 0.0) -> Rolled:
    """One motion, two frames, three particles; x and slopes broadcast."""
    position = torch.zeros(1, 2, 3, 3) + torch.as_tensor(np.asarray(x), dtype=torch.float32)
    strengths = torch.zeros(0, 1, 2, 3, 3)
    if slopes is not None:
        strengths = torch.as_tensor(np.asarray(slopes)).float().expand(1, 1, 2, 3, 3)
    return Rolled(position, strengths, torch.full((1, 2, 3), spread))


def test_the_distance_is_counted_in_noise_over_free_particles() -> None:
    """3 mm apart along x, noise 1 mm, two frames, two free particles of three: 2 * 2 * 3^2 = 36. With a spread of
    (2 mm)^2 in one of the two, CHAOS 1.5 times its mean makes 1 + 1.5 * 2 = 4 mm^2: 36 / 4 = 9.
    """
    free = torch.tensor([False, True, True])
    d = separation(rolled([0.003, 0.0, 0.0]), rolled(0.0), 1e-3, free)
    assert d.squared[0] == pytest.approx(36.0, rel=1e-5)
    assert d.remaining[0, 0, 1] == pytest.approx([0.003, 0.0, 0.0], abs=1e-9)
    shaken = separation(rolled([0.003, 0.0, 0.0], spread=4e-6), rolled(0.0), 1e-3, free)
    assert shaken.squared[0] == pytest.approx(9.0, rel=1e-5)


def test_what_another_strength_explains_does_not_count() -> None:
    """If one standard deviation of the rival's strength makes the whole difference, W = 36 shrinks to the least of
    36 (1 - t)^2 + t^2, which is 36 / 37 at t = 36 / 37. A motion over which a rival diverges tells nothing.
    """
    free = torch.tensor([False, True, True])
    d = separation(rolled([0.003, 0.0, 0.0]), rolled(0.0, slopes=[0.003, 0.0, 0.0]), 1e-3, free)
    assert d.squared[0] == pytest.approx(36.0 / 37.0, rel=1e-4)
    assert separation(rolled(np.nan), rolled(0.0), 1e-3, free).squared[0] == 0.0


@pytest.mark.parametrize("seed", range(12))
def test_every_motion_stays_in_the_visited_box_and_within_the_shown_speeds(seed: int) -> None:
    """For drawn limits, poses and one or two grippers; and all start and end at rest. Differences over one frame at
    most reach the peak; 2 % for sampling a jerk-limited path.
    """
    rng = np.random.default_rng(seed)
    count = 1 + seed % 2
    low, size = rng.uniform(-0.3, 0.3, (count, 3)), rng.uniform(0.0, 0.5, (count, 3))
    speed, acceleration, turn_speed, turned = rng.uniform((0.05, 0.3, 0.2, 0.0), (0.8, 4.0, 2.0, 1.0))
    limits = Limits(low, low + size, speed, acceleration, turn_speed, turned)
    at = torch.tensor(low + size * rng.uniform(0, 1, (count, 3)))
    turn = quaternion_from_rotation_vector(torch.tensor(rng.normal(0.0, 0.5, (count, 3))))
    over = np.array([np.cos(seed), np.sin(seed), 0.0])
    grip = Grip(at, turn, torch.ones(count, dtype=torch.bool))
    motions = library(grip, 0, limits, PERIOD, np.array([0.0, 0.0, -1.0]), over, seed % 3 == 0)
    assert len({m.name for m in motions}) == len(motions) > 3
    for m in motions:
        x = np.concatenate((at.numpy()[None], m.position))
        assert len(m.position) == round(LONGEST / PERIOD)
        assert (x >= low - 1e-9).all() and (x <= low + size + 1e-9).all(), m.name
        speed = np.linalg.norm(np.diff(x, axis=0), axis=-1) / PERIOD
        assert speed.max() <= 1.02 * limits.speed, m.name
        acceleration = np.linalg.norm(np.diff(x, 2, axis=0), axis=-1) / PERIOD**2
        assert acceleration.max() <= 1.02 * limits.acceleration, m.name
        q = np.concatenate((turn.numpy()[None], m.rotation))
        angle = 2.0 * np.arccos(np.clip(np.abs((q[1:] * q[:-1]).sum(-1)), 0.0, 1.0))
        assert angle.max() / PERIOD <= 1.02 * limits.turn_speed + 1e-6, m.name
        away = 2.0 * np.arccos(np.clip(np.abs((q * q[:1]).sum(-1)), 0.0, 1.0))
        assert away.max() <= limits.turn + 1e-6, m.name
        assert np.abs(x[-1] - x[-2]).max() < 1e-9 and speed[0].max() < 0.2 * limits.speed


def test_limits_are_what_the_recordings_show(twin: Twin) -> None:
    """A gripper that goes 10 cm along x in a second at constant speed, then rests: 0.1 m/s and that box."""
    e = recorded(twin, (), ("train",), size=0.0)[0]
    way = 0.1 * np.minimum(PERIOD * np.arange(len(e.stamps)), 1.0)
    place = e.grips.position.clone()
    place[:, 0, 0] = torch.tensor(way)
    bound = limits_of([dataclasses.replace(e, grips=Grip(place, e.grips.rotation, e.grips.closed))])
    assert bound.speed == pytest.approx(0.1, rel=1e-3) and bound.turn_speed == pytest.approx(0.0, abs=1e-6)
    assert bound.high[0, 0] - bound.low[0, 0] == pytest.approx(0.1, rel=1e-6)


def test_the_chosen_motion_convicts_the_wrong_law_better_than_a_random_one(twin: Twin, dragged: list[Episode]) -> None:
    """Linear against quadratic drag. Each motion is carried out with the linear law and noise, then the
    quadratic law is fitted to that recording alone: what it leaves must be, in the chosen motion, at least twice what
    it leaves in a random one (the mean over the library), and nearly the most that any motion can tell.
    """
    pair = rivals_of(answer(twin, dragged, "group"))
    assert pair is not None
    tried = compare(twin, pair, dragged, NOISE, 0)
    assert tried is not None
    best = int(tried.separation.squared.argmax())
    truth = carried_out(twin, tried, drag())
    truth = truth + np.random.default_rng(5).normal(0.0, NOISE, truth.shape)
    guesses = np.stack([carried_out(twin, tried, drag("drag_quadratic", c)) for c in np.geomspace(0.5, 12.0, 40)])
    left = (((guesses - truth) / NOISE) ** 2).sum(axis=(2, 3, 4)).min(axis=0)  # (M,) a chi-square
    excess = left - np.prod(truth.shape[1:])
    assert excess[best] > 2.0 * excess.mean()
    assert excess[best] > 0.5 * excess.max()


def carried_out(twin: Twin, tried, extensions) -> Array:  # type: ignore[no-untyped-def]
    """(M, K, N - 1, 3) [m] free particles over every motion, begun after three seconds of rest."""
    count, start = len(tried.motions), tried.starts[0]
    assert len(tried.starts) == 1
    simulator = SpringMass(twin.body, twin.physics, twin.scene, period=PERIOD, extensions=extensions)
    state = State(*(v.expand(count, *v.shape).contiguous() for v in (start.state.position, start.state.velocity,
                                                                     start.state.held)))  # fmt: skip
    grip = Grip(*(v.expand(count, *v.shape) for v in (start.grip.position, start.grip.rotation, start.grip.closed)))
    still = Grip(*(v.expand(90, *v.shape) for v in (grip.position, grip.rotation, grip.closed)))
    _, rested = simulator.rollout_states(simulator.start(state, grip), still)
    position = torch.tensor(np.stack([m.position for m in tried.motions], axis=1)).float()
    rotation = torch.tensor(np.stack([m.rotation for m in tried.motions], axis=1)).float()
    moved = simulator.rollout(rested, Grip(position, rotation, torch.ones(*position.shape[:-1], dtype=torch.bool)))
    return moved[:, :, 1:].movedim(0, 1).double().numpy()


def test_a_proposal_is_quick_and_names_what_it_separates(twin: Twin, dragged: list[Episode]) -> None:
    begin = time.process_time()
    motion = propose(answer(twin, dragged, "group"), dragged)
    assert motion is not None and time.process_time() - begin < 5.0
    assert [r["id"] for r in motion["rivals"]] == ["drag_linear", "drag_quadratic"]
    assert motion["tried"][0]["name"] == motion["name"] and motion["distance_mm"] > 0.0
    sigmas = [t["distance_sigma"] for t in motion["tried"]]
    assert sigmas == sorted(sigmas, reverse=True)
    again = propose(answer(twin, dragged, "group"), dragged)
    assert again == motion


def test_rivals_are_the_group_then_the_runner_up_then_the_ends_of_a_wide_interval(
    twin: Twin, dragged: list[Episode]
) -> None:
    near = answer(twin, dragged)
    assert [r.id for r in rivals_of(near) or ()] == ["drag_linear", "drag_quadratic"]
    far = dataclasses.replace(near, ranking=tuple(dataclasses.replace(r, probability=0.0) for r in near.ranking))
    assert rivals_of(far) is None  # an interval of 0.1 around 1.5 is narrow
    wide = answer(twin, dragged, width=2.0)
    ends = rivals_of(dataclasses.replace(wide, ranking=far.ranking))
    assert ends is not None and [r.id for r in ends] == ["drag_linear"] * 2
    values = [next(iter(r.values.values())) for r in ends]
    assert values == pytest.approx([LINEAR - 1.0, LINEAR + 1.0])
    assert rivals_of(answer(twin, dragged, "none")) is None


def test_what_a_plan_needs_of_an_arm() -> None:
    """1 m/s for a tenth of a second from rest to rest, in steps of 0.05 s: 1 m/s / 0.05 s = 20 m/s^2 at either end. A
    quarter turn in 0.1 s is 15.71 rad/s, rounded up."""
    times, half = np.array([0.0, 0.05, 0.1, 0.15]), np.sqrt(0.5)
    position = np.array([[0.0, 0, 0], [0.05, 0, 0], [0.1, 0, 0], [0.1, 0, 0]])
    turned = [np.cos(np.pi / 8), 0.0, 0.0, np.sin(np.pi / 8)]
    rotation = np.array([[1.0, 0, 0, 0], turned, [half, 0, 0, half], [half, 0, 0, half]])
    needs = needs_of(times, position, rotation)
    assert (needs["speed"], needs["acceleration"], needs["lifetime"]) == (1.0, 20.0, 1.15)
    assert (needs["angular_speed"], needs["angular_acceleration"]) == (15.71, 314.16)
    said = as_parameters(needs, GuardConfig())
    assert said == "-p speed:=1 -p acceleration:=20 -p angular_speed:=15.71 -p angular_acceleration:=314.16"


def test_nothing_is_proposed_for_a_gripper_that_stood_still(twin: Twin) -> None:
    """There is no box to move in and no speed that was shown."""
    still = recorded(twin, drag(), SPLITS, size=0.0)
    assert propose(answer(twin, still, "group"), still) is None


def test_an_arm_takes_the_plan_from_the_file(twin: Twin, dragged: list[Episode], tmp_path: Path) -> None:
    """At the speed that was shown; it is refused whole by an arm that may only creep, which is told what it needs."""
    d = answer(twin, dragged, "group")
    motion = propose(d, dragged)
    assert motion is not None
    write_motion(tmp_path / "next_motion.yaml", motion)
    bound = motion["limits"]
    edges = {f"{a}_{e}": bound[e][0][k] for k, a in enumerate("xyz") for e in ("low", "high")}
    box = {k: v + (0.01 if k.endswith("high") else -0.01) for k, v in edges.items()}
    allowed = GuardConfig(speed=bound["speed"], angular_speed=max(bound["turn_speed"], 0.02), table=-1.0, **box)
    plan = load_plan(tmp_path / "next_motion.yaml", 7_000_000_000, allowed)
    assert plan.ends_at_rest and plan.begin == 7_000_000_000
    assert plan.end == pytest.approx(plan.begin + 1e9 * LONGEST, abs=2e8)
    e = next(e for e in dragged if e.name == motion["start"]["episode"])
    assert plan.position[0] == pytest.approx(e.grips.position[motion["start"]["frame"], 0].numpy(), abs=1e-6)
    with pytest.raises(InputError, match="too fast for this arm's guard; got .*allowed: 0.001 m/s") as refused:
        load_plan(tmp_path / "next_motion.yaml", 0, dataclasses.replace(allowed, speed=0.001))
    written = load_yaml(tmp_path / "next_motion.yaml")["arm"]
    assert f"-p speed:={written['speed']:g}" in str(refused.value)
    assert 0.9 * FAST * bound["speed"] < written["speed"] <= bound["speed"] + 0.01
    assert written["acceleration"] <= 1.1 * bound["acceleration"] + 0.01
    given = {k: max(v, getattr(GuardConfig(), k)) for k, v in written.items() if k != "lifetime"}
    enough = dataclasses.replace(allowed, **given)
    assert load_plan(tmp_path / "next_motion.yaml", 0, enough).times[-1] < written["lifetime"]
    assert as_parameters(written, enough) == f"-p lifetime:={written['lifetime']:g}"
    (tmp_path / "other.yaml").write_text("trajectory: {points: [1]}\n")
    with pytest.raises(ConfigError, match="not a motion"):
        load_plan(tmp_path / "other.yaml", 0, allowed)
