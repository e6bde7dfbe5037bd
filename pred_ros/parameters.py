"""ROS parameters from one frozen dataclass: descriptors with range and unit, all-or-nothing validation."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Callable
from typing import Any, TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from pred_core.config import from_mapping, to_mapping
from pred_core.errors import ConfigError, PredError, nearest

T = TypeVar("T")

# What the client library itself declares or accepts beside the node's own parameters.
SWITCHES = ("use_sim_time", "start_type_description_service")
_LIBRARY_PREFIXES = ("qos_overrides.",)


def is_library_name(name: str) -> bool:
    """True for parameters that belong to the client library rather than to the node."""
    return name in SWITCHES or name.startswith(_LIBRARY_PREFIXES)


def declare(node: Node, cls: type[T], overrides: dict[str, Any]) -> T:
    """Declare every field of `cls` and return the configuration that `overrides` (name -> value) make.

    Raises: ConfigError for an unknown name, a wrong type or a value out of range; nothing is declared then.
    """
    config = from_mapping(cls, overrides, f"parameters of {node.get_name()}")
    hints = typing.get_type_hints(cls)
    for field in dataclasses.fields(config):  # type: ignore[arg-type]
        node.declare_parameter(
            field.name, getattr(config, field.name), _descriptor(field, hints[field.name]), ignore_override=True
        )
    return config


def follow(node: Node, current: Callable[[], Any], accept: Callable[[Any], None]) -> None:
    """Check every later change as a whole: all new values are accepted together, or none is.

    `current` returns the configuration in force; `accept` receives the new one and may raise PredError to refuse it.
    """

    def changed(parameters: list[Parameter]) -> SetParametersResult:
        own = {p.name: p.value for p in parameters if not is_library_name(p.name)}
        if not own:
            return SetParametersResult(successful=True)
        config = current()
        try:
            names = [f.name for f in dataclasses.fields(config)]
            for name in own:
                if name not in names:
                    raise ConfigError(f"unknown parameter '{name}'", next_step=nearest(name, names))
            accept(from_mapping(type(config), {**to_mapping(config), **own}, f"parameters of {node.get_name()}"))
        except PredError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    node.add_on_set_parameters_callback(changed)


def _descriptor(field: dataclasses.Field, hint: Any) -> ParameterDescriptor:
    meta = field.metadata
    unit, doc, choices = meta.get("unit", ""), meta.get("doc", ""), meta.get("choices") or ()
    parts = [doc, f"[{unit}]" if unit else "", f"one of: {', '.join(choices)}" if choices else ""]
    described = ParameterDescriptor(description=" ".join(p for p in parts if p))
    low, high = meta.get("low"), meta.get("high")
    if low is None or high is None:
        return described
    if hint is float:
        described.floating_point_range = [FloatingPointRange(from_value=float(low), to_value=float(high), step=0.0)]
    elif hint is int:
        described.integer_range = [IntegerRange(from_value=int(low), to_value=int(high), step=1)]
    return described
