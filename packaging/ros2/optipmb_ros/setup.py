"""Files of the package, for colcon."""

from setuptools import setup

NAME = "optipmb_ros"

setup(
    name=NAME,
    version="0.1.0",
    packages=[],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/bridge.launch.py"]),
        (f"share/{NAME}/config", ["config/robot.toml"]),
    ],
)
