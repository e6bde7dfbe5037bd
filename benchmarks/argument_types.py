"""Types of command line arguments that say what is allowed."""

from __future__ import annotations

import argparse
from collections.abc import Callable


def count(low: int, high: int = 10**6) -> Callable[[str], int]:
    """An integer from `low` to `high`."""

    def parse(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = low - 1
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"got {text!r}; allowed: {low} to {high}")
        return value

    return parse


def amount(low: float, high: float) -> Callable[[str], float]:
    """A number from `low` to `high`."""

    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"got {text!r}; allowed: {low:g} to {high:g}")
        return value

    return parse
