"""Each cost against a number worked out by hand; the chamfer cost needs both its sides."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from plan_cases import settings

from pred_core.errors import ConfigError, InputError
from pred_core.metrics.chamfer import chamfer_one_sided, chamfer_two_sided
from pred_core.plan.collision_cost import CollisionCost, Hand
from pred_core.plan.config import CostConfig
from pred_core.plan.costs import Objective
from pred_core.plan.distance import distance_to
from pred_core.plan.goal import check_goal, thinned
from pred_core.plan.goal_cost import GoalCost
from pred_core.plan.motion_costs import SmoothnessCost, WorkspaceCost
from pred_core.plan.passage_cost import PassageCost
from pred_core.plan.rollouts import Rollouts
from pred_core.plan.slot import Slot
from pred_core.plan.stretch_cost import StretchCost
from pred_core.plan.task import make_objective, scene_with_slot
from pred_core.plan.through_cost import ThroughCost
from pred_core.springmass import build_body
from pred_core.springmass.reference import fixture_gap
from pred_core.types import Body, Box, Capsule, Grip, Physics, Scene, Sphere

LOW, HIGH = np.array([-1.0, -1.0, 0.0]), np.array([1.0, 1.0, 1.0])


def line_body(points: np.ndarray, radius: float = 0.0) -> Body:
    spacing = float(np.linalg.norm(points[1] - points[0]))
    return build_body("line", points, 0.05, Physics(connection_threshold=1.2 * spacing, max_springs=2), radius=radius)


def rollouts(objects: np.ndarray, grippers: np.ndarray | None = None, knots: np.ndarray | None = None) -> Rollouts:
    """K motions of one step: objects (K, N, 3), grippers (K, 3)."""
    count = len(objects)
    place = np.zeros((count, 3)) + [0.0, 0.0, 0.9] if grippers is None else grippers
    grip = Grip(
        torch.tensor(place, dtype=torch.float32)[None, :, None],
        torch.tensor([1.0, 0, 0, 0]).expand(1, count, 1, 4),
        torch.ones(1, count, 1, dtype=torch.bool),
    )
    position = torch.tensor(objects, dtype=torch.float32)[None]
    return Rollouts(0.1, position, grip, np.zeros((6, count, 1, 4)) if knots is None else knots, 0.2, (0,))


def row(count: int, spacing: float, start: tuple[float, float, float] = (0.0, 0.0, 0.3)) -> np.ndarray:
    points = np.repeat(np.array([start]), count, axis=0)
    points[:, 0] += spacing * np.arange(count)
    return points


def test_chamfer_is_two_sided() -> None:
    """A crumpled object on one end of the goal, and one that overshoots it: each fools one of the two sides."""
    goal = row(5, 0.1)  # 0 to 0.4 m
    crumpled = row(5, 0.0)  # all on the goal's first point: side object -> goal is 0
    longer = row(9, 0.1)  # 0 to 0.8 m: side goal -> object is 0
    values = GoalCost(goal, None, 0.0, 1.0)(rollouts(np.stack([crumpled, row(5, 0.1)])))
    # goal -> crumpled: mean of 0, .1, .2, .3, .4 = 0.2; object -> goal: 0.
    assert values.tolist() == pytest.approx([0.2, 0.0], abs=1e-6)
    assert chamfer_one_sided(crumpled, goal) == 0.0  # the side that a one-sided cost would have
    # object -> goal: mean of five 0 and .1, .2, .3, .4 over 9 = 1/9; goal -> object: 0.
    assert GoalCost(goal, None, 0.0, 1.0)(rollouts(longer[None])).item() == pytest.approx(1 / 9, abs=1e-6)
    assert chamfer_one_sided(goal, longer) == 0.0


def test_goal_cost_weighs_way_and_end_and_looks_at_the_surface_only() -> None:
    goal, rng = row(5, 0.1), np.random.default_rng(0)
    x = torch.tensor(goal + rng.normal(size=(3, 1, 5, 3)) * 0.05, dtype=torch.float32)
    many = dataclasses.replace(rollouts(goal[None]), position=x, frames=(0, 1, 2))
    each = [chamfer_two_sided(x[t, 0].double().numpy(), goal) for t in range(3)]
    assert GoalCost(goal, None, 1.0, 2.0)(many).item() == pytest.approx(np.mean(each) + 2 * each[-1], rel=1e-5)
    first = GoalCost(goal[:2], np.array([0, 1]), 0.0, 1.0)
    moved = goal.copy()
    moved[2:] += 5.0
    assert first(rollouts(moved[None])).item() == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(
    "fixture",
    [
        Box((0.1, -0.2, 0.3), (0.05, 0.1, 0.02), (0.8, 0.1, -0.5, 0.3)),
        Capsule((0.0, 0.0, 0.0), (0.1, 0.2, 0.1), 0.08),
        Sphere((0.1, 0.1, 0.1), 0.05),
    ],
)
def test_distance_agrees_with_the_simulators_contact(fixture: Box | Capsule | Sphere) -> None:
    points = np.random.default_rng(0).uniform(-0.4, 0.4, (2000, 3))
    expected, _ = fixture_gap(fixture, torch.tensor(points))
    found = distance_to(fixture, torch.tensor(points, dtype=torch.float32))
    assert bool((expected < 0).any())
    assert (found.double() - expected).abs().max().item() < 1e-6  # float32


def collision(scene: Scene, body: Body) -> CollisionCost:
    return CollisionCost(scene, body, Hand(0.01, 0.1, 0.03, 0.1), 1.0, margin=0.005)


def test_collision_of_object_fingers_and_table() -> None:
    body = line_body(row(3, 0.1), radius=0.002)
    scene = Scene(ground=0.0, fixtures=(Sphere((0.05, 0.0, 0.3), 0.02),))
    cost = collision(scene, body)
    # Between particles 0 and 1 the line passes through the middle of the sphere: 20 + 5 + 2 mm deep.
    assert cost.object_depth(rollouts(row(3, 0.1)[None])).item() == pytest.approx(0.027, abs=1e-6)
    # The fingers stand from z = 0.25 to 0.35 m, spheres 25 mm apart, beside the sphere: 20 + 10 - 15 mm deep.
    away = row(3, 0.1)[None] + 5.0
    assert cost.hand_inside(rollouts(away, np.array([[0.05, 0.015, 0.25]]))).item() == pytest.approx(0.015, abs=1e-6)
    # The palm stands 10 to 20 cm above the tool centre: its lowest sphere, 13 cm above, here at the sphere's height,
    # 45 mm off is 20 + 30 - 45 mm deep, where the fingers would be free.
    assert cost.hand_inside(rollouts(away, np.array([[0.05, 0.045, 0.17]]))).item() == pytest.approx(0.005, abs=1e-6)
    hits = CollisionCost(scene, body, Hand(0.01, 0.1, 0.0, 0.1), 0.0, 0.0, hit=5.0, hand_margin=0.002)
    # Fingers 31 mm off the centre stay 1 mm clear of the sphere; with a margin of 2 mm they hit it.
    assert hits(rollouts(away, np.array([[0.05, 0.031, 0.25]]))).item() == pytest.approx(5.0)
    assert hits(rollouts(away, np.array([[0.05, 0.0321, 0.25]]))).item() == 0.0
    under = cost.hand_inside(rollouts(row(3, 0.1)[None] + 5.0, np.array([[0.5, 0.5, -0.004]]))).item()
    assert under == pytest.approx(0.004, abs=1e-6)


def test_no_fixtures_and_no_table_cost_nothing() -> None:
    body = line_body(row(3, 0.1))
    assert collision(Scene(), body)(rollouts(row(3, 0.1)[None] - 5.0, np.array([[0.0, 0.0, -3.0]]))).tolist() == [0.0]


def test_smoothness_is_the_root_mean_square_acceleration() -> None:
    knots = np.zeros((6, 2, 1, 4))
    knots[:, 0, 0, 1] = 0.2 * 3.0 * np.arange(6)  # velocity grows by 0.6 m/s each 0.2 s: 3 m/s^2 throughout
    cost = SmoothnessCost(0.5)(rollouts(np.zeros((2, 2, 3)), knots=knots))
    assert cost.tolist() == pytest.approx([1.5, 0.0], abs=1e-6)


def test_workspace_is_the_way_out_of_the_box() -> None:
    place = np.array([[0.0, 0.0, 0.5], [1.03, 0.0, -0.04]])
    cost = WorkspaceCost(LOW, HIGH, 2.0)(rollouts(np.zeros((2, 2, 3)), place))
    assert cost.tolist() == pytest.approx([0.0, 0.1], abs=1e-6)  # 3 and 4 cm: 5 cm, twice


def test_stretch_beyond_what_is_free() -> None:
    body = line_body(row(3, 0.1))
    pulled = row(3, 0.1)
    pulled[2, 0] += 0.02  # the second spring: 20 % longer
    assert StretchCost(body, 1.0, 0.05)(rollouts(np.stack([row(3, 0.1), pulled]))).tolist() == pytest.approx(
        [0.0, 0.15], abs=1e-5
    )


def test_passage_measures_how_far_beside_the_gap_a_line_crosses() -> None:
    slot = Slot(x=0.1, y=0.0, yaw=0.0, gap=0.024, height=0.1)
    body = line_body(row(2, 0.2, (0.0, 0.0, 0.05)), radius=0.004)
    through = row(2, 0.2, (0.0, 0.005, 0.05))
    beside, above, short = (through + d for d in ([0, 0.02, 0], [0, 0, 0.08], [-0.15, 0.3, 0]))
    cost = PassageCost(slot, body, 1.0)(rollouts(np.stack([through, beside, above, short])))
    # Opening: 8 mm to either side (12 less the radius), up to 9 cm. 25 mm beside -> 17 mm; z 13 cm -> 4 cm.
    assert cost.tolist() == pytest.approx([0.0, 0.017, 0.04, 0.0], abs=1e-6)
    with pytest.raises(ConfigError, match="a line"):
        PassageCost(slot, dataclasses.replace(body, kind="sheet"), 1.0)


SLOT = Slot(x=0.0, y=0.0, yaw=0.0, gap=0.024, height=0.1)


def across_slot(begin: float, y: float = 0.0, z: float = 0.05) -> np.ndarray:
    """11 particles over 1 m along the way through the gap, from `begin` [m] on; the plane lies at 0."""
    return row(11, 0.1, (begin, y, z))


def test_through_is_how_far_a_line_is_through_as_its_goal_is() -> None:
    body, goal = line_body(across_slot(-0.6), radius=0.004), across_slot(-0.65)
    cost = ThroughCost(SLOT, body, goal, 1.0)
    # Of the goal's 11 points 4 lie beyond: f* = 4/11, the smaller share. A line from -0.55 m on has f = 0.45.
    ways = {
        "as the goal": (across_slot(-7 / 11), 0.0),
        "less far": (across_slot(-0.8), (4 / 11 - 0.2) / (4 / 11)),
        "too far": (across_slot(-0.4), (0.6 - 4 / 11) / (4 / 11)),
        "before the slot": (across_slot(-1.2), 1.0),
        "behind it": (across_slot(0.1), 1.0),
        "3 cm beside the opening": (across_slot(-7 / 11, y=0.038), 0.3),  # half the gap less the radius: 8 mm
        "5 cm over it": (across_slot(-7 / 11, z=0.14), 0.5),  # it ends at 9 cm
        "around the posts": (across_slot(-7 / 11, y=0.2), 1.0),
    }
    found = cost(rollouts(np.stack([line for line, _ in ways.values()])))
    assert found.tolist() == pytest.approx([value for _, value in ways.values()], abs=1e-5)


def test_through_does_not_ask_which_end_leads_nor_where_the_free_end_lies() -> None:
    body, goal = line_body(across_slot(-0.6)), across_slot(-0.65)
    cost = ThroughCost(SLOT, body, goal, 2.0)
    line = across_slot(-0.8)
    swung = line.copy()
    swung[:8] = [-0.1, 0.0, 0.05] + 0.1 * np.outer(np.arange(7, -1, -1), [0.0, 1.0, 0.0])  # the free end to one side
    mirrored = swung * [1.0, -1.0, 1.0]
    same = cost(rollouts(np.stack([line, line[::-1], swung, mirrored])))
    assert same.tolist() == pytest.approx([2.0 * (4 / 11 - 0.2) / (4 / 11)] * 4, abs=1e-5)
    loop = np.concatenate([across_slot(-0.5)[:8], across_slot(-0.5)[6:3:-1]])  # to +0.2 m and back to -0.1 m
    assert cost(rollouts(loop[None])).item() == pytest.approx(2.0), "pushed in and out again is not through"


def test_through_weighs_the_way_and_the_end_and_asks_only_what_the_goal_does() -> None:
    body, goal = line_body(across_slot(-0.6)), across_slot(-0.65)
    there, not_yet = across_slot(-7 / 11), across_slot(-1.2)
    one = rollouts(there[None])
    moving = torch.tensor(np.stack([not_yet, not_yet, not_yet, there]), dtype=torch.float32)[:, None]
    late = dataclasses.replace(one, position=moving, frames=(0, 1, 2, 3))
    # Mean over the steps 3/4, last step 0.
    assert ThroughCost(SLOT, body, goal, 1.0)(late).item() == pytest.approx(0.375, abs=1e-5)
    assert ThroughCost(SLOT, body, not_yet, 1.0)(late).item() == 0.0
    barely = row(101, 0.01, (-0.985, 0.0, 0.05))  # 2 of 101 points, 1.98 cm of 1 m: less than leads through
    assert ThroughCost(SLOT, body, barely, 1.0)(late).item() == 0.0
    beside, over = across_slot(-0.65, y=0.2), across_slot(-0.65, z=0.14)
    in_the_plane = across_slot(-0.65)[:, [1, 0, 2]] + [1e-6, 0.0, 0.0]
    for elsewhere in (beside, over, in_the_plane, in_the_plane * [-1.0, 1.0, 1.0]):
        assert ThroughCost(SLOT, body, elsewhere, 1.0)(late).item() == 0.0, "a goal that is not through the gap"
    with pytest.raises(ConfigError, match="a line"):
        ThroughCost(SLOT, dataclasses.replace(body, kind="sheet"), goal, 1.0)


def test_slot_posts_leave_the_gap_free() -> None:
    slot = Slot(x=0.3, y=0.1, yaw=0.5, gap=0.024, width=0.09, thickness=0.012, height=0.1)
    up = np.array([0.0, 0.0, 0.05])
    inside = torch.tensor(slot.foot + up + np.outer([0.0, 0.0119], slot.axes[1]), dtype=torch.float32)
    assert min(distance_to(p, inside).min().item() for p in slot.posts()) == pytest.approx(0.0001, abs=1e-5)
    middle = torch.tensor(slot.foot + up + (0.012 + 0.045) * slot.axes[1], dtype=torch.float32)
    assert distance_to(slot.posts()[1], middle).item() == pytest.approx(-0.006, abs=1e-6)  # half the thickness


def test_the_slot_is_the_stand_in_worlds() -> None:
    """The same numbers make the same posts there and here; neither may import the other."""
    pytest.importorskip("mujoco", reason="MuJoCo is not installed")
    from pred_core.plant.live.slot import SlotConfig

    for values in ({}, {"x": 0.3, "y": -0.1, "yaw": 0.7, "gap": 0.03, "width": 0.1, "thickness": 0.01, "height": 0.12}):
        here, there = Slot(**values).posts(), SlotConfig(**values).boxes
        for a, b in zip(sorted(here, key=str), sorted(there, key=str), strict=True):
            assert a.center == pytest.approx(b.center, abs=1e-12) and a.half_size == pytest.approx(b.half_size)
            assert a.rotation == pytest.approx(b.rotation)


def test_a_diverged_motion_costs_infinity_and_hides_from_the_costs() -> None:
    x = np.stack([row(5, 0.1), row(5, 0.1)])
    x[1, 2] = np.nan
    total, parts = Objective([GoalCost(row(5, 0.1), None, 1.0, 0.0)])(rollouts(x))
    assert total[0] == pytest.approx(0.0, abs=1e-6) and total[1] == np.inf and parts["goal"][1] == np.inf


def test_costs_need_names_of_their_own() -> None:
    with pytest.raises(ConfigError, match="each name once"):
        Objective([SmoothnessCost(1.0), SmoothnessCost(2.0)])


@pytest.mark.parametrize(
    ("goal", "line"),
    [
        (np.zeros((0, 3)), "goal is empty"),
        (np.full((3, 3), np.nan), "not finite; got 3 of 3"),
        (1000.0 * row(5, 0.1), "millimetres"),
        (row(5, 0.3), "larger than the object"),
        (row(5, 0.1) + [4.0, 0.0, 0.0], "out of reach"),
        (row(5, 0.1) - [0.0, 0.0, 0.5], "under the table"),
        (np.zeros((4, 2)), "shape"),
    ],
)
def test_unusable_goals_are_refused_in_one_line(goal: np.ndarray, line: str) -> None:
    with pytest.raises(InputError, match=line) as caught:
        check_goal(goal, line_body(row(5, 0.1)), Scene(ground=0.0), LOW, HIGH)
    assert "\n" not in str(caught.value)


def test_a_large_goal_is_thinned_evenly() -> None:
    cloud = np.random.default_rng(0).uniform(0.0, 1.0, (20_000, 3)) * [1.0, 0.1, 0.1]
    kept = thinned(cloud, 500)
    assert 400 < len(kept) <= 500
    counts = np.histogram(kept[:, 0], bins=5, range=(0, 1))[0]
    assert counts.min() > 0.5 * counts.max()


def test_weights_of_zero_leave_costs_out_and_costs_of_a_slot_need_one() -> None:
    body, config = line_body(row(5, 0.1)), settings()
    chosen = dataclasses.replace(config, costs=CostConfig(collision=0.0, stretch=0.0))
    names = {c.name for c in make_objective(body, Scene(), row(5, 0.1), chosen).costs}
    assert names == {"goal", "smoothness", "workspace"}
    asking = dataclasses.replace(config, costs=CostConfig(passage=1.0, through=1.0))
    for one in ("passage", "through"):
        only = dataclasses.replace(config, costs=CostConfig(**{one: 1.0}))
        with pytest.raises(ConfigError, match=f"costs.{one} needs a slot"):
            make_objective(body, Scene(), row(5, 0.1), only)
    slotted = dataclasses.replace(config, slot=Slot())
    both = make_objective(body, Scene(), row(5, 0.1), dataclasses.replace(asking, slot=Slot())).costs
    assert {"passage", "through"} < {c.name for c in both}
    assert len(scene_with_slot(Scene(), slotted).fixtures) == 2


