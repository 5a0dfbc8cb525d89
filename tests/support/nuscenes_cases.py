"""Tracks of a nuScenes scene that no tracker of the product made: disturbed truth, and a greedy tracker."""

import random
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from optipmb_schemas import Tracks
from optipmb_tools.datasets import DetectionFrame
from optipmb_tools.datasets.nuscenes import NuScenesDataset, NuScenesSequence
from optipmb_tools.results import column_shape
from optipmb_tools.results.nuscenes import NUSCENES_CLASSES, scene_file

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

COLUMNS = ("id", "label", "center", "size", "yaw", "velocity", "score")

_Part = tuple[int, int, Floats, Floats, float, float]
"""Id, label, centre, size, yaw, score."""

REACH = {"bicycle": 3.0, "bus": 5.5, "car": 4.0, "motorcycle": 5.0, "pedestrian": 1.0, "trailer": 3.0, "truck": 4.0}
"""Metres between a prediction and a detection of the same track, by class, for the greedy tracker."""


@dataclass(frozen=True)
class Rows:
    id: Ints
    label: Ints
    center: Floats
    size: Floats
    yaw: Floats
    velocity: Floats
    score: Floats
    labels: tuple[str, ...] = NUSCENES_CLASSES

    @property
    def existence(self) -> Floats:
        return self.score


def message(rows: Rows) -> Tracks:
    """Return tracks as a message, all confirmed."""
    count = len(rows.id)
    columns = {
        name: np.ones((count, *column_shape(name)), array.dtype)
        for name, array in Tracks.arrays.items()
        if array.rows == Tracks.arrays["id"].rows
    }
    header = {"stream": "s", "epoch": bytes(16), "seq": 0, "stamp_ns": 0, "session": "0" * 32, "profile": "p"}
    header |= {"cloud_used": False, "labels": rows.labels}
    known = {name: getattr(rows, name) for name in COLUMNS}
    return Tracks.trusted(header | columns | known)


def write(dataset: NuScenesDataset, sequence: NuScenesSequence, frames: Sequence[Rows], out: Path) -> Path:
    dataset.write(out, sequence, dict(enumerate(frames)))
    dataset.join(out, [one for one in dataset.sequences(["all"]) if scene_file(out, one.name).is_file()])
    return out / "tracking_results.json"


def truth_tracks(sequence: NuScenesSequence, *, ignored: bool = True) -> list[Rows]:
    """Give the annotated objects as perfect tracks, with or without the boxes that do not count."""
    truth = sequence.truth()
    assert truth is not None
    truth = truth if ignored else truth.take(~truth.ignored)
    frames = []
    for index in range(len(sequence)):
        rows = np.flatnonzero(truth.frame == index)
        score = np.ones(len(rows))
        values = (truth.center[rows], truth.size[rows], truth.yaw[rows], truth.velocity[rows], score)
        frames.append(Rows(truth.id[rows], truth.label[rows], *values))
    return frames


class _Chance:
    """Chance from the one generator whose numbers are promised never to change."""

    def __init__(self, seed: int) -> None:
        self._next = random.Random(seed).random

    def happens(self, probability: float) -> bool:
        return self._next() < probability

    def below(self, count: int) -> int:
        return int(self._next() * count)

    def uniform(self, low: float, high: float) -> float:
        return low + (high - low) * self._next()

    def normal(self, spread: float) -> float:
        return spread * (sum(self._next() for _ in range(12)) - 6.0)

    def place(self, spread: float) -> Floats:
        return np.array([self.normal(spread) for _ in range(3)])


def disturbed_tracks(sequence: NuScenesSequence, seed: int) -> list[Rows]:
    """Give tracks with every fault there is: noise, holes, exchanged and changed ids, doubles, and false ones.

    Some scores change within a track, some are the same for many tracks; some tracks change their class.
    """
    chance = _Chance(seed)
    quality: dict[int, float] = {}
    shown_as: dict[int, int] = {}
    fresh = 100_000
    frames = []
    for rows in truth_tracks(sequence):
        parts: dict[int, _Part] = {}
        identities = rows.id.tolist()
        for identity, label, center, size, yaw in zip(
            identities, rows.label.tolist(), rows.center, rows.size, rows.yaw.tolist(), strict=True
        ):
            if chance.happens(0.15):
                continue
            if chance.happens(0.04):
                shown_as[identity], fresh = fresh, fresh + 1
            if chance.happens(0.02):
                other = identities[chance.below(len(identities))]
                shown_as[identity], shown_as[other] = shown_as.get(other, other), shown_as.get(identity, identity)
            level = quality.setdefault(identity, round(max(chance.uniform(0, 1), chance.uniform(0, 1)), 1))
            score = min(max(level + chance.normal(0.05) * (identity % 2), 0.01), 1.0)
            name = chance.below(len(NUSCENES_CLASSES)) if chance.happens(0.02) else label
            number = shown_as.get(identity, identity)
            parts[number] = (number, name, center + chance.place(0.4), size, yaw, score)
            if chance.happens(0.08):
                number = identity + 200_000
                parts[number] = (number, label, center + chance.place(0.9), size, yaw, 0.6 * score)
        middle = rows.center.mean(axis=0) if len(rows.id) else np.zeros(3)
        for _ in range(chance.below(10)):
            number = 300_000 + chance.below(60)
            place = middle + np.array([chance.uniform(-45, 45), chance.uniform(-45, 45), 0.0])
            size = np.array([3.0, 1.5, 1.5])
            parts[number] = (number, chance.below(len(NUSCENES_CLASSES)), place, size, 0.0, chance.uniform(0.01, 0.7))
        frames.append(_rows(list(parts.values())))
    return frames


@dataclass
class _Track:
    id: int
    center: Floats
    velocity: Floats = field(default_factory=lambda: np.zeros(2))
    seen_s: float = 0.0
    misses: int = 0


class GreedyTracker:
    """Gives each detection, best first, to the nearest prediction in reach, or starts a track; keeps lost ones a while.

    Predictions go on at the velocity of the last two detections. A track has the score of its detection.
    """

    def __init__(self, *, patience: int = 3) -> None:
        self._patience = patience
        self._tracks: dict[int, list[_Track]] = {}
        self._next = 1

    def step(self, frame: DetectionFrame) -> Rows:
        now = frame.stamp_ns * 1e-9
        parts = []
        for label, name in enumerate(frame.labels):
            rows = np.flatnonzero(frame.label == label)
            free = self._tracks.get(label, [])
            places = [track.center + track.velocity * (now - track.seen_s) for track in free]
            kept = []
            for row in rows[np.argsort(-frame.score[rows], kind="stable")].tolist():
                center = frame.center[row, :2]
                apart = [float(np.linalg.norm(place - center)) for place in places]
                best = int(np.argmin(apart)) if apart else -1
                if best >= 0 and apart[best] < REACH[name]:
                    track = free[best]
                    free, places = free[:best] + free[best + 1 :], places[:best] + places[best + 1 :]
                    track.velocity = (center - track.center) / (now - track.seen_s)
                else:
                    track, self._next = _Track(self._next, center), self._next + 1
                track.center, track.seen_s, track.misses = center, now, 0
                kept.append(track)
                values = (frame.center[row], frame.size[row], float(frame.yaw[row]), float(frame.score[row]))
                parts.append((track.id, label, *values))
            for track in free:
                track.misses += 1
            self._tracks[label] = kept + [track for track in free if track.misses <= self._patience]
        return _rows(parts)


def greedy_tracks(sequence: NuScenesSequence) -> list[Rows]:
    tracker = GreedyTracker()
    return [tracker.step(frame) for frame in sequence.frames()]


def _rows(parts: Sequence[_Part]) -> Rows:
    return Rows(
        id=np.array([part[0] for part in parts], dtype=np.int64),
        label=np.array([part[1] for part in parts], dtype=np.int64),
        center=np.array([part[2] for part in parts]).reshape(-1, 3),
        size=np.array([part[3] for part in parts]).reshape(-1, 3),
        yaw=np.array([part[4] for part in parts], dtype=np.float64),
        velocity=np.full((len(parts), 2), np.nan),
        score=np.array([part[5] for part in parts], dtype=np.float64),
    )
