"""From detections to measurements: canonical order, score filter and non-maximum suppression (Section IV.A).

Measurements are put in an order of their own (best score first, then by coordinates), so that nothing that follows
depends on the order in which a detector lists its boxes.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from optipmb.compiled import kernel
from optipmb.effort import UNLIMITED
from optipmb.errors import EffortError
from optipmb.geometry import iou_exceeds
from optipmb.neighbours import NOBODY, block, empty_torus, insert
from optipmb.position_noise import PLAIN, relative_noise
from optipmb.records import INDEX, record

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb.frame import Frame
    from optipmb.table import ClassTable

    Array = NDArray[np.float64]
    Index = NDArray[np.int64]


@record
class Measurements:
    """The measurement set Z_k, best score first.

    Attributes:
        position: (M, 2) z_xy, m; (M, 5) with rho_xx, rho_xy and rho_yy of `optipmb.position_noise` behind, where some
            detection of the frame has another R than its class.
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
    label: Index
    source: Index

    def __len__(self) -> int:
        return len(self.score)


def preprocess(frame: Frame, table: ClassTable, most: int = UNLIMITED) -> tuple[Measurements, int, int]:
    """Remove detections scored below eta_sf, then those that overlap a better one by more than eta_iou.

    They are compared with detections of their class, and with those of the other classes of its group, if it has one.

    Returns:
        The measurements, the number below the score filter and the number suppressed.

    Raises:
        EffortError: more than `most` pairs of detections may overlap.
    """
    count = frame.score.shape[0]
    chosen = np.empty(count, INDEX)
    above, kept = select(
        frame.center,
        frame.size,
        frame.yaw,
        frame.score,
        frame.label,
        frame.source,
        table.score_filter,
        table.nms_iou,
        table.group,
        chosen,
        most,
    )
    if kept < 0:
        raise EffortError("center", f"at most {most} pairs of detections that may overlap", "more")
    own_noise = frame.position_covariance is not None or table.noise_grows
    measurements = Measurements(
        np.empty((kept, PLAIN + 3 if own_noise else PLAIN)),  # position
        np.empty(kept),  # yaw
        np.empty((kept, 2)),  # velocity
        np.empty((kept, 4)),  # auxiliary
        np.empty(kept),  # score
        np.empty(kept, INDEX),  # label
        np.empty(kept, INDEX),  # source
    )
    gather(
        chosen,
        frame.center,
        frame.size,
        frame.yaw,
        frame.velocity,
        frame.score,
        frame.label,
        frame.source,
        measurements.position,
        measurements.yaw,
        measurements.velocity,
        measurements.auxiliary,
        measurements.score,
        measurements.label,
        measurements.source,
    )
    if own_noise:
        measurements.position[:, PLAIN:] = relative_noise(frame, chosen[:kept], table)
    return measurements, count - above, above - kept


@kernel
def select(
    center: Array,
    size: Array,
    yaw: Array,
    score: Array,
    label: Index,
    source: Index,
    score_filter: Array,
    nms_iou: Array,
    group: Index,
    chosen: Index,
    most: int = UNLIMITED,
) -> tuple[int, int]:
    """Write the rows of the measurements, in their order, to the front of `chosen` (M,).

    Returns:
        How many rows pass the score filter, and how many of those the suppression too; -1 when more than `most` pairs
        of boxes had to be looked at.
    """
    above = 0
    for m in range(score.shape[0]):
        if score[m] >= score_filter[label[m]]:
            chosen[above] = m
            above += 1
    order = chosen[:above]
    sort_canonically(order, score, center, size, yaw, source)
    boxes = np.empty((above, 5))
    ordered_label = np.empty(above, np.int64)
    for k in range(above):
        m = order[k]
        boxes[k, 0], boxes[k, 1], boxes[k, 2], boxes[k, 3] = center[m, 0], center[m, 1], size[m, 0], size[m, 1]
        boxes[k, 4] = yaw[m]
        ordered_label[k] = label[m]
    keep = non_maximum_suppression(boxes, ordered_label, nms_iou, group, most)
    if keep.shape[0] < above:
        return above, -1
    kept = 0
    for k in range(above):
        if keep[k]:
            chosen[kept] = chosen[k]
            kept += 1
    return above, kept


@kernel
def precedes(m: int, n: int, score: Array, center: Array, size: Array, yaw: Array, source: Index) -> bool:
    """Tell whether detection m stands before n: by falling score, then by coordinates, size, yaw and place."""
    if score[m] != score[n]:
        return bool(score[m] > score[n])
    for s in range(3):
        if center[m, s] != center[n, s]:
            return bool(center[m, s] < center[n, s])
    for s in range(3):
        if size[m, s] != size[n, s]:
            return bool(size[m, s] < size[n, s])
    if yaw[m] != yaw[n]:
        return bool(yaw[m] < yaw[n])
    return bool(source[m] < source[n])


@kernel
def sort_canonically(order: Index, score: Array, center: Array, size: Array, yaw: Array, source: Index) -> None:
    """Sort the rows in `order` in place by `precedes`: a merge sort, runs of 1, 2, 4 … rows at a time."""
    count = order.shape[0]
    merged = np.empty(count, np.int64)
    width = 1
    while width < count:
        for begin in range(0, count, 2 * width):
            middle, end = min(begin + width, count), min(begin + 2 * width, count)
            left, right = begin, middle
            for k in range(begin, end):
                if right == end or (
                    left < middle and not precedes(order[right], order[left], score, center, size, yaw, source)
                ):
                    merged[k] = order[left]
                    left += 1
                else:
                    merged[k] = order[right]
                    right += 1
        order[:] = merged
        width *= 2


@kernel
def non_maximum_suppression(
    boxes: Array, label: Index, threshold: Array, group: Index, most: int = UNLIMITED
) -> NDArray[np.bool_]:
    """Keep each box unless a kept box of its group before it overlaps it by more than the threshold of its class.

    Args:
        boxes: (M, 5) bird's-eye boxes, best first.
        label: (M,) class of each.
        threshold: (C,) eta_iou of each class.
        group: (C,) group of each class.
        most: pairs of boxes whose overlap is computed before it gives up.

    Returns:
        (M,) whether the box is kept; empty after giving up.
    """
    count, left = boxes.shape[0], most
    keep = np.ones(count, np.bool_)
    radius = np.empty(count)
    widest = np.zeros(threshold.shape[0])
    for m in range(count):
        radius[m] = 0.5 * math.hypot(boxes[m, 2], boxes[m, 3])
        g = group[label[m]]
        widest[g] = max(widest[g], radius[m])
    # Only kept boxes stand in the torus; the cells of a group are as wide as two of its boxes reach.
    head, following, side = empty_torus(count)
    for m in range(count):
        g = group[label[m]]
        cell_size = 2.0 * widest[g]
        first_x, last_x, first_y, last_y = block(boxes[m, 0], boxes[m, 1], radius[m] + widest[g], cell_size)
        for i in range(first_x, last_x + 1):
            for j in range(first_y, last_y + 1):
                k = head[(i & (side - 1)) * side + (j & (side - 1))]
                while k != NOBODY and keep[m]:
                    if group[label[k]] == g:
                        dx, dy, reach = boxes[k, 0] - boxes[m, 0], boxes[k, 1] - boxes[m, 1], radius[k] + radius[m]
                        if dx * dx + dy * dy < reach * reach:
                            left -= 1
                            if left < 0:
                                return keep[:0]
                            keep[m] = not iou_exceeds(boxes[k], boxes[m], threshold[label[m]])
                    k = following[k]
        if keep[m]:
            insert(head, following, side, m, boxes[m, 0], boxes[m, 1], cell_size)
    return keep


@kernel
def gather(
    chosen: Index,
    center: Array,
    size: Array,
    yaw: Array,
    velocity: Array,
    score: Array,
    label: Index,
    source: Index,
    position_out: Array,
    yaw_out: Array,
    velocity_out: Array,
    auxiliary_out: Array,
    score_out: Array,
    label_out: Index,
    source_out: Index,
) -> None:
    """Copy the chosen detections to the columns of `Measurements`."""
    for k in range(score_out.shape[0]):
        m = chosen[k]
        for s in range(2):
            position_out[k, s] = center[m, s]
            velocity_out[k, s] = velocity[m, s]
        for s in range(3):
            auxiliary_out[k, s] = size[m, s]
        auxiliary_out[k, 3] = center[m, 2]
        yaw_out[k], score_out[k], label_out[k], source_out[k] = yaw[m], score[m], label[m], source[m]
