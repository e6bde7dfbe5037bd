"""A data set: strict YAML, lazy episodes, folds that never split a recording."""

import shutil
from pathlib import Path

import pytest
from bag_examples import line_bag

from pred_core.bag.dataset import Dataset, EpisodeEntry, load_dataset, write_dataset
from pred_core.errors import BagError, ConfigError, DatasetError
from pred_core.types import ObjectInfo

YAML = """
object: {name: rope, kind: line}
rate: 100.0
held: {10: 0}
known: {mass: 0.05}
episodes:
  - {bag: a.mcap, split: train, recording: 3}
  - {bag: b.mcap, split: train}
"""


def _folder(path: Path, text: str = YAML, bags: tuple[str, ...] = ("a.mcap", "b.mcap")) -> Path:
    for bag in bags:
        line_bag(path / bag)
    (path / "dataset.yaml").write_text(text)
    return path


def test_load_and_read(tmp_path: Path) -> None:
    dataset = load_dataset(_folder(tmp_path))
    assert (dataset.object, dataset.rate, dataset.gravity) == (ObjectInfo("rope", "line"), 100.0, (0.0, 0.0, -9.81))
    assert dataset.sigma is None and dataset.known == {"mass": 0.05} and dataset.held == {10: 0}
    first, second = dataset.episodes("train")
    assert (first.name, first.split, first.recording, first.object.name) == ("a", "train", 3, "rope")
    assert first.held.tolist() == [0, -1, -1, -1, -1]
    assert second.recording == 4  # left out: a recording of its own
    assert load_dataset(tmp_path / "dataset.yaml") == dataset


def test_what_is_written_is_loaded(tmp_path: Path) -> None:
    line_bag(tmp_path / "a.mcap")
    entry = EpisodeEntry("a.mcap", "ood", 5)
    written = write_dataset(
        tmp_path, object=ObjectInfo("s", "sheet"), rate=100, entries=[entry], sigma=1e-3, held={10: 0, 13: 1}
    )
    assert load_dataset(tmp_path) == written
    assert written.entries == (entry,) and written.held == {10: 0, 13: 1} and written.splits == ("ood",)


def test_episodes_are_read_one_by_one(tmp_path: Path) -> None:
    """The second bag is broken; the first episode is there before it is touched."""
    dataset = load_dataset(_folder(tmp_path))
    (tmp_path / "b.mcap").write_bytes(b"nothing")
    episodes = dataset.episodes("train")
    assert next(episodes).name == "a"
    with pytest.raises(BagError, match=r"b\.mcap: not a bag"):
        next(episodes)


def test_sha256_is_that_of_the_file(tmp_path: Path) -> None:
    dataset = load_dataset(_folder(tmp_path))
    (tmp_path / "a.mcap").write_bytes(b"abc")
    # FIPS 180-2, appendix B.1
    assert dataset.sha256(dataset.entries[0]) == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


def test_empty_split(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="split 'test' is empty; got episodes only in train"):
        load_dataset(_folder(tmp_path)).episodes("test")
    with pytest.raises(DatasetError, match="unknown split; got eval; allowed: train, test, ood"):
        load_dataset(tmp_path).episodes("eval")


def test_missing_episode(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"1 of 2 episodes are missing; got no file b\.mcap"):
        load_dataset(_folder(tmp_path, bags=("a.mcap",)))


def test_not_a_data_set(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"not a data set; got no dataset\.yaml in it"):
        load_dataset(tmp_path)
    with pytest.raises(DatasetError, match="not a data set; got no such folder"):
        load_dataset(tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("rate: 100.0", "rates: 100.0", "unknown key 'rates'. did you mean 'rate'?"),
        ("split: train,", "splt: train,", "unknown key 'splt'. did you mean 'split'?"),
        ("mass: 0.05", "mas: 0.05", "unknown key 'mas' in known. did you mean 'mass'?"),
        ("mass: 0.05", "mass: heavy", "known mass; got 'heavy'"),
        ("kind: line", "kind: rope", "got 'rope'; allowed: line, sheet, volume, mixed"),
        ("split: train,", "split: eval,", "got 'eval'; allowed: train, test, ood"),
        ("rate: 100.0", "rate: fast", "rate; got 'fast'"),
        ("rate: 100.0", "rate: -1.0", "rate; got -1.0 Hz"),
        ("held: {10: 0}", "held: {10: left}", "held; got 10: 'left'"),
        ("rate: 100.0", "rate: 100.0\nrate: 30.0", "given twice"),
        ("rate: 100.0", "", "missing key 'rate'"),
    ],
)
def test_strict_yaml(tmp_path: Path, old: str, new: str, words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_dataset(_folder(tmp_path, YAML.replace(old, new, 1)))
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("bag: b.mcap", "bag: a.mcap", "listed twice"),
        ("bag: b.mcap", "bag: ../b.mcap", "a path inside the data set's folder"),
    ],
)
def test_bag_paths(tmp_path: Path, old: str, new: str, words: str) -> None:
    with pytest.raises(DatasetError, match=words):
        load_dataset(_folder(tmp_path, YAML.replace(old, new)))


def test_no_episodes(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="no episodes"):
        load_dataset(_folder(tmp_path, "object: {name: rope, kind: line}\nrate: 100.0\nepisodes: []\n"))


def test_grouped_folds_keep_recordings_whole_and_use_every_episode_once() -> None:
    recordings = [0, 0, 0, 0, 1, 1, 2, 2, 3, 4]
    entries = tuple(
        EpisodeEntry(f"{i}.mcap", "test" if i % 3 == 0 else "train", r) for i, r in enumerate(recordings)
    ) + (EpisodeEntry("o.mcap", "ood", 9),)
    dataset = Dataset(Path("."), ObjectInfo(), 100.0, (0.0, 0.0, -9.81), None, None, {}, entries)
    folds = dataset.grouped_folds(3)
    # Sizes 4, 2, 2, 1, 1 dealt largest first to the smallest fold: 4 | 2 + 1 | 2 + 1.
    assert [len(f.test) for f in folds] == [4, 3, 3]
    assert sorted(e.bag for f in folds for e in f.test) == sorted(e.bag for e in entries[:-1])
    for fold in folds:
        assert not {e.recording for e in fold.train} & {e.recording for e in fold.test}
        assert len(fold.train) + len(fold.test) == 10
    with pytest.raises(DatasetError, match=r"cannot make folds; got 6; allowed: 2 to 5 \(recordings\)"):
        dataset.grouped_folds(6)


def test_a_data_set_can_be_moved(tmp_path: Path) -> None:
    (tmp_path / "here").mkdir()
    _folder(tmp_path / "here")
    shutil.move(tmp_path / "here", tmp_path / "there")
    assert next(load_dataset(tmp_path / "there").episodes()).name == "a"
