"""Starts the node: `ros2 launch ros/topomerge.launch.py robots:="['a=/a/scan,/a/odom', 'b=/b/scan,/b/odom']"`."""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.substitutions import LaunchConfiguration

DEFAULTS = {"robots": "['a=/a/scan,/a/odom', 'b=/b/scan,/b/odom']", "folder": "topomerge_live"}


def generate_launch_description() -> LaunchDescription:
    """Describe the node and its arguments."""
    node = str(Path(__file__).parent / "topomerge_node.py")
    parameters = [part for name in DEFAULTS for part in ("-p", [f"{name}:=", LaunchConfiguration(name)])]
    arguments = [DeclareLaunchArgument(name, default_value=value) for name, value in DEFAULTS.items()]
    return LaunchDescription([*arguments, ExecuteProcess(cmd=["python3", node, "--ros-args", *parameters], output="screen")])
