"""One scored replay: player, predictor and evaluator as processes of their own, followed to the end."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

from pred_core.bag.dataset import load_dataset
from pred_core.bag.playlist import Clip, find_clips
from pred_core.errors import PredError
from pred_ros.processes import Children, free_domain, node_command, node_environment

START = 60.0  # [s] for three interpreters to start, load the twin and compile its kernels
FOLLOW = 0.2  # [s] between two looks at the processes


@dataclass(frozen=True)
class Replay:
    """What to replay."""

    dataset: Path
    twin: Path
    out: Path
    split: str = "test"
    episodes: tuple[str, ...] = ()  # names; empty: all of the split
    factor: float = 1.0  # x real time
    model: str = ""  # name in the report; empty: the stage of the twin
    extra: float = 60.0  # [s] beyond start and playing time before everything is ended


def replay(job: Replay, terminal: TextIO = sys.stderr) -> dict[str, Any]:
    """Run the three nodes over the data; returns the live `metrics.json`. Leaves no process behind.

    Raises: PredError with the node's own line if one of them fails, or if the time limit passes.
    """
    clips = find_clips(job.dataset, job.split, job.episodes)
    limit = START + job.extra + _media_seconds(clips, job.dataset) / job.factor
    metrics = job.out / "metrics.json"
    metrics.unlink(missing_ok=True)
    with Children(node_environment(free_domain()), job.out / "log") as children:
        # Readers first; the player begins when both listen to it, the predictor when the evaluator listens to it.
        for node, parameters in _parameters(job).items():
            children.start(node, node_command(node, parameters))
        _follow(children, limit, terminal)
    if not metrics.is_file():
        raise PredError("the evaluator wrote no score", got=children.last_line("evaluator"))
    result: dict[str, Any] = json.loads(metrics.read_text(encoding="utf-8"))
    return result


def _parameters(job: Replay) -> dict[str, Mapping[str, object]]:
    held = load_dataset(job.dataset).held
    return {
        "evaluator": {"out": job.out, "model": job.model, "twin": job.twin},
        "predictor": {
            "twin": job.twin,
            "held": " ".join(f"{p}:{g}" for p, g in (held or {}).items()),
            "overload": "queue",
            "wait_for": 1,
        },
        "player": {
            "bag": job.dataset,
            "split": job.split,
            "episodes": ",".join(job.episodes),
            "factor": job.factor,
            "wait_for": 2,
            "patience": START,
        },
    }


def _media_seconds(clips: list[Clip], dataset: Path) -> float:
    return sum(clip.frames for clip in clips) / load_dataset(dataset).rate


def _follow(children: Children, limit: float, terminal: TextIO) -> None:
    """Show one line until the evaluator is done. Raises: PredError."""
    begin = time.monotonic()
    told = ""
    try:
        while children.running["evaluator"].poll() is None:
            elapsed = time.monotonic() - begin
            for name, process in children.running.items():
                if process.poll() not in (None, 0):
                    raise PredError(f"the {name} ended with code {process.returncode}", got=children.last_line(name))
            if elapsed > limit:
                raise PredError(
                    f"the replay took longer than {limit:.0f} s and was ended",
                    got="; ".join(f"{n}: {children.last_line(n)}" for n in children.running),
                )
            playing = _said(children, "player")
            _show(terminal, f"{elapsed:5.0f} s  {playing}  |  {_said(children, 'evaluator')}")
            if not terminal.isatty() and playing != told:
                told = playing
                print(f"   {elapsed:5.0f} s  {playing}", file=terminal, flush=True)
            time.sleep(FOLLOW)
    finally:
        _show(terminal, "")
    code = children.running["evaluator"].returncode
    if code != 0:
        raise PredError(f"the evaluator ended with code {code}", got=children.last_line("evaluator"))


def _said(children: Children, name: str) -> str:
    """The text of a node's last log line, without level, time and name."""
    return children.last_line(name).rsplit("]: ", 1)[-1]


def _show(terminal: TextIO, text: str) -> None:
    if terminal.isatty():
        terminal.write(f"\r\033[K{text[:150]}")
        terminal.flush()
