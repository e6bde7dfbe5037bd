"""The DEFORM cables: npz and pickles, refused pickles, an interrupted conversion, the contract."""

import json
import pickle
from collections import OrderedDict
from pathlib import Path

import numpy as np
import pytest
import torch

from pred_core.bag.dataset import load_dataset
from pred_core.bag.deform import convert_deform, group_recordings, read_deform
from pred_core.bag.measured import find_measured
from pred_core.bag.pickles import read_pickled_numbers
from pred_core.errors import DatasetError
from pred_core.frames import quaternion_rotate

VERTICES = 7


def _positions(episodes: int = 4, frames: int = 30) -> np.ndarray:
    """Two recordings of two adjacent windows each: a straight cable moving at 1 m/s, the second 0.5 m away."""
    time = np.arange(episodes * frames) * 0.01
    p = np.zeros((episodes * frames, VERTICES, 3))
    p[..., 0] = 0.1 * np.arange(VERTICES)
    p[..., 1] = time[:, None]
    p[..., 2] = 0.4
    p = p.reshape(episodes, frames, VERTICES, 3)
    p[episodes // 2 :, ..., 1] += 0.5
    return p.astype(np.float32)


def _npz(path: Path, **changes: object) -> Path:
    arrays = {
        "positions": _positions(),
        "hz": np.float32(100.0),
        "split": np.array(["train", "train", "train", "eval"]),
        "recording_id": np.array([0, 0, 1, 1]),
        **changes,
    }
    np.savez(path, **{k: v for k, v in arrays.items() if v is not None})
    return path


def _pickles(folder: Path) -> Path:
    for i, (split, p) in enumerate(zip(["train", "train", "train", "eval"], _positions(), strict=True)):
        (folder / split).mkdir(parents=True, exist_ok=True)
        nested = np.swapaxes(p.astype(np.float64), 1, 2).tolist()  # [frame][3][vertex]
        (folder / split / f"{i}.pkl").write_bytes(pickle.dumps(nested))
    return folder


def _quiet(done: int, total: int, name: str) -> None:
    pass


def assert_clamps_turn_with_their_edges(position: np.ndarray, rotation: torch.Tensor) -> None:
    """The rotation takes the vertical (down at the first end, up at the last) to the clamped edge, with no roll."""
    for gripper, (a, b), up in ((0, (0, 1), -1.0), (1, (0, 1), -1.0), (2, (-2, -1), 1.0), (3, (-2, -1), 1.0)):
        edge = torch.as_tensor(position[:, b] - position[:, a], dtype=torch.float32)
        edge = edge / edge.norm(dim=-1, keepdim=True)
        turned = quaternion_rotate(rotation[:, gripper], torch.tensor([0.0, 0.0, up]))
        assert torch.allclose(turned, edge, atol=1e-6)
        assert rotation[:, gripper, 3].abs().max() < 1e-6  # the axis is horizontal


def test_the_data_set_contract(tmp_path: Path) -> None:
    source = read_deform(_npz(tmp_path / "deform_x.npz"))
    dataset = convert_deform(source, tmp_path / "out", _quiet)
    assert (dataset.object.name, dataset.object.kind) == ("deform_x", "line")
    assert (dataset.rate, dataset.sigma, dataset.gravity) == (100.0, 0.00006, (0.0, 0.0, -9.81))
    assert dataset.held == {0: 0, 1: 1, 5: 2, 6: 3}
    assert [e.split for e in dataset.entries] == ["train", "train", "train", "test"]
    assert [e.recording for e in dataset.entries] == [0, 0, 1, 1]
    for i, episode in enumerate(dataset.episodes()):
        assert np.array_equal(episode.position, _positions()[i])
        assert np.array_equal(episode.grips.position.numpy(), _positions()[i][:, [0, 1, 5, 6]])
        assert_clamps_turn_with_their_edges(episode.position, episode.grips.rotation)
        assert bool(episode.grips.closed.all())
        assert episode.held.tolist() == [0, 1, -1, -1, -1, 2, 3]


def test_pickles_give_the_same_episodes_and_find_the_recordings(tmp_path: Path) -> None:
    from_npz = read_deform(_npz(tmp_path / "deform_x.npz"))
    from_pickles = read_deform(_pickles(tmp_path / "X"))
    assert from_pickles.name == "deform_x" and from_pickles.held == from_npz.held
    for a, b in zip(from_npz.position, from_pickles.position, strict=True):
        assert np.array_equal(a, b)
    assert from_pickles.split == from_npz.split
    assert from_pickles.recording == (0, 0, 1, 1)
    assert read_deform(_npz(tmp_path / "unnamed.npz", recording_id=None)).recording == (0, 0, 1, 1)


def test_an_interrupted_conversion_goes_on(tmp_path: Path) -> None:
    source = read_deform(_npz(tmp_path / "x.npz"))

    def interrupt(done: int, total: int, name: str) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        convert_deform(source, tmp_path / "out", interrupt)
    assert not (tmp_path / "out" / "dataset.yaml").exists()
    (tmp_path / "out" / ".ep002.mcap.part").write_bytes(b"half a bag")
    kept = (tmp_path / "out" / "ep000.mcap").stat().st_mtime_ns
    dataset = convert_deform(source, tmp_path / "out", _quiet)
    assert (tmp_path / "out" / "ep000.mcap").stat().st_mtime_ns == kept
    assert len(list(dataset.episodes())) == 4 and not list((tmp_path / "out").glob(".*"))


def test_a_folder_of_another_source_is_left_alone(tmp_path: Path) -> None:
    convert_deform(read_deform(_npz(tmp_path / "x.npz")), tmp_path / "out", _quiet)
    other = read_deform(_npz(tmp_path / "y.npz", recording_id=np.array([0, 1, 2, 3])))
    with pytest.raises(DatasetError, match="holds the data of another source"):
        convert_deform(other, tmp_path / "out", _quiet)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("keep")
    with pytest.raises(DatasetError, match="not empty"):
        convert_deform(other, tmp_path / "mine", _quiet)
    assert (tmp_path / "mine" / "notes.txt").read_text() == "keep"


class _Evil:
    """Unpickled, it leaves a file in the current folder."""

    def __reduce__(self):
        return (Path.touch, (Path("evil_pickle_ran"),))


@pytest.mark.parametrize(
    "content",
    [
        _Evil(),
        np.zeros((3, 3, 4)),
        [[[np.float64(1.0)] * 4] * 3] * 2,
        OrderedDict(),
        {"frames": []},
        [["text"] * 3] * 2,
        {1, 2},
        [[[True] * 4] * 3] * 2,
        [[[None] * 4] * 3] * 2,
    ],
    ids=["code", "array", "numpy scalar", "class", "dict", "text", "set", "bool", "none"],
)
@pytest.mark.parametrize("protocol", [0, 2, 5])
def test_a_pickle_of_anything_else_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: object, protocol: int
) -> None:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "x.pkl"
    path.write_bytes(pickle.dumps(content, protocol))
    with pytest.raises(DatasetError, match="holds more than lists and numbers|frame 0 holds a bool"):
        read_pickled_numbers(path)
    assert not (tmp_path / "evil_pickle_ran").exists()


@pytest.mark.parametrize("protocol", [0, 1, 2, 3, 4, 5])
def test_lists_of_numbers_are_read_in_every_protocol(tmp_path: Path, protocol: int) -> None:
    nested = [[[0.5, 1, -2.25], [1e-3, 4, 5], [7, 8, 2**40]], [[1, 2, 3]] * 3]  # a shared list is one list
    (tmp_path / "x.pkl").write_bytes(pickle.dumps(nested, protocol))
    assert np.array_equal(read_pickled_numbers(tmp_path / "x.pkl"), np.array(nested, float))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ([[[1.0, 2.0], [1.0], [1.0, 2.0]]] * 2, "frame 0 has 1 vertices, the first has 2"),
        ([[[1.0]] * 2] * 2, "frame 0 is not a list of 3 coordinates"),
        ([[[float("nan")]] * 3] * 2, "frame 0 holds nan"),
        ([], "not a list of at least two frames"),
        ([[1.0, 2.0, 3.0]] * 2, "frame 0 does not hold lists"),
    ],
)
def test_uneven_lists_are_refused(tmp_path: Path, content: object, words: str) -> None:
    (tmp_path / "x.pkl").write_bytes(pickle.dumps(content))
    with pytest.raises(DatasetError, match=words):
        read_pickled_numbers(tmp_path / "x.pkl")


@pytest.mark.parametrize("content", [b"", b"hello", b"\x80\x05", b"]r\xff\xff\xff\x7f.", b"(lp0\n", b"0.", b"e."])
def test_bytes_that_are_no_pickle(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "x.pkl").write_bytes(content)
    with pytest.raises(DatasetError):
        read_pickled_numbers(tmp_path / "x.pkl")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"split": None}, "not DEFORM data, no split"),
        ({"hz": np.float32(50.0)}, "hz; got 50.0; allowed: 100.0"),
        ({"positions": np.zeros((4, 30, 7, 2), np.float32)}, "positions; got"),
        ({"positions": np.zeros((4, 1, 7, 3), np.float32)}, "2 frames or more"),
        ({"split": np.array(["train", "train", "train", "maybe"])}, "unknown split; got 'maybe'"),
        ({"positions": np.full((4, 30, 7, 3), np.nan, np.float32)}, "not finite"),
        ({"positions": 1000.0 * _positions()}, "are these millimetres"),
        ({"split": np.array(["train"])}, "arrays of different lengths"),
        ({"positions": _positions()[:, :, :4]}, "vertices per episode; got"),
    ],
)
def test_bad_npz(tmp_path: Path, changes: dict[str, object], words: str) -> None:
    with pytest.raises(DatasetError) as caught:
        read_deform(_npz(tmp_path / "x.npz", **changes))
    assert words in str(caught.value)


def test_not_an_npz(tmp_path: Path) -> None:
    (tmp_path / "x.npz").write_bytes(b"PK\x03\x04 no zip")
    for path in (tmp_path / "x.npz", tmp_path / "missing.npz"):
        with pytest.raises(DatasetError, match="not an npz file"):
            read_deform(path)
    with pytest.raises(DatasetError, match="no episodes"):
        read_deform(tmp_path)


@pytest.mark.parametrize(("name", "recordings"), [("deform_dlo1", 9), ("deform_dlo2", 20)])
def test_the_published_cables(name: str, recordings: int, tmp_path: Path) -> None:
    """70 episodes, 14 for test; recordings found from the motion are exactly those listed with the data."""
    path = find_measured(name + ".npz")
    if path is None:
        pytest.skip(f"no measured data {name}.npz (README.md, 'measured data')")
    source = read_deform(path)
    assert (len(source.position), source.split.count("test")) == (70, 14)
    found = group_recordings(source.position)
    assert len(set(found)) == recordings
    assert len(set(zip(found, source.recording, strict=True))) == recordings


def test_the_source_is_noted(tmp_path: Path) -> None:
    source = read_deform(_npz(tmp_path / "x.npz"))
    convert_deform(source, tmp_path / "out", _quiet)
    assert json.loads((tmp_path / "out" / "source.json").read_text())["sha256"] == source.digest
    assert load_dataset(tmp_path / "out").root == tmp_path / "out"
