"""`pred plan` and offline plans on a simulated rope: it gets there, writes its files, refuses what it cannot use."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch

from pred_core.cli.main import main
from pred_core.errors import InputError, TwinError
from pred_core.plan.config import CostConfig, PlannerConfig, SearchConfig
from pred_core.plan.endpoints import read_cloud, rest_observation
from pred_core.plan.latency import Observation, departure
from pred_core.plan.offline import carry_out, settled
from pred_core.plan.rollouts import Rollouts
from pred_core.plan.session import Session, Timing
from pred_core.plan.slot import Slot
from pred_core.plan.task import load_settings, make_planner, planning_dynamics, scene_with_slot
from pred_core.pred import COUNT, PReD
from pred_core.residual import ResidualConfig, build_network
from pred_core.springmass import build_body
from pred_core.twin import Twin, TwinMeta
from pred_core.types import Grip, ObjectInfo, Physics, Scene

ROOT = Path(__file__).parents[1]
WAY = np.array([0.06, 0.1, -0.05])  # [m] of the gripper in the motion that made the goal


@pytest.fixture(scope="module")
def twin() -> Twin:
    """A rope of 16 particles, held at one end 20 cm above a table, that hangs and lies."""
    x = np.zeros((16, 3))
    x[:, 0], x[:, 2] = np.linspace(0.45, -0.05, 16), 0.2
    physics = Physics(stiffness=60.0, damping=0.1, connection_threshold=0.05, max_springs=4, bending_stiffness=3e-4)
    body = build_body("line", x, 0.04, physics, radius=0.004)
    meta = TwinMeta(object=ObjectInfo("rope", "line"), period=1 / 30, held=((0, 0), (1, 0)))
    return Twin(meta, body, physics, Scene(ground=0.0))


@pytest.fixture(scope="module")
def start(twin: Twin) -> Observation:
    """At rest."""
    return settled(planning_dynamics(twin, twin.scene), rest_observation(twin, None), 2.0)


@pytest.fixture(scope="module")
def goal(twin: Twin, start: Observation) -> np.ndarray:
    """Where the rope is after the gripper went along WAY in two seconds: a goal that can be reached."""
    dynamics = planning_dynamics(twin, twin.scene)
    share = np.clip(np.arange(1, 76) / 60, 0, 1)[:, None, None]
    position = torch.tensor(start.position + share**2 * (3 - 2 * share) * WAY, dtype=torch.float32)
    rotation = torch.tensor(start.rotation, dtype=torch.float32).expand(75, 1, 4)
    state = dynamics.start(start.state, Grip(torch.tensor(start.position).float(), rotation[0], start.closed()))
    grips = Grip(position[:, None], rotation[:, None], start.closed().expand(75, 1, 1))
    lead = dataclasses.replace(
        state, position=state.position[None], velocity=state.velocity[None], held=state.held[None],
        memory={k: v[None] for k, v in state.memory.items()},
    )  # fmt: skip
    return dynamics.rollout(lead, grips)[-1, 0].double().numpy()


QUICK = PlannerConfig(search=SearchConfig(samples=32, iterations=4))


def test_a_rope_is_brought_to_a_goal_that_can_be_reached(twin: Twin, start: Observation, goal: np.ndarray) -> None:
    planner = make_planner(twin, goal, QUICK, seed=0)
    world = planning_dynamics(twin, twin.scene)
    run = carry_out(planner, world, start, replans=6, step=0.5, report=lambda *_: None)
    assert run.distance[0] > 0.08
    # Chamfer distances add two sides; particles are 33 mm apart, so 10 mm is a rope that lies on its goal.
    assert run.distance[-1] < 0.010
    assert np.linalg.norm(run.gripper[-1, 0] - run.gripper[0, 0] - WAY) < 0.03
    speed = np.linalg.norm(np.diff(run.gripper[:, 0], axis=0), axis=-1) / run.period
    assert speed.max() <= QUICK.motion.speed * 1.02  # also across the borders of plans


def test_the_hand_goes_around_a_post(twin: Twin, start: Observation, goal: np.ndarray) -> None:
    """A post of 4 cm stands in the straight way; without the collision cost the hand hits it."""
    middle = start.position[0] + 0.5 * WAY
    slot = Slot(x=float(middle[0]), y=float(middle[1]), yaw=1.03, gap=0.002, width=0.02, thickness=0.02, height=0.3)
    depth = {}
    for weight in (0.0, 20.0):
        config = dataclasses.replace(QUICK, slot=slot, costs=CostConfig(collision=weight))
        scene = scene_with_slot(Scene(ground=0.0), config)
        planner = make_planner(twin, goal, config, seed=0, dynamics=planning_dynamics(twin, Scene(ground=0.0)))
        judge = make_planner(twin, goal, dataclasses.replace(config, costs=CostConfig(collision=1.0)), seed=0)
        collision = next(c for c in judge.objective.costs if c.name == "collision")
        plan = planner.plan(start)
        times = np.arange(1, 61) / 30
        position, rotation = plan.curve.poses(times)
        places, turns = (torch.tensor(v).float()[:, None] for v in (position, rotation))
        grip = Grip(places, turns, torch.ones(60, 1, 1))
        far = torch.full((60, 1, 16, 3), 5.0)
        rolled = Rollouts(1 / 30, far, grip, plan.curve.knots[:, None], 0.25, (59,))
        depth[weight] = float(collision.hand_inside(rolled).mean())  # type: ignore[attr-defined]
        assert len(scene.fixtures) == 2
    assert depth[0.0] > 0.002 and depth[20.0] < 0.2 * depth[0.0]


def test_the_command_writes_plan_and_report(
    tmp_path: Path, twin: Twin, goal: np.ndarray, capsys: pytest.CaptureFixture
) -> None:
    twin.save(tmp_path / "twin")
    np.save(tmp_path / "goal.npy", goal)
    (tmp_path / "quick.yaml").write_text("search: {samples: 16, iterations: 2}\n")
    code = main([
        "plan", str(tmp_path / "twin"), "--goal", str(tmp_path / "goal.npy"), "--settle", "1", "--out",
        str(tmp_path / "out"), "--settings", str(tmp_path / "quick.yaml"), "--replans", "2", "--seed", "3",
    ])  # fmt: skip
    assert code == 0
    plan = json.loads((tmp_path / "out" / "plan.json").read_text())
    trajectory = plan["trajectory"]
    assert len(trajectory["time"]) == len(trajectory["position"]) == len(plan["distance_m"]["each_frame"])
    assert np.allclose(np.linalg.norm(trajectory["rotation_wxyz"], axis=-1), 1.0, atol=1e-5)
    assert plan["replans"] == 2 and plan["motions"] == 64 and plan["settings"]["search"]["samples"] == 16
    assert plan["distance_m"]["end"] < plan["distance_m"]["start"]
    page = (tmp_path / "out" / "plan.html").read_text()
    assert "pred-animation" in page and page.count("<svg") + page.count("svg+xml") >= 2
    assert "mm from the goal" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "no goal was given"),
        (["--shift", "5", "0", "0"], "goal is out of reach"),
        (["--goal", "empty.npy"], "the goal is empty"),
        (["--goal", "nowhere.npy"], "nowhere.npy: cannot be read"),
        (["--goal", "goal.png"], "unknown kind of cloud"),
        (["--shift", "0", "0", "0", "--settings", "typo.yaml"], "did you mean 'samples'?"),
        (["--shift", "0", "0", "0", "--held", "x"], "--held"),
        (["--shift", "0", "0", "0", "--held", "0:0 0:1"], "--held names a particle twice"),
        (["--shift", "0", "0", "0", "--held", "99:0"], "does not have"),
        (["--shift", "0", "0", "0", "--replans", "0"], "pred: --replans; got 0; allowed: 1 or more."),
        (["--shift", "0", "0", "0", "--seed", "-1"], "pred: --seed; got -1; allowed: 0 or more."),
        (["--shift", "0", "0", "0", "--step", "nan"], "pred: --step; got nan; allowed: above 0 s."),
        (["--shift", "0", "0", "0", "--settle", "61"], "pred: --settle; got 61.0; allowed: 0 to 60 s."),
        (["--shift", "0", "0", "0", "--device", "cuda"], "pred: --device; got cuda; allowed: cpu. Without"),
        (["--shift", "0", "0", "0", "--step", "1.5"], "followed longer than it is sent"),
        (["--shift", "0", "0", "0", "--settings", "passage.yaml"], "needs a slot"),
    ],
)
def test_unusable_input_is_one_line_and_code_2(
    tmp_path: Path, twin: Twin, arguments: list[str], words: str, capsys: pytest.CaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    twin.save(Path("twin"))
    np.save("empty.npy", np.zeros((0, 3)))
    Path("typo.yaml").write_text("search: {sample: 16}\n")
    Path("passage.yaml").write_text("costs: {passage: 1.0}\n")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert main(["plan", "twin", "--out", "out", *arguments]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and words in lines[0]
    assert not Path("out").exists()


def test_planning_with_a_residual_continues_its_memory(twin: Twin, start: Observation, goal: np.ndarray) -> None:
    """The state a plan begins at carries the residual's window: two periods after the observation, two estimates."""
    sizes = dict.fromkeys(("feature", "encoder_feedforward", "hidden", "embedding", "feedforward"), 16)
    small = ResidualConfig(encoder_layers=1, **sizes)
    network = build_network(small, seed=0).eval()
    dynamics = PReD(planning_dynamics(twin, twin.scene), network, twin.body)
    later = departure(dynamics, start, start.stamp + 2 * round(1e9 / 30), None)
    assert int(later.state.memory[COUNT]) == 2
    quick = dataclasses.replace(QUICK, search=SearchConfig(samples=16, iterations=1, chunk=8))
    plan = make_planner(twin, goal, quick, 0, dynamics=dynamics).plan(start)
    assert plan.motions == 16 and plan.cost <= plan.still


def test_settings_that_ship_can_be_read() -> None:
    for path in sorted((ROOT / "config" / "plan").glob("*.yaml")):
        assert load_settings(str(path)).costs.goal > 0.0
    assert load_settings(str(ROOT / "config" / "plan" / "slot.yaml")).slot is not None


def test_a_cloud_is_read_from_text(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("0.1,0.2,0.3\n0.4,0.5,0.6\n")
    assert read_cloud(tmp_path / "a.csv").tolist() == [[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]]
    (tmp_path / "b.csv").write_text("a,b,c\n")
    with pytest.raises(InputError, match="cannot be read"):
        read_cloud(tmp_path / "b.csv")


def test_a_twin_that_holds_nothing_needs_held(twin: Twin) -> None:
    free = twin.replace(meta=dataclasses.replace(twin.meta, held=()))
    with pytest.raises(TwinError, match="Give --held"):
        rest_observation(free, None)
    with pytest.raises(TwinError, match="hold nothing"):
        rest_observation(free, {0: 1})


def test_session_drops_late_plans_and_keeps_no_plan_that_was_not_sent(
    twin: Twin, start: Observation, goal: np.ndarray
) -> None:
    now = [start.stamp]
    timing = Timing(budget=0.05, margin=0.02)

    def make(points: np.ndarray):
        return make_planner(twin, points, QUICK, 0)

    session = Session(make, timing, lambda: now[0])
    with pytest.raises(InputError, match="there is no goal"):
        session.replan(start)
    session.set_goal(goal)
    assert session.replan(start) is None  # the first, slow run
    plan = session.replan(start)
    assert plan is not None and plan.start >= now[0] + 50_000_000 and session.in_force is None
    session.commit(plan)
    now[0] = plan.start + 100_000_000
    stop = session.stop()
    assert stop is not None and session.in_force is None
    before, after = plan.at(stop.start), stop.at(stop.start)
    assert after.position == pytest.approx(before.position, abs=1e-12)
    assert after.velocity == pytest.approx(before.velocity, abs=1e-9)
    assert np.abs(stop.at(stop.end).velocity).max() == 0.0
    assert session.stop() is None
    clock = iter(range(10**9, 10**12, 10**9))
    late = Session(make, dataclasses.replace(timing, max_age=60.0), lambda: next(clock))  # a second passes a look
    late.set_goal(goal)
    late.replan(dataclasses.replace(start, stamp=10**9))
    assert late.replan(dataclasses.replace(start, stamp=3 * 10**9)) is None and late.counts.late == 1
