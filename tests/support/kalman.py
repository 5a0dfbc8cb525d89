"""A tracker of Kalman filters, the baseline of 3D tracking (AB3DMOT: Weng et al., 2020, arXiv 2008.08063).

Written from the paper and its published parameters for PointRCNN. Each track is a box [x, y, z, yaw, length, width,
height] with a constant velocity per frame; measured states start with variance 10 and gain 1 a frame, velocities start
with 10000 and gain 0.01, detections have variance 1. Detections are assigned by generalised intersection over union or
by the distance of centres, all at once or the best pair first. A box is written from the third detection on (a
pedestrian from the first), and for a frame or three after the last one, with the log odds of its latest detection. It
works in the world frame, which is what its compensation of the camera's own motion comes to.
"""

from dataclasses import dataclass

import numpy as np
from boxes import Row, table_of
from numpy.typing import NDArray
from optipmb_tools.evaluation.overlap import intersection_area
from optipmb_tools.geometry import box_corners, wrap_angle
from optipmb_tools.results import ResultTable
from optipmb_tools.tuning.clips import Clip
from scipy.optimize import linear_sum_assignment

Array = NDArray[np.float64]

MEASURED, STATES = 7, 10
YAW = 3
SIZE = slice(4, 7)
FAR = 1e9
SURE = 1e-6
STEP = np.eye(STATES)
STEP[[0, 1, 2], [7, 8, 9]] = 1.0
GAINED = np.diag([1.0] * MEASURED + [0.01] * 3)
START = np.diag([10.0] * MEASURED + [10_000.0] * 3)


@dataclass(frozen=True)
class Habits:
    at_once: bool
    """All detections are assigned together; else the best pair first."""
    by_overlap: bool
    """By generalised intersection over union; else by the distance of centres."""
    limit: float
    """Least overlap, or farthest distance in metres."""
    hits: int
    """Detections before a box is written."""
    patience: int
    """Frames without a detection after which a track ends."""


HABITS = {
    "Car": Habits(at_once=True, by_overlap=True, limit=-0.2, hits=3, patience=2),
    "Pedestrian": Habits(at_once=False, by_overlap=True, limit=-0.4, hits=1, patience=4),
    "Cyclist": Habits(at_once=True, by_overlap=False, limit=2.0, hits=3, patience=4),
}


@dataclass
class _Track:
    id: int
    state: Array
    covariance: Array
    score: float
    hits: int = 1
    missed: int = 0


def kalman_tracks(clip: Clip, name: str) -> ResultTable:
    habits = HABITS[name]
    tracks: list[_Track] = []
    rows: list[Row] = []
    count = 0
    for index, frame in enumerate(clip.frames):
        boxes = np.column_stack([frame.center, frame.yaw, frame.size])
        odds = np.log(np.clip(frame.score, SURE, 1.0 - SURE))
        odds -= np.log1p(-np.clip(frame.score, SURE, 1.0 - SURE))
        for track in tracks:
            track.state = STEP @ track.state
            track.covariance = STEP @ track.covariance @ STEP.T + GAINED
            track.missed += 1
        free = set(range(len(boxes)))
        for m, n in _assigned(
            boxes, np.array([track.state[:MEASURED] for track in tracks]).reshape(-1, MEASURED), habits
        ):
            _update(tracks[n], boxes[m], float(odds[m]))
            free.discard(m)
        for m in sorted(free):
            count += 1
            tracks.append(_Track(count, np.append(boxes[m], np.zeros(3)), START.copy(), float(odds[m])))
        for track in tracks:
            if track.missed < habits.patience and (track.hits >= habits.hits or index < habits.hits):
                box = track.state
                rows.append((index, track.id, box[:3].copy(), box[SIZE].copy(), float(box[YAW]), track.score))
        tracks = [track for track in tracks if track.missed < habits.patience]
    return table_of(clip, name, rows)


def _update(track: _Track, box: Array, score: float) -> None:
    gain = track.covariance[:, :MEASURED] @ np.linalg.inv(track.covariance[:MEASURED, :MEASURED] + np.eye(MEASURED))
    error = box - track.state[:MEASURED]
    error[YAW] = (error[YAW] + 0.5 * np.pi) % np.pi - 0.5 * np.pi  # a box may be turned round
    track.state = track.state + gain @ error
    if abs(wrap_angle(box[YAW] - track.state[YAW])) > 0.5 * np.pi:
        track.state[YAW] += np.pi
    track.state[YAW] = wrap_angle(track.state[YAW])
    track.covariance = track.covariance - gain @ track.covariance[:MEASURED]
    track.score, track.missed, track.hits = score, 0, track.hits + 1


def _assigned(boxes: Array, tracks: Array, habits: Habits) -> list[tuple[int, int]]:
    if not len(boxes) or not len(tracks):
        return []
    apart = np.linalg.norm(boxes[:, None, :3] - tracks[None, :, :3], axis=2)
    worth = generalised_overlap(boxes, tracks, apart) if habits.by_overlap else -apart
    limit = habits.limit if habits.by_overlap else -habits.limit
    if habits.at_once:
        pairs = zip(*(side.tolist() for side in linear_sum_assignment(-worth)), strict=True)
        return [(m, n) for m, n in pairs if worth[m, n] >= limit]
    found: list[tuple[int, int]] = []
    while worth.max() >= limit:
        m, n = divmod(int(worth.argmax()), worth.shape[1])
        found.append((m, n))
        worth[m], worth[:, n] = -FAR, -FAR
    return found


def generalised_overlap(boxes: Array, tracks: Array, apart: Array) -> Array:
    """Return 3D GIoU (M, N): the overlap, less the share of the hull of both that neither fills; -1 where far apart."""
    worth = np.full(apart.shape, -1.0)
    reach = 0.5 * (np.linalg.norm(boxes[:, None, SIZE], axis=2) + np.linalg.norm(tracks[None, :, SIZE], axis=2))
    m, n = np.nonzero(apart < 3.0 * reach)  # beyond, the hull is more than twice what fills it
    first, second = ((side[:, :3], side[:, SIZE], side[:, YAW]) for side in (boxes[m], tracks[n]))
    low = [center[:, 2] - 0.5 * size[:, 2] for center, size, _ in (first, second)]
    high = [center[:, 2] + 0.5 * size[:, 2] for center, size, _ in (first, second)]
    common = np.zeros(len(m))
    meet = apart[m, n] < reach[m, n]
    common[meet] = intersection_area(*(tuple(column[meet] for column in side) for side in (first, second)))
    common *= np.maximum(np.minimum(*high) - np.maximum(*low), 0.0)
    filled = np.prod(boxes[m][:, SIZE], axis=1) + np.prod(tracks[n][:, SIZE], axis=1) - common
    outlines = np.concatenate([box_corners(*side)[:, :4, :2] for side in (first, second)], axis=1)
    hull = hull_area(outlines) * (np.maximum(*high) - np.minimum(*low))
    worth[m, n] = common / filled - (hull - filled) / np.maximum(hull, 1e-9)
    return worth


def hull_area(points: Array) -> Array:
    """Return the areas (N,) of the convex hulls of points (N, K, 2), of which no three lie on a line.

    The way from one point to another is an edge of the hull if no point is to the right of it.
    """
    x, y = points[..., 0], points[..., 1]
    dx, dy = x[:, None, :] - x[:, :, None], y[:, None, :] - y[:, :, None]
    left = dx[:, :, :, None] * dy[:, :, None, :] - dy[:, :, :, None] * dx[:, :, None, :]
    edge = (left >= 0.0).all(axis=3)
    area: Array = 0.5 * (edge * (x[:, :, None] * dy - y[:, :, None] * dx)).sum(axis=(1, 2))
    return area
