"""The planner's speed: MPPI itself against pytorch_mppi in one process, then whole replans of simulated objects.

    python benchmarks/planner.py [--rounds 15] [--samples 64] [--device cpu] [--twin TWIN]

Overhead: the simulation and the costs cost nothing here, so that only sampling, limits, curves, weights and
conversions remain. One iteration of both over the same number of samples, steps and axes, in alternating rounds;
ratios as minimum over minimum and as the median of the paired ratios. Before that, the weights of both are shown to be
equal for equal costs. Then seconds a replan, simulated frames a second, and where the time goes. pytorch_mppi is left
out where it is not installed (pip install pytorch_mppi).
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib.util
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from argument_types import count
from torch import Tensor

from pred_core.dynamics import Dynamics
from pred_core.plan.config import MotionConfig, PlannerConfig, SearchConfig
from pred_core.plan.costs import Objective
from pred_core.plan.endpoints import rest_observation
from pred_core.plan.latency import Observation
from pred_core.plan.planner import Planner
from pred_core.plan.rollouts import Rollouts
from pred_core.plan.search import move_mean
from pred_core.plan.task import make_objective, planning_dynamics
from pred_core.springmass import build_body
from pred_core.twin import Twin, TwinMeta
from pred_core.types import Array, Grip, ObjectInfo, Physics, Scene, State

PERIOD = 1.0 / 30.0  # [s]
ITERATIONS = 4  # of a replan
# One thread: other work on the machine does not count. With CUDA the CPU waits, so that its time counts as well.
CLOCK = time.process_time
BOX = {"x_low": -1.0, "x_high": 1.0, "y_low": -1.0, "y_high": 1.0, "z_low": 0.0, "z_high": 1.0}


class Nothing:
    """A Dynamics that costs nothing: the object never moves."""

    period = PERIOD

    def __init__(self, steps: int, worlds: int):
        self._positions = torch.zeros(steps, worlds, 1, 3)

    def start(self, state: State, grip: Grip | None = None) -> State:
        return state

    def step(self, state: State, grip: Grip) -> State:
        return state

    def rollout(self, state: State, grips: Grip) -> Tensor:
        return self._positions


class NoCost:
    """Known costs, whatever the motions are."""

    name = "none"

    def __init__(self, costs: Tensor):
        self._costs = costs

    def __call__(self, rollouts: Rollouts) -> Tensor:
        return self._costs


class Timed:
    """A Dynamics that adds up the time of its rollouts."""

    def __init__(self, inner: Dynamics, device: str):
        self.inner, self.seconds, self._cuda = inner, 0.0, device == "cuda"
        self.period = inner.period

    def start(self, state: State, grip: Grip | None = None) -> State:
        return self.inner.start(state, grip)

    def step(self, state: State, grip: Grip) -> State:
        return self.inner.step(state, grip)

    def rollout(self, state: State, grips: Grip) -> Tensor:
        begin = CLOCK()
        positions = self.inner.rollout(state, grips)
        if self._cuda:
            torch.cuda.synchronize()
        self.seconds += CLOCK() - begin
        return positions


class TimedObjective(Objective):
    """An objective that adds up its own time."""

    seconds = 0.0

    def __call__(self, rollouts: Rollouts) -> tuple[Array, dict[str, Array]]:
        begin = CLOCK()
        result = super().__call__(rollouts)
        self.seconds += CLOCK() - begin
        return result


def ours(samples: int, steps: int, iterations: int, seed: int = 0) -> Callable[[], object]:
    """A plan of that many iterations, everything but simulation and costs."""
    motion = MotionConfig(horizon=steps * PERIOD, knots=10, **BOX)
    search = SearchConfig(samples=samples, iterations=iterations, chunk=samples, frames=4)
    costs = torch.as_tensor(np.random.default_rng(seed).uniform(1.0, 2.0, samples))
    planner = Planner(
        Nothing(steps, samples), Objective([NoCost(costs)]), PlannerConfig(motion, search), np.random.default_rng(seed)
    )
    one = State(torch.zeros(1, 3), torch.zeros(1, 3), torch.zeros(1, dtype=torch.int32))
    seen = Observation(0, one, np.array([[0.0, 0.0, 0.5]]), np.array([[1.0, 0.0, 0.0, 0.0]]))
    return lambda: planner.plan(seen)


def theirs(samples: int, steps: int) -> Callable[[], object]:
    """One `command` of pytorch_mppi with four bounded axes; dynamics and cost are as cheap as can be."""
    import pytorch_mppi

    cost = torch.rand(samples)
    other = pytorch_mppi.MPPI(
        lambda state, action: state, lambda state, action: cost, 3, torch.eye(4) * 0.01, num_samples=samples,
        horizon=steps, device="cpu", lambda_=0.1, u_min=-torch.ones(4), u_max=torch.ones(4),
    )  # fmt: skip
    start = torch.zeros(3)
    return lambda: other.command(start)


def same_weights() -> None:
    """Both weigh samples by exp(-cost / lambda): equal means for equal samples and costs."""
    generator = np.random.default_rng(0)
    costs, samples = generator.uniform(1.0, 2.0, 100), generator.normal(size=(5, 100, 1, 4))
    scale = 0.1 * (np.sort(costs)[50] - costs.min())
    weights = torch.softmax(torch.as_tensor(-costs / scale), 0).numpy()
    expected = np.einsum("k,mkga->mga", weights, samples)
    if not np.allclose(move_mean(samples, costs, 0.1), expected, atol=1e-12):
        raise SystemExit("the means differ")


def paired(runs: dict[str, Callable[[], object]], rounds: int) -> dict[str, list[float]]:
    """CPU times [s] in alternating rounds, after two runs each: other work on the machine does not count."""
    times: dict[str, list[float]] = {name: [] for name in runs}
    for run in runs.values():
        run(), run()
    for _ in range(rounds):
        for name, run in runs.items():
            begin = CLOCK()
            run()
            times[name].append(CLOCK() - begin)
    return times


def overhead(rounds: int) -> None:
    """MPPI itself, per iteration."""
    same_weights()
    there = importlib.util.find_spec("pytorch_mppi") is not None
    print(f"MPPI itself, no simulation, no costs, {rounds} alternating rounds; ms of one CPU")
    header = ("samples", "steps", "iteration", "plan of one", "pytorch_mppi", "min/min", "median")
    print("".join(f"{h:>14}" for h in header))
    for samples in (64, 1000):
        for steps in (10, 60):
            runs = {"one": ours(samples, steps, 1), "nine": ours(samples, steps, 9)}
            if there:
                runs["theirs"] = theirs(samples, steps)
            times = paired(runs, rounds)
            each = (min(times["nine"]) - min(times["one"])) / 8
            line = f"{samples:14d}{steps:14d}{1e3 * each:14.2f}{1e3 * min(times['one']):14.2f}"
            if there:
                least = min(times["theirs"])
                ratios = (np.array(times["nine"]) - times["one"]) / 8 / times["theirs"]
                line += f"{1e3 * least:14.2f}{each / least:14.2f}{statistics.median(ratios):14.2f}"
            print(line)
    print("iteration: (plan of nine iterations - plan of one) / 8; ratios: our iteration over theirs (one command)"
          if there else "pytorch_mppi is not installed: pip install pytorch_mppi")  # fmt: skip
    print("A plan of one adds what a plan needs once: the state at its beginning, its check, its first guess.")


def rope() -> Twin:
    """A rope of 32 particles like the plant's, held at one end above a table."""
    x = np.zeros((32, 3))
    x[:, 0], x[:, 2] = np.linspace(0.45, -0.25, 32), 0.1
    physics = Physics(stiffness=100.0, damping=0.05, connection_threshold=0.03, max_springs=4, bending_stiffness=3e-4)
    meta = TwinMeta(object=ObjectInfo("rope", "line"), period=PERIOD, held=((0, 0), (1, 0)))
    return Twin(meta, build_body("line", x, 0.05, physics, radius=0.004), physics, Scene(ground=0.0))


def block() -> Twin:
    """A soft block of 1000 particles, one corner held."""
    grid = np.stack(np.meshgrid(*(np.arange(10),) * 3, indexing="ij"), -1).reshape(-1, 3) * 0.012
    physics = Physics(stiffness=2.0, damping=2e-3, connection_threshold=0.02, max_springs=20)
    body = build_body("volume", grid + [0.4, 0.0, 0.05], 0.1, physics)
    held = ((999, 0), (998, 0), (989, 0))
    meta = TwinMeta(object=ObjectInfo("block", "volume"), period=PERIOD, held=held)
    return Twin(meta, body, physics, Scene(ground=0.0))


def replans(name: str, twin: Twin, samples: int, steps: int, device: str, rounds: int) -> None:
    """Whole replans: seconds, frames a second, and the shares of simulation, costs and MPPI."""
    motion = MotionConfig(horizon=steps * twin.meta.period, knots=max(4, min(8, steps)), **{**BOX, "z_low": 0.0})
    search = SearchConfig(samples=samples, iterations=ITERATIONS, chunk=min(samples, 64), frames=min(8, steps))
    config = PlannerConfig(motion, search)
    seen = rest_observation(twin, None)
    goal = seen.state.position.double().numpy() + [0.05, 0.05, 0.02]
    dynamics = Timed(planning_dynamics(twin, twin.scene, device), device)
    objective = TimedObjective(make_objective(twin.body, twin.scene, goal, config).costs)
    planner = Planner(dynamics, objective, config, np.random.default_rng(0))
    planner.plan(seen)
    planner.plan(seen)
    best = None
    for _ in range(rounds):
        dynamics.seconds = objective.seconds = 0.0
        begin = CLOCK()
        plan = planner.plan(seen)
        whole = CLOCK() - begin
        rest = whole - dynamics.seconds - objective.seconds
        row = (whole, dynamics.seconds, objective.seconds, rest, plan.motions * plan.steps / whole)
        best = row if best is None or row < best else best
    assert best is not None
    whole, simulation, costs, rest, rate = best
    print(f"{name:18}{twin.body.count:6d}{samples:6d}{steps:5d}{whole:10.3f}{rate:11.0f}{simulation / whole:12.1%}"
          f"{costs / whole:8.1%}{rest / whole:8.1%}{rest / simulation:15.1%}")  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=count(9, 1000), default=15, help="at least 9")
    parser.add_argument("--samples", type=count(2), default=64, help="motions an iteration")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="where motions are simulated")
    parser.add_argument("--twin", type=Path, help="a twin with a residual, in addition")
    args = parser.parse_args()
    torch.set_num_threads(1)
    overhead(args.rounds)
    print(f"\nreplans of {ITERATIONS} iterations on {args.device}, best of {args.rounds // 3 + 1}; seconds of one CPU")
    print(f"{'object':18}{'N':>6}{'K':>6}{'T':>5}{'seconds':>10}{'frames/s':>11}{'simulation':>12}{'costs':>8}{'MPPI':>8}"
          f"{'MPPI/simulation':>17}")  # fmt: skip
    rounds = args.rounds // 3 + 1
    cases = [("rope", rope(), 60), ("rope, short", rope(), 10), ("block", block(), 10)]
    if args.twin is not None:
        twin = Twin.load(args.twin)
        plain = dataclasses.replace(twin, residual=None)
        cases += [("twin, spring-mass", plain, 60), ("twin, PReD", twin, 60)]
    for name, twin, steps in cases:
        replans(name, twin, args.samples, steps, args.device, rounds)


if __name__ == "__main__":
    main()
