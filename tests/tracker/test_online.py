"""The tracker that keeps its density: input, output and refusals."""

from __future__ import annotations

import sys
import warnings
from datetime import UTC, datetime
from enum import Enum
from importlib.metadata import version
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from matplotlib.figure import Figure

import optipmb

OTHER = {"l": "length", "w": "width", "h": "height", "yaw": "heading", "score": "confidence", "class": "category"}
BOX = {"center": [[0.0, 0.0, 0.8]], "size": [[4.5, 1.9, 1.6]], "yaw": [0.0], "score": [0.9]}


class Kind(str, Enum):  # noqa: UP042  as code for Python 3.10 has it
    CAR = "car"


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
        [[{name: values[0] for name, values in one.items()}] for one in frames],
        [
            np.array([tuple(v[0] for v in one.values())], [(n, "U9" if n == "class" else "f8") for n in one])
            for one in frames
        ],
        [{OTHER.get(name, name): values for name, values in one.items()} for one in frames],
        [{**BOX, "center": [[float(k), 0.0, 0.8]], "label": ["vehicle.car"]} for k in range(4)],
        [pa.table({**BOX, "center": [[float(k), 0.0, 0.8]], "label": ["car"]}) for k in range(4)],
        [flat(k, Kind.CAR) for k in range(4)],
        [{name: np.array(values, np.object_) for name, values in flat(k, Kind.CAR).items()} for k in range(4)],
    ):
        other = run(others)[-1]
        assert other.center.tobytes() == first.center.tobytes()


def test_masked_numbers_are_unknown() -> None:
    """A masked heading, size or height is as NaN, and its number below the mask plays no part."""
    hidden = {"yaw": np.ma.array([3.0], mask=True), "h": np.ma.array([99], mask=True)}
    shown = {"yaw": [np.nan], "h": [np.nan]}
    first, second = (run([flat(k) | change for k in range(4)])[-1] for change in (hidden, shown))
    np.testing.assert_array_equal(first.tracks.size, second.tracks.size)
    np.testing.assert_array_equal(first.yaw, second.yaw)


def test_classes_have_the_names_that_the_detections_gave() -> None:
    """A class is called as its first detection called it; without one, as the profile does."""
    assert [run([flat(0, name)])[0].name.tolist() for name in ("car", "vehicle.car", 0)] == [
        ["car"],
        ["vehicle.car"],
        ["Car"],
    ]


def test_columns_that_tables_may_lack_have_the_values_of_tables() -> None:
    """Without z it is 0, without height 1.5 m, without scores 1."""
    box = {name: values for name, values in flat(0).items() if name not in {"z", "h", "score"}}
    given = run([{**box, "z": [0.0], "h": [1.5], "score": [1.0]}])[0]
    assert run([box])[0].tracks.words.tobytes() == given.tracks.words.tobytes()


def test_a_date_is_a_time() -> None:
    """Dates of datetime and numpy give the stamp of their seconds since 1970."""
    tracker = optipmb.OnlineTracker("kitti")
    dates = (
        datetime(2026, 1, 1, tzinfo=UTC),
        np.datetime64("2026-01-01T00:00:00.1"),
        datetime(2026, 1, 1, 0, 0, 1, tzinfo=UTC).replace(tzinfo=None),
    )
    stamps = [tracker.update(flat(0), t=date).stamp_ns for date in dates]
    assert stamps == [1_767_225_600_000_000_000 + ms * 1_000_000 for ms in (0, 100, 1000)]


def test_the_representation_lists_tracks() -> None:
    """A notebook shows ids, classes, positions and existence; `dir` has the columns."""
    tracks = run([flat(k) for k in range(3)])[-1]
    head, names, row = repr(tracks).splitlines()
    assert head == "OnlineTracks: 1 tracks at 0.200 s"
    assert names.split() == ["id", "class", "x", "y", "vx", "vy", "existence"]
    assert row.split()[:2] == ["1", "car"]
    assert {"id", "center", "covariance", "confirmed"} <= set(dir(tracks))


def test_a_notebook_shows_confirmed_tracks() -> None:
    """The tracker says profile, time and tracks; confirmed tracks are a drawing and a table."""
    tracker = optipmb.OnlineTracker()
    assert repr(tracker) == "OnlineTracker: profile generic, no frame yet"
    weak = {name: [*values, *values] for name, values in flat(0).items()} | {"x": [0.0, 30.0], "score": [0.9, 0.2]}
    for k in range(4):
        tracks = tracker.update(weak, t=0.1 * k)
    assert repr(tracker) == "OnlineTracker: profile generic, 1 tracks at 0.300 s, 1 not confirmed"
    page = tracks._repr_html_()
    assert "1 tracks at 0.300 s, 1 not confirmed" in page
    assert page.count("<tr>") == 2
    assert "<svg" in page


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
        ({"yaw": [1.0]}, {"t": 1.0}, "center: expected the columns x and y, or center, received the columns yaw"),
        ({"x": [1.0]}, {"t": 1.0}, "y: expected the columns x and y, received the columns x"),
        ({**flat(0), "vx": [1.0]}, {"t": 1.0}, "vy: expected the columns vx and vy"),
        ({**flat(0), "velocity_x": [1.0]}, {"t": 1.0}, "velocity_x: expected columns among center, "),
        ({**flat(0), "x": ["far"]}, {"t": 1.0}, "x: expected numbers, received list of ..far"),
        ({**flat(0), "y": [1.0, 2.0]}, {"t": 1.0}, "y: expected .1,. numbers, one for each box, received .2,."),
        ([flat(0), {"x": 1.0}], {"t": 1.0}, "boxes: expected a dictionary with the same keys for each box"),
        (np.zeros((1, 7)), {"t": 1.0}, "boxes: expected a structured array, or columns by name"),
        (flat(0), {"t": "noon"}, "t: expected seconds or a date, received 'noon'"),
        (flat(0), {"t": np.datetime64("NaT")}, "t: expected seconds or a date, received NaT"),
        ({**flat(0), "heading": [0.0]}, {"t": 1.0}, "heading: expected one column for each meaning, .* yaw, heading"),
        ({**BOX, "label": [0], "length": [4.5]}, {"t": 1.0}, "length: expected one column for each meaning, .* size, "),
        ({**flat(0), "center": [[0.0, 0.0, 0.8]]}, {"t": 1.0}, "center: expected one column for each meaning, .* x, y"),
        (flat(0), {}, "t: expected t .s. or stamp_ns .ns., received neither"),
        (flat(0), {"t": float("nan")}, "t: expected finite seconds"),
        ({**flat(0), "yaw": [float("inf")]}, {"t": 1.0}, r"yaw\[0\]: expected radians from -6.4 to 6.4"),
        ({**flat(0), "w": [0.0]}, {"t": 1.0}, r"size\[0\]\[1\]: expected a positive length"),
        ({**flat(0), "x": [float("nan")]}, {"t": 1.0}, r"center\[0\]\[0\]: expected a finite number"),
        ({**flat(0), "score": [3.0]}, {"t": 1.0}, r"score\[0\]"),
        (flat(0), {"t": 0.1}, "t: expected a time from 0.5 s on, in seconds, received 0.1"),
        (flat(0), {"t": -1}, "t: expected a time from 0.5 s on"),
        (flat(0), {"t": 1.7e18}, "t: expected a time from 0.5 s on, in seconds, received 1.7e.18"),
        (flat(0), {"t": 1.0, "pose": np.eye(4)}, "pose: expected an optipmb.Pose .* received ndarray"),
        ({**flat(0), "l": 4.5}, {"t": 1.0}, "l: expected numbers, one for each box, received 4.5"),
        ({**flat(0), "x": np.ma.array([5.0], mask=True)}, {"t": 1.0}, r"center\[0\]\[0\]: .* received nan"),
        (
            {**flat(0), "class": np.ma.array([1], mask=True)},
            {"t": 1.0},
            r"label\[0\]: expected a class, .* received nan",
        ),
        (flat(0), {"stamp_ns": 1}, "stamp_ns: expected a stamp from"),
    ],
)
def test_what_is_wrong_is_named_and_changes_nothing(boxes: Any, when: dict[str, Any], text: str) -> None:
    """An error names the column and the row, and the density stays as it was."""
    tracker = optipmb.OnlineTracker("kitti")
    tracker.update(flat(0), t=0.5)
    before = tracker.density
    with pytest.raises(optipmb.FrameError, match=text):
        tracker.update(boxes, **when)
    assert tracker.density is before


@pytest.mark.parametrize(
    ("unit", "change", "text"),
    [
        (1e3, {}, r"t: expected seconds .*, received 2 frames in succession, the last 100 s after the one before"),
        (0.0, {}, r"t: expected seconds .*, received 20 frames in succession, the last 0 s after"),
        (1.0, {"l": [1.9], "w": [4.5]}, "size: expected length, width, height.*, received 100 of 100 vehicles wider"),
        (1.0, {"l": [4500.0], "w": [1900.0]}, "size: .* in metres, received 100 of 100 boxes of sizes as 4500"),
    ],
)
def test_numbers_of_another_meaning_are_doubted_once(unit: float, change: dict[str, Any], text: str) -> None:
    """Times that are not in seconds, millimetres, and widths before lengths bring one warning."""
    tracker = optipmb.OnlineTracker()
    with pytest.warns(UserWarning, match=text) as warnings:
        _ = [tracker.update({**flat(k), **change}, t=unit * 0.1 * k) for k in range(120)]
    assert len(warnings) == 1


@pytest.mark.parametrize("wrong", ["nothing", "unit", "axes", "relative"])
def test_velocities_that_contradict_the_boxes_are_doubted_once(wrong: str) -> None:
    """Velocities in km/h, along other axes or relative to the sensor bring one warning; true ones with noise none."""
    tracker, rng = optipmb.OnlineTracker(), np.random.default_rng(1)
    speed = np.array([7.0, -8.0, 9.0, -10.0, 11.0, 0.0, 0.0, 0.0])
    boxes = {"y": 8.0 * np.arange(8), "l": [4.5] * 8, "w": [1.9] * 8, "yaw": [0.0] * 8, "label": "car"}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for k in range(120):
            vx, vy = speed + rng.normal(0.0, 1.0, 8), rng.normal(0.0, 1.0, 8)
            given = {"unit": (3.6 * vx, 3.6 * vy), "axes": (-vy, -vx), "relative": (vx - 15.0, vy)}.get(wrong, (vx, vy))
            x = speed * 0.1 * k + rng.normal(0.0, 0.2, 8)
            tracker.update({"x": x, "vx": given[0], "vy": given[1], **boxes}, t=0.1 * k)
    texts = [str(one.message) for one in caught]
    assert len(texts) == (wrong != "nothing")
    assert all(text.startswith("velocity: expected metres per second over ground") for text in texts)


def test_slow_frames_and_frames_in_parts_are_not_doubted() -> None:
    """A frame every five seconds is none too few, and the classes of one time may come one after the other."""
    slow, parts = optipmb.OnlineTracker(), optipmb.OnlineTracker()
    for k in range(40):
        slow.update(flat(0), t=5.0 * k)
        parts.update(flat(k), t=0.1 * (k // 2))


def test_boxes_without_a_class_are_objects() -> None:
    """As in tables: a profile with the class `object` tracks them, another one says what to do."""
    boxes = {"x": [1.0], "y": [2.0], "l": [4.0], "w": [2.0], "yaw": [0.0]}
    tracker = optipmb.OnlineTracker(optipmb.generic_parameters(["object"], 0.1))
    assert tracker.update(boxes, t=0.0).name.tolist() == ["object"]
    with pytest.raises(optipmb.FrameError, match=r"expected a column class, as car: without one .*\['object'\]"):
        optipmb.OnlineTracker().update(boxes, t=0.0)


def test_one_class_is_of_all_boxes_and_none_is_no_column() -> None:
    """A single name stands for each box; a column of None is absent."""
    boxes = {"center": [[0.0] * 3, [20.0] * 3], "size": None, "label": "car", "score": [0.9, 0.8]}
    assert optipmb.OnlineTracker().update(boxes, t=0.0).name.tolist() == ["car", "car"]


def test_classes_that_are_left_out_are_counted() -> None:
    """On request, detections of classes that the profile lacks are left out and counted."""
    tracker = optipmb.OnlineTracker("kitti", unknown_classes="leave out")
    assert tracker.update(flat(0, "barrier"), t=0.0).left_out == 1


def test_auto_needs_a_recording() -> None:
    """The error names what to take in its place."""
    with pytest.raises(optipmb.ParameterError, match="generic_parameters"):
        optipmb.Tracker("auto")
    assert optipmb.Tracker("kitti").parameters == optipmb.load_profile("kitti")


def test_tracks_go_to_other_tools(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lines of KITTI, boxes of nuScenes, image boxes of supervision, and a picture with ids and classes."""
    tracks = run([flat(10 + k) for k in range(6)])[-1]
    pose = optipmb.Pose(np.array([5.0, 0.0, 0.0]), np.array([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]))  # looks along y
    for given, (x, y, z), turn in ((None, (0.0, 0.0, 15.0), -np.pi / 2), (pose, (10.0, 0.0, 0.0), 0.0)):
        (line,) = tracks.to_kitti(7, given)
        fields = line.split()
        assert fields[:3] == ["7", "1", "car"]
        assert [float(one) for one in fields[10:17]] == pytest.approx([1.6, 1.9, 4.5, x, y, z, turn], abs=0.3)
    (box,) = tracks.to_nuscenes("token")
    assert (box["sample_token"], box["tracking_id"], box["tracking_name"]) == ("token", "1", "car")
    assert box["size"] == pytest.approx([1.9, 4.5, 1.6])
    monkeypatch.setitem(sys.modules, "supervision", SimpleNamespace(Detections=SimpleNamespace))
    camera = np.array([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]])
    axes = np.array([[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.8], [1.0, 0.0, 0.0, 0.0]])
    seen = tracks.to_supervision(camera @ axes)
    half = 500 / (15 - 2.25)
    expected = [320 - 0.95 * half, 240 - 0.8 * half, 320 + 0.95 * half, 240 + 0.8 * half]
    assert seen.xyxy[0] == pytest.approx(expected, abs=3.0)
    assert seen.tracker_id.tolist() == [1]
    drawn = tracks.plot(Figure().subplots())
    assert [text.get_text() for text in (*drawn.texts, *drawn.get_legend().get_texts())] == ["1", "car"]


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
