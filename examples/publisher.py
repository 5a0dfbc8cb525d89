"""Publish the detections of a sensor: here of one car that drives along x at 10 m/s, seen ten times a second."""

import time

from optipmb_client import Publisher

with Publisher("garage/robot-1/lidar", connect="tcp/127.0.0.1:7447", frame="world") as publisher:
    for k in range(50):
        car = {"label": ["car"], "center": [[k, 0, 0.8]], "size": [[4.5, 1.9, 1.6]], "yaw": [0.0], "score": [0.9]}
        publisher.publish(stamp_ns=time.time_ns(), **car)
        time.sleep(0.1)
