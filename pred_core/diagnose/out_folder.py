"""The folder a diagnosis writes to: nothing that it reads, and nothing of an earlier job in it, goes unseen."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from pred_core.errors import ConfigError

JOURNAL = "journal.jsonl"
TWIN = "twin"
GUARD = ("guard.json", "guard.html")
ANSWER = ("diagnosis.json", "report.html", "next_motion.yaml")
RESULTS = (*ANSWER, *GUARD, TWIN)
OURS = {"outcome", "sentence", "causes"}  # what every diagnosis.json has


def check_out(out: Path, twin: Path, data: Mapping[str, Path]) -> None:
    """`data`: what a data set is called in a message -> its folder. Links are followed.

    Raises: ConfigError if `out` is no folder or that of an input, if an input lies where the answer's twin is written,
    or if a twin, a report or another result lies there that no diagnosis wrote.
    """
    _check_folder(out)
    _check_not_the_folder(out, {"the twin": twin, **data})
    place, result, given = out.resolve(), (out / TWIN).resolve(), twin.resolve()
    if given.is_relative_to(place) or given.is_relative_to(result):
        raise ConfigError(
            "--out holds the twin that is questioned, and the twin of the answer is written there",
            got=f"--twin {twin} and --out {out}, which writes {out / TWIN}",
            allowed="a folder that the questioned twin is not in",
            next_step="Give another --out",
        )
    for name, root in data.items():
        if root.resolve().is_relative_to(result):
            raise ConfigError(
                f"--out: the twin of the answer would be written into {name}",
                got=f"{root} and --out {out}, which writes {out / TWIN}",
                next_step="Give another --out",
            )
    if _ours(out):
        return
    foreign = [name for name in ANSWER if (out / name).exists()]
    if foreign:
        raise ConfigError(
            f"--out holds {', '.join(foreign)} that no diagnosis wrote there, and the answer's would replace it",
            got=f"{out} without a diagnosis.json of ours or {JOURNAL}",
            allowed="a new folder, or one with an earlier diagnosis",
            next_step="Give another --out, or move it away",
        )
    if (out / TWIN).exists():
        raise ConfigError(
            "--out holds a twin that no diagnosis wrote there, and the twin of the answer would replace it",
            got=f"{out / TWIN} without diagnosis.json or {JOURNAL} beside it",
            next_step="Give another --out, or move that twin away",
        )


def check_guard_out(out: Path, data: Path) -> None:
    """The question about the network writes two files, which a twin's folder may hold: `pred train` writes them there.

    Raises: ConfigError if `out` is no folder, or the data set's.
    """
    _check_folder(out)
    _check_not_the_folder(out, {"the data set": data})


def results_in(out: Path) -> list[str]:
    """What an earlier diagnosis has left in the folder beside its journal."""
    return [name for name in RESULTS if (out / name).exists()]


def said_of_earlier(out: Path, aside: Path | None, differs: str) -> str:
    """One line about an earlier diagnosis in the folder: where its pieces went (None: there were none), and why."""
    old = ", ".join(results_in(out))
    going = "will be replaced or removed when this one is finished"
    if aside is None:
        return f"{out} holds {old} of an earlier answer without its {JOURNAL}: {going}"
    line = f"{out} holds the pieces of another diagnosis ({differs}): put aside in {aside}"
    return f"{line}; its {old} {going}" if old else line


def remove_guard(out: Path) -> None:
    """Remove what was said of an earlier twin's network."""
    for name in GUARD:
        (out / name).unlink(missing_ok=True)


def _ours(out: Path) -> bool:
    """Whether a diagnosis wrote into the folder: its answer, or its journal or one that it put aside."""
    try:
        found = json.loads((out / "diagnosis.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        found = None
    return (isinstance(found, dict) and set(found) >= OURS) or any(map(_is_journal, out.glob("journal*.jsonl")))


def _is_journal(path: Path) -> bool:
    try:
        with path.open(encoding="utf-8") as stream:
            first = json.loads(stream.readline())
    except (OSError, ValueError):
        return False
    return isinstance(first, dict) and isinstance(first.get("header"), dict)


def _check_folder(out: Path) -> None:
    for place in (out, *out.parents):
        if place.exists() and not place.is_dir():
            raise ConfigError(
                "--out must be a folder", got=f"{place}, which is a file", allowed="a folder, new or not",
                next_step="Give another --out",
            )  # fmt: skip


def _check_not_the_folder(out: Path, inputs: Mapping[str, Path]) -> None:
    for name, folder in inputs.items():
        if folder.resolve() == out.resolve():
            raise ConfigError(
                f"--out is the folder of {name}, which is only read",
                got=out,
                allowed="a folder of its own",
                next_step="Give another --out",
            )
