"""No public call crashes the interpreter: what does not fit is refused, and kernels stay within their arrays."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scenes import boxes

import optipmb
from optipmb.model.density import check_fitting, labels_within
from optipmb.warm import compilations

KITTI, NUSCENES = optipmb.load_profile("kitti"), optipmb.load_profile("nuscenes")
HERE = Path(__file__).parent


def settled() -> optipmb.Density:
    """A density with an object and a component."""
    tracker = optipmb.Tracker(KITTI)
    frame = boxes(KITTI, 0.0, [(0, 0), (30, 0)], score=[0.9, 0.4])
    density = tracker.step(tracker.initial(), frame).density
    assert (len(density.bernoulli), len(density.poisson)) == (1, 1)
    return density


def test_a_frame_of_other_classes_is_refused() -> None:
    """Seven labels of one profile do not go through a tracker of three, with any frame."""
    tracker = optipmb.Tracker(KITTI)
    for xy in ((), (0, 0)):
        with pytest.raises(optipmb.FrameError, match="labels"):
            tracker.step(tracker.initial(), boxes(NUSCENES, 0.0, xy, label="truck"))


def test_a_density_of_other_classes_is_refused() -> None:
    """A density keeps the labels that it was made with."""
    with pytest.raises(optipmb.FrameError, match=r"density\.labels"):
        optipmb.Tracker(NUSCENES).step(settled(), boxes(NUSCENES, 1.0))


@pytest.mark.parametrize("part", ["bernoulli", "poisson"])
def test_a_density_whose_columns_do_not_fit_is_refused(part: str) -> None:
    """Every column of another length, a label that is none, a list: each is named, and no kernel compiled for it."""
    density = settled()
    rows = getattr(density, part)
    optipmb.warm_up()
    before = compilations()
    for name, column in rows.columns():
        for values in (np.concatenate([column, column]), column[:0], column.tolist()):
            with pytest.raises(optipmb.DensityError, match=part):
                rows.replaced(**{name: values})
    for label in (rows.label + 7, rows.label - 1):
        changed = replace(density, **{part: rows.replaced(label=label)})
        with pytest.raises(optipmb.DensityError, match=f"{part}.label"):
            optipmb.Tracker(KITTI).step(changed, boxes(KITTI, 0.1, (0, 0)))
    assert compilations() == before


def test_labels_are_within_the_classes() -> None:
    """Of objects and of components: none is negative, none as large as the number of classes."""
    density = settled()
    for rows in (density.bernoulli, density.poisson):
        given = density.bernoulli.words, density.poisson.words
        largest = max(density.bernoulli.label[0], density.poisson.label[0])
        for label in range(-2, 5):
            before = int(rows.label[0])
            rows.label[0] = label
            assert labels_within(*given, 3) == (0 <= label < 3)
            rows.label[0] = before
        assert not labels_within(*given, int(largest))


def test_what_the_tracker_makes_fits() -> None:
    """The check passes the result of a step."""
    check_fitting(settled(), KITTI.labels)


def test_a_frame_cannot_be_written_to() -> None:
    """Checked arrays cannot be written to."""
    frame = boxes(KITTI, 0.0, (0, 0))
    for field in fields(frame):
        value = getattr(frame, field.name)
        if isinstance(value, np.ndarray):
            with pytest.raises(ValueError, match="read-only"):
                value[...] = 0


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("label", np.array([3])),
        ("label", np.array([-1])),
        ("label", np.array([0.5])),
        ("label", np.array([0, 0])),
        ("source", np.zeros((1, 1), np.int64)),
        ("center", np.zeros((1, 2))),
        ("center", np.full((1, 3), np.nan)),
        ("size", np.zeros((1, 3))),
        ("yaw", np.zeros(2)),
        ("velocity", np.zeros((2, 2))),
        ("score", np.array([0.0])),
        ("score", np.array([0.5, 0.5])),
        ("stamp_ns", -1),
    ],
)
def test_a_frame_made_by_hand_is_checked(name: str, values: Any) -> None:
    """`Frame` itself refuses what `make_frame` would not make."""
    with pytest.raises(optipmb.FrameError):
        replace(boxes(KITTI, 0.0, (0, 0)), **{name: values})


def test_a_score_of_zero_refuses_the_object_and_not_the_frame() -> None:
    """It is left out and counted, the others are tracked; negative scores and NaN refuse the frame."""
    given: dict[str, Any] = {"stamp_ns": 0, "labels": ["Car"], "label": [0, 0, 0], "size": [[4, 2, 1.5]] * 3}
    given |= {"center": [[0, 0, 0], [20, 0, 0], [40, 0, 0]], "yaw": [0, 0, 0]}
    frame, left_out = optipmb.make_frame(KITTI, score=[0.9, 0.0, 0.8], **given)
    assert left_out == 1
    np.testing.assert_array_equal(frame.source, [0, 2])
    for score in (-0.1, np.nan, 1.5):
        with pytest.raises(optipmb.FrameError, match=r"score\[1\]"):
            optipmb.make_frame(KITTI, score=[0.9, score, 0.8], **given)


@pytest.mark.parametrize(
    "call",
    [
        lambda cloud: optipmb.points_in_boxes(cloud, np.zeros((2, 3)), np.ones((1, 3)), np.zeros(2)),
        lambda cloud: optipmb.points_in_boxes(cloud, np.zeros((2, 3)), np.ones((2, 3)), np.zeros(1)),
        lambda cloud: optipmb.points_in_boxes(cloud, np.zeros((2, 2)), np.ones((2, 3)), np.zeros(2)),
        lambda _: optipmb.bev_iou(np.zeros((2, 4)), np.ones((2, 5))),
        lambda _: optipmb.bev_iou(np.ones((2, 5)), np.ones(5)),
    ],
)
def test_boxes_of_other_shapes_are_refused(call: Any) -> None:
    """The functions over boxes say which array does not fit."""
    pose = optipmb.Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
    with pytest.raises(optipmb.FrameError):
        call(optipmb.PointCloud(np.zeros((4, 3), np.float32), pose))


def test_tracks_whose_columns_do_not_fit_are_refused() -> None:
    """The one that is too short is named, or the next one where the first is."""
    tracker = optipmb.Tracker(KITTI)
    tracks = tracker.step(tracker.initial(), boxes(KITTI, 0.0, [(0, 0), (30, 0)])).tracks
    assert optipmb.sound(tracks)
    for name, column in tracks.columns():
        with pytest.raises(optipmb.FrameError, match=f"^tracks.{name if name != 'id' else 'label'}: expected"):
            tracks.replaced(**{name: column[:1]})


@pytest.mark.bounds
def test_kernels_stay_within_their_arrays(request: pytest.FixtureRequest) -> None:
    """With numba's bounds checks on, the public calls never index beyond an array, and raise nothing but refusals."""
    cache = request.config.cache
    assert cache is not None
    # Kernels with bounds checks are others, and need a cache of their own.
    environment = {"NUMBA_BOUNDSCHECK": "1", "NUMBA_CACHE_DIR": str(cache.mkdir("numba-bounds"))}
    found = subprocess.run(
        [sys.executable, str(HERE.parent / "support" / "hostile_calls.py")],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        timeout=900,
        check=False,
    )
    assert found.returncode == 0, found.stderr[-4000:]
    assert "kernels with bounds checks" in found.stdout
