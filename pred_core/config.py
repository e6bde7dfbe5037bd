"""Typed configuration: frozen dataclasses whose fields carry unit and range; strict YAML.

Unknown keys are errors that offer the nearest name; a float never becomes an int; a value outside
its range is an error. Nothing is coerced in silence.
"""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import yaml

from pred_core.errors import ConfigError, nearest

T = TypeVar("T")


def setting(
    default: Any = dataclasses.MISSING,
    *,
    unit: str = "",
    low: float | None = None,
    high: float | None = None,
    doc: str = "",
    choices: tuple[str, ...] = (),
    log: bool = False,
    floor: float | None = None,
) -> Any:
    """A dataclass field with its unit, allowed range and meaning.

    `log`: searched on a log scale, from `floor` up where `low` is zero.
    """
    metadata = {"unit": unit, "low": low, "high": high, "doc": doc, "choices": choices, "log": log, "floor": floor}
    if isinstance(default, (list, dict)):
        raise TypeError("use a tuple: configuration is immutable")
    return dataclasses.field(default=default, metadata=metadata)


def from_mapping(cls: type[T], values: Mapping[str, Any], source: str) -> T:
    """Build the dataclass `cls` from `values`; every problem names `source` and the key.

    Raises: ConfigError for an unknown key, a missing key, a wrong type or a value out of range.
    """
    if not isinstance(values, Mapping):
        raise ConfigError(f"{source}: expected a mapping of settings", got=type(values).__name__)
    fields = {f.name: f for f in dataclasses.fields(cls) if f.init}  # type: ignore[arg-type]
    for key in values:
        if key not in fields:
            raise ConfigError(f"{source}: unknown key '{key}'", next_step=nearest(str(key), fields))
    hints = typing.get_type_hints(cls)
    built = {}
    for name, field in fields.items():
        if name in values:
            built[name] = _checked(hints[name], values[name], f"{source}: {name}")
        elif field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            raise ConfigError(f"{source}: missing key '{name}'", allowed=", ".join(fields))
    result = cls(**built)
    check_ranges(result, source)
    return result


def check_ranges(config: Any, source: str) -> None:
    """Raise ConfigError if a field of a dataclass lies outside the range its `setting` declares."""
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        low, high = field.metadata.get("low"), field.metadata.get("high")
        unit = field.metadata.get("unit", "")
        choices = field.metadata.get("choices") or ()
        where = f"{source}: {field.name}"
        if choices and value not in choices:
            raise ConfigError(where, got=repr(value), allowed=", ".join(choices))
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, bool) or not isinstance(number, (int, float)):
                continue
            if not math.isfinite(number):
                raise ConfigError(where, got=number, allowed="finite numbers")
            if (low is not None and number < low) or (high is not None and number > high):
                raise ConfigError(where, got=f"{number} {unit}".strip(), allowed=f"{low} to {high} {unit}".strip())


def load_yaml(path: Path) -> Any:
    """Parse a YAML file. Raises: ConfigError if it is missing, not YAML, or repeats a key."""
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read as text", got=error) from error
    try:
        return yaml.load(text, Loader=_StrictLoader)  # noqa: S506 (a SafeLoader subclass)
    except yaml.YAMLError as error:
        raise ConfigError(f"{path}: not valid YAML", got=error) from error


def load_config(cls: type[T], path: Path) -> T:
    """Build `cls` from a YAML file (strict)."""
    return from_mapping(cls, load_yaml(path) or {}, str(path))


def to_mapping(config: Any) -> dict[str, Any]:
    """Plain dict of a config dataclass, fit for YAML."""
    return {k: _plain(v) for k, v in dataclasses.asdict(config).items()}


def _plain(value: Any) -> Any:
    """Tuples as lists, at any depth."""
    return [_plain(v) for v in value] if isinstance(value, (list, tuple)) else value


class _StrictLoader(yaml.SafeLoader):
    """SafeLoader that refuses a repeated key, which YAML would silently overwrite."""

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        seen: set[Any] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=deep)
            if key in seen:
                raise yaml.constructor.ConstructorError(None, None, f"key '{key}' given twice", key_node.start_mark)
            seen.add(key)
        return super().construct_mapping(node, deep=deep)


def _checked(hint: Any, value: Any, where: str) -> Any:
    origin = typing.get_origin(hint)
    if origin in (typing.Union, types.UnionType):
        options = typing.get_args(hint)
        if value is None and type(None) in options:
            return None
        return _checked(next(o for o in options if o is not type(None)), value, where)
    if origin is tuple:
        if not isinstance(value, (list, tuple)):
            raise ConfigError(where, got=repr(value), allowed="a list")
        args = typing.get_args(hint)
        item_hints = [args[0]] * len(value) if len(args) == 2 and args[1] is Ellipsis else list(args)
        if len(item_hints) != len(value):
            raise ConfigError(where, got=f"{len(value)} values", allowed=f"{len(item_hints)} values")
        return tuple(_checked(h, v, where) for h, v in zip(item_hints, value, strict=True))
    if dataclasses.is_dataclass(hint):
        return from_mapping(typing.cast(type, hint), value, where)
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if hint is Any or (isinstance(value, hint) and not (isinstance(value, bool) and hint is not bool)):
        return value
    raise ConfigError(where, got=f"{value!r} ({type(value).__name__})", allowed=hint.__name__)
