"""Training of the residual on recorded episodes (paper III-B)."""

from pred_core.train.config import TrainingConfig
from pred_core.train.recordings import Recording, align
from pred_core.train.trainer import Trainer

__all__ = ["Recording", "Trainer", "TrainingConfig", "align"]
