"""Imports only go down: the layers of the design, read from the syntax trees."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

LEVEL = {
    **dict.fromkeys(("frames", "config", "errors"), 0),
    **dict.fromkeys(("types", "dynamics", "calibration", "twin"), 1),
    **dict.fromkeys(("springmass", "effects", "residual", "track", "render", "arm", "metrics", "bag", "report"), 2),
    **dict.fromkeys(("pred", "baselines"), 3),
    **dict.fromkeys(("identify", "train", "diagnose", "plan", "evaluate", "estimate", "live"), 4),
    "cli": 5,
}
PLANT_MAY_IMPORT = {"plant", "types", "bag", "frames", "config", "errors"}
ROS_PACKAGES = {
    "rclpy", "launch", "launch_ros", "tf2_ros", "ament_index_python", "rosbag2_py", "builtin_interfaces",
    "std_msgs", "std_srvs", "sensor_msgs", "geometry_msgs", "diagnostic_msgs", "trajectory_msgs",
    "visualization_msgs", "rosgraph_msgs", "rcl_interfaces", "lifecycle_msgs",
}  # fmt: skip


def imported_modules(source: str) -> set[str]:
    """Every module a file imports, also inside functions; relative imports are not part of the style."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative import"
            module = node.module or ""
            names |= {f"{module}.{alias.name}" for alias in node.names} if module == "pred_core" else {module}
    return names


def package_of(module: str) -> str | None:
    """`pred_core.bag.writer` -> `bag`; None for modules of others."""
    parts = module.split(".")
    return parts[1] if parts[0] == "pred_core" and len(parts) > 1 else None


def upward(package: str, imports: set[str]) -> list[str]:
    """The imports of a file of `package` that break the layers."""
    found = []
    for module in sorted(imports):
        target = package_of(module)
        if target is None or target == package:
            continue
        if package == "plant":
            wrong = target not in PLANT_MAY_IMPORT
        elif target == "plant":
            wrong = package != "cli"
        else:
            wrong = LEVEL.get(target, 99) > LEVEL[package]
        if wrong:
            found.append(f"{package} -> {module}")
    return found


def sources(package: str) -> list[Path]:
    """The Python files of a top-level package."""
    return [p for p in sorted((ROOT / package).rglob("*.py")) if "__pycache__" not in p.parts]


def core_package(path: Path) -> str:
    """`pred_core/bag/writer.py` -> `bag`; `pred_core/types.py` -> `types`."""
    return path.relative_to(ROOT / "pred_core").parts[0].removesuffix(".py")


CORE = [p for p in sources("pred_core") if p != ROOT / "pred_core" / "__init__.py"]


def test_the_checker_sees_an_upward_import() -> None:
    assert upward("types", {"pred_core.springmass.model"}) == ["types -> pred_core.springmass.model"]
    assert upward("springmass", {"pred_core.plant.rope"}) == ["springmass -> pred_core.plant.rope"]
    assert upward("plant", {"pred_core.springmass.model"}) == ["plant -> pred_core.springmass.model"]
    assert upward("evaluate", {"pred_core.types", "numpy", "pred_core.metrics"}) == []
    assert imported_modules("def f():\n    from pred_core import pred\n    import numpy.linalg") == {
        "pred_core.pred",
        "numpy.linalg",
    }


def test_every_core_package_has_a_level() -> None:
    assert {core_package(p) for p in CORE} <= {*LEVEL, "plant"}, "add the new package to LEVEL"


@pytest.mark.parametrize("path", CORE, ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_only_go_down(path: Path) -> None:
    assert upward(core_package(path), imported_modules(path.read_text(encoding="utf-8"))) == []


def test_packages_have_no_import_cycle() -> None:
    graph: dict[str, set[str]] = {}
    for path in CORE:
        targets = {package_of(m) for m in imported_modules(path.read_text(encoding="utf-8"))}
        graph.setdefault(core_package(path), set()).update(t for t in targets if t and t != core_package(path))
    done: set[str] = set()
    while len(done) < len(graph):
        free = {name for name, targets in graph.items() if name not in done and not (targets & set(graph)) - done}
        assert free, f"cycle among {sorted(set(graph) - done)}"
        done |= free


def test_core_never_imports_or_names_ros() -> None:
    for path in sources("pred_core"):
        text = path.read_text(encoding="utf-8")
        assert "rclpy" not in text, f"{path.relative_to(ROOT)} names the ROS client library"
        tops = {module.split(".")[0] for module in imported_modules(text)}
        assert not tops & ROS_PACKAGES and "pred_ros" not in tops, path.relative_to(ROOT)


def test_launch_is_imported_by_launch_files_only() -> None:
    for path in sources("pred_ros"):
        tops = {module.split(".")[0] for module in imported_modules(path.read_text(encoding="utf-8"))}
        assert not tops & {"launch", "launch_ros"} or path.name.endswith(".launch.py"), path.relative_to(ROOT)


def test_only_the_plant_imports_mujoco() -> None:
    for path in CORE:
        tops = {module.split(".")[0] for module in imported_modules(path.read_text(encoding="utf-8"))}
        assert "mujoco" not in tops or core_package(path) == "plant", path.relative_to(ROOT)
