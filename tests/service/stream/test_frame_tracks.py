"""Output tracks: bytes composed without a message equal the encoded message."""

from typing import Any

import numpy as np
import optipmb_schemas as schemas
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from optipmb_service.session.convert import tracks_of
from optipmb_service.session.outputs import TrackedFrame
from optipmb_service.session.timeline import FrameId

import optipmb
from optipmb.joining.decision import Joined

FRAME = FrameId(b"0" * 16, 1, 2)
PARAMETERS = optipmb.load_profile("generic")


def sound_tracks(count: int) -> optipmb.Tracks:
    rng = np.random.default_rng(count)
    columns: dict[str, Any] = {}
    for name, one in optipmb.Tracks.described.items():
        numbers = rng.uniform(0.01, 1.0, (count, *one.shape))
        columns[name] = numbers > 0.5 if one.number == np.bool_ else numbers.astype(one.number)
    return optipmb.Tracks(**columns | {"id": np.arange(count) * 3})


def made(tracks: optipmb.Tracks, *parts: Any, frame_id: FrameId = FRAME, **fields: Any) -> TrackedFrame:
    """Tracks of a frame, with parts of the tracker's result that few profiles have."""
    header: dict[str, Any] = {"session": "0" * 32, "revision": 0, "profile": PARAMETERS.name, "cloud_used": False}
    header |= {"gap": 0, "ignored": 0, "labels": PARAMETERS.labels}
    empty = optipmb.Density.empty(PARAMETERS.labels)
    result = optipmb.StepResult(empty, tracks, None, *parts)  # type: ignore[arg-type]  # of the tracks alone
    return tracks_of(result, fields.pop("stream", "a/b/c"), frame_id, **header | fields)


def delivery(run: int) -> dict[str, Any]:
    times = {"queue_ms": 0.5, "decode_ms": 0.0, "step_ms": 1e-3}
    return {"instance": "one", "received_ns": 2**60, "published_ns": 2**61, **times, "run": run}


@given(
    count=st.integers(0, 150),
    node=st.integers(1, 60),
    sensor=st.booleans(),
    seq=st.sampled_from([0, 127, 128, 2**16, 2**63 - 1]),
    run=st.integers(0, 300),
)
@example(count=0, node=1, sensor=False, seq=0, run=0)
@example(count=14, node=2, sensor=True, seq=1, run=0)
@example(count=15, node=3, sensor=False, seq=1, run=1)
def test_bytes_are_those_of_the_message(*, count: int, node: int, sensor: bool, seq: int, run: int) -> None:
    """Any number of tracks, at any place in the message, of one sensor or of several."""
    frame_id = FrameId(b"0" * 16, seq, 2**60, "a/b/d" if sensor else "")
    stream = f"site/{'n' * node}/lidar"
    tracks = made(sound_tracks(count), stream=stream, frame_id=frame_id, gap=run, revision=run)
    values = delivery(run)
    payload = tracks.encoded(values)
    assert payload == schemas.encode(tracks.tracks, delivery=schemas.Delivery(**values))
    message = schemas.decode(payload, schemas.Tracks)
    assert (message.seq, message.sensor, len(message.id)) == (seq, frame_id.sensor or None, count)
    for name, column in tracks.estimates.columns():
        np.testing.assert_array_equal(getattr(message, name), column)


@pytest.mark.parametrize("count", [0, 3, 130])
def test_what_few_sessions_have_is_in_the_bytes(count: int) -> None:
    """Paths, classes, objects and a motion of the world come behind the columns, as in the message, also large ones."""
    one = sound_tracks(count)
    mean, covariance = np.zeros((count, 5, 6)), np.broadcast_to(np.eye(6), (count, 5, 6, 6))
    paths = optipmb.PredictedPaths(one.id, one.label, np.arange(0.5, 3.0, 0.5), mean, covariance)
    classes = np.full((count, len(PARAMETERS.labels)), 1 / len(PARAMETERS.labels))
    share = np.full(count, 0.9)
    joined = Joined(None, one, one.id // 2, share, one.id // 2, share, 0, 0)  # type: ignore[arg-type]  # of the tracks alone
    tracks = made(one, paths, classes, np.full(count, 7), joined)
    tracks.others["relocation"] = schemas.Relocation(world=1, translation=np.ones(3), quaternion=np.eye(4)[0])
    payload = tracks.encoded(delivery(0))
    assert payload == schemas.encode(tracks.tracks, delivery=schemas.Delivery(**delivery(0)))
    message = schemas.decode(payload, schemas.Tracks)
    assert message.path_position is not None
    assert message.class_probability is not None
    assert message.object is not None
    assert message.path_position.shape == (count, 5, 2)
    assert message.class_probability.shape == classes.shape
    assert message.object.tolist() == (one.id // 2).tolist()
    assert message.delivery == schemas.Delivery(**delivery(0))


def test_class_probabilities_that_are_no_numbers_are_refused() -> None:
    """They are the error of their field, in whatever row."""
    classes = np.full((3, len(PARAMETERS.labels)), 1 / len(PARAMETERS.labels))
    classes[2, 0] = np.nan
    with pytest.raises(schemas.MessageError, match="class_probability"):
        made(sound_tracks(3), None, classes)
