"""How long a step takes: `pytest benchmarks/test_tracker.py`, in milliseconds per frame.

KITTI-like frames at 10 Hz: cars, pedestrians and cyclists without velocity, one object per 16 m^2 on average, so that
gates overlap everywhere; a tenth is missed, a tenth is clutter, a third has low scores. Clouds hold 120,000 points, as
a 64-beam scan does. What is measured is one step from a settled density.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

import optipmb

if TYPE_CHECKING:
    from pytest_benchmark.fixture import BenchmarkFixture

PARAMETERS = optipmb.load_profile("kitti")
SIZES = np.array([[4.0, 1.7, 1.5], [0.6, 0.6, 1.7], [1.8, 0.6, 1.7]])
POINTS = 120_000
SETTLED = 10
MISSED = 0.1
HERE = optipmb.Pose(translation=np.array([0.0, 0.0, 1.7]), quaternion=np.array([1.0, 0.0, 0.0, 0.0]))


def scan(rng: np.random.Generator, center: np.ndarray, half: float) -> optipmb.PointCloud:
    """Points on the ground and on the objects, thinning out with distance like a real scan."""
    angle, distance = rng.uniform(-np.pi, np.pi, POINTS), rng.exponential(0.3 * half, POINTS)
    points = np.column_stack([distance * np.cos(angle), distance * np.sin(angle), rng.normal(-1.7, 0.05, POINTS)])
    on_objects = POINTS // 5
    points[:on_objects] = center[rng.integers(len(center), size=on_objects)] + rng.normal(0, 0.5, (on_objects, 3))
    return optipmb.PointCloud(points.astype(np.float32), HERE)


def frames(objects: int, *, clouds: bool) -> list[optipmb.Frame]:
    """A dense scene of so many objects, long enough to settle."""
    rng = np.random.default_rng(objects)
    half = 2.0 * np.sqrt(objects)
    label = rng.integers(0, 3, objects)
    place, heading = rng.uniform(-half, half, (objects, 2)), rng.uniform(-np.pi, np.pi, objects)
    speed = rng.uniform(0, [6.0, 1.5, 4.0], (objects, 3))[np.arange(objects), label]
    confidence = rng.beta(4, 1.5, objects)
    made = []
    for k in range(SETTLED + 1):
        seen = np.flatnonzero(rng.random(objects) > MISSED)
        clutter = objects // 10
        position = np.concatenate(
            [place[seen] + rng.normal(0, 0.1, (seen.size, 2)), rng.uniform(-half, half, (clutter, 2))]
        )
        labels = np.concatenate([label[seen], rng.integers(0, 3, clutter)])
        score = np.concatenate([confidence[seen] + rng.normal(0, 0.05, seen.size), rng.beta(2, 4, clutter)])
        center = np.column_stack([position, np.full(len(position), 0.8)])
        frame, _ = optipmb.make_frame(
            PARAMETERS,
            stamp_ns=k * 100_000_000,
            labels=PARAMETERS.labels,
            label=labels,
            center=center,
            size=SIZES[labels],
            yaw=np.concatenate([heading[seen], rng.uniform(-np.pi, np.pi, clutter)]),
            score=np.clip(score, 0.01, 1.0),
            cloud=scan(rng, center, half) if clouds else None,
        )
        made.append(frame)
        place = place + 0.1 * speed[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])
    return made


@pytest.mark.parametrize("clouds", [False, True], ids=["boxes", "boxes+cloud"])
@pytest.mark.parametrize("objects", [10, 100, 400, 800])
def test_step(benchmark: BenchmarkFixture, objects: int, clouds: bool) -> None:  # noqa: FBT001 - parametrized
    """One step of the full tracker from a settled density."""
    *before, last = frames(objects, clouds=clouds)
    tracker = optipmb.Tracker(PARAMETERS)
    density = tracker.initial()
    for frame in before:
        density = tracker.step(density, frame).density
    result = benchmark(tracker.step, density, last)
    benchmark.extra_info["measurements"] = result.diagnostics.detections
    benchmark.extra_info["bernoullis"] = len(result.density.bernoulli)
    assert len(result.tracks) > 0.5 * objects
