"""A frozen configuration as command-line flags: one flag a field, strict about what it is given."""

from __future__ import annotations

import argparse
import dataclasses
from typing import Any, get_type_hints

from pred_core.config import from_mapping
from pred_core.errors import ConfigError


def add_settings(parser: argparse.ArgumentParser, config: type) -> None:
    """A flag for every field of the configuration."""
    for field in dataclasses.fields(config):
        default = f"{shown(field.default)} {field.metadata['unit']}".strip()
        text = f"{field.metadata['doc']} (default: {default})".replace("%", "%%")
        flag = "--" + field.name.replace("_", "-")
        if isinstance(field.default, bool):
            parser.add_argument(flag, action=argparse.BooleanOptionalAction, default=None, help=text)
        else:
            parser.add_argument(flag, default=None, metavar="VALUE", help=text)


def read_settings(args: argparse.Namespace, config: type, where: str, values: dict[str, Any] | None = None) -> Any:
    """The configuration the flags describe, over `values`. Raises: ConfigError naming the field."""
    hints = get_type_hints(config)
    values = dict(values or {})
    for field in dataclasses.fields(config):
        given = getattr(args, field.name)
        if given is not None:
            values[field.name] = given if isinstance(given, bool) else _parsed(given, hints[field.name])
    return from_mapping(config, values, where)


def given_settings(args: argparse.Namespace, config: type) -> list[str]:
    """The flags as they were given."""
    flags: list[str] = []
    for field in dataclasses.fields(config):
        given = getattr(args, field.name)
        flag = "--" + field.name.replace("_", "-")
        if isinstance(given, bool):
            flags.append(flag if given else flag.replace("--", "--no-", 1))
        elif given is not None:
            flags += [flag, str(given)]
    return flags


def parse_held(text: str, where: str = "--held") -> dict[int, int]:
    """'0:0 11:1' -> {0: 0, 11: 1}. `where`: what the user set. Raises: ConfigError."""
    try:
        pairs = [tuple(int(x) for x in item.split(":")) for item in text.replace(",", " ").split()]
        held = {particle: gripper for particle, gripper in pairs}
    except ValueError as error:
        raise ConfigError(where, got=repr(text), allowed="pairs like '0:0 1:1 11:2'") from error
    if not held or any(p < 0 or g < 0 for p, g in held.items()):
        raise ConfigError(where, got=repr(text), allowed="ids and gripper indices of 0 or more")
    if len(held) < len(pairs):
        raise ConfigError(f"{where} names a particle twice", got=repr(text), allowed="each particle in one gripper")
    return held


def shown(value: Any) -> str:
    """A default as a user would type it."""
    return ",".join(str(v) for v in value) if isinstance(value, tuple) else str(value)


def _parsed(text: str, hint: Any) -> Any:
    """A flag's text as the number or list it stands for; what does not parse is left for the strict check."""
    if hint == tuple[str, ...]:
        return tuple(part for part in text.split(",") if part)
    if hint == tuple[float, ...]:
        return tuple(_number(part) for part in text.split(",") if part)
    return _number(text)


def _number(text: str) -> Any:
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text
