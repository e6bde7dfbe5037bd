"""What an evaluation must not hide: fold twins with less, leaks, damaged files, flags that depend on the cache."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from evaluation_cases import swinging_cable

from pred_core.bag.dataset import Dataset, EpisodeEntry, write_dataset
from pred_core.bag.episode import write_episode
from pred_core.cli.main import main
from pred_core.errors import TwinError
from pred_core.evaluate.cache import PredictionCache
from pred_core.evaluate.evaluation import EpisodeStore, run_all, run_model
from pred_core.evaluate.models import NamedTwin, baseline_models, twin_models
from pred_core.evaluate.splits import grouped, published
from pred_core.springmass.topology import build_body
from pred_core.twin import Extension, ResidualWeights, Twin, TwinMeta
from pred_core.types import ObjectInfo, Physics


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Four recordings; ep001, which no test tests, has a marker that jumps by 10 cm and back once."""
    root = tmp_path_factory.mktemp("cable")
    entries = []
    for i in range(4):
        episode = swinging_cable(i, frames=35, name=f"ep{i:03d}")
        if i == 1:
            episode.position[20, 2, 1] += 0.1
        write_episode(root / f"ep{i:03d}.mcap", episode)
        entries.append(EpisodeEntry(f"ep{i:03d}.mcap", "test" if i == 0 else "train", i))
    return write_dataset(root, object=ObjectInfo("cable", "line"), rate=100.0, entries=entries, held={0: 0, 5: 1})


@pytest.fixture(scope="module")
def twin() -> Twin:
    """A plain twin of six particles."""
    physics = Physics(stiffness=200.0, damping=0.1, connection_threshold=0.15)
    body = build_body("line", swinging_cable(0).position[0], 0.05, physics, id=np.arange(6, dtype=np.uint32))
    return Twin(TwinMeta(object=ObjectInfo("cable", "line"), period=0.01), body, physics)


RESIDUAL = ResidualWeights({}, {})
DRAG = Extension("drag_linear", 1, {"coefficient": (0.1,)})


def lacking(main_twin: Twin, fold: Twin, name: str = "") -> dict[str, str]:
    return {m.name: m.lacking for m in twin_models(NamedTwin(name, main_twin, (main_twin, fold)))}


def test_a_fold_twin_with_less_is_never_scored_under_the_name_of_the_whole(twin: Twin) -> None:
    extended = twin.replace(extensions=(DRAG,), base=twin)
    full = extended.replace(residual=RESIDUAL)
    assert lacking(full, full) == {"spring-mass": "", "extended": "", "pred": ""}
    assert lacking(full, extended) == {"spring-mass": "", "extended": "", "pred": "fold twins have no residual"}
    assert lacking(full, full.replace(base=None))["spring-mass"] == "fold twins have no base"
    without = lacking(full, full.replace(extensions=()))
    assert without["extended"] == without["pred"] == "the twin of fold 1 has extensions none, the twin has drag_linear"
    assert lacking(twin, full, "plain") == {"plain": "only the fold twins have a residual"}


def test_what_fold_twins_lack_is_listed_as_not_computed(dataset: Dataset, twin: Twin, tmp_path: Path) -> None:
    models = twin_models(NamedTwin("", twin.replace(residual=RESIDUAL), (twin, twin)))
    results, missing = run_all(
        models, frozenset(), [grouped(dataset, 2)], EpisodeStore(dataset), PredictionCache(tmp_path), lambda _: None
    )
    assert [r.model.name for r in results] == ["spring-mass"]
    assert [(m.model, m.reason) for m in missing] == [("pred", "fold twins have no residual")]


def test_a_fold_twin_fitted_on_what_its_fold_tests_is_refused(dataset: Dataset, twin: Twin, tmp_path: Path) -> None:
    split = grouped(dataset, 2)

    def fitted_on(hashes: tuple[str, ...]) -> Twin:
        return twin.replace(meta=dataclasses.replace(twin.meta, data=hashes))

    def run(folds: tuple[Twin, ...]) -> int:
        models = twin_models(NamedTwin("", twin, folds))
        store, cache = EpisodeStore(dataset), PredictionCache(tmp_path)
        return len(run_all(models, frozenset(), [split], store, cache, lambda _: None)[0])

    honest = tuple(fitted_on(tuple(dataset.sha256(e) for e in fold.train)) for fold in split.folds)
    assert run(honest) == 1
    assert run((twin, twin)) == 1, "a twin that stores no hashes cannot be checked"
    leaky = split.folds[1].test[0].bag
    with pytest.raises(TwinError, match=f"fold 1 was fitted on {leaky}"):
        run((honest[0], fitted_on(split.folds[1].test_hashes[:1])))


def test_last_residual_counts_the_leaks_of_its_twin(dataset: Dataset, twin: Twin, tmp_path: Path) -> None:
    seen = twin.replace(meta=dataclasses.replace(twin.meta, data=(dataset.sha256(dataset.select("test")[0]),)))
    (model,) = baseline_models(["last-residual"], NamedTwin("", seen))
    result = run_model(
        model, published(dataset, "test"), EpisodeStore(dataset), PredictionCache(tmp_path), lambda _: None
    )
    assert result.tested_on_training_data == 1


def test_the_gate_sees_every_bag_on_every_run_and_damaged_files_are_made_again(
    dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["evaluate", str(dataset.root), "--out", str(tmp_path), "--baselines", "persistence"]
    assert main(command) == 0
    first = json.loads((tmp_path / "metrics.json").read_text())
    jumped = [f["episode"] for f in first["flagged_episodes"] if any("jump" in flag for flag in f["flags"])]
    assert jumped == ["ep001"], "an episode that no model reads"
    assert "damaged" not in capsys.readouterr().err
    assert main(command) == 0
    assert json.loads((tmp_path / "metrics.json").read_text()) == first
    kept = sorted((tmp_path / "cache").iterdir())
    assert [p.suffix for p in kept] == [".npz", ".json"] or [p.suffix for p in kept] == [".json", ".npz"]
    for path in kept:
        path.write_bytes(path.read_bytes()[:-40])
    assert main(command) == 0
    told = [line for line in capsys.readouterr().err.splitlines() if "damaged, computed again" in line]
    assert len(told) == 2
    assert json.loads((tmp_path / "metrics.json").read_text()) == first


@pytest.mark.parametrize("place", [0, 30, 200, -60, -10])
def test_a_changed_byte_in_the_cache_is_never_a_traceback(tmp_path: Path, place: int) -> None:
    cache = PredictionCache(tmp_path)
    cache.store("a", [np.ones((20, 4, 3))])
    path = tmp_path / "a.npz"
    data = bytearray(path.read_bytes())
    data[place] ^= 0xFF
    path.write_bytes(bytes(data))
    found = cache.load("a", [(20, 4, 3)])
    assert found is None or np.array_equal(found[0], np.ones((20, 4, 3)))
    assert cache.load("b", [(20, 4, 3)]) is None
    cache.store("a", [np.ones((20, 4, 3))])
    assert cache.load("a", [(21, 4, 3)]) is None, "predictions of other episodes"
