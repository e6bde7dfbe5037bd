"""ros2 launch pred_ros reroute.launch.py [twin:=TWIN] [settings:=YAML]

Then publish goal/points (latched) and call /arm/enable and /planner/enable. `pred_reroute` does that too, and judges.
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

CONFIG = Path(get_package_share_directory("pred_ros")) / "config"


def generate_launch_description() -> LaunchDescription:
    """The cell, tracker, predictor, planner and arm (config/nodes/reroute.yaml)."""
    twin, settings = (ParameterValue(LaunchConfiguration(name), value_type=str) for name in ("twin", "settings"))
    own = {"plant": {}, "tracker": {}, "predictor": {"twin": twin}, "planner": {"twin": twin, "settings": settings}}
    shared = str(CONFIG / "nodes" / "reroute.yaml")
    return LaunchDescription(
        [
            DeclareLaunchArgument("twin", default_value=str(CONFIG / "twins" / "cell_rope")),
            DeclareLaunchArgument("settings", default_value=str(CONFIG / "plan" / "slot.yaml")),
            *(
                Node(package="pred_ros", executable=name, name=name, parameters=[shared, more], output="screen")
                for name, more in {**own, "arm": {}}.items()
            ),
        ]
    )
