"""The work folder of the benchmark of hidden effects: what a run leaves in it, and whether it is there."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hidden_cases import Case

from pred_core.bag.dataset import FILE
from pred_core.errors import ConfigError
from pred_core.plant.case import truth_path

ANSWER = "diagnosis.json"
CODE = "code.txt"  # hash of the code that answered
TWIN = "twin.yaml"
CHECK = "Check --work, --out, --set and --only, or `run` the cases first"


def twin_of(work: Path, reference: str) -> Path:
    """Folder of the twin that was identified on a reference."""
    return work / "twins" / reference


def diagnosed(work: Path, out: str, cases: Sequence[Case]) -> list[Case]:
    """The cases that a run has answered. Raises: ConfigError if none is, so that nothing is begun in a wrong folder."""
    found = [c for c in cases if (work / out / c.name / ANSWER).exists()]
    if not found:
        where = next((p for p in (work, work / out) if not p.is_dir()), None)
        missing = f"no folder {where}" if where else f"{work / out} without an answer of these cases"
        raise ConfigError("--work", got=missing, allowed="the folder of a finished `run` of them", next_step=CHECK)
    return found


def check_data(work: Path, cases: Sequence[Case]) -> None:
    """Raise ConfigError if data or twins that the cases were diagnosed with are gone: they are not made anew."""
    wanted = {work / name / FILE for c in cases for name in (c.name, c.reference)}
    wanted |= {twin_of(work, c.reference) / TWIN for c in cases}
    missing = sorted(str(p) for p in wanted if not p.exists())
    if missing:
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        raise ConfigError(
            "--work", got=f"no {missing[0]}{more}", allowed="answers, data and twins of one `run`", next_step=CHECK
        )


def check_truth(work: Path, case: Case) -> None:
    """Raise ConfigError if the truth beside a data set is not what was drawn."""
    beside = truth_path(work / case.name)
    truth = read_json(beside)
    if truth is None:
        raise ConfigError(f"{case.name} cannot be scored", got=f"no {beside}", next_step=CHECK)
    hidden = tuple((h["effect"], float(h["magnitude"])) for h in truth["hidden"])
    if (hidden, truth["seed"], truth.get("extent", 1.0)) != (case.hidden, case.seed, case.extent):
        raise ConfigError(f"{beside} is of another case than {case.name}", next_step="Use another work folder")


def code_of(work: Path, out: str, case: Case) -> str:
    """Hash of the code that answered a case, '' if it was not kept."""
    path = work / out / case.name / CODE
    return path.read_text(encoding="utf-8") if path.exists() else ""


def read_json(path: Path) -> Any:
    """The mapping that a file holds; None: it is not there. Raises: ConfigError if it holds something else."""
    if not path.exists():
        return None
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except json.JSONDecodeError as error:
        raise ConfigError(f"{path} is not whole", got=str(error), next_step="Remove it and run again") from error
    if not isinstance(found, dict):
        raise ConfigError(f"{path} holds no mapping", got=type(found).__name__, next_step="Remove it and run again")
    return found
