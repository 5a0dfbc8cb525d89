"""The nuScenes tracking benchmark (tracking_nips_2019): results in the official layout against the official tables.

Scenes. Global frame, metres; only the centres of boxes matter. Stamps are microseconds. Rows are ordered by frame;
within a frame the boxes that were given come first, as they were given, and the interpolated ones follow. The filters,
for truth and tracks alike: a box must be nearer to the car than the range of its class; bicycles and motorcycles whose
centre lies in an annotated bicycle rack are dropped. Truth without LiDAR and radar points is dropped as well. Then
every object and every track is filled in between its first and its last remaining box.

Matching. In a frame, an object keeps the track that it matched last, in any earlier frame, if the two are near enough;
of several objects that claim one track the first has it. The others are matched so that there are as many matches as
possible and their total distance is the least (CLEAR MOT; Bernardin and Stiefelhagen, 2008). A match with another track
than the last one is a switch.

Figures. Counts are of boxes; GT = TP + FN + IDS, for a switch is no true positive here. A figure that is not defined is
NaN. Durations count keyframes of half a second.

    MOTAR = max(0, 1 - (IDS + FP + FN - (1 - r) GT) / (r GT)),  r = TP / GT
    MOTA  = max(0, 1 - (IDS + FP + FN) / GT)
    MOTP  = mean distance over TP and IDS, metres
    recall = (TP + IDS) / GT

AMOTA and AMOTP are the means of MOTAR and MOTP over 40 recalls from 0.1 to 1, each at the score threshold that reaches
the recall; recalls that no threshold reaches count 0 and 2 m. All other figures are those at the threshold with the
highest MOTA. The name MOTAR is the benchmark's.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np

from optipmb_tools.datasets.nuscenes import CLASS_RANGE, NuScenesDataset, NuScenesSequence, tracking_labels
from optipmb_tools.evaluation.cases import Case, by_frame, lives, match_frames, same_frame, track_changes
from optipmb_tools.evaluation.figures import defined, overall
from optipmb_tools.files import DatasetError
from optipmb_tools.geometry import Bools, Floats, Ints, rotation_of
from optipmb_tools.results import ResultTable
from optipmb_tools.results.nuscenes import NUSCENES_CLASSES, read_nuscenes_results, result_table

RACK = "static_object.bicycle_rack"
_RACKED = ("bicycle", "motorcycle")
_PERIOD_S = 0.5
_MOSTLY = 0.8
_HARDLY = 0.2
_DECIMALS = 12


@dataclass(frozen=True)
class NuScenesConfig:
    """The settings of the benchmark; the defaults are the official ones (tracking_nips_2019)."""

    class_range: Mapping[str, float] = field(default_factory=lambda: dict(CLASS_RANGE))
    """Metres from the car, by class; these classes are evaluated."""
    match_distance: float = 2.0  # metres in the plane below which a track may match an object
    min_recall: float = 0.1  # the lowest recall at which MOTAR and MOTP are taken
    thresholds: int = 40  # number of recalls from there to 1
    worst_motp: float = 2.0  # MOTP at recalls that are not reached


@dataclass(frozen=True)
class TrackBoxes:
    """Boxes of one scene that have an id: annotated objects or tracks."""

    frame: Ints  # (R,)
    id: Ints  # (R,)
    label: Ints  # (R,) index into `NUSCENES_CLASSES`
    center: Floats  # (R, 3)
    score: Floats  # (R,) mean score of the track; NaN for truth

    def __len__(self) -> int:
        return len(self.frame)

    def take(self, rows: Ints | Bools) -> "TrackBoxes":
        return TrackBoxes(self.frame[rows], self.id[rows], self.label[rows], self.center[rows], self.score[rows])


@dataclass(frozen=True)
class Racks:
    """Annotated bicycle racks."""

    frame: Ints  # (B,)
    center: Floats  # (B, 3)
    size: Floats  # (B, 3) length, width, height
    rotation: Floats  # (B, 3, 3) world from rack

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
    stamp_us: Ints  # (F,)
    ego: Floats  # (F, 2) place of the car
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
    for rows in by_frame(boxes.id, np.arange(len(boxes))):
        # One by one, not by sums: thresholds are compared with these means, so even their rounding is the official one.
        mean[rows] = np.mean(boxes.score[rows])
    return mean


def interpolate(boxes: TrackBoxes, stamp_us: Ints) -> TrackBoxes:
    """Return the boxes with those between that are missing: every id is in all frames from its first to its last.

    A missing box lies on the line between its neighbours in time. The official tools weigh the later neighbour by how
    far it is away instead of by how near; this does as they do, for only so the figures can be compared. For a single
    missing frame, the usual case, both come to nearly the same. Its class is taken from the later neighbour.

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


class ObjectState(IntEnum):
    """State of an object in a frame."""

    MISS = 0
    MATCH = 1
    SWITCH = 2


def pair(truth: TrackBoxes, tracks: TrackBoxes, label: int, limit: float) -> Case:
    """Return one class of one scene, with the pairs of centres less than `limit` metres apart in the plane."""
    truth, tracks = truth.take(truth.label == label), tracks.take(tracks.label == label)
    rows, other = same_frame(truth.frame, tracks.frame)
    distance = np.linalg.norm(truth.center[rows, :2] - tracks.center[other, :2], axis=1)
    return Case(
        sequence="",
        truth_frame=truth.frame,
        truth_id=truth.id,
        ignored=np.zeros(len(truth), dtype=np.bool_),
        track_frame=tracks.frame,
        track_id=tracks.id,
        excused=np.zeros(len(tracks), dtype=np.bool_),
        track_score=tracks.score,
        truth_row=rows,
        track_row=other,
        cost=distance,
        similarity=distance,
    ).pairs(distance < limit)


@dataclass(frozen=True)
class ThresholdMatches:
    """Matches of the tracks with a score from a threshold on."""

    event: Ints  # (T,) `ObjectState` of each object in each of its frames
    score: Floats  # (T,) of the track; NaN for misses
    distance: Floats  # (T,) metres; 0 for misses
    false_positives: int
    frames: int  # in which there is an object or a track

    @classmethod
    def of(cls, case: Case, threshold: float = -np.inf) -> "ThresholdMatches":
        """Match the tracks of a class in a scene."""
        case = case.keep(case.track_score >= threshold)
        match = match_frames(case, continuity="first")
        hit, pairs = match >= 0, case.matched(match)
        event = np.where(hit, ObjectState.MATCH, ObjectState.MISS).astype(np.int64)
        event[track_changes(case, match, hit)[0]] = ObjectState.SWITCH
        score, distance = np.full(len(match), np.nan), np.zeros(len(match))
        score[hit], distance[case.truth_row[pairs]] = case.track_score[match[hit]], case.cost[pairs]
        frames = np.union1d(case.truth_frame, case.track_frame)
        return cls(event, score, distance, len(case.track_frame) - int(hit.sum()), len(frames))


@dataclass(frozen=True)
class NuScenesFigures:
    """Figures of one class at one threshold, by their official names."""

    threshold: float  # lowest mean score of a track
    recall: float
    motar: float
    gt: float
    mota: float
    motp: float
    mt: float  # objects tracked in at least 80 % of their frames
    ml: float  # objects tracked in less than 20 % of their frames
    faf: float  # false positives in a hundred frames
    tp: float
    fp: float
    fn: float
    ids: float
    frag: float  # breaks in the tracking of an object
    tid: float  # mean time until an object is tracked, seconds
    lgd: float  # mean longest time for which an object is not tracked, seconds

    def to_json(self) -> dict[str, float | None]:
        """Return the figures by name; None where undefined."""
        return {name: defined(value) for name, value in asdict(self).items()}


@dataclass(frozen=True)
class NuScenesClass:
    """Figures of one class."""

    amota: float
    amotp: float
    best: NuScenesFigures  # at the threshold with the highest MOTA
    recalls: tuple[float, ...]  # from 1 down
    curve: tuple[NuScenesFigures | None, ...]  # at each of `recalls`; None where it is not reached

    def to_json(self) -> dict[str, float | None]:
        """Return the figures by name; None where undefined."""
        return {name: defined(value) for name, value in self.figures().items()}

    def figures(self) -> dict[str, float]:
        """Return the averages, and the figures at the threshold with the highest MOTA."""
        return {"amota": self.amota, "amotp": self.amotp, **asdict(self.best)}


UNDEFINED = NuScenesFigures(*(math.nan,) * len(fields(NuScenesFigures)))


def evaluate_class(cases: Sequence[Case], config: NuScenesConfig) -> NuScenesClass:
    """Return the figures of one class over all scenes, each prepared by `pair`."""
    recalls = np.linspace(config.min_recall, 1.0, config.thresholds).round(_DECIMALS)
    named = tuple(recalls[::-1].tolist())
    count = sum(len(case.truth_id) for case in cases)
    if not count:
        return NuScenesClass(math.nan, math.nan, UNDEFINED, named, (None,) * len(named))
    everything = [ThresholdMatches.of(case) for case in cases]
    scores = np.concatenate([one.score[one.event == ObjectState.MATCH] for one in everything])
    thresholds = score_thresholds(scores, count, recalls)[::-1]
    known = {
        threshold: figures(cases, [ThresholdMatches.of(case, threshold) for case in cases], threshold)
        for threshold in np.unique(thresholds[~np.isnan(thresholds)]).tolist()
    }
    curve = tuple(known.get(threshold) for threshold in thresholds.tolist())
    if not known:
        return NuScenesClass(0.0, config.worst_motp, _worst(cases, config), named, curve)
    return NuScenesClass(
        amota=_average([point.motar if point else math.nan for point in curve], 0.0),
        amotp=_average([point.motp if point else math.nan for point in curve], config.worst_motp),
        # The curve begins at the highest recall, which so wins among equals.
        best=max((point for point in curve if point), key=lambda point: point.mota),
        recalls=named,
        curve=curve,
    )


def score_thresholds(scores: Floats, count: int, recalls: Floats) -> Floats:
    """Return the thresholds (H,) that reach recalls (H,); NaN where the recall is not reached.

    Args:
        scores: (S,) of the true positives, in any order.
        count: number of truth boxes.
        recalls: (H,) ascending.
    """
    if not len(scores):
        return np.full(len(recalls), np.nan)
    ordered = np.sort(scores)[::-1]
    reached = np.arange(1, len(ordered) + 1) / count
    thresholds = np.interp(recalls, reached, ordered, right=0.0)
    thresholds[recalls > reached[-1]] = np.nan
    return np.asarray(thresholds, dtype=np.float64)


def figures(cases: Sequence[Case], matchings: Sequence[ThresholdMatches], threshold: float) -> NuScenesFigures:
    """Return the figures of one class from the matchings of all scenes at a threshold."""
    events = np.concatenate([matching.event for matching in matchings])
    gt = len(events)
    tp, ids, fn = (int((events == kind).sum()) for kind in (ObjectState.MATCH, ObjectState.SWITCH, ObjectState.MISS))
    fp = sum(matching.false_positives for matching in matchings)
    frames = sum(matching.frames for matching in matchings)
    metres = sum(float(matching.distance.sum()) for matching in matchings)
    first = np.cumsum([0, *(len(np.unique(case.truth_id)) for case in cases)])
    owner = [np.unique(case.truth_id, return_inverse=True)[1] + k for case, k in zip(cases, first[:-1], strict=True)]
    # Objects are filled in: in every frame from the first to the last.
    paths = lives(
        np.concatenate(owner), np.concatenate([case.truth_frame for case in cases]), events != ObjectState.MISS
    )
    share = tp / gt
    return NuScenesFigures(
        threshold=threshold,
        recall=(tp + ids) / gt,
        motar=max(0.0, 1.0 - (ids + fp + fn - (1.0 - share) * gt) / (share * gt)) if tp else math.nan,
        gt=float(gt),
        mota=max(0.0, 1.0 - (ids + fp + fn) / gt),
        motp=metres / (tp + ids) if tp + ids else math.nan,
        mt=float((paths.share >= _MOSTLY).sum()),
        ml=float((paths.share < _HARDLY).sum()),
        faf=100.0 * fp / frames,
        tp=float(tp),
        fp=float(fp),
        fn=float(fn),
        ids=float(ids),
        frag=float(paths.breaks),
        tid=_PERIOD_S * _mean(paths.delay),
        lgd=_PERIOD_S * _mean(paths.longest),
    )


def _worst(cases: Sequence[Case], config: NuScenesConfig) -> NuScenesFigures:
    """Return the figures of a class of which nothing is found."""
    gt = float(sum(len(case.truth_id) for case in cases))
    found = {"recall": 0.0, "motar": 0.0, "gt": gt, "mota": 0.0, "motp": config.worst_motp, "tp": 0.0, "fn": gt}
    lost = float(sum(len(np.unique(case.truth_id)) for case in cases))
    return replace(UNDEFINED, **found, mt=0.0, ml=lost, faf=500.0, tid=20.0, lgd=20.0)


def _average(values: list[float], worst: float) -> float:
    """Return the mean with `worst` for NaN; NaN when there is nothing else."""
    array = np.array(values)
    known = ~np.isnan(array)
    return float(np.where(known, array, worst).mean()) if known.any() else math.nan


def _mean(values: Ints) -> float:
    return float(values.mean()) if len(values) else math.nan


@dataclass(frozen=True)
class NuScenesScores:
    """Figures of all classes."""

    scenes: tuple[str, ...]
    classes: Mapping[str, NuScenesClass]
    overall: Mapping[str, float]
    """By official name, over the classes that the truth has: sums of the counts, means of everything else, also of the
    number of truth boxes."""

    def to_json(self) -> dict[str, Any]:
        """Return everything but the curves as plain values; None for figures that are not defined."""
        return {
            "scenes": list(self.scenes),
            "overall": {name: defined(value) for name, value in self.overall.items()},
            "classes": {name: scores.to_json() for name, scores in self.classes.items()},
        }


def evaluate_nuscenes(
    root: Path, results: Path, sequences: Sequence[str] = (), config: NuScenesConfig | None = None
) -> NuScenesScores:
    """Return the figures of a result file.

    Args:
        root: the folder of the dataset.
        results: a file in the layout of tracking submissions, or the folder with `tracking_results.json`.
        sequences: scenes and splits to evaluate; by default all with samples in the file.
        config: other settings than the official ones.

    Raises:
        DatasetError: the data or the results are not there or not in their layout, a scene has no annotations, or the
            results lack a sample of it.
    """
    config = config or NuScenesConfig()
    dataset = NuScenesDataset(root, clouds=False)
    submission = read_nuscenes_results(results)
    scenes = dataset.tables.scenes.values()
    names = sequences or [s.name for s in scenes if any(token in submission.rows for token in s.tokens)]
    if not names:
        raise DatasetError(submission.path, f"samples of scenes in {dataset.tables.folder}", "none")
    pairs = []
    for sequence in dataset.sequences(names):
        if not len(sequence.annotations()):
            raise DatasetError(dataset.tables.folder, f"annotations of {sequence.name}", "none")
        table = result_table(submission, sequence.name, sequence.samples)
        pairs.append((prepare_scene(sequence, config), table))
    return evaluate_scenes(pairs, config)


def evaluate_scenes(
    pairs: Sequence[tuple[NuScenesScene, ResultTable]], config: NuScenesConfig | None = None
) -> NuScenesScores:
    """Return the figures of tracks in memory, in the world frame; their frames count the keyframes of a scene."""
    config = config or NuScenesConfig()
    scenes = [(scene, scene.tracks(table, config)) for scene, table in pairs]
    classes = {}
    for name in config.class_range:
        label = NUSCENES_CLASSES.index(name)
        classes[name] = evaluate_class(
            [pair(scene.truth, tracks, label, config.match_distance) for scene, tracks in scenes], config
        )
    total = overall([one.figures() for one in classes.values()])
    total.pop("threshold", None)
    return NuScenesScores(tuple(scene.name for scene, _ in pairs), classes, total)
