"""`train.json` and `train.html`: what a training run did, with its loss curves."""

from __future__ import annotations

import base64
import html
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure


def write_report(directory: Path, summary: dict[str, Any], command: str) -> None:
    """Write both files. `summary` is `Trainer.summary()`."""
    directory.mkdir(parents=True, exist_ok=True)
    (directory / "train.json").write_text(json.dumps({"command": command, **summary}, indent=1), encoding="utf-8")
    (directory / "train.html").write_text(_page(summary, command), encoding="utf-8")


def _page(summary: dict[str, Any], command: str) -> str:
    curves = summary["curves"]
    rows = {"step kept": f"{summary['best_step']} of {summary['step']}"}
    if curves["held_out_mm"]:
        best = curves["held_out_step"].index(summary["best_step"])
        rows |= {
            "held-out error of the backbone alone [mm]": f"{curves['held_out_mm'][0]:.3f}",
            "held-out error with the residual [mm]": f"{curves['held_out_mm'][best]:.3f}",
            "held-out share of components at the cap": f"{curves['held_out_binding'][best]:.1%}",
            "held out": ", ".join(summary["held_out"]),
        }
    if summary["left_out"]:
        rows["left out of training"] = ", ".join(f"{r['name']} ({r['error_mm']:.1f} mm)" for r in summary["left_out"])
    rows |= {
        "training share of components at the cap, last tenth": f"{_tail(curves['binding']):.1%}",
        "network parameters": f"{summary['parameters']}",
        "windows": f"{summary['windows']} from {len(summary['fitted_on'])} recordings",
        "time [s]": f"{summary['seconds']:.0f}",
    }
    settings = {**summary["training"], **{f"network.{k}": v for k, v in summary["network"].items()}}
    return f"""<!doctype html><meta charset="utf-8"><title>Residual training</title>
<style>body{{font:15px/1.5 sans-serif;max-width:60em;margin:2em auto;padding:0 1em}}
td{{padding:.1em 1em .1em 0;vertical-align:top}}img{{max-width:100%}}</style>
<h1>Residual training</h1><p><code>{html.escape(command)}</code></p>
<p>Errors are mean absolute per coordinate. Held-out recordings are train recordings that the network is not fitted
on; they choose the step that is kept. A component is at the cap beyond 95 % of it.</p>
{_table(rows)}<img alt="loss curves" src="data:image/png;base64,{_curves(curves)}">
<h2>Settings</h2>{_table(settings)}"""


def _tail(values: list[float]) -> float:
    return float(np.mean(values[-max(1, len(values) // 10) :])) if values else 0.0


def _table(rows: dict[str, Any]) -> str:
    cells = (f"<tr><td>{html.escape(str(k))}</td><td>{html.escape(str(v))}</td></tr>" for k, v in rows.items())
    return f"<table>{''.join(cells)}</table>"


def _curves(curves: dict[str, Any]) -> str:
    """PNG, base64: windows' error and held-out error over steps, and the share at the cap."""
    figure = Figure(figsize=(9, 5.5), layout="constrained")
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    steps = 1 + np.arange(len(curves["error_mm"]))
    top.semilogy(steps, np.maximum(curves["error_mm"], 1e-9), lw=0.8, label="training windows, K steps")
    if curves["held_out_mm"]:
        top.semilogy(curves["held_out_step"], curves["held_out_mm"], "o-", label="held-out recordings, open loop")
        top.axhline(curves["held_out_mm"][0], ls=":", c="gray", label="backbone alone on them")
        bottom.plot(curves["held_out_step"], curves["held_out_binding"], "o-")
    bottom.plot(steps, curves["binding"], lw=0.8)
    top.set_ylabel("error [mm]")
    bottom.set_ylabel("share at the cap")
    bottom.set_xlabel("optimiser step")
    top.legend()
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=110)
    return base64.b64encode(stream.getvalue()).decode()
