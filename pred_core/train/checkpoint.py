"""Checkpoint of a `Trainer`: one safetensors file, written atomically, with everything the next step reads."""

from __future__ import annotations

import dataclasses
import json
import os
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from pred_core.errors import TwinError
from pred_core.train.slots import Slots
from pred_core.train.trainer import Curves, Trainer

FORMAT = 1


def save_checkpoint(path: Path, trainer: Trainer, source: dict[str, str]) -> None:
    """Write the trainer's state. `source`: hashes of twin and data, checked when it is loaded.

    A crash while writing leaves the old file: the new one is complete on disk before it takes the name.
    """
    tensors: dict[str, Tensor] = {
        "order": trainer.order,
        "generator": trainer.generator.get_state(),
        "shuffle": trainer.shuffle.get_state(),
    }
    tensors |= _named("network", trainer.network.state_dict())
    tensors |= _named("average", trainer.average.state_dict())
    tensors |= _named("best", trainer.best)
    if trainer.slots is not None:
        tensors |= _named("slots", trainer.slots.tensors())
    for i, state in trainer.optimizer.state_dict()["state"].items():
        tensors |= _named(f"adam.{i}", state)
    facts = {
        "format": FORMAT,
        "training": dataclasses.asdict(trainer.config),
        "network": dataclasses.asdict(trainer.network.config),
        "source": source,
        "step": trainer.step,
        "cursor": trainer.cursor,
        "best_step": trainer.best_step,
        "seconds": trainer.seconds,
        "curves": dataclasses.asdict(trainer.curves),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.part")
    plain = {k: v.detach().cpu().clone().contiguous() for k, v in tensors.items()}
    save_file(plain, partial, metadata={"facts": json.dumps(facts)})
    with partial.open("rb") as stream:
        os.fsync(stream.fileno())
    partial.replace(path)


def read_facts(path: Path) -> dict[str, Any]:
    """What a checkpoint says about its run. Raises: TwinError if it is not one."""
    try:
        with safe_open(path, framework="pt") as file:
            facts: dict[str, Any] = json.loads((file.metadata() or {})["facts"])
    except (SafetensorError, OSError, KeyError, json.JSONDecodeError) as error:
        raise TwinError(f"{path}: not a training checkpoint", got=error, next_step="Train without --resume") from error
    if facts.get("format") != FORMAT:
        raise TwinError(f"{path}: checkpoint format", got=facts.get("format"), allowed=FORMAT)
    return facts


def load_checkpoint(path: Path, trainer: Trainer, source: dict[str, str]) -> None:
    """Put the trainer where the checkpoint stopped.

    Raises: TwinError if the checkpoint belongs to another twin, other data or other settings.
    """
    facts = read_facts(path)
    expected = {
        "training": dataclasses.asdict(trainer.config),
        "network": dataclasses.asdict(trainer.network.config),
        "source": source,
    }
    for part, values in expected.items():
        for key, value in values.items():
            stored = facts[part].get(key)
            if stored != value:
                raise TwinError(
                    f"{path}: the checkpoint has another {key}", got=stored, allowed=value,
                    next_step="Resume with the same data, twin and settings, or train without --resume",
                )  # fmt: skip
    with safe_open(path, framework="pt") as file:
        tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    trainer.order = tensors["order"]
    trainer.generator.set_state(tensors["generator"])
    trainer.shuffle.set_state(tensors["shuffle"])
    trainer.network.load_state_dict(_part("network", tensors))
    trainer.average.load_state_dict(_part("average", tensors))
    trainer.best = {k: v.to(trainer.device) for k, v in _part("best", tensors).items()}
    adam = trainer.optimizer.state_dict()
    numbers = adam["param_groups"][0]["params"]
    states = {i: _part(f"adam.{i}", tensors) for i in numbers}
    trainer.optimizer.load_state_dict({**adam, "state": {i: state for i, state in states.items() if state}})
    slots = _part("slots", tensors)
    trainer.slots = Slots.restored(slots, trainer.device) if slots else None
    trainer.step, trainer.cursor, trainer.best_step = facts["step"], facts["cursor"], facts["best_step"]
    trainer.seconds = facts["seconds"]
    trainer.curves = Curves(**facts["curves"])


def _named(prefix: str, tensors: dict[str, Any]) -> dict[str, Tensor]:
    return {f"{prefix}/{key}": torch.as_tensor(value) for key, value in tensors.items()}


def _part(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    start = f"{prefix}/"
    return {key[len(start) :]: value for key, value in tensors.items() if key.startswith(start)}
