"""Tracks joined over gaps in sessions: as the library does, in any order of frames, after restores, and in zones."""

import json
import random
import tomllib
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from typing import Any

import gaps
import msgpack
import numpy as np
import pytest
from optipmb_schemas import Attribute, Detections, Events, Tracks, decode, encode
from optipmb_schemas.json_form import tracks_json
from optipmb_schemas.protobuf.convert import from_proto, to_proto
from optipmb_service.session.checkpoint import decode_checkpoint, encode_checkpoint, state_bytes
from optipmb_service.session.convert import density_of
from optipmb_service.session.outputs import TrackedFrame
from optipmb_service.session.policy import Policy
from optipmb_service.session.session import Session
from optipmb_service.settings import MOST_ZONES, RejoinSettings, Settings
from optipmb_service.streams.profiles import Fusion, Profiles
from optipmb_service.streams.session_factory import SessionFactory
from sessions import Merged, plain, problems, tracks

from optipmb import OnlineTracker, Passage, Rejoin, Tracker, generic_parameters
from optipmb.online import KNOWN
from optipmb.world import zones
from optipmb.world.zones import Event, Zone

GENERIC = generic_parameters(gaps.CLASSES, 0.1)
HOW = Rejoin(min_probability=0.6)
POLICY = Policy(rejoin=HOW)
RECORDING = gaps.record("street", 7, 25.0)
FRAMES = RECORDING.frames
STREAM = "site/node/camera"


MODEL = replace(HOW, embedding_model="reid-7")
DECLARED = replace(
    HOW,
    exits=(((-60, 5), (-30, 5), (-30, 25), (-60, 25)),),
    passages=(Passage(((-24, 5), (-14, 5), (-14, 15), (-24, 15)), ((-12, 5), (0, 5), (0, 15), (-12, 15)), (0.5, 9)),),
)
VECTORS = gaps.with_vectors(RECORDING, 0.85)
YARD = Zone("yard", polygon=((-5, -5), (200, -5), (200, 5), (-5, 5)), dwell_s=(6.0,), lost_s=6.0)
SHORT = Zone("short", polygon=((-5, -5), (200, -5), (200, 5), (-5, 5)))
GATE = Zone("gate", line=((40.0, -9.0), (40.0, 9.0)), lost_s=6.0)
LATE = Zone("late", line=((40.0, -9.0), (40.0, 9.0)))


def message_of(seq: int, given: dict[str, Any]) -> Detections:
    return Detections(stream=STREAM, epoch=bytes(16), seq=seq, frame="world", **given)


MESSAGES = [message_of(seq, one) for seq, one in enumerate(FRAMES)]
fresh = partial(Session, STREAM, GENERIC)


def in_order(policy: Policy = POLICY, messages: list[Detections] = MESSAGES) -> tuple[list[TrackedFrame], Session]:
    session = fresh(policy)
    outputs = [one for message in messages for one in session.on_detections(message, 0)]
    return [one for one in outputs if isinstance(one, TrackedFrame)], session


@pytest.mark.parametrize(
    ("given", "policy"),
    [
        (FRAMES, POLICY),
        (FRAMES, Policy(zones=(YARD, SHORT, GATE), rejoin=HOW)),
        (VECTORS, Policy(rejoin=MODEL)),
        (FRAMES, Policy(rejoin=DECLARED)),
    ],
    ids=["motion", "zones", "vectors", "exits and passages"],
)
def test_a_session_joins_as_the_library_does(given: list[dict[str, Any]], policy: Policy) -> None:
    """Tracks, objects and probabilities are those of `OnlineTracker`, for any order of frames and any restores."""
    messages = [message_of(seq, one) for seq, one in enumerate(given)]
    found, one = in_order(policy, messages)
    tracker, joined = OnlineTracker(GENERIC, rejoin=policy.rejoin), 0
    for output, frame in zip(found, given, strict=True):
        model, message = frame.get("embedding_model"), output.tracks
        columns = {name: value for name, value in frame.items() if name in KNOWN}
        expected = tracker.update(columns, stamp_ns=frame["stamp_ns"], embedding_model=model)
        assert output.estimates.words.tobytes() == expected.tracks.words.tobytes()
        assert message.object is not None
        assert message.object_probability is not None
        assert expected.object is not None
        assert expected.object_probability is not None
        assert message.object.tobytes() == expected.object.tobytes()
        assert message.object_probability.tobytes() == expected.object_probability.astype("f4").tobytes()
        joined += ((message.object >= 0) & (message.object != message.id)).sum()
    assert joined
    assert tracker.density.rejoining is not None
    appearance = tracker.density.rejoining.appearance
    assert (appearance is None) == (given is not VECTORS)
    assert appearance is None or appearance.counts[0, :2].sum(axis=1).min() >= 200
    in_turn, merged, session = Merged(), Merged(), fresh(policy)
    in_turn.take(found)
    order, chance = list(range(len(messages))), random.Random(3)
    for begin in range(0, len(order), 12):
        stored = encode_checkpoint(session.snapshot())
        part = order[begin : begin + 12]
        chance.shuffle(part)
        for seq in part[:4]:
            merged.take(session.on_detections(messages[seq], 0), session.run)  # lost with the process
        session = Session.restore(decode_checkpoint(stored), 0, policy)
        for seq in part:
            merged.take(session.on_detections(messages[seq], 0), session.run)
        merged.take(session.recovered(0), session.run)
    assert merged.plain() == in_turn.plain()
    assert state_bytes(session.snapshot()) == state_bytes(one.snapshot())
    assert session.state().embedding_ignored is None


def test_messages_carry_objects() -> None:
    """In msgpack, protobuf and JSON; a track without a decision has -1, in JSON none."""
    found, _ = in_order()
    numbers: set[int] = set()
    for one in found[::10]:
        message = one.tracks
        assert plain(decode(encode(message), Tracks)) == plain(message)
        assert plain(from_proto(to_proto(message), Tracks)) == plain(message)
        rows = json.loads(tracks_json(message))["objects"]
        assert message.object is not None
        assert [row.get("object", -1) for row in rows] == message.object.tolist()
        assert all(0.0 <= row["object_probability"] <= 1.0 for row in rows if "object" in row)
        assert all("object" in row for row in rows if "object_probability" in row)
        numbers |= {row["object"] - row["id"] if "object" in row else 1 for row in rows}
    assert {0, 1} < numbers


def test_without_the_setting_nothing_is_added() -> None:
    """Messages, state and checkpoint have no field of it, and the tracks are the same until a join removes one."""
    found, session = in_order(Policy())
    assert {"object", "object_probability"} & json.loads(tracks_json(found[-1].tracks))["objects"][0].keys() == set()
    assert not any(
        "rejoin" in name or name == "lost_dropped" for name in names_in(encode_checkpoint(session.snapshot()))
    )
    joined, _ = in_order()
    assert found[20].estimates.words.tobytes() == joined[20].estimates.words.tobytes()


def names_in(data: bytes) -> set[str]:
    """Return all names in the body of a checkpoint."""
    body = msgpack.unpackb(data[data.index(b"\xa8software") - 1 :], strict_map_key=False)
    found, rest = set(), [body]
    while rest:
        one = rest.pop()
        if isinstance(one, dict):
            found |= set(one)
            rest += one.values()
        elif isinstance(one, list):
            rest += one
    return found


def test_an_older_checkpoint_begins_with_an_empty_list() -> None:
    """A session restored from one without the setting has the tracks, whose objects are decided once more."""
    _, before = in_order(Policy(), MESSAGES[:100])
    session = Session.restore(decode_checkpoint(encode_checkpoint(before.snapshot())), 0, POLICY)
    found = tracks([one for message in MESSAGES[100:110] for one in session.on_detections(message, 0)])
    assert found[0].object is not None
    assert found[-1].object is not None
    assert (found[0].object == -1).all()
    assert (found[-1].object == found[-1].id).sum() > 5


def test_vectors_of_other_models_are_counted_and_of_another_length_refused() -> None:
    """A frame of another model, or without the setting, is tracked; another length is a problem with the path."""
    messages = [message_of(seq, one) for seq, one in enumerate(VECTORS[:23])]
    _, plain_session = in_order(POLICY, messages[:20])
    assert plain_session.state().embedding_ignored == 20
    _, session = in_order(Policy(rejoin=MODEL), messages[:20])
    other = messages[20].model_copy(update={"embedding_model": "reid-8"})
    outputs = session.on_detections(other, 0)
    assert tracks(outputs)
    (problem,) = problems(outputs)
    assert (problem.code, problem.path) == ("embedding", "embedding_model")
    assert ("'reid-7'" in problem.expected, "'reid-8'" in problem.received) == (True, True)
    assert session.state().embedding_ignored == 1
    vectors = messages[21].embedding
    assert vectors is not None
    short = messages[21].model_copy(update={"embedding": np.ascontiguousarray(vectors[:, :4])})
    (problem,) = problems(session.on_detections(short, 0))
    assert (problem.code, problem.path) == ("invalid_value", "embedding")
    assert "32 numbers" in problem.expected
    assert session.state().refused == 1
    assert tracks(session.on_detections(messages[22], 0))


def test_a_reset_forgets_lost_objects() -> None:
    """No object of a session is of another one."""
    _, session = in_order(messages=MESSAGES[:200])
    assert (session.state().lost_objects or 0) > 0
    assert (session.state().rejoined or 0) > 0
    session.reset()
    found = tracks([one for message in MESSAGES[200:] for one in session.on_detections(message, 0)])
    assert session.state().next_id > 0
    for one in found:
        assert one.object is not None
        assert (one.object[one.object >= 0] >= found[0].id.min()).all()


def test_a_visit_over_a_gap_is_one() -> None:
    """Within `lost_s` a visit goes on and a line is crossed meanwhile; beyond, the object is lost and returns."""
    cars = gaps.cars((0, 3, (0, 0), (8, 0)), (7, 10, (0, 0), (8, 0)))
    messages = [message_of(seq, one) for seq, one in enumerate(cars)]
    found, _ = in_order(Policy(zones=(YARD, SHORT, GATE, LATE), rejoin=Rejoin()), messages)
    events: list[Event] = [event for one in found for event in one.events]
    about = [(one.zone, one.kind, one.how, one.id, one.object) for one in events]
    assert about == [
        ("short", "entered", "appeared", 1, 1),
        ("yard", "entered", "appeared", 1, 1),
        ("short", "left", "lost", 1, 1),
        ("gate", "crossed", "", 2, 1),
        ("yard", "stayed", "", 2, 1),
        ("short", "entered", "appeared", 2, 1),
    ]
    assert 4 * 10**9 < events[3].at_ns < 6 * 10**9
    counts = [one.counts for one in found if one.counts][-1]
    inside = {
        name: {kind: one.get(kind, {}).get("car", 0) for kind in ("entered", "distinct", "left", "inside")}
        for name, one in counts.items()
    }
    assert inside["yard"] == {"entered": 1, "distinct": 1, "left": 0, "inside": 1}
    assert inside["short"] == {"entered": 2, "distinct": 1, "left": 1, "inside": 1}
    told = encode(found[-1].tracks)
    assert decode(told, Tracks).object is not None


@pytest.mark.parametrize(("lost_s", "left"), [("", 0), ("lost_s = 2.0", 1)])
def test_a_zone_waits_as_long_as_its_session_joins(lost_s: str, left: int) -> None:
    """Without `lost_s` a visit survives each gap that is joined; a zone of a session that does not join has 2 s."""
    text = f"""
    [rejoin."site/node/camera"]
    [zones.short]
    streams = ["site/*/*"]
    polygon = [[-5, -5], [200, -5], [200, 5], [-5, 5]]
    {lost_s}
    """
    settings = Settings(**tomllib.loads(text))
    profiles = Profiles.read("generic", {})
    factory = SessionFactory(settings, profiles, Fusion.of(settings), Tracker, lambda *_, **__: None)
    cars = gaps.cars((0, 3, (0, 0), (8, 0)), (7, 10, (0, 0), (8, 0)))
    found, _ = in_order(factory.policy(STREAM), [message_of(seq, one) for seq, one in enumerate(cars)])
    assert sum(event.kind == "left" for one in found for event in one.events) == left
    assert factory.policy("site/node/other").zones[0].lost_s == 2.0


DELIVERY = {"instance": "a", "received_ns": 1, "published_ns": 2, "queue_ms": 0.0, "decode_ms": 0.0, "step_ms": 0.0}


def test_attributes_reach_tracks_and_events() -> None:
    """What the messages of a car say is in the tracks, also behind a gap, and in the events of a zone."""
    cars = gaps.cars((0, 3, (0, 0), (8, 0)), (7, 10, (0, 0), (8, 0)))
    known = (Attribute(row=0, name="plate", text="AB 1", score=0.5),)
    messages = [
        message_of(seq, one | ({"attributes": known} if len(one["score"]) and one["stamp_ns"] < 10**9 else {}))
        for seq, one in enumerate(cars)
    ]
    found, session = in_order(Policy(zones=(YARD,), rejoin=Rejoin()), messages)
    told = decode(found[-1].encoded(DELIVERY), Tracks)
    assert told.object is not None
    assert (told.id.tolist(), told.object.tolist()) == ([2], [1])
    assert told.attributes == (Attribute(row=0, name="plate", text="AB 1", score=1.0),)
    (events,) = [one for one in found if any(event.kind == "stayed" for event in one.events)]
    payload = events.encoded_events(DELIVERY, None)
    assert payload is not None
    assert decode(payload, Events).attributes == told.attributes
    assert json.loads(tracks_json(told))["objects"][0]["attributes"] == {"plate": ["AB 1", 1.0]}
    state = density_of(session.density, stream=STREAM, session=session.session, parameters=GENERIC)
    assert state.track is not None
    assert state.candidate is not None
    assert (state.track.tolist(), state.candidate.tolist()) == ([2], [1])


def test_settings_have_the_bounds_of_the_library() -> None:
    """The settings, which do not import the tracker, repeat its bounds and defaults without a difference."""
    assert RejoinSettings().model_dump() == asdict(Rejoin())
    limits = {"minimum", "exclusiveMinimum", "maximum", "exclusiveMaximum"}
    for length in (0, 1, 64, 65):
        accepted = [is_accepted(one, "embedding_model", "x" * length) for one in (RejoinSettings, Rejoin)]
        assert accepted == [1 <= length <= 64] * 2
    numbers = RejoinSettings.model_json_schema()["properties"]
    for name in ("embedding_model", "exits", "passages"):
        del numbers[name]
    for name, described in numbers.items():
        ends = [described[one] for one in sorted(limits & described.keys())]
        assert len(ends) == 2
        step = 1 if described["type"] == "integer" else 1e-9
        for value in [end + change for end in ends for change in (-step, 0, step)]:
            assert is_accepted(RejoinSettings, name, value) == is_accepted(Rejoin, name, value), (name, value)
    assert MOST_ZONES == zones.MOST


def is_accepted(kind: Callable[..., object], name: str, value: object) -> bool:
    try:
        kind(**{name: value})
    except ValueError:
        return False
    return True
