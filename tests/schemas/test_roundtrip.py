"""Messages survive the wire unchanged, to the bit."""

import array
import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from jsonschema import Draft202012Validator
from optipmb_schemas import (
    MESSAGES,
    Delivery,
    Density,
    Detections,
    DrainRequest,
    Events,
    LinkedObject,
    Links,
    Message,
    MoveRequest,
    Points,
    Pose,
    Problem,
    Relocation,
    ResetRequest,
    ServiceStatus,
    SessionParameters,
    SessionState,
    SessionSummary,
    Tracks,
    TracksRequest,
    ZoneCount,
    ZoneEvent,
    decode,
    encode,
    encode_json,
    encoding_of,
)
from optipmb_schemas.json_form import FIELDS, Selection, event_json, tracks_json, zones_json

from optipmb import Georeference

SCHEMAS = Path(__file__).parents[2] / "schemas/json"
INT64 = 2**63 - 1
FAR = 1e8

chunk = st.from_regex(r"[A-Za-z0-9_-][A-Za-z0-9_.-]{0,12}", fullmatch=True)
stream = st.tuples(chunk.filter(lambda c: c not in {"owner", "service"}), chunk, chunk).map("/".join)
count = st.integers(0, INT64)
duration = st.floats(0, allow_infinity=False, allow_nan=False)
text = st.text(st.characters(exclude_categories=["Cs"]), max_size=40)
word = text.filter(bool)
labels = st.lists(
    st.text(st.characters(categories=["L", "N"]), min_size=1, max_size=20), min_size=1, max_size=6, unique=True
)
epoch = st.binary(min_size=16, max_size=16)
session = st.binary(min_size=16, max_size=16).map(bytes.hex)


horizons = st.none() | st.lists(st.floats(0, 30, exclude_min=True), max_size=4, unique=True).map(sorted).map(np.array)


def rows(shape: tuple[int, ...], low: float, high: float, *, above: bool = False) -> st.SearchStrategy[Any]:
    return arrays("f8", shape, elements=st.floats(low, high, exclude_min=above, allow_nan=False))


def whole(size: int, low: int, high: int) -> st.SearchStrategy[Any]:
    return arrays("i8", (size,), elements=st.integers(low, high))


@st.composite
def covariances(draw: st.DrawFn, m: int) -> Any:
    root = draw(rows((m, 3, 3), -1e3, 1e3))
    covariance = root @ root.transpose(0, 2, 1) + np.eye(3)
    covariance[draw(arrays(np.bool_, m))] = np.nan
    return covariance


@st.composite
def poses(draw: st.DrawFn) -> Pose:
    quaternion = draw(rows((4,), -1, 1).filter(lambda q: np.linalg.norm(q) > 0.1))
    return Pose(translation=draw(rows((3,), -FAR, FAR)), quaternion=quaternion / np.linalg.norm(quaternion))


@st.composite
def headers(draw: st.DrawFn) -> dict[str, Any]:
    return {"stream": draw(stream), "epoch": draw(epoch), "seq": draw(count), "stamp_ns": draw(count)}


@st.composite
def placed(draw: st.DrawFn) -> dict[str, Any]:
    frame = draw(st.sampled_from(["world", "sensor"]))
    pose = draw(poses()) if frame == "sensor" else draw(st.none() | poses())
    return {**draw(headers()), "frame": frame, "pose": pose, "relocation": draw(st.none() | relocations())}


@st.composite
def relocations(draw: st.DrawFn) -> Relocation:
    turn = draw(st.floats(-7.0, 7.0))
    quaternion = np.array([np.cos(turn), 0.0, 0.0, np.sin(turn)])
    return Relocation(
        world=draw(st.integers(1, 2**31 - 1)), translation=draw(rows((3,), -FAR, FAR)), quaternion=quaternion
    )


@st.composite
def detections(draw: st.DrawFn) -> Detections:
    m, names = draw(st.integers(0, 9)), draw(labels)
    velocity = draw(st.none() | rows((m, 2), -1e3, 1e3))
    if velocity is not None:
        velocity[draw(arrays(np.bool_, m))] = np.nan
    center, size, yaw = (
        draw(rows((m, 3), -FAR, FAR)),
        draw(rows((m, 3), 0, 1e4, above=True)),
        draw(rows((m,), -6.4, 6.4)),
    )
    if draw(st.booleans()):
        center[draw(arrays(np.bool_, m)), 2] = np.nan
        size[draw(arrays(np.bool_, (m, 3)))] = np.nan
        yaw[draw(arrays(np.bool_, m))] = np.nan
    return Detections(
        **draw(placed()),
        labels=tuple(names),
        label=draw(whole(m, 0, len(names) - 1)),
        center=center,
        size=draw(st.sampled_from([None, size])),
        yaw=draw(st.sampled_from([None, yaw])),
        score=draw(rows((m,), 0, 1, above=True)),
        velocity=velocity,
        has_points=draw(st.none() | st.booleans()),
        position_covariance=draw(st.none() | covariances(m)),
    )


@st.composite
def points(draw: st.DrawFn) -> Points:
    shape = (draw(st.integers(0, 9) | st.just(700)), 3)  # 700 points are a large block, viewed instead of copied
    fill = st.floats(-FAR, FAR, width=32)
    return Points(**draw(placed()), xyz=draw(arrays("f4", shape, elements=fill, fill=fill)))


@st.composite
def tracks(draw: st.DrawFn) -> Tracks:
    n, names = draw(st.integers(0, 5)), draw(labels)
    column = {
        name: draw(rows((n,), low, high))
        for name, low, high in [
            ("yaw", -1e5, 1e5),
            ("yaw_rate", -1e5, 1e5),
            ("acceleration", -1e5, 1e5),
            ("heading_confidence", 0, 1),
            ("existence", 0, 1),
            ("score", 0, 1),
            ("age", 0, 1e12),
            ("time_since_detection", 0, 1e12),
        ]
    }
    delivery = st.builds(
        Delivery,
        instance=chunk,
        received_ns=count,
        published_ns=count,
        queue_ms=duration,
        decode_ms=duration,
        step_ms=duration,
    )
    return Tracks(
        **draw(headers()),
        session=draw(session),
        revision=draw(count),
        profile=draw(chunk),
        cloud_used=draw(st.booleans()),
        gap=draw(count),
        ignored=draw(count),
        world=draw(st.none() | count),
        relocation=draw(st.none() | relocations()),
        labels=tuple(names),
        id=np.sort(np.array(draw(st.lists(count, min_size=n, max_size=n, unique=True)), dtype="i8")),
        label=draw(whole(n, 0, len(names) - 1)),
        center=draw(rows((n, 3), -FAR, FAR)),
        size=draw(rows((n, 3), 0, 1e5, above=True)),
        velocity=draw(rows((n, 2), -1e5, 1e5)),
        covariance=draw(rows((n, 6, 6), -1e30, 1e30)),
        detection=draw(whole(n, -1, INT64)),
        measured=draw(st.none() | whole(n, 0, 7)),
        confirmed=draw(st.none() | whole(n, 0, 1)),
        delivery=draw(st.none() | delivery),
        **column,
        **draw(paths(n)),
    )


@st.composite
def paths(draw: st.DrawFn, n: int) -> dict[str, Any]:
    given = draw(horizons)
    if given is None:
        return {}
    single = st.floats(-1e5, 1e5, width=32)
    return {
        "horizons": given,
        "path_position": draw(rows((n, len(given), 2), -1e12, 1e12)),
        "path_yaw": draw(arrays("f4", (n, len(given)), elements=single)),
        "path_covariance": draw(arrays("f4", (n, len(given), 2, 2), elements=single)),
    }


@st.composite
def densities(draw: st.DrawFn) -> Density:
    n, names = draw(st.integers(0, 5)), draw(labels)
    return Density(
        stream=draw(stream),
        session=draw(session),
        stamp_ns=draw(st.none() | count),
        labels=tuple(names),
        label=draw(whole(n, 0, len(names) - 1)),
        weight=draw(rows((n,), 0, 1e30)),
        mean=draw(rows((n, 6), -1e30, 1e30)),
        covariance=draw(rows((n, 6, 6), -1e30, 1e30)),
        z=draw(rows((n,), -1e30, 1e30)),
    )


@st.composite
def zone_events(draw: st.DrawFn) -> Events:
    names, number = draw(labels), st.floats(allow_nan=False, allow_infinity=False)
    event = st.builds(
        ZoneEvent,
        zone=word,
        kind=st.sampled_from(["entered", "left", "stayed", "crossed"]),
        n=count,
        id=count,
        label=st.integers(0, len(names) - 1),
        at_ns=count,
        position=st.tuples(number, number, number),
        speed=number,
        yaw=number,
        how=st.sampled_from([None, "crossed", "appeared", "lost", "ended"]),
        dwell_s=st.none() | duration,
        direction=st.sampled_from([None, "left", "right"]),
    )
    columns = set(ZoneCount.names) - {"zone"}
    counts = st.builds(ZoneCount, zone=word, **dict.fromkeys(columns, st.tuples(*[count] * len(names))))
    return Events(
        **draw(headers()),
        session=draw(session),
        revision=draw(count),
        labels=tuple(names),
        events=tuple(draw(st.lists(event, max_size=3))),
        zones=draw(st.none() | st.lists(counts, max_size=3).map(tuple)),
    )


problems = st.builds(
    Problem,
    stream=text,
    instance=chunk,
    code=word,
    path=text,
    expected=text,
    received=text,
    message=text,
    seq=st.none() | count,
    stamp_ns=st.none() | count,
    count=count,
)
scalars = (
    st.none() | st.booleans() | st.integers(-(2**63), INT64) | st.floats(allow_nan=False, allow_infinity=False) | text
)
values = st.dictionaries(
    text, st.recursive(scalars, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(text, inner, max_size=3))
)
summaries = st.builds(
    SessionSummary, stream=stream, profile=chunk, state=word, rate_hz=duration, age_s=st.none() | duration
)
messages: dict[type[Message], st.SearchStrategy[Message]] = {
    Detections: detections(),
    Points: points(),
    Tracks: tracks(),
    Events: zone_events(),
    Links: st.builds(
        Links,
        area=chunk,
        revision=count,
        stamp_ns=count,
        whole=st.booleans(),
        objects=st.lists(
            st.builds(
                LinkedObject,
                global_id=epoch,
                stream=stream,
                session=session,
                object=count,
                probability=st.floats(0.0, 1.0),
                kind=st.sampled_from(["overlap", "passage", "appearance", "none"]),
                ended=st.booleans(),
            ),
            max_size=3,
        ).map(tuple),
    ),
    SessionState: st.builds(
        SessionState,
        stream=stream,
        session=session,
        state=st.sampled_from(["new", "running", "closed"]),
        profile=chunk,
        epoch=st.none() | epoch,
        seq=st.none() | count,
        frames=count,
        queue=count,
    ),
    Density: densities(),
    SessionParameters: st.builds(
        SessionParameters,
        profile=st.none() | chunk,
        cloud_wait_s=st.none() | duration,
        horizons=horizons,
        restart=st.booleans(),
        values=st.none() | values,
    ),
    TracksRequest: st.builds(TracksRequest, from_ns=st.integers(0, 9), to_ns=st.none() | st.integers(0, 2**63 - 1)),
    ResetRequest: st.builds(ResetRequest, close=st.booleans()),
    MoveRequest: st.builds(MoveRequest, stream=stream, worker=st.integers(0, 63)),
    DrainRequest: st.builds(DrainRequest, drain=st.booleans()),
    Problem: problems,
    ServiceStatus: st.builds(
        ServiceStatus,
        instance=chunk,
        version=word,
        started_ns=count,
        uptime_s=duration,
        state=word,
        sessions=st.lists(summaries, max_size=3).map(tuple),
        problems=st.lists(problems, max_size=3).map(tuple),
    ),
}


@pytest.mark.parametrize("kind", MESSAGES)
@settings(max_examples=10, deadline=None)
@given(data=st.data())
def test_every_message_comes_back_equal(kind: type[Message], data: st.DataObject) -> None:
    """Decoding gives an equal message with equal bytes, as msgpack and as JSON, with and without a named encoding."""
    message = data.draw(messages[kind])
    for form, write in (("msgpack", encode), ("json", encode_json)):
        payload = write(message)
        assert decode(payload, kind) == decode(payload, kind, encoding=encoding_of(kind, form=form)) == message
        assert write(decode(payload, kind)) == payload


def test_negative_zero_and_unknown_velocity_survive(detections: Detections) -> None:
    """The sign of zero and rows of NaN come back, also through JSON, where NaN is null."""
    assert b"[null,null]" in encode_json(detections)
    for payload in (encode(detections), encode_json(detections)):
        received = decode(payload, Detections)
        assert np.signbit(received.center[1, 2])
        assert received.velocity is not None
        assert np.isnan(received.velocity[1]).all()
        assert np.signbit(received.velocity[0, 1])


def test_order_of_map_keys_does_not_matter() -> None:
    """Parameters that differ in the order of their values alone have equal bytes."""
    one, other = SessionParameters(values={"a": 1, "b": 2}), SessionParameters(values={"b": 2, "a": 1})
    assert encode(one) == encode(other)


def test_numbers_of_numpy_are_encoded_as_those_of_python(examples: dict[str, Message]) -> None:
    """A copy with a float64 of numpy in place of a number has the same bytes."""
    tracks = examples["Tracks"]
    delivery = tracks.delivery.model_copy(update={"queue_ms": np.float64(1.5)})  # type: ignore[attr-defined]
    same = tracks.delivery.model_copy(update={"queue_ms": 1.5})  # type: ignore[attr-defined]
    assert encode(tracks, delivery=delivery) == encode(tracks, delivery=same)


def test_buffers_of_other_libraries_are_columns(detections: Detections) -> None:
    """Columns given as buffers, of several dimensions and another number type too, make the same message."""
    rows = len(detections.label)
    center = memoryview(detections.center.tobytes()).cast("d", (rows, 3))
    columns = {"center": center, "label": array.array("i", detections.label.tolist())}
    assert Detections(**dict(detections.present()) | columns) == detections


def test_messages_cross_processes_and_pydantic(examples: dict[str, Message]) -> None:
    """Every message can be pickled, and read from `model_dump_json`, as programs that know pydantic write it."""
    for message in examples.values():
        assert decode(message.model_dump_json().encode(), type(message)) == message
        assert pickle.loads(pickle.dumps(message)) == message  # noqa: S301 - made in this line


def validator(name: str) -> Draft202012Validator:
    return Draft202012Validator(json.loads((SCHEMAS / f"{name}.v1.schema.json").read_text()))


@given(tracks())
def test_the_json_of_the_edges_has_the_numbers_of_the_columns(message: Tracks) -> None:
    """Each object has the values of its row, rounded; the text conforms to its published schema."""
    text = json.loads(tracks_json(message, place=Georeference((48.0, 11.0, 500.0)).to_geographic))
    validator("EdgeTracks").validate(text)
    assert text["type"] == "tracks"
    assert (text["stamp_ns"], text["epoch"]) == (str(message.stamp_ns), message.epoch.hex())
    assert [one["id"] for one in text["objects"]] == message.id.tolist()
    assert [one["class"] for one in text["objects"]] == [message.labels[at] for at in message.label]
    columns = {
        "position": message.center,
        "size": message.size,
        "yaw": message.yaw,
        "velocity": message.velocity,
        "existence": message.existence,
        "age_s": message.age,
        "seen_s": message.time_since_detection,
    }
    known = np.full(len(message.id), 7) if message.measured is None else message.measured
    for name, column in columns.items():
        wanted = np.round(column, 3).tolist()
        for row, bits in enumerate(known.tolist()):
            if name == "yaw" and not bits & 1:
                wanted[row] = None
            elif name == "size" and not bits & 2:
                wanted[row] = [None] * 3
            elif name == "position" and not bits & 4:
                wanted[row][2] = None
        assert [one[name] for one in text["objects"]] == wanted
    near = np.linalg.norm(message.center, axis=1) <= 1e5
    assert ["lat" in one for one in text["objects"]] == near.tolist()
    assert [0 <= one.get("heading", -1) < 360 for one in text["objects"]] == (near & (known % 2 == 1)).tolist()


@given(tracks(), st.frozensets(st.sampled_from(sorted(FIELDS))), st.floats(0, 1), st.integers(0, 1))
def test_a_selection_leaves_out_rows_and_fields(
    message: Tracks, fields: frozenset[str], least: float, confirmed: int
) -> None:
    """The remaining objects equal the whole text, with the requested fields and `id`."""
    selection = Selection(frozenset(message.labels[:1]), bool(confirmed), least, fields)
    whole = {one["id"]: one for one in json.loads(tracks_json(message))["objects"]}
    chosen = json.loads(tracks_json(message, selection))["objects"]
    for one in chosen:
        all_of_it = whole[one["id"]]
        assert one == {name: all_of_it[name] for name in all_of_it if name in fields | {"id"} or not fields}
        assert all_of_it["class"] == message.labels[0]
    expected = (message.existence >= least) & (message.label == 0)
    if confirmed and message.confirmed is not None:
        expected &= message.confirmed == 1
    elif confirmed:
        expected &= (message.existence > 0.5) & (message.age > 0)
    assert [one["id"] for one in chosen] == message.id[expected].tolist()


@given(zone_events())
def test_the_json_of_events_has_one_text_for_each(message: Events) -> None:
    """Every event and the counts conform to their schemas, with classes by name."""
    texts = [json.loads(one) for one in event_json(message)]
    for text, event in zip(texts, message.events, strict=True):
        validator("EdgeEvent").validate(text)
        assert (text["zone"], text["n"], text["at_ns"]) == (event.zone, event.n, str(event.at_ns))
        assert text["class"] == message.labels[event.label]
    counts = zones_json(message)
    assert (counts is None) == (message.zones is None)
    if counts is not None:
        validator("EdgeZones").validate(json.loads(counts))
        for zone in message.zones or ():
            found = json.loads(counts)["zones"][zone.zone]
            assert {name: one["inside"] for name, one in found.items()} == dict(
                zip(message.labels, zone.inside, strict=True)
            ) or [one.zone for one in message.zones or ()].count(zone.zone) > 1
