"""What a user may set of a diagnosis."""

from __future__ import annotations

from dataclasses import dataclass

from pred_core.config import setting

STEPS = ("settle", "back_fit", "cross_fit", "chaos_weights")  # that can be left out, to measure what each is worth


@dataclass(frozen=True)
class DiagnoseConfig:
    """Defaults are frozen: they were chosen on development cases, never on those that are reported."""

    window: float = setting(1.6, unit="s", low=0.1, high=60.0, doc="length of a rollout between two starts from data")
    stride: int = setting(2, low=1, high=50, doc="frames between the residuals that are read")
    level: float = setting(0.05, low=1e-4, high=0.5, doc="family-wise error of a name, over what one round fitted")
    gate: float = setting(0.1, low=0.0, high=1.0, doc="least share of the excess error that a cause must close")
    cold_gate: float = setting(
        0.25, low=0.0, high=1.0, doc="the same where there is no reference and the twin explains 94 % of the motion"
    )
    improved: float = setting(0.75, low=0.0, high=1.0, doc="share of the episodes it acts in that must not get worse")
    enough: float = setting(
        0.6, low=0.0, high=1.0, doc="share of the excess closed below which pairs are tried; cold: the rest is unknown"
    )
    survivors: int = setting(8, low=2, high=100, doc="candidates of the screening that are fitted to the end")
    places: int = setting(32, low=4, high=1000, doc="places, or the like, where a localized cause is tried first")
    iterations: int = setting(8, low=1, high=100, doc="steps of a refinement")
    causes: int = setting(3, low=1, high=8, doc="most causes that are named together")
    seconds: float = setting(
        300.0, unit="s", low=1.0, high=86400.0, doc="time it aims at: the first round always ends, none begins after "
        "0.8 of it, nor one that would end after 1.25 of it, going by the last"
    )  # fmt: skip
    settle: bool = setting(True, doc="windows start from an estimate over several frames; off: raw from two")
    back_fit: bool = setting(
        True, doc="no change is what the reference says of a candidate, or a base refined anew; off: the twin as it is"
    )
    cross_fit: bool = setting(True, doc="judge train episodes by a step that leaves their recording out")
    chaos_weights: bool = setting(True, doc="residuals count less where perturbed starts spread")
    seed: int = setting(0, low=0, high=2**31 - 1, doc="of places, perturbed starts and sign flips")

    @property
    def left_out(self) -> tuple[str, ...]:
        """Steps that are switched off."""
        return tuple(s for s in STEPS if not getattr(self, s))
