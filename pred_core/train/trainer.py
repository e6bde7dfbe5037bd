"""The training loop. Its whole state is explicit, so an interrupted run continues bit for bit."""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from pred_core.dynamics import Dynamics
from pred_core.errors import DivergenceError
from pred_core.pred import PReD
from pred_core.residual import ResidualConfig, ResidualNetwork, build_network
from pred_core.train.config import TrainingConfig
from pred_core.train.outliers import LeftOut
from pred_core.train.recordings import Batch, Recording, beginnings, gather, split_groups, window_index
from pred_core.train.rollout import Outcome, held_out_error, training_rollout, training_start
from pred_core.train.slots import Slots, refill
from pred_core.types import STANDARD_GRAVITY, Body, State


@dataclass
class Curves:
    """What is recorded while training; errors are mean absolute per coordinate."""

    loss: list[float] = field(default_factory=list)  # every step [mm^2] or [mm]
    error_mm: list[float] = field(default_factory=list)  # every step, over the K-step windows
    binding: list[float] = field(default_factory=list)  # every step, share of components at the cap
    held_out_step: list[int] = field(default_factory=list)
    held_out_mm: list[float] = field(default_factory=list)  # open loop on held-out recordings; first: backbone alone
    held_out_binding: list[float] = field(default_factory=list)


class Trainer:
    """Trains a residual on `base`. All randomness comes from generators seeded by the configuration."""

    def __init__(
        self,
        base: Dynamics,
        body: Body,
        recordings: Sequence[Recording],
        config: TrainingConfig,
        network: ResidualConfig,
        gravity: Sequence[float] = STANDARD_GRAVITY,
        device: str = "cpu",
    ):
        """Raises: DatasetError if the recordings give no window or no group to hold out."""
        self.base, self.body, self.config, self.gravity = base, body, config, tuple(gravity)
        self.device = torch.device(device)
        self.generator = torch.Generator().manual_seed(config.seed)
        self.shuffle = torch.Generator().manual_seed(config.seed + 1)
        self.fit, held_out = split_groups(recordings, config.holdout, self.generator)
        self.index = window_index(self.fit, config.rollout, config.stride)
        if config.carry > 1:
            self.index = beginnings(self.index)
        self.slots: Slots | None = None
        self.held_out = held_out
        self.left_out: list[LeftOut] = []  # what a rule took away before; reported
        self.held_out_batch = self._held_out_batch(held_out)
        self.network = build_network(network, config.seed).to(self.device)
        self.average = copy.deepcopy(self.network).requires_grad_(False)
        self.best: dict[str, Tensor] = copy.deepcopy(self.average.state_dict())
        self.optimizer = torch.optim.Adam(self.network.parameters(), lr=config.learning_rate)
        self.order = torch.zeros(0, dtype=torch.int64)  # windows of this epoch, shuffled
        self.cursor = 0  # how many of them are used up
        self.step = 0
        self.best_step = 0
        self.seconds = 0.0
        self.curves = Curves()

    @property
    def done(self) -> bool:
        """Whether every step is made."""
        return self.step >= self.config.steps

    def advance(self) -> None:
        """One optimiser step, and the held-out rollout if it is due. Raises: DivergenceError naming the step."""
        if self.step == 0 and not self.curves.held_out_step:
            self._evaluate()
        model = PReD(self.base, self.network, self.body, shuffle=self.shuffle)
        for group in self.optimizer.param_groups:
            group["lr"] = self.learning_rate(self.step)
        self.optimizer.zero_grad()
        try:
            outcome = self._rollout(model)
        except DivergenceError as error:
            raise DivergenceError(f"at training step {self.step + 1}: {error}") from error
        outcome.loss.backward()  # type: ignore[no-untyped-call]
        loss = float(outcome.loss.detach())
        norm = torch.nn.utils.clip_grad_norm_(self.network.parameters(), self.config.clip)
        if not (math.isfinite(loss) and math.isfinite(float(norm))):
            raise DivergenceError(
                f"training left the finite numbers at step {self.step + 1}",
                got=f"loss {loss:g}, gradient norm {float(norm):g}",
                next_step="Lower --learning-rate, --cap or --rollout",
            )
        self.optimizer.step()
        self._update_average()
        self.step += 1
        self.curves.loss.append(loss)
        self.curves.error_mm.append(outcome.error)
        self.curves.binding.append(outcome.binding)
        if self.step % self.config.evaluate_every == 0 or self.done:
            self._evaluate()

    def _rollout(self, model: PReD) -> Outcome:
        """One batch of windows: from measurements, or going on where the last ones ended."""
        steps = self.config.rollout
        if self.config.carry == 1:
            batch = self._gather(self._draw(self.config.batch), steps)
            return training_rollout(model, self._start(model, batch), batch, self.config)
        self.slots = refill(
            self.slots,
            torch.tensor([len(r.position) for r in self.fit]),
            steps,
            self.config.carry,
            self.config.batch,
            self._draw,
            lambda places: self._start(model, self._gather(places, 0)),
            self.generator,
        )
        batch = self._gather(self.slots.place, steps)
        outcome = training_rollout(model, self.slots.state, batch, self.config)
        self.slots = self.slots.moved(outcome.state, steps)
        return outcome

    def _start(self, model: PReD, batch: Batch) -> State:
        return training_start(model, batch, self.config, self.gravity, self.generator)

    def _gather(self, places: Tensor, steps: int) -> Batch:
        return gather(self.fit, places, steps, self.base.period, self.device)

    def learning_rate(self, step: int) -> float:
        """Cosine from the configured rate to zero over the run."""
        return self.config.learning_rate * 0.5 * (1.0 + math.cos(math.pi * step / self.config.steps))

    def chosen(self) -> ResidualNetwork:
        """The averaged weights at the step that was best on held-out recordings (without them: the last)."""
        network = copy.deepcopy(self.average)
        network.load_state_dict(self.best)
        return network.eval()

    def summary(self) -> dict[str, Any]:
        """What `train.json` holds."""
        return {
            "training": dataclasses.asdict(self.config),
            "network": dataclasses.asdict(self.network.config),
            "parameters": sum(p.numel() for p in self.network.parameters()),
            "windows": len(self.index),
            "fitted_on": [r.name for r in self.fit],
            "held_out": [r.name for r in self.held_out],
            "left_out": [dataclasses.asdict(r) for r in self.left_out],
            "step": self.step,
            "best_step": self.best_step,
            "seconds": round(self.seconds, 3),
            "seed": self.config.seed,
            "curves": dataclasses.asdict(self.curves),
        }

    def _held_out_batch(self, recordings: list[Recording]) -> Batch | None:
        if not recordings:
            return None
        steps = min(self.config.holdout_frames, min(len(r.position) for r in recordings) - 2)
        index = window_index(recordings, max(steps, 1), stride=max(steps, 1))
        return gather(recordings, index, max(steps, 1), self.base.period, self.device)

    def _draw(self, number: int) -> Tensor:
        """(number, 2) recording and start frame of the next windows; each once an epoch, in a new order."""
        drawn: list[int] = []
        while len(drawn) < number:
            if self.cursor >= len(self.order):
                self.order = torch.randperm(len(self.index), generator=self.generator)
                self.cursor = 0
            take = self.order[self.cursor : self.cursor + number - len(drawn)]
            self.cursor += len(take)
            drawn += take.tolist()
        return self.index[drawn]

    @torch.no_grad()
    def _update_average(self) -> None:
        # The decay grows from 0 so that the start value does not linger.
        decay = min(self.config.average, self.step / (self.step + 10.0))
        for mean, value in zip(self.average.parameters(), self.network.parameters(), strict=True):
            mean.lerp_(value, 1.0 - decay)

    def _evaluate(self) -> None:
        better = True
        if self.held_out_batch is not None:
            try:
                outcome = held_out_error(PReD(self.base, self.average, self.body), self.held_out_batch)
            except DivergenceError as error:
                raise DivergenceError(f"after training step {self.step}: {error}") from error
            better = outcome.error < min(self.curves.held_out_mm, default=math.inf)
            self.curves.held_out_step.append(self.step)
            self.curves.held_out_mm.append(outcome.error)
            self.curves.held_out_binding.append(outcome.binding)
        if better:
            self.best = copy.deepcopy(self.average.state_dict())
            self.best_step = self.step
