"""The tracker that keeps its density: what it takes, what it gives, and what it refuses."""

from __future__ import annotations

from importlib.metadata import version
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

import optipmb

BOX = {"center": [[0.0, 0.0, 0.8]], "size": [[4.5, 1.9, 1.6]], "yaw": [0.0], "score": [0.9]}


def flat(k: int, name: Any = "car") -> dict[str, list[Any]]:
    """Give one car as flat columns, a metre further with each frame."""
    row = {"x": float(k), "y": 0.0, "z": 0.8, "l": 4.5, "w": 1.9, "h": 1.6, "yaw": 0.0, "score": 0.9, "class": name}
    return {key: [value] for key, value in row.items()}


def run(frames: list[Any]) -> list[optipmb.OnlineTracks]:
    """Track some frames at 10 Hz."""
    tracker = optipmb.OnlineTracker("kitti")
    return [tracker.update(boxes, t=0.1 * k) for k, boxes in enumerate(frames)]


def test_it_gives_the_tracks_of_the_pure_steps() -> None:
    """The object is the pure function and nothing else: the same tracks, bit by bit."""
    parameters = optipmb.load_profile("kitti")
    tracker = optipmb.Tracker(parameters)
    density = tracker.initial()
    for k, found in enumerate(run([flat(k) for k in range(6)])):
        center = [[float(k), 0.0, 0.8]]
        frame, _ = optipmb.make_frame(
            parameters, stamp_ns=k * 100_000_000, labels=["Car"], label=[0], **{**BOX, "center": center}
        )
        result = tracker.step(density, frame)
        density, tracks = result.density, result.tracks
        for name in ("id", "center", "covariance", "existence"):
            assert getattr(found, name).tobytes() == getattr(tracks, name).tobytes()


def test_names_places_lists_arrays_and_tables_are_one() -> None:
    """Class names of any spelling, their places in the profile, dictionaries, arrays and tables give the same."""
    frames = [flat(k) for k in range(4)]
    first = run(frames)[-1]
    for others in (
        [flat(k, "Car") for k in range(4)],
        [flat(k, 0) for k in range(4)],
        [{name: np.array(values) for name, values in one.items()} for one in frames],
        [pa.table(one) for one in frames],
        [{**BOX, "center": [[float(k), 0.0, 0.8]], "label": ["vehicle.car"]} for k in range(4)],
    ):
        other = run(others)[-1]
        assert other.center.tobytes() == first.center.tobytes()
        assert other.name.tolist() == ["Car"]


def test_an_unknown_velocity_is_not_a_number() -> None:
    """Before the second detection nothing is known of the velocity; then there is a number."""
    tracks = run([flat(k) for k in range(3)])
    assert np.isnan(tracks[0].velocity).all()
    assert tracks[0].to_arrow()["vx"].null_count == 1
    assert tracks[2].velocity[0, 0] == pytest.approx(10.0, abs=1.5)


def test_nothing_detected_is_a_frame() -> None:
    """Without boxes the track is missed, and is still there."""
    tracks = run([*(flat(k) for k in range(4)), None])[-1]
    assert tracks.time_since_detection.tolist() == pytest.approx([0.1])
    assert tracks.columns()["detection"].tolist() == [-1]


@pytest.mark.parametrize(
    ("boxes", "when", "text"),
    [
        (flat(0, "barrier"), {"t": 1.0}, r"label\[0\]: expected one of Car, Pedestrian, Cyclist .* 'barrier'"),
        ({"x": [1.0]}, {"t": 1.0}, "center: expected a column for each of center, size, yaw, score, label"),
        (flat(0), {}, "t: expected t .s. or stamp_ns .ns., received neither"),
        (flat(0), {"t": float("nan")}, "t: expected finite seconds"),
        ({**flat(0), "yaw": [float("nan")]}, {"t": 1.0}, r"yaw\[0\]: expected a finite number"),
        ({**flat(0), "score": [3.0]}, {"t": 1.0}, r"score\[0\]"),
        (flat(0), {"t": 0.1}, "stamp_ns: expected a stamp from"),
    ],
)
def test_what_is_wrong_is_named_and_changes_nothing(boxes: Any, when: dict[str, float], text: str) -> None:
    """An error names the column and the row, and the density stays as it was."""
    tracker = optipmb.OnlineTracker("kitti")
    tracker.update(flat(0), t=0.5)
    before = tracker.density
    with pytest.raises(optipmb.FrameError, match=text):
        tracker.update(boxes, **when)
    assert tracker.density is before


def test_classes_that_are_left_out_are_counted() -> None:
    """On request, detections of classes that the profile lacks are left out and counted."""
    tracker = optipmb.OnlineTracker("kitti", unknown_classes="leave out")
    assert tracker.update(flat(0, "barrier"), t=0.0).left_out == 1


def test_a_reset_uses_no_id_again() -> None:
    """After a reset tracks get new ids."""
    tracker = optipmb.OnlineTracker(optipmb.generic_parameters(["car"], 0.1))
    first = [tracker.update(flat(k), t=0.1 * k) for k in range(4)][-1].id
    tracker.reset()
    second = [tracker.update(flat(k), t=0.1 * k) for k in range(4)][-1].id
    assert len(first) == len(second) == 1
    assert second[0] > first[0]


def test_the_version_comes_from_one_place() -> None:
    """`optipmb.__version__` is what the installation says."""
    assert optipmb.__version__ == version("optipmb")
