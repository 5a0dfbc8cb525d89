"""Accuracy of a calibrated camera on KITTI: boxes of RRC against the centres of the labels, on the ground."""

from collections import Counter, defaultdict
from collections.abc import Iterator
from functools import cache
from itertools import groupby
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest
from numpy.typing import NDArray
from optipmb_tools.datasets.kitti import _AXES, read_poses
from real_data import kitti_root
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

import optipmb

pytestmark = pytest.mark.accuracy
Floats = NDArray[np.float64]

RANGES: Final = (0, 10, 20, 30, 40, 60)
EXPECTED: Final = {
    "Car": {
        "fixed": ((0.40, 1.6), (0.34, 0.95), (0.51, 1.4), (0.92, 2.7), (1.08, 3.6)),
        "ground": ((0.68, 2.0), (1.07, 2.7), (2.59, 6.0), (5.3, 15.0), (9.2, 27.0)),
        "height": ((0.43, 1.6), (0.59, 1.5), (1.12, 2.6), (1.62, 3.8), (2.37, 5.5)),
        "both": ((0.48, 1.7), (0.55, 1.5), (1.05, 2.6), (1.57, 4.1), (2.71, 6.2)),
    },
    "Pedestrian": {
        "fixed": ((0.93, 2.7), (0.42, 1.7), (1.34, 5.7), (1.74, 4.9), (3.8, 8.4)),
        "both": ((1.37, 2.7), (0.75, 2.4), (1.70, 4.1), (3.2, 6.2), (2.8, 10.0)),
    },
}
"""Median and 90 % quantile of the error, m, of each range, of a prototype that another hand wrote."""
COVERED: Final = {"fixed": (0.90, 0.98, 0.99, 0.99, 0.99), "both": (0.91, 0.98, 0.99, 0.99, 0.99)}
"""Share of the cars in the ellipse that should hold 95 %."""
FOLLOWED: Final = {"Car": (0.951, 0.687), "Pedestrian": (0.879, 0.674)}
"""Share of the matched boxes in the main track of their object, and MOTA within 4 m, of the same prototype."""
REACH_M: Final = 70.0
WITHIN_M: Final = 4.0
SIDE: Final = np.arctan(621 / 721)
"""Angle of the sides of the image."""
STILL: Final = optipmb.Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))


@cache
def cached(numbers: bytes, ground: float, kind: str) -> optipmb.GroundCamera:
    return camera(np.frombuffer(numbers).reshape(3, 4), ground, kind)


def camera(projection: Floats, ground: float, kind: str) -> optipmb.GroundCamera:
    """Give the left colour camera of KITTI in a frame with x forward and z up."""
    inner = projection[:, :3]
    x, y, z = -np.linalg.solve(inner, projection[:, 3])
    error: dict[str, Any] = {"largest": 1e4}
    return optipmb.GroundCamera.parse(
        {
            "image": [1242, 375],
            "mount": "fixed" if kind == "fixed" else "vehicle",
            "pinhole": {
                "intrinsics": [inner[0, 0], inner[1, 1], inner[0, 2], inner[1, 2]],
                "position": [z, -x, -y],
                "quaternion": [0.5, -0.5, 0.5, -0.5],
                "ground": ground,
            },
            "error": error if kind == "fixed" else error | {"range": kind, "tilt": 0.02},
            "class": {"car": {"size": [4.2, 1.8, 1.5]}},
        }
    )


def overlaps(one: Floats, other: Floats) -> Floats:
    """Give the overlap (N, M) of image boxes, intersection over union."""
    low, high = np.maximum(one[:, None, :2], other[:, :2]), np.minimum(one[:, None, 2:], other[:, 2:])
    shared = np.prod(np.clip(high - low, 0.0, None), axis=2)
    first, second = (np.prod(boxes[:, 2:] - boxes[:, :2], axis=1) for boxes in (one, other))
    return np.asarray(shared / (first[:, None] + second - shared))


Matched = tuple[str, int, Floats, Floats, Floats, list[tuple[int, int]]]


def matched(root: Path, name: str) -> Iterator[Matched]:
    """Yield sequence, number, projection, boxes, labels and matches of each frame with boxes and labels."""
    for file in sorted((root / "training" / "label_02").glob("*.txt")):
        text = (root / "training" / "calib" / file.name).read_text()
        projection = np.array(text.partition("P2: ")[2].split("\n")[0].split(), float).reshape(3, 4)
        found = (root / "detections_2d" / "rrc" / name / file.name).read_text()
        rows = np.array([line.split(",") for line in found.splitlines()], float).reshape(-1, 6)
        lines = [line.split() for line in file.read_text().splitlines()]
        chosen = [[fields[0], *fields[6:17], fields[1]] for fields in lines if fields[2] == name]
        labels = np.array(chosen, float).reshape(-1, 13)
        for frame in np.intersect1d(rows[:, 0], labels[:, 0]):
            boxes, truth = rows[rows[:, 0] == frame, 1:5], labels[labels[:, 0] == frame, 1:]
            share = overlaps(boxes, truth[:, :4])
            found_pairs = zip(*(one.tolist() for one in linear_sum_assignment(-share)), strict=True)
            pairs = [(box, label) for box, label in found_pairs if share[box, label] >= 0.5]
            yield file.stem, int(frame), projection, boxes, truth, pairs


def errors(root: Path, name: str, kind: str) -> Floats:
    """Give the range, the error and its squared Mahalanobis distance (N, 3) of the boxes of a kind of camera."""
    rows: list[tuple[float, float, float]] = []
    for _, _, projection, boxes, truth, pairs in matched(root, name):
        names = [name] * len(boxes)
        on_vehicle = (
            cached(projection.tobytes(), -1.65, kind).detections(boxes, names, pose=STILL) if kind != "fixed" else {}
        )
        for box, label in pairs:
            x, y, z = truth[label, 7:10]
            if kind == "fixed" and y < 0.3:  # a label above the camera
                continue
            found = on_vehicle or camera(projection, -y, kind).detections(boxes, names)
            for row in np.flatnonzero(found["row"] == box):
                error = found["center"][row, :2] - (z, -x)
                distance = error @ np.linalg.solve(found["position_covariance"][row, :2, :2], error)
                rows.append((np.hypot(x, z), np.hypot(*error), distance))
    return np.array(rows)


@pytest.mark.timeout(900)
@pytest.mark.parametrize("name", EXPECTED)
def test_places_of_boxes_are_as_exact_as_measured(name: str) -> None:
    """Medians and 90 % quantiles of the errors reach the measured ones within 10 %, and the ellipses hold as many."""
    root = kitti_root()
    for kind, expected in EXPECTED[name].items():
        reach, error, distance = errors(root, name, kind).T
        for place, (median, quantile) in enumerate(expected):
            mine = (reach >= RANGES[place]) & (reach < RANGES[place + 1])
            assert np.median(error[mine]) <= 1.1 * median + 0.005, (kind, place)
            assert np.quantile(error[mine], 0.9) <= 1.1 * quantile + 0.05, (kind, place)
            if name == "Car" and kind in COVERED:
                assert (distance[mine] < 5.99).mean() >= COVERED[kind][place] - 0.02, (kind, place)


@pytest.mark.timeout(900)
@pytest.mark.parametrize("name", FOLLOWED)
def test_tracks_of_boxes_are_as_good_as_measured(name: str) -> None:
    """From a vehicle with poses, boxes that match labels give tracks within 10 % of the measured share and MOTA."""
    root, numbers, wrong, objects = kitti_root(), defaultdict[Any, Counter[int]](Counter), 0, 0
    for stem, group in groupby(matched(root, name), key=lambda one: one[0]):
        poses = _AXES @ read_poses(root / "training" / "poses" / f"{stem}.txt") @ _AXES.T
        frames, tracker = {one[1]: one[2:] for one in group}, optipmb.OnlineTracker("generic")
        projection = next(iter(frames.values()))[0]
        one_camera = cached(projection.tobytes(), -1.65, "both")
        for number, matrix in enumerate(poses):
            _, boxes, truth, pairs = frames.get(number, (projection, np.zeros((0, 4)), np.zeros((0, 12)), []))
            seen = [(box, label) for box, label in pairs if np.hypot(*truth[label, [7, 9]]) < REACH_M]
            turn, place = matrix[:3, :3], matrix[:3, 3]
            pose = optipmb.Pose(place.copy(), np.roll(Rotation.from_matrix(turn).as_quat(), 1))
            found = boxes[[box for box, _ in seen]].reshape(-1, 4)
            tracks = tracker.update(
                {"box": found, "class": [name.lower()] * len(found)}, t=0.1 * number, pose=pose, camera=one_camera
            )
            of_box = dict(zip(tracks.detection.tolist(), tracks.id.tolist(), strict=True))
            labels = truth[[label for _, label in seen]].reshape(-1, 12)
            for row, label in enumerate(labels):
                numbers[stem, label[11]][of_box.get(row, -1)] += 1
            ahead = (np.array(tracks.center)[:, :2] - place[:2]) @ turn[:2, :2]
            shown = ahead[tracks.confirmed & (np.hypot(*ahead.T) < REACH_M)]
            shown = shown[np.abs(np.arctan2(shown[:, 1], shown[:, 0])) < SIDE]
            apart = np.hypot(*(labels[:, None, [9, 7]] * (1.0, -1.0) - shown[None]).transpose(2, 0, 1))
            rows = linear_sum_assignment(np.minimum(apart, WITHIN_M))
            hits = int((apart[rows] < WITHIN_M).sum())
            wrong, objects = wrong + len(labels) + len(shown) - 2 * hits, objects + len(labels)
    main = sum(max((count for number, count in one.items() if number > 0), default=0) for one in numbers.values())
    share, accuracy = FOLLOWED[name]
    assert main / objects >= 0.9 * share
    assert 1.0 - wrong / objects >= 0.9 * accuracy
