"""Warnings that several commands give about how their inputs fit together."""

from __future__ import annotations

import sys

from pred_core.bag.dataset import Dataset
from pred_core.twin import Twin


def warn_of_another_object(twin: Twin, dataset: Dataset, name: str) -> None:
    """One line on stderr if the twin was identified on an object of another name. It may still be meant."""
    if twin.meta.object.name != dataset.object.name:
        print(
            f"warning: twin '{name}' is of object '{twin.meta.object.name}', {dataset.root} of '{dataset.object.name}'",
            file=sys.stderr,
        )
