"""`report.html` and `metrics.json` of one evaluation."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pred_core.bag.dataset import Dataset
from pred_core.bag.gate import EpisodeQuality
from pred_core.evaluate import pictures
from pred_core.evaluate.evaluation import NotComputed, Result, entry
from pred_core.evaluate.models import NamedTwin
from pred_core.evaluate.parameters import add_parameters
from pred_core.evaluate.protocol import FIRST_PREDICTED
from pred_core.evaluate.scores import CLOUD_EVERY, METRICS, REPORT_STEP
from pred_core.evaluate.style import INK, styles
from pred_core.metrics import NOT_COMPUTED
from pred_core.report import Page, Track, animation, number

FORMAT = 1
_PREFERRED = ("pred", "extended", "spring-mass")
_IMAGE_METRICS = ("j_iou", "f_contour", "psnr", "ms_ssim", "lpips_alex")
CM = 100.0


def metrics_json(
    dataset: Dataset,
    results: Sequence[Result],
    missing: Sequence[NotComputed],
    gate: Sequence[EpisodeQuality],
    seed: int,
    command: str,
) -> dict[str, Any]:
    """What `metrics.json` holds."""
    return {
        "format": FORMAT,
        "command": command,
        "dataset": {"name": dataset.object.name, "kind": dataset.object.kind, "rate_hz": dataset.rate},
        "protocol": {
            "start": "frames 0 and 1 measured, then open loop to the last frame",
            "last_residual": "takes frame 2 as well; its score at step 1 is the base's",
            "cloud_metrics_every_steps": CLOUD_EVERY,
            "interval": "95 % percentile bootstrap over episodes",
            "seed": seed,
        },
        "definitions": {name: {"unit": m.unit, "meaning": m.meaning} for name, m in METRICS.items()},
        "not_computed": [
            *({"model": m.model, "split": m.split, "reason": m.reason} for m in missing),
            *({"metric": name, "reason": f"{NOT_COMPUTED}: no rendered images"} for name in _IMAGE_METRICS),
        ],
        "flagged_episodes": [
            {"episode": q.name, "split": q.split, "recording": q.recording, "flags": list(q.flags)}
            for q in gate
            if q.flags
        ],
        "entries": [entry(r, seed) for r in results],
    }


def main_result(results: Sequence[Result]) -> Result:
    """The model the pictures are about: the fullest stage of the twin, else the one with the least error."""
    by_name = {r.model.name: r for r in results}
    for name in _PREFERRED:
        if name in by_name and by_name[name].values("coordinate_l1"):
            return by_name[name]
    scored = [r for r in results if r.values("coordinate_l1")] or list(results)
    return min(scored, key=lambda r: float(np.mean(list(r.values("coordinate_l1").values()) or [np.inf])))


def write_report(
    path: Path, dataset: Dataset, results: Sequence[Result], numbers: dict[str, Any], twins: Sequence[NamedTwin]
) -> None:
    """The HTML file, and its figures as PNG beside it in `figures/`."""
    page = Page(f"Evaluation: {dataset.object.name}")
    page.code(numbers["command"])
    page.text(
        "Start from frames 0 and 1, then open loop to the last frame; held particles follow the measured grippers. "
        "Intervals are 95 % bootstraps over episodes."
    )
    splits = list(dict.fromkeys(r.split.name for r in results))
    for split in splits:
        chosen = [r for r in results if r.split.name == split]
        entries = [e for e in numbers["entries"] if e["split"] == split]
        page.heading(f"Split: {split}")
        _tables(page, entries)
        _not_computed(page, [m for m in numbers["not_computed"] if m.get("split") == split])
        _figures(page, chosen, path.parent / "figures", split)
    _gate(page, numbers["flagged_episodes"], results)
    for named in twins:
        add_parameters(page, named)
    page.heading("Definitions")
    page.table(
        ("metric", "unit", "meaning"), [(name, m["unit"], m["meaning"]) for name, m in numbers["definitions"].items()]
    )
    images = [m["metric"] for m in numbers["not_computed"] if "metric" in m]
    page.text(f"Image metrics ({', '.join(images)}): {NOT_COMPUTED}, this evaluation renders no images.", note=True)
    page.write(path)


def _tables(page: Page, entries: Sequence[dict[str, Any]]) -> None:
    def mean(e: dict[str, Any], metric: str, when: str) -> str:
        return number(_scaled(e["metrics"][metric][when]["mean"]))

    means = [e["metrics"]["coordinate_l1"]["all_steps"]["mean"] for e in entries]
    finite = [m for m in means if m is not None]
    rows, marks = [], []
    for e, value in zip(entries, means, strict=True):
        one = e["metrics"]["coordinate_l1"]["all_steps"]
        interval = "–" if one["low_95"] is None else f"{_scaled(one['low_95']):.2f} to {_scaled(one['high_95']):.2f}"
        rows.append(
            (
                e["model"], "–" if value is None else f"{_scaled(value):.2f}", interval, number(_scaled(one["std"])),
                number(_scaled(one["median"])), mean(e, "coordinate_l1", f"step_{REPORT_STEP}"),
                mean(e, "mde", "all_steps"), mean(e, "mde", f"step_{REPORT_STEP}"),
                mean(e, "chamfer_two_sided_unsquared", "all_steps"), mean(e, "emd", "all_steps"),
                one["episodes"], len(e["diverged"]) or "",
            )
        )
        marks.append("warn" if e["diverged"] else "strong" if finite and value == min(finite) else "")
    page.table(
        ("model", "coordinate_l1 [cm]", "95 %", "std", "median", f"at step {REPORT_STEP}", "mde [cm]",
         f"mde at step {REPORT_STEP}", "chamfer (two-sided) [cm]", "emd [cm]", "episodes", "diverged"),
        rows, marks,
    )
    notes = []
    for e in entries:
        for d in e["diverged"]:
            notes.append(f"{e['model']} diverged in {d['episode']} at step {d['step']}; it is in no mean.")
        if e["tested_on_training_data"]:
            notes.append(f"{e['model']} was fitted on {e['tested_on_training_data']} of the tested episodes.")
    hidden = max(e["hidden_particle_frames"] for e in entries)
    if hidden:
        notes.append(f"{hidden} particle-frames were not measured and are left out of every score.")
    shared = max(e["episodes_sharing_a_recording_with_training"] for e in entries)
    if shared:
        notes.append(f"{shared} tested episodes are windows of a recording that also has training episodes: "
                     "this split leaks; the one grouped by recording does not.")
    for note in notes:
        page.text(note, note=True)


def _gate(page: Page, flagged: Sequence[dict[str, Any]], results: Sequence[Result]) -> None:
    """What the data gate flags, beside the error of the main model there. Nothing is left out because of it."""
    page.heading("Data gate")
    if not flagged:
        page.text("No episode is flagged.")
        return
    main = main_result(results)
    values = main.values("coordinate_l1")
    page.text(f"Flagged, none left out of a score. Error: {main.model.name} on {main.split.name}.", note=True)
    rows = [
        (f["episode"], f["split"], f["recording"], number(_scaled(values.get(f["episode"]))), "; ".join(f["flags"]))
        for f in flagged
    ]
    page.table(("episode", "split", "recording", "error [cm]", "what was found"), rows)


def _not_computed(page: Page, missing: Sequence[dict[str, Any]]) -> None:
    for m in missing:
        page.text(f"{m['model']}: {NOT_COMPUTED}. {m['reason']}", note=True)


def _figures(page: Page, results: Sequence[Result], folder: Path, split: str) -> None:
    usable = [r for r in results if r.values("coordinate_l1")]
    if not usable:
        page.text("Every model diverged in every episode; there is nothing to draw.")
        return
    main = main_result(usable)
    ranked = sorted(main.values("coordinate_l1").items(), key=lambda item: item[1])
    median, worst = ranked[(len(ranked) - 1) // 2][0], ranked[-1][0]
    total = sum(v for _, v in ranked)
    top = max(1, len(ranked) // 5)
    share = sum(v for _, v in ranked[-top:]) / total if total > 0 else 0.0
    compared = [r for r in usable if r.model.name == "spring-mass" and r is not main]
    compared += [r for r in usable if r.model.name == "static-regression" and r is not main and not compared]
    folder.mkdir(parents=True, exist_ok=True)
    drawn = {
        "error_against_time": (
            pictures.error_against_time(usable, main.model.name),
            f"Error against time. The band holds the middle half of the episodes of {main.model.name}.",
        ),
        "error_by_episode": (
            pictures.error_by_episode(usable, main),
            f"Which episodes dominate: the worst {top} of {len(ranked)} carry {100 * share:.0f} % of the error of "
            f"{main.model.name}. Solid line: its mean; dashed: its median.",
        ),
        "error_on_object": (
            pictures.error_on_object([main, *compared]),
            "Where the error sits, per particle and direction (the plane is the vertical one through the held ends), "
            "below which frequency, and at which speed of the grippers.",
        ),
        "worst_episode": (pictures.shapes(main, worst, _having(compared, worst)), f"Worst episode, {worst}."),
        "median_episode": (pictures.shapes(main, median, _having(compared, median)), f"Median episode, {median}."),
    }
    for name, (figure, caption) in drawn.items():
        figure.savefig(folder / f"{split}_{name}.png", dpi=130)
        figure.set_layout_engine("none")  # keep the layout just found: finding it is most of the drawing time
        page.figure(figure, caption)
    for label, name in (("Worst", worst), ("Median", median)):
        page.html(_animation([main, *_having(compared, name)], name, f"{label} episode, {name}."))


def _having(results: Sequence[Result], episode: str) -> list[Result]:
    return [r for r in results if episode in r.values("coordinate_l1")]


def _animation(results: Sequence[Result], name: str, title: str) -> str:
    episode = next(e for e in results[0].episodes if e.name == name)
    look = styles([r.model.name for r in results])
    visible = episode.tracks.visible[FIRST_PREDICTED:, :, None]
    tracks = [Track("measured", np.where(visible, episode.position[FIRST_PREDICTED:], np.nan), INK)]
    for r in results:
        index = [e.name for e in r.episodes].index(name)
        tracks.append(Track(r.model.name, r.predictions[index], look[r.model.name][0]))
    return animation(tracks, episode.period, line=episode.object.kind == "line", title=title)


def _scaled(value: float | None) -> float | None:
    return None if value is None else CM * value


def write_json(path: Path, value: Any) -> None:
    """Write JSON, refusing NaN."""
    path.write_text(json.dumps(value, indent=1, allow_nan=False) + "\n", "utf-8")
