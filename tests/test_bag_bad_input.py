"""Each bad input has its own clear error, which names the bag and what to do."""

from pathlib import Path

import numpy as np
import pytest
from bag_examples import edited_bag, line_bag, points_edited

from pred_core.bag.episode import read_episode
from pred_core.bag.reader import open_bag
from pred_core.bag.summary import summarize_bag
from pred_core.bag.wire import GRIPPER_CLOSED, GRIPPER_POSE, TRACKER_POINTS
from pred_core.bag.writer import BagWriter
from pred_core.errors import BagError


@pytest.mark.parametrize("content", [b"", b"bag file #ROSBAG V2.0\n", b"SQLite format 3\x00", b"\x89MCAP1\r\n"])
def test_not_a_bag(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    with pytest.raises(BagError, match=r"x\.mcap: not a bag"):
        open_bag(path)


def test_no_such_bag(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="no such bag"):
        open_bag(tmp_path / "missing.mcap")
    with pytest.raises(BagError, match=r"a folder with 0 \.mcap files"):
        open_bag(tmp_path)


def test_a_truncated_bag_reports_what_can_be_read(tmp_path: Path) -> None:
    whole = line_bag(tmp_path / "whole.mcap", frames=400)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size * 2 // 3])
    reader = open_bag(cut)
    assert reader.damage is not None and "cut off" in reader.damage
    assert 300 < reader.message_count < 1200
    assert len(list(reader.read_messages(partial=True))) == reader.message_count
    with pytest.raises(BagError, match=r"cut\.mcap: truncated or damaged bag"):
        list(reader.read_messages())
    with pytest.raises(BagError, match="truncated or damaged bag"):
        read_episode(cut)
    summary = summarize_bag(cut)
    assert summary.messages == reader.message_count and summary.low is not None
    assert "truncated" in summary.problems[0]


def test_a_flipped_bit_is_found_by_its_checksum(tmp_path: Path) -> None:
    path = line_bag(tmp_path / "a.mcap", frames=100)
    data = bytearray(path.read_bytes())
    data[400] ^= 1  # inside the first chunk
    path.write_bytes(bytes(data))
    with pytest.raises(BagError, match="truncated or damaged"):
        read_episode(path)


@pytest.mark.parametrize("topic", [TRACKER_POINTS, GRIPPER_POSE, GRIPPER_CLOSED])
def test_missing_topic_names_those_there_are(tmp_path: Path, topic: str) -> None:
    path = edited_bag(tmp_path / "a.mcap", lambda t, message, number: None if t == topic else message)
    with pytest.raises(BagError, match=rf"no topic '{topic}'; the bag has .*gripper|no topic '{topic}'; .*tracker"):
        read_episode(path)


def test_wrong_type(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "a.mcap") as writer:
        writer._channels[TRACKER_POINTS] = writer._register(TRACKER_POINTS, "std_msgs/msg/String")
        writer._writer.add_message(writer._channels[TRACKER_POINTS], 0, b"\0\1\0\0", 0)
    with pytest.raises(BagError, match="wrong type of 'tracker/points'; got std_msgs/msg/String; allowed: sensor_msgs"):
        read_episode(tmp_path / "a.mcap")


def _field(chosen: str, **changes: object):
    def edit(topic, message, number):
        if topic == TRACKER_POINTS:
            field = next(f for f in message.fields if f.name == chosen)
            for key, value in changes.items():
                setattr(field, key, value)
        return message

    return edit


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (_field("id", name="index"), "no field 'id'"),
        (_field("id", datatype=7), "field 'id' is not one u4"),
        (_field("x", datatype=99), "field 'x' has datatype 99"),
        (_field("y", offset=0), "overlaps"),
        (_field("confidence", offset=400), "beyond point_step"),
        (_field("z", name="x"), "named twice"),
    ],
)
def test_unknown_field_layout(tmp_path: Path, edit, words: str) -> None:
    with pytest.raises(BagError, match=f"unknown field layout, .*{words}") as caught:
        read_episode(edited_bag(tmp_path / "a.mcap", edit))
    assert "x f4, y f4, z f4, id u4" in str(caught.value)


def test_a_point_of_gigabytes(tmp_path: Path) -> None:
    def edit(topic, message, number):
        if topic == TRACKER_POINTS:
            message.point_step, message.width, message.data = 2**31, 0, message.data[:0]
        return message

    with pytest.raises(BagError, match="unknown field layout, point_step 2147483648 is larger than 65536"):
        read_episode(edited_bag(tmp_path / "a.mcap", edit))


def test_points_that_do_not_fit_their_bytes(tmp_path: Path) -> None:
    def edit(topic, message, number):
        if topic == TRACKER_POINTS:
            message.width += 1
        return message

    with pytest.raises(BagError, match="unknown field layout, .*do not fit"):
        read_episode(edited_bag(tmp_path / "a.mcap", edit))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_coordinates_that_are_not_finite(tmp_path: Path, value: float) -> None:
    def spoil(cloud):
        cloud["y"][2] = value

    with pytest.raises(BagError, match=r"tracker/points at 5\.070 s: coordinates of visible ids 16 are not finite"):
        read_episode(points_edited(tmp_path / "a.mcap", spoil))


def test_the_same_coordinates_at_confidence_0_are_a_hidden_particle(tmp_path: Path) -> None:
    def hide(cloud):
        cloud["y"][2], cloud["confidence"][2] = np.nan, 0.0

    assert not read_episode(points_edited(tmp_path / "a.mcap", hide)).tracks.visible[7, 2]


@pytest.mark.parametrize("value", [np.nan, 1.5, -0.1])
def test_confidence_outside_0_to_1(tmp_path: Path, value: float) -> None:
    def spoil(cloud):
        cloud["confidence"][1] = value

    with pytest.raises(BagError, match="confidence of ids 13"):
        read_episode(points_edited(tmp_path / "a.mcap", spoil))


def test_duplicate_ids(tmp_path: Path) -> None:
    def spoil(cloud):
        cloud["id"][3] = 10

    with pytest.raises(BagError, match="duplicate ids 10"):
        read_episode(points_edited(tmp_path / "a.mcap", spoil))


def test_millimetres_given_as_metres(tmp_path: Path) -> None:
    def spoil(cloud):
        for axis in "xyz":
            cloud[axis] *= 1000.0

    with pytest.raises(BagError, match="implausible extent, are these millimetres.; got 400 m across"):
        read_episode(points_edited(tmp_path / "a.mcap", spoil))


@pytest.mark.parametrize("topic", [TRACKER_POINTS, GRIPPER_POSE])
def test_time_running_backwards(tmp_path: Path, topic: str) -> None:
    def edit(t, message, number):
        if t == topic and number == 9:
            message.header.stamp.sec -= 1
        return message

    with pytest.raises(BagError, match=f"{topic}: time runs backwards; got header stamp 4.09"):
        read_episode(edited_bag(tmp_path / "a.mcap", edit))


@pytest.mark.parametrize("topic", [TRACKER_POINTS, GRIPPER_POSE])
def test_frame_other_than_world(tmp_path: Path, topic: str) -> None:
    def edit(t, message, number):
        if t == topic:
            message.header.frame_id = "base_link"
        return message

    with pytest.raises(BagError, match=f"{topic}: frame_id is not 'world'; got 'base_link'"):
        read_episode(edited_bag(tmp_path / "a.mcap", edit))


def test_a_quaternion_that_is_none(tmp_path: Path) -> None:
    def edit(topic, message, number):
        if topic == GRIPPER_POSE:
            message.poses[0].orientation.w = 0.0
        return message

    with pytest.raises(BagError, match="quaternion has no unit norm"):
        read_episode(edited_bag(tmp_path / "a.mcap", edit))


def test_poses_that_stop_early(tmp_path: Path) -> None:
    path = edited_bag(tmp_path / "a.mcap", lambda t, m, number: None if t == GRIPPER_POSE and number > 14 else m)
    words = r"gripper/pose: no pose for 5 of 20 frames, first at 5\.150 s; got .* 10\.0 ms away"
    with pytest.raises(BagError, match=words):
        read_episode(path)


def test_a_hole_in_the_poses(tmp_path: Path) -> None:
    path = edited_bag(tmp_path / "a.mcap", lambda t, m, n: None if t == GRIPPER_POSE and 5 <= n < 8 else m)
    with pytest.raises(BagError, match="no pose for 3 of 20 frames"):
        read_episode(path)


def test_closed_flags_that_stop_early(tmp_path: Path) -> None:
    path = edited_bag(tmp_path / "a.mcap", lambda t, m, number: None if t == GRIPPER_CLOSED and number > 9 else m)
    with pytest.raises(BagError, match="no closed flag for"):
        read_episode(path)


def test_flags_and_poses_of_different_number(tmp_path: Path) -> None:
    def edit(topic, message, number):
        if topic == GRIPPER_CLOSED:
            message.data = message.data[:1]
        return message

    with pytest.raises(BagError, match=r"gripper/closed has \[1\] flags a message; allowed: 2"):
        read_episode(edited_bag(tmp_path / "a.mcap", edit))


def test_a_long_gap_of_the_tracker(tmp_path: Path) -> None:
    path = edited_bag(
        tmp_path / "a.mcap", lambda t, m, n: None if t == TRACKER_POINTS and 5 <= n < 130 else m, frames=150
    )
    with pytest.raises(BagError, match=r"tracker/points has a gap of 1\.26 s"):
        read_episode(path)


def test_a_gap_of_more_periods_than_there_are_frames(tmp_path: Path) -> None:
    """Stamps 1 ns apart and a pause of 0.5 s would be 500 million lost frames."""

    def edit(topic, message, number):
        if topic == TRACKER_POINTS:
            message.header.stamp.nanosec = number if number < 15 else 500_000_000 + number
        return message

    with pytest.raises(BagError, match="gap of 0.5 s at 5.000 s; allowed: 1 s, and no more frames lost than measured"):
        read_episode(edited_bag(tmp_path / "a.mcap", edit))


def test_another_rate_than_the_data_set_says(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="got 100 Hz; allowed: 30 Hz"):
        read_episode(line_bag(tmp_path / "a.mcap"), rate=30.0)


def test_held_names_a_particle_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="held says particle 11 is in gripper 0"):
        read_episode(line_bag(tmp_path / "a.mcap"), held={11: 0})


def test_a_single_frame_is_no_episode(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="at least 2 messages"):
        read_episode(line_bag(tmp_path / "a.mcap", frames=1))
