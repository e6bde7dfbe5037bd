"""The closed loop in one command: a rope is led through a slot, from camera images to arm commands, and judged.

`python -m pred_ros.reroute` (or `pred_reroute`, or `make reroute`) starts plant, tracker, predictor, planner and arm as
processes, enables them, and ends on success or at the time limit. `--fault NAME` breaks something on the way. Left
behind: a bag, a report, a video. The plant's truth goes to the judge and the report only.
"""

from __future__ import annotations

import argparse
import math
import shlex
import socket
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pred_core.arm.limits import GuardConfig
from pred_core.config import from_mapping
from pred_core.errors import ConfigError
from pred_core.plan.endpoints import read_cloud
from pred_core.plan.goal import check_goal, size_of
from pred_core.plan.task import load_settings, workspace
from pred_core.plant.live.slot import SlotConfig
from pred_core.track.settings import parse_fixtures
from pred_core.twin import Twin
from pred_core.types import Array
from pred_ros.bringup import apply_overrides, read_nodes
from pred_ros.commands import run_command
from pred_ros.node_parameters import check_parameters
from pred_ros.reroute_faults import FAULTS, Fault
from pred_ros.reroute_loop import BAG, Job, run
from pred_ros.reroute_report import PAGE, VIDEO, lead, outcome, write_report
from pred_ros.reroute_verdict import Verdict, judge
from pred_ros.resources import config_folder

NOT_REACHED = 1
NODES = ("plant", "tracker", "predictor", "planner", "arm")
AHEAD = 0.16  # [m] of rope beyond the slot in the goal
LIFTED = 0.035  # [m] by which its end is held above the table there
SPACING = 0.01  # [m] of the goal's points


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point. Returns 0 done, 1 not reached or not safe, 2 bad input or a node that failed, 130 interrupted."""
    args = _parser().parse_args(argv)
    return run_command("pred_reroute", lambda: go(args))


def go(args: argparse.Namespace) -> int:
    """Prepare, run, judge, report. Raises: PredError."""
    check_times(args)
    nodes = prepare(args)
    goal = goal_of(args.goal, nodes)
    fault = FAULTS[args.fault] if args.fault else None
    job = Job(nodes, goal, args.out, args.limit, fault, args.fault_at, None if args.no_pictures else "cam0")
    try:
        args.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError("--out", got=error, allowed="a folder that can be written to") from error
    begin = time.monotonic()
    record = run(job, lambda line: print(line, file=sys.stderr, flush=True))
    verdict = judge(record, record.wall, float(nodes["arm"].get("speed", GuardConfig.speed)), fault)
    extra = {
        "command": "python -m pred_ros.reroute " + shlex.join(sys.argv[1:]),
        "seed": args.seed,
        "twin": str(args.twin),
        "wall_seconds": time.monotonic() - begin,
    }
    write_report(record, verdict, extra, args.out)
    print(lead(verdict) if fault is None else f"{fault.name}: {outcome(verdict)}")
    print(f"   report {args.out / PAGE}\n   bag    {args.out / BAG}")
    if not args.no_pictures:
        lost = max(0, record.taken - len(record.pictures))
        print(f"   video  {args.out / VIDEO}" + (f"; {lost} of {record.taken} pictures did not come" if lost else ""))
    return 0 if passed(verdict, fault) else NOT_REACHED


def passed(verdict: Verdict, fault: Fault | None) -> bool:
    """Success; with a fault: the arm stayed safe, a node named it, and the task was done if it still could be."""
    if fault is None:
        return verdict.success
    told = verdict.fault is not None and verdict.fault.safe and bool(verdict.fault.named)
    return told and (verdict.success or not fault.reachable)


def check_times(args: argparse.Namespace) -> None:
    """Raise ConfigError for times and seeds that cannot be, and for a fault that would not happen before the end."""
    if not (math.isfinite(args.limit) and args.limit > 0.0):
        raise ConfigError("--limit", got=args.limit, allowed="above 0 s")
    if not (math.isfinite(args.fault_at) and args.fault_at >= 0.0):
        raise ConfigError("--fault-at", got=args.fault_at, allowed="0 s or more")
    if args.seed < 0:
        raise ConfigError("--seed", got=args.seed, allowed="0 or more")
    last = max((step.after for step in FAULTS[args.fault].steps), default=0.0) if args.fault else 0.0
    if args.fault and args.fault_at + last >= args.limit:
        begins = f"{args.fault} would be over after {args.fault_at + last:g} s"
        raise ConfigError(begins, got=f"--limit {args.limit:g}", allowed="more", next_step="Give a longer --limit")


def prepare(args: argparse.Namespace) -> dict[str, dict[str, Any]]:
    """Parameters of every node: the file's, a free port, the twin, the planner's settings, then the overrides.

    Planner and tracker are told the plant's gap; fixtures that are not the posts of the file's own gap stay as given.
    Raises: ConfigError, also for a parameter that no node has, of a wrong type or out of its range.
    """
    nodes = read_nodes(args.nodes)
    missing = [n for n in NODES if n not in nodes]
    if missing:
        raise ConfigError(f"{args.nodes}: {', '.join(missing)} missing", got=", ".join(nodes), allowed=", ".join(NODES))
    posts = nodes["tracker"].get("fixtures")
    if isinstance(posts, str) and parse_fixtures(posts) == parse_fixtures(fixtures_of(slot_of(nodes["plant"]))):
        del nodes["tracker"]["fixtures"]
    port = free_port()
    for node in ("plant", "arm"):
        nodes[node]["port"] = port
    nodes["plant"]["seed"] = args.seed
    for node in ("predictor", "planner"):
        nodes[node].setdefault("twin", str(args.twin))
    nodes["planner"].setdefault("settings", str(config_folder() / "plan" / "slot.yaml"))
    nodes["planner"]["seed"] = args.seed
    apply_overrides(nodes, args.overrides)
    check_parameters(nodes)
    slot = slot_of(nodes["plant"])
    if load_settings(nodes["planner"]["settings"]).slot is not None:
        nodes["planner"].setdefault("gap", slot.gap)
    parse_fixtures(nodes["tracker"].setdefault("fixtures", fixtures_of(slot)))
    return nodes


def goal_of(file: Path | None, nodes: Mapping[str, Mapping[str, Any]]) -> Array:
    """The goal (Q, 3) [m] of a file, or through the slot. Raises: InputError for one that the planner would refuse,
    TwinError for a node's twin that is none: no node is needed to say so.
    """
    Twin.load(Path(nodes["predictor"]["twin"]))
    given = nodes["planner"]
    twin, settings = Twin.load(Path(given["twin"])), load_settings(given["settings"])
    goal = read_cloud(file) if file else through_slot(SlotConfig(), size_of(twin.body))
    check_goal(goal, twin.body, twin.scene, *workspace(settings))
    return goal


def slot_of(plant: Mapping[str, Any]) -> SlotConfig:
    """The slot that the plant will have. Raises: ConfigError for a gap that cannot be."""
    return from_mapping(SlotConfig, {"gap": plant.get("gap", SlotConfig.gap)}, "plant")


def fixtures_of(slot: SlotConfig) -> str:
    """The posts as the tracker's parameter: 'x y z hx hy hz; ...' [m], boxes along the axes of world."""
    turn = np.abs(slot.world_from_slot[:3, :3])
    return "; ".join(" ".join(f"{v:.4f}" for v in (*b.center, *(turn @ b.half_size))) for b in slot.boxes)


def free_port() -> int:
    """A TCP port of this machine that nobody listens on."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def through_slot(slot: SlotConfig, length: float) -> Array:
    """The goal (Q, 3) [m]: straight through the gap, `AHEAD` beyond it, where its end is held a little up."""
    x = np.arange(AHEAD, AHEAD - length, -SPACING)
    up = LIFTED * np.clip((x - 0.06) / (AHEAD - 0.06), 0.0, 1.0)
    local = np.stack([x, np.zeros_like(x), 0.004 + up, np.ones_like(x)], axis=1)
    return (local @ slot.world_from_slot.T)[:, :3]


def _parser() -> argparse.ArgumentParser:
    faults = "\n".join(f"  {f.name:18} {f.help}" for f in FAULTS.values())
    parser = argparse.ArgumentParser(
        prog="pred_reroute",
        description=__doc__.splitlines()[0] if __doc__ else "",
        epilog=f"faults:\n{faults}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("overrides", nargs="*", metavar="NODE.PARAMETER=VALUE", help="e.g. plant.factor=0.1")
    nodes = config_folder() / "nodes" / "reroute.yaml"
    parser.add_argument("--nodes", type=Path, default=nodes, help="parameters; default: config/nodes/reroute.yaml")
    twin = config_folder() / "twins" / "cell_rope"
    parser.add_argument("--twin", type=Path, default=twin, help="of the rope; default: config/twins/cell_rope")
    parser.add_argument("--goal", type=Path, metavar="CLOUD", help="points [m] of the goal; default: through the slot")
    parser.add_argument("--seed", type=int, default=0, help="start pose, noise, sampled motions; default: 0")
    parser.add_argument("--limit", type=float, default=60.0, help="of the cell's time [s]; default: 60")
    parser.add_argument("--fault", choices=tuple(FAULTS), metavar="NAME", help="break something; see below")
    parser.add_argument("--fault-at", type=float, default=3.0, help="after the arm was enabled [s]; default: 3")
    parser.add_argument("--no-pictures", action="store_true", help="keep no pictures: no video")
    parser.add_argument("--out", type=Path, default=Path("out") / "reroute", help="folder; default: out/reroute")
    return parser


if __name__ == "__main__":
    sys.exit(main())
