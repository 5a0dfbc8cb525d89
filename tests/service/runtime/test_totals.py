"""The counts of messages over all streams, as the metrics show them: they only grow, and each message counts once."""

from __future__ import annotations

import sys
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from optipmb_service.runtime import actor_table, stream_actor, stream_counters
from optipmb_service.runtime.ports import Packet
from optipmb_service.session.values import MAX_SENSORS, MessageCounters
from registries import Around, packet_of, registry_of
from router import Sensor

if TYPE_CHECKING:
    from types import FrameType

    import pytest

SENSOR = Sensor()
TRACED = {str(Path(module.__file__)) for module in (stream_actor, stream_counters)}


def packet(seq: int) -> Packet:
    """Return a frame as it comes."""
    return packet_of(SENSOR.detections(seq))


def test_totals_never_fall_and_count_nothing_twice() -> None:
    """Between any two lines that open, close or restore a session the totals are what they were, or more."""
    around = Around()
    registry, seen = registry_of(around), [MessageCounters()]

    def look(frame: FrameType, *_: object) -> Any:
        if frame.f_code.co_filename not in TRACED:
            return None
        if not registry._actors._lock.locked():  # another thread would wait for it
            seen.append(registry.totals())
        return look

    before = sys.gettrace()
    sys.settrace(look)
    try:
        for seq in (0, 1, 2, 2, 3):
            registry.frame(packet(seq))
        around.run()
        registry.command(SENSOR.stream, lambda actor: actor.close_session("idle"), urgent=False)
        around.run()
        assert registry.actor(SENSOR.stream) is None
        for seq in (3, 4, 5):
            registry.frame(packet(seq))
        around.run()
    finally:
        sys.settrace(before)
    for name in (field.name for field in fields(MessageCounters)):
        values = [getattr(one, name) for one in seen]
        assert values == sorted(values), name
    assert (seen[-1].received, seen[-1].frames, seen[-1].duplicates) == (8, 6, 2)
    assert registry.totals() == seen[-1]


def test_a_command_without_room_is_no_message(monkeypatch: pytest.MonkeyPatch) -> None:
    """A query on a stream that finds no room among those that are new is told so, and counts as no frame."""
    monkeypatch.setattr(actor_table, "MAX_UNPROVEN_ACTORS", 0)
    registry = registry_of(Around())
    assert not registry.command(SENSOR.stream, lambda _: None, urgent=True)
    assert registry.totals() == MessageCounters()


def test_a_message_on_a_key_of_no_stream_is_refused_as_what_it_is() -> None:
    """A cloud on a key that names no stream counts among the clouds refused, detections among the frames."""
    registry, bad = registry_of(Around()), Packet("optipmb/v1/nothing", b"", 0, "", 0, 0)
    registry.cloud(bad)
    assert registry.totals() == MessageCounters(clouds_refused=1)
    registry.frame(bad)
    assert registry.totals() == MessageCounters(received=1, refused=1, clouds_refused=1)


def test_what_one_sensor_too_many_sends_is_counted_as_what_it_is() -> None:
    """Of a sensor beyond those that a session takes, a frame counts as refused, and a cloud as a refused cloud."""
    around = Around()
    registry = registry_of(around, fuse=("site/node/*",), recovery_wait_s=0)
    for number in range(MAX_SENSORS):
        registry.frame(packet_of(replace(SENSOR, stream=f"site/node/s{number}").detections(0)))
    around.run()
    more = replace(SENSOR, stream="site/node/more")
    registry.frame(packet_of(more.detections(0)))
    registry.cloud(packet_of(more.points(0)))
    around.run()
    totals = registry.totals()
    assert (totals.received, totals.frames, totals.refused, totals.clouds_refused) == (
        MAX_SENSORS + 1,
        MAX_SENSORS,
        1,
        1,
    )
