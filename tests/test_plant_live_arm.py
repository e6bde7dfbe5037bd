"""The stand-in arm: its chain against published numbers and MuJoCo, its reach, and how well tool and servos follow."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="MuJoCo is not installed")

import mujoco

from pred_core.errors import InputError
from pred_core.plant.live.arm7 import Arm7
from pred_core.plant.live.cell import Cell, CellConfig
from pred_core.plant.live.chain import LIMITS, READY, TOOL_LENGTH, Chain
from pred_core.plant.live.mover import DOWN, Segment, ToolPose, quaternion_of, rotation_between, tool_down
from pred_core.plant.live.station import TICK, Station


def test_the_zero_pose_is_the_published_one() -> None:
    # UFACTORY's manual: at zero angles the flange is at x 206 mm, z 120.5 mm, pointing down.
    pose, _ = Chain(np.zeros(3), 0.0).forward(np.zeros(7))
    assert pose.position == pytest.approx([0.206, 0.0, 0.1205 - TOOL_LENGTH], abs=1e-12)
    assert np.abs(rotation_between(pose.rotation, DOWN)).max() < 1e-9


def test_chain_and_model_are_the_same_arm() -> None:
    arm = Arm7(np.array([0.1, -0.2, 0.05]), 0.4)
    spec = mujoco.MjSpec()
    arm.build(spec)
    model = spec.compile()
    data = mujoco.MjData(model)
    arm.bind(model)
    generator = np.random.default_rng(0)
    for _ in range(10):
        data.qpos[:7] = q = generator.uniform(LIMITS[:, 0], LIMITS[:, 1])
        mujoco.mj_kinematics(model, data)
        tool = model.body("tool").id
        pose, jacobian = arm.chain.forward(q)
        assert pose.position == pytest.approx(data.xpos[tool], abs=1e-12)
        assert np.abs(rotation_between(pose.rotation, data.xquat[tool])).max() < 1e-7
        mujoco.mj_comPos(model, data)
        linear, angular = np.empty((3, 7)), np.empty((3, 7))
        mujoco.mj_jacBody(model, data, linear, angular, tool)
        assert jacobian == pytest.approx(np.concatenate([linear, angular]), abs=1e-12)


def test_inverse_kinematics_reaches_the_workplace_and_refuses_beyond() -> None:
    chain = Chain(np.zeros(3), 0.0)
    for x, y, yaw in ((0.35, -0.25, 0.0), (0.45, 0.0, np.pi / 2), (0.45, 0.3, 2.2), (0.55, 0.2, 1.0)):
        target = ToolPose(np.array([x, y, 0.05]), tool_down(yaw))
        q = chain.inverse(target, READY, posture_steps=60)
        pose, _ = chain.forward(q)
        # The iteration ends at 1 um and 1 urad.
        assert np.abs(pose.position - target.position).max() < 1e-6
        assert np.abs(rotation_between(pose.rotation, target.rotation)).max() < 1e-6
        assert (q >= LIMITS[:, 0]).all() and (q <= LIMITS[:, 1]).all()
    with pytest.raises(InputError, match="out of the arm's reach"):
        chain.inverse(ToolPose(np.array([1.2, 0.0, 0.1]), DOWN), READY)


@pytest.mark.parametrize("mover", ["free", "arm"])
def test_the_tool_follows_a_moving_command(mover: str) -> None:
    cell = Cell(CellConfig(mover=mover), cameras=())
    home = ToolPose(cell.reset(1).gripper.position, cell.reference.rotation)
    # A circle of 5 cm with 0.2 m/s and a turn of 0.4 rad/s, begun at rest with a smooth speed.
    angle = 4.0 * np.cumsum(np.minimum(np.arange(45) / 15.0, 1.0)) / 30.0
    off, turned = [], []
    for k, a in enumerate(angle):
        way = 0.05 * np.array([np.sin(a), 1.0 - np.cos(a), 0.5 * (1.0 - np.cos(a))])
        rotation = Segment(home, ToolPose(home.position, tool_down(2.2)), 1.0).at(0.01 * k).rotation
        command = ToolPose(home.position + way, rotation)
        truth = cell.step(command)
        off.append(np.linalg.norm(truth.gripper.position - command.position))
        turned.append(np.linalg.norm(rotation_between(truth.gripper.rotation, command.rotation)))
    assert max(off) < 0.003, "position servos with feed-forward: 3 mm"
    assert max(turned) < 0.02
    assert bool(truth.joints) is (mover == "arm")


def test_a_command_out_of_reach_or_too_far_moves_nothing() -> None:
    cell = Cell(cameras=())
    before = cell.reset(2)
    for place, line in ((np.array([0.9, 0.0, 0.1]), "too far for its time"), (np.full(3, np.nan), "finite")):
        with pytest.raises(InputError, match=line):
            cell.step(ToolPose(place, DOWN))
    with pytest.raises(InputError, match="unit quaternion"):
        cell.step(ToolPose(before.gripper.position, np.array([2.0, 0.0, 0.0, 0.0])))
    with pytest.raises(InputError, match="out of the arm's reach"):
        cell.step(ToolPose(np.array([0.9, 0.0, 0.1]), DOWN), seconds=2.0)
    with pytest.raises(InputError, match="multiples of 1/300"):
        cell.step(seconds=0.0121)
    assert cell.time == 0.0
    after = cell.step()
    assert after.gripper.position == pytest.approx(before.gripper.position, abs=1e-4)


def test_a_quaternion_helper_pair_is_its_own_inverse() -> None:
    turn = np.array([0.3, -0.5, 0.2])
    assert rotation_between(
        DOWN, Segment(ToolPose(np.zeros(3), DOWN), ToolPose(np.zeros(3), DOWN), 1.0).at(1.0).rotation
    ) == pytest.approx(np.zeros(3))
    assert rotation_between(np.array([1.0, 0, 0, 0]), quaternion_of(turn)) == pytest.approx(turn)


def test_the_edge_of_the_reach_latches_a_fault_and_time_goes_on() -> None:
    station = Station(Cell(cameras=()))
    start = station.reset(0).truth.gripper
    station.servo.begin()
    for _ in range(700):
        outward = ToolPose(station.cell.reference.position + [0.002, -0.002, 0.001], start.rotation)
        if station.servo.following:
            station.servo.command(outward, np.zeros(3), np.zeros(3), station.cell.time)
        moment = station.tick()
    assert "out of the arm's reach" in station.servo.fault
    place = moment.truth.gripper.position
    assert np.linalg.norm(station.tick().truth.gripper.position - place) < 1e-4, "it stays where it was"
    assert station.cell.time == pytest.approx(701 * TICK), "no tick is lost"
