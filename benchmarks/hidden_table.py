"""The score table of many judged cases, as numbers and as markdown."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from hidden_scores import (
    BINS,
    Judgement,
    brier,
    calibration_error,
    clopper_pearson,
    mean_interval,
    quantile_interval,
    strengths,
)

AVOIDABLE = 0.05  # of the base error: less is nothing to close a share of
Cell = dict[str, Any]
Rows = Sequence[Judgement]
Holds = Callable[[Judgement], bool]
Metric = tuple[str, str, Callable[[Rows], Cell | None]]


def scores(rows: Rows, placebos: bool = False) -> dict[str, Any]:
    """{"table": [{metric, goal, cells {column: cell}}], "confusion": {truth: {answer: count}}, "cases": [...]}.

    `placebos`: laws that nothing obeys were among the candidates; how often one was named is shown.
    """
    strength = strengths(rows)
    columns = {"all": list(rows)}
    for low, high in BINS:
        columns[_span(low, high)] = [r for r in rows if low <= strength[r.name] < high]
    table = _table(columns, (*METRICS, FAKES) if placebos else METRICS)
    cases = [
        {
            "name": r.name, "reference": r.reference, "kind": r.kind, "hidden": list(r.hidden), "outcome": r.outcome,
            "named": list(r.named), "group": list(r.group), "right": r.right, "strength": strength[r.name],
            "confidence": r.confidence, "parameter_error": r.parameter_error, "covered": r.covered, "base": r.base,
            "extended": r.extended, "oracle": r.oracle, "seconds": r.seconds,
        }
        for r in rows
    ]  # fmt: skip
    known = sum(r.paired is not None for r in rows)
    others = sum(bool(r.hidden) for r in rows) - known
    said = f"measured on the same motions for {known} cases and on the reference's controls for {others}"
    return {"table": table, "confusion": confusion(rows), "cases": cases, "strength": said}


def compare(methods: Mapping[str, Rows]) -> list[dict[str, Any]]:
    """Rows as in the table: names of several methods on the same cases, all and the strong ones."""
    columns = {}
    for method, rows in methods.items():
        strength = strengths(rows)
        columns[method] = list(rows)
        columns[f"{method}, {_span(*BINS[-1])}"] = [r for r in rows if strength[r.name] >= BINS[-1][0]]
    return _table(columns, METRICS[:COMPARED])


def ablated(whole: Rows, without: Mapping[str, Rows]) -> list[dict[str, Any]]:
    """Rows as in the table: the diagnosis as it is beside itself without each step, on the cases that all answered."""
    common = set.intersection(*({r.name for r in rows} for rows in (whole, *without.values())))
    columns = {"as it is": whole, **{f"without {step}": rows for step, rows in without.items()}}
    return _table({c: [r for r in rows if r.name in common] for c, rows in columns.items()}, METRICS[:ABLATED])


def _table(columns: Mapping[str, Rows], metrics: Sequence[Metric]) -> list[dict[str, Any]]:
    return [
        {"metric": metric, "goal": goal, "cells": {c: cell(chosen) for c, chosen in columns.items()}}
        for metric, goal, cell in metrics
    ]


def _span(low: float, high: float) -> str:
    if low <= 0.0:
        return f"< {high:g}"
    return f">= {low:g}" if high == float("inf") else f"{low:g} to {high:g}"


def share(kind: Sequence[str], holds: Holds, of: Holds | None = None) -> Any:
    """A cell: in how many of the cases of these kinds (for which `of` holds) something holds."""

    def cell(rows: Rows) -> Cell | None:
        asked = [r for r in rows if r.kind in kind and (of is None or of(r))]
        if not asked:
            return None
        count = sum(holds(r) for r in asked)
        low, high = clopper_pearson(count, len(asked))
        return {"count": count, "of": len(asked), "value": count / len(asked), "low": low, "high": high}

    return cell


def number(pick: Callable[[Judgement], float | None], quantile: float | None, unit: str) -> Any:
    """A cell: a quantile, or the mean, of a number over the cases that have it."""

    def cell(rows: Rows) -> Cell | None:
        values = [v for v in (pick(r) for r in rows) if v is not None]
        if not values:
            return None
        value, low, high = mean_interval(values) if quantile is None else quantile_interval(values, quantile)
        return {"value": value, "low": low, "high": high, "of": len(values), "unit": unit}

    return cell


def plain(count: Callable[[Rows], float]) -> Any:
    """A cell: a number of all cases together."""
    return lambda rows: {"value": count(rows), "of": len(rows), "unit": ""} if rows else None


def closed(base: float | None, extended: float | None, least: float | None) -> float | None:
    """Share of the avoidable error that is closed; None where nothing, or less than 5 % of it, is avoidable."""
    if base is None or extended is None or least is None or base - least < AVOIDABLE * base:
        return None
    return (base - extended) / (base - least)


def _named(r: Judgement) -> bool:
    return bool(r.named)


def _family_of_unlisted(r: Judgement) -> bool:
    return _named(r) and bool(set(r.families) & set(r.truth_families))


def _closed(r: Judgement) -> float | None:
    return closed(r.base, r.extended, r.oracle) if r.hidden else None


def _closed_ood(r: Judgement) -> float | None:
    return closed(r.base_ood, r.extended_ood, r.oracle_ood) if r.hidden else None


def _closed_to_paired(r: Judgement) -> float | None:
    return closed(r.base, r.extended, r.paired)


def _size(r: Judgement) -> float | None:
    return float(len(r.group)) if r.named and r.hidden else None


def _no_false(r: Judgement) -> bool:
    return set(r.named) <= set(r.truths)


KNOWN = ("single",)
METRICS: tuple[Metric, ...] = (
    ("controls: anything but none", "<= 3 %", share(("control",), lambda r: r.outcome != "none")),
    ("controls: something named", "", share(("control",), _named)),
    ("one effect: detected (anything but none)", ">= 95 %", share(KNOWN, lambda r: r.outcome != "none")),
    ("one effect: right name first", ">= 80 %", share(KNOWN, lambda r: r.right)),
    ("one effect: right name and nothing else", "", share(KNOWN, lambda r: r.named == r.truths)),
    ("one effect: right family first", ">= 92 %",
     share(KNOWN, lambda r: bool(r.families) and r.families[0] in r.truth_families)),
    ("one effect: truth in the group, where named", ">= 88 %",
     share(KNOWN, lambda r: r.truths[0] in r.group, _named)),
    ("size of the group, mean", "<= 2", number(_size, None, "")),
    ("outside the library: unknown", ">= 75 %", share(("unlisted",), lambda r: r.outcome == "unknown")),
    ("outside the library: named, family wrong", "<= 10 %",
     share(("unlisted",), lambda r: _named(r) and not _family_of_unlisted(r))),
    ("outside the library: named, family right, law wrong", "", share(("unlisted",), _family_of_unlisted)),
    ("outside the library: none", "", share(("unlisted",), lambda r: r.outcome == "none")),
    ("two effects: exactly both", ">= 50 %", share(("pair",), lambda r: sorted(r.named) == sorted(r.truths))),
    ("two effects: one or both right, none false", ">= 85 %", share(("pair",), lambda r: _named(r) and _no_false(r))),
    # The metrics above are of names alone: other ways to a name are compared by them.
    ("parameter error, median", "<= 10 %", number(lambda r: r.parameter_error, 0.5, "%")),
    ("truth in the 90 % interval", "85 to 95 %",
     share(KNOWN, lambda r: bool(r.covered), lambda r: r.covered is not None)),
    ("avoidable error closed, median", ">= 85 %", number(_closed, 0.5, "%")),
    ("avoidable error closed, 10th percentile", ">= 50 %", number(_closed, 0.1, "%")),
    ("avoidable error closed out of distribution, median", ">= 75 %", number(_closed_ood, 0.5, "%")),
    ("error that the effect adds closed, median", "", number(_closed_to_paired, 0.5, "%")),
    ("calibration error (10 bins)", "<= 0.07",
     plain(lambda rows: calibration_error([r.confidence for r in rows], [r.right for r in rows]))),
    ("Brier score of what was answered", "",
     plain(lambda rows: brier([r.confidence for r in rows], [r.right for r in rows]))),
    ("probability of the truth, mean", ">= 0.75", number(lambda r: r.on_truth, None, "")),
    ("time, median", "<= 300 s", number(lambda r: r.seconds, 0.5, "s")),
    ("time, 90th percentile", "", number(lambda r: r.seconds, 0.9, "s")),
)  # fmt: skip
ABLATED = 1 + next(n for n, (metric, _, _) in enumerate(METRICS) if metric.startswith("one effect: right family"))
COMPARED = next(n for n, (metric, _, _) in enumerate(METRICS) if metric.startswith("parameter error"))
EVERY = ("control", "single", "unlisted", "pair")
FAKES: Metric = ("a law that nothing obeys is named", "0", share(EVERY, lambda r: "placebo" in r.families))


def confusion(rows: Rows) -> dict[str, dict[str, int]]:
    """Truth (family; what has none in the library, by its own name) -> first family answered, none or unknown."""
    result: dict[str, dict[str, int]] = {}
    for r in rows:
        if r.kind == "control":
            truth = "none"
        elif r.kind == "unlisted":
            truth = f"({r.hidden[0]})"
        else:
            truth = " + ".join(sorted(r.truth_families))
        answer = r.families[0] if r.families else r.outcome
        line = result.setdefault(truth, {})
        line[answer] = line.get(answer, 0) + 1
    return dict(sorted(result.items()))


def markdown(result: Mapping[str, Any]) -> str:
    """Tables and confusion matrix."""
    lines = [
        f"Columns: error of the base over that with nothing hidden, {result['strength']}. 95 % intervals:"
        " Clopper-Pearson for shares, bootstrap over cases for the others.",
        "",
        *_rows(result["table"]),
    ]
    if "baselines" in result:
        lines += ["", "The same cases, answered by simpler ways.", "", *_rows(result["baselines"])]
    if "ablations" in result:
        lines += ["", "Each step left out, on the cases that all of these answered.", "", *_rows(result["ablations"])]
    matrix = result["confusion"]
    answers = sorted({a for line in matrix.values() for a in line})
    lines += ["", "Families: hidden (rows), answered first (columns).", ""]
    lines += [_line(["", *answers]), _line(["---"] * (1 + len(answers)))]
    lines += [_line([truth, *(str(line.get(a, "")) for a in answers)]) for truth, line in matrix.items()]
    return "\n".join(lines)


def _rows(table: Sequence[Mapping[str, Any]]) -> list[str]:
    columns = list(table[0]["cells"])
    lines = [_line(["", "goal", *columns]), _line(["---"] * (2 + len(columns)))]
    for row in table:
        lines.append(_line([row["metric"], row["goal"], *(_text(row["cells"][c]) for c in columns)]))
    return lines


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _text(cell: Cell | None) -> str:
    if cell is None:
        return ""
    if "count" in cell:
        span = f"{100 * cell['low']:.1f} to {100 * cell['high']:.1f}"
        return f"{cell['count']}/{cell['of']} = {100 * cell['value']:.0f} % [{span}]"
    if "low" not in cell:
        return f"{cell['value']:.3f}"
    unit = cell["unit"]
    scale, form, after = {"%": (100.0, ".1f", " %"), "s": (1.0, ".0f", " s"), "": (1.0, ".2f", "")}[unit]
    shown = [format(scale * cell[k], form) for k in ("value", "low", "high")]
    return f"{shown[0]}{after} [{shown[1]} to {shown[2]}] of {cell['of']}"
