"""What is compared: the truth and the tracks of one class in one sequence, and how well each pair of them agrees.

Conventions: truth and tracks are in the same frame of reference, whichever that is. A cost is smaller for better pairs:
one minus the intersection over union of the boxes (in space, or in the image), or the distance of the centres in the
plane in metres. Pairs are prepared once; every metric, and every threshold on scores, works on them.
"""

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from optipmb_client.datasets import DatasetError, Truth
from optipmb_client.evaluation.overlap import iou_2d, iou_3d
from optipmb_client.geometry import Bools, Floats, Ints
from optipmb_client.results import ResultTable

_DECIMALS = 12

Measure = Literal["iou_3d", "iou_2d", "distance"]


@dataclass(frozen=True)
class Rules:
    """How truth and tracks are compared."""

    measure: Measure = "iou_3d"
    limit: float = 0.25
    """Least intersection over union, or largest distance in metres, of a pair that may match."""
    continuity: bool = True
    """A truth object stays with the track it matched last as long as the two may match; otherwise each frame is matched
    on its own."""
    memory: bool = True
    """A change of the track's id also counts when frames lie between in which the object was missed or ignored."""
    neighbours: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """Class -> classes alike, whose truth objects are ignored: matched by tracks of the class without counting."""
    min_height: float | None = None
    """Unmatched tracks whose image box is at most so high, in pixels, do not count as false."""
    regions: bool = False
    """Unmatched tracks more than half of whose image box lies in a region without annotations do not count as false."""


@dataclass(frozen=True)
class Case:
    """One class in one sequence; rows are ordered by frame."""

    sequence: str
    truth_frame: Ints
    """(T,)"""
    truth_id: Ints
    """(T,)"""
    ignored: Bools
    """(T,) truth that is neither to be found nor wrong to find."""
    track_frame: Ints
    """(K,)"""
    track_id: Ints
    """(K,)"""
    excused: Bools
    """(K,) tracks that are not false when nothing matches them."""
    track_score: Floats
    """(K,)"""
    truth_row: Ints
    """(P,) of the pairs that may match"""
    track_row: Ints
    """(P,)"""
    cost: Floats
    """(P,)"""
    similarity: Floats
    """(P,) what is averaged for MOTP: the intersection over union, or the distance."""

    def keep(self, tracks: Bools) -> "Case":
        """Return the case with only some of its track rows (K,)."""
        place = np.cumsum(tracks) - 1
        pairs = tracks[self.track_row]
        return replace(
            self,
            track_frame=self.track_frame[tracks],
            track_id=self.track_id[tracks],
            excused=self.excused[tracks],
            track_score=self.track_score[tracks],
            truth_row=self.truth_row[pairs],
            track_row=place[self.track_row[pairs]].astype(np.int64),
            cost=self.cost[pairs],
            similarity=self.similarity[pairs],
        )

    def mean_scores(self) -> Floats:
        """Return for each track row (K,) the mean score of its whole track."""
        _, which = np.unique(self.track_id, return_inverse=True)
        count = np.bincount(which)
        # Tracks of equal scores are to have equal means, whatever summing them up has rounded.
        return np.round(np.bincount(which, self.track_score) / np.maximum(count, 1), _DECIMALS)[which]


def prepare(truth: Truth, tracks: ResultTable, name: str, rules: Rules, sequence: str = "") -> Case:
    """Return the case of one class.

    Args:
        truth: annotations of a sequence.
        tracks: results for it, in the same frame of reference.
        name: the class.
        rules: how to compare.
        sequence: the name of the sequence, for reports.

    Raises:
        DatasetError: overlaps are asked for of boxes without size or heading.

    """
    shapes = (truth.size, truth.yaw, tracks.size, tracks.yaw)
    if rules.measure == "iou_3d" and any(np.isnan(one).any() for one in shapes):
        raise DatasetError("--iou", "truth and tracks with sizes and headings (--distance compares centres)", "centres")
    alike = (name, *rules.neighbours.get(name, ()))
    wanted = truth.take(np.isin(truth.names, alike))
    wanted = wanted.take(np.argsort(wanted.frame, kind="stable"))
    found = tracks.of_class(name)
    if truth.labelled is not None:
        found = found.take(truth.labelled[found.frame])
    found = found.take(np.argsort(found.frame, kind="stable"))
    truth_row, track_row = _same_frame(wanted.frame, found.frame)
    if rules.measure == "iou_3d":
        similarity = iou_3d(
            (wanted.center[truth_row], wanted.size[truth_row], wanted.yaw[truth_row]),
            (found.center[track_row], found.size[track_row], found.yaw[track_row]),
        )
        cost = 1.0 - similarity
        near = similarity >= rules.limit
    elif rules.measure == "iou_2d":
        similarity = iou_2d(wanted.box2d[truth_row], found.box2d[track_row])
        cost = 1.0 - similarity
        near = similarity >= rules.limit
    else:
        similarity = np.linalg.norm(wanted.center[truth_row, :2] - found.center[track_row, :2], axis=1)
        cost = similarity
        near = similarity <= rules.limit
    return Case(
        sequence=sequence,
        truth_frame=wanted.frame,
        truth_id=wanted.id,
        ignored=wanted.ignored | (wanted.names != name),
        track_frame=found.frame,
        track_id=found.id,
        excused=_excused(truth, found, rules),
        track_score=found.score,
        truth_row=truth_row[near],
        track_row=track_row[near],
        cost=cost[near],
        similarity=similarity[near],
    )


def _same_frame(first: Ints, second: Ints) -> tuple[Ints, Ints]:
    """Return the rows of all pairs of equal frames of two ordered columns."""
    start, stop = np.searchsorted(second, first, "left"), np.searchsorted(second, first, "right")
    count = stop - start
    rows = np.repeat(np.arange(len(first)), count)
    begin = np.repeat(np.cumsum(count) - count, count)
    return rows, np.arange(len(rows)) - begin + np.repeat(start, count)


def _excused(truth: Truth, found: ResultTable, rules: Rules) -> Bools:
    box = found.box2d
    excused = np.zeros(len(found), dtype=np.bool_)
    if rules.min_height is not None:
        excused |= box[:, 3] - box[:, 1] <= rules.min_height
    if rules.regions and len(truth.regions.frame):
        order = np.argsort(truth.regions.frame, kind="stable")
        region = truth.regions.box2d[order]
        rows, places = _same_frame(found.frame, truth.regions.frame[order])
        low = np.maximum(box[rows, :2], region[places, :2])
        high = np.minimum(box[rows, 2:], region[places, 2:])
        common = np.prod(np.maximum(high - low, 0.0), axis=1)
        area = np.prod(np.maximum(box[rows, 2:] - box[rows, :2], 0.0), axis=1)
        excused[rows[common > 0.5 * area]] = True
    return excused
