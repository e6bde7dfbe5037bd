"""Settings every test shares."""

from __future__ import annotations

import os
from pathlib import Path

# One thread a process: the numbers do not depend on it and the machine is not oversubscribed.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
import torch

torch.set_num_threads(1)


@pytest.fixture(scope="session")
def straight_twin(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the twin of `live_world`: nobody writes to it."""
    from live_world import make_twin  # late: it pulls in the simulator

    return make_twin(tmp_path_factory.mktemp("twin") / "line")
