"""The network must not hide causes: a residual that does what a cause would do reopens the case, any other does not."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from bench_modules import loaded_modules
from report_cases import PERIOD, drag, recorded, rope
from torch import Tensor

from pred_core.bag.dataset import EpisodeEntry, write_dataset
from pred_core.bag.episode import write_episode
from pred_core.cli.main import main
from pred_core.diagnose.guard import Guard, guard_of, network_guard
from pred_core.diagnose.guard_forces import Moments, with_network
from pred_core.diagnose.guard_probes import Probe
from pred_core.diagnose.guard_shares import Model, cross_fitted, shares
from pred_core.diagnose.report_network import read_network
from pred_core.effects import find_effect
from pred_core.errors import ConfigError, DatasetError, InputError, TwinError
from pred_core.evaluate.report import write_json
from pred_core.pred import load_base
from pred_core.residual import Motion, ResidualConfig, ResidualNetwork, build_network
from pred_core.residual.network import Buffer
from pred_core.train import Trainer, TrainingConfig, align
from pred_core.twin import Twin
from pred_core.types import Episode, ObjectInfo

SMALL = ResidualConfig(
    feature=16, encoder_layers=1, hidden=16, embedding=16, temporal_layers=1, cap=0.3, feedforward=16
)
PLANTED = 1.5  # [1/s]


class Planted(ResidualNetwork):
    """In place of a network: what linear drag takes from a speed in one period, and noise beside it, of each particle
    or `common` to all."""

    def __init__(self, coefficient: float, noise: float = 0.0, common: bool = False):
        super().__init__(SMALL)
        self.coefficient, self.noise, self.common = coefficient, noise, common
        self.generator = torch.Generator().manual_seed(0)

    def forward(
        self, motion: Motion, buffer: Buffer, period: float, arc: Tensor, shuffle: Sequence[int] | None = None
    ) -> tuple[Tensor, Buffer]:
        shape = [*motion.velocity.shape]
        shape[-2] = 1 if self.common else shape[-2]
        noise = self.noise * torch.randn(shape, generator=self.generator)
        return -self.coefficient * period * motion.velocity + noise, buffer


def damped_rope() -> Twin:
    """The springs' vibrations die within a period of 33 ms, so that a velocity of a frame is one of the motion."""
    twin = rope()
    return twin.replace(physics=dataclasses.replace(twin.physics, damping=0.5))


@pytest.fixture(scope="module")
def twin() -> Twin:
    return damped_rope()


@pytest.fixture(scope="module")
def episodes(twin: Twin) -> list[Episode]:
    """Six recordings of the rope with drag: what the twin lacks."""
    return recorded(twin, drag(coefficient=PLANTED), ("train",) * 6, frames=45)


def asked(twin: Twin, network: ResidualNetwork, episodes: Sequence[Episode]) -> Guard:
    return guard_of(with_network(twin, network), twin, episodes)


def test_exactly_a_drag_is_named_and_nothing_else(twin: Twin, episodes: list[Episode]) -> None:
    """The residual -b v dt, b = 1.5 /s, does what drag does, but at once at the end of a period: 0.9 or more of it."""
    guard = asked(twin, Planted(PLANTED), episodes)
    best = guard.families[0]
    assert guard.reopened == ("drag",), guard.sentence
    assert best.share > 0.9 and best.low > 0.85 and best.p < 0.05
    assert max(best.effects, key=lambda i: best.effects[i]) == "drag_linear"
    assert "drag" in guard.sentence and "exploratory" not in guard.sentence
    said = json.loads(json.dumps(guard.to_json()))
    assert said["reopened"] == ["drag"] and said["recordings"] == 6
    assert "delay" in said["untested"], "a sensor's error is no force"


def test_noise_that_is_no_law_reopens_nothing(twin: Twin, episodes: list[Episode]) -> None:
    """White noise of 0.02 m/s: every share is a chance one, far below a tenth."""
    guard = asked(twin, Planted(0.0, noise=0.02), episodes)
    assert guard.reopened == () and guard.families[0].share < 0.03, guard.sentence
    assert guard.speed == pytest.approx(0.02 * 3**0.5, rel=0.03)


def test_half_drag_half_noise_is_half_explained(twin: Twin, episodes: list[Episode]) -> None:
    """The share is one of variance: noise as large as the drag halves it. Common to all particles, it moves them over
    0.1 s as drag does; springs would take away what neighbours do not share.
    """
    size = asked(twin, Planted(PLANTED), episodes).speed / 3**0.5
    guard = asked(twin, Planted(PLANTED, noise=size, common=True), episodes)
    assert guard.reopened[0] == "drag" and 0.35 < guard.families[0].share < 0.65, guard.sentence


def test_a_network_trained_on_a_rope_that_lacks_drag_hides_the_drag(twin: Twin, episodes: list[Episode]) -> None:
    """And it does not where the twin has the drag: what a network learns there is not drag."""
    training = TrainingConfig(
        steps=120, rollout=6, batch=8, holdout=0.0, seed=1, azimuth=False, penalty=0.0, learning_rate=3e-3
    )
    recordings = [align(e, twin.body, PERIOD) for e in episodes]
    trainer = Trainer(load_base(twin), twin.body, recordings, training, SMALL)
    while not trainer.done:
        trainer.advance()
    guard = network_guard(twin.replace(residual=trainer.chosen().weights()), episodes)
    assert guard.reopened[:1] == ("drag",), guard.sentence
    assert guard.families[0].share > 0.3


def test_a_share_by_hand() -> None:
    """Column a = (1, 0) in each of four recordings, network (2, 1): b = 2 leaves 1 of 5, a share of 0.8. With the
    sign of the last recording turned the others say b = 2, (2 b)^2 + 1 = 17 are left there.
    """
    one = np.array([[1.0, 2.0], [2.0, 5.0]])
    products = np.stack([one] * 4)
    errors = cross_fitted(products, Model((0,)), np.array([[1.0, 1.0, 1.0, 1.0]]))
    assert errors == pytest.approx(np.full((1, 4), 1.0), abs=1e-4)  # the ridge of 1e-3 shifts b by 2e-3
    turned = cross_fitted(products, Model((0,)), np.array([[1.0, 1.0, 1.0, -1.0]]))
    assert turned[0, 3] == pytest.approx(17.0, abs=0.1)


def test_a_law_of_one_recording_only_is_no_law() -> None:
    """Twelve recordings whose coefficients have random signs: in-sample each would be explained, held out none is."""
    rng = np.random.default_rng(2)
    signs = rng.permutation([1.0, -1.0] * 6)
    products = np.array([[[1.0, s], [s, 1.2]] for s in signs])
    probe = Probe("drag_linear", "drag", "coefficient[0]", find_effect("drag_linear").extension())
    rows, joint = shares(Moments(products, tuple(range(12)), 100), [probe], rng)
    assert rows[0].share < 0.1 and rows[0].p > 0.05 and joint < 0.1


def test_of_several_places_the_one_is_taken_that_the_other_recordings_choose() -> None:
    """Two columns, of which only the second is alike the network; both are orthogonal."""
    products = np.stack([np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 1.0], [0.0, 1.0, 1.0]])] * 3)
    errors = cross_fitted(products, Model((), ((0, 1),)), np.ones((1, 3)))
    assert errors == pytest.approx(np.zeros((1, 3)), abs=1e-5)


def test_what_cannot_be_asked_is_said(twin: Twin, episodes: list[Episode]) -> None:
    with pytest.raises(TwinError, match="no network"):
        network_guard(twin, episodes)
    with pytest.raises(InputError, match="adds nothing"):
        network_guard(twin.replace(residual=build_network(SMALL, 0).weights()), episodes)
    with pytest.raises(DatasetError, match="1 recording"):
        asked(twin, Planted(PLANTED), episodes[:1])
    few = asked(twin, Planted(PLANTED), episodes[:3])
    assert few.reopened == ("drag",) and "exploratory, from 3 recordings" in few.sentence


def test_commands_ask_and_tell(
    twin: Twin, episodes: list[Episode], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """`pred train` asks by itself; `pred diagnose --guard` asks again and says how to reopen the case."""
    data, plain, out = tmp_path / "data", tmp_path / "twin", tmp_path / "net"
    for e in episodes:
        write_episode(data / f"{e.name}.mcap", e)
    entries = [EpisodeEntry(f"{e.name}.mcap", "train", e.recording) for e in episodes]
    write_dataset(data, object=episodes[0].object, rate=1.0 / PERIOD, entries=entries, held={0: 0})
    twin.save(plain)
    command = ["train", str(data), "--twin", str(plain), "--out", str(out), "--steps", "60", "--rollout", "6"]
    sizes = ["--feature", "16", "--hidden", "16", "--embedding", "16", "--encoder-layers", "1", "--batch", "8"]
    more = ["--temporal-layers", "1", "--learning-rate", "3e-3", "--no-azimuth", "--penalty", "0", "--cap", "0.3"]
    assert main([*command, *sizes, *more, "--holdout", "0"]) == 0
    said = json.loads((out / "guard.json").read_text())
    assert f"network guard: {said['sentence']}" in capsys.readouterr().err
    assert main(["diagnose", str(data), "--twin", str(out), "--guard", "--out", str(tmp_path / "asked")]) == 0
    again = json.loads((tmp_path / "asked" / "guard.json").read_text())
    printed = capsys.readouterr().out
    assert again["families"] == said["families"] and again["sentence"] in printed
    assert again["reopened"][0] == "drag" and f"pred diagnose {data} --twin {out}" in printed
    assert main(["diagnose", str(data), "--twin", str(plain), "--guard", "--out", str(tmp_path / "none")]) == 2
    assert "no network" in capsys.readouterr().err


@pytest.fixture(scope="module")
def questioned(twin: Twin, episodes: list[Episode], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`twin` with a network in it, and four episodes of `data`."""
    root = tmp_path_factory.mktemp("guard")
    generator = torch.Generator().manual_seed(0)
    network = build_network(SMALL, 0)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter += 0.2 * torch.randn(parameter.shape, generator=generator)
    twin.replace(residual=network.weights()).save(root / "twin")
    for e in episodes[:4]:
        write_episode(root / "data" / f"{e.name}.mcap", e)
    return root


def listed(root: Path, split: str = "train") -> Path:
    """The data set of `questioned`, all episodes with this split."""
    names = sorted(p.name for p in (root / "data").glob("*.mcap"))
    entries = [EpisodeEntry(name, split, n) for n, name in enumerate(names)]
    info = ObjectInfo("rope", "line")
    write_dataset(root / "data", object=info, rate=1.0 / PERIOD, entries=entries, held={0: 0})
    return root / "data"


@pytest.mark.parametrize(
    "more",
    [
        ("--reference", "before"),
        ("--network", "errors.json"),
        ("--causes", "2"),
        ("--no-settle",),
        ("--reference", "before", "--network", "errors.json", "--seconds", "60"),
    ],
)
def test_guard_refuses_options_it_would_not_heed(
    questioned: Path, more: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["diagnose", str(listed(questioned)), "--twin", str(questioned / "twin"), "--out", str(tmp_path / "o")]
    assert main([*command, "--guard", *more]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "--guard only asks about the twin's network" in line and " ".join(more) in line
    assert not (tmp_path / "o").exists()


def test_guard_checks_the_tracks_as_the_diagnosis_does(
    questioned: Path, twin: Twin, episodes: list[Episode], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """An episode with a particle that is never seen, one with a particle the twin lacks, and none to ask."""
    data, out = listed(questioned), tmp_path / "out"
    command = ["diagnose", str(data), "--twin", str(questioned / "twin"), "--out", str(out), "--guard"]
    bag = data / f"{episodes[0].name}.mcap"
    whole, tracks = bag.read_bytes(), episodes[0].tracks
    hidden = tracks.visible.copy()
    hidden[:, 5] = False
    foreign = tracks.id.copy()
    foreign[-1] = 77
    for changed, words in (
        (dataclasses.replace(tracks, visible=hidden), "never measured in this episode; got id 5"),
        (dataclasses.replace(tracks, id=foreign), "particles that the twin lacks; got id 77"),
    ):
        write_episode(bag, dataclasses.replace(episodes[0], tracks=changed))
        assert main(command) == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert words in line
    bag.write_bytes(whole)
    listed(questioned, "ood")
    assert main(command) == 2
    assert "nothing to question a network on" in capsys.readouterr().err
    assert not out.exists()


@pytest.fixture(scope="module")
def two_by_two() -> Iterator[ModuleType]:
    for modules in loaded_modules(("measured_cables", "network_2x2")):
        yield modules["network_2x2"]


def test_the_table_of_base_and_extended_by_hand(two_by_two: ModuleType) -> None:
    """Base 4, 6, 8 mm, with network 3, 6, 3: mean 6 and 4, the network takes 2 away, better in 2 of 3; extended 1, 1, 1
    with network 2, 1, 1: it adds a third, better in none. The extension takes 5 away, and 8/3 beside a network.
    """
    values = {"base": (4, 6, 8), "base + network": (3, 6, 3), "extended": (1, 1, 1), "extended + network": (2, 1, 1)}
    lines = two_by_two.markdown("test", {k: np.array(v, dtype=float) for k, v in values.items()})
    cells = [[c.strip() for c in line.split("|")[1:-1]] for line in lines if line]
    assert cells[0][0] == "test, 3 episodes [mm]"
    base, extended, takes = cells[2:]
    assert base[1].startswith("6.00 [4.00, 8.00] / 6.00") and base[2].startswith("4.00 [3.00, 6.00] / 3.00")
    assert base[3].startswith("2.00 [0.00, 5.00]") and base[3].endswith("2 of 3")
    assert extended[1].startswith("1.00 [1.00, 1.00]") and extended[3].startswith("-0.33 [-1.00, 0.00], 0 of 3")
    assert takes[1].startswith("5.00 [3.00, 7.00], 3 of 3") and takes[2].startswith("2.67 [1.00, 5.00], 3 of 3")


def test_errors_with_and_without_a_network_are_read_strictly(two_by_two: ModuleType, tmp_path: Path) -> None:
    """What the benchmark writes is what the report reads; a cell that is missing is named."""
    path = tmp_path / "network.json"
    cells = ("base", "base + network", "extended", "extended + network")
    table = {"ood": {c: two_by_two.summary(np.array([1.0, 3.0])) for c in cells}}
    write_json(path, table)
    assert read_network(path) == table and table["ood"]["base"] == {"mean": 2.0, "low": 1.0, "high": 3.0}
    del table["ood"]["extended"]
    write_json(path, table)
    with pytest.raises(ConfigError, match="extended"):
        read_network(path)
