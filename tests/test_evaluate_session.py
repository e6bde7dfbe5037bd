"""What drifts over a session is scored as far as it was when an episode was recorded."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from report_cases import COUNT, PERIOD, recorded, rope

from pred_core.bag.dataset import EpisodeEntry, write_dataset
from pred_core.bag.episode import write_episode
from pred_core.baselines import LastResidual
from pred_core.dynamics import on_clock
from pred_core.effects import find_effect
from pred_core.evaluate.cache import PredictionCache
from pred_core.evaluate.evaluation import EpisodeStore, run_model
from pred_core.evaluate.models import NamedTwin, baseline_models, twin_models
from pred_core.evaluate.protocol import predict
from pred_core.evaluate.splits import published
from pred_core.pred import load_dynamics
from pred_core.twin import ResidualWeights, Twin
from pred_core.types import Array, Episode, State

RATE = 0.1  # 1/min: a tenth longer after a minute
FOUND = {"found_by": "pred diagnose"}


def drifting(evidence: dict[str, str]) -> Twin:
    """The rope, of which somebody says that it grows longer while one records."""
    drift = dataclasses.replace(find_effect("length_drift").extension(rate=(RATE,)), evidence=evidence)
    return rope().replace(extensions=(drift,))


def longer() -> Twin:
    """The rope a minute later."""
    return rope().replace(extensions=(find_effect("length_scale").extension(change=(RATE,)),))


@pytest.fixture(scope="module")
def episodes() -> list[Episode]:
    """The same second of a rope at 0 s and at 60 s of a session."""
    (first,) = recorded(rope(), (), ("train",), frames=30)
    stamps = first.stamps + 60 * 10**9
    tracks = dataclasses.replace(first.tracks, stamp=stamps)
    return [first, dataclasses.replace(first, name="ep1", stamps=stamps, tracks=tracks, split="test", recording=1)]


def apart(one: Array, other: Array) -> float:
    """Mean distance [m]."""
    return float(np.linalg.norm(one - other, axis=-1).mean())


def test_a_minute_in_the_rope_is_as_long_as_it_then_is(episodes: list[Episode]) -> None:
    """Within the second it grows by 0.7 mm more (45 cm, 0.1 a minute), which a start that is 45 mm short magnifies."""
    begin = int(episodes[0].stamps[0])
    dynamics = load_dynamics(drifting(FOUND))
    at_start, minute_in = predict(dynamics, episodes, begin)
    unclocked = predict(dynamics, episodes)
    assert np.array_equal(unclocked[0], unclocked[1]) and np.allclose(at_start, unclocked[0], atol=1e-3)
    expected = predict(load_dynamics(longer()), episodes)[1]
    assert apart(minute_in, expected) < 0.1 * apart(minute_in, at_start)


def test_the_last_residual_is_of_the_same_clock(episodes: list[Episode]) -> None:
    """Its first frame is the simulator's own, and so on the session's clock."""
    begin, base = int(episodes[0].stamps[0]), load_dynamics(drifting(FOUND))
    for one, other in zip(predict(LastResidual(base), episodes, begin), predict(base, episodes, begin), strict=True):
        assert np.array_equal(one[0], other[0])


def test_a_clock_is_set_wherever_a_dynamics_keeps_its_simulators() -> None:
    memory = {"base/time": torch.zeros(2), "time": torch.zeros(2), "base/steps": torch.ones(2)}
    state = State(torch.zeros(2, 1, 3), torch.zeros(2, 1, 3), torch.full((2, 1), -1), memory)
    after = on_clock(state, torch.tensor([3.0, 4.0])).memory
    assert after["base/time"].tolist() == after["time"].tolist() == [3.0, 4.0]
    assert after["base/steps"].tolist() == [1.0, 1.0] and set(after) == set(memory)


def test_a_twin_of_a_diagnosis_is_scored_on_the_clock_of_its_data_set(episodes: list[Episode], tmp_path: Path) -> None:
    """The session began with the train episode, though only the test one is scored."""
    for e in episodes:
        write_episode(tmp_path / f"{e.name}.mcap", e)
    entries = [EpisodeEntry(f"{e.name}.mcap", e.split, e.recording) for e in episodes]
    data = write_dataset(tmp_path, object=episodes[0].object, rate=1.0 / PERIOD, entries=entries, held={0: 0})
    store, cache = EpisodeStore(data), PredictionCache(tmp_path / "cache")
    assert store.session() == int(episodes[0].stamps[0])
    twin = drifting(FOUND)
    found = {}
    for named in (NamedTwin("", twin), NamedTwin("later", longer())):
        for model in twin_models(named):
            found[model.name] = run_model(model, published(data, "test"), store, cache, lambda _: None).predictions[0]
    assert found["extended"].shape[1:] == (COUNT, 3)
    assert apart(found["extended"], found["later"]) < 0.1 * apart(found["extended"], found["spring-mass"])


def test_only_what_a_diagnosis_found_goes_by_the_clock() -> None:
    """`pred identify` and `pred train` start at 0 everywhere: what they fitted is scored as they fitted it."""
    twin = drifting(FOUND)
    assert {m.name: m.drifts for m in twin_models(NamedTwin("", twin))} == {"spring-mass": False, "extended": True}
    assert baseline_models(["last-residual"], NamedTwin("", twin))[0].drifts
    assert not any(m.drifts for m in twin_models(NamedTwin("", drifting({}))))
    assert not any(m.drifts for m in twin_models(NamedTwin("", longer())))
    trained = twin.replace(residual=ResidualWeights({}, {}))
    assert [m.drifts for m in twin_models(NamedTwin("", trained))] == [False, True, False]
