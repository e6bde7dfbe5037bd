"""What the parameters of every node may be, checked before any of them is started."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any

from pred_core.config import from_mapping
from pred_core.errors import ConfigError
from pred_ros.parameters import SWITCHES, is_library_name
from pred_ros.shell import Shell


def check_parameters(nodes: Mapping[str, Mapping[str, Any]]) -> None:
    """Raise ConfigError for an unknown name, a wrong type or a value out of range. What a text means, a node checks."""
    for node, given in nodes.items():
        odd = [name for name in given if not isinstance(name, str)]
        if odd:
            raise ConfigError(f"name of a parameter of {node}", got=odd[0], allowed="text")
        for name in SWITCHES:
            if not isinstance(given.get(name, False), bool):
                raise ConfigError(f"parameters of {node}: {name}", got=repr(given[name]), allowed="true, false")
        own = {name: value for name, value in given.items() if not is_library_name(name)}
        from_mapping(config_class(node), own, f"parameters of {node}")


def config_class(node: str) -> type:
    """The dataclass of a node's parameters. Imported late: it brings the node's core along."""
    module = importlib.import_module(f"pred_ros.{node}_node")
    shells = [v for v in vars(module).values() if isinstance(v, type) and issubclass(v, Shell) and v is not Shell]
    return {s.NAME: s.CONFIG for s in shells}[node]
