"""The state of the object: predicted by a Dynamics, corrected by tracks at the time they were captured."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from pred_core.dynamics import Dynamics, corrected
from pred_core.errors import InputError
from pred_core.estimate.config import EstimatorConfig
from pred_core.estimate.filter import Correction, ErrorFilter, Evidence
from pred_core.estimate.gate import NoiseScale, believable
from pred_core.estimate.grasped import Grasp, grasp_of
from pred_core.estimate.health import Health, Tally
from pred_core.estimate.history import NS, SAME, History, Node
from pred_core.estimate.lengths import Lengths
from pred_core.estimate.measurement import Measurement, Outcome
from pred_core.estimate.modes import Modes, error_modes
from pred_core.estimate.starter import Start, Starter
from pred_core.types import Body, Grip, State


class Estimator:
    """`start`, then `step` once a period with the measured gripper; `correct` whenever tracks arrive, in order.

    Without tracks it is the Dynamics, bit for bit. Where most tracks contradict the state for too long, it is made anew
    out of tracks alone, and `tally.lost` counts it. Not thread-safe.
    """

    def __init__(self, dynamics: Dynamics, body: Body, config: EstimatorConfig | None = None):
        self.config = config or EstimatorConfig()
        self.starter = Starter(body, self.config)
        self.tally = Tally()
        self._dynamics, self._body = dynamics, body
        self.scale = NoiseScale(self.starter.modes, self.config)
        self._history = History(self.config.history)
        self._grasp: Grasp | None = None
        self.missing = 0  # particles that a closed gripper should hold and that are free: the tracks had them elsewhere
        self._errors: ErrorFilter | None = None
        self._lengths: Lengths | None = None
        self._modes: dict[bytes, Modes] = {}
        self._held: NDArray[np.bool_] = np.zeros(0, bool)
        self._corrected = 0  # [ns] time of the covariance
        self.health = Health(self.config, 0)

    @property
    def stamp(self) -> int:
        """[ns] of the state."""
        return self._history.newest.stamp

    @property
    def state(self) -> State:
        """The newest state, with the memory of its Dynamics."""
        return self._history.newest.state

    def start(self, stamp: int, state: State, grip: Grip, grasp: Grasp | None = None) -> None:
        """Begin at `stamp` [ns] with a state (N, 3) without memory; `grip` is the gripper then.

        grasp: what is to be held when it must begin anew; None: what the state holds.
        """
        self._grasp = grasp or grasp_of(self._body, state, grip, {})
        self._begin(stamp, state, grip)

    def _begin(self, stamp: int, state: State, grip: Grip) -> None:
        self._history = History(self.config.history)
        self._history.add(Node(stamp, self._dynamics.start(state, grip), grip))
        self._errors = None
        self.missing = 0 if self._grasp is None else self._grasp.missing(state)
        self._hold(state)
        self._corrected = stamp
        self.health = Health(self.config, stamp)

    def step(self, stamp: int, grip: Grip) -> State:
        """The state one period later, at `stamp` [ns]; `grip` is the gripper then. Raises: DivergenceError."""
        assert self._grasp is not None
        self._grasp = self._grasp.kept(grip)
        after = self._dynamics.step(self.state, grip)
        self._history.add(Node(stamp, after, grip))
        self.missing = self._grasp.missing(after)
        return after

    def correct(self, seen: Measurement) -> Outcome:
        """Correct the state of the measurement's time, and simulate on to the newest with the same grips.

        Raises: InputError if the measurement is newer than the state or older than the last one, or if a track is not
        finite (`Measurement`; the state stays what it was); DivergenceError.
        """
        if seen.stamp > self.stamp + SAME or seen.stamp < self._corrected:
            raise InputError(
                "a measurement out of turn",
                got=f"stamp {seen.stamp / NS:.3f} s",
                allowed=f"{self._corrected / NS:.3f} to {self.stamp / NS:.3f} s",
                next_step="Step to the time of the tracks first; give them in order",
            )
        self.starter.add(seen)
        if seen.stamp < self._history.oldest.stamp:
            self.tally.late += 1
            nothing = np.zeros(0, np.int64)
            return Outcome(seen.stamp, nothing, nothing.astype(bool), 0.0, late=True)
        at = self._history.before(seen.stamp)
        node = self._history.node(at)
        self._hold(node.state)
        assert self._errors is not None
        elapsed = (seen.stamp - self._corrected) / NS
        self._errors.predict(elapsed)
        self._corrected = seen.stamp
        usable = (seen.confidence > self.config.least_confidence) & ~self._held[seen.index]
        index = seen.index[usable]
        innovation = seen.position[usable] - self._history.position_at(at, seen.stamp)[index]
        evidence = Evidence(index, innovation, self.scale.value * seen.variance(self.config)[usable])
        used = believable(self._errors, evidence, self.config.gate)
        if used.sum() <= (1.0 - self.config.lost_share) * len(used):
            used[:] = False  # where most contradict the state, the few that agree do by chance, and would crumple it
        self._note(seen.stamp, used, elapsed, evidence)
        found = self.starter.find() if self.health.lost(seen.stamp) else None
        if found is not None:
            self._begin_anew(at, found)
        elif used.any():
            change = self._errors.update(evidence.only(used))
            self._apply(at, change, (seen.stamp - node.stamp) / NS)
        distance = float(np.median(np.linalg.norm(innovation, axis=1))) if len(index) else 0.0
        return Outcome(seen.stamp, index, used, distance, anew=found is not None)

    def _note(self, stamp: int, used: NDArray[np.bool_], elapsed: float, evidence: Evidence) -> None:
        count = int(used.sum())
        self.tally.frames += int(count > 0)
        self.tally.used += count
        self.tally.rejected += len(used) - count
        self.health.note(stamp, count, len(used) - count)
        self.scale.follow(evidence.only(used), elapsed)

    def _apply(self, at: int, change: Correction, later: float) -> None:
        """Correct node `at` so that `later` [s] after it the change is there, and simulate the nodes after it anew."""
        assert self._lengths is not None
        node, *after = self._history.cut(at)
        before = node.state.position.double().numpy()
        position = self._lengths.keep(before, before + change.position - later * change.velocity)
        velocity = self._lengths.still(position, change.velocity)
        state = corrected(
            self._dynamics,
            node.state,
            node.state.position + torch.as_tensor(position - before, dtype=torch.float32),
            node.state.velocity + torch.as_tensor(velocity, dtype=torch.float32),
        )
        self._history.add(Node(node.stamp, state, node.grip))
        self._again(after)

    def _begin_anew(self, at: int, found: Start) -> None:
        """Replace node `at` and all after it; what is to be held is in the jaws, unless the tracks contradict it."""
        node, *after = self._history.cut(at)
        assert self._grasp is not None
        position = found.position - found.velocity * ((found.stamp - node.stamp) / NS)
        state = State(
            position=torch.as_tensor(position, dtype=torch.float32),
            velocity=torch.as_tensor(found.velocity, dtype=torch.float32),
            held=node.state.held,
        )
        self._grasp = self._grasp.joined(self._body, node.state, node.grip)
        state = self._grasp.taken(state, node.grip, found.track, self.config.slipped)
        self._begin(node.stamp, state, node.grip)
        self.tally.lost += 1
        self.tally.let_go += int(((node.state.held >= 0) & (state.held < 0)).sum())
        self._again(after)

    def _again(self, nodes: list[Node]) -> None:
        """Simulate over nodes that were cut, with the grips they had."""
        for old in nodes:
            self.step(old.stamp, old.grip)

    def _hold(self, state: State) -> None:
        """The modes of those that are free now; errors begin anew when a gripper takes or leaves some."""
        held = (state.held >= 0).numpy()
        if self._errors is not None and np.array_equal(held, self._held):
            return
        key = held.tobytes()
        if key not in self._modes:
            self._modes[key] = error_modes(self._body, held, self.config.correlation, self.config.modes)
        self._held = held
        self._errors = ErrorFilter(self._modes[key], self.config)
        self._lengths = Lengths(self._body, (~held).astype(np.float64))
