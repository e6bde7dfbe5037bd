"""What is written is read back, by us and by the tools of others."""

from pathlib import Path

import mcap.reader
import numpy as np
import pytest
import torch
from bag_examples import PERIOD, START, edited_bag, line_bag, line_episode
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from pred_core.bag.clouds import PointFrame, make_tracker_points, read_tracker_points
from pred_core.bag.episode import read_episode, write_episode
from pred_core.bag.reader import open_bag
from pred_core.bag.wire import GRIPPER_CLOSED, GRIPPER_POSE, TRACKER_POINTS
from pred_core.bag.writer import BagWriter
from pred_core.errors import BagError


def test_an_episode_survives_the_bag_to_the_last_bit_of_float32(tmp_path: Path) -> None:
    episode = line_episode()
    write_episode(tmp_path / "a.mcap", episode)
    back = read_episode(tmp_path / "a.mcap", held={10: 0})
    assert np.array_equal(back.stamps, episode.stamps)
    assert np.array_equal(back.position, episode.position)
    assert np.array_equal(back.tracks.id, [10, 13, 16, 19, 22])
    assert torch.equal(back.grips.position, episode.grips.position)
    assert torch.equal(back.grips.rotation, episode.grips.rotation)
    assert torch.equal(back.grips.closed, episode.grips.closed)
    assert back.held.tolist() == [0, -1, -1, -1, -1]
    assert back.period == pytest.approx(0.01, abs=1e-12)


def test_hidden_particles_read_as_nan_and_not_visible(tmp_path: Path) -> None:
    episode = line_episode()
    episode.tracks.visible[4, 2] = False
    write_episode(tmp_path / "a.mcap", episode)
    back = read_episode(tmp_path / "a.mcap")
    assert np.isnan(back.position[4, 2]).all() and not back.tracks.visible[4, 2]
    assert back.tracks.visible.sum() == 20 * 5 - 1


def test_an_absent_particle_is_hidden_too(tmp_path: Path) -> None:
    def without_the_last(topic, message, number):
        if topic == TRACKER_POINTS and number == 4:
            message.width -= 1
            message.row_step -= message.point_step
            message.data = message.data[: message.row_step]
        return message

    back = read_episode(edited_bag(tmp_path / "a.mcap", without_the_last))
    assert not back.tracks.visible[4, 4] and np.isnan(back.position[4, 4]).all()
    assert back.tracks.visible.sum() == 20 * 5 - 1


def test_header_stamps_count_and_not_the_log_time(tmp_path: Path) -> None:
    delay = 3_210_000_000  # every message recorded 3.21 s late
    with BagWriter(tmp_path / "late.mcap") as writer:
        for message in open_bag(line_bag(tmp_path / "a.mcap")).read_messages():
            writer.write_raw("/" + message.topic, message.type, message.data, message.log_time + delay)
    back = read_episode(tmp_path / "late.mcap")
    assert back.stamps[0] == START
    assert back.grips.closed.tolist() == [[True, False]] * 20


def test_without_held_in_the_data_set_a_closed_gripper_holds_what_is_within_2_cm(tmp_path: Path) -> None:
    assert read_episode(line_bag(tmp_path / "a.mcap")).held.tolist() == [0, -1, -1, -1, -1]  # the other one is open


def test_poses_at_half_the_rate_are_interpolated(tmp_path: Path) -> None:
    """Every second pose is dropped; the motion is linear at 1 m/s, so interpolation is exact to float32."""
    keep = lambda topic, message, number: None if topic == GRIPPER_POSE and number % 2 else message  # noqa: E731
    back = read_episode(edited_bag(tmp_path / "a.mcap", keep, frames=21))
    assert back.grips.position[:, 0, 1].numpy() == pytest.approx(0.01 * np.arange(21), abs=1e-7)


def test_lost_tracker_frames_become_unmeasured_frames_at_their_times(tmp_path: Path) -> None:
    lose = lambda topic, message, number: None if topic == TRACKER_POINTS and number in (5, 6) else message  # noqa: E731
    back = read_episode(edited_bag(tmp_path / "a.mcap", lose))
    assert np.array_equal(back.stamps, START + np.arange(20) * PERIOD)
    assert np.flatnonzero(~back.tracks.visible.any(1)).tolist() == [5, 6]


def test_a_single_closed_message_counts_for_the_whole_episode(tmp_path: Path) -> None:
    once = lambda topic, message, number: None if topic == GRIPPER_CLOSED and number else message  # noqa: E731
    back = read_episode(edited_bag(tmp_path / "a.mcap", once))
    assert back.grips.closed.tolist() == [[True, False]] * 20


def test_colours_and_big_endian_clouds_are_read(tmp_path: Path) -> None:
    color = np.array([[255, 0, 7], [1, 2, 3]], np.uint8)
    ids, seen = np.array([4, 9], np.uint32), np.ones(2, np.float32)
    message = make_tracker_points(PointFrame(START, np.array([[0.1, 0.2, 0.3], [1.0, 2.0, 3.0]]), ids, seen, color))
    little = read_tracker_points(message, "test")
    message.data = np.frombuffer(message.data.tobytes(), "<u4").astype(">u4").view(np.uint8)
    message.is_bigendian = True
    big = read_tracker_points(message, "test")
    for frame in (little, big):
        assert np.array_equal(frame.color, color)
        assert np.array_equal(frame.id, ids)
        assert frame.position[1].tolist() == [1.0, 2.0, 3.0]


def test_rosbags_reads_what_we_write(tmp_path: Path) -> None:
    path = line_bag(tmp_path / "a.mcap")
    with AnyReader([path]) as reader:
        assert reader.message_count == 60
        assert {c.topic: c.msgtype for c in reader.connections}[TRACKER_POINTS] == "sensor_msgs/msg/PointCloud2"
        connection = next(c for c in reader.connections if c.topic == GRIPPER_POSE)
        (qos,) = connection.ext.offered_qos_profiles
        assert qos.reliability.name == "RELIABLE" and qos.depth == 5
        _, _, data = next(iter(reader.messages([connection])))
        assert reader.deserialize(data, connection.msgtype).poses[0].position.z == 0.5


def test_the_mcap_library_reads_what_we_write(tmp_path: Path) -> None:
    """With checksums verified, the ROS 2 profile, and the index and statistics `ros2 bag play` seeks by."""
    with line_bag(tmp_path / "a.mcap").open("rb") as stream:
        reader = mcap.reader.make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert summary is not None and summary.statistics is not None
        assert summary.statistics.message_count == 60 and len(summary.chunk_indexes) >= 1
        assert {s.encoding for s in summary.schemas.values()} == {"ros2msg"}
        assert {c.message_encoding for c in summary.channels.values()} == {"cdr"}
        decoded = [d.decoded_message for d in reader.iter_decoded_messages(topics=[TRACKER_POINTS])]
        assert len(decoded) == 20 and decoded[3].header.frame_id == "world"
        assert decoded[3].header.stamp.nanosec == 30_000_000


def test_a_recorded_folder_is_a_bag(tmp_path: Path) -> None:
    folder = tmp_path / "recorded"
    folder.mkdir()
    line_bag(folder / "recorded_0.mcap")
    assert open_bag(folder).message_count == 60


def test_a_bag_that_fails_half_way_leaves_nothing_behind(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="wrong type for 'tracker/points'"), BagWriter(tmp_path / "a.mcap") as writer:
        writer.write_raw(TRACKER_POINTS, "std_msgs/msg/String", b"", 0)
    assert list(tmp_path.iterdir()) == []
