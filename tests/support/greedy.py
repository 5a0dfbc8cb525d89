"""A greedy tracker, the simplest that is used: each detection, the best first, takes the nearest track that is free.

As the tracker that came with CenterPoint: a detection is carried back by its velocity, if it has one, to where the
object was in the frame before, and takes the nearest track of its class within reach there, or starts one. A track that
is not found stays where its velocity takes it and ends after three frames. A box is written when it is detected, with
the score of its detection.
"""

from dataclasses import dataclass, replace

import numpy as np
from boxes import Row, table_of
from numpy.typing import NDArray
from optipmb_tools.results import ResultTable
from optipmb_tools.tuning.clips import Clip

REACH = {
    "car": 4.0,
    "truck": 4.0,
    "bus": 5.5,
    "trailer": 3.0,
    "pedestrian": 1.0,
    "motorcycle": 13.0,
    "bicycle": 3.0,
    "Car": 4.0,
    "Pedestrian": 1.0,
    "Cyclist": 3.0,
}
"""Farthest that a track of a class is sought, metres."""
PATIENCE = 3
FAR = np.full(1, np.inf)


@dataclass(frozen=True)
class _Track:
    id: int
    place: NDArray[np.float64]
    velocity: NDArray[np.float64]
    missed: int = 0


def greedy_tracks(clip: Clip, name: str) -> ResultTable:
    tracks: list[_Track] = []
    rows: list[Row] = []
    before, count = None, 0
    for index, frame in enumerate(clip.frames):
        dt = 0.0 if before is None else (frame.stamp_ns - before) * 1e-9
        before = frame.stamp_ns
        velocity = np.nan_to_num(frame.velocity)
        free, found = list(tracks), []
        for m in np.argsort(-frame.score, kind="stable").tolist():
            place = frame.center[m, :2]
            distance = np.hypot(*(place - velocity[m] * dt - [track.place for track in free]).T) if free else FAR
            if distance.min() <= REACH[name]:
                identity = free.pop(int(np.argmin(distance))).id
            else:
                count += 1
                identity = count
            found.append(_Track(identity, place, velocity[m]))
            rows.append((index, identity, frame.center[m], frame.size[m], float(frame.yaw[m]), float(frame.score[m])))
        lost = [replace(track, place=track.place + track.velocity * dt, missed=track.missed + 1) for track in free]
        tracks = [*found, *(track for track in lost if track.missed < PATIENCE)]
    return table_of(clip, name, rows)
