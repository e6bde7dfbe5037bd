"""Episode marks: std_msgs/String with JSON on `player/episode` (latched), the only thing common_interfaces lacks.

    {"event": "begin", "name": "ep003", "index": 0, "count": 14, "begin": 1000000000, "frames": 500,
     "shift": 0, "split": "test", "recording": 3, "kind": "line"}
    {"event": "end", "episodes": 14}

`begin` is the header stamp [ns] of the first tracker/points as published; `shift` [ns] is what was added to the
capture stamps. Marks may arrive after the data they announce: readers sort data by `begin`, not by arrival.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass

from pred_core.config import from_mapping
from pred_core.errors import InputError

TOPIC = "player/episode"


@dataclass(frozen=True)
class EpisodeMark:
    """An episode begins."""

    name: str
    index: int
    count: int  # episodes of this replay
    begin: int  # [ns] stamp of its first tracker/points as published
    frames: int  # number of tracker/points
    shift: int = 0  # [ns] added to the capture stamps
    split: str = ""
    recording: int = -1
    kind: str = ""  # line | sheet | volume | mixed, if known


@dataclass(frozen=True)
class EndMark:
    """The replay is over."""

    episodes: int


Mark = EpisodeMark | EndMark
_EVENTS: dict[str, type] = {"begin": EpisodeMark, "end": EndMark}


def encode(mark: Mark) -> str:
    """JSON text of a mark."""
    event = next(name for name, cls in _EVENTS.items() if isinstance(mark, cls))
    return json.dumps({"event": event, **asdict(mark)})


def decode(text: str) -> Mark:
    """A mark. Raises: InputError for anything else."""
    try:
        values = json.loads(text)
    except json.JSONDecodeError as error:
        raise InputError(f"{TOPIC}: not JSON", got=repr(text[:60])) from error
    event = values.pop("event", None) if isinstance(values, dict) else None
    if event not in _EVENTS:
        raise InputError(f"{TOPIC}: event", got=repr(event), allowed=", ".join(_EVENTS))
    mark: Mark = from_mapping(_EVENTS[event], values, TOPIC)
    return mark
