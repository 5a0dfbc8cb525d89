"""Starts `optipmb-service ros2` of a Python environment, where `pip install 'optipmb[service,ros2]'` has put it."""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.substitutions import LaunchConfiguration

CONFIG = Path(__file__).resolve().parents[1] / "config" / "robot.toml"
ARGUMENTS = {
    "program": ("optipmb-service", "Path of the service's command."),
    "settings": (str(CONFIG), "Settings with the table ros2.streams."),
    "connect": ("tcp/127.0.0.1:7447", "Address of the Zenoh router."),
    "domain": ("0", "ROS_DOMAIN_ID."),
}


def generate_launch_description() -> LaunchDescription:
    """Return the arguments, and the process that they start."""
    value = {name: LaunchConfiguration(name) for name in ARGUMENTS}
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=text)
        for name, (default, text) in ARGUMENTS.items()
    ]
    process = ExecuteProcess(
        cmd=[value["program"], "ros2", "--connect", value["connect"], "--settings", value["settings"]],
        additional_env={"OPTIPMB_ROS2__DOMAIN": value["domain"]},
        output="screen",
    )
    return LaunchDescription([*declared, process])
