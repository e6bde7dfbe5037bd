"""What the arm was told, plan after plan: a plan is sent before it begins, until then the ones before it hold."""

from __future__ import annotations

from pred_core.plan.knots import Beginning
from pred_core.plan.plan import Plan


class Course:
    """The plans that were sent. At any instant the newest one that has begun is carried out."""

    def __init__(self) -> None:
        self._plans: list[Plan] = []  # by their beginning

    @property
    def newest(self) -> Plan | None:
        """The plan that will be in force in the end; None: nothing was sent."""
        return self._plans[-1] if self._plans else None

    def add(self, plan: Plan, oldest: int) -> None:
        """A plan was sent; it replaces those that would begin later. Instants before `oldest` [ns] are forgotten."""
        self._plans = [p for p in self._plans if p.start < plan.start] + [plan]
        while len(self._plans) > 1 and self._plans[1].start <= oldest:
            del self._plans[0]

    def clear(self) -> None:
        """Forget every plan."""
        self._plans = []

    def at(self, stamp: int) -> Beginning:
        """Pose, velocity and acceleration at `stamp` [ns]; at rest before the first plan. At least one was added."""
        begun = [p for p in self._plans if p.start <= stamp]
        return (begun[-1] if begun else self._plans[0]).at(stamp)
