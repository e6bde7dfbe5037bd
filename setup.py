"""Packaging for pip and for colcon (ament_python): the same entry points and data files for both."""

from pathlib import Path

from setuptools import find_packages, setup

PACKAGE = "pred_ros"
SHARE = f"share/{PACKAGE}"
ROOT = Path(__file__).parent

# `ros2 run pred_ros NAME` and the script `NAME` of a pip install.
NODES = ("player", "plant", "tracker", "predictor", "evaluator", "planner", "arm")
COMMANDS = ("pred_replay", "pred_bringup", "pred_reroute", "pred_motion")

CORE = [
    "cma",
    "jinja2",
    "lz4",
    "matplotlib",
    "mcap",
    "numpy",
    "pyyaml",
    "rosbags",
    "safetensors",
    "scipy",
    "torch",
    "warp-lang",
    "zstandard",
]
EXTRAS = {
    "ros": ["ros-jazzy-rclpy", "ros-jazzy-common-interfaces", "ros-jazzy-rmw-fastrtps-cpp"],
    "vision": ["open3d", "opencv-python-headless<5"],
    "plant": ["mujoco==4.0.0"],
    "hardware": ["ur-rtde", "xarm-python-sdk", "depthai"],
    "dev": ["hypothesis", "mcap-ros2-support", "mypy", "pytest", "ruff"],
}


def shared_files(top: str) -> list[tuple[str, list[str]]]:
    """Every file under `top`, installed with its folder below share/pred_ros."""
    folders: dict[str, list[str]] = {}
    for path in sorted((ROOT / top).rglob("*")):
        if path.is_file() and "__pycache__" not in path.parts:
            relative = path.relative_to(ROOT)
            folders.setdefault(f"{SHARE}/{relative.parent}", []).append(str(relative))
    return sorted(folders.items())


def launch_files() -> list[str]:
    """The launch files, for users who have launch installed."""
    return [str(p.relative_to(ROOT)) for p in sorted((ROOT / PACKAGE / "launch").glob("*.launch.py"))]


setup(
    name=PACKAGE,
    version="0.1.0",
    description="Track, predict, diagnose and drive soft objects",
    long_description=(ROOT / "README.md").read_text(encoding="utf-8") if (ROOT / "README.md").is_file() else "",
    long_description_content_type="text/markdown",
    license="Apache-2.0",
    author="PReD maintainers",
    author_email="pred@example.org",
    maintainer="PReD maintainers",
    maintainer_email="pred@example.org",
    python_requires=">=3.11,<3.13",
    packages=find_packages(include=["pred_core", "pred_core.*", "pred_ros", "pred_ros.*"]),
    package_data={"pred_core": ["**/*.j2", "**/*.html", "**/*.css", "**/*.js", "**/*.json", "py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"{PACKAGE}/resource/{PACKAGE}"]),
        (SHARE, ["package.xml"]),
        (f"{SHARE}/launch", launch_files()),
        *shared_files("config"),
        *shared_files("bags"),
    ],
    install_requires=CORE,
    extras_require=EXTRAS,
    zip_safe=False,
    entry_points={
        "console_scripts": [
            "pred = pred_core.cli.main:main",
            *(f"{name} = pred_ros.entry:{name}" for name in (*COMMANDS, *NODES)),
        ]
    },
)
