"""Drive a `Trainer` to its end: progress with an estimate, checkpoints, a stop between two steps."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from pred_core.train.checkpoint import save_checkpoint
from pred_core.train.trainer import Trainer

CHECKPOINT_SECONDS = 30.0  # the most work a crash can cost
PROGRESS_SECONDS = 5.0


def run_training(
    trainer: Trainer,
    checkpoint: Path,
    source: dict[str, str],
    stop: Callable[[], bool],
    tell: Callable[[str], None],
    checkpoint_seconds: float = CHECKPOINT_SECONDS,
) -> bool:
    """Train until done or until `stop()` between two steps; True if done. A checkpoint is left either way.

    Raises: DivergenceError; the last checkpoint before it stays.
    """
    begin, first, before = time.monotonic(), trainer.step, trainer.seconds
    saved = told = begin
    while not trainer.done and not stop():
        trainer.advance()
        now = time.monotonic()
        trainer.seconds = before + now - begin
        if now - saved >= checkpoint_seconds:
            save_checkpoint(checkpoint, trainer, source)
            saved = now
        if now - told >= PROGRESS_SECONDS or trainer.done or trainer.step == first + 1:
            tell(progress_line(trainer, (now - begin) / (trainer.step - first)))
            told = now
    save_checkpoint(checkpoint, trainer, source)
    return trainer.done


def progress_line(trainer: Trainer, seconds_per_step: float) -> str:
    """One line: step, error over the last steps, held-out error against the backbone's, time left."""
    curves = trainer.curves
    recent = curves.error_mm[-20:]
    parts = [f"step {trainer.step}/{trainer.config.steps}", f"windows {sum(recent) / len(recent):.3f} mm"]
    if curves.held_out_mm:
        parts.append(f"held-out {curves.held_out_mm[-1]:.3f} mm (backbone {curves.held_out_mm[0]:.3f})")
    left = seconds_per_step * (trainer.config.steps - trainer.step)
    parts += [f"{seconds_per_step:.2f} s a step", f"{left / 60:.1f} min left"]
    return ", ".join(parts)
