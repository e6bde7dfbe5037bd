"""The whole diagnosis: gate, commissioning, structure, rounds; `answer.py` makes of it what is said."""

from __future__ import annotations

import time
from collections.abc import Sequence

from pred_core.bag.gate import GateLimits, examine_all
from pred_core.calibration import Calibration
from pred_core.diagnose.answer import Study, answer
from pred_core.diagnose.commission import commission
from pred_core.diagnose.config import DiagnoseConfig
from pred_core.diagnose.fits import check_tracks
from pred_core.diagnose.form import check_forms, check_table
from pred_core.diagnose.gate import measure
from pred_core.diagnose.journal import Journal
from pred_core.diagnose.judge import Tell
from pred_core.diagnose.progress import Named, OutOfTime, Progress
from pred_core.diagnose.result import Diagnosis
from pred_core.diagnose.rounds import finish, one_round, something_left
from pred_core.diagnose.seen import seen_only
from pred_core.diagnose.skill import check_reference
from pred_core.diagnose.structure import applies, question
from pred_core.errors import DatasetError
from pred_core.twin import Twin
from pred_core.types import Episode

MOST_LEFT_OUT = 0.2  # of the episodes
LATEST = 0.8  # share of the time after which no further round begins; the errors and the report take the rest
OVER = 0.25  # share of the time by which a round may be expected to end too late, going by the last one


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
    left_out = [] if known else moved_markers(fitted)
    fitted = [e for e in fitted if e.name not in left_out]
    bench = commission(plain, fitted, known, config, tell, journal, session)
    check_reference(bench)
    progress = Progress(
        bench, journal, [bench.twin], begin + LATEST * config.seconds, begin + (1.0 + OVER) * config.seconds
    )
    if left_out:
        why = "left out of fitting and judging, because a marker has moved on the object (`pred info`)"
        progress.notes.append(f"{why}: {', '.join(left_out)}")
    ends = begin + config.seconds
    used = _change_structure(progress, tell, ends) if bench.reference is None and applies(bench.twin) else 0
    for number in range(used, config.causes):
        if not something_left(progress):
            break
        if number and not progress.time_for_another():
            progress.notes.append(f"stopped after {number} rounds: no time for more in --seconds {config.seconds:g}")
            about = f" (another takes about {progress.expected():.0f} s)" if progress.took >= 1.0 else ""
            tell(f"{progress.notes[-1]}{about}")
            break
        if not _timed_round(progress, tell, number, ends):
            break
        found = progress.named[-1]
        tell(f"named: {found.judged.trial.id}, closes {found.closed:.0%} of the excess")
    check_forms(progress, tell)
    finish(progress)
    check_table(progress, gate)
    progress.unknown |= not progress.named and bool(seen_only(gate, progress))
    study = Study(tuple(episodes), tuple(corrected), tuple(known), twin, gate, bench, session)
    return answer(study, progress, begin, tell)


def _timed_round(progress: Progress, tell: Tell, number: int, ends: float) -> bool:
    """`one_round`, and how long it took. `ends` [s] of `time.monotonic`: when the time is over."""
    started, needs = time.monotonic(), progress.substeps()
    about = f"about {progress.expected():.0f} s, as the one before; " if progress.took >= 1.0 else ""
    tell(f"round {number + 1}: {about}{max(ends - started, 0.0):.0f} s left of --seconds")
    try:
        more = one_round(progress, tell, number)
    except OutOfTime:
        progress.notes.append(f"round {number + 1} was given up: it takes longer than --seconds allow")
        tell(progress.notes[-1])
        more = False
    progress.took, progress.needed = time.monotonic() - started, needs
    return more


def moved_markers(episodes: Sequence[Episode]) -> list[str]:
    """Episodes in which neighbouring particles do not keep their distance: no cause explains them, and they would
    decide everything. None, if that holds for most of them: then it is the object that stretches, or all of the data.
    """
    limits = GateLimits()
    found = [q.name for q in examine_all(lambda: episodes) if q.stretch_frames > 0 or q.slip_max > limits.slip]
    return found if len(found) <= MOST_LEFT_OUT * len(episodes) else []


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


def _change_structure(progress: Progress, tell: Tell, ends: float) -> int:
    """Name bending by angle, if a chain with it is better than the springs as they are. Returns the rounds used."""
    before = progress.bench
    base = before.standing()
    found = question(before, progress.journal, tell)
    if found is None:
        return 0
    bench, judged, p = found
    progress.add(Named(judged, p, (), judged.mean / float(base.mean()), -1), bench)
    if float(bench.standing().mean()) < float(base.mean()):
        return 0
    if not _timed_round(progress, tell, 0, ends):  # judged together with damping, which was not found
        progress.withdraw(before)
        tell("bending by angle: withdrawn")
    return 1
