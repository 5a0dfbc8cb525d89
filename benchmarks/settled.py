"""Frames as the tracker takes them, and densities that have settled on them."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from dense import LABELS, SENSOR_HEIGHT, SceneFrame, dense_scene

import optipmb

if TYPE_CHECKING:
    from collections.abc import Iterator

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests" / "support"))

PARAMETERS = optipmb.load_profile("kitti")
PROFILES = ("generic", "kitti")
"""The default, and a tuned one."""
HERE = optipmb.Pose(np.array([0.0, 0.0, SENSOR_HEIGHT]), np.array([1.0, 0.0, 0.0, 0.0]))


def frame_of(given: SceneFrame, parameters: optipmb.Parameters) -> optipmb.Frame:
    """The tracker's frame of a frame of the scene."""
    cloud = None if given.scan is None else optipmb.PointCloud(given.scan, HERE)
    frame, _ = optipmb.make_frame(
        parameters,
        stamp_ns=given.stamp_ns,
        labels=LABELS,
        label=given.label,
        center=given.center,
        size=given.size,
        yaw=given.yaw,
        score=given.score,
        cloud=cloud,
    )
    return frame


def settled(
    objects: int, points: int = 0, profile: str | None = None
) -> tuple[optipmb.Tracker, optipmb.Density, optipmb.Frame]:
    """A tracker, its density after ten frames of the dense scene, and the eleventh frame."""
    parameters = PARAMETERS if profile is None else optipmb.load_profile(profile)
    *before, last = (frame_of(given, parameters) for given in dense_scene(objects, points=points))
    tracker = optipmb.Tracker(parameters)
    density = tracker.initial()
    for frame in before:
        density = tracker.step(density, frame).density
    return tracker, density, last


Arguments = dict[str, Any]


def recorded(dataset: str) -> tuple[optipmb.Parameters, list[list[Arguments]]]:
    """The arguments of `make_frame` of all frames of all sequences, KITTI's with cars only; skips without the data."""
    from optipmb_tools.datasets import open_dataset, selected_frames  # noqa: PLC0415 - the dense scene needs none
    from real_data import kitti_root, nuscenes_root  # noqa: PLC0415 - the same

    if dataset == "kitti":
        opened, classes = open_dataset("kitti", kitti_root(), "pointrcnn", clouds=False), ("Car",)
    else:
        root = nuscenes_root()
        opened, classes = open_dataset("nuscenes", root, root / "detections" / "centerpoint.json", clouds=False), ()

    def arguments() -> Iterator[list[Arguments]]:
        for sequence in opened.sequences(["all"]):
            yield [
                {
                    "stamp_ns": one.stamp_ns,
                    "labels": one.labels,
                    "label": one.label,
                    "center": one.center,
                    "size": one.size,
                    "yaw": one.yaw,
                    "score": one.score,
                    "velocity": one.velocity,
                    "pose": (one.pose.translation, one.pose.quaternion),
                }
                for one in selected_frames(sequence, classes)
            ]

    return optipmb.load_profile(dataset), list(arguments())
