"""Rows of a simple tracker as a table of results, and the points in a box."""

import numpy as np
from numpy.typing import NDArray
from optipmb_tools.geometry import Bools, Floats, to_sensor
from optipmb_tools.results import ResultTable
from optipmb_tools.results.kitti import LEAST_SHOWN
from optipmb_tools.tuning.clips import Clip

Row = tuple[int, int, "NDArray[np.float64]", "NDArray[np.float64]", float, float]
"""Frame, id, centre, size, yaw and score, in the world frame."""


def table_of(clip: Clip, name: str, rows: list[Row]) -> ResultTable:
    frame, identity, center, size, yaw, score = zip(*rows, strict=True) if rows else ([],) * 6
    when = np.array(frame, dtype=np.int64)
    centers, sizes = np.array(center, dtype=np.float64).reshape(-1, 3), np.array(size, dtype=np.float64).reshape(-1, 3)
    yaws = np.array(yaw, dtype=np.float64)
    image = np.full((len(when), 4), np.nan)
    if clip.camera is not None:
        local, turned = to_sensor(clip.rotation[when], clip.translation[when], centers, yaws)
        image = clip.camera.boxes(local, sizes, turned, LEAST_SHOWN)[0]
    return ResultTable(
        labels=(name,),
        frame=when,
        id=np.array(identity, dtype=np.int64),
        label=np.zeros(len(when), dtype=np.int64),
        center=centers,
        size=sizes,
        yaw=yaws,
        score=np.array(score, dtype=np.float64),
        box2d=image,
    )


def points_in_box(xyz: Floats, center: Floats, size: Floats, yaw: float, margin: float = 0.0) -> Bools:
    """Return which points (P, 3) lie in one box, widened by a margin on every side."""
    offset = xyz - center
    cos, sin = np.cos(yaw), np.sin(yaw)
    along = np.abs(cos * offset[:, 0] + sin * offset[:, 1])
    across = np.abs(cos * offset[:, 1] - sin * offset[:, 0])
    half = 0.5 * size + margin
    return np.asarray((along <= half[0]) & (across <= half[1]) & (np.abs(offset[:, 2]) <= half[2]), dtype=np.bool_)
