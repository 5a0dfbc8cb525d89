"""Adaptive detection probability (ADP, Section IV.F): an object without LiDAR points in its box is hidden, not gone."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from optipmb.density import PHI
from optipmb.points import points_in_boxes

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb.frame import PointCloud
    from optipmb.table import ClassTable

    Array = NDArray[np.float64]


def detection_probability(
    mean: Array, auxiliary: Array, label: NDArray[np.int64], cloud: PointCloud | None, table: ClassTable
) -> Array:
    """Compute p_d(x_+) of each predicted object.

    ``p_d = p_d0 min[1, (1 - s_d) PTS / PTS_0 + s_d]`` with the points PTS counted in the predicted box: position and
    heading from the motion state, size and height from the auxiliary state. Without a cloud p_d = p_d0; a frame says
    whether it had one.

    Args:
        mean: (N, 6) predicted motion states.
        auxiliary: (N, 4) auxiliary states.
        label: (N,) classes.
        cloud: the scan of the frame, or None.
        table: parameters as columns.

    Returns:
        (N,) in (0, 1).
    """
    p_d0 = table.detection[label]
    if cloud is None or not label.size:
        return p_d0
    center = np.column_stack((mean[:, :2], auxiliary[:, 3]))
    points = points_in_boxes(cloud, center, auxiliary[:, :3].copy(), mean[:, PHI].copy())
    s_d = table.detection_floor[label]
    scaled: Array = p_d0 * np.minimum(1.0, (1.0 - s_d) * points / table.expected_points[label] + s_d)
    return scaled
