"""Compile every kernel ahead of the first frame."""

from __future__ import annotations

import numpy as np

from optipmb.frame import PointCloud, Pose, make_frame
from optipmb.geometry import bev_iou
from optipmb.parameters import load_profile
from optipmb.tracker import Tracker


def warm_up() -> None:
    """Compile all kernels, or load them from the cache beside the source, by running a few frames through a tracker.

    The first call after an installation compiles (tens of seconds); later processes load the machine code (under a
    second). Call it before the first frame that is waited for.
    """
    parameters = load_profile("nuscenes")
    tracker = Tracker(parameters)
    density = tracker.initial()
    pose = Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
    cloud = PointCloud(np.zeros((8, 3), np.float32), pose)
    # A low score announces, a second detection then starts a track from what was announced; two close objects make a
    # cluster.
    for k, score in enumerate((0.21, 0.21, 0.9, 0.9, 0.9)):
        frame, _ = make_frame(
            parameters,
            stamp_ns=k * 500_000_000,
            labels=("pedestrian",),
            label=[0, 0, 0],
            center=[[0.0, 0.0, 0.0], [1.5, 0.0, 0.0], [9.0, 9.0, 0.0]],
            size=[[0.6, 0.6, 1.7]] * 3,
            yaw=[0.0, 1.0, 2.0],
            score=[score] * 3,
            velocity=[[1.0, 0.0], [0.0, 0.0], [np.nan, np.nan]],
            cloud=cloud,
        )
        density = tracker.step(density, frame).density
    bev_iou(np.zeros((1, 5)), np.zeros((1, 5)))
