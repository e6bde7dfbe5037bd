"""How far ahead the twins see: their open-loop error along the motions of trials.

    python benchmarks/reroute_foresight.py --work out/trials [--first 1] [--trials 4] [--cable 0] [--gap 0.024]

Each trial (true state) is led by a twin, once by either; its true rope and gripper are kept. Then both twins predict
from every second of it, from the true state and along the gripper's true way, over 3 s, the planner's horizon. Prints
the mean distance of the particles from the truth after 1, 2 and 3 s, and how far the rope itself moved meanwhile.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from argument_types import amount, count
from reroute import SETTINGS, TWINS
from reroute_eyes import TrueEyes, held_of
from reroute_trial import TrialConfig, run_trial

from pred_core.cli.main import BAD_INPUT
from pred_core.errors import PredError
from pred_core.plan.task import load_settings, planning_dynamics, scene_with_slot, with_gap
from pred_core.plant.live.station import TICK, Moment
from pred_core.twin import Twin
from pred_core.types import Array, Grip, State

AHEAD = (1.0, 2.0, 3.0)  # [s]
APART = 1.0  # [s] between the instants predicted from


class Keeper(TrueEyes):
    """True eyes that keep a moment a period."""

    def __init__(self, twin: Twin):
        super().__init__(twin)
        self._every, self._count = round(twin.meta.period / TICK), 0
        self.kept: list[Moment] = []

    def see(self, moments: Sequence[Moment]) -> None:
        super().see(moments)
        for moment in moments:
            if self._count % self._every == 0:
                self.kept.append(moment)
            self._count += 1


def errors(twin: Twin, config: TrialConfig, kept: Sequence[Moment]) -> Array:
    """(K, len(AHEAD)) [mm] mean distance of the particles from the truth; K instants of a trial."""
    slotted = with_gap(load_settings(str(SETTINGS)), config.gap)
    dynamics = planning_dynamics(twin, scene_with_slot(twin.scene, slotted))
    rope, speed, hand, turn = stacked(kept)
    begin, steps = instants(twin, len(kept))
    if not len(begin):
        return np.zeros((0, len(AHEAD)))
    closed = torch.ones(len(begin), 1, dtype=torch.bool)
    held = held_of(twin).expand(len(begin), -1)

    def grip(at: Array) -> Grip:
        return Grip(torch.as_tensor(hand[at][:, None]), torch.as_tensor(turn[at][:, None]), closed)

    state = dynamics.start(State(torch.as_tensor(rope[begin]), torch.as_tensor(speed[begin]), held), grip(begin))
    found = np.zeros((len(begin), len(AHEAD)))
    for k in range(1, steps[-1] + 1):
        state = dynamics.step(state, grip(begin + k))
        if k in steps:
            away = np.linalg.norm(state.position.numpy() - rope[begin + k], axis=-1).mean(-1)
            found[:, steps.index(k)] = 1e3 * away
    return found


def moved(twin: Twin, kept: Sequence[Moment]) -> Array:
    """(K, len(AHEAD)) [mm] mean way of the particles: the error of who predicts no motion."""
    rope = stacked(kept)[0]
    begin, steps = instants(twin, len(kept))
    away = [np.linalg.norm(rope[begin + k] - rope[begin], axis=-1).mean(-1) for k in steps]
    return 1e3 * np.stack(away, axis=1)


def instants(twin: Twin, count: int) -> tuple[Array, list[int]]:
    """Periods predicted from (K,), and the number of periods of AHEAD."""
    steps = [round(a / twin.meta.period) for a in AHEAD]
    return np.arange(0, count - steps[-1], round(APART / twin.meta.period)), steps


def stacked(kept: Sequence[Moment]) -> tuple[Array, Array, Array, Array]:
    """Rope (T, N, 3) [m], its velocity, hand (T, 3) [m] and its rotation (T, 4), float32."""
    truths = [m.truth for m in kept]
    parts = ([t.rope for t in truths], [t.rope_velocity for t in truths], [t.gripper.position for t in truths],
             [t.gripper.rotation for t in truths])  # fmt: skip
    rope, speed, hand, turn = (np.stack(p).astype(np.float32) for p in parts)
    return rope, speed, hand, turn


def main() -> int:
    torch.set_num_threads(1)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True, metavar="DIR", help="with the twins of reroute.py")
    parser.add_argument("--first", type=count(0), default=1, help="first seed")
    parser.add_argument("--trials", type=count(1), default=4, help="of each twin")
    parser.add_argument("--cable", type=count(0), default=TrialConfig.cable)
    parser.add_argument("--gap", type=amount(0.01, 0.1), default=TrialConfig.gap)
    args = parser.parse_args()
    config = TrialConfig(cable=args.cable, gap=args.gap)
    try:
        twins = {name: Twin.load(args.work / name) for name in TWINS}
        found: dict[str, list[Array]] = {"no motion": [], **{name: [] for name in TWINS}}
        for seed in range(args.first, args.first + args.trials):
            for leader in twins.values():
                eyes = Keeper(leader)
                run_trial(leader, load_settings(str(SETTINGS)), config, seed, args.work / "goals", eyes)
                found["no motion"].append(moved(leader, eyes.kept))
                for name, twin in twins.items():
                    found[name].append(errors(twin, config, eyes.kept))
    except PredError as error:
        print(f"reroute_foresight: {error}", file=sys.stderr)
        return BAD_INPUT
    print("| prediction | instants | " + " | ".join(f"after {a:g} s: mean, median, 90 % [mm]" for a in AHEAD) + " |")
    print("|---" * (2 + len(AHEAD)) + "|")
    for name, parts in found.items():
        values = np.concatenate(parts)
        cells = [f"{v.mean():.1f}, {np.median(v):.1f}, {np.quantile(v, 0.9):.1f}" for v in values.T]
        print(f"| {name} | {len(values)} | " + " | ".join(cells) + " |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
