"""How long a step takes: `make bench`, or `pytest benchmarks/test_tracker.py`.

Steps of the dense scene (`dense.py`) from a settled density, the bare arithmetic of the same frames, and recorded
sequences from their first frame to their last, detections checked, where the data are there.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from lower_bound import arguments, bare
from settled import PARAMETERS, PROFILES, recorded, settled

import optipmb
from optipmb.filter.lightweight import turn_around

if TYPE_CHECKING:
    from pytest_benchmark.fixture import BenchmarkFixture

OBJECTS = (10, 20, 50, 100, 200, 400, 800)


@pytest.mark.parametrize("points", [0, 30_000, 120_000])
@pytest.mark.parametrize("objects", OBJECTS)
@pytest.mark.parametrize("profile", PROFILES)
def test_step(benchmark: BenchmarkFixture, profile: str, objects: int, points: int) -> None:
    """One step of the full tracker."""
    tracker, density, frame = settled(objects, points, profile)
    result = benchmark(tracker.step, density, frame)
    benchmark.extra_info["measurements"] = result.diagnostics.detections
    benchmark.extra_info["bernoullis"] = len(result.density.bernoulli)
    assert result.diagnostics.cloud_used == (points > 0)
    assert len(result.tracks) > 0.5 * objects


@pytest.mark.parametrize("objects", OBJECTS)
def test_bare_arithmetic(benchmark: BenchmarkFixture, objects: int) -> None:
    """The lower bound of the step; its updates equal the tracker's bit by bit."""
    tracker, density, frame = settled(objects)
    given = arguments(PARAMETERS, density, frame)
    benchmark(bare, *given)
    means = {row.tobytes() for row in tracker.step(density, frame).density.bernoulli.mean}
    assert len(given[-2]) > 0.5 * objects
    for row, covariance in zip(given[-2], given[-1], strict=True):
        if row.tobytes() not in means:  # the tracker has found that the object faces the other way
            turn_around(row, covariance)
            assert row.tobytes() in means


@pytest.mark.parametrize("dataset", ["kitti", "nuscenes"])
def test_sequence(benchmark: BenchmarkFixture, dataset: str) -> None:
    """All frames of the recorded sequences."""
    parameters, runs = recorded(dataset)
    tracker = optipmb.Tracker(parameters)

    def track() -> int:
        frames = 0
        for run in runs:
            density = tracker.initial()
            for given in run:
                frame, _ = optipmb.make_frame(parameters, **given | {"pose": optipmb.Pose(*given["pose"])})
                density = tracker.step(density, frame).density
                frames += 1
        return frames

    frames = benchmark.pedantic(track, rounds=5, warmup_rounds=1)
    benchmark.extra_info["frames"] = frames
    assert frames > 30
