"""Bags of ROS 2 (rosbag2 in MCAP or SQLite): read, and written with tracks.

The packages that this needs are the extra `ros2` of the installation; no ROS is needed.
"""
