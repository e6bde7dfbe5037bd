"""Parts of the report that are tables and sentences: summary, evidence, budget, gate, what stays open."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np

from pred_core.diagnose import pictures
from pred_core.diagnose.chosen import chosen_of
from pred_core.diagnose.evidence import Judged
from pred_core.diagnose.gate_result import GateCause
from pred_core.diagnose.progress import Round
from pred_core.diagnose.result import Diagnosis, Errors
from pred_core.diagnose.said import NAMES, confusions
from pred_core.evaluate.bootstrap import bootstrap_interval
from pred_core.report import Page, number

MOST_PARAMETERS = 6  # of a cause in the summary; a profile has many
FEWEST = 6  # episodes; drawing fewer gives intervals that are clearly too narrow: by sqrt(1 - 1/n), and no Student's t


def words(id: str) -> str:
    """A cause, or several joined by '+', in words."""
    return " and ".join(NAMES.get(one, one.replace("_", " ")) for one in id.split("+"))


def summary(page: Page, d: Diagnosis) -> None:
    """What was found and what it is worth, in one table each."""
    rows = []
    for c in d.causes:
        for n, (name, v) in enumerate(list(c.parameters.items())[:MOST_PARAMETERS]):
            edge = " (at its bound)" if v.at_bound else ""
            kind = "sensor" if c.measured else "physics"
            first = (words(c.id), f"{c.probability:.2f}", kind) if n == 0 else ("", "", "")
            unit = "" if v.unit == "1" else f" {v.unit}"
            span = f"{number(v.low)} to {number(v.high)}" if v.interval else "no interval"
            rows.append((*first, name, f"{number(v.value)}{unit}{edge}", span))
        more = len(c.parameters) - MOST_PARAMETERS
        if more > 0:
            rows.append(("", "", "", f"and {more} more", "", ""))
    if rows:
        page.table(("cause", "probability", "kind", "parameter", "value", "90 % interval"), rows)
    page.table(
        ("episodes", "base [mm]", "extended [mm]", "reference [mm]", "gain [mm]", "95 % interval", "improved"),
        [_error_row(e) for e in (d.errors, d.errors_ood) if e is not None],
    )
    note = "Whole episodes, open loop; mean distance of free particles. Intervals draw episodes."
    page.text(f"{note}{_significance(d)}", note=True)
    for line in d.notes:
        page.text(line, note=True)


def _significance(d: Diagnosis) -> str:
    """The p value of all that was named, and what it is adjusted for."""
    if not d.causes:
        return ""
    last = max(d.causes, key=lambda c: c.p_adjusted)
    over = ""
    if last.measured:
        over = ", adjusted for all causes that were measured without the simulation"
    elif last.id in d.judged_ids:
        rows = [(j, q) for seen in d.rounds for j, q, why in seen.judged if not why and last.id in j.trial.ids]
        pair = any(len(j.trial.ids) > 1 and q == last.p_adjusted for j, q in rows)
        over = f", adjusted for the {'pairs' if pair else 'finalists'} of its round"
    several = " (the largest: all causes must hold)" if len(d.causes) > 1 else ""
    return f" p {d.p_adjusted:.2g}{over}{several}."


def span_of(low: float, high: float, episodes: int) -> str:
    """An interval from drawing episodes, and what to think of it."""
    if episodes < 2:
        return "no interval (1 episode)"
    narrow = f" ({episodes} episodes: too narrow)" if episodes < FEWEST else ""
    return f"{low:.2f} to {high:.2f}{narrow}"


def _error_row(e: Errors) -> tuple[str, ...]:
    g = e.gain
    return (
        e.split, f"{e.base.mean:.2f}", f"{e.extended.mean:.2f}", "–" if e.floor is None else f"{e.floor:.2f}",
        f"{g.mean:.2f}", span_of(g.low, g.high, g.episodes), f"{g.improved} of {g.episodes}",
    )  # fmt: skip


def add_evidence(page: Page, d: Diagnosis) -> None:
    """Every candidate with what it saves and why it is not named, round by round."""
    page.heading("Evidence: what explains it, and what does not")
    page.text(
        "All candidates are screened on the train episodes; those that lead, the finalists, are fitted on all of these "
        "jointly and judged on every episode: by the joint fit where its recording was not fitted, else by parameters "
        "that a step from the joint fit gives without that recording (if there is another). p is family-wise over the "
        "finalists of a round, not over all that were screened. 100 % is the mean excess of the base over what the "
        "reference leaves (without a reference: over nothing). Dots are episodes, bars 95 %.",
        note=True,
    )
    tried = d.judged_ids
    for c in d.causes:
        if c.measured:
            page.text(f"{words(c.id)}: measured without the simulation, see below; corrected before anything is tried.")
        elif c.id not in tried:
            share = f"it saves {c.closed or 0.0:.0%} of the loss of the base (p {c.p_adjusted:.2g})"
            page.text(f"{words(c.id)}: another structure of the model, asked before the candidates; {share}.")
    if not d.rounds:
        page.text("No candidate was tried.")
    chosen = chosen_of(d.rounds, d.causes)
    for n, (seen, named) in enumerate(zip(d.rounds, chosen, strict=True)):
        if not seen.judged:
            continue
        ids = {j.trial.id: words(j.trial.id) for j, _, _ in seen.judged}
        after = "" if n == 0 else " (after what was named before)"
        green = "nothing is named" if named is None else f"green: {_verdict(named, d)}, {words(named.trial.id)}"
        page.figure(pictures.evidence(seen, ids, named, d.seed), f"Round {n + 1}{after}; {green}.")
        _round_table(page, d, n, named)
        _only_screened(page, seen)


def _round_table(page: Page, d: Diagnosis, n: int, named: Judged | None) -> None:
    """All candidates fitted in a round; in the first also their probabilities, with "unknown" and "nothing"."""
    seen = d.rounds[n]
    excess, _ = pictures.whole_of(seen)
    probability = {r.id: f"{r.probability:.2f}" for r in d.ranking} if n == 0 else {}
    ids = [j.trial.id for j, _, _ in seen.judged]
    rows, marks = [], []
    for j, q, why in sorted(seen.judged, key=lambda row: (row[0] is not named, -row[0].mean)):
        verdict = _verdict(j, d) if j is named else _in_words(why, ids) or _beaten(j, named, d)
        share, likely = f"{100 * j.mean / excess:.0f} %", probability.get(j.trial.id, "–")
        rows.append((words(j.trial.id), j.trial.family, likely, share, f"{q:.2g}", _values(j.values), verdict))
        marks.append("strong" if j is named else "")
    for id, label in (("unknown", "something not in the library"), ("none", "nothing")):
        if id in probability:
            rows.append((label, "", probability[id], "–", "–", "", ""))
            marks.append("")
    page.table(("candidate", "family", "probability", "saves", "p adjusted", "fitted", "verdict"), rows, marks)


def _verdict(named: Judged, d: Diagnosis) -> str:
    """What a candidate that was taken is: a name, or only the nearest law."""
    return "nearest" if any(c.contradicted for c in d.causes if c.id in named.trial.ids) else "named"


def _beaten(j: Judged, named: Judged | None, d: Diagnosis) -> str:
    """Why a candidate that passes every test is not the one."""
    if named is None:
        return "part of a pair that explains too little"
    group = next(c.group for c in d.causes if c.id == named.trial.ids[0])
    if j.trial.id in group:
        return f"these data do not tell it apart from {words(named.trial.id)}"
    return f"saves less than {words(named.trial.id)}"


def _in_words(text: str, ids: Sequence[str]) -> str:
    """A verdict with candidates' ids replaced."""
    for id in sorted(ids, key=len, reverse=True):
        text = re.sub(rf"\b{re.escape(id)}\b", words(id), text)
    return text


def _values(values: Mapping[str, float]) -> str:
    """Parameters that are not vectors too long to read."""
    shown = {k.split(".", 1)[-1].replace("[0]", ""): v for k, v in values.items() if "." in k}
    text = ", ".join(f"{k} {number(v)}" for k, v in list(shown.items())[:5])
    return text + (", ..." if len(shown) > 5 else "")


def _only_screened(page: Page, seen: Round) -> None:
    fitted = {i for j, _, _ in seen.judged for i in j.trial.ids}
    rest = [words(i) for i, _ in seen.screened if i not in fitted]
    if rest:
        page.text(f"Screened and not fitted, because they promised less: {', '.join(rest)}.", note=True)


def budget_rows(d: Diagnosis) -> list[tuple[str, float, str]]:
    """(name, mm, colour) that add up to the base's held-out error."""
    rows = []
    for n, (id, mm) in enumerate(d.budget["named"].items()):
        rows.append((words(id), float(mm), pictures.NAMED[n % len(pictures.NAMED)]))
    rows.append(("learned by a network", float(d.budget["learned"]), pictures.LEARNED))
    rows.append(("unexplained", float(d.budget["unexplained"]), pictures.UNEXPLAINED))
    floor = "left, less than the reference leaves" if _under_floor(d) else "floor: noise, chaos, known misfit"
    rows.append((floor, float(d.budget["floor"]), pictures.FLOOR))
    rest = d.errors.base.mean - sum(v for _, v, _ in rows)
    if abs(rest) > 1e-6 * max(d.errors.base.mean, 1.0):
        rows.append(("base refitted", rest, pictures.OTHER))
    return rows


def _under_floor(d: Diagnosis) -> bool:
    """Less is left than the reference leaves on its own episodes."""
    return d.errors.floor is not None and d.errors.floor > d.errors.extended.mean


def add_budget(page: Page, d: Diagnosis) -> None:
    """One stacked bar and its numbers."""
    page.heading("Error budget")
    rows, total = budget_rows(d), d.errors.base.mean
    what = f"Where the {total:.1f} mm of the base come from ({d.errors.split} episodes)."
    page.figure(pictures.budget_bar(rows), what)
    table = [(name, f"{mm:.2f}", f"{100 * mm / total:.0f} %" if total > 0 else "–") for name, mm, _ in rows if mm]
    if not d.budget["learned"]:
        table.append(("learned by a network", "not measured", "–"))
    table.append(("sum = base", f"{sum(v for _, v, _ in rows):.2f}", "100 %"))
    page.table(("part", "mm", "share"), table, [*[""] * (len(table) - 1), "strong"])
    page.text(_bands(d), note=True)
    if _under_floor(d):
        page.text(
            f"The reference leaves {d.errors.floor:.2f} mm on its own episodes, more than the "
            f"{d.errors.extended.mean:.2f} mm left here: how much of these noise, chaos and known misfit make is not "
            "known, and nothing counts as unexplained.",
            note=True,
        )
    if d.errors.floor is None:
        page.text("Without a reference there is no floor: noise and chaos are part of what is unexplained.", note=True)


def _bands(d: Diagnosis) -> str:
    """95 % over episodes of what was taken away and of what is left."""
    spans = []
    for values in (d.errors.base.values - d.errors.extended.values, d.errors.extended.values):
        if len(values) < 2:
            return "One episode: no interval."
        spans.append(bootstrap_interval(values, np.random.default_rng(d.seed)))
    (a, b), (c, e) = spans
    count = len(d.errors.base.values)
    narrow = f" ({count} episodes: too narrow)" if count < FEWEST else ""
    return f"95 % over episodes: taken away {a:.2f} to {b:.2f} mm, left {c:.2f} to {e:.2f} mm{narrow}."


def add_gate(page: Page, d: Diagnosis) -> None:
    """What clock, camera, grip and table get wrong, measured without the simulation."""
    page.heading("Measured without the simulation")
    compared = f"{d.gate.reference} reference episodes" if d.gate.reference else "the twin and zero"
    page.text(f"{d.gate.episodes} episodes against {compared}; track noise {1e3 * d.gate.sigma:.2f} mm. Intervals are "
              "90 %; p is adjusted for all causes tested.", note=True)  # fmt: skip
    rows, marks = [], []
    for c in d.gate.causes:
        corrected = c.accepted and c.id in d.gate.sensor_ids
        seen = "found" if corrected else "seen; left to the candidates above"
        verdict = seen if c.accepted else "not found" if c.testable else "not testable"
        p = f"{c.p_adjusted:.2g}" if c.testable else "–"
        effect = f"{c.effect_mm:.2f}" if c.parameters else "–"
        near = f"; as well: {', '.join(map(words, c.confused_with))}" if c.confused_with else ""
        rows.append((words(c.id), verdict, _measured(c), p, effect, c.why + near))
        marks.append("strong" if corrected else "" if c.testable else "warn")
    page.table(("cause", "verdict", "estimate", "p adjusted", "at the object [mm]", "rests on"), rows, marks)


READ_AS = {"m": (1e3, "mm"), "s": (1e3, "ms"), "rad": (1e3, "mrad"), "1": (100.0, "%")}


def _measured(c: GateCause) -> str:
    """The estimate with its interval, in units to read."""
    factor, unit = READ_AS.get(c.unit, (1.0, c.unit))
    parts = []
    for name, values in c.parameters.items():
        spans = c.interval.get(name, ())
        for k, value in enumerate(values):
            label = "" if len(c.parameters) == len(values) == 1 else f"{name} " if len(values) == 1 else f"{'xyz'[k]} "
            span = f" [{_short(factor * spans[k][0])}, {_short(factor * spans[k][1])}]" if k < len(spans) else ""
            parts.append(f"{label}{_short(factor * value)}{span}")
    return f"{', '.join(parts)} {unit}" if parts else "–"


def _short(value: float) -> str:
    """Two digits after the point, no minus before zero."""
    return f"{round(value, 2) + 0.0:.2f}"


def add_open_questions(page: Page, d: Diagnosis) -> None:
    """What these data cannot tell."""
    page.heading("What cannot be told apart")
    for c in d.causes:
        if c.group:
            page.text(f"These data do not tell {words(c.id)} from {', '.join(map(words, c.group))}.")
        elif not c.measured:
            rows = [f"{how}: {', '.join(map(words, ids))}" for how, ids in confusions(d, c).items() if ids]
            if rows:
                page.text(f"Often confused with {words(c.id)}. {'; '.join(rows)}.", note=True)
    page.table(("no data of this kind tells",), [(line,) for line in d.not_identifiable])
    if d.not_testable:
        page.table(("not testable with these motions", "why"), [(words(k), v) for k, v in d.not_testable.items()])
