"""The whole diagnosis: gate, commissioning, structure, rounds; `answer.py` makes of it what is said."""

from __future__ import annotations

import time
from collections.abc import Sequence

from pred_core.calibration import Calibration
from pred_core.diagnose.answer import Study, answer
from pred_core.diagnose.commission import commission
from pred_core.diagnose.config import DiagnoseConfig
from pred_core.diagnose.fits import check_tracks
from pred_core.diagnose.gate import measure
from pred_core.diagnose.journal import Journal
from pred_core.diagnose.judge import Tell
from pred_core.diagnose.progress import Named, Progress
from pred_core.diagnose.result import Diagnosis
from pred_core.diagnose.rounds import finish, one_round
from pred_core.diagnose.skill import check_reference
from pred_core.diagnose.structure import applies, question
from pred_core.errors import DatasetError
from pred_core.twin import Twin
from pred_core.types import Episode


def diagnose(
    episodes: Sequence[Episode],
    twin: Twin,
    reference: Sequence[Episode] | None,
    config: DiagnoseConfig,
    tell: Tell,
    journal: Journal | None = None,
    begin: float | None = None,
) -> Diagnosis:
    """What these episodes say the twin gets wrong. Splits as in the data set: train is fitted, test judges, ood is
    only reported. `begin`: `time.monotonic()` when the work began.

    Raises: DatasetError if episodes are too few or too short, or the twin does not describe them.
    """
    begin = time.monotonic() if begin is None else begin
    train = [e for e in episodes if e.split == "train"]
    known = [e for e in reference or () if e.split != "ood"]
    _check(episodes, train, known, reference)
    check_tracks(episodes, reference or (), twin)
    gate = measure(train, [e for e in known if e.split == "train"] or None, twin)
    for cause in gate.accepted:
        tell(f"gate: {cause.id}: {cause.effect_mm:.1f} mm at the object, p {cause.p_adjusted:.3g}")
    corrected = [gate.calibration.correct(e) for e in episodes]
    known = [twin.calibration.correct(e) for e in known]
    plain = twin.replace(calibration=Calibration(), residual=None)
    session = min(int(e.stamps[0]) for e in corrected)
    journal = journal or Journal(None, {})
    fitted = [e for e in corrected if e.split != "ood"]
    bench = commission(plain, fitted, known, config, tell, journal, session)
    check_reference(bench)
    progress = Progress(bench, journal, [bench.twin], deadline=begin + LATEST * config.seconds)
    if bench.reference is None and applies(bench.twin):
        _change_structure(progress, tell)
    for number in range(config.causes):
        if number and progress.late():
            progress.notes.append(f"stopped after {number} rounds: --seconds {config.seconds:g} were used up")
            break
        if not one_round(progress, tell, number):
            break
        found = progress.named[-1]
        tell(f"named: {found.judged.trial.id}, closes {found.closed:.0%} of the excess")
    finish(progress)
    study = Study(tuple(episodes), tuple(corrected), tuple(known), twin, gate, bench, session)
    return answer(study, progress, begin, tell)


LATEST = 0.8  # share of the time after which no further round begins; the errors and the report take the rest


def _check(
    episodes: Sequence[Episode], train: Sequence[Episode], known: Sequence[Episode], reference: Sequence[Episode] | None
) -> None:
    if not train:
        raise DatasetError(
            "there is nothing to fit a cause to",
            got="no episode with split 'train'",
            allowed="1 or more; 10 train and test episodes for a name that holds",
            next_step="Record more episodes with different motions",
        )
    if len({e.recording for e in train}) < 2 and not any(e.split == "test" for e in episodes):
        raise DatasetError(
            "nothing is held out, so nothing can be judged",
            got="one recording and no episode with split 'test'",
            allowed="two recordings, or a test episode",
            next_step="Record another episode",
        )
    if reference is not None and not known:
        raise DatasetError("the reference has no train or test episodes", next_step="Give another --reference")
    names = [e.name for e in episodes]
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        raise DatasetError("two bags have one name", got=", ".join(twice[:3]), next_step="Rename one of them")


def _change_structure(progress: Progress, tell: Tell) -> None:
    """Name bending by angle, if a chain with it is better than the springs as they are."""
    base = progress.bench.standing()
    found = question(progress.bench, progress.journal, tell)
    if found is None:
        return
    bench, judged, p = found
    closed = judged.mean / float(base.mean())
    if closed < progress.bench.config.cold_gate:
        return
    progress.add(Named(judged, p, (), closed, -1), bench)
