"""How long the kernels take, each alone, on the dense scene: `make bench`, or `pytest benchmarks/test_kernels.py`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from settled import PARAMETERS, settled

import optipmb
from optipmb.filter.association import associate
from optipmb.filter.class_posterior import UNGROUPED, Groups
from optipmb.filter.detection_probability import points_in_boxes
from optipmb.filter.hypotheses import UNLIMITED, local_hypotheses
from optipmb.filter.predict import predict
from optipmb.filter.preprocess import non_maximum_suppression, preprocess
from optipmb.model.density import Density, Moment, components_in, objects_in
from optipmb.model.table import CLASS, ClassTable

if TYPE_CHECKING:
    from pytest_benchmark.fixture import BenchmarkFixture

TABLE = ClassTable.of(PARAMETERS)
OBJECTS = pytest.mark.parametrize("objects", [10, 100, 800])


def moment(density: Density, frame: optipmb.Frame) -> Moment:
    """The time of a frame."""
    dt = (frame.stamp_ns - density.stamp_ns) * 1e-9
    return Moment(frame.stamp_ns, density.stamp_ns, dt, TABLE.period)


@OBJECTS
def test_predict(benchmark: BenchmarkFixture, objects: int) -> None:
    """Unscented transforms of all objects and components."""
    _, density, frame = settled(objects)
    predicted, repaired = benchmark(predict, density, moment(density, frame), TABLE)
    assert (len(predicted.bernoulli), repaired) == (len(density.bernoulli), 0)


@OBJECTS
def test_preprocess(benchmark: BenchmarkFixture, objects: int) -> None:
    """Canonical order, score filter and suppression."""
    _, _, frame = settled(objects)
    measurements, _, below, suppressed = benchmark(preprocess, frame, TABLE)
    assert len(measurements.score) + below + suppressed == len(frame.score)


@pytest.mark.parametrize("apart", [1.0, 6.0], ids=["heap", "street"])
def test_suppression(benchmark: BenchmarkFixture, apart: float) -> None:
    """A thousand boxes, heaped upon each other or side by side."""
    rng = np.random.default_rng(0)
    boxes = rng.uniform([-16, -16, 3, 1.5, -3], [16, 16, 5, 2, 3], (1000, 5))
    boxes[:, :2] *= apart
    classes = np.zeros(1, CLASS)
    classes["nms_iou"] = 0.1
    given = boxes, np.full(1000, 0.5), np.zeros(1000, np.int64), classes, UNLIMITED
    keep = benchmark(non_maximum_suppression, *given)
    assert 0 < keep.sum() < 1000


def before_association(objects: int) -> tuple[Any, ...]:
    """The arguments of `local_hypotheses`."""
    _, density, frame = settled(objects)
    density, _ = predict(density, moment(density, frame), TABLE)
    measurements, *_ = preprocess(frame, TABLE)
    old, new = density.bernoulli, density.poisson
    p_d = TABLE["detection"][np.concatenate((old.label, new.label))]
    known, undetected = objects_in(old.words), components_in(new.words)
    return known, undetected, p_d, measurements, Groups(UNGROUPED, TABLE.confusion), TABLE.period, TABLE.classes


@OBJECTS
def test_hypotheses(benchmark: BenchmarkFixture, objects: int) -> None:
    """Gates, likelihoods and costs."""
    found = benchmark(local_hypotheses, *before_association(objects))
    assert len(found.row) > 0.5 * objects


@OBJECTS
def test_associate(benchmark: BenchmarkFixture, objects: int) -> None:
    """Clusters and assignment."""
    given = before_association(objects)
    found = local_hypotheses(*given)
    pairs = found.row, found.measurement, found.detection_cost, found.first_cost
    assigned = benchmark(associate, *pairs, given[2].size)
    assert (assigned >= 0).sum() > 0.5 * objects


@pytest.mark.parametrize("boxes", [0, 100])
@pytest.mark.parametrize("points", [30_000, 120_000])
def test_points_in_boxes(benchmark: BenchmarkFixture, points: int, boxes: int) -> None:
    """One pass over a cloud."""
    _, density, frame = settled(100, points)
    assert frame.cloud is not None
    objects = density.bernoulli
    center = np.column_stack([objects.mean[:, :2], objects.auxiliary[:, 3]])[:boxes]
    counts = benchmark(
        points_in_boxes, frame.cloud, center, objects.auxiliary[:boxes, :3], objects.mean[:boxes, 3].copy()
    )
    assert counts.sum() >= 0


@pytest.mark.parametrize("objects", [10, 100, 800])
def test_make_frame(benchmark: BenchmarkFixture, objects: int) -> None:
    """The check of detections, and their way from the sensor to the world."""
    _, _, frame = settled(objects)
    pose = optipmb.Pose(np.array([1.0, 2.0, 0.0]), np.array([1.0, 0.0, 0.0, 0.0]))
    made, left_out = benchmark(
        optipmb.make_frame,
        PARAMETERS,
        stamp_ns=frame.stamp_ns,
        labels=PARAMETERS.labels,
        label=frame.label,
        center=frame.center,
        size=frame.size,
        yaw=frame.yaw,
        score=frame.score,
        pose=pose,
    )
    assert (len(made.score), left_out) == (len(frame.score), 0)
