"""Settings every test shares."""

from __future__ import annotations

import os

# One thread a process: the numbers do not depend on it and the machine is not oversubscribed.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch

torch.set_num_threads(1)
