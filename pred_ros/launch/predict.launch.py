"""ros2 launch pred_ros predict.launch.py twin:=TWIN [held:='0:0 1:1'] [namespace:=robot1]"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

CONFIG = Path(get_package_share_directory("pred_ros")) / "config"


def generate_launch_description() -> LaunchDescription:
    """The predictor beside a tracker and an arm that already publish (config/nodes/live.yaml)."""
    own = {name: ParameterValue(LaunchConfiguration(name), value_type=str) for name in ("twin", "held")}
    return LaunchDescription(
        [
            DeclareLaunchArgument("twin", description="twin folder"),
            DeclareLaunchArgument("held", default_value="", description="particle:gripper pairs, '0:0 1:1'"),
            DeclareLaunchArgument("namespace", default_value=""),
            Node(
                package="pred_ros",
                executable="predictor",
                name="predictor",
                namespace=LaunchConfiguration("namespace"),
                parameters=[str(CONFIG / "nodes" / "live.yaml"), own],
                output="screen",
            ),
        ]
    )
