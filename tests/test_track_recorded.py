"""`pred track`: pictures of a bag become a data set, once and for all the same; what cannot be used is said."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

pytest.importorskip("cv2", reason="OpenCV is not installed")

from pred_core.bag import images
from pred_core.bag.dataset import FILE, load_dataset
from pred_core.bag.reader import BagMessage, open_bag
from pred_core.bag.wire import GRIPPER_CLOSED, GRIPPER_POSE, TRACKER_POINTS, decode, encode, stamp_of
from pred_core.bag.writer import BagWriter
from pred_core.cli.main import main

ROOT = Path(__file__).parents[1]
PICTURES = ROOT / "bags" / "sample_cameras.mcap"
SETTINGS = str(ROOT / "config" / "nodes" / "reroute.yaml")
PERIOD = 1.0 / 15.0  # [s] of the pictures
Change = Callable[[BagMessage], Any]


def cut(path: Path, instants: int, change: Change = lambda message: True, first: int = 0) -> Path:
    """The sample from instant `first` on, `instants` of them; `change` drops a message (None, False) or replaces it."""
    begin = open_bag(PICTURES).log_begin + round(first * PERIOD * 1e9)
    last = begin + round((instants - 0.5) * PERIOD * 1e9)
    with BagWriter(path) as writer:
        for message in open_bag(PICTURES).read_messages():
            latched = message.topic.endswith(images.POSE) and message.topic != GRIPPER_POSE
            if not latched and not begin <= message.log_time <= last:
                continue
            changed = change(message)
            if changed is True:
                writer.write_raw(message.topic, message.type, message.data, message.log_time)
            elif changed:
                writer.write_raw(message.topic, message.type, encode(changed), message.log_time)
    return path


def track(source: Path, out: Path, *more: str) -> int:
    return main(["track", str(source), "--settings", SETTINGS, "--out", str(out), *more])


def test_the_sample_becomes_a_data_set_in_which_the_rope_hangs_in_the_gripper(tmp_path: Path) -> None:
    assert track(PICTURES, tmp_path / "set", "--name", "rope", "--held", "0:0 1:0") == 0
    dataset = load_dataset(tmp_path / "set")
    assert (dataset.object.name, dataset.object.kind, dataset.rate) == ("rope", "line", 15.0)
    assert dataset.held == {0: 0, 1: 0}
    (episode,) = dataset.episodes("test")
    assert episode.position.shape == (25, 30, 3) and np.isfinite(episode.position).all()
    edges = np.linalg.norm(np.diff(episode.position, axis=1), axis=-1)
    assert np.abs(edges.sum(axis=1) - 0.7).max() < 0.01  # [m] the settings say how long it is
    assert np.abs(edges / edges.mean() - 1.0).max() < 0.1  # evenly along the line
    tool = episode.grips.position[:, 0].double().numpy()
    assert np.linalg.norm(tool[-1] - tool[0]) > 0.1, "the arm moves"
    assert np.linalg.norm(episode.position[:, 0] - tool, axis=-1).max() < 0.003
    for topic in (GRIPPER_POSE, GRIPPER_CLOSED):
        theirs, ours = ([m.data for m in open_bag(b).read_messages((topic,))] for b in (PICTURES, _bag(tmp_path)))
        assert theirs == ours, "what the gripper said is kept"


def _bag(folder: Path) -> Path:
    return folder / "set" / "sample_cameras.mcap"


def test_it_is_causal_and_repeatable(tmp_path: Path) -> None:
    """The first instants are the same, bit for bit, whatever is recorded later; and in every run."""
    tracks = {}
    for name, instants in (("short", 6), ("long", 9), ("again", 9)):
        assert track(cut(tmp_path / f"{name}.mcap", instants), tmp_path / name) == 0
        bag = tmp_path / name / f"{name}.mcap"
        tracks[name] = [m.data for m in open_bag(bag).read_messages((TRACKER_POINTS,))]
    assert len(tracks["short"]) == 6 and tracks["long"][:6] == tracks["short"]
    assert tracks["again"] == tracks["long"]


def test_a_refused_run_does_not_claim_the_folder(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    source, out = cut(tmp_path / "source.mcap", 4), tmp_path / "set"
    assert track(source, out, "--cameras", "cam0 cam7") == 2
    assert track(source, out, "--held", "0:5") == 2
    assert "held names gripper 5; got 1 grippers; allowed: 0 to 0" in capsys.readouterr().err
    assert track(source, out, "--held", "300:0") == 2
    assert "300" in capsys.readouterr().err and not (out / FILE).exists()
    assert track(source, out, "--held", "0:0") == 0 and load_dataset(out).held == {0: 0}
    assert track(source, out, "--cameras", "cam0 cam1") == 2
    assert "holds the data of another source or other settings" in capsys.readouterr().err


def test_cameras_are_found_whatever_their_drivers_call_them(tmp_path: Path) -> None:
    tracks = {}
    for name in ("cam", "cells/left/realsense"):
        folder = tmp_path / name
        folder.mkdir(parents=True)
        with BagWriter(folder / "one.mcap") as writer:
            for message in open_bag(cut(folder / "before.mcap", 4)).read_messages():
                topic = message.topic.replace("cam", name, 1) if message.topic.startswith("cam") else message.topic
                writer.write_raw(topic, message.type, message.data, message.log_time)
        cameras = " ".join(f"{name}{k}" for k in range(4))
        assert open_bag(folder / "one.mcap").cameras == tuple(cameras.split())
        assert track(folder / "one.mcap", folder / "out", "--cameras", cameras) == 0
        tracks[name] = [m.data for m in open_bag(folder / "out" / "one.mcap").read_messages((TRACKER_POINTS,))]
    assert len(tracks["cam"]) == 4 and tracks["cells/left/realsense"] == tracks["cam"]


def make_set(folder: Path) -> Path:
    """Two bags of pictures with facts, as a user would write it."""
    folder.mkdir()
    cut(folder / "a.mcap", 4)
    cut(folder / "b.mcap", 4, first=8)
    facts = {
        "object": {"name": "my rope", "kind": "line"},
        "rate": 15.0,
        "held": {0: 0},
        "known": {"mass": 0.05},
        "episodes": [
            {"bag": "a.mcap", "split": "train", "recording": 4},
            {"bag": "b.mcap", "split": "test", "recording": 7, "held": {0: 0, 1: 0}},
        ],
    }
    (folder / FILE).write_text(yaml.safe_dump(facts))
    return folder


def test_a_data_set_keeps_its_facts_and_what_was_finished(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    source, out = make_set(tmp_path / "pictures"), tmp_path / "set"
    assert track(source, out) == 0
    dataset = load_dataset(out)
    assert (dataset.object.name, dataset.held, dataset.known) == ("my rope", {0: 0}, {"mass": 0.05})
    assert [(e.bag, e.split, e.recording, e.held) for e in dataset.entries] == [
        ("a.mcap", "train", 4, None),
        ("b.mcap", "test", 7, {0: 0, 1: 0}),
    ]
    finished = (out / "b.mcap").read_bytes()
    (out / "a.mcap").rename(tmp_path / "kept.mcap")  # as if it had been interrupted
    (out / FILE).unlink()
    capsys.readouterr()
    assert track(source, out) == 0
    said = capsys.readouterr().out
    assert "a: the line found" in said and "b: the line found" not in said
    assert (out / "b.mcap").read_bytes() == finished
    points = [[m.data for m in open_bag(p).read_messages()] for p in (tmp_path / "kept.mcap", out / "a.mcap")]
    assert points[0] == points[1]
    assert track(source, out, "--particles", "31") == 2
    line = capsys.readouterr().err.strip().splitlines()[-1]
    assert "other settings" in line and "particles 30" in line and "particles 31" in line


def test_settings_for_another_kind_of_object_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    source = make_set(tmp_path / "pictures")
    text = (source / FILE).read_text()
    (source / FILE).write_text(text.replace("kind: line", "kind: sheet"))
    assert track(source, tmp_path / "set", "--kind", "line") == 2
    assert "its object is a sheet; got kind line" in capsys.readouterr().err


def no_calibration(message: BagMessage) -> bool:
    return not message.topic.endswith(images.INFO)


def other_clock(message: BagMessage) -> Any:
    """Depth of cam1 is stamped 1 ms later than its colour."""
    if message.topic != f"cam1/{images.DEPTH_COMPRESSED}":
        return True
    decoded = decode(message.data, message.type, message.where)
    nanoseconds = stamp_of(decoded) + 1_000_000
    decoded.header.stamp.sec, decoded.header.stamp.nanosec = divmod(nanoseconds, 10**9)
    return decoded


BAD: tuple[tuple[str, Change, tuple[str, ...], str], ...] = (
    ("nothing of the arm", lambda m: m.topic != GRIPPER_POSE, (), "no topic 'gripper/pose'"),
    ("no calibration", no_calibration, (), "calibration missing"),
    ("no pictures", lambda m: "/color/image" not in m.topic, (), "no pictures of cameras; got cam0"),
    ("another camera", lambda m: True, ("--cameras", "cam0 cam7"), "no camera 'cam7'"),
    ("nothing there", lambda m: True, ("--x-low", "-0.7", "--x-high", "-0.3"), "never found"),
    ("unknown kind", lambda m: True, ("--kind", "rope"), "allowed: line, sheet, volume"),
    ("too few", lambda m: True, ("--particles", "1"), "allowed: 4 to 5000"),
)


@pytest.mark.parametrize(("change", "more", "said"), [b[1:] for b in BAD], ids=[b[0] for b in BAD])
def test_bad_input_is_one_line_and_leaves_no_bag(
    change: Change, more: tuple[str, ...], said: str, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    source, out = cut(tmp_path / "source.mcap", 3, change), tmp_path / "set"
    assert track(source, out, *more) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("pred: ")]
    assert len(lines) == 1 and said in lines[0], lines
    assert not list(out.glob("*.mcap"))


def test_a_camera_that_cannot_be_used_is_counted_and_the_others_go_on(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    assert track(cut(tmp_path / "source.mcap", 12, other_clock), tmp_path / "set") == 0
    captured = capsys.readouterr()
    assert "found in 12 of 12 instants" in captured.out
    assert "pictures not used: cam1: colour and depth of different stamps" in captured.err


def test_the_settings_file_is_strict(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    for text, said in (
        ("tracker: {ros__parameters: {particels: 30}}", "did you mean 'particles'?"),
        ("predictor: {ros__parameters: {}}", "no settings of the tracker"),
        ("tracker: {ros__parameters: {particles: 30.5}}", "particles"),
    ):
        bad = tmp_path / "bad.yaml"
        bad.write_text(text)
        assert main(["track", str(PICTURES), "--settings", str(bad), "--out", str(tmp_path / "set")]) == 2
        assert said in capsys.readouterr().err
