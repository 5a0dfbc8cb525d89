"""What the nuScenes tracking benchmark compares in one scene: its truth and the tracks, after the official filters.

Conventions: global frame, metres; only the centres of boxes matter. Stamps are microseconds. Rows are ordered by frame;
within a frame the boxes that were given come first, as they were given, and the interpolated ones follow.

The filters, for truth and tracks alike: a box must be nearer to the car than the range of its class; bicycles and
motorcycles whose centre lies in an annotated bicycle rack are dropped. Truth without LiDAR and radar points is dropped
as well. Then every object and every track is filled in between its first and its last remaining box.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from optipmb_client.datasets.nuscenes import CLASS_RANGE, NuScenesSequence, tracking_labels
from optipmb_client.geometry import Bools, Floats, Ints, rotation_of
from optipmb_client.results import ResultTable
from optipmb_client.results.nuscenes import NUSCENES_CLASSES

RACK = "static_object.bicycle_rack"
_RACKED = ("bicycle", "motorcycle")


@dataclass(frozen=True)
class NuScenesConfig:
    """The settings of the benchmark; the defaults are the official ones (tracking_nips_2019)."""

    class_range: Mapping[str, float] = field(default_factory=lambda: dict(CLASS_RANGE))
    """Metres from the car, by class; its classes are those that are evaluated."""
    match_distance: float = 2.0
    """Metres in the plane below which a track may match an object."""
    min_recall: float = 0.1
    """The lowest recall at which MOTAR and MOTP are taken."""
    thresholds: int = 40
    """Number of recalls from there to 1."""
    worst_motp: float = 2.0
    """What counts for MOTP at recalls that are not reached."""


@dataclass(frozen=True)
class TrackBoxes:
    """Boxes of one scene that have an id: annotated objects or tracks."""

    frame: Ints
    """(R,)"""
    id: Ints
    """(R,)"""
    label: Ints
    """(R,) index into `NUSCENES_CLASSES`."""
    center: Floats
    """(R, 3)"""
    score: Floats
    """(R,) mean score of the track; NaN for truth."""

    def __len__(self) -> int:
        return len(self.frame)

    def take(self, rows: Ints | Bools) -> "TrackBoxes":
        """Return the chosen rows."""
        return TrackBoxes(self.frame[rows], self.id[rows], self.label[rows], self.center[rows], self.score[rows])


@dataclass(frozen=True)
class Racks:
    """Annotated bicycle racks."""

    frame: Ints
    """(B,)"""
    center: Floats
    """(B, 3)"""
    size: Floats
    """(B, 3) length, width, height"""
    rotation: Floats
    """(B, 3, 3) world from rack"""

    def hold(self, frame: Ints, center: Floats) -> Bools:
        """Return which places (R, 3) lie in a rack of their frame (R,)."""
        held = np.zeros(len(frame), dtype=np.bool_)
        for when, middle, size, rotation in zip(self.frame, self.center, self.size, self.rotation, strict=True):
            rows = np.flatnonzero(frame == when)
            held[rows] |= (np.abs((center[rows] - middle) @ rotation) <= 0.5 * size).all(axis=1)
        return held


@dataclass(frozen=True)
class NuScenesScene:
    """The truth of one scene, ready to be compared with any number of results."""

    name: str
    stamp_us: Ints
    """(F,)"""
    ego: Floats
    """(F, 2) where the car was."""
    racks: Racks
    truth: TrackBoxes

    def tracks(self, table: ResultTable, config: NuScenesConfig) -> TrackBoxes:
        """Return results in the world frame, filtered, filled in and with the mean score of each track.

        Rows of classes that are not evaluated are dropped.
        """
        code = {name: i for i, name in enumerate(NUSCENES_CLASSES)}
        label = np.array([code.get(name, -1) for name in table.labels] or [-1], dtype=np.int64)
        label = label[table.label] if len(table) else np.empty(0, dtype=np.int64)
        boxes = TrackBoxes(table.frame, table.id, label, table.center, table.score)
        boxes = boxes.take(np.argsort(boxes.frame, kind="stable"))
        boxes = boxes.take(boxes.label >= 0)
        boxes = boxes.take(_counted(boxes, self.ego, self.racks, config))
        return interpolate(replace(boxes, score=mean_scores(boxes)), self.stamp_us)


def prepare_scene(sequence: NuScenesSequence, config: NuScenesConfig) -> NuScenesScene:
    """Return the truth of a scene, filtered and filled in."""
    table = sequence.annotations()
    ego = np.array([pose.translation[:2] for pose in sequence.ego_poses]).reshape(-1, 2)
    found = np.flatnonzero([name == RACK for name in table.category])
    racks = Racks(
        frame=table.frame[found],
        center=table.center[found],
        size=table.size[found],
        rotation=np.array([rotation_of(quaternion) for quaternion in table.rotation[found]]).reshape(-1, 3, 3),
    )
    kept, label = tracking_labels(table)
    boxes = TrackBoxes(table.frame[kept], table.instance[kept], label, table.center[kept], np.full(len(label), np.nan))
    seen = (table.lidar_points + table.radar_points)[kept] != 0
    boxes = boxes.take(seen & _counted(boxes, ego, racks, config))
    return NuScenesScene(sequence.name, sequence.stamp_us, ego, racks, interpolate(boxes, sequence.stamp_us))


def _counted(boxes: TrackBoxes, ego: Floats, racks: Racks, config: NuScenesConfig) -> Bools:
    """Return which boxes (R,) are in range and not in a rack."""
    reach = np.array([config.class_range.get(name, 0.0) for name in NUSCENES_CLASSES])[boxes.label]
    near = np.linalg.norm(boxes.center[:, :2] - ego[boxes.frame], axis=1) < reach
    racked = np.isin(boxes.label, [NUSCENES_CLASSES.index(name) for name in _RACKED])
    return np.asarray(near & ~(racked & racks.hold(boxes.frame, boxes.center)), dtype=np.bool_)


def mean_scores(boxes: TrackBoxes) -> Floats:
    """Return for each row (R,) the mean score of its whole track."""
    mean = np.empty(len(boxes))
    for rows in _by_track(boxes.id):
        # One by one, not by sums: thresholds are compared with these means, so even their rounding is the official one.
        mean[rows] = np.mean(boxes.score[rows])
    return mean


def _by_track(identity: Ints) -> list[Ints]:
    order = np.argsort(identity, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(identity[order])) + 1) if len(order) else []


def interpolate(boxes: TrackBoxes, stamp_us: Ints) -> TrackBoxes:
    """Return the boxes with those between that are missing: every id is in all frames from its first to its last.

    A missing box lies on the line between its neighbours in time. The official tools weigh the later neighbour by how
    far it is away instead of by how near; this does as they do, for only so the figures can be compared. For a single
    missing frame, the usual case, both come to nearly the same. Its class is that of the later neighbour.

    Args:
        boxes: ordered by frame; an id at most once in a frame.
        stamp_us: (F,) microseconds.

    """
    _, first, which = np.unique(boxes.id, return_index=True, return_inverse=True)
    rank = first[which]  # ids in order of appearance
    order = np.lexsort((boxes.frame, rank))
    left, right = order[:-1], order[1:]
    gap = np.where(rank[left] == rank[right], boxes.frame[right] - boxes.frame[left] - 1, 0)
    left, right = np.repeat(left, gap), np.repeat(right, gap)
    step = np.arange(len(left)) - np.repeat(np.cumsum(gap) - gap, gap)
    frame = boxes.frame[left] + 1 + step
    begin, end = stamp_us[boxes.frame[left]], stamp_us[boxes.frame[right]]
    weight = (end - stamp_us[frame]) / (end - begin)
    added = TrackBoxes(
        frame=frame,
        id=boxes.id[left],
        label=boxes.label[right],
        center=(1.0 - weight)[:, None] * boxes.center[left] + weight[:, None] * boxes.center[right],
        score=(1.0 - weight) * boxes.score[left] + weight * boxes.score[right],
    )
    order = np.lexsort((np.append(np.full(len(boxes), -1), rank[left]), np.append(boxes.frame, added.frame)))
    return TrackBoxes(
        frame=np.append(boxes.frame, added.frame)[order],
        id=np.append(boxes.id, added.id)[order],
        label=np.append(boxes.label, added.label)[order],
        center=np.vstack([boxes.center, added.center])[order],
        score=np.append(boxes.score, added.score)[order],
    )
