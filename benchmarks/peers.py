"""Other trackers from PyPI on the same scenes: `python benchmarks/peers.py [SIZE...]`, in an environment of their own.

    python -m venv out/peers
    out/peers/bin/pip install stonesoup norfair trackers
    out/peers/bin/python benchmarks/peers.py

Prints one JSON object: tracker and version, objects, and the milliseconds of processor time of each frame after the
first few. What a tracker needs as input (its own detection objects) is made before the clock starts. A tracker that
needs longer than `PATIENCE_S` for a frame is not given larger scenes. Each is set up as its documentation shows, with a
gate of 4 m and prediction over the period of the scene; none of them receives the classes, most have no oriented boxes.
BoxMOT is not among them: it needs torch with the libraries of CUDA, several GB for trackers that run without, and its
licence is the AGPL.
"""

from __future__ import annotations

import datetime as dt
import json
import sys
import time
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

import numpy as np
from dense import PERIOD_S, SceneFrame, dense_scene

if TYPE_CHECKING:
    from collections.abc import Callable

    Step = Callable[[Any], object]

OBJECTS = (10, 20, 50, 100, 200, 400, 800)
SETTLED = 4
PATIENCE_S = 1.0
GATE = 4.0
START = dt.datetime(2026, 1, 1)  # noqa: DTZ001 - Stone Soup compares naive times


def stone_soup(_: int) -> tuple[Callable[[SceneFrame], Any], Step]:
    """Global nearest neighbour by the 2D assignment, unscented Kalman filter, constant velocity on the plane."""
    from stonesoup.dataassociator.neighbour import GNNWith2DAssignment
    from stonesoup.hypothesiser.distance import DistanceHypothesiser
    from stonesoup.measures import Mahalanobis
    from stonesoup.models.measurement.linear import LinearGaussian
    from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
    from stonesoup.predictor.kalman import UnscentedKalmanPredictor
    from stonesoup.types.detection import Detection
    from stonesoup.types.state import GaussianState
    from stonesoup.types.track import Track
    from stonesoup.updater.kalman import UnscentedKalmanUpdater

    motion = CombinedLinearGaussianTransitionModel([ConstantVelocity(1.0), ConstantVelocity(1.0)])
    measurement = LinearGaussian(4, (0, 2), np.diag([0.04, 0.04]))
    predictor, updater = UnscentedKalmanPredictor(motion), UnscentedKalmanUpdater(measurement)
    associator = GNNWith2DAssignment(DistanceHypothesiser(predictor, updater, Mahalanobis(), missed_distance=3.0))
    tracks: dict[int, Any] = {}

    def prepare(frame: SceneFrame) -> tuple[dt.datetime, list[Any]]:
        now = START + dt.timedelta(seconds=frame.stamp_ns * 1e-9)
        return now, [Detection(xy[:, None], timestamp=now, measurement_model=measurement) for xy in frame.center[:, :2]]

    def step(given: tuple[dt.datetime, list[Any]]) -> None:
        now, detections = given
        used = set()
        if tracks:
            hypotheses = associator.associate(set(tracks.values()), set(detections), now)
            for track, hypothesis in hypotheses.items():
                if hypothesis:
                    track.append(updater.update(hypothesis))
                    used.add(id(hypothesis.measurement))
                else:
                    track.append(hypothesis.prediction)
                    if len([state for state in track.states[-5:] if not hasattr(state, "hypothesis")]) == 5:
                        del tracks[id(track)]
        for detection in detections:
            if id(detection) not in used:
                x, y = detection.state_vector[:, 0]
                prior = GaussianState([[x], [0], [y], [0]], np.diag([0.1, 9.0, 0.1, 9.0]), timestamp=now)
                track = Track([prior])
                tracks[id(track)] = track

    return prepare, step


def bytetrack(_: int) -> tuple[Callable[[SceneFrame], Any], Step]:
    """ByteTrack of the package trackers: Kalman filter of boxes in an image, two rounds of the Hungarian algorithm."""
    from supervision import Detections
    from trackers import ByteTrackTracker

    tracker = ByteTrackTracker(frame_rate=1.0 / PERIOD_S, minimum_iou_threshold=0.05)

    def prepare(frame: SceneFrame) -> Any:
        low, high = frame.center[:, :2] - frame.size[:, :2] / 2, frame.center[:, :2] + frame.size[:, :2] / 2
        none = np.zeros(len(low), dtype=int)
        return Detections(np.hstack([low, high]), confidence=np.asarray(frame.score), class_id=none)

    return prepare, tracker.update


def norfair(_: int) -> tuple[Callable[[SceneFrame], Any], Step]:
    """Constant velocity of points, greedy association by Euclidean distance."""
    from norfair import Detection, Tracker

    tracker = Tracker(distance_function="mean_euclidean", distance_threshold=GATE, initialization_delay=1)

    def prepare(frame: SceneFrame) -> list[Any]:
        return [Detection(points=xy[None]) for xy in frame.center[:, :2]]

    return prepare, lambda detections: tracker.update(detections=detections)


PEERS = {
    ("Stone Soup", "stonesoup"): stone_soup,
    ("ByteTrack", "trackers"): bytetrack,
    ("norfair", "norfair"): norfair,
}


def timed(peer: Callable[[int], tuple[Callable[[SceneFrame], Any], Step]], objects: int) -> list[float]:
    """Milliseconds of each frame of a scene after the first few."""
    prepare, step = peer(objects)
    spent = []
    for frame in dense_scene(objects, frames=10):
        given = prepare(frame)
        begun = time.thread_time()
        step(given)
        spent.append(1e3 * (time.thread_time() - begun))
        if spent[-1] > 1e3 * PATIENCE_S and len(spent) > SETTLED:
            break
    return [round(one, 4) for one in spent[SETTLED:]]


def main(sizes: list[int]) -> None:
    """Time every peer that is installed, in growing scenes."""
    found: dict[str, dict[int, list[float]]] = {}
    for (tracker, package), peer in PEERS.items():
        try:
            name = f"{tracker} {version(package)}"
        except PackageNotFoundError as error:
            print(f"{tracker}: not installed ({error})", file=sys.stderr)
            continue
        for objects in sizes:
            times = timed(peer, objects)
            found.setdefault(name, {})[objects] = times
            print(f"{name}, {objects} objects: {np.median(times):.2f} ms", file=sys.stderr)
            if np.median(times) > 1e3 * PATIENCE_S:
                break
    print(json.dumps(found))


if __name__ == "__main__":
    main([int(size) for size in sys.argv[1:]] or list(OBJECTS))
