"""`pred train` as a process: interrupted and killed runs, resumed, give the weights of an uninterrupted one."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from residual_case import PERIOD, Falling, episodes, line_body

from pred_core.bag.dataset import EpisodeEntry, write_dataset
from pred_core.bag.episode import write_episode
from pred_core.cli.main import main
from pred_core.cli.train_command import CHECKPOINT
from pred_core.pred import PReD, load_dynamics
from pred_core.twin import Twin, TwinMeta
from pred_core.types import ObjectInfo, Physics, Scene

FLAGS = [
    "--steps", "100", "--rollout", "2", "--batch", "4", "--evaluate-every", "40", "--feature", "16", "--hidden", "16",
    "--embedding", "16", "--encoder-layers", "1", "--holdout", "0.3", "--seed", "3", "--cap", "0.2",
]  # fmt: skip


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set of four recorded throws, and a twin of soft springs."""
    root = tmp_path_factory.mktemp("train")
    entries = []
    for i, episode in enumerate(episodes(Falling(drag=1.0), 4, 12, seed=0)):
        write_episode(root / "data" / f"ep{i}.mcap", episode)
        entries.append(EpisodeEntry(f"ep{i}.mcap", "train", i))
    # Nothing is held: the gripper stays at the origin, so the data set says so.
    write_dataset(root / "data", object=ObjectInfo(), rate=1.0 / PERIOD, entries=entries, held={})
    meta = TwinMeta(period=PERIOD, data=("of the backbone",))
    twin = Twin(meta, line_body(), Physics(stiffness=0.1, damping=1e-6), Scene())
    twin.save(root / "twin")
    return root


def command(case: Path, out: Path, *extra: str) -> list[str]:
    return ["train", str(case / "data"), "--twin", str(case / "twin"), "--out", str(out), "--no-guard", *extra]


def start(arguments: list[str]) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "pred_core.cli.main", *arguments],
        cwd=Path(__file__).parents[1],
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )


# 100 steps take seconds, so that the signal comes long before the last even where this process gets little time.
def signal_after_first_step(process: subprocess.Popen[str], number: signal.Signals) -> str:
    """Wait for the first step, send the signal, wait for the end; what it printed."""
    assert process.stderr is not None
    printed = ""
    for line in process.stderr:
        printed += line
        if "step 1/100" in line:
            process.send_signal(number)
            break
    printed += process.stderr.read()
    process.wait(timeout=120)
    return printed


@pytest.fixture(scope="module")
def whole(case: Path) -> bytes:
    """Weights of the uninterrupted run, made by a process like the others."""
    process = start(command(case, case / "whole", *FLAGS))
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 0, errors
    return (case / "whole" / "residual.safetensors").read_bytes()


def test_writes_a_twin_that_predicts_and_a_report(case: Path, whole: bytes) -> None:
    twin = Twin.load(case / "whole")
    assert isinstance(load_dynamics(twin), PReD)
    assert twin.meta.parent == Twin.load(case / "twin").digest() and len(twin.meta.data) == 5
    assert twin.meta.data[0] == "of the backbone", "what the twin was identified on still counts as seen"
    report = json.loads((case / "whole" / "train.json").read_text())
    assert len(report["curves"]["loss"]) == 100 and report["network"]["cap"] == 0.2
    assert f"--out {case / 'whole'} " in report["command"] and "--no-azimuth" not in report["command"]
    assert "--steps 100 " in report["command"] and "--learning-rate 0.001 " in report["command"], "defaults too"
    assert report["command"] == twin.meta.created_by
    assert "share of components at the cap" in (case / "whole" / "train.html").read_text()
    assert not (case / "whole" / CHECKPOINT).exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_resumed_after_a_signal_equals_uninterrupted(case: Path, whole: bytes, number: signal.Signals) -> None:
    out = case / f"signal{int(number)}"
    process = start(command(case, out, *FLAGS, "--checkpoint-seconds", "0"))
    printed = signal_after_first_step(process, number)
    assert process.returncode == (130 if number == signal.SIGINT else -signal.SIGKILL), printed
    assert (out / CHECKPOINT).is_file() and not (out / "residual.safetensors").exists()
    assert main(command(case, out, *FLAGS)) == 2  # an unfinished run is never thrown away silently
    assert main(command(case, out, "--resume", "--seed", "4")) == 2  # nor changed half-way
    resumed = start(command(case, out, "--resume"))
    _, errors = resumed.communicate(timeout=120)
    assert resumed.returncode == 0, errors
    assert "resumed at step" in errors
    assert (out / "residual.safetensors").read_bytes() == whole
    made_by = [Twin.load(p).meta.created_by.replace(str(p), "OUT") for p in (out, case / "whole")]
    assert made_by[0] == made_by[1], "a resumed run tells the settings it was begun with"


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        (["--cap", "0"], "cap"),
        (["--resume"], "nothing to resume"),
        (["--device", "cuda:99"], "cuda"),
        (["--rollout", "50"], "--rollout"),
    ],
)
def test_bad_input_is_one_line_and_exit_2(
    case: Path, tmp_path: Path, extra: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(command(case, tmp_path / "out", *extra)) == 2
    printed = capsys.readouterr().err.strip()
    assert message in printed and len(printed.splitlines()) == 1
