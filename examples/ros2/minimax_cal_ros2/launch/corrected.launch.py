"""The corrected arm for everything that listens to robot_description.

ros2 launch minimax_cal_ros2 corrected.launch.py urdf:=corrected.urdf
"""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def publisher(context, *args, **kwargs):
    """The node that publishes what `minimax-cal export fit.json --to urdf` wrote."""
    path = Path(LaunchConfiguration("urdf").perform(context))
    described = {"robot_description": path.read_text(encoding="utf-8")}
    return [
        Node(
            package="robot_state_publisher",
            executable="robot_state_publisher",
            parameters=[described],
        )
    ]


def generate_launch_description():
    """As ROS asks for it."""
    urdf = DeclareLaunchArgument("urdf", description="the file of minimax-cal export --to urdf")
    return LaunchDescription([urdf, OpaqueFunction(function=publisher)])
