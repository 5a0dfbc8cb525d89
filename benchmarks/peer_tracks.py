"""Tracks of others for `make compare`: `python benchmarks/peer_tracks.py DETECTIONS.csv OUT`, in their environment.

norfair follows points, ByteTrack of the package trackers boxes in an image: here the boxes around the objects in the
plane. Both have the defaults of their packages but for distances, which are in metres, and get one class at a time.
"""

from __future__ import annotations

import csv
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np
import supervision
from norfair import Detection, Tracker
from trackers import ByteTrackTracker

RATE_HZ = 10.0
GATE_M = 2.0
AROUND_M = 0.5  # added to the half length of an object, so that boxes of slow rates overlap
IDS = 1000  # of a class


def main(detections: Path, out: Path) -> None:
    """Track a table of detections with both, and write a table of tracks for each."""
    frames = defaultdict(list)
    with detections.open(encoding="utf-8") as file:
        for row in csv.DictReader(file):
            frames[row["time"]].append(row)
    classes = sorted({row["class"] for rows in frames.values() for row in rows})
    points = [Tracker("mean_euclidean", distance_threshold=GATE_M, initialization_delay=2) for _ in classes]
    boxes = [ByteTrackTracker(frame_rate=RATE_HZ, minimum_iou_threshold=0.05) for _ in classes]
    found = defaultdict(list)
    for time, rows in frames.items():
        for number, name in enumerate(classes):
            own = [[float(row[k]) for k in ("x", "y", "length", "score")] for row in rows if row["class"] == name]
            table = np.array(own).reshape(-1, 4)
            for track in points[number].update([Detection(place[None]) for place in table[:, :2]]):
                found["norfair"].append((time, IDS * number + track.id, *track.estimate[0], name))
            half = 0.5 * table[:, 2:3] + AROUND_M
            corners = np.hstack([table[:, :2] - half, table[:, :2] + half])
            none = np.zeros(len(table), dtype=int)
            tracked = boxes[number].update(supervision.Detections(corners, confidence=table[:, 3], class_id=none))
            for box, identity in zip(tracked.xyxy, tracked.tracker_id, strict=True):
                if identity >= 0:
                    found["bytetrack"].append((time, IDS * number + identity, *(box[:2] + box[2:]) / 2, name))
    for name, rows in found.items():
        with (out / f"{name}.csv").open("w", encoding="utf-8", newline="") as file:
            csv.writer(file).writerows([("time", "id", "x", "y", "class"), *rows])


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
