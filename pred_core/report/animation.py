"""An animation of moving particles in plain JavaScript: play, scrub, turn by dragging, switch tracks on and off."""

from __future__ import annotations

import html
import json
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources

import numpy as np

from pred_core.types import Array

FRAMES_PER_SECOND = 25.0
MOST_FRAMES = 400
MOST_PARTICLES = 400
_UNIT = 1e-4  # [m] coordinates are stored as whole tenths of a millimetre


@dataclass(frozen=True)
class Track:
    """One set of moving particles."""

    name: str
    position: Array  # (T, P, 3) [m] world, z up; NaN = not drawn
    color: str


def animation(tracks: Sequence[Track], period: float, *, line: bool, title: str) -> str:
    """Markup of the animation, thinned to 25 frames a second and 400 particles. `period` [s] of the input frames.

    `line`: consecutive particles are joined.
    """
    frames = tracks[0].position.shape[0]
    stride = max(1, round(1.0 / FRAMES_PER_SECOND / period), -(-frames // MOST_FRAMES))
    count = tracks[0].position.shape[1]
    chosen = np.linspace(0, count - 1, min(count, MOST_PARTICLES)).round().astype(int)
    thinned = [t.position[::stride][:, chosen] for t in tracks]
    everything = np.concatenate([t.reshape(-1, 3) for t in thinned[:1]])
    everything = everything[np.isfinite(everything).all(axis=1)]
    center = (everything.min(0) + everything.max(0)) / 2
    data = {
        "title": title,
        "step": stride * period,
        "line": line,
        "size": float(np.linalg.norm(everything.max(0) - everything.min(0)) / 2),
        "tracks": [
            {"name": t.name, "color": t.color, "frames": [_whole(f - center) for f in p]}
            for t, p in zip(tracks, thinned, strict=True)
        ],
    }
    # "</" would end the script element inside a string.
    payload = json.dumps(data, separators=(",", ":")).replace("</", "<\\/")
    script = resources.files("pred_core.report").joinpath("animation.js").read_text("utf-8")
    return (
        f'<figure><div class="pred-animation" data-title="{html.escape(title)}"></div>'
        f"<script>(function(host){{{script}\nrun(host,{payload});}})"
        "(document.currentScript.previousElementSibling);</script></figure>"
    )


def _whole(frame: Array) -> list[int | None]:
    return [int(round(v / _UNIT)) if np.isfinite(v) else None for v in frame.ravel()]
