"""ROS 2 messages: their definitions, CDR, and their meaning in the terms of this package.

Detections and point clouds become arrays, transforms become poses, tracks become `TrackedObjects`, `Detection3DArray`
and markers. Nothing here knows a bag or a network. The packages that this needs are the extra `ros2` of the
installation; no ROS is needed.
"""
