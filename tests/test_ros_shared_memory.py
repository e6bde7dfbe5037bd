"""Promises: only pictures travel in shared memory, no node leaves anything there, and a restarted one is heard."""

from __future__ import annotations

import contextlib
import fcntl
import signal
import socket
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="ROS is not installed")

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from ros_bench import own_domain

from pred_ros import dead_ports, transport
from pred_ros.processes import Children, free_domain, node_command, node_environment
from pred_ros.shared_memory import SHARED_MEMORY, sweep

pytestmark = pytest.mark.skipif(not SHARED_MEMORY.is_dir(), reason=f"no {SHARED_MEMORY}")


def segments(pid: int) -> set[Path]:
    """Segments of Fast DDS that a process owns: it has their locks open. Those of others it only reads."""
    opened = []
    for entry in Path(f"/proc/{pid}/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):  # closed in the meantime
            opened.append(entry.readlink())
    locks = [p for p in opened if p.parent == SHARED_MEMORY and p.name.endswith("_el") and "port" not in p.name]
    return {p.with_name(p.name.removesuffix("_el")) for p in locks}


def started(children: Children, node: str, parameters: dict[str, object], words: str) -> subprocess.Popen[bytes]:
    """A node that has said these words."""
    process = children.start(node, node_command(node, parameters))
    until(lambda: words in children.log(node), lambda: children.log(node))
    assert process.poll() is None, children.log(node)
    return process


def until(condition: Callable[[], bool], what: Callable[[], str], limit: float = 60.0) -> None:
    """Wait; fail with a line after `limit` [s]."""
    end = time.monotonic() + limit
    while not condition():
        assert time.monotonic() < end, what()
        time.sleep(0.05)


def test_what_carries_no_pictures_stays_out_of_shared_memory(tmp_path: Path) -> None:
    """A process that is killed in there can stop all others: not the arm."""
    with Children(node_environment(free_domain()), tmp_path) as children:
        arm = started(children, "arm", {}, "not armed yet")
        assert f"{SHARED_MEMORY}/fastrtps_" not in Path(f"/proc/{arm.pid}/maps").read_text()


def test_the_user_may_choose_another_transport() -> None:
    for pictures, name in ((True, transport.PROFILES), (False, transport.TRANSPORTS)):
        assert list(transport.variables(pictures, {})) == [name]
        assert transport.variables(pictures, {transport.PROFILES: "mine.xml"}) == {}
    here = transport.variables(False, {transport.RANGE: "LOCALHOST"})
    assert here[transport.RANGE] == "SYSTEM_DEFAULT" and "127.0.0.1" in Path(here[transport.PROFILES]).read_text()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL], ids=["asked to end", "killed"])
def test_a_node_leaves_no_segment(number: signal.Signals, tmp_path: Path) -> None:
    with Children(node_environment(free_domain()), tmp_path) as children:
        node = started(children, "tracker", {}, "waiting for pictures")
        held = segments(node.pid)
        assert held, "pictures come through shared memory"
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


def is_free(port: int) -> bool:
    """Whether no participant has this UDP port."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("", port))
        except OSError:
            return False
    return True


def test_a_restarted_node_does_not_take_the_ports_of_the_killed_one(tmp_path: Path) -> None:
    """As long as we have them open without a break; and we hear it."""
    with own_domain(), Children(node_environment(), tmp_path) as children:
        rclpy.init()
        node = rclpy.create_node("watch")
        heard: list[DiagnosticArray] = []
        node.create_subscription(DiagnosticArray, "/diagnostics", heard.append, 10)

        def written() -> set[int]:
            return {int(p) for p in dead_ports.PORT.findall(Path("/proc/self/maps").read_text())}

        def start(name: str, ports: set[int]) -> set[int]:
            """Those of the ports that are written to until the node is heard."""
            children.start(name, node_command("tracker", {}))
            end = time.monotonic() + 60.0
            while not heard:
                assert time.monotonic() < end, children.log(name)
                rclpy.spin_once(node, timeout_sec=0.05)
                ports = ports & written()
            return ports

        try:
            start("first", set())
            children.running["first"].kill()
            children.running.pop("first").wait()
            end = time.monotonic() + 0.5
            while time.monotonic() < end:  # its last words
                rclpy.spin_once(node, timeout_sec=0.05)
            heard.clear()
            dead = {p for p in written() if is_free(p)}
            assert dead, "it is written to the ports of a node that is gone"
            assert all(is_free(p) for p in start("second", dead))
        finally:
            node.destroy_node()
            rclpy.try_shutdown()
