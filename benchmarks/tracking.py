"""Trackers on exact truth (MuJoCo): error, jitter, visibility, drift and time, beside the paper's rollout.

    python benchmarks/tracking.py [--scenes rope cloth ...] [--seconds 6] [--seeds 0 1] [--json FILE]

Four cameras 640 x 480 with stereo-like depth noise, one thread, automatic initialisation. Scenes: rope (sliding on the
table), rope_covered and cloth_covered (cam0 and cam1 see nothing from 2.0 to 3.3 s), rope_still, cell (rope in the
jaws of an arm, at the slot), cloth (0.23 m/s). Errors in mm are distances to the same material points; time is
processor time of one step (all four pictures) of the tracker alone. Jitter is the standard deviation of a still
particle's place. Ends with a table, means over the seeds.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from argument_types import amount, count
from numpy.typing import NDArray
from tracking_cloth import Cloth, OnCloth

from pred_core.plant.appearance import dress_rope, dress_spec
from pred_core.plant.cameras import Cameras, ring_of_cameras
from pred_core.plant.drive import Drive, poses
from pred_core.plant.live.cell import Cell, CellConfig
from pred_core.plant.live.mover import ToolPose
from pred_core.plant.motion import draw_motion
from pred_core.plant.rope import STEP, RopeConfig, build_rope
from pred_core.plant.world import FREE, SETTLE, SETTLE_DRAG, World, lay
from pred_core.track.paper_rollout import PaperRollout
from pred_core.track.surface_tracker import SurfaceConfig
from pred_core.track.tracker import Tracker, TrackerConfig
from pred_core.track.view import project
from pred_core.track.workspace import Workspace
from pred_core.types import Array, CameraFrame

RATE = 15.0  # [Hz] of the pictures that are tracked
PARTICLES = 61  # of a rope
COVERED = (2.0, 3.3)  # [s]
SURFACE = 0.008  # [m] depth before a particle that hides it in the true picture


@dataclass(frozen=True)
class Shot:
    """What happens at one instant, and what is true."""

    time: float  # [s]
    frames: dict[str, CameraFrame]
    clean: dict[str, NDArray[np.float32]]  # true depth
    truth: Array  # rope: (61, 3) material points; cloth: (221, 3) vertices
    grip: tuple[Array, Array] | None  # position (1, 3), rotation (1, 4)


def rope_shots(seconds: float, seed: int, still: bool) -> Iterator[Shot]:
    """The rope of the plant on the table, moved by its gripper."""
    generator = np.random.default_rng(seed)
    motion = draw_motion(generator, "table", "usual", seconds)
    rope = build_rope(RopeConfig())
    dress_spec(rope.spec)
    dress_rope(rope)
    world = World(rope)
    settle, count = round(SETTLE / STEP), round((SETTLE + seconds) / STEP) + 2
    path = motion.path(-SETTLE, count, STEP) if not still else motion.path(-SETTLE - seconds - 9.0, count, STEP)
    drive = Drive(path)
    drive.place(world.data)
    lay(world, motion)
    arc = np.linspace(0.0, rope.rope.length, PARTICLES)
    with Cameras(world.model, ring_of_cameras()) as cameras:
        for k in range(count):
            world.time = (k - settle) * STEP
            mujoco.mj_step1(world.model, world.data)
            if k >= settle and (k - settle) % round(1 / RATE / STEP) == 0:
                grip = poses(world.data.qpos[None, :6])
                yield _shot(cameras, world.data, world.time, generator, world.material_points(arc), grip)
            world.finish_step(drive, k, SETTLE_DRAG if world.time < -FREE else 0.0)


def cell_shots(seconds: float, seed: int) -> Iterator[Shot]:
    """The rope in the jaws of the arm, beside the slot."""
    with Cell(CellConfig(mover="arm", particles=PARTICLES)) as cell:
        home = cell.reset(seed + 1).gripper.position.copy()
        for k in range(round(seconds * RATE)):
            s = k / RATE
            shift = np.array([0.08 * np.sin(1.5 * s), 0.1 * np.sin(1.1 * s), 0.05 * np.sin(0.9 * s) ** 2])
            truth = cell.step(ToolPose(home + shift, cell.reference.rotation), 1 / RATE)
            frames = {c.name: f for c, f in zip(cell.cameras, cell.look(), strict=True) if f is not None}
            grip = truth.gripper.position[None], truth.gripper.rotation[None]
            yield Shot(truth.stamp * 1e-9 - 1.0, frames, {}, truth.rope, grip)


def cloth_shots(seconds: float, seed: int) -> Iterator[Shot]:
    """The swung cloth."""
    cloth, generator = Cloth(0.23, seed), np.random.default_rng(seed)
    with Cameras(cloth.model, ring_of_cameras(target=(0.0, 0.0, 0.42))) as cameras:
        for k in range(round(seconds / STEP)):
            cloth.step()
            if k % round(1 / RATE / STEP) == 0:
                yield _shot(cameras, cloth.data, cloth.time, generator, cloth.vertices, None)


def _shot(cameras: Cameras, data: Any, at: float, generator: np.random.Generator, truth: Array, grip: Any) -> Shot:
    stamp = 1_000_000_000 + round(1e9 * at)
    frames = {n: cameras.frame(data, n, stamp, generator) for n in cameras.configs}
    return Shot(at, frames, {n: cameras.truth(data, n)[1] for n in cameras.configs}, truth, grip)


def run(scene: str, seconds: float, seed: int) -> dict[str, float]:
    """One run of a scene; the rollout starts from the tracker's first particles."""
    cloth = scene.startswith("cloth")
    if cloth:
        shots, box = cloth_shots(seconds, seed), Workspace((-0.7, -0.7, 0.02), (0.7, 0.7, 1.0))
    elif scene == "cell":
        shots, box = cell_shots(seconds, seed), Workspace((-0.1, -0.6, 0.0), (0.9, 0.6, 0.6))
    else:
        shots, box = rope_shots(seconds, seed, scene == "rope_still"), Workspace((-0.7, -0.7, 0.0), (0.7, 0.7, 0.6))
    config = TrackerConfig(kind="sheet" if cloth else "line", workspace=box, surface=SurfaceConfig(particles=400))
    names = [f"cam{i}" for i in range(4)]
    tracker, paper = Tracker(config, names), None
    bound: OnCloth | None = None
    error, paper_error, spent, paper_spent, seen, stamps, position = [], [], [], [], [], [], []
    for shot in shots:
        frames = dict(shot.frames)
        if scene.endswith("covered") and COVERED[0] <= shot.time < COVERED[1]:
            frames = {n: f for n, f in frames.items() if n not in ("cam0", "cam1")}
        stamp = next(iter(frames.values())).stamp
        if shot.grip is not None:
            tracker.add_grip(stamp, *shot.grip, np.array([True]))
        begin = time.process_time()
        for name, frame in frames.items():
            tracker.add_frame(name, frame)
        estimate = tracker.step()
        spent.append(time.process_time() - begin)
        if estimate is None:
            continue
        begin = time.process_time()
        views = [tracker.mask.view(n, f) for n, f in frames.items()]
        paper = paper or PaperRollout(estimate.tracks.position)
        rolled = paper.step(frames, views)
        paper_spent.append(time.process_time() - begin)
        bound = (bound or OnCloth(estimate.tracks.position, shot.truth)) if cloth else None
        truth = bound.at(shot.truth) if bound is not None else shot.truth
        error.append(np.linalg.norm(estimate.tracks.position - truth, axis=-1))
        paper_error.append(np.linalg.norm(rolled - truth, axis=-1))
        stamps.append(shot.time)
        position.append(estimate.tracks.position)
        if shot.clean:
            hidden = ~truly_visible(truth, frames, shot.clean, 0.012 if cloth else SURFACE)
            seen.append((estimate.tracks.visible == ~hidden).mean())
    wander = 1e3 * float(np.sqrt(np.array(position)[3:].var(axis=0).sum(axis=-1).mean()))
    return summarise(1e3 * np.array(error), 1e3 * np.array(paper_error), np.array(stamps)) | {
        "jitter_mm": wander if scene.endswith("still") else float("nan"),
        "start_s": spent[0],
        "step_ms": 1e3 * float(np.median(spent[1:])),
        "step_ms_max": 1e3 * float(np.max(spent[1:])),
        "paper_ms": 1e3 * float(np.median(paper_spent)),
        "visibility_accuracy": float(np.mean(seen)) if seen else float("nan"),
    }


def truly_visible(
    points: Array, frames: dict[str, CameraFrame], clean: dict[str, NDArray[np.float32]], surface: float
) -> NDArray[np.bool_]:
    """(P,) seen by some camera that is not covered, from true depth."""
    found = np.zeros(len(points), bool)
    for name, frame in frames.items():
        pixel, depth = project(points, frame.intrinsics, frame.world_from_camera)
        u, v = np.round(pixel).astype(int).T
        height, width = clean[name].shape
        inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
        found[inside] |= depth[inside] - clean[name][v[inside], u[inside]] < surface
    return found


def summarise(error: Array, paper: Array, stamps: Array) -> dict[str, float]:
    """Figures of one run from errors (T, P) [mm]."""
    during = (stamps >= COVERED[0]) & (stamps < COVERED[1])
    after = stamps >= COVERED[1] + 0.5
    return {
        "mean_mm": float(error.mean()),
        "median_mm": float(np.median(error)),
        "p95_mm": float(np.percentile(error, 95)),
        "covered_mm": float(error[during].mean()),
        "after_mm": float(error[after].mean()),
        "drift_mm_s": float(np.polyfit(stamps, error.mean(axis=1), 1)[0]),
        "paper_mean_mm": float(paper.mean()),
        "paper_median_mm": float(np.median(paper)),
        "paper_covered_mm": float(paper[during].mean()),
        "paper_drift_mm_s": float(np.polyfit(stamps, paper.mean(axis=1), 1)[0]),
    }


COLUMNS = ("mean_mm", "median_mm", "p95_mm", "covered_mm", "after_mm", "drift_mm_s", "jitter_mm", "visibility_accuracy",
           "step_ms", "paper_mean_mm", "paper_covered_mm", "paper_drift_mm_s", "paper_ms")  # fmt: skip


def table(results: dict[str, list[dict[str, float]]]) -> str:
    """A row a scene, means over its runs; "-" where a figure means nothing."""
    rows = ["| scene | " + " | ".join(COLUMNS) + " |", "|---" * (len(COLUMNS) + 1) + "|"]
    for scene, runs in results.items():
        means = [float(np.mean([run[c] for run in runs])) for c in COLUMNS]
        rows.append(f"| {scene} | " + " | ".join("-" if np.isnan(m) else f"{m:.2f}" for m in means) + " |")
    return "\n".join(rows)


SCENES = ("rope", "rope_covered", "rope_still", "cell", "cloth", "cloth_covered")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=SCENES)
    parser.add_argument("--seconds", type=amount(0.5, 600.0), default=6.0)
    parser.add_argument("--seeds", type=count(0), nargs="+", default=[0])
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    results: dict[str, list[dict[str, float]]] = {}
    for scene in args.scenes:
        for seed in args.seeds:
            found = run(scene, args.seconds, seed)
            results.setdefault(scene, []).append(found)
            print(scene, f"seed {seed}:", ", ".join(f"{k} {v:.2f}" for k, v in found.items()), flush=True)
            if args.json:
                args.json.write_text(json.dumps(results, indent=1), encoding="utf-8")
    print(table(results))


if __name__ == "__main__":
    main()
