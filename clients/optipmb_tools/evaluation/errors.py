"""Errors of boxes in every direction, of tracks and of the detections that they are made of.

Conventions: world frame, metres and radians, box minus label. `along` and `across` are offsets of the centre along and
across the heading of the label, `height` is the offset upwards. Headings are compared modulo pi; a box is
backward when its heading is off by more than half of pi. Tracks count from an existence probability of a half on; only
boxes with a detection of their own in the frame are compared, so that both columns are of the same objects at the same
times. Labels and tracks belong together as in `optipmb_tools.evaluation.calibration`. Where the dataset was opened
without the detections that the tracks were made of, only headings are compared, and `without` has the reason.
"""

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from optipmb_tools.datasets import DataSequence, DatasetError, Truth
from optipmb_tools.evaluation.calibration import NORMAL_95, rows_of, sample
from optipmb_tools.evaluation.cases import Rules
from optipmb_tools.geometry import Bools, Floats, Ints, stack_poses, to_world, wrap_angle
from optipmb_tools.results import FullTable, ResultTable

DIRECTIONS = ("along", "across", "height", "heading", "length", "width", "tall")
"""Columns of the errors; the last three are errors of the size."""
CONFIRMED = 0.5  # existence probability from which tracks count
RANGES = (0.0, 20.0, 40.0, np.inf)  # distances from the sensor, m
SPEEDS = (0.0, 1.0, 8.0, np.inf)  # speeds of tracks, m/s
_HEADING = 3
_HALF = 0.5 * np.pi


@dataclass(frozen=True)
class ErrorResult:
    """Boxes of confirmed tracks of one class that match a label; results of several sequences add up."""

    track: Floats  # (N, 7) errors of tracks, headings in (-pi, pi]
    detection: Floats  # (N, 7) errors of their detections; NaN where they were missed
    heading_variance: Floats  # (N,) of the tracks, rad^2
    distance: Floats  # (N,) from the sensor, m
    speed: Floats  # (N,) of the track, m/s
    without: str = ""  # why there are no detections to compare with; empty where there are

    def __add__(self, other: "ErrorResult") -> "ErrorResult":
        columns = {name: value for name, value in vars(self).items() if name != "without"}
        joined = {name: np.concatenate([value, getattr(other, name)]) for name, value in columns.items()}
        return ErrorResult(**joined, without=self.without or other.without)

    @property
    def detected(self) -> Bools:
        """(N,) with a detection of their own."""
        return np.asarray(np.isfinite(self.detection[:, 0]), dtype=np.bool_)

    def groups(self) -> Iterator[tuple[str, Bools]]:
        """Yield the name and the boxes (N,) of each group: all, by range, by speed."""
        yield "all", np.ones(len(self.distance), dtype=np.bool_)
        for values, edges, unit in ((self.distance, RANGES, "m"), (self.speed, SPEEDS, "m/s")):
            for low, high in itertools.pairwise(edges):
                name = f"from {low:g} {unit}" if np.isinf(high) else f"{low:g}-{high:g} {unit}"
                yield name, (values >= low) & (values < high)

    def figures(self, group: Bools) -> dict[str, object]:
        """Return root mean squares of detected tracks and of their detections, and what headings are like."""
        both, errors = group & self.detected, self.track[group, _HEADING]
        squared = errors**2 / self.heading_variance[group]
        return {
            "boxes": int(both.sum()),
            "track": _spread(self.track[both]),
            "detection": _spread(self.detection[both]),
            "backward": {"track": _backward(self.track[both]), "detection": _backward(self.detection[both])},
            "heading": {
                "boxes": int(group.sum()),
                "backward": _backward(self.track[group]),
                "NEES": _mean(squared),
                "coverage": _mean(squared <= NORMAL_95**2),
            },
        }

    def summary(self) -> dict[str, object]:
        """Return the figures of every group that has boxes, and why there are no detections to compare with."""
        groups = {name: self.figures(group) for name, group in self.groups() if group.any()}
        return {"groups": groups, "without detections": self.without or None}


def evaluate_errors(
    parts: Iterable[tuple[DataSequence, Truth, ResultTable, FullTable]], name: str, rules: Rules
) -> ErrorResult:
    """Return the errors of one class over all sequences; parts and rules as for `evaluate_calibration`."""
    none, boxes = np.empty(0), np.empty((0, len(DIRECTIONS)))
    return sum((_sequence_errors(*part, name, rules) for part in parts), ErrorResult(boxes, boxes, none, none, none))


def _sequence_errors(
    sequence: DataSequence, truth: Truth, tracks: ResultTable, full: FullTable, name: str, rules: Rules
) -> ErrorResult:
    found = sample(truth, tracks, full, name, rules)
    rows, owner = found.row[found.true], found.owner[found.true]
    sure = full.existence[rows] >= CONFIRMED
    rows, owner = rows[sure], owner[sure]
    label = rows_of(truth.frame, truth.id, full.frame[rows], owner)
    without = ""
    center, size, yaw = (np.full((len(rows), *tail), np.nan) for tail in ((3,), (3,), ()))
    try:
        center, size, yaw = _detections(sequence, full, rows)
    except DatasetError as error:
        without = str(error)
    sensor = np.array([sequence.poses[frame].translation[:2] for frame in full.frame[rows].tolist()]).reshape(-1, 2)
    return ErrorResult(
        track=_errors(truth, label, full.center[rows], full.size[rows], full.yaw[rows]),
        detection=_errors(truth, label, center, size, yaw),
        heading_variance=full.covariance[rows, _HEADING, _HEADING],
        distance=np.asarray(np.linalg.norm(truth.center[label, :2] - sensor, axis=1), dtype=np.float64),
        speed=np.asarray(np.linalg.norm(full.velocity[rows], axis=1), dtype=np.float64),
        without=without,
    )


def _detections(sequence: DataSequence, full: FullTable, rows: Ints) -> tuple[Floats, Floats, Floats]:
    """Return centre (N, 3), size (N, 3) and heading (N,) of the detections of some rows; NaN where there is none.

    Raises:
        DatasetError: there are no detections, or others than the tracks were made of.
    """
    center, size, yaw = (np.full((len(rows), *tail), np.nan) for tail in ((3,), (3,), ()))
    names = np.array(full.labels, dtype=np.str_)[full.label]
    wanted: dict[int, list[int]] = {}
    for k, row in enumerate(rows.tolist()):
        if full.detection[row] >= 0:
            wanted.setdefault(int(full.frame[row]), []).append(k)
    for frame in sequence.frames() if wanted else ():
        here = wanted.get(frame.index)
        if here is None:
            continue
        chosen = full.detection[rows[here]]
        labels = np.array(frame.labels, dtype=np.str_)[frame.label]
        if chosen.max() >= len(labels) or (labels[chosen] != names[rows[here]]).any():
            place = f"sequence {sequence.name}, frame {frame.index}"
            raise DatasetError(place, "the detections, of all classes, that the tracks were made of", "others")
        rotation, translation = (np.repeat(part, len(here), axis=0) for part in stack_poses([frame.pose]))
        center[here], yaw[here] = to_world(rotation, translation, frame.center[chosen], frame.yaw[chosen])
        size[here] = frame.size[chosen]
    return center, size, yaw


def _errors(truth: Truth, label: Ints, center: Floats, size: Floats, yaw: Floats) -> Floats:
    """Return box minus label (N, 7), in the order of `DIRECTIONS`."""
    offset, ahead = center - truth.center[label], truth.yaw[label]
    cos, sin = np.cos(ahead), np.sin(ahead)
    along = offset[:, 0] * cos + offset[:, 1] * sin
    across = offset[:, 1] * cos - offset[:, 0] * sin
    return np.column_stack([along, across, offset[:, 2], wrap_angle(yaw - ahead), size - truth.size[label]])


def _spread(values: Floats) -> dict[str, float | None]:
    """Return the root mean square of each direction, headings modulo pi."""
    folded = values.copy()
    folded[:, _HEADING] = wrap_angle(2.0 * folded[:, _HEADING]) / 2.0
    return {name: _mean(column**2, root=True) for name, column in zip(DIRECTIONS, folded.T, strict=True)}


def _backward(values: Floats) -> float | None:
    return _mean(np.abs(values[:, _HEADING]) > _HALF)


def _mean(values: np.ndarray, *, root: bool = False) -> float | None:
    values = values[~np.isnan(values)]
    if not len(values):
        return None
    mean = float(values.mean())
    return float(np.sqrt(mean)) if root else mean
