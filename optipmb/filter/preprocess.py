"""From detections to measurements: canonical order, score filter and non-maximum suppression (Section IV.A).

Measurements are sorted (best score first, then by coordinates), so that no result depends on the order in which a
detector lists its boxes.

People walk side by side, and their boxes overlap as two boxes of one person do (not in the paper). A detector is seldom
sure of a second box of the same object. Where `sure_nms_iou` is more than eta_iou, boxes that overlap a better one by
more than `sure_nms_iou` go first. Of the others, those go that overlap a better one that stays by more than eta_iou,
unless the scores of both are high, ``z_s z_s' >= SURE_OF_BOTH``. Points have no size to overlap with: two of high
scores may have boxes of the usual size that overlap by `SAME_PLACE`.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from optipmb.compiled import kernel
from optipmb.filter.geometry import END_OF_CHAIN, block, boxes_overlap, empty_torus, insert
from optipmb.filter.hypotheses import UNLIMITED
from optipmb.model.errors import EffortError
from optipmb.model.frame import PLAIN
from optipmb.model.rows import read_only
from optipmb.model.stages import Measurements
from optipmb.model.table import known_length

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb.model.frame import Frame
    from optipmb.model.rows import Array, Columns, Index
    from optipmb.model.table import Classes, ClassRow, ClassTable


def preprocess(
    frame: Frame, table: ClassTable, most: int = UNLIMITED, score: Array | None = None
) -> tuple[Measurements, Index, int, int]:
    """Remove detections scored below eta_sf, then detections that overlap a better one by more than eta_iou.

    They are compared within their class, or within its group where `suppress_in_group` is on. `score` (M,) replaces the
    scores of the frame.

    Returns:
        The measurements, their rows in the frame, the number below the score filter and the number suppressed.

    Raises:
        EffortError: more than `most` pairs of detections may overlap.
    """
    own_noise = NO_NOISE if frame.position_covariance is None else frame.position_covariance
    if score is None:
        score = frame.score
    given = frame.center, frame.size, frame.yaw, frame.velocity, score, frame.label, frame.source
    above, chosen, columns = select(given, own_noise, table.classes, most)
    if above < 0:
        raise EffortError("center", f"at most {most} pairs of detections that may overlap", "more")
    return Measurements(*columns), chosen, frame.score.shape[0] - above, above - chosen.shape[0]


NO_NOISE: Final = read_only(np.zeros((0, 3)))
"""In place of the covariances of the positions of a frame where it has none."""


@kernel
def select(detections: Columns, own_noise: Array, classes: Classes, most: int) -> tuple[int, Index, Columns]:
    """Choose the detections that are measurements, of center, size, yaw, velocity, score, label and source of all.

    `own_noise` (M, 3) are the covariances of their positions, or (0, 3).

    Returns:
        How many detections pass the score filter, or -1 when more than `most` pairs of boxes had to be compared; the
        rows that pass the suppression too, in their order; their columns of `Measurements`.
    """
    center, size, yaw, velocity, score, label, source = detections
    chosen = np.empty(score.shape[0], np.int64)
    above = 0
    for m in range(score.shape[0]):
        if score[m] >= classes[label[m]].score_filter:
            chosen[above] = m
            above += 1
    order = chosen[:above]
    sort_canonically(order, score, center, size, yaw, source)
    boxes, ordered_score = np.empty((above, 5)), np.empty(above)
    ordered_label, points = np.empty(above, np.int64), np.empty(above, np.bool_)
    for k in range(above):
        m = order[k]
        points[k] = math.isnan(size[m, 0]) and math.isnan(size[m, 1])
        boxes[k, 0], boxes[k, 1], boxes[k, 4] = center[m, 0], center[m, 1], yaw[m]
        for s in range(2):
            boxes[k, 2 + s] = known_length(size[m, s], s, classes[label[m]])
        ordered_score[k], ordered_label[k] = score[m], label[m]
    keep = non_maximum_suppression(boxes, ordered_score, ordered_label, points, classes, most)
    if keep.shape[0] < above:
        above = -1
    kept = 0
    for k in range(above):
        if keep[k]:
            chosen[kept] = chosen[k]
            kept += 1
    width = PLAIN + 3 if own_noise.shape[0] > 0 else PLAIN
    for k in range(kept):
        if long_for_noise(size[chosen[k], 0], classes[label[chosen[k]]]):
            width = PLAIN + 3
    position, velocity_out, auxiliary = np.empty((kept, width)), np.empty((kept, 2)), np.empty((kept, 4))
    yaw_out, score_out = np.empty(kept), np.empty(kept)
    label_out, source_out = np.empty(kept, np.int64), np.empty(kept, np.int64)
    for k in range(kept):
        m = chosen[k]
        for s in range(2):
            position[k, s], velocity_out[k, s] = center[m, s], velocity[m, s]
        if width > PLAIN:
            noise = own_noise[m] if own_noise.shape[0] > 0 else UNKNOWN_NOISE
            write_noise(noise, size[m, 0], yaw[m], classes[label[m]], position[k])
        for s in range(3):
            auxiliary[k, s] = size[m, s]
        auxiliary[k, 3] = center[m, 2]
        yaw_out[k], score_out[k], label_out[k], source_out[k] = yaw[m], score[m], label[m], source[m]
    return above, chosen[:kept], (position, yaw_out, velocity_out, auxiliary, score_out, label_out, source_out)


UNKNOWN_NOISE: Final = np.full(3, np.nan)


@kernel
def long_for_noise(length: float, own: ClassRow) -> bool:
    """Tell whether the error along an object of a length, m, is more than that of its class; NaN is not."""
    return own.noise_length * length > own.noise_position


@kernel
def write_noise(noise: Array, length: float, yaw: float, own: ClassRow, position: Array) -> None:
    """Write the covariance of a detection, relative to R_xy of its class, behind its position.

    That is `noise`, R_xx, R_xy and R_yy in m^2, where it is known. Else the centre of an object of length L is off
    along its heading, the unit vector a, by kappa L with kappa = `noise_length`, where that is more than sigma:

        R_xy = sigma^2 I + (kappa^2 L^2 - sigma^2) a a^T        (extends eq. Single Object Measurement Model)

    and R_xy = kappa^2 L^2 I where the heading is not known.
    """
    variance = own.noise_position * own.noise_position
    if not math.isnan(noise[0]):
        for s in range(3):
            position[PLAIN + s] = noise[s] / variance
        return
    position[PLAIN], position[PLAIN + 1], position[PLAIN + 2] = 1.0, 0.0, 1.0
    if not long_for_noise(length, own):
        return
    more = (own.noise_length * length) ** 2 / variance - 1.0
    if math.isnan(yaw):
        position[PLAIN], position[PLAIN + 2] = 1.0 + more, 1.0 + more
        return
    cos, sin = math.cos(yaw), math.sin(yaw)
    position[PLAIN] += more * cos * cos
    position[PLAIN + 1] = more * cos * sin
    position[PLAIN + 2] += more * sin * sin


@kernel
def precedes(m: int, n: int, score: Array, center: Array, size: Array, yaw: Array, source: Index) -> bool:
    """Tell whether detection m comes before n: by falling score, then by coordinates, size, yaw and place."""
    if score[m] != score[n]:
        return bool(score[m] > score[n])
    for s in range(3):
        if differ(center[m, s], center[n, s]):
            return below(center[m, s], center[n, s])
    for s in range(3):
        if differ(size[m, s], size[n, s]):
            return below(size[m, s], size[n, s])
    if differ(yaw[m], yaw[n]):
        return below(yaw[m], yaw[n])
    return bool(source[m] < source[n])


@kernel
def differ(one: float, other: float) -> bool:
    """Tell whether two numbers differ, where NaN equals NaN."""
    return one != other and not (math.isnan(one) and math.isnan(other))


@kernel
def below(one: float, other: float) -> bool:
    """Tell whether a number is below another one, NaN above all."""
    return one < other or math.isnan(other)


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
        for k in range(count):  # a slice would bring in the text of numba's error about shapes: 4 s of compilation
            order[k] = merged[k]
        width *= 2


SURE_OF_BOTH: Final = 0.64
"""Product of two scores from which they are of two objects: 0.8 each."""

SAME_PLACE: Final = 0.5
"""Overlap of two boxes of the usual size from which two sure points are at one place."""


@kernel
def non_maximum_suppression(
    boxes: Array, score: Array, label: Index, points: NDArray[np.bool_], classes: Classes, most: int
) -> NDArray[np.bool_]:
    """Keep each box unless a better one of its group overlaps it by more than the threshold of its class.

    `boxes` (M, 5) are bird's-eye boxes, best first, with `score` (M,); `points` (M,) tells whose size is not known.

    Returns:
        (M,) whether the box is kept; empty where more than `most` overlaps had to be computed.
    """
    count, left = boxes.shape[0], most
    keep = np.ones(count, np.bool_)
    radius = np.empty(count)
    widest = np.zeros(len(classes))
    for m in range(count):
        radius[m] = 0.5 * math.hypot(boxes[m, 2], boxes[m, 3])
        g = classes[label[m]].suppressed_with
        widest[g] = max(widest[g], radius[m])
    # The torus has the boxes that overlap none in it too much; the cells of a group are as wide as two of them reach.
    head, following, side = empty_torus(count)
    for m in range(count):
        own, stands = classes[label[m]], True
        g, widest_overlap = own.suppressed_with, max(own.nms_iou, own.sure_nms_iou)
        cell_size = 2.0 * widest[g]
        first_x, last_x, first_y, last_y = block(boxes[m, 0], boxes[m, 1], radius[m] + widest[g], cell_size)
        for i in range(first_x, last_x + 1):
            for j in range(first_y, last_y + 1):
                k = head[(i & (side - 1)) * side + (j & (side - 1))]
                while k != END_OF_CHAIN and stands:
                    if classes[label[k]].suppressed_with == g:
                        dx, dy, reach = boxes[k, 0] - boxes[m, 0], boxes[k, 1] - boxes[m, 1], radius[k] + radius[m]
                        if dx * dx + dy * dy < reach * reach:
                            left -= 1
                            if left < 0:
                                return keep[:0]
                            sure = own.nms_iou < widest_overlap and score[k] * score[m] >= SURE_OF_BOTH
                            limit = (
                                max(widest_overlap, SAME_PLACE) if sure and points[k] and points[m] else widest_overlap
                            )
                            stands = not boxes_overlap(boxes[k], boxes[m], limit)
                            unsure = own.nms_iou < widest_overlap and not sure
                            if unsure and stands and keep[k] and keep[m]:
                                keep[m] = not boxes_overlap(boxes[k], boxes[m], own.nms_iou)
                    k = following[k]
        if stands:
            insert(head, following, side, m, boxes[m, 0], boxes[m, 1], cell_size)
        else:
            keep[m] = False
    return keep
