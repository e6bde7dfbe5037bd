"""Promise: a node leaves nothing in shared memory, whether it ends by itself or is killed."""

from __future__ import annotations

import fcntl
import signal
import time
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="ROS is not installed")

from pred_ros.processes import Children, free_domain, node_command, node_environment
from pred_ros.shared_memory import SHARED_MEMORY, sweep

pytestmark = pytest.mark.skipif(not SHARED_MEMORY.is_dir(), reason=f"no {SHARED_MEMORY}")


def segments(pid: int) -> set[Path]:
    """Segments of Fast DDS that a process holds; ports belong to all."""
    paths = {Path(line.split()[-1]) for line in Path(f"/proc/{pid}/maps").read_text().splitlines()}
    return {p for p in paths if p.name.startswith("fastrtps_") and not p.name.startswith("fastrtps_port")}


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL], ids=["asked to end", "killed"])
def test_a_node_leaves_no_segment(number: signal.Signals, tmp_path: Path) -> None:
    with Children(node_environment(free_domain()), tmp_path) as children:
        node = children.start("evaluator", node_command("evaluator", {"out": tmp_path}))
        end = time.monotonic() + 60.0
        while "no pairs yet" not in children.log("evaluator"):
            assert node.poll() is None and time.monotonic() < end, children.log("evaluator")
            time.sleep(0.05)
        held = segments(node.pid)
        assert held, "the node uses shared memory"
        sweep()
        assert all(p.exists() for p in held), "a living node keeps its own"
        node.send_signal(number)
        node.wait(20.0)
        if number == signal.SIGINT:
            assert not any(p.exists() for p in held)
    assert not any(p.exists() for p in held)


def test_a_segment_goes_only_once_its_owner_is_gone(tmp_path: Path) -> None:
    segment, lock, port = (tmp_path / name for name in ("fastrtps_1f", "fastrtps_1f_el", "fastrtps_port7_el"))
    for path in (segment, lock, port, tmp_path / "other_el"):
        path.write_bytes(b"")
    with lock.open() as owner:
        fcntl.flock(owner, fcntl.LOCK_EX)
        assert sweep(tmp_path) == 0 and segment.exists()
    assert sweep(tmp_path) == 1
    assert not segment.exists() and not lock.exists() and port.exists() and (tmp_path / "other_el").exists()
