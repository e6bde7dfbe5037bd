"""The slot and the measure of success, against numbers worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="MuJoCo is not installed")

from pred_core.errors import InputError
from pred_core.plant.live.slot import SlotConfig
from pred_core.plant.live.success import judge_passage

SLOT = SlotConfig(x=0.0, y=0.0, yaw=0.0)  # through along x: posts at |y| 12 to 102 mm, |x| <= 6 mm, 100 mm high
LOW = np.array([0.2, 0.0, 0.05])


def line(*points: tuple[float, float, float]) -> np.ndarray:
    return np.array(points)


def test_posts_stand_where_the_numbers_say() -> None:
    left, right = SlotConfig(x=0.4, y=0.1, yaw=np.pi / 2).boxes
    # Through along +y: across is -x. The post's middle is 12 + 45 = 57 mm to the side, half height 50 mm.
    assert left.center == pytest.approx((0.4 - 0.057, 0.1, 0.05))
    assert right.center == pytest.approx((0.4 + 0.057, 0.1, 0.05))
    assert left.half_size == pytest.approx((0.006, 0.045, 0.05))


def test_a_straight_rope_through_the_gap_counts_its_lengths() -> None:
    passage = judge_passage(line((-0.3, 0, 0.004), (0.1, 0, 0.004)), LOW, SLOT)
    assert passage.success and passage.crossings == 1
    # 300 mm and 100 mm on the sides, less 6 mm of half thickness each
    assert passage.before == pytest.approx(0.294) and passage.behind == pytest.approx(0.094)


def test_too_little_rope_beyond_fails() -> None:
    # 25 mm past the middle is 19 mm past the post: below 20 mm
    assert not judge_passage(line((-0.3, 0, 0.004), (0.025, 0, 0.004)), LOW, SLOT).success
    assert judge_passage(line((-0.3, 0, 0.004), (0.027, 0, 0.004)), LOW, SLOT).success


@pytest.mark.parametrize(
    ("y", "z", "good"),
    [(0.0119, 0.05, True), (0.0121, 0.05, False), (0.0, 0.0899, True), (0.0, 0.0901, False), (0.0, 0.12, False)],
)
def test_the_cross_section_is_the_gap_less_a_centimetre_at_the_top(y: float, z: float, good: bool) -> None:
    assert judge_passage(line((-0.2, y, z), (0.2, y, z)), LOW, SLOT).success is good


def test_a_rope_over_the_posts_or_around_them_fails() -> None:
    over = line((-0.2, 0, 0), (-0.01, 0, 0.11), (0.01, 0, 0.11), (0.2, 0, 0))
    assert judge_passage(over, LOW, SLOT).crossings == 1 and not judge_passage(over, LOW, SLOT).success
    around = line((-0.2, 0, 0), (-0.1, 0.15, 0), (0.1, 0.15, 0), (0.2, 0, 0))
    assert not judge_passage(around, LOW, SLOT).inside


def test_there_and_back_is_an_even_number_of_crossings() -> None:
    back = line((-0.2, 0.005, 0.004), (0.1, 0.005, 0.004), (0.1, -0.005, 0.004), (-0.2, -0.005, 0.004))
    passage = judge_passage(back, LOW, SLOT)
    assert passage.crossings == 2 and passage.inside and not passage.success


def test_one_strand_in_the_gap_and_one_around_the_post_fails() -> None:
    # Three crossings: through, back outside the post, through again
    rope = line((-0.1, 0, 0), (0.1, 0, 0), (0.1, 0.2, 0), (-0.1, 0.2, 0), (-0.1, 0.004, 0), (0.1, 0.004, 0))
    passage = judge_passage(rope, LOW, SLOT)
    assert passage.crossings == 3 and not passage.success


def test_rope_on_one_side_only_is_no_passage() -> None:
    passage = judge_passage(line((-0.3, 0, 0), (-0.05, 0, 0)), LOW, SLOT)
    assert not passage.inside and passage.crossings == 0 and not passage.success


def test_the_gripper_must_be_below_the_top() -> None:
    rope = line((-0.2, 0, 0.004), (0.2, 0, 0.004))
    assert judge_passage(rope, np.array([0.2, 0.0, 0.0999]), SLOT).success
    high = judge_passage(rope, np.array([0.2, 0.0, 0.1001]), SLOT)
    assert high.threaded and not high.success


def test_a_turned_slot_judges_the_turned_rope_alike() -> None:
    slot = SlotConfig(x=0.4, y=-0.1, yaw=0.7)
    pose = slot.world_from_slot
    rope = line((-0.3, 0, 0.004), (0.1, 0, 0.004)) @ pose[:3, :3].T + pose[:3, 3]
    gripper = pose[:3, :3] @ LOW + pose[:3, 3]
    assert judge_passage(rope, gripper, slot).behind == pytest.approx(0.094)


def test_bad_input_is_refused() -> None:
    with pytest.raises(InputError, match="finite points"):
        judge_passage(line((0, 0, np.nan), (1, 0, 0)), LOW, SLOT)
    with pytest.raises(InputError, match="gripper"):
        judge_passage(line((0, 0, 0), (1, 0, 0)), np.zeros(2), SLOT)
