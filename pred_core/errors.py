"""Errors a user can act on: what happened, what was found, what is allowed, what to do next."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class PredError(ValueError):
    """Base of every error caused by input (a file, a message, a parameter) rather than by a bug.

    The command line and the nodes print it as one line and stop; they never repair the input.
    """

    def __init__(self, what: str, *, got: object = None, allowed: object = None, next_step: str = ""):
        parts = [what.rstrip(".")]
        if got is not None:
            parts.append(f"got {got}")
        if allowed is not None:
            parts.append(f"allowed: {allowed}")
        line = "; ".join(parts) + "."
        if next_step:
            line += f" {next_step.rstrip('.')}" + ("" if next_step.endswith("?") else ".")
        super().__init__(" ".join(line.split()))


class BagError(PredError):
    """A bag cannot be read, or what it holds breaks the bag contract."""


class DatasetError(PredError):
    """A data set folder or its `dataset.yaml` breaks the data set contract."""


class ConfigError(PredError):
    """A configuration value or key is not allowed."""


class TwinError(PredError):
    """A twin directory is missing, incomplete, or does not fit the data."""


class InputError(PredError):
    """A live value (a message, a command) is late, missing, not finite or inconsistent."""


class DivergenceError(PredError):
    """A simulation or a training run left the finite numbers; nothing after that step is used."""


def nearest(name: str, known: Iterable[str]) -> str:
    """The hint for an unknown name: the closest known one, or the list of all."""
    names = sorted(known)
    close = difflib.get_close_matches(name, names, n=1, cutoff=0.6)
    return f"did you mean '{close[0]}'?" if close else f"known: {', '.join(names)}"
