"""ros2 launch pred_ros replay.launch.py bag:=DATASET twin:=TWIN [factor:=1.0] [out:=out/live] [rviz:=true]"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

CONFIG = Path(get_package_share_directory("pred_ros")) / "config"


def generate_launch_description() -> LaunchDescription:
    """Player, predictor and evaluator with the parameters of config/nodes/replay.yaml."""
    shared = str(CONFIG / "nodes" / "replay.yaml")

    def text(name: str) -> ParameterValue:
        return ParameterValue(LaunchConfiguration(name), value_type=str)

    factor = ParameterValue(LaunchConfiguration("factor"), value_type=float)
    own = {
        "evaluator": {"out": text("out"), "twin": text("twin")},
        "predictor": {"twin": text("twin"), "held": text("held")},
        "player": {"bag": text("bag"), "split": text("split"), "factor": factor},
    }
    return LaunchDescription(
        [
            DeclareLaunchArgument("bag", description="data set folder or bag"),
            DeclareLaunchArgument("twin", description="twin folder"),
            DeclareLaunchArgument("held", default_value="", description="particle:gripper pairs, '0:0 1:1'"),
            DeclareLaunchArgument("split", default_value="test"),
            DeclareLaunchArgument("factor", default_value="1.0", description="speed, times real time"),
            DeclareLaunchArgument("out", default_value="out/live", description="folder of the report"),
            DeclareLaunchArgument("rviz", default_value="false"),
            *(
                Node(package="pred_ros", executable=name, name=name, parameters=[shared, parameters], output="screen")
                for name, parameters in own.items()
            ),
            Node(
                package="rviz2",
                executable="rviz2",
                arguments=["-d", str(CONFIG / "rviz" / "pred.rviz")],
                condition=IfCondition(LaunchConfiguration("rviz")),
            ),
        ]
    )
