"""What a robot is not moved from: grippers that change in number, are out of their workspace or far from the object."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from plan_cases import DOWN, HOME, seen, settings
from test_plan_session import Cell

from pred_core.bag.grippers import PoseFrame
from pred_core.errors import InputError
from pred_core.plan.gripper_poses import GripperPoses
from pred_core.plan.latency import Observation, tracking_error
from pred_core.plan.start import OUTSIDE, REACH, check_start

S = 1_000_000_000  # [ns]


def pose(stamp: int, grippers: int = 1, x: float = 0.0) -> PoseFrame:
    """Grippers beside each other along y."""
    place = np.column_stack((np.full(grippers, x), 0.1 * np.arange(grippers), np.full(grippers, 0.3)))
    return PoseFrame(stamp, place, np.repeat(DOWN, grippers, axis=0))


@pytest.mark.parametrize(("before", "after"), [(1, 2), (2, 3), (2, 1)])
def test_grippers_that_change_in_number_are_refused_until_all_is_forgotten(before: int, after: int) -> None:
    poses = GripperPoses()
    poses.add(pose(S, before))
    for stamp in (S + 20_000_000, S - 20_000_000):  # later, and on a clock that was set back
        with pytest.raises(InputError, match=f"number of grippers changed; got {after}; allowed: {before} as before"):
            poses.add(pose(stamp, after))
    assert len(poses.at(S + 10_000_000, 0.05)[0]) == before, "nothing is made up between them"
    poses.clear()
    poses.add(pose(2 * S, after))
    assert len(poses.at(2 * S, 0.05)[0]) == after


def test_a_pose_lies_between_two_and_is_not_taken_from_far_away() -> None:
    poses = GripperPoses()
    poses.add(pose(S, x=0.1))
    poses.add(pose(S + 40_000_000, x=0.3))
    # A quarter of the way from 0.1 to 0.3 m.
    assert poses.at(S + 10_000_000, 0.05)[0][0, 0] == pytest.approx(0.15, abs=1e-12)
    with pytest.raises(InputError, match="no gripper/pose at the stamp of state/points; got 0.060 s away"):
        poses.at(S + 100_000_000, 0.05)
    poses.add(pose(S - S // 2, x=0.7))  # one stamp out of line costs nothing
    assert poses.at(S + 10_000_000, 0.05)[0][0, 0] == pytest.approx(0.15, abs=1e-12)
    with pytest.raises(InputError, match="one stamp is out of line; got -0.540 s"):
        poses.add(pose(S + 80_000_000, x=0.3))
    for stamp in (S - S // 2, S - S // 2 + 1):  # a clock set back: what was before is forgotten
        poses.add(pose(stamp, x=0.7))
    with pytest.raises(InputError, match="0.500 s away"):
        poses.at(S, 0.05)


def test_plans_in_force_are_not_compared_with_other_grippers() -> None:
    cell = Cell()
    while cell.session.in_force is None:
        cell.turn()
    one = cell.observe()
    two = Observation(one.stamp, one.state, np.repeat(one.position, 2, axis=0), np.repeat(one.rotation, 2, axis=0))
    assert tracking_error(one, cell.session.in_force) < 1e-3
    with pytest.raises(InputError, match="for other grippers; got 2; allowed: 1"):
        cell.session.replan(two)
    cell.session.reset()
    assert cell.session.replan(two) is None and cell.session.waiting, "after ~/reset they are planned for, at rest"


@pytest.mark.parametrize(
    ("way", "far"),
    [((0.0, 0.0, 5.0), "4.30 m"), ((0.0, 0.0, -0.45), "0.15 m"), ((1.3, -1.4, 0.0), "0.50 m")],
)
def test_a_gripper_clearly_out_of_its_workspace_is_refused(way: tuple[float, float, float], far: str) -> None:
    """The box ends at 1 m along x and y, at 0 and 1 m along z; HOME is 0.3 m high. 0.3 and 0.4 m out make 0.5 m."""
    with pytest.raises(InputError, match=f"gripper 0 is outside its workspace; got {far}"):
        check_start(seen(offset=way), settings().motion)


def test_a_start_a_little_out_of_its_workspace_is_led_back() -> None:
    check_start(seen(offset=(0.0, 0.0, 0.7 + 0.9 * OUTSIDE)), settings().motion)


def test_a_gripper_far_from_what_it_holds_is_refused() -> None:
    """Of several held particles the nearest counts: the second one of a stiff end may be far from the fingers."""
    there = seen()
    motion = settings().motion
    off = dataclasses.replace(there, position=HOME + [0.0, 0.0, REACH + 0.02])
    with pytest.raises(InputError, match="gripper 0 is far from what it is said to hold; got 0.17 m"):
        check_start(off, motion)
    check_start(dataclasses.replace(there, position=HOME + [0.0, 0.0, 0.9 * REACH]), motion)
    held = there.state.held.clone()
    held[-1] = 0  # 10 cm along the line; the nearest is 9 cm off
    check_start(dataclasses.replace(off, state=there.state.replace(held=held), position=HOME + [0.19, 0, 0]), motion)
    free = Observation(0, there.state, np.concatenate((HOME, HOME + 0.5)), np.repeat(DOWN, 2, axis=0))
    check_start(free, motion)  # the second gripper holds nothing


def test_a_session_gives_up_its_plans_and_says_why() -> None:
    cell = Cell()
    while cell.session.counts.plans < 3:
        cell.turn()
    lost = dataclasses.replace(cell.observe(), position=HOME + [0.0, 0.0, 5.0])
    with pytest.raises(InputError, match="outside its workspace"):
        cell.session.replan(lost)
    assert cell.session.waiting and cell.session.in_force is None and cell.session.counts.off_track == 1
