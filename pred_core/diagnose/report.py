"""The HTML report of a diagnosis: one file with everything a person wants to see."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pred_core.calibration import Calibration
from pred_core.diagnose import pictures, pictures_map, pictures_motion
from pred_core.diagnose import report_parts as parts
from pred_core.diagnose.errors import predicted
from pred_core.diagnose.guard import Guard
from pred_core.diagnose.map import WINDOW, Replay, conditional, edges_of, replay
from pred_core.diagnose.report_network import Network, add_network
from pred_core.diagnose.result import Diagnosis
from pred_core.evaluate.style import INK
from pred_core.report import Page, Track, animation
from pred_core.types import Array, Episode

FEWEST_BINS = 3  # with a mean, of the time in the recordings
MOVED = 1e-3  # [m] by which a calibration must move the tracks to be drawn beside them


def write_report(
    path: Path,
    answer: Diagnosis,
    episodes: Sequence[Episode],
    reference: Sequence[Episode] | None,
    command: str,
    network: Network | None = None,
    guard: Guard | None = None,
) -> None:
    """Write the file. `episodes`, `reference`: as recorded, nothing corrected. `network`: errors with one, if known;
    `guard`: what the questioned twin's own network does, if it has one.

    Raises: DatasetError if an episode is too short to be replayed.
    """
    page = Page("Diagnosis")
    page.lead(answer.sentence)
    parts.summary(page, answer)
    _map(page, answer, episodes, reference)
    parts.add_evidence(page, answer)
    _overlay(page, answer, episodes)
    page.heading("Errors by episode")
    shown = [e for e in (answer.errors, answer.errors_ood) if e is not None]
    page.figure(pictures.by_episode(shown), "Whole episodes, open loop, in the order of the base's error.")
    parts.add_budget(page, answer)
    parts.add_gate(page, answer)
    parts.add_open_questions(page, answer)
    pictures_motion.add_next_motion(page, answer)
    add_network(page, network, guard)
    page.heading("How it was made")
    page.code(command)
    made = f"{answer.seconds:.0f} s; seed {answer.seed}. The extended twin stands beside this file in twin/."
    page.text(made, note=True)
    page.write(path)


def replays(d: Diagnosis, episodes: Sequence[Episode], reference: Sequence[Episode] | None) -> list[Replay]:
    """Base and, if anything was named, extended over the train and test episodes; the base over the reference's."""
    mine = [e for e in episodes if e.split != "ood"]
    begin = min(int(e.stamps[0]) for e in mine) if d.session is None else d.session
    rows = [replay("base", d.base_twin, mine, _given(d), begin)]
    if d.causes:
        rows.append(replay("extended", d.twin, mine, d.twin.calibration, begin))
    known = [e for e in reference or () if e.split != "ood"]
    if known:
        rows.append(replay("reference", d.base_twin, known, _given(d)))
    return rows


def _given(d: Diagnosis) -> Calibration:
    """What was corrected before anything was found."""
    return d.base_twin.calibration if d.twin.base is None else d.twin.base.calibration


def _map(page: Page, d: Diagnosis, episodes: Sequence[Episode], reference: Sequence[Episode] | None) -> None:
    page.heading("Where and when the error sits")
    rows = with_clock(replays(d, episodes, reference), d.seed)
    also = " Reference: the base on the reference's episodes." if rows[-1].name == "reference" else ""
    page.figure(
        pictures_map.curves(rows, d.seed),
        f"Mean error of train and test episodes, restarted from data every {WINDOW:g} s so that it is seen where it "
        f"arises. Bins hold equally many samples; bands are 95 % over episodes.{also}",
    )
    page.figure(
        pictures_map.seen_from_above(rows),
        "Seen from above: mean error where the object was (cells with two episodes or more). Arrows: the mean of "
        "measured minus predicted, which way the missing cause pulls.",
    )
    if d.base_twin.body.kind == "line":
        page.figure(
            pictures_map.direction(rows, d.base_twin.body.arc),
            "Which way it pulls along the object: mean of measured minus predicted, in world axes.",
        )


def with_clock(rows: list[Replay], seed: int) -> list[Replay]:
    """Without the time in the recordings, where that leaves too few points to show how the error goes with it."""
    if "session" not in rows[0].features:
        return rows
    curve = conditional(rows[0], "session", edges_of(rows[0], "session"), np.random.default_rng(seed))
    if np.isfinite(curve.mean).sum() >= FEWEST_BINS:
        return rows
    return [
        dataclasses.replace(r, features={k: v for k, v in r.features.items() if k != "session"}) for r in rows
    ]


def _overlay(page: Page, d: Diagnosis, episodes: Sequence[Episode]) -> None:
    """Measured, base and extended in the held-out episode whose base error is the median one."""
    names, values = d.errors.base.names, d.errors.base.values
    name = names[int(np.argsort(values)[len(names) // 2])]
    episode = next(e for e in episodes if e.name == name)
    base, measured = predicted(d.base_twin, _given(d).correct(episode), d.session)
    extended, corrected = predicted(d.twin, d.twin.calibration.correct(episode), d.session)
    frames = min(len(base), len(extended))
    held = "held-out " if d.errors.split == "test" else ""
    page.heading(f"{'Before and after: ' if d.causes else 'As it is: '}{held}episode {name}")
    tracks: list[tuple[str, Array, str]] = [("measured", measured[:frames], INK)]
    if np.nanmax(np.linalg.norm(corrected[:frames] - measured[:frames], axis=-1), initial=0.0) > MOVED:
        tracks.append(("measured, corrected", corrected[:frames], pictures.NAMED[1]))
    tracks.append(("base", base[:frames], pictures_map.COLORS["base"]))
    if d.causes:
        tracks.append(("extended", extended[:frames], pictures_map.COLORS["extended"]))
    line, period = d.base_twin.body.kind == "line", d.base_twin.meta.period
    k = names.index(name)
    page.figure(
        pictures.stills(tracks, period, line),
        f"The episode in the middle of the {d.errors.split} split by the base's error: base {values[k]:.1f} mm, "
        f"extended {d.errors.extended.values[k]:.1f} mm. One start from data, then open loop.",
    )
    page.html(animation([Track(*t) for t in tracks], period, line=line, title=f"Episode {name}"))
