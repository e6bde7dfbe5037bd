"""Wall time of an identification, and whether it reaches the error floor of the planted values.

    python benchmarks/identify.py [--quick] [--only TEXT]

Three objects with known values, simulated with three times the substeps: a 13-particle cable and a 30-particle rope
(16 episodes of 5 s), and a sheet of 500 particles (4 episodes of 2 s, a shorter search). All have air drag. The floor
is the error at the planted values over whole episodes, in the same simulator and from the same starts; the fit is
scored the same way. One core.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch

from pred_core.bag.dataset import Dataset, EpisodeEntry, write_dataset
from pred_core.bag.episode import write_episode
from pred_core.effects.drag_linear import DragLinear
from pred_core.identify.config import IdentifyConfig
from pred_core.identify.prepare import prepare
from pred_core.identify.run import identify, train_episodes
from pred_core.identify.search import trimmed
from pred_core.identify.space import Candidate
from pred_core.springmass import SpringMass, build_body
from pred_core.types import Array, Body, Episode, Grip, ObjectInfo, Physics, State, Tracks

MASS = 0.05  # [kg]
SETTLE = 1.0  # [s] a line hangs before the recording; a sheet's first frame is its rest shape, so it begins flat


@dataclass(frozen=True)
class Case:
    """One object, its planted values, and what is recorded of it."""

    name: str
    kind: str
    rest: Array  # (N, 3) [m]
    held: tuple[int, ...]  # the particle each gripper holds
    physics: Physics
    rate: float  # [Hz]
    episodes: int
    seconds: float
    slack: float  # [m] grippers come together by
    config: IdentifyConfig


DRAG = DragLinear.extension(coefficient=1.0)  # [1/s] planted, and searched


def cases(quick: bool) -> list[Case]:
    """The three objects; `quick` shortens the recordings."""
    made = []
    base = IdentifyConfig(effects=(DRAG.id,))
    rope = dataclasses.replace(base, parameters=("stiffness", "damping", "connection_threshold", "bending_stiffness"))
    for name, count, length, rate, stiffness, config in (
        ("cable, 13 particles", 13, 0.96, 100.0, 150.0, rope),
        ("rope, 30 particles", 30, 0.9, 30.0, 60.0, dataclasses.replace(rope, substeps=100)),
    ):
        rest = np.zeros((count, 3))
        rest[:, 0] = np.linspace(0.0, length, count)
        physics = Physics(stiffness, 0.02, 1.5 * length / (count - 1), 2, 0.5, 5e-4)
        made.append(Case(name, "line", rest, (0, count - 1), physics, rate, 16, 5.0, 0.3, config))
    i, j = np.divmod(np.arange(500), 25)
    jitter = np.random.default_rng(0).uniform(-0.001, 0.001, (500, 2))
    rest = np.stack((0.02 * i + jitter[:, 0], 0.02 * j + jitter[:, 1], np.zeros(500)), axis=-1)
    config = dataclasses.replace(
        base, parameters=("stiffness", "damping", "connection_threshold", "max_springs"), substeps=128, restarts=1,
        evaluations=240, window=0.5, windows=8, stages=(0.5, 1e9), iterations=6,
    )  # fmt: skip
    made.append(
        Case("sheet, 500 particles", "sheet", rest, (0, 24, 475, 499), Physics(1.0, 0.003, 0.031, 8), 30.0, 4, 2.0, 0.0,
             config)
    )  # fmt: skip
    if quick:
        return [dataclasses.replace(c, episodes=4, seconds=min(c.seconds, 3.0)) for c in made[:2]]
    return made


def record(case: Case, body: Body) -> list[Episode]:
    """Episodes of the planted object; all are simulated as one batch."""
    rng = np.random.default_rng(1)
    settle = SETTLE if case.kind == "line" else 0.0
    lead, frames = round(settle * case.rate), round((settle + case.seconds) * case.rate)
    when = np.arange(frames) / case.rate - settle
    shape = (case.episodes, 1, len(case.held), 3, 2)
    angle = 2 * np.pi * rng.uniform(0.3, 1.2, shape) * when[:, None, None, None] + rng.uniform(0, 6.3, shape)
    size = rng.uniform(0.01, 0.03, shape) if case.kind == "line" else rng.uniform(0.003, 0.008, shape)
    home = case.rest[list(case.held)]
    motion = home + np.clip(when, 0.0, 1.0)[:, None, None] * (size * np.sin(angle)).sum(-1)
    inward = 0.5 * case.slack * np.clip((when + settle) / 0.5, 0.0, 1.0)
    motion[:, :, 0, 0] += inward
    motion[:, :, -1, 0] -= inward
    pose = torch.as_tensor(motion, dtype=torch.float32)
    turn = torch.zeros(*pose.shape[:3], 4)
    turn[..., 0] = 1.0
    grips = Grip(pose, turn, torch.ones(pose.shape[:3], dtype=torch.bool))
    held = torch.full((body.count,), -1, dtype=torch.int32)
    held[list(case.held)] = torch.arange(len(case.held), dtype=torch.int32)
    position = torch.as_tensor(case.rest, dtype=torch.float32).expand(case.episodes, -1, -1).contiguous()
    chosen = SpringMass(body, case.physics, period=1.0 / case.rate).substeps
    simulator = SpringMass(body, case.physics, period=1.0 / case.rate, substeps=3 * chosen, extensions=[DRAG])
    state = State(position, torch.zeros_like(position), held.expand(case.episodes, -1).contiguous())
    by_time = Grip(pose.movedim(1, 0), turn.movedim(1, 0), grips.closed.movedim(1, 0))
    tracks = simulator.rollout(simulator.start(state, by_time.at(0)), by_time.span(1, frames))
    tracks = torch.cat((position[None], tracks))[lead:]
    stamps = 10**9 + np.arange(len(tracks), dtype=np.int64) * round(1e9 / case.rate)
    seen = np.ones((len(tracks), body.count), bool)
    return [
        Episode(
            name=f"ep{e:03d}",
            object=ObjectInfo(case.name, case.kind),
            stamps=stamps,
            tracks=Tracks(stamps, tracks[:, e].double().numpy(), body.id, seen, seen.astype(np.float32)),
            grips=Grip(pose[e, lead:], turn[e, lead:], grips.closed[e, lead:]),
            held=held.numpy(),
            split="train",
            recording=e,
        )
        for e in range(case.episodes)
    ]


def write(case: Case, episodes: list[Episode], root: Path) -> Dataset:
    """The episodes as a data set of bags."""
    for e in episodes:
        write_episode(root / f"{e.name}.mcap", e)
    return write_dataset(
        root,
        object=episodes[0].object,
        rate=case.rate,
        entries=[EpisodeEntry(f"{e.name}.mcap", "train", e.recording) for e in episodes],
        sigma=0.0,
        held={p: g for g, p in enumerate(case.held)},
        known={"mass": MASS},
    )


def measure(case: Case, root: Path) -> str:
    """One line: seconds, candidates, floor and what was reached."""
    body = build_body(case.kind, case.rest, MASS, case.physics)
    dataset = write(case, record(case, body), root)
    episodes = train_episodes(dataset)
    config = case.config
    stages = prepare(dataset, episodes, config, _silent)
    problem = stages.stages.whole(stages.recordings)
    planted = Candidate(case.physics, (DRAG,))
    floor = 1e3 * float(trimmed(problem.losses([planted]))[0])
    begin = time.perf_counter()
    result = identify(dataset, episodes, config, None, _silent)
    seconds = time.perf_counter() - begin
    found = ", ".join(f"{k} {v['value']:.4g} ({planted_value(case, k):.4g})" for k, v in result.values.items())
    same = {tuple(s) for s in result.twin.body.springs.tolist()} == {tuple(s) for s in body.springs.tolist()}
    return (
        f"{case.name}, {len(result.values)} parameters, {case.episodes} episodes of {case.seconds:g} s at "
        f"{case.rate:g} Hz: {seconds:.1f} s, {sum(r['evaluations'] for r in result.restarts):.0f} candidates; whole "
        f"episodes {result.fitted_mm:.3f} mm, planted {floor:.3f} mm; the planted springs: {same}\n"
        f"    found (planted): {found}"
    )


def planted_value(case: Case, name: str) -> float:
    """The planted value of a searched parameter."""
    return DRAG.parameters["coefficient"][0] if "." in name else float(getattr(case.physics, name))


def _silent(line: str) -> None:
    """Progress that nobody reads."""


def main() -> int:
    """Print a line a case."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--quick", action="store_true", help="the cable and the rope, 4 episodes of 3 s each")
    parser.add_argument("--only", default="", help="cases whose name has this text")
    args = parser.parse_args()
    torch.set_num_threads(1)
    for case in (c for c in cases(args.quick) if args.only in c.name):
        with tempfile.TemporaryDirectory() as folder:
            print(measure(case, Path(folder)), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
