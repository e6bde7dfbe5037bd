"""Whether what was tracked is what the twin has, before anything is computed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pred_core.errors import DatasetError
from pred_core.train.recordings import PERIOD_TOLERANCE
from pred_core.twin import Twin
from pred_core.types import Episode


def check_tracks(suspect: Sequence[Episode], reference: Sequence[Episode], twin: Twin) -> None:
    """Raise DatasetError if an episode has particles the twin lacks or never shows one it has, or if the reference
    comes at another rate. What else does not fit is said where it is aligned with the twin's body.
    """
    have = {int(i) for i in twin.body.id}
    for title, episodes in (("", suspect), ("reference, ", reference)):
        for e in episodes:
            where = f"{title}{e.name}"
            more = [int(i) for i in e.tracks.id if int(i) not in have]
            if more and e.split != "ood":
                raise DatasetError(
                    f"{where}: tracks have particles that the twin lacks",
                    got=_ids(more),
                    next_step="Identify a twin from this data set or its reference",
                )
            without = _without(e, have)
            if title and without and e.split != "ood" and not any(_without(o, have) for o in suspect):
                raise DatasetError(
                    f"{where}: particles of the twin are not in its tracks",
                    got=f"no {_ids(without)}",
                    next_step="Give a --reference of the same object, or identify a twin from it",
                )
            dark = ~np.isfinite(e.position).all(axis=-1)  # (T, P)
            never = [int(i) for i in e.tracks.id[np.all(dark, axis=0)] if int(i) in have]
            if never:
                raise DatasetError(
                    f"{where}: particles of the twin are never measured in this episode",
                    got=_ids(never),
                    allowed="every particle measured in two frames in a row at least",
                    next_step=_help(e),
                )
    for e in reference:
        if _other_rate(e, twin) and not any(_other_rate(o, twin) for o in suspect):
            raise DatasetError(
                f"reference, {e.name}: the reference's frames do not come at the period of the twin and the data set",
                got=f"{e.period:.6g} s",
                allowed=f"{twin.meta.period:.6g} s within {PERIOD_TOLERANCE:.0%}",
                next_step="Give a --reference recorded at the data set's rate",
            )


def _without(e: Episode, have: set[int]) -> list[int]:
    """Ids that an episode does not track."""
    return sorted(have - {int(i) for i in e.tracks.id})


def _other_rate(e: Episode, twin: Twin) -> bool:
    return abs(e.period / twin.meta.period - 1.0) > PERIOD_TOLERANCE


def _help(e: Episode) -> str:
    line = " (of a line, 'rest_length' under 'known' in dataset.yaml lets them be estimated)"
    also = line if e.object.kind == "line" else ""
    return f"Track these particles, leave the episode out, or identify a twin without them{also}"


def _ids(ids: Sequence[int]) -> str:
    more = f" and {len(ids) - 5} more" if len(ids) > 5 else ""
    return f"id {', '.join(map(str, ids[:5]))}{more}"
