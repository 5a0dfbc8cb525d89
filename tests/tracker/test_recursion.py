"""A step in one call beside the same stages called one by one."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from scenes import Options, frame_of, random_parameters, scene

import optipmb
from optipmb.parameters import parse_parameters
from optipmb.recursion import recursion

EVERYTHING = optipmb.FieldOfView(pose=optipmb.Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])))


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """For each step that was one call, the number of objects that it began with."""
    begun: list[int] = []

    def counted(*arguments: Any) -> Any:
        begun.append(len(arguments[0][0]))
        return recursion(*arguments)

    monkeypatch.setattr(optipmb.tracker, "recursion", counted)
    return begun


def in_stages(tracker: optipmb.Tracker) -> optipmb.Tracker:
    """Have a tracker call the stages one by one whatever it is given."""
    tracker._compiled = False
    return tracker


def written(result: optipmb.StepResult) -> dict[str, Any]:
    """All that a step gives: arrays as bytes with type and shape."""
    columns = {f"density.{name}": column for name, column in optipmb.columns_of(result.density).items()}
    columns |= {field.name: getattr(result.tracks, field.name) for field in fields(result.tracks)}
    given: dict[str, Any] = {name: (one.dtype, one.shape, one.tobytes()) for name, one in columns.items()}
    density = result.density
    return given | {"diagnostics": result.diagnostics, "next": (density.stamp_ns, density.next_id, density.labels)}


def parameters_of(which: str) -> optipmb.Parameters:
    """A shipped profile, or a random one by its seed."""
    if not which.isdecimal():
        return optipmb.load_profile(which)
    return parse_parameters(random_parameters(int(which), calibrated=int(which) % 2 > 0))


@pytest.mark.parametrize("two_thresholds", [True, False])
@pytest.mark.parametrize("which", ["generic", "kitti", "nuscenes", "0", "2", "3", "5", "6", "8"])
def test_one_call_gives_what_the_stages_give(calls: list[int], which: str, *, two_thresholds: bool) -> None:
    """Density, tracks and diagnostics are equal in every byte, in frames with gaps, ties, clutter and nothing."""
    parameters = parameters_of(which)
    modules = optipmb.Modules(ote=two_thresholds)
    tracker, staged = optipmb.Tracker(parameters, modules), in_stages(optipmb.Tracker(parameters, modules))
    density = tracker.initial()
    seed = sum(map(ord, which)) + two_thresholds
    options = Options(labels=parameters.labels, frames=24, period=parameters.nominal_period, clouds=0.0, missed=0.3)
    tracks = 0
    for number, given in enumerate(scene(seed, options)):
        frame = frame_of(parameters, given)
        if number % 8 == 6:  # nothing was detected
            some = np.zeros(0, np.int64)
            columns = {name: getattr(frame, name)[some] for name in ("center", "size", "yaw", "velocity", "score")}
            frame = replace(frame, **columns, label=frame.label[some], source=frame.source[some])
        result = tracker.step(density, frame)
        assert written(result) == written(staged.step(density, frame))
        density, tracks = result.density, tracks + len(result.tracks)
    assert len(calls) > 15
    assert max(calls) > 3
    assert tracks > 0


def test_what_one_call_cannot_do_is_done_in_stages(calls: list[int]) -> None:
    """With a cloud, a field of view, an own R, a stamp seen before, many pairs or a baseline, it is not one call."""
    parameters = optipmb.load_profile("kitti")
    tracker = optipmb.Tracker(parameters)
    options = Options(labels=parameters.labels, frames=8, irregular=False, clouds=0.0)
    first, *others = (frame_of(parameters, one) for one in scene(1, options))
    density = tracker.step(tracker.initial(), first).density
    assert calls == []
    frame = others[0]
    assert tracker.step(density, frame).density.stamp_ns == frame.stamp_ns
    assert len(calls) == 1
    calls.clear()

    cloud = optipmb.PointCloud(np.zeros((4, 3), np.float32), optipmb.Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])))
    unknown = np.full((len(frame.score), 3), np.nan)
    for other in (
        replace(frame, cloud=cloud),
        replace(frame, field_of_view=EVERYTHING),
        replace(frame, position_covariance=unknown),
        replace(frame, stamp_ns=density.stamp_ns),
    ):
        tracker.step(density, other)
    seen = tracker.step(density, replace(frame, field_of_view=EVERYTHING)).density
    tracker.step(seen, others[1])
    pairs = (len(density.bernoulli) + len(density.poisson) + len(frame.score)) * len(frame.score)
    optipmb.Tracker(parameters, max_pairs=pairs - 1).step(density, frame)
    for off in ("habm", "rpp"):
        optipmb.Tracker(parameters, optipmb.Modules(**{off: False})).step(density, frame)
    assert calls == []
    optipmb.Tracker(parameters, max_pairs=pairs).step(density, frame)
    optipmb.Tracker(parameters, optipmb.Modules(adp=False)).step(density, replace(frame, cloud=cloud))
    assert len(calls) == 2


def test_columns_that_do_not_fit_are_named_as_by_the_stages(calls: list[int]) -> None:
    """The error of a density made by hand says which column it is, and a list is not compiled for."""
    parameters = optipmb.load_profile("kitti")
    tracker = optipmb.Tracker(parameters)
    options = Options(labels=parameters.labels, frames=6, irregular=False, clouds=0.0)
    *before, last = (frame_of(parameters, one) for one in scene(2, options))
    density = tracker.initial()
    for frame in before:
        density = tracker.step(density, frame).density
    objects = density.bernoulli
    for name, wrong in (
        ("score", replace(objects, score=objects.score[1:])),
        ("label", replace(objects, label=objects.label + 99)),
    ):
        with pytest.raises(optipmb.DensityError, match=rf"bernoulli\.{name}"):
            tracker.step(replace(density, bernoulli=wrong), last)
    calls.clear()
    listed: Any = objects.score.tolist()
    with pytest.raises(optipmb.DensityError, match=r"bernoulli\.score"):
        tracker.step(replace(density, bernoulli=replace(objects, score=listed)), last)
    assert calls == []
