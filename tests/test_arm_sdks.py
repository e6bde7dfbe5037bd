"""The makers' own drivers against controllers that speak their protocols, each in a process of its own."""

from __future__ import annotations

import importlib.util
import json
import os
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

HERE = Path(__file__).parent
LIMIT = 15.0  # [s] for one answer, with the machine busy


class Process:
    """A script with lines in and out, ended whatever happens."""

    def __init__(self, script: str, *arguments: str):
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join([str(HERE.parent), *sys.path]),
            "PYTHONUNBUFFERED": "1",
        }
        self.process = subprocess.Popen(
            [sys.executable, str(HERE / script), *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=environment,
            text=True,
        )
        self._lines: queue.Queue[str] = queue.Queue()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self._lines.put(line.strip())

    def tell(self, line: str) -> None:
        """A line to its standard input."""
        assert self.process.stdin is not None
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()

    def line(self) -> str:
        """Its next line that is ours (the drivers print, too)."""
        end = time.monotonic() + LIMIT
        while time.monotonic() < end:
            try:
                found = self._lines.get(timeout=0.1)
            except queue.Empty:
                assert self.process.poll() is None, f"ended with {self.process.returncode}"
                continue
            if found.startswith("{") or found == "listening":
                return found
        raise AssertionError(f"no line within {LIMIT} s")

    def ask(self, line: str = "read") -> dict[str, Any]:
        """Tell, and read the JSON answer."""
        self.tell(line)
        return dict(json.loads(self.line()))


@contextmanager
def process(script: str, *arguments: str) -> Iterator[Process]:
    """A running script."""
    child = Process(script, *arguments)
    try:
        yield child
    finally:
        child.process.kill()
        child.process.wait()


def own_host() -> str:
    """A loopback address that other runs on this machine do not use: the drivers' ports are fixed."""
    if sys.platform != "linux":
        pytest.skip("only Linux answers on every loopback address")
    return f"127.{1 + os.getpid() % 250}.{1 + os.getpid() // 250 % 250}.7"


@pytest.mark.skipif(importlib.util.find_spec("rtde_receive") is None, reason="ur_rtde is not installed")
def test_ur_rtde_reads_a_controller_and_never_releases_its_protective_stop() -> None:
    host = own_host()
    with process("fake_rtde.py", host) as controller:
        assert controller.line() == "listening"
        with process("drive_ur.py", host) as driver:
            found = driver.ask()
            assert found["ready"] and found["position"] == pytest.approx([0.0, -0.3, 0.25])
            # The rotation vector (2, -1, 0.5): angle 2.2913, half of it 1.1456, cosine 0.41246.
            assert found["rotation"][0] == pytest.approx(0.41246, abs=1e-5)
            assert found["joints"]["elbow"] == pytest.approx(1.3)
            controller.tell("mode 5")
            assert _until(driver, "message", "robot mode 5")["ready"] is False
            controller.tell("protective")
            found = _until(driver, "message", "protective stop")
            assert found["begin"] == "ur: protective stop. Clear it at the pendant, then enable again."
            controller.tell("emergency")
            _until(driver, "message", "emergency stop")
            controller.tell("end")
            assert "connection lost" in _until(driver, "error", "ur: connection lost")["error"]


@pytest.mark.skipif(importlib.util.find_spec("xarm") is None, reason="xarm-python-sdk is not installed")
def test_the_xarm_sdk_drives_a_controller_whose_dead_man_stops_it() -> None:
    host = own_host()
    with process("fake_xarm.py", host) as controller:
        assert controller.line() == "listening"
        with process("drive_xarm.py", host) as driver:
            assert driver.ask("read")["position"] == pytest.approx([0.3, 0.0, 0.25])
            assert "before the arm was enabled" in driver.ask("move 1")["error"]
            assert "error" not in driver.ask("begin")
            known = controller.ask("show")
            assert (known["mode"], known["state"], known["enabled"], known["fence"]) == (5, 2, 1, 1)
            assert known["boundary"] == pytest.approx([730, 170, 430, -430, 630, -10], abs=1)  # rounded outwards
            # 25 set-points of 20 ms at 0.1 m/s, then silence: 50 mm, and at most 0.1 s x 0.12 m/s of dead-man more.
            moved = driver.ask("move 25")["position"][0] - 0.3
            time.sleep(0.3)
            rest, later = controller.ask("show")["pose"][0], controller.ask("show")["pose"][0]
            assert moved > 0.03 and rest == later and 40.0 < rest - 300.0 < 75.0
            known = controller.ask("show")
            assert known["duration"] == pytest.approx(0.1) and known["coordinates"] == 0 and known["velocities"] == 25
            controller.tell("error 31")
            assert "xarm" in driver.ask("move 5")["error"]
            assert _until(driver, "message", "error 31")["ready"] is False
            driver.ask("stop")
            assert "Clear it in Studio" in driver.ask("begin")["error"]
            known = controller.ask("show")
            assert known["cleaned"] == 0 and known["state"] == 4


def _until(driver: Process, key: str, word: str) -> dict[str, Any]:
    """Readings until one says `word` under `key`: the drivers receive in the background."""
    end = time.monotonic() + LIMIT
    while time.monotonic() < end:
        found = driver.ask()
        if str(found.get(key, "")).startswith(word):
            return found
        time.sleep(0.02)
    raise AssertionError(f"'{word}' was not reported; last: {found}")
