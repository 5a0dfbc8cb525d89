"""Covariances that have lost their rank, weights next to nothing, long silences: finite, repaired, counted, shown."""

from dataclasses import replace

import numpy as np
import optipmb_schemas as schemas
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from optipmb_service.session import convert
from optipmb_service.session.checkpoint import Checkpoint, decode_checkpoint, encode_checkpoint
from optipmb_service.session.session import Session
from optipmb_service.session.timeline import FrameId
from router import Sensor
from sessions import feed, tracks

import optipmb

NUSCENES = optipmb.load_profile("nuscenes")
SENSOR = Sensor()


def spoiled(checkpoint: Checkpoint, spoil: np.random.Generator, weight: float, scale: float) -> Checkpoint:
    """The checkpoint with covariances of rank one or two, of any size, and weights next to nothing."""
    density = checkpoint.head.density

    def covariances(count: int) -> np.ndarray:
        root = spoil.normal(size=(count, 6, 2)) * scale
        root[::2, :, 1] = 0.0
        return root @ root.transpose(0, 2, 1)

    bernoulli, poisson = density.bernoulli, density.poisson
    bernoulli = bernoulli.replaced(
        covariance=covariances(len(bernoulli)), existence=np.full(len(bernoulli), max(weight, 1e-300))
    )
    poisson = poisson.replaced(covariance=covariances(len(poisson)), weight=np.full(len(poisson), weight))
    state = replace(checkpoint.head, density=replace(density, bernoulli=bernoulli, poisson=poisson))
    return replace(checkpoint, base=state, window=(), head=state)


@settings(max_examples=20, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    weight=st.sampled_from([1e-300, 1e-200, 1e-30, 0.5, 1.0]),
    scale=st.sampled_from([1e-160, 1e-8, 1.0, 1e2]),
)
def test_nothing_in_the_output_is_ever_nan(seed: int, weight: float, scale: float) -> None:
    """From any such density the next frames are tracked, and all that comes out is finite: the messages check that."""
    one = Session(SENSOR.stream, NUSCENES)
    feed(one, range(4), SENSOR, score=np.array([0.9, 0.2, 0.05]))
    two = Session.restore(spoiled(one.snapshot(), np.random.default_rng(seed), weight, scale), 0)
    got = tracks(feed(two, range(4, 9), SENSOR))
    assert (len(got), two.quarantine) == (5, "")
    for name, column in optipmb.columns_of(two.density).items():
        assert np.isfinite(column).all(), name


def test_a_covariance_that_no_message_can_carry_is_not_published() -> None:
    """Standard deviations of a million in all that moves a car grow beyond any bound: quarantine, which says why."""
    one = Session(SENSOR.stream, NUSCENES)
    feed(one, range(4), SENSOR, score=np.array([0.9, 0.2, 0.05]))
    two = Session.restore(spoiled(one.snapshot(), np.random.default_rng(1), 1.0, 1e6), 0)
    assert tracks(feed(two, range(4, 9), SENSOR)) == []
    assert "covariance" in two.quarantine
    assert "expected a number in" in two.quarantine


def told(found: optipmb.Tracks, paths: optipmb.PredictedPaths | None = None) -> schemas.Tracks:
    empty = optipmb.Density.empty(NUSCENES.labels)
    return convert.tracks_of(
        optipmb.StepResult(empty, found, None, paths),  # type: ignore[arg-type]  # of the tracks alone
        SENSOR.stream,
        FrameId(SENSOR.epoch, 1, 2),
        session="0" * 32,
        revision=0,
        profile=NUSCENES.name,
        cloud_used=False,
        gap=0,
        ignored=0,
        labels=NUSCENES.labels,
    ).tracks


@settings(max_examples=20, deadline=None)
@given(data=st.data(), count=st.integers(0, 3))
def test_a_message_that_is_made_without_its_checks_would_pass_them(data: st.DataObject, count: int) -> None:
    """For any numbers in the tracks, near every bound of the message, it is valid or not made."""
    columns = {}
    for name in optipmb.Tracks.described:
        array = schemas.Tracks.arrays[name]
        shape = (count, *array.shape[1:])
        if name == "confirmed":
            columns[name] = data.draw(arrays(np.bool_, shape))
        elif array.dtype == "i8":
            top = len(NUSCENES.classes) - 1 if name == "label" else 9
            columns[name] = data.draw(arrays(np.int64, shape, elements=st.integers(0, top), unique=name == "id"))
        else:
            ends = [array.low, array.high, np.nextafter(array.high, np.inf), np.nextafter(array.low, -np.inf), np.nan]
            columns[name] = data.draw(
                arrays(np.float64, shape, elements=st.just(0.5) | st.sampled_from(ends), fill=st.just(0.5))
            )
    found = optipmb.Tracks(**columns)
    try:
        message = told(found)
    except schemas.MessageError:
        assert not optipmb.sound(found)
        return
    assert schemas.decode(schemas.encode(message), schemas.Tracks) == message
    assert all(not getattr(message, name).flags.writeable for name in columns)


@pytest.mark.parametrize("value", [1e12, 1.1e12, 1e31, 1e39, np.inf, np.nan])
@pytest.mark.parametrize("entry", ["position", "yaw", "covariance"])
def test_paths_that_no_message_can_carry_are_not_published(entry: str, value: float) -> None:
    """For any numbers in predicted paths, the message is valid, or it is not made and the error names the field."""
    found = tracks_after(4)
    count = len(found.id)
    mean, covariance = np.zeros((count, 2, 6)), np.broadcast_to(np.eye(6), (count, 2, 6, 6)).copy()
    if entry == "covariance":
        covariance[-1, -1, 1, 1] = value
    else:
        mean[-1, -1, 1 if entry == "position" else 3] = value
    paths = optipmb.PredictedPaths(found.id, found.label, np.array([0.5, 1.0]), mean, covariance)
    if (entry, value) == ("position", 1e12) or (entry == "covariance" and value < 1e13):
        message = told(found, paths)
        assert schemas.decode(schemas.encode(message), schemas.Tracks) == message
    else:
        with pytest.raises(schemas.MessageError, match=rf"path_{entry}\[{count - 1}\]\[1\]"):
            told(found, paths)


def tracks_after(frames: int) -> optipmb.Tracks:
    tracker = optipmb.Tracker(NUSCENES)
    density = tracker.initial()
    for seq in range(frames):
        frame, _ = convert.frame_of(NUSCENES, SENSOR.detections(seq))
        result = tracker.step(density, frame)
        density = result.density
    assert len(result.tracks)
    return result.tracks


def test_repairs_are_counted_and_shown() -> None:
    """Covariances without rank are repaired, counted in the session's state, and the count survives a checkpoint."""
    one = Session(SENSOR.stream, NUSCENES)
    feed(one, range(4), SENSOR)
    checkpoint = one.snapshot()
    without_rank = np.tile(np.diag([0.0, 0.0, 0.0, 0.0, 1.0, 0.0]), (3, 1, 1))  # of a known heading: omega varies
    bernoulli = checkpoint.head.density.bernoulli.replaced(covariance=without_rank)
    state = replace(checkpoint.head, density=replace(checkpoint.head.density, bernoulli=bernoulli))
    two = Session.restore(replace(checkpoint, base=state, window=(), head=state), 0)
    assert two.state().repaired == 0
    feed(two, [4], SENSOR)
    assert two.state().repaired > 0
    three = Session.restore(decode_checkpoint(encode_checkpoint(two.snapshot())), 0)
    assert three.state().repaired == two.state().repaired


def test_tracks_die_of_silence() -> None:
    """Four seconds without a frame: tracks of before are gone by time, not by frames, and covariance has grown."""
    one = Session(SENSOR.stream, NUSCENES)
    before = tracks(feed(one, range(5), SENSOR))[-1]
    assert len(before.id) == 3
    shortly = tracks(feed(one, [10], SENSOR, objects=0))[-1]
    spread = [np.trace(message.covariance[0]) for message in (before, shortly)]
    assert spread[1] > spread[0]
    assert (shortly.existence < before.existence[: len(shortly.id)]).all()
    after = tracks(feed(one, [50], SENSOR, objects=0))[-1]
    assert len(after.id) == 0
