"""`train.json` and `train.html`: what a training run did, with its loss curves."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from pred_core.report import Page


def write_report(directory: Path, summary: dict[str, Any], command: str) -> None:
    """Write both files. `summary` is `Trainer.summary()`."""
    directory.mkdir(parents=True, exist_ok=True)
    (directory / "train.json").write_text(json.dumps({"command": command, **summary}, indent=1), encoding="utf-8")
    _page(summary, command).write(directory / "train.html")


def _page(summary: dict[str, Any], command: str) -> Page:
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
    page = Page("Residual training")
    page.code(command)
    page.text(
        "Errors are mean absolute per coordinate. Held-out recordings are train recordings that the network is not "
        "fitted on; they choose the step that is kept. A component is at the cap beyond 95 % of it."
    )
    page.table(("", "value"), list(rows.items()))
    page.figure(_curves(curves), "Error of windows and of held-out recordings, and share of components at the cap.")
    page.heading("Settings")
    page.table(("setting", "value"), list(settings.items()))
    return page


def _tail(values: list[float]) -> float:
    return float(np.mean(values[-max(1, len(values) // 10) :])) if values else 0.0


def _curves(curves: dict[str, Any]) -> Figure:
    """Windows' error and held-out error over steps, and the share at the cap."""
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
    return figure
