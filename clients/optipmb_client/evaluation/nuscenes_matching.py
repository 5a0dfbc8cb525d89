"""Matching tracks with objects, frame by frame, as the nuScenes tracking benchmark does.

Conventions: one class in one scene. In a frame, an object keeps the track that it matched last, wherever that was, if
the two are near enough; of several objects that claim one track the first has it. What is left is matched so that there
are as many matches as possible and their total distance is the least (CLEAR MOT; Bernardin and Stiefelhagen, 2008). A
match with another track than the last one is a switch.
"""

from dataclasses import dataclass
from enum import IntEnum
from itertools import groupby
from operator import itemgetter

import numpy as np
from scipy.optimize import linear_sum_assignment

from optipmb_client.evaluation.nuscenes_scene import TrackBoxes
from optipmb_client.geometry import Bools, Floats, Ints


class Event(IntEnum):
    """What became of an object in a frame."""

    MISS = 0
    MATCH = 1
    SWITCH = 2


@dataclass(frozen=True)
class Pairing:
    """One class in one scene, and the pairs that are near enough to match."""

    frames: int
    """Of the scene."""
    truth_frame: Ints
    """(T,) ascending"""
    truth_id: Ints
    """(T,) from 0 on, without holes"""
    objects: int
    track_frame: Ints
    """(K,) ascending"""
    track_id: Ints
    """(K,)"""
    track_score: Floats
    """(K,)"""
    truth_row: Ints
    """(P,) ascending"""
    track_row: Ints
    """(P,)"""
    distance: Floats
    """(P,) metres"""


@dataclass(frozen=True)
class Matching:
    """What matching gave for the tracks from a threshold on."""

    event: Ints
    """(T,) `Event` of each object in each of its frames."""
    track_row: Ints
    """(T,) the track's row; -1 for misses."""
    distance: Floats
    """(T,) metres; NaN for misses."""
    false_positives: int
    frames: int
    """In which there is an object or a track."""


def pair(truth: TrackBoxes, tracks: TrackBoxes, label: int, frames: int, limit: float) -> Pairing:
    """Return the pairs of one class with centres less than `limit` metres apart in the plane."""
    truth, tracks = truth.take(truth.label == label), tracks.take(tracks.label == label)
    start, stop = (np.searchsorted(tracks.frame, truth.frame, side) for side in ("left", "right"))
    count = stop - start
    rows = np.repeat(np.arange(len(truth)), count)
    other = np.arange(len(rows)) - np.repeat(np.cumsum(count) - count, count) + np.repeat(start, count)
    distance = np.linalg.norm(truth.center[rows, :2] - tracks.center[other, :2], axis=1)
    near = distance < limit
    objects, number = np.unique(truth.id, return_inverse=True)
    return Pairing(
        frames=frames,
        truth_frame=truth.frame,
        truth_id=number.astype(np.int64),
        objects=len(objects),
        track_frame=tracks.frame,
        track_id=tracks.id,
        track_score=tracks.score,
        truth_row=rows[near],
        track_row=other[near],
        distance=distance[near],
    )


def match(pairing: Pairing, threshold: float = -np.inf) -> Matching:
    """Return what matching gives when only tracks with a score from `threshold` on are there."""
    kept = pairing.track_score >= threshold
    use = kept[pairing.track_row]
    rows, other, metres = pairing.truth_row[use], pairing.track_row[use], pairing.distance[use]
    keys = zip(
        pairing.truth_frame[rows].tolist(),
        rows.tolist(),
        other.tolist(),
        metres.tolist(),
        pairing.truth_id[rows].tolist(),
        pairing.track_id[other].tolist(),
        strict=True,
    )
    event = np.zeros(len(pairing.truth_frame), dtype=np.int64)
    chosen = np.full(len(event), -1, dtype=np.int64)
    distance = np.full(len(event), np.nan)
    last: dict[int, int] = {}
    for _, group in groupby(keys, itemgetter(0)):
        pairs = list(group)
        taken = _continued(pairs, last)
        objects, tracks = {one[1] for one in taken}, {one[2] for one in taken}
        taken += _assigned([one for one in pairs if one[1] not in objects and one[2] not in tracks])
        for _, row, track, apart, identity, follower in taken:
            event[row] = Event.SWITCH if last.get(identity, follower) != follower else Event.MATCH
            chosen[row], distance[row] = track, apart
            last[identity] = follower
    present = _present(pairing.truth_frame, pairing.frames) | _present(pairing.track_frame[kept], pairing.frames)
    return Matching(event, chosen, distance, int(kept.sum() - (chosen >= 0).sum()), int(present.sum()))


_Pair = tuple[int, int, int, float, int, int]
"""Frame, row of the object, row of the track, metres, id of the object, id of the track."""


def _continued(pairs: list[_Pair], last: dict[int, int]) -> list[_Pair]:
    """Return the pairs of one frame that go on from earlier ones."""
    taken: list[_Pair] = []
    used: set[int] = set()
    for one in pairs:
        if one[5] not in used and last.get(one[4]) == one[5]:
            taken.append(one)
            used.add(one[5])
    return taken


def _assigned(pairs: list[_Pair]) -> list[_Pair]:
    """Return the most pairs without common members and, of those, the ones with the least total distance."""
    objects = {row: i for i, row in enumerate(dict.fromkeys(one[1] for one in pairs))}
    tracks = {row: i for i, row in enumerate(dict.fromkeys(one[2] for one in pairs))}
    if len(objects) == len(pairs) == len(tracks):
        return pairs
    # Leaving a pair out must never pay: one forbidden pair costs more than any set of allowed ones.
    forbidden = 1.0 + 2.0 * sum(one[3] for one in pairs)
    cost = np.full((len(objects), len(tracks)), forbidden)
    at = {}
    for one in pairs:
        place = objects[one[1]], tracks[one[2]]
        cost[place] = one[3]
        at[place] = one
    found = zip(*(side.tolist() for side in linear_sum_assignment(cost)), strict=True)
    return [at[place] for place in found if place in at]


def _present(frame: Ints, frames: int) -> Bools:
    present = np.zeros(frames, dtype=np.bool_)
    present[frame] = True
    return present
