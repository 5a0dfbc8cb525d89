"""Truth and tracks of one class in one sequence, how well each pair of boxes agrees, and who belongs to whom.

Conventions: truth and tracks are in the same frame of reference. A cost is smaller for better pairs: one minus the
intersection over union of the boxes (in space, or in the image), or the distance of the centres in the plane in metres.
Pairs are prepared once; every metric, and every threshold on scores, works on them. Pairs that may match are columns:
row (P,) and column (P,) name the truth box and the track box of each pair. Each frame is solved on its own, and in it
each row and each column is taken at most once.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from scipy.optimize import linear_sum_assignment

from optipmb_tools.datasets import DatasetError, Truth
from optipmb_tools.evaluation.overlap import iou_2d, iou_3d
from optipmb_tools.geometry import Bools, Floats, Ints
from optipmb_tools.results import ResultTable, ranks

_EPSILON = float(np.finfo(np.float64).eps)
_HALF = 0.5

Measure = Literal["iou_3d", "iou_2d", "distance"]

CENTRE_DISTANCE = 2.0  # centres farther apart than this, in metres, have no similarity (D_0 of the OptiPMB paper)
IOU_LIMIT = 0.25


@dataclass(frozen=True)
class Rules:
    """How truth and tracks are compared."""

    measure: Measure = "iou_3d"
    limit: float = IOU_LIMIT  # least intersection over union, or largest distance in metres, of a pair that may match
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


_KITTI = Rules(
    continuity=False,
    memory=False,
    neighbours={"Car": ("Van",), "Pedestrian": ("Person", "Person_sitting")},
    min_height=25.0,
    regions=True,
)


def default_rules(dataset: str, measure: Measure | None = None, limit: float | None = None) -> Rules:
    """Return the usual rules of a dataset.

    kitti: AB3DMOT's: 3D intersection over union of a quarter, each frame matched on its own, identity changes counted
    from one frame to the next, vans ignored for cars and sitting persons for pedestrians, no false tracks that are at
    most 25 pixels high or in unannotated regions. Others: centres within 2 metres in the plane, with continuity and
    memory.
    """
    measure = measure or ("iou_3d" if dataset == "kitti" else "distance")
    usual = CENTRE_DISTANCE if measure == "distance" else IOU_LIMIT
    return replace(_KITTI if dataset == "kitti" else Rules(), measure=measure, limit=usual if limit is None else limit)


def ab3dmot_rules(limit: float = IOU_LIMIT) -> Rules:
    """Return the rules of AB3DMOT's protocol for boxes that match from a 3D intersection over union on.

    Persons whom the labels call `Person` are not known to it: a pedestrian track on one is false.
    """
    return replace(_KITTI, limit=limit, neighbours={"Car": ("Van",), "Pedestrian": ("Person_sitting",)})


def hota_2d_rules() -> Rules:
    """Return the rules of KITTI's benchmark for HOTA of image boxes.

    The benchmark ranks cars and pedestrians; cyclists are treated in the same way.
    """
    return replace(_KITTI, measure="iou_2d", limit=0.0)


@dataclass(frozen=True)
class Case:
    """One class in one sequence; rows are ordered by frame."""

    sequence: str
    truth_frame: Ints  # (T,)
    truth_id: Ints  # (T,)
    ignored: Bools  # (T,) truth that is neither to be found nor wrong to find
    track_frame: Ints  # (K,)
    track_id: Ints  # (K,)
    excused: Bools  # (K,) tracks that are not false when nothing matches them
    track_score: Floats  # (K,)
    truth_row: Ints  # (P,) of the pairs that may match
    track_row: Ints  # (P,)
    cost: Floats  # (P,)
    similarity: Floats  # (P,) averaged for MOTP: the intersection over union, or the distance

    @property
    def pair_frame(self) -> Ints:
        """(P,) frame of each pair."""
        return self.truth_frame[self.truth_row]

    def matched(self, match: Ints) -> Bools:
        """Return which pairs (P,) belong to a match (T,) of `match_frames`."""
        return np.asarray(match[self.truth_row] == self.track_row, dtype=np.bool_)

    def pairs(self, kept: Bools) -> "Case":
        """Return the case with only some of its pairs (P,)."""
        columns = ("truth_row", "track_row", "cost", "similarity")
        return replace(self, **{name: getattr(self, name)[kept] for name in columns})

    def keep(self, tracks: Bools) -> "Case":
        """Return the case with only some of its track rows (K,)."""
        left = self.pairs(tracks[self.track_row])
        columns = ("track_frame", "track_id", "excused", "track_score")
        place = np.cumsum(tracks) - 1
        return replace(
            left,
            track_row=place[left.track_row].astype(np.int64),
            **{name: getattr(self, name)[tracks] for name in columns},
        )

    def from_score(self, threshold: float) -> "Case":
        """Return the case with only the tracks whose mean score reaches a threshold."""
        return self.keep(self.mean_scores() >= threshold)

    def mean_scores(self) -> Floats:
        """Return for each track row (K,) the mean score of its whole track."""
        return ranks(self.track_id, self.track_score)


def prepare(truth: Truth, tracks: ResultTable, name: str, rules: Rules, sequence: str = "") -> Case:
    """Return the case of one class; `sequence` is the name in reports.

    Raises:
        DatasetError: overlaps are asked for of boxes without size or heading.
    """
    shapes = (truth.size, truth.yaw, tracks.size, tracks.yaw)
    if rules.measure == "iou_3d" and any(np.isnan(one).any() for one in shapes):
        raise DatasetError("--iou", "truth and tracks with sizes and headings (--distance compares centres)", "centres")
    wanted = truth.take(np.isin(truth.names, (name, *rules.neighbours.get(name, ()))))
    wanted = wanted.take(np.argsort(wanted.frame, kind="stable"))
    found = tracks.of_class(name)
    if truth.labelled is not None:
        found = found.take(truth.labelled[found.frame])
    found = found.take(np.argsort(found.frame, kind="stable"))
    truth_row, track_row = same_frame(wanted.frame, found.frame)
    if rules.measure == "iou_3d":
        similarity = iou_3d(
            (wanted.center[truth_row], wanted.size[truth_row], wanted.yaw[truth_row]),
            (found.center[track_row], found.size[track_row], found.yaw[track_row]),
        )
    elif rules.measure == "iou_2d":
        similarity = iou_2d(wanted.box2d[truth_row], found.box2d[track_row])
    else:
        similarity = np.linalg.norm(wanted.center[truth_row, :2] - found.center[track_row, :2], axis=1)
    apart = rules.measure == "distance"
    return Case(
        sequence=sequence,
        truth_frame=wanted.frame,
        truth_id=wanted.id,
        ignored=wanted.ignored | (wanted.names != name),
        track_frame=found.frame,
        track_id=found.id,
        excused=_excused(truth, found, rules),
        track_score=found.score,
        truth_row=truth_row,
        track_row=track_row,
        cost=similarity if apart else 1.0 - similarity,
        similarity=similarity,
    ).pairs(similarity <= rules.limit if apart else similarity >= rules.limit)


def same_frame(first: Ints, second: Ints) -> tuple[Ints, Ints]:
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
        rows, places = same_frame(found.frame, truth.regions.frame[order])
        low = np.maximum(box[rows, :2], region[places, :2])
        high = np.minimum(box[rows, 2:], region[places, 2:])
        common = np.prod(np.maximum(high - low, 0.0), axis=1)
        area = np.prod(np.maximum(box[rows, 2:] - box[rows, :2], 0.0), axis=1)
        excused[rows[common > 0.5 * area]] = True
    return excused


def similarity(case: Case, rules: Rules) -> Floats:
    """Return the similarity (P,) of the pairs in [0, 1].

    It is the intersection over union; or, with D_0 the distance up to which pairs may match, max(0, 1 - d / D_0).
    """
    scale = rules.limit if rules.measure == "distance" else 1.0
    return np.maximum(0.0, 1.0 - case.cost / scale)


def counted(case: Case, rules: Rules) -> Case:
    """Return the case with what counts; nothing in it is ignored, and nothing excused.

    The rules are those with which the HOTA of KITTI's benchmark is computed (TrackEval), for any similarity in [0, 1].
    In each frame, tracks and truth are matched so that the total similarity of pairs with at least a half is the
    greatest. A track that is matched to ignored truth goes; so does one that is matched to nothing and is excused.
    Ignored truth goes. Unlike the counts of CLEAR MOT and of AB3DMOT this is done once, before anything is measured.
    """
    alike = similarity(case, rules)
    near = case.pairs(alike >= _HALF - _EPSILON)
    taken = assign_frames(near.pair_frame, near.truth_row, near.track_row, alike[alike >= _HALF - _EPSILON], best_pairs)
    gone = case.excused.copy()
    gone[near.track_row[taken]] = case.ignored[near.truth_row[taken]]
    wanted = ~case.ignored
    left = case.keep(~gone)
    left = left.pairs(wanted[left.truth_row])
    place = np.cumsum(wanted) - 1
    return replace(
        left,
        truth_frame=case.truth_frame[wanted],
        truth_id=case.truth_id[wanted],
        ignored=case.ignored[wanted],
        excused=np.zeros(len(left.track_frame), dtype=np.bool_),
        truth_row=place[left.truth_row].astype(np.int64),
    )


Solver = Callable[[Ints, Ints, Floats], Ints]  # Rows, columns and values of pairs -> the indices of those to take


def most_pairs(row: Ints, column: Ints, cost: Floats) -> Ints:
    """Return which pairs to take so that most are taken, and of those ways the one of least total cost."""
    # A pair that may not match costs more than all others together, so it is taken only where nothing else is left.
    return _solve(row, column, cost, 1e6)


def best_pairs(row: Ints, column: Ints, gain: Floats) -> Ints:
    """Return which pairs to take so that their total gain is the greatest; gains are positive."""
    return _solve(row, column, -gain, 0.0)


def _solve(row: Ints, column: Ints, cost: Floats, other: float) -> Ints:
    """Return the pairs of the assignment of least cost when all pairs that are not given cost `other`."""
    row_names, place = np.unique(row, return_inverse=True)
    column_names, where = np.unique(column, return_inverse=True)
    table = np.full((len(row_names), len(column_names)), other)
    table[place, where] = cost
    index = np.full(table.shape, -1, dtype=np.int64)
    index[place, where] = np.arange(len(row))
    taken = index[linear_sum_assignment(table)]
    return np.asarray(taken[taken >= 0], dtype=np.int64)


def uncontested(row: Ints, column: Ints) -> Bools:
    """Return which pairs (P,) share neither their row nor their column with another pair."""
    uses = [np.bincount(names)[names] if len(names) else names for names in (row, column)]
    return np.asarray((uses[0] == 1) & (uses[1] == 1), dtype=np.bool_)


def by_frame(frame: Ints, pairs: Ints) -> list[Ints]:
    """Return the given pairs, each an index into frame (P,), as one array for each frame, in order of frames."""
    order = pairs[np.argsort(frame[pairs], kind="stable")]
    return np.split(order, np.flatnonzero(np.diff(frame[order])) + 1) if len(order) else []


def assign_frames(frame: Ints, row: Ints, column: Ints, value: Floats, solver: Solver) -> Ints:
    """Return the pairs that a solver takes in every frame, in ascending order.

    Args:
        frame: (P,)
        row: (P,) unlike in different frames.
        column: (P,) unlike in different frames.
        value: (P,) cost or gain.
        solver: one that takes every uncontested pair.
    """
    # Most pairs are uncontested and are taken without solving.
    alone = uncontested(row, column)
    contested = by_frame(frame, np.flatnonzero(~alone))
    taken = [pairs[solver(row[pairs], column[pairs], value[pairs])] for pairs in contested]
    return np.sort(np.concatenate([np.flatnonzero(alone), *taken]))


Claim = Literal["latest", "first"]
"""Which of several objects that were with one track keeps it: the one that was last, or the one with the first row."""


def match_frames(case: Case, *, continuity: Claim | None = None) -> Ints:
    """Return the track row (T,) that each truth row matches, -1 for none.

    In each frame the matches of most pairs with the least total cost are taken; with continuity, pairs of an object and
    the track that it matched last are taken first.
    """
    match = np.full(len(case.truth_frame), -1, dtype=np.int64)
    alone = uncontested(case.truth_row, case.track_row)
    match[case.truth_row[alone]] = case.track_row[alone]
    contested = np.flatnonzero(~alone)
    earlier = _earlier_rows(case) if continuity and len(contested) else np.empty(0, dtype=np.int64)
    for pairs in by_frame(case.pair_frame, contested):
        truth, track = case.truth_row[pairs], case.track_row[pairs]
        chosen = np.zeros(len(pairs), dtype=np.bool_)
        if continuity:
            chosen[_continued(case, pairs, match, earlier, continuity)] = True
        free = ~np.isin(truth, truth[chosen]) & ~np.isin(track, track[chosen])
        if free.any():
            chosen[np.flatnonzero(free)[most_pairs(truth[free], track[free], case.cost[pairs][free])]] = True
        match[truth[chosen]] = track[chosen]
    return match


def _continued(case: Case, pairs: Ints, match: Ints, earlier: Ints, claim: Claim) -> list[int]:
    """Return the places of the pairs of one frame that are of an object and the track that it matched last."""
    claims: dict[int, tuple[int, int]] = {}
    rows = zip(case.truth_row[pairs].tolist(), case.track_row[pairs].tolist(), strict=True)
    for place, (truth, track) in enumerate(rows):
        row = int(earlier[truth])
        while row >= 0 and match[row] < 0:
            row = int(earlier[row])
        if row >= 0 and case.track_id[match[row]] == case.track_id[track]:
            frame = int(case.truth_frame[row])
            if track not in claims or (claim == "latest" and frame > claims[track][0]):
                claims[track] = frame, place
    return [place for _, place in claims.values()]


def _earlier_rows(case: Case) -> Ints:
    """Return for each truth row (T,) the row of the same object before it, -1 for the first."""
    order = np.lexsort((case.truth_frame, case.truth_id))
    earlier = np.full(len(order), -1, dtype=np.int64)
    same = case.truth_id[order[1:]] == case.truth_id[order[:-1]]
    earlier[order[1:][same]] = order[:-1][same]
    return earlier


def track_changes(case: Case, match: Ints, counted: Bools, *, memory: bool = True) -> tuple[Ints, Ints]:
    """Return the truth rows (C,) at which an object changes its track, and the rows (C,) of its matches before them.

    Args:
        case: truth and tracks.
        match: (T,) as `match_frames` returns it.
        counted: (T,) truth rows; matches of the others are no matches.
        memory: the match before may be any earlier one; otherwise only the object's previous row counts.
    """
    order = np.lexsort((case.truth_frame, case.truth_id))
    place = np.flatnonzero((counted & (match >= 0))[order])
    before, after = order[place[:-1]], order[place[1:]]
    changed = case.truth_id[before] == case.truth_id[after]
    changed &= case.track_id[match[before]] != case.track_id[match[after]]
    if not memory:
        changed &= np.diff(place) == 1
    return after[changed], before[changed]


@dataclass(frozen=True)
class Lives:
    """How well each object was followed."""

    share: Floats  # (O,) of its boxes that are matched
    delay: Ints  # (O',) boxes before the first match of objects that have one
    longest: Ints  # (O',) the most boxes in a row without a match, of objects that have one
    breaks: int  # times without a match between times with one


def lives(owner: Ints, frame: Ints, matched: Bools) -> Lives:
    """Return how well objects were followed: object, frame and whether it is matched of each box, (R,)."""
    order = np.lexsort((frame, owner))
    _, owner = np.unique(owner[order], return_inverse=True)
    matched = matched[order]
    # Cut into runs of equal state within one object.
    start = np.flatnonzero(np.diff(owner, prepend=-1) | np.diff(matched.astype(np.int64), prepend=-1))
    length = np.diff(np.append(start, len(owner)))
    run_owner, missed = owner[start], ~matched[start]
    first = np.diff(run_owner, prepend=-1) != 0
    last = np.append(first[1:], True)[: len(first)]
    count = np.bincount(owner)
    found = np.bincount(owner, matched, len(count))
    longest, delay = np.zeros((2, len(count)), dtype=np.int64)
    np.maximum.at(longest, run_owner[missed], length[missed])
    delay[run_owner[first & missed]] = length[first & missed]
    return Lives(found / count, delay[found > 0], longest[found > 0], int((missed & ~first & ~last).sum()))
