"""pip and colcon find every node: entry points, resource marker, package.xml, exact pins."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import pytest
import setuptools

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def arguments() -> dict[str, Any]:
    """What setup.py hands to setuptools, without building anything."""
    given: dict[str, Any] = {}
    source = (ROOT / "setup.py").read_text(encoding="utf-8")
    original = setuptools.setup
    setuptools.setup = lambda **kwargs: given.update(kwargs)  # type: ignore[assignment]
    try:
        exec(compile(source, str(ROOT / "setup.py"), "exec"), {"__file__": str(ROOT / "setup.py"), "__name__": "x"})
    finally:
        setuptools.setup = original
    return given


def scripts(arguments: dict[str, Any]) -> dict[str, str]:
    """Script name -> module:function."""
    return dict(re.split(r"\s*=\s*", line, maxsplit=1) for line in arguments["entry_points"]["console_scripts"])


def test_every_node_module_has_an_entry_point_that_exists(arguments: dict[str, Any]) -> None:
    found = scripts(arguments)
    nodes = {p.name.removesuffix("_node.py") for p in (ROOT / "pred_ros").glob("*_node.py")}
    assert nodes, "no *_node.py in pred_ros"
    assert nodes <= set(found)
    for name in nodes:
        assert found[name] == f"pred_ros.entry:{name}"
    pytest.importorskip("rclpy", reason="the node modules need ROS")
    for target in found.values():
        module, function = target.split(":")
        assert callable(getattr(importlib.import_module(module), function)), target


def test_ctrl_c_while_the_modules_load_ends_quietly() -> None:
    code = (
        "import importlib, signal; from pred_ros import entry; signal.signal(signal.SIGINT, signal.default_int_handler)"
        "; importlib.import_module = lambda module: signal.raise_signal(signal.SIGINT); entry.predictor()"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_colcon_puts_scripts_where_ros2_run_looks(arguments: dict[str, Any]) -> None:
    text = (ROOT / "setup.cfg").read_text(encoding="utf-8")
    assert "install_scripts=$base/lib/pred_ros" in text and "script_dir=$base/lib/pred_ros" in text
    placed = {Path(folder) / Path(f).name for folder, files in arguments["data_files"] for f in files}
    assert Path("share/ament_index/resource_index/packages/pred_ros") in placed
    assert Path("share/pred_ros/package.xml") in placed


def test_every_data_file_exists_and_configuration_is_complete(arguments: dict[str, Any]) -> None:
    listed = [f for _, files in arguments["data_files"] for f in files]
    assert all((ROOT / f).is_file() for f in listed)
    config = {str(p.relative_to(ROOT)) for p in (ROOT / "config").rglob("*") if p.is_file()}
    assert config and config <= set(listed)
    assert any(f.endswith(".launch.py") for f in listed)


def test_package_xml_is_valid_for_colcon(arguments: dict[str, Any]) -> None:
    root = ElementTree.parse(ROOT / "package.xml").getroot()
    assert root.get("format") == "3"
    assert root.findtext("name") == arguments["name"] == "pred_ros"
    assert root.findtext("version") == arguments["version"]
    assert root.findtext("export/build_type") == "ament_python"
    assert root.findtext("license") == arguments["license"] == "Apache-2.0"
    maintainer = root.find("maintainer")
    # colcon treats the package as plain Python, in silence, when the address is malformed.
    assert maintainer is not None and re.fullmatch(r"[\w.+-]+@[\w-]+(\.[\w-]+)+", maintainer.get("email", ""))
    children = [child.tag for child in root]
    assert children.index("maintainer") < children.index("license")


def test_every_requirement_is_pinned_exactly(arguments: dict[str, Any]) -> None:
    lines = [x for x in (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines() if x and x[0] != "#"]
    pins = dict(line.split("==") for line in lines)
    normal = {re.sub(r"[-_.]+", "-", name).lower(): version for name, version in pins.items()}
    wanted = [*arguments["install_requires"], *(r for group in arguments["extras_require"].values() for r in group)]
    for requirement in wanted:
        match = re.match(r"[A-Za-z0-9._-]+", requirement)
        assert match and re.sub(r"[-_.]+", "-", match[0]).lower() in normal, requirement
    assert normal["torch"] == "2.13.0" and normal["mujoco"] == "4.0.0"
    assert int(normal["opencv-python-headless"].split(".")[0]) < 5
    assert not any("+" in version for version in normal.values()), "a local version does not exist on PyPI"


def test_core_installs_without_ros_or_hardware(arguments: dict[str, Any]) -> None:
    core = " ".join(arguments["install_requires"])
    assert "ros-" not in core and "depthai" not in core and "ur-rtde" not in core and "mujoco" not in core


def test_files_that_the_core_reads_are_installed_with_it(arguments: dict[str, Any]) -> None:
    patterns = [p.removeprefix("**/") for p in arguments["package_data"]["pred_core"]]
    files = [p for p in (ROOT / "pred_core").rglob("*") if p.is_file() and "__pycache__" not in p.parts]
    for path in files:
        assert path.suffix == ".py" or any(path.match(p) for p in patterns), path.relative_to(ROOT)
