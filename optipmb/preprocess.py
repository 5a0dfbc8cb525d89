"""From detections to measurements: canonical order, score filter and non-maximum suppression (Section IV.A).

Measurements are put in an order of their own (best score first, then by coordinates), so that nothing that follows
depends on the order in which a detector lists its boxes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from optipmb.compiled import kernel
from optipmb.geometry import box_iou

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb.frame import Frame
    from optipmb.table import ClassTable

    Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Measurements:
    """The measurement set Z_k, best score first.

    Attributes:
        position: (M, 2) z_xy, m.
        yaw: (M,) z_phi, rad.
        velocity: (M, 2) z_v, m/s, NaN where unknown.
        auxiliary: (M, 4) z_A = [length, width, height, z].
        score: (M,) z_s in (0, 1].
        label: (M,) class z_c.
        source: (M,) index in the caller's arrays.
    """

    position: Array
    yaw: Array
    velocity: Array
    auxiliary: Array
    score: Array
    label: NDArray[np.int64]
    source: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.score)


def preprocess(frame: Frame, table: ClassTable) -> tuple[Measurements, int, int]:
    """Remove detections scored below eta_sf, then those that overlap a better one of their class by more than eta_iou.

    Returns:
        The measurements, the number below the score filter and the number suppressed.
    """
    above = np.flatnonzero(frame.score >= table.score_filter[frame.label])
    center, size, yaw = frame.center[above], frame.size[above], frame.yaw[above]
    score, label, source = frame.score[above], frame.label[above], frame.source[above]
    keys = (source, yaw, size[:, 2], size[:, 1], size[:, 0], center[:, 2], center[:, 1], center[:, 0], -score)
    order = np.lexsort(keys)  # the last key counts most
    boxes = np.column_stack((center[:, :2], size[:, :2], yaw))[order]
    keep = order[non_maximum_suppression(boxes, label[order], table.nms_iou)]
    measurements = Measurements(
        position=center[keep, :2].copy(),
        yaw=yaw[keep],
        velocity=frame.velocity[above][keep],
        auxiliary=np.column_stack((size[keep], center[keep, 2])),
        score=score[keep],
        label=label[keep],
        source=source[keep],
    )
    return measurements, frame.score.shape[0] - above.shape[0], above.shape[0] - keep.shape[0]


@kernel
def non_maximum_suppression(boxes: Array, label: NDArray[np.int64], threshold: Array) -> NDArray[np.bool_]:
    """Keep each box unless a kept box of its class before it overlaps it by more than the threshold of the class.

    Args:
        boxes: (M, 5) bird's-eye boxes, best first.
        label: (M,) class of each.
        threshold: (C,) eta_iou of each class.

    Returns:
        (M,) whether the box is kept.
    """
    count = boxes.shape[0]
    keep = np.ones(count, np.bool_)
    # A sweep along x: boxes whose circles cannot touch are never compared.
    by_x = np.argsort(boxes[:, 0])
    place = np.empty(count, np.int64)
    place[by_x] = np.arange(count)
    radius = 0.5 * np.hypot(boxes[:, 2], boxes[:, 3])
    largest = radius.max() if count else 0.0
    for m in range(count):
        reach = radius[m] + largest
        for step in (-1, 1):
            p = place[m] + step
            while 0 <= p < count and keep[m] and abs(boxes[by_x[p], 0] - boxes[m, 0]) <= reach:
                k = by_x[p]
                if k < m and keep[k] and label[k] == label[m] and box_iou(boxes[k], boxes[m]) > threshold[label[m]]:
                    keep[m] = False
                p += step
    return keep
