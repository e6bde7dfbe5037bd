"""Small diagnoses through the command line, for tests of several files."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pred_core.bag.dataset import EpisodeEntry, write_dataset
from pred_core.bag.episode import write_episode
from pred_core.cli.main import main
from pred_core.plant.springs import SpringsConfig
from pred_core.springmass import build_body
from pred_core.twin import Twin, TwinMeta
from pred_core.types import STANDARD_GRAVITY, Episode, ObjectInfo, Physics, Scene

SPLITS = ("train",) * 5 + ("test",)
FAST = ["--places", "4", "--survivors", "3", "--iterations", "6"]


def write(
    root: Path,
    episodes: Sequence[Episode],
    rate: float = 30.0,
    name: str = "rope",
    gravity: tuple[float, float, float] = STANDARD_GRAVITY,
) -> Path:
    """The episodes as a data set of bags."""
    entries = []
    for e in episodes:
        write_episode(root / f"{e.name}.mcap", e)
        entries.append(EpisodeEntry(f"{e.name}.mcap", e.split, e.recording))
    write_dataset(
        root, object=ObjectInfo(name, "line"), rate=rate, entries=entries, held={0: 0}, known={"mass": 0.05},
        gravity=gravity,
    )  # fmt: skip
    return root


def diagnose(dataset: Path, twin: Path, out: Path, *flags: str) -> int:
    return main(["diagnose", str(dataset), "--twin", str(twin), "--out", str(out), *FAST, *flags])


def read(out: Path) -> dict[str, Any]:
    return dict(json.loads((out / "diagnosis.json").read_text()))


def refusal(capsys: pytest.CaptureFixture[str], dataset: Path, twin: Path, out: Path, *flags: str) -> str:
    """The one line of a diagnosis that must fail; lines of progress, "[  1 s] ...", may stand before it."""
    capsys.readouterr()
    assert diagnose(dataset, twin, out, *flags) == 2
    shown = capsys.readouterr()
    lines = [line for line in shown.err.strip().splitlines() if not line.startswith("[")]
    assert len(lines) == 1 and lines[0].startswith("pred: ") and not shown.out, shown
    assert not (out / "diagnosis.json").exists() and not (out / "twin").exists()
    return lines[0]


PARTICLES = 10
SPRINGS = SpringsConfig(stiffness=60.0, damping=0.03, friction=0.5, reach=2, substeps=12)


def matched() -> Twin:
    """The twin with the world's own parameters."""
    spacing = SPRINGS.length / (PARTICLES - 1)
    physics = Physics(
        stiffness=SPRINGS.stiffness, damping=SPRINGS.damping, connection_threshold=2.5 * spacing, max_springs=4,
        ground_friction=SPRINGS.friction,
    )  # fmt: skip
    rest = np.zeros((PARTICLES, 3))
    rest[:, 0] = spacing * np.arange(PARTICLES)
    body = build_body("line", rest, SPRINGS.mass, physics)
    return Twin(TwinMeta(object=ObjectInfo("rope", "line"), period=1.0 / 30.0), body, physics, Scene(ground=0.0))
