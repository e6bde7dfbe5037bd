"""`pred info` of a bag: it finds what `read_episode` refuses, without keeping what the messages hold."""

from __future__ import annotations

import tracemalloc
from pathlib import Path
from typing import Any

import pytest
from bag_examples import Edit, edited_bag, line_bag, line_episode

from pred_core.bag.episode import read_episode, write_episode
from pred_core.bag.summary import TopicSummary, _Clock, summarize_bag
from pred_core.bag.wire import GRIPPER_CLOSED, GRIPPER_POSE, TRACKER_POINTS
from pred_core.cli.main import main
from pred_core.errors import BagError


def dropped(topic: str, first: int, last: int) -> Edit:
    """Messages `first` to `last` of a topic are lost."""

    def edit(name: str, message: Any, number: int) -> Any:
        return None if name == topic and first <= number <= last else message

    return edit


def one_pose_less(name: str, message: Any, number: int) -> Any:
    if name == GRIPPER_POSE and number == 5:
        message.poses = message.poses[:1]
    return message


def one_flag_less(name: str, message: Any, number: int) -> Any:
    if name == GRIPPER_CLOSED:
        message.data = message.data[:1]
    return message


@pytest.mark.parametrize(
    "edit",
    [
        dropped(TRACKER_POINTS, 1, 19),
        dropped(TRACKER_POINTS, 3, 16),
        dropped(GRIPPER_POSE, 12, 19),
        dropped(GRIPPER_POSE, 6, 9),
        dropped(GRIPPER_CLOSED, 0, 8),
        one_pose_less,
        one_flag_less,
    ],
    ids=["one frame", "long gap", "poses end", "hole in poses", "flags begin late", "gripper vanishes", "few flags"],
)
def test_the_report_names_what_reading_refuses(tmp_path: Path, edit: Edit) -> None:
    path = edited_bag(tmp_path / "bad.mcap", edit)
    with pytest.raises(BagError) as refusal:
        read_episode(path)
    assert summarize_bag(path).problems[0].startswith(str(refusal.value))


@pytest.mark.parametrize("edit", [dropped(TRACKER_POINTS, 5, 6), dropped(GRIPPER_POSE, 7, 7)])
def test_what_reading_accepts_is_no_problem(tmp_path: Path, edit: Edit) -> None:
    path = edited_bag(tmp_path / "lost.mcap", edit)
    assert len(read_episode(path).stamps) == 20
    assert summarize_bag(path).problems == []


def test_the_report_says_what_was_checked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(line_bag(tmp_path / "a.mcap"))]) == 0
    assert "checked: every message of the required topics" in capsys.readouterr().out


def peak(path: Path) -> int:
    """Most memory [bytes] that a summary takes."""
    tracemalloc.start()
    assert summarize_bag(path).problems == []
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return most


def test_memory_of_a_summary_does_not_hold_the_bag(tmp_path: Path) -> None:
    # 1200 more frames of 80 particles are 2.3 MB as an episode's positions; their times on three topics, kept
    # twice, are 1200 * 3 * 16 B = 58 kB, and as Python integers while gaps are looked for 43 kB.
    for frames in (300, 1500):
        write_episode(tmp_path / f"{frames}.mcap", line_episode(frames, particles=80))
    peak(tmp_path / "300.mcap")  # the message definitions are loaded once
    assert peak(tmp_path / "1500.mcap") - peak(tmp_path / "300.mcap") < 500_000


def test_bursts_of_several_senders_say_nothing_of_lost_messages() -> None:
    """Seven nodes report within microseconds once a second: nothing is lost. One sender that loses every other of its
    messages, in runs, is still counted.
    """
    burst = _Clock(has_header=False)
    burst.stamps.extend(int(s * 1e9) + 1000 * k for s in range(1, 20) for k in range(7))
    sparse = _Clock(has_header=False)
    sparse.stamps.extend(10_000_000 * n for n in range(100) if n % 8 < 4)
    found = []
    for stamps in (burst, sparse):
        topic = TopicSummary("t", "type", 1, "log")
        stamps.fill(topic)
        found.append(topic.lost)
    assert found == [0, 48]
