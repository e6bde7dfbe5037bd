"""Settings every test shares."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

# One thread a process: the numbers do not depend on it and the machine is not oversubscribed.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
import torch

if TYPE_CHECKING:
    from hidden_world import Answers

torch.set_num_threads(1)
# Begun in the background of a script, it and what it starts would ignore an interrupt, which tests send.
signal.signal(signal.SIGINT, signal.default_int_handler)

ANSWERS = "hidden_answers"
DRAWN = pytest.StashKey[str]()
# Tests of processes and clocks come last, when nothing runs beside them any more.
LIVE = ("test_arm_node", "test_arm_sdks", "test_live_", "test_reroute", "test_ros_")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """First what is answered at once, then what the process beside has worked on, then what needs the machine alone."""
    items.sort(key=lambda item: 2 if item.path.stem.startswith(LIVE) else int(ANSWERS in _fixtures(item)))


def _fixtures(item: pytest.Item) -> tuple[str, ...]:
    return tuple(getattr(item, "fixturenames", ()))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """Say which case was drawn in this run: it is another one every time."""
    if DRAWN in config.stash:
        terminalreporter.write_line(config.stash[DRAWN])


@pytest.fixture(scope="session", autouse=True)
def _hidden_work(request: pytest.FixtureRequest) -> None:
    """Begin the hidden cases with the session if a test of it wants them."""
    if any(ANSWERS in _fixtures(item) for item in request.session.items):
        request.getfixturevalue(ANSWERS)


@pytest.fixture(scope="session")
def hidden_answers(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Iterator[Answers]:
    """What `pred diagnose` says of the hidden cases; worked on beside the other tests."""
    from hidden_world import Answers  # late: it pulls in the simulator

    answers = Answers(tmp_path_factory.mktemp("hidden"))
    request.config.stash[DRAWN] = f"hidden effects: {answers.drawn}"
    answers.work(1)
    yield answers
    answers.end()


@pytest.fixture(scope="session")
def straight_twin(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the twin of `live_world`: nobody writes to it."""
    from live_world import make_twin  # late: it pulls in the simulator

    return make_twin(tmp_path_factory.mktemp("twin") / "line")
