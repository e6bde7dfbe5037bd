"""What the diagnosis says of evidence is exact: family-wise errors, lack of fit, rivals, the simpler law."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from report_cases import judged, rope

from pred_core.diagnose import evidence
from pred_core.diagnose.evidence import Judged, elsewhere, family_wise, lack_of_fit, rivals, set_limit, simplest
from pred_core.diagnose.naming import share_closed
from pred_core.diagnose.progress import Named, refitted
from pred_core.diagnose.ranking import nothing
from pred_core.diagnose.trial import make_trial
from pred_core.effects import find_effect
from pred_core.twin import Twin
from pred_core.types import Array


@pytest.fixture(scope="module")
def twin() -> Twin:
    return rope()


def gains(twin: Twin, rows: Array) -> list[Judged]:
    return [judged(twin, "drag_linear", 1.0, 0.1, row.tolist()) for row in rows]


def test_family_wise_errors_are_what_they_say(twin: Twin, monkeypatch: pytest.MonkeyPatch) -> None:
    """Four correlated candidates on ten episodes, nothing in them, 400 times: the smallest adjusted p is below 0.05
    in 20 of them. 99.9 % of Binomial(400, 0.05) lies in 7..36; of Binomial(400, 0.5) in 167..233.
    """
    monkeypatch.setattr(evidence, "FLIPS", 999)
    rng = np.random.default_rng(1)
    smallest = []
    for seed in range(400):
        shared = rng.standard_t(3, size=10)
        smallest.append(family_wise(gains(twin, shared + rng.standard_t(3, size=(4, 10))), seed).min())
    p = np.array(smallest)
    assert 7 <= (p <= 0.05).sum() <= 36
    assert 167 <= (p <= 0.5).sum() <= 233


def test_a_shift_is_found_among_candidates_without_one(twin: Twin) -> None:
    """Gains of 2 +- 1 on 12 episodes: t = 7. Sign flips reach that once in 4096; with 5 candidates below 0.005."""
    rng = np.random.default_rng(0)
    rows = rng.normal(0.0, 1.0, (5, 12))
    rows[3] += 2.0
    p = family_wise(gains(twin, rows), 0)
    assert p[3] < 0.005 and (np.delete(p, 3) > 0.05).all()


def test_gains_in_few_episodes_are_not_held_against_even_ones(twin: Twin) -> None:
    """A patch: eight of sixteen episodes gain, one of them most. One in 256 flips does as well, and five candidates
    make that 0.02 at most; the four beside it, with even gains of either sign, would reach twice its t by chance.
    """
    patch = np.array([0.64, 0.05, 0.81, 0.07, 0.99, 1.64, 0.02, 0.17] + [0.0] * 8)
    even = np.where(np.random.default_rng(2).random((4, 16)) < 0.5, 0.1, -0.1)
    p = family_wise(gains(twin, np.vstack((patch, even))), 0)
    assert p[0] < 0.025
    t = patch.mean() / patch.std(ddof=1) * 4.0
    assert t < 2.4 and (even.mean(axis=1) / even.std(axis=1, ddof=1) * 4.0).max() > 0.0


def test_few_recordings_are_flipped_by_episodes(twin: Twin) -> None:
    """Sixteen episodes of six recordings, in two of which nothing acts: signs of recordings cannot fall below
    2^-4 = 0.06, whatever the gain; those of episodes can. With twelve recordings they are flipped together.
    """
    six, twelve = np.repeat(np.arange(6), [3, 3, 3, 3, 2, 2]), np.repeat(np.arange(12), 2)
    rows = np.where(six < 4, 1.0, 0.0)[None] * np.linspace(0.9, 1.1, 16)
    assert family_wise(gains(twin, rows), 0, six)[0] < 0.001
    alike = np.where(twelve == 0, 5.0, np.where(twelve % 2, 0.2, -0.2))[None]  # one recording alone gains
    assert family_wise(gains(twin, alike), 0, twelve)[0] > 0.2
    assert family_wise(gains(twin, alike), 0)[0] < 0.15


def test_names_go_to_what_leaves_least(twin: Twin) -> None:
    """Each candidate is compared with its own null, so the larger gain can stand for the larger rest."""
    flattered, right = gains(twin, np.array([[2.0, 2.1, 1.9, 2.0], [1.5, 1.6, 1.4, 1.5]]))
    flattered = dataclasses.replace(flattered, extended=np.array([1.0, 1.1, 0.9, 1.0]))
    right = dataclasses.replace(right, extended=np.array([0.8, 0.7, 0.8, 0.9]))
    assert rivals([flattered, right], right)[0][0] is right
    plain, flexible = nested(twin, 0.98)  # the gain of the plain one is near, what it leaves is not
    plain = dataclasses.replace(plain, extended=plain.extended + 1.0)
    assert simplest([plain, flexible], flexible) is flexible


def test_an_interval_gets_no_shorter_beside_a_later_cause(twin: Twin) -> None:
    """Drag 1.5 [1.2, 1.8], then 1.6 [1.59, 1.61] fitted beside a later cause: 1.6 [1.3, 1.9]. A wide one stays wide."""
    first, knob = judged(twin, "drag_linear", 1.5, 0.6, [1.0] * 10), "drag_linear.coefficient[0]"
    named = Named(first, 0.01, (), 1.0, 0)
    for width, expected in ((0.02, (1.3, 1.9)), (1.0, (1.1, 2.1))):
        later = judged(twin, "drag_linear", 1.6, width, [1.0] * 10)
        found = refitted(named, later).judged
        assert found.values[knob] == 1.6 and found.intervals[knob] == pytest.approx(expected)


def test_a_local_cause_is_told_from_off_and_not_from_another_place(twin: Twin) -> None:
    """A pull of strength 1 [0.6, 1.4] here; in the reference the same law found 0.8 elsewhere. For drag, which acts
    everywhere, 0.8 would be no change.
    """
    _, local = nested(twin, 0.5)
    switch = local.trial.space.knobs[local.trial.amplitudes[0]].name
    inside = {**local.intervals, switch: (0.6, 1.4)}
    local = dataclasses.replace(local, null={**local.null, switch: 0.8}, intervals=inside)
    assert local.excludes_null
    assert not dataclasses.replace(local, intervals={**local.intervals, switch: (-0.1, 1.4)}).excludes_null
    drag = judged(twin, "drag_linear", 1.0, 0.8, [1.0] * 10)
    assert drag.excludes_null
    assert not dataclasses.replace(drag, null=dict.fromkeys(drag.null, 0.8)).excludes_null


def test_episodes_that_fit_worse_are_told() -> None:
    """Losses have a scale of their own, so their logs are compared. On 8 against 8 episodes a factor of 3 over a
    scatter of 30 % is 5 standard errors; nothing is told of 2 episodes.
    """
    rng = np.random.default_rng(0)
    one, other = 3.0 * np.exp(rng.normal(0, 0.3, 8)), np.exp(rng.normal(0, 0.3, 8))
    ground = np.zeros(8, dtype=bool)
    assert lack_of_fit(one, other, 0, ground, ground) < 0.001
    assert lack_of_fit(other, one, 0, ground, ground) > 0.9  # one-sided
    assert lack_of_fit(1e3 * one, 1e3 * other, 0, ground, ground) == lack_of_fit(one, other, 0, ground, ground)
    assert lack_of_fit(one[:2], other, 0, ground[:2], ground) == 1.0


def test_a_lack_of_fit_on_the_ground_alone_is_told() -> None:
    """Half of the episodes lie; only these fit worse. Pooled, a factor of 2 in half of them would drown in 30 times
    larger losses on the ground; apart it is 5 standard errors, doubled for two tests.
    """
    rng = np.random.default_rng(2)
    ground = np.arange(16) % 2 == 0
    scale = np.where(ground, 30.0, 1.0)
    one = scale * np.where(ground, 3.0, 1.0) * np.exp(rng.normal(0, 0.3, 16))
    other = scale * np.exp(rng.normal(0, 0.3, 16))
    assert lack_of_fit(one, other, 0, ground, ground) < 0.005


def test_lack_of_fit_errs_as_often_as_it_says() -> None:
    """120 draws of 6 against 6 in the air and 6 against 6 on the ground: two tests at 2.5 % err in 1 - 0.975^2 = 4.9 %
    of them, 6. 99.9 % of Binomial(120, 0.049) lies below 15; none at all has a probability of 0.2 %.
    """
    rng = np.random.default_rng(3)
    ground = np.arange(12) % 2 == 0
    losses = np.exp(rng.normal(0, 1, (120, 2, 12)))
    p = np.array([lack_of_fit(one, other, n, ground, ground) for n, (one, other) in enumerate(losses)])
    assert 1 <= (p <= 0.05).sum() <= 14


def nested(twin: Twin, share: float) -> tuple[Judged, Judged]:
    """Drag with one number, saving `share` of what attraction with more numbers saves, on 10 episodes."""
    rich = np.linspace(1.0, 2.0, 10)
    many = make_trial(twin, (find_effect("attraction"),))
    plain = judged(twin, "drag_linear", 1.0, 0.1, (share * rich).tolist())
    names = [k.name for k in many.space.knobs]
    flexible = dataclasses.replace(
        plain,
        trial=many,
        gain=rich,
        extended=10.0 - rich,
        values=dict.fromkeys(names, 1.0),
        null=dict.fromkeys(names, 0.0),
        intervals=dict.fromkeys(names, (0.9, 1.1)),
        z=np.zeros(len(names)),
    )
    return plain, flexible


def test_the_simpler_law_is_preferred_when_it_explains_as_much(twin: Twin) -> None:
    plain, flexible = nested(twin, 0.98)
    assert plain.parameters == 1 < flexible.parameters
    assert simplest([flexible, plain], flexible) is plain
    plain, flexible = nested(twin, 0.8)  # always 20 % less: many standard errors, and beyond a tenth
    assert simplest([flexible, plain], flexible) is flexible
    assert simplest([flexible, plain], plain) is plain  # more numbers are never preferred


def test_rivals_are_counted_in_standard_errors(twin: Twin) -> None:
    """Differences 1, 2, 3, 4 have mean 2.5 and standard error 1.291 / 2: 3.873; limit t(3) at 90 %: 1.638."""
    best, other = gains(twin, np.array([[5.0, 5.0, 5.0, 5.0], [4.0, 3.0, 2.0, 1.0]]))
    rows = rivals([other, best], best)
    assert rows[0][0] is best and rows[0][1] == 0.0
    assert rows[1][1] == pytest.approx(2.5 / (1.2909944 / 2.0))
    assert set_limit(4) == pytest.approx(1.6377, abs=1e-4)


# Samples, restarts, weights -------------------------------------------------------------------------------------------


def test_nothing_is_the_less_likely_the_nearer_a_candidate_came_to_a_name() -> None:
    """a = ln 0.88 / ln 0.05 = 0.0427; at p = 0.05 the density of effects is 0.0427 x 0.05^-0.9573 = 0.751."""
    assert nothing(1.0) == pytest.approx(1.0 / 1.0427, abs=1e-4)
    assert nothing(0.05) == pytest.approx(1.0 / 1.751, abs=2e-3)
    values = [nothing(p) for p in (1e-9, 0.01, 0.05, 0.1, 0.3, 1.0)]
    assert values == sorted(values) and 0.0 < values[0] < 0.01


def test_causes_that_save_in_other_episodes_are_not_two_names_for_one(twin: Twin) -> None:
    """Drag saves 4, 4, 0.2, 0: shares 0.49, 0.49, 0.02, 0. A table saves 0, 0, 3, 3: they share 0.02. Wind shares 0.98.
    By the spread of the differences, 4 and -3, the table could not be told apart from the drag.
    """
    drag, table, wind = gains(twin, np.array([[4.0, 4.0, 0.2, 0.0], [0.0, 0.0, 3.0, 3.0], [3.9, 3.9, 0.2, -1.0]]))
    assert rivals([table], drag)[0][1] < set_limit(4)
    assert elsewhere(table, drag) and elsewhere(drag, table) and not elsewhere(wind, drag)


def test_a_cause_explains_all_where_motions_are_easier_than_the_references(twin: Twin) -> None:
    """10 are left without the cause, 6 with it. Beside a reference at 4 that is 4 of 6; beside one at 12, all."""
    found = judged(twin, "drag_linear", 1.0, 0.1, [4.0] * 8)
    assert share_closed(found, excess=6.0, floor=4.0) == pytest.approx(4.0 / 6.0)
    assert share_closed(found, excess=-2.0, floor=12.0) == 1.0
