"""Adaptive detection probability (ADP, Section IV.G): an object without LiDAR points in its box is hidden, not gone."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from optipmb.density import PHI
from optipmb.points import points_in_boxes

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb.frame import PointCloud
    from optipmb.table import ClassTable

    Array = NDArray[np.float64]

LEAST_SHARE: Final = 0.02
"""Least share of the time that p_d holds for that a look counts for."""


def detection_probability(
    mean: Array, auxiliary: Array, label: NDArray[np.int64], cloud: PointCloud | None, table: ClassTable
) -> Array:
    """Compute p_d(x_+) of each predicted object.

    ``p_d = p_d0 min[1, (1 - s_d) PTS / PTS_0 + s_d]`` with the points PTS counted in the predicted box: position and
    heading from the motion state, size and height from the auxiliary state; points up to `ground_clearance` above the
    bottom of the box are returns of the ground and do not count. Without a cloud p_d = p_d0; a frame says
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
    p_d0: Array = table["detection"][label]
    if cloud is None or not label.size:
        return p_d0
    cut = np.minimum(table["ground_clearance"][label], auxiliary[:, 2])
    center = np.column_stack((mean[:, :2], auxiliary[:, 3] + 0.5 * cut))
    size = auxiliary[:, :3].copy()
    size[:, 2] -= cut
    points = points_in_boxes(cloud, center, size, mean[:, PHI].copy())
    s_d = table["detection_floor"][label]
    scaled: Array = p_d0 * np.minimum(1.0, (1.0 - s_d) * points / table["expected_points"][label] + s_d)
    return scaled


def over_time(p_d: Array, share: float | Array) -> Array:
    """Return the probability of a detection within a share of the time that p_d holds for, ``1 - (1 - p_d)^share``.

    A detector that looks twice as often does not see twice as much: what hides an object hides it in the next look as
    well. So p_d holds for `detection_time`, and a miss weighs by the time that it lasts. Looks farther apart are
    independent: the share is at most one. It is at least `LEAST_SHARE`, so that frames of equal stamps can
    be associated.

    Args:
        p_d: (N,) probabilities.
        share: of that time, one for all or (N,).
    """
    kept: Array
    if isinstance(share, np.ndarray):
        kept = np.where(share >= 1.0, p_d, 1.0 - (1.0 - p_d) ** np.maximum(share, LEAST_SHARE))
    elif share >= 1.0:
        kept = p_d
    else:
        kept = 1.0 - (1.0 - p_d) ** max(share, LEAST_SHARE)
    return kept
