"""The parameter table of a twin: value, spread over restarts, sensitivity, and whether it sits on a bound."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from pred_core.evaluate.models import NamedTwin
from pred_core.report import Page, number
from pred_core.twin import Twin


def add_parameters(page: Page, named: NamedTwin) -> None:
    """Add the table of a twin to the page."""
    twin = named.twin
    page.heading(f"Parameters{f' of {named.name}' if named.name else ''}")
    if twin.meta.created_by:
        page.code(twin.meta.created_by)
    keys = [k for k in dict.fromkeys(k for r in twin.physics_report.values() for k in r) if k not in ("low", "high")]
    rows, marks = [], []
    for field in dataclasses.fields(twin.physics):
        value, report = getattr(twin.physics, field.name), twin.physics_report.get(field.name, {})
        bound = at_bound(value, field.metadata, report)
        rows.append((field.name, number(value, 4), field.metadata.get("unit", ""), field.metadata.get("doc", ""),
                     *(_text(report.get(k)) for k in keys), bound))
        marks.append("warn" if bound else "")
    page.table(("parameter", "value", "unit", "meaning", *(k.replace("_", " ") for k in keys), "on bound"), rows, marks)
    _extensions(page, twin)
    if twin.residual is not None:
        parameters = sum(t.numel() for t in twin.residual.tensors.values())
        page.text(f"Learned residual velocity: {parameters:,} weights.")
        page.table(("setting", "value"), [(k, _text(v)) for k, v in twin.residual.config.items()])
    for note in twin.meta.notes:
        page.text(note, note=True)


def at_bound(value: float, metadata: Mapping[str, Any], report: Mapping[str, Any]) -> str:
    """Which bound of its range a parameter sits on ("" for none; an exact 0 means switched off)."""
    if "at_bound" in report:
        return "" if not report["at_bound"] else _text(report["at_bound"] if report["at_bound"] is not True else "yes")
    low, high = metadata.get("low"), metadata.get("high")
    if value == 0 or low is None or high is None:
        return ""
    close = 1e-3 * abs(high - low) if not metadata.get("log") else None
    if value <= (low * 1.01 if close is None else low + close):
        return "low"
    return "high" if value >= (high / 1.01 if close is None else high - close) else ""


def _extensions(page: Page, twin: Twin) -> None:
    if not twin.extensions:
        return
    page.table(
        ("extension", "parameter", "value"),
        [(e.id, k, ", ".join(number(x, 4) for x in v)) for e in twin.extensions for k, v in e.parameters.items()],
    )


def _text(value: object) -> str:
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else ""
    if isinstance(value, (int, float)):
        return number(float(value), 3)
    if isinstance(value, (list, tuple)):
        return ", ".join(_text(v) for v in value)
    if isinstance(value, Mapping):
        return ", ".join(f"{k} {_text(v)}" for k, v in value.items())
    return str(value)
