"""Starts any set of nodes from one YAML, without launch: `pred_bringup FILE [NODE.PARAMETER=VALUE ...]`.

FILE is an ordinary ROS parameter file whose top-level keys are the nodes to start. The nodes run until one fails,
all have ended, or SIGINT or SIGTERM comes; then all of them are ended.
"""

from __future__ import annotations

import argparse
import signal
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from pred_core.cli.main import BAD_INPUT
from pred_core.config import load_yaml
from pred_core.errors import ConfigError, PredError, nearest
from pred_ros.node_parameters import check_parameters
from pred_ros.processes import NODES, Children, node_command, node_environment

PARAMETERS = "ros__parameters"
LAST_DOMAIN = 232  # beyond it the ports of DDS do not fit in 16 bits


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point. Returns 0 when every node ended well or a signal came, 2 on bad input, else a node's code."""
    parser = argparse.ArgumentParser(prog="pred_bringup", description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("file", type=Path, help="ROS parameter file, e.g. config/nodes/replay.yaml")
    parser.add_argument("overrides", nargs="*", metavar="NODE.PARAMETER=VALUE")
    parser.add_argument("--domain", type=int, help="run in this ROS domain on this machine only")
    parser.add_argument("--logs", type=Path, help="folder for the nodes' output; default: a temporary one")
    args = parser.parse_args(argv)
    try:
        if args.domain is not None and not 0 <= args.domain <= LAST_DOMAIN:
            raise ConfigError("--domain", got=args.domain, allowed=f"0 to {LAST_DOMAIN}")
        nodes = read_nodes(args.file, args.overrides)
        check_parameters(nodes)
        return run(nodes, args.domain, args.logs)
    except PredError as error:
        print(f"pred_bringup: {error}", file=sys.stderr)
        return BAD_INPUT


def read_nodes(file: Path, overrides: Sequence[str] = ()) -> dict[str, dict[str, Any]]:
    """Node -> parameters, with the overrides. Raises: ConfigError for another layout or an unknown node."""
    content = load_yaml(file)
    if not isinstance(content, dict) or not content:
        raise ConfigError(f"{file}: no nodes", allowed=", ".join(NODES))
    nodes: dict[str, dict[str, Any]] = {}
    for name, entry in content.items():
        if name not in NODES:
            raise ConfigError(f"{file}: unknown node '{name}'", next_step=nearest(str(name), NODES))
        if not isinstance(entry, dict) or set(entry) != {PARAMETERS} or not isinstance(entry[PARAMETERS] or {}, dict):
            raise ConfigError(f"{file}: {name}", got=repr(entry)[:80], allowed=f"a mapping '{PARAMETERS}'")
        nodes[name] = dict(entry[PARAMETERS] or {})
    apply_overrides(nodes, overrides)
    return nodes


def apply_overrides(nodes: dict[str, dict[str, Any]], overrides: Sequence[str]) -> None:
    """Set what NODE.PARAMETER=VALUE says. Raises: ConfigError for a malformed one or a node that is not there."""
    for override in overrides:
        target, equals, value = override.partition("=")
        node, dot, parameter = target.partition(".")
        if not equals or not dot or node not in nodes:
            raise ConfigError(f"override '{override}'", allowed=f"NODE.PARAMETER=VALUE with {', '.join(nodes)}")
        try:
            nodes[node][parameter] = yaml.safe_load(value)
        except yaml.YAMLError as error:
            raise ConfigError(
                f"override '{override}'", got="a value that is not YAML", allowed="a number, true, false, text"
            ) from error


def run(nodes: dict[str, dict[str, Any]], domain: int | None, logs: Path | None) -> int:
    """Start the nodes and wait for them. Raises: ConfigError."""
    asked: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda received, _: asked.append(received))
    folder = logs or Path(tempfile.mkdtemp(prefix="pred_bringup_"))
    print(f"pred_bringup: {', '.join(nodes)}; output in {folder}", flush=True)
    with Children(node_environment(domain), folder) as children:
        for name, parameters in nodes.items():
            children.start(name, node_command(name, parameters))
        while True:
            codes = {name: process.poll() for name, process in children.running.items()}
            for name, code in codes.items():
                if code not in (None, 0):
                    print(f"pred_bringup: {name} ended: {children.last_line(name)}", file=sys.stderr)
                    return int(code)
            if asked or None not in codes.values():
                return 0
            time.sleep(0.1)


if __name__ == "__main__":
    sys.exit(main())
