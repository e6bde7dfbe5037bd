"""Evaluation: the protocol, statistics that hide nothing, and the command from bags to metrics.json."""

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from evaluation_cases import episode_of, swinging_cable

from pred_core.bag.dataset import EpisodeEntry, write_dataset
from pred_core.bag.episode import write_episode
from pred_core.baselines import Persistence
from pred_core.cli.main import main
from pred_core.errors import DatasetError, DivergenceError, InputError, TwinError
from pred_core.evaluate.bootstrap import bootstrap_interval
from pred_core.evaluate.cache import PredictionCache
from pred_core.evaluate.evaluation import EpisodeStore, Result, entry, run_model
from pred_core.evaluate.models import Model, NamedTwin, twin_models
from pred_core.evaluate.protocol import diverged_at, predict
from pred_core.evaluate.scores import score_episode, statistics
from pred_core.evaluate.splits import HashedFold, Split, grouped, published
from pred_core.evaluate.where import error_by_speed, error_map, error_spectrum
from pred_core.report import Page, Track, animation
from pred_core.springmass.topology import build_body
from pred_core.twin import Twin, TwinMeta
from pred_core.types import Grip, ObjectInfo, Physics, State


@dataclass(frozen=True)
class Exploding(Persistence):
    """Persistence that leaves the finite numbers once the first gripper has passed x = 0.5 m."""

    value: float = float("nan")
    refuse: bool = False  # raise, as a simulator does, instead of returning what is not finite

    def step(self, state: State, grip: Grip) -> State:
        after = super().step(state, grip)
        gone = (grip.position[..., :1, :1] > 0.5).expand_as(after.position)
        if self.refuse and bool(gone.any()):
            raise DivergenceError("a world left the finite numbers")
        return after.replace(position=torch.where(gone, self.value, after.position))


def moved_cable(step: float, frames: int = 40, name: str = "ep"):
    """Five particles on a line; the left end is held and moves by `step` [m] a frame, the others stand still."""
    position = np.zeros((frames, 5, 3))
    position[:, 1:, 0] = np.linspace(0.1, 0.4, 4)
    position[:, 0, 0] = step * np.arange(frames)
    return episode_of(position, [0, -1, -1, -1, -1], name=name)


def test_prediction_starts_at_frame_two_and_keeps_the_order_of_mixed_lengths():
    episodes = [swinging_cable(0, frames=30), swinging_cable(1, frames=50), swinging_cable(2, frames=30)]
    out = predict(Persistence(0.01), episodes)
    assert [len(p) for p in out] == [28, 48, 28]
    for prediction, episode in zip(out, episodes, strict=True):
        assert np.allclose(prediction[:, 1:-1], episode.position[1, 1:-1], atol=1e-6)
        assert np.allclose(prediction[:, 0], episode.position[2:, 0], atol=1e-6)


@pytest.mark.parametrize(("value", "refuse"), [(float("nan"), False), (1e6, False), (0.0, True)])
def test_divergence_is_dated_and_leaves_the_other_episodes_alone(value, refuse):
    # The gripper passes 0.5 m at frame 26 (0.52 m at 0.02 m a frame), which is step 25; the other stays below.
    episodes = [moved_cable(0.02, name="fast"), moved_cable(0.001, name="slow")]
    out = predict(Exploding(0.01, value, refuse), episodes)
    assert diverged_at(out[0]) == 25
    assert diverged_at(out[1]) is None
    assert np.array_equal(out[1], predict(Persistence(0.01), episodes)[1])
    scores = [score_episode(p, e) for p, e in zip(out, episodes, strict=True)]
    assert (scores[0].diverged, scores[1].diverged) == (25, None)
    assert not scores[0].curves, "no score of a diverged episode can enter a mean"


def test_episodes_that_cannot_stand_side_by_side_are_refused():
    with pytest.raises(DatasetError, match="particle count differs"):
        predict(Persistence(0.01), [swinging_cable(0, count=6), swinging_cable(1, count=7)])
    with pytest.raises(TwinError, match="steps 0.1 s but frames are 0.01 s apart"):
        predict(Persistence(0.1), [swinging_cable(0)])
    with pytest.raises(DatasetError, match="no episodes"):
        predict(Persistence(0.01), [])
    hidden = swinging_cable(0).position.copy()
    hidden[1, 2] = np.nan
    with pytest.raises(InputError, match=r"particles \[2\] are not measured"):
        predict(Persistence(0.01), [episode_of(hidden, [0, -1, -1, -1, -1, 1])])


def test_scores_at_step_30_and_over_all_steps_by_hand():
    # Particle 1 of 5 drifts by 1 mm a frame along z from frame 1 on; persistence keeps it, so after step n the
    # error is n mm there and 0 elsewhere: mde n/5 mm, coordinate_l1 n/15 mm. Over n = 1..38 the mean of n is 19.5.
    episode = moved_cable(0.0)
    episode.position[1:, 1, 2] = 1e-3 * np.arange(39)
    score = score_episode(predict(Persistence(0.01), [episode])[0], episode)
    split = Split("test", (HashedFold((), (), "sha", ()),), grouped=False)
    model = Model("persistence", "p", lambda *a: Persistence(0.01))
    made = entry(Result(model, split, (episode,), (), (score,), 0, 0), seed=0)
    mde, l1 = made["metrics"]["mde"], made["metrics"]["coordinate_l1"]
    assert mde["step_30"]["mean"] == pytest.approx(30e-3 / 5, abs=1e-7)
    assert mde["all_steps"]["mean"] == pytest.approx(19.5e-3 / 5, abs=1e-7)
    assert l1["all_steps"]["mean"] == pytest.approx(19.5e-3 / 15, abs=1e-7)
    assert (l1["all_steps"]["episodes"], l1["all_steps"]["low_95"]) == (1, None), "one episode has no interval"
    # EMD is taken at steps 10, 20, 30: the drifting particle's best match is itself, so (10 + 20 + 30) / 3 / 5 mm.
    assert made["metrics"]["emd"]["all_steps"]["mean"] == pytest.approx(20e-3 / 5, abs=1e-7)


def test_statistics_of_known_values():
    made = statistics({"a": 1.0, "b": 3.0, "c": float("nan")}, np.random.default_rng(0))
    assert (made["mean"], made["median"], made["episodes"]) == (2.0, 2.0, 2)
    assert made["std"] == pytest.approx(np.sqrt(2.0))
    assert (made["low_95"], made["high_95"]) == (1.0, 3.0)
    assert "c" not in made["per_episode"]


def test_bootstrap_interval_covers_the_true_mean_about_95_percent_of_the_time():
    # 300 sets of 30 normal values: the percentile interval covers 93 to 94 % at n = 30; the binomial spread of
    # 300 trials is 1.4 %, so 89 to 98 % is three of them.
    rng = np.random.default_rng(1)
    hits = 0
    for _ in range(300):
        low, high = bootstrap_interval(rng.normal(2.0, 1.0, 30), rng, draws=1000)
        hits += low <= 2.0 <= high
    assert 0.89 < hits / 300 < 0.98
    with pytest.raises(InputError, match="too few"):
        bootstrap_interval(np.array([1.0]), rng)


def test_error_map_tells_vertical_from_along_and_out_of_plane():
    # Ends along x: a prediction 1 cm too high and 2 cm to the side (y) at particle 2 only.
    cable = np.zeros((20, 4, 3))
    cable[:, :, 0] = np.linspace(0, 0.6, 4)
    episode = episode_of(cable, [0, -1, -1, 1])
    prediction = cable[2:].copy()
    prediction[:, 2] += (0.0, 0.02, 0.01)
    where = error_map([prediction], [episode])
    assert where.directions == ("along", "vertical", "out of plane")
    assert where.absolute[2].tolist() == pytest.approx([0.0, 0.01, 0.02])
    assert where.bias[2, 1] == pytest.approx(0.01)
    assert np.abs(where.absolute[[0, 1, 3]]).max() == 0.0


def test_error_spectrum_finds_the_frequency_of_a_sine():
    # 100 frames at 100 Hz: bins of 1 Hz. A 5 Hz error has no power below 5 Hz and all of it at or below.
    cable = np.zeros((102, 3, 3))
    cable[:, :, 0] = np.linspace(0, 0.6, 3)
    prediction = cable[2:].copy()
    prediction[:, 1, 2] += 0.01 * np.sin(2 * np.pi * 5 * np.arange(100) / 100)
    frequency, share = error_spectrum([prediction], [episode_of(cable, [0, -1, 1])])
    assert share[frequency < 4.5].max() == pytest.approx(0.0, abs=1e-12)
    assert share[np.isclose(frequency, 5.0)] == pytest.approx(1.0)


def test_error_by_speed_puts_the_error_where_the_gripper_is_fast():
    # The left end stands for 20 frames, then moves at 1 m/s; particle 1 of 5 is 15 mm off along z while it moves.
    cable = moved_cable(0.0, frames=42).position
    cable[22:, 0, 0] = 0.01 * np.arange(1, 21)
    prediction = cable[2:].copy()
    prediction[20:, 1, 2] += 0.015
    speed, error = error_by_speed([prediction], [episode_of(cable, [0, -1, -1, -1, -1])], bins=2)
    assert speed.tolist() == pytest.approx([0.0, 1.0])
    assert error.tolist() == pytest.approx([0.0, 1e-3])


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Six recordings of two episodes; the published split puts windows of recordings 0 and 1 on both sides."""
    root = tmp_path_factory.mktemp("cable")
    entries = []
    for i in range(12):
        write_episode(root / f"ep{i:03d}.mcap", swinging_cable(i, frames=45, name=f"ep{i:03d}"))
        split = "test" if i in (0, 2, 11) else "train"
        entries.append(EpisodeEntry(f"ep{i:03d}.mcap", split, i // 2))
    held = {0: 0, 5: 1}
    return write_dataset(root, object=ObjectInfo("cable", "line"), rate=100.0, entries=entries, held=held)


def test_grouped_folds_test_each_episode_once_and_never_share_a_recording(dataset):
    split = grouped(dataset, 3)
    tested = [e.bag for fold in split.folds for e in fold.test]
    assert sorted(tested) == sorted(e.bag for e in dataset.entries)
    for fold in split.folds:
        assert not {e.recording for e in fold.test} & {e.recording for e in fold.train}
    assert len({fold.digest for fold in split.folds}) == 3


def test_leak_of_the_published_split_is_counted_and_predictions_are_reused(dataset, tmp_path):
    built = []

    def build(test, train, fold):
        built.append(len(train))
        return Persistence(test[0].period)

    model = Model("persistence", "digest", build)
    store, cache = EpisodeStore(dataset), PredictionCache(tmp_path)
    first = run_model(model, published(dataset, "test"), store, cache, lambda _: None)
    assert first.same_recording == 3, "ep000, ep002 and ep011 all have a sibling in training"
    again = run_model(model, published(dataset, "test"), store, cache, lambda _: None)
    assert built == [9], "the second run takes the predictions of the first"
    assert all(np.array_equal(a, b) for a, b in zip(first.predictions, again.predictions, strict=True))
    run_model(Model("persistence", "other", build), published(dataset, "test"), store, cache, lambda _: None)
    assert built == [9, 9], "another model is not"


def interrupted_after(read, calls):
    """`read` that is interrupted by the user at the given call."""
    left = [calls]

    def interrupted(*args):
        left[0] -= 1
        if left[0] < 0:
            raise KeyboardInterrupt
        return read(*args)

    return interrupted


def small_twin(path, ids):
    episode = swinging_cable(0)
    physics = Physics(stiffness=200.0, damping=0.1, connection_threshold=0.15)
    body = build_body("line", episode.position[0][: len(ids)], 0.05, physics, id=np.array(ids, dtype=np.uint32))
    Twin(TwinMeta(object=ObjectInfo("cable", "line"), period=0.01), body, physics,
         physics_report={"stiffness": {"spread": 0.1, "at_bound": False}}).save(path)
    return str(path)


def test_command_interrupted_and_run_again_writes_json_and_report(dataset, tmp_path, capsys, monkeypatch):
    twin, out = small_twin(tmp_path / "twin", range(6)), tmp_path / "out"
    command = ["evaluate", str(dataset.root), "--twin", twin, "--out", str(out), "--folds", "3"]
    with monkeypatch.context() as patch:
        patch.setattr(EpisodeStore, "read", interrupted_after(EpisodeStore.read, 8))
        assert main(command) == 130
    assert not (out / "metrics.json").exists(), "nothing half done looks finished"
    capsys.readouterr()
    assert main(command) == 0
    # Reads are: one to check twins, then test and train of each model and fold; the ninth read stops the fourth model.
    assert capsys.readouterr().err.count("kept from before") == 3
    numbers = json.loads((out / "metrics.json").read_text())
    made = {(e["model"], e["split"]): e for e in numbers["entries"]}
    names = {"spring-mass", "persistence", "constant-velocity", "blended-ends", "static-regression", "last-residual"}
    assert {m for m, s in made if s == "test"} == names
    assert {m for m, s in made if s != "test"} == names - {"spring-mass", "last-residual"}, "a twin needs one a fold"
    assert {m["model"] for m in numbers["not_computed"] if "model" in m} == {"spring-mass", "last-residual"}
    for e in made.values():
        for metric in e["metrics"].values():
            for when in ("step_30", "all_steps"):
                s = metric[when]
                assert s["low_95"] <= s["mean"] <= s["high_95"]
                assert s["episodes"] == len(s["per_episode"]) == e["episodes_tested"]
    report = (out / "report.html").read_text()
    assert "http://" not in report.replace("http://www.w3.org", "") and "src=\"http" not in report, "self-contained"
    assert "connection_threshold" in report and "<canvas" not in report and 'createElement("canvas")' in report


def test_each_fold_is_predicted_by_its_own_twin_and_fitting_on_tested_bags_is_counted(dataset, tmp_path):
    twin = Twin.load(Path(small_twin(tmp_path / "twin", range(6))))
    tested = dataset.sha256(dataset.select("test")[0])
    twin = twin.replace(meta=dataclasses.replace(twin.meta, data=(tested, "another")))
    # The fold twins step differently, so that each is known by its period.
    folds = tuple(twin.replace(meta=dataclasses.replace(twin.meta, period=p)) for p in (0.02, 0.03))
    (model,) = twin_models(NamedTwin("", twin, folds))
    episodes = EpisodeStore(dataset).read(dataset.select("test"))
    assert [model.build(episodes, (), f).period for f in (None, 0, 1)] == [0.01, 0.02, 0.03]
    assert model.fold_twins == 2
    with pytest.raises(TwinError, match="no twin for fold 2"):
        model.build(episodes, (), 2)
    split, cache = published(dataset, "test"), PredictionCache(tmp_path)
    result = run_model(model, split, EpisodeStore(dataset), cache, lambda _: None)
    assert result.tested_on_training_data == 1


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--split", "ood"], "split 'ood' is empty"),
        (["--baselines", "persistance"], "did you mean 'persistence'?"),
        (["--baselines", "last-residual"], "Name one with --twin"),
        (["--folds", "9"], "cannot make folds"),
        (["--twin", "{five}"], "particle ids differ"),
        (["--twin", "{six}", "--twin", "{six}"], "two twins have no name"),
        (["--twin", "{nowhere}"], "not a twin"),
        (["--twin", "{six}", "--fold-twins", "{nowhere}"], "fold twins"),
    ],
)
def test_bad_input_ends_with_one_line(dataset, tmp_path, capsys, arguments, said):
    paths = {"five": small_twin(tmp_path / "five", range(5)), "six": small_twin(tmp_path / "six", range(6)),
             "nowhere": str(tmp_path / "nowhere")}
    given = [a.format(**paths) for a in arguments]
    assert main(["evaluate", str(dataset.root), "--out", str(tmp_path / "out"), *given]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1


def test_page_escapes_text_and_animation_keeps_tenths_of_a_millimetre(tmp_path):
    page = Page("<b>")
    page.table(("a",), [("<script>",)])
    position = np.zeros((9, 2, 3))
    position[:, 1, 0] = 0.2
    position[4, 0] = np.nan
    # Centre 0.1 m: the two particles are at -1000 and +1000 tenths of a millimetre; frames 0, 4 and 8 are kept.
    page.html(animation([Track("measured", position, "#000000")], 0.01, line=True, title="</script>"))
    page.write(tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text()
    assert "&lt;script&gt;" in text and text.count("</script>") == 1
    assert '"frames":[[-1000,0,0,1000,0,0],[null,null,null,1000,0,0],[-1000,0,0,1000,0,0]]' in text
