"""Made-up answers of a diagnosis, and the modules of the benchmark of hidden effects that judge them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pred_core.effects import find_effect

MODULES = ("hidden_cases", "hidden_scores", "hidden_table", "hidden_bench", "hidden_sindy", "hidden_placebos",
           "hidden_flips", "hidden_oracle", "hidden_work", "hidden_effects")  # fmt: skip


def answer(
    outcome: str,
    *causes: tuple[str, dict[str, tuple[float, float, float]]],
    group: Sequence[str] = (),
    base: float = 10.0,
    extended: float = 8.0,
    ranking: Sequence[tuple[str, float]] = (),
) -> dict[str, Any]:
    """A made-up diagnosis.json; parameters as (value, low, high)."""
    return {
        "outcome": outcome,
        "causes": [
            {
                "id": id, "family": find_effect(id).family, "probability": 0.9, "kind": "physics", "group": list(group),
                "parameters": {k: dict(zip(("value", "low", "high"), v, strict=True)) for k, v in values.items()},
            }
            for id, values in causes
        ],
        "ranking": [{"id": i, "probability": p} for i, p in ranking],
        "error_mm": {"base": base, "extended": extended, "floor": 7.0},
        "error_mm_ood": {"base": 2 * base, "extended": 2 * extended},
        "seconds": 100.0,
    }  # fmt: skip
