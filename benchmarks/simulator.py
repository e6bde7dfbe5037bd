"""The simulator's speed on one CPU thread: paired ratios against two other solvers, and growth with N and worlds.

    python benchmarks/simulator.py [--quick] [--rounds 25] [--out out]

Against (a) a plain Warp loop, one launch for springs and one for particles a substep, and (b) Newton's
semi-implicit solver (`pip install newton`; left out if it is not there). Rounds alternate the
solvers in one process after asserting equal trajectories; a ratio is given as minimum over minimum and as the
median of the paired ratios.
"""

from __future__ import annotations

import argparse
import importlib.util
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch
import warp as wp

from pred_core.springmass import SpringMass, build_body
from pred_core.types import Body, Grip, Physics, Scene, State

PHYSICS = Physics(stiffness=0.5, damping=1e-4, connection_threshold=0.019, max_springs=20)
SUBSTEP = 1e-4  # [s]
Tensor3 = np.ndarray[Any, np.dtype[np.float32]]  # (N, 3)
FRAME, FRAME_SUBSTEPS = 1.0 / 30.0, 667  # the field's usual frame and substeps


def cube(count: int) -> Body:
    """A jittered grid of `count` particles, about 9 unique springs each."""
    rng = np.random.default_rng(0)
    side = round(count ** (1 / 3) + 0.5)
    grid = np.stack(np.meshgrid(*(np.arange(side),) * 3, indexing="ij"), -1).reshape(-1, 3)[:count] * 0.01
    return build_body("volume", grid + rng.uniform(-0.001, 0.001, grid.shape), 1e-4 * count, PHYSICS)


def state_of(body: Body, worlds: int) -> State:
    """At rest shape with random velocities, the same in every world."""
    rng = np.random.default_rng(1)
    position = torch.tensor(body.rest_position, dtype=torch.float32).expand(worlds, -1, 3).contiguous()
    velocity = torch.tensor(rng.normal(size=(body.count, 3)) * 0.05, dtype=torch.float32)
    return State(position, velocity.expand(worlds, -1, 3).contiguous(), torch.full((worlds, body.count), -1).int())


def ours(body: Body, worlds: int, substeps: int) -> Callable[[], Tensor3]:
    """One call of `substeps` substeps; returns the last positions of the first world."""
    sim = SpringMass(body, PHYSICS, Scene(), period=SUBSTEP * substeps, substeps=substeps)
    begun = sim.start(state_of(body, worlds))
    nobody = Grip(torch.zeros(1, 0, 3), torch.zeros(1, 0, 4), torch.zeros(1, 0, dtype=torch.bool))
    return lambda: sim.rollout(begun, nobody)[-1, 0].numpy()




@wp.kernel(enable_backward=False)
def plain_springs(
    position: wp.array(dtype=wp.vec3), velocity: wp.array(dtype=wp.vec3), ends: wp.array(dtype=wp.vec2i),
    rest: wp.array(dtype=wp.float32), stiffness: wp.float32, damping: wp.float32,
    force_out: wp.array(dtype=wp.vec3),
):  # fmt: skip
    s = wp.tid()
    i = ends[s][0]
    j = ends[s][1]
    d = position[j] - position[i]
    length = wp.length(d)
    normal = d / length
    rate = wp.dot(velocity[j] - velocity[i], normal)
    f = (stiffness * (length / rest[s] - 1.0) + damping * rate) * normal
    wp.atomic_add(force_out, i, f)
    wp.atomic_sub(force_out, j, f)


@wp.kernel(enable_backward=False)
def plain_particles(
    mass: wp.array(dtype=wp.float32), gravity: wp.vec3, substep: wp.float32,
    position_out: wp.array(dtype=wp.vec3), velocity_out: wp.array(dtype=wp.vec3), force_out: wp.array(dtype=wp.vec3),
):  # fmt: skip
    i = wp.tid()
    v = velocity_out[i] + substep * (force_out[i] / mass[i] + gravity)
    velocity_out[i] = v
    position_out[i] = position_out[i] + substep * v
    force_out[i] = wp.vec3(0.0, 0.0, 0.0)


def plain_warp(body: Body, substeps: int, recorded: bool) -> Callable[[], Tensor3]:
    """Two launches a substep, by `wp.launch` or recorded once and replayed."""
    start = state_of(body, 1)
    x0 = wp.array(start.position[0].numpy(), dtype=wp.vec3, device="cpu")
    v0 = wp.array(start.velocity[0].numpy(), dtype=wp.vec3, device="cpu")
    x, v, f = wp.clone(x0), wp.clone(v0), wp.zeros_like(x0)
    ends = wp.array(body.springs, dtype=wp.vec2i, device="cpu")
    rest = wp.array(body.rest_length.astype(np.float32), dtype=wp.float32, device="cpu")
    mass = wp.array(body.mass.astype(np.float32), dtype=wp.float32, device="cpu")
    forces = {"inputs": [x, v, ends, rest, PHYSICS.stiffness, PHYSICS.damping], "outputs": [f], "device": "cpu"}
    motion = {"inputs": [mass, wp.vec3(*Scene().gravity), SUBSTEP], "outputs": [x, v, f], "device": "cpu"}
    springs = wp.launch(plain_springs, dim=len(body.springs), record_cmd=True, **forces)
    particles = wp.launch(plain_particles, dim=body.count, record_cmd=True, **motion)

    def run() -> Tensor3:
        wp.copy(x, x0)
        wp.copy(v, v0)
        for _ in range(substeps):
            if recorded:
                springs.launch()
                particles.launch()
            else:
                wp.launch(plain_springs, dim=len(body.springs), **forces)
                wp.launch(plain_particles, dim=body.count, **motion)
        return x.numpy().copy()

    return run


def newton(body: Body, substeps: int) -> Callable[[], Tensor3] | None:
    """Newton's `SolverSemiImplicit`, particle grid off; None where the package is missing."""
    if importlib.util.find_spec("newton") is None:
        return None
    import newton as nt

    builder = nt.ModelBuilder()
    start = state_of(body, 1)
    for p, v, m in zip(start.position[0].tolist(), start.velocity[0].tolist(), body.mass.tolist(), strict=True):
        builder.add_particle(tuple(p), tuple(v), m)
    for (i, j), length in zip(body.springs.tolist(), body.rest_length.tolist(), strict=True):
        builder.add_spring(i, j, PHYSICS.stiffness / length, PHYSICS.damping, 0.0)
    model = builder.finalize(device="cpu")
    model.particle_grid = None
    solver, control = nt.solvers.SolverSemiImplicit(model), model.control()

    def run() -> Tensor3:
        now, after = model.state(), model.state()
        for _ in range(substeps):
            now.clear_forces()
            solver.step(now, after, control, None, SUBSTEP)
            now, after = after, now
        return now.particle_q.numpy().copy()

    return run


def seconds(run: Callable[[], Any]) -> float:
    """Wall time of one call [s]."""
    begin = time.perf_counter()
    run()
    return time.perf_counter() - begin


def paired(runs: dict[str, Callable[[], Any]], rounds: int) -> dict[str, list[float]]:
    """Times of each, in alternating rounds."""
    times: dict[str, list[float]] = {name: [] for name in runs}
    for run in runs.values():
        run()
    for _ in range(rounds):
        for name, run in runs.items():
            times[name].append(seconds(run))
    return times


def ratio(slow: list[float], fast: list[float], per: float = 1.0) -> str:
    """Minimum over minimum and median paired ratio; `per` worlds share the fast time."""
    many = np.array(slow) / np.array(fast) * per
    return f"{min(slow) / min(fast) * per:6.1f} {np.median(many):8.1f}"


def against_others(rounds: int, substeps: int) -> None:
    """Equal trajectories, then ratios at N = 1000."""
    body = cube(1000)
    runs: dict[str, Callable[[], Any]] = {"one": ours(body, 1, substeps), "many": ours(body, 32, substeps)}
    runs["plain"], runs["replayed"] = plain_warp(body, substeps, False), plain_warp(body, substeps, True)
    solver = newton(body, substeps)
    if solver is not None:
        runs["newton"] = solver
    expected = runs["plain"]()
    moved = np.abs(expected - body.rest_position).max()
    for name, run in runs.items():
        difference = np.abs(run() - expected).max()
        if not difference < 1e-6 + 1e-4 * moved:
            raise SystemExit(f"{name}: trajectory differs by {difference:.1e} m after {substeps} substeps")
    springs = len(body.springs)
    print(f"N = {body.count}, {springs} springs, {substeps} substeps a call, {rounds} rounds; trajectories equal")
    times = paired(runs, rounds)
    print(f"{'':34}{'ns a spring and world':>22}")
    for name, label, worlds in (("one", "ours, 1 world", 1), ("many", "ours, 32 worlds", 32),
                                ("plain", "plain Warp, 2 launches a substep", 1),
                                ("replayed", "the same, replayed", 1), ("newton", "Newton", 1)):  # fmt: skip
        if name in times:
            print(f"{label:34}{min(times[name]) / substeps / springs / worlds * 1e9:22.2f}")
    print(f"{'ratio':34}{'min/min':>6} {'median':>8}")
    print(f"{'plain / ours, 1 world':34}{ratio(times['plain'], times['one'])}    goal 2")
    print(f"{'plain / ours, a world of 32':34}{ratio(times['plain'], times['many'], 32)}    goal 10")
    print(f"{'replayed / ours, 1 world':34}{ratio(times['replayed'], times['one'])}")
    if "newton" in times:
        print(f"{'Newton / ours, 1 world':34}{ratio(times['newton'], times['one'])}    goal 2")
    else:
        print("Newton is not installed: pip install newton")


def growth(rounds: int, substeps: int, counts: list[int], worlds: list[int], out: Path) -> None:
    """Time against N (one world) and against the number of worlds (N = 1000); exponent; picture."""
    bodies = {n: cube(n) for n in counts}
    by_count = paired({str(n): ours(b, 1, substeps) for n, b in bodies.items()}, rounds)
    size = np.array(counts, dtype=float)
    best = np.array([min(by_count[str(n)]) for n in counts]) / substeps
    work = np.array([len(bodies[n].springs) for n in counts])
    large = size >= 1000
    exponent = np.polyfit(np.log(size[large]), np.log(best[large]), 1)[0]
    per_spring = np.polyfit(np.log(work[large]), np.log(best[large]), 1)[0]
    print(f"N = 1000 to {counts[-1]}: time ~ N^{exponent:.2f} (goal 0.95 to 1.05), ~ springs^{per_spring:.2f}; "
          "small cubes have fewer springs a particle")  # fmt: skip
    body = cube(1000)
    by_world = paired({str(w): ours(body, w, substeps) for w in worlds}, rounds)
    each = np.array([min(by_world[str(w)]) / w for w in worlds]) / substeps
    for w, t in zip(worlds, each, strict=True):
        print(f"{w:4d} worlds of {body.count}: {t * 1e6:7.2f} us a substep and world")
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6))
    left.loglog(size, best * 1e6, "o-")
    left.loglog(size, best[0] * 1e6 * size / size[0], ":", color="grey", label="proportional")
    left.set(xlabel="particles", ylabel="a substep [us]", title=f"one world: N^{exponent:.2f}")
    left.legend()
    right.loglog(worlds, each * 1e6, "o-")
    right.set(xlabel="worlds in one call", ylabel="a substep and world [us]", title=f"N = {body.count}")
    figure.tight_layout()
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / "simulator_growth.png", dpi=120)
    print(f"picture: {out / 'simulator_growth.png'}")


def real_time(rounds: int) -> None:
    """Real-time factors with a frame of 667 substeps, whatever the stiffness would need."""
    for count, worlds, goal in ((500, 1, 1), (1000, 1, 0), (1000, 32, 4)):
        run = ours(cube(count), worlds, FRAME_SUBSTEPS)
        run()
        best = min(seconds(run) for _ in range(rounds))
        aim = f"    goal {goal}" if goal else ""
        print(f"real time: {worlds:3d} x {count:5d} particles, {FRAME_SUBSTEPS} substeps a frame: "
              f"{1e3 * best / worlds:6.2f} ms a frame, factor {worlds * FRAME / best:5.1f}{aim}")  # fmt: skip


def calls(rounds: int) -> None:
    """What a call costs beside the substeps: a cable of 13 particles, 16 substeps a period."""
    x = np.zeros((13, 3))
    x[:, 0] = np.linspace(0, 1, 13)
    physics = Physics(stiffness=300.0, damping=0.5, connection_threshold=0.1, max_springs=4, bending_stiffness=2e-3)
    body = build_body("line", x, 0.1, physics)
    for worlds in (1, 16):
        sim = SpringMass(body, physics, substeps=16)
        state = state_of(body, worlds)
        state.held[:, [0, 1]], state.held[:, [-2, -1]] = 0, 1
        ends = torch.tensor(x[[0, -1]], dtype=torch.float32).expand(worlds, 2, 3)
        grip = Grip(ends, torch.tensor([1.0, 0, 0, 0]).expand(worlds, 2, 4), torch.ones(worlds, 2, dtype=torch.bool))
        grips = Grip(*(v.expand(500, *v.shape) for v in vars(grip).values()))
        begun = sim.start(state, grip)
        times = paired({"step": lambda b=begun, g=grip, s=sim: [s.step(b, g) for _ in range(50)],
                        "rollout": lambda b=begun, g=grips, s=sim: s.rollout(b, g)}, rounds)  # fmt: skip
        print(f"cable of 13, {worlds:2d} worlds: step {min(times['step']) / 50 * 1e6:5.0f} us, "
              f"rollout of 500 {min(times['rollout']) * 1e3:5.2f} ms "
              f"({min(times['rollout']) / 8000 * 1e6:.2f} us a substep)")  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="few substeps and sizes")
    parser.add_argument("--rounds", type=int, default=25, help="at least 9")
    parser.add_argument("--out", type=Path, default=Path("out"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    substeps = 50  # short calls, many rounds: on a shared machine some of them run undisturbed
    against_others(args.rounds, substeps)
    counts = [1000, 2000, 5000] if args.quick else [250, 500, 1000, 2000, 3000, 4000, 5000]
    growth(args.rounds, substeps, counts, [1, 4, 16, 32] if args.quick else [1, 2, 4, 8, 16, 32, 64], args.out)
    real_time(3)
    calls(args.rounds)


if __name__ == "__main__":
    main()
