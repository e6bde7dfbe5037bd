"""The lock-step cell: repeatable from a seed, honest contacts, faults that are there when switched on."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="MuJoCo is not installed")

from pred_core.errors import ConfigError, InputError
from pred_core.plant.cameras import CameraConfig, ring_of_cameras
from pred_core.plant.live.cable import NOMINAL, draw_cable
from pred_core.plant.live.cell import Cell, CellConfig
from pred_core.plant.live.mover import Segment, ToolPose, tool_down
from pred_core.plant.live.slot import SlotConfig
from pred_core.plant.live.start import StartFamily, draw_start

FREE = CellConfig(mover="free")
SMALL = ring_of_cameras(2, target=(0.45, 0.0, 0.03), width=160, height=120)


@pytest.fixture(scope="module")
def cell() -> Cell:
    """A free gripper without cameras; every test begins with a reset."""
    return Cell(FREE, cameras=())


def walk(cell: Cell, *places: tuple[float, float, float], speed: float = 0.25) -> None:
    """Lead the tool through places in the slot's axes, its x axis along the way through."""
    pose = cell.slot.world_from_slot
    for place in places:
        begin = cell.reference
        end = ToolPose(pose[:3, :3] @ np.array(place) + pose[:3, 3], tool_down(cell.slot.yaw))
        count = max(1, int(np.ceil(np.linalg.norm(end.position - begin.position) / speed * 30)))
        for k in range(count):
            cell.step(Segment(begin, end, 1.0).at((k + 1) / count))


def test_the_same_seed_gives_the_same_bits() -> None:
    def run(cell: Cell) -> tuple[np.ndarray, ...]:
        cell.reset(5)
        walk(cell, (-0.1, 0.0, 0.1))
        truth = cell.truth()
        frame = cell.look(["cam1"])[0]
        assert frame is not None
        return truth.rope, truth.rope_velocity, truth.gripper.position, frame.rgb, frame.depth

    with Cell(cameras=SMALL) as first, Cell(cameras=SMALL) as second:
        one = run(first)
        first.reset(6)
        first.step()
        again, other = run(first), run(second)  # after another episode, and in another cell
    for a, b, c in zip(one, again, other, strict=True):
        assert np.array_equal(a, b, equal_nan=True) and np.array_equal(a, c, equal_nan=True)


def test_starts_are_drawn_at_rest_on_the_near_side(cell: Cell) -> None:
    starts = []
    for seed in range(2):
        truth = cell.reset(seed)
        in_slot = cell.slot.to_slot(truth.rope)
        assert in_slot[:, 0].max() < -0.03 and not cell.judge().threaded
        assert np.linalg.norm(truth.rope_velocity, axis=1).max() < 0.01, "the rope is at rest"
        assert truth.rope[:, 2].min() > 0.002, "on the table, radius 4 mm"
        assert np.linalg.norm(truth.rope[0] - truth.gripper.position) < 5e-4, "its end is in the jaws"
        assert truth.stamp == 1_000_000_000 and cell.time == 0.0
        starts.append(truth.rope)
    assert np.abs(starts[0] - starts[1]).max() > 0.02


def test_velocity_is_the_rate_of_position(cell: Cell) -> None:
    home = cell.reset(0).gripper.position
    for k in range(10):
        cell.step(ToolPose(home + [0.0, 0.0, 0.008 * (k + 1)], cell.reference.rotation))
    before = cell.truth()
    after = cell.step(ToolPose(home + [0.0, 0.0, 0.081], cell.reference.rotation), seconds=1 / 300)
    # Semi-implicit Euler moves by the new velocity; a turn of a link within one step of 3.3 ms is second order.
    assert np.abs((after.rope - before.rope) * 300 - after.rope_velocity).max() < 0.01
    assert np.abs(after.rope_velocity).max() > 0.15, "the held end moves with 0.24 m/s"


def test_a_rope_led_over_the_slot_and_down_is_through_it(cell: Cell) -> None:
    cell.reset(0)
    assert not cell.judge().success
    walk(cell, (-0.12, 0.0, 0.13), (0.22, 0.0, 0.13), (0.25, 0.0, 0.05))
    for _ in range(10):
        cell.step()
    passage = cell.judge()
    assert passage.success and passage.crossings == 1
    # 0.25 m beyond the middle is where the gripper holds the rope's end
    assert passage.behind == pytest.approx(0.25, abs=0.02)
    assert cell.touches.count["gripper on slot"] == 0 and cell.touches.count["rope on slot"] >= 1


def test_the_gripper_cannot_pass_a_post_and_the_collision_is_counted(cell: Cell) -> None:
    cell.reset(0)
    walk(cell, (-0.1, 0.057, 0.05), (0.06, 0.057, 0.05))
    in_slot = cell.slot.to_slot(cell.truth().gripper.position)
    # Finger: 10 mm before the tool centre; post: 6 mm before the middle.
    assert in_slot[0] == pytest.approx(-0.016, abs=0.002)
    assert cell.touches.count["gripper on slot"] == 1 and cell.touches.seconds["gripper on slot"] > 0.1


def test_a_rope_that_slips_out_stays_behind_and_can_be_taken_again(cell: Cell) -> None:
    cell.reset(0)
    walk(cell, (-0.12, 0.0, 0.05))
    cell.jaws.slip()
    place = cell.slot.to_slot(cell.reference.position)
    walk(cell, (place[0], place[1], 0.15))
    truth = cell.truth()
    assert truth.closed and not truth.holds, "the jaws report closed; they do not know"
    assert truth.rope[:, 2].max() < 0.02, "it lies on the table"
    cell.jaws.open()
    end = cell.slot.to_slot(cell.truth().rope[3])
    walk(cell, (end[0], end[1], 0.15), (end[0], end[1], 0.01))
    cell.jaws.close()
    assert cell.jaws.holds
    walk(cell, (end[0], end[1], 0.15))
    assert cell.truth().rope[:, 2].max() == pytest.approx(0.145, abs=0.02)
    assert np.linalg.norm(cell.reset(0).rope[0] - cell.truth().gripper.position) < 5e-4, "a reset mends the grasp"


def test_jaws_that_close_on_nothing_hold_nothing(cell: Cell) -> None:
    cell.reset(0)
    cell.jaws.open()
    walk(cell, (-0.1, 0.0, 0.2))
    cell.jaws.close()
    assert cell.jaws.closed and not cell.jaws.holds


def test_dead_and_bumped_cameras() -> None:
    with Cell(FREE, cameras=SMALL) as cell:
        cell.reset(0)
        good, other = cell.look()
        assert good is not None and other is not None
        cell.faults.bump(["cam0"], seed=1)
        bumped = cell.look(["cam0"])[0]
        assert bumped is not None
        assert np.array_equal(bumped.world_from_camera, good.world_from_camera), "it reports the old pose"
        moved = cell.faults.bumped["cam0"]
        assert np.linalg.norm(moved[:3, 3] - good.world_from_camera[:3, 3]) == pytest.approx(0.005)
        turn = moved[:3, :3] @ good.world_from_camera[:3, :3].T
        assert np.trace(turn) == pytest.approx(1 + 2 * np.cos(np.deg2rad(1.0)))
        assert not np.array_equal(bumped.rgb, good.rgb)
        cell.faults.kill(["cam1"])
        assert cell.look()[1] is None and cell.look()[0] is not None
        with pytest.raises(ConfigError, match="unknown camera 'cam7'.*did you mean"):
            cell.faults.kill(["cam7"])
        cell.reset(0)
        again = cell.look()[0]
        assert again is not None and np.array_equal(again.rgb, good.rgb), "a reset ends the faults"


def test_cables_of_seeds_differ_within_the_family() -> None:
    drawn = [draw_cable(np.random.default_rng(seed)) for seed in range(20)]
    assert len({c.bending for c in drawn}) == 20
    for cable in drawn:
        assert 0.63 <= cable.length <= 0.77 and 0.45 <= cable.friction <= 0.75
        assert NOMINAL.bending * np.exp(-0.7) <= cable.bending <= NOMINAL.bending * np.exp(0.7)
        assert cable.link_length == pytest.approx(NOMINAL.link_length, rel=0.03)
    assert Cell(CellConfig(mover="free", cable=4), cameras=()).rope != NOMINAL


def test_no_room_for_a_start_is_said() -> None:
    with pytest.raises(ConfigError, match="no start pose fits"):
        draw_start(np.random.default_rng(0), NOMINAL, SlotConfig(), StartFamily(far=-0.3, side=0.05, sway=0.1))


def test_use_before_reset_and_cameras_named_twice_are_refused() -> None:
    cell = Cell(FREE, cameras=(CameraConfig("cam0"), CameraConfig("cam0")))
    with pytest.raises(InputError, match="before reset"):
        cell.step()
    with pytest.raises(InputError, match="before reset"):
        cell.look()
    cell.reset(0)
    with pytest.raises(ConfigError, match="each name once"):
        cell.look()
