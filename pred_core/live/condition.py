"""How far a followed state can be trusted, in words for the diagnostics."""

from __future__ import annotations

from dataclasses import dataclass

from pred_core.estimate.health import Level, Tally
from pred_core.estimate.history import NS
from pred_core.estimate.measurement import Outcome

ANEW_SHOWN = 5.0  # [s] how long a new start stays the headline


@dataclass(frozen=True)
class Condition:
    """At one state."""

    stamp: int  # [ns] of the state
    level: Level
    blind: float  # [s] since the capture of the last tracks that corrected it
    stop_after: float  # [s] of that, after which no state is given
    newest: Outcome | None  # what became of the newest tracks
    lost: Outcome | None  # of the tracks that made it start anew, the last time
    noise: float  # errors of the tracks, times what their confidence says
    tally: Tally
    missing: int = 0  # particles that a closed gripper should hold, and that the tracks have elsewhere

    def trouble(self) -> str:
        """What is wrong, in a line; empty if nothing is."""
        told = f"no tracks for {self.blind:.1f} s"
        n = self.newest
        if n is not None and not n.late and (self.stamp - n.stamp) / NS < 0.5 * self.blind:
            told = f"no usable tracks for {self.blind:.1f} s ({len(n.used)} of free particles, all far from the state)"
        elif n is not None and n.late:
            told = f"tracks come too late, no others for {self.blind:.1f} s"
        if self.level == "blind":
            return f"{told}, model alone; after {self.stop_after:g} s no state is given"
        if self.level == "stopped":
            return f"{told}: no state is given until they are back"
        if self.lost is not None and self.stamp - self.lost.stamp < ANEW_SHOWN * NS:
            contrary = int((~self.lost.used).sum())
            gone = f", {self.missing} particles are not in the gripper any more" if self.missing else ""
            return (
                f"was lost at {self.lost.stamp / NS:.3f} s, {contrary} of {len(self.lost.used)} tracks were far from"
                f" it; started anew from the tracks ({self.tally.lost} times so far){gone}"
            )
        if self.missing:
            return f"the tracks have {self.missing} particles elsewhere that the gripper should hold: they are free"
        return ""

    def shown(self) -> dict[str, str]:
        """Values for the diagnostics."""
        n, t = self.newest, self.tally
        values = {
            "tracks rejected": f"{t.rejected} of {t.used + t.rejected}",
            "frames too late": str(t.late),
            "started anew when lost": str(t.lost),
            "held particles that were elsewhere": str(t.let_go),
            "track noise, times expected": f"{self.noise:.2f}",
        }
        if n is not None:
            values["tracks rejected in the newest frame"] = f"{int((~n.used).sum())} of {len(n.used)}"
            values["tracks off the model, median [mm]"] = f"{1e3 * n.innovation:.1f}"
            values["tracks older than the state [ms]"] = f"{(self.stamp - n.stamp) * 1e-6:.0f}"
        return values
