"""Events of zones in sessions: the same whatever came late, after a restore, and with other zones beside."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest
from optipmb_service.stream.checkpoint import decode_checkpoint, encode_checkpoint, state_bytes
from optipmb_service.stream.session import Session
from optipmb_service.stream.values import Output, Policy, Tracked
from router import Sensor
from sessions import feed

import optipmb
from optipmb.zones import Event, Zone

if TYPE_CHECKING:
    from collections.abc import Iterable

SENSOR = Sensor()
PROFILE = optipmb.load_profile("nuscenes")
ZONES = (
    Zone("crossing", polygon=((5, -6), (12, -6), (12, 6), (5, 6)), dwell_s=(1.0,)),
    Zone("gate", line=((8.2, -30), (8.2, 30))),
    Zone("yard", polygon=((-50, -50), (50, -50), (50, 50), (-50, 50))),
)
POLICY = Policy(zones=ZONES)


def final(outputs: Iterable[Output]) -> list[Event]:
    """Return the events of the highest revision of each frame, as a reader has them in the end."""
    newest: dict[int, tuple[int, int, tuple[Event, ...]]] = {}
    for one in outputs:
        if isinstance(one, Tracked):
            seq, head = one.header["seq"], (one.run, one.header["revision"])
            if head >= newest.get(seq, (0, 0, ()))[:2]:
                newest[seq] = (*head, one.events)
    return [event for seq in sorted(newest) for event in newest[seq][2]]


def in_order(policy: Policy = POLICY) -> tuple[list[Event], Session]:
    """Return the events of forty frames in order."""
    session = Session(SENSOR.stream, PROFILE, policy)
    return final(feed(session, range(40), SENSOR)), session


def test_objects_enter_cross_and_leave() -> None:
    """Three cars appear in the yard and cross the line; one of them passes the crossing."""
    events, _ = in_order()
    found = [(one.zone, one.kind, one.how or one.direction) for one in events]
    assert sorted(found) == sorted(
        [("yard", "entered", "appeared")] * 3
        + [("gate", "crossed", "right")] * 3
        + [("crossing", "entered", "crossed"), ("crossing", "stayed", ""), ("crossing", "left", "crossed")]
    )


@pytest.mark.parametrize(
    "order", [[0, 2, 1, *range(3, 40)], [*range(9), 12, 11, 10, 9, *range(13, 20), *range(21, 26), 20, *range(26, 40)]]
)
def test_late_frames_give_the_events_of_the_order(order: list[int]) -> None:
    """State and final events are equal, byte for byte."""
    expected, one = in_order()
    session = Session(SENSOR.stream, PROFILE, POLICY)
    events = final(feed(session, order, SENSOR))
    assert repr(events) == repr(expected)
    assert state_bytes(session.snapshot()) == state_bytes(one.snapshot())


@pytest.mark.parametrize("seq", range(1, 40, 3))
def test_a_restore_continues_events_and_numbers(seq: int) -> None:
    """A session that goes on from a checkpoint some frames old gives the events of one that never stopped."""
    expected, one = in_order()
    session = Session(SENSOR.stream, PROFILE, POLICY)
    outputs = feed(session, range(seq), SENSOR)
    stored = encode_checkpoint(session.snapshot())
    outputs += feed(session, range(seq, min(40, seq + 4)), SENSOR)  # lost with the process
    session = Session.restore(decode_checkpoint(stored), 0, POLICY)
    outputs += feed(session, range(seq, 40), SENSOR)
    assert repr(final(outputs)) == repr(expected)
    assert state_bytes(session.snapshot()) == state_bytes(one.snapshot())


def test_a_reset_ends_all_visits() -> None:
    """They end in the first frame of the next session; the counts go on."""
    _, session = in_order()
    session.reset()
    events = final(feed(session, range(40, 60), SENSOR))
    assert [(one.zone, one.kind, one.how, one.n) for one in events[:3]] == [
        ("yard", "left", "ended", n) for n in (1, 2, 3)
    ]
    assert [(one.kind, one.how, one.n) for one in events[3:]] == [("entered", "appeared", n) for n in (4, 5, 6)]


def test_a_zone_that_was_changed_begins_anew_and_the_others_go_on() -> None:
    """Those inside have appeared; numbers continue."""
    session = Session(SENSOR.stream, PROFILE, POLICY)
    feed(session, range(20), SENSOR)
    other = replace(ZONES[2], polygon=((-60, -60), (60, -60), (60, 60), (-60, 60)))
    policy = Policy(zones=(other, *ZONES[:2]))
    again = Session.restore(decode_checkpoint(encode_checkpoint(session.snapshot())), 0, policy)
    rest = final(feed(again, range(20, 40), SENSOR))
    expected = [one for one in final(feed(session, range(20, 40), SENSOR)) if one.zone != "yard"]
    assert [one for one in rest if one.zone != "yard"] == expected
    assert [(one.how, one.n) for one in rest if one.zone == "yard"] == [("appeared", n) for n in (4, 5, 6)]


def test_sessions_without_zones_have_none_in_their_checkpoints() -> None:
    """Their bytes are those of before."""
    _, session = in_order(Policy())
    assert b"zones" not in encode_checkpoint(session.snapshot())
