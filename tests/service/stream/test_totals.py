"""The counts of messages over all streams, as the metrics show them: they only grow, and each message counts once."""

import sys
from dataclasses import fields, replace
from pathlib import Path
from types import FrameType
from typing import Any

from optipmb_service.session.counts import MessageCounters
from optipmb_service.session.policy import MAX_SENSORS
from optipmb_service.streams import backlog, opening, outbox, stream
from optipmb_service.zenoh.topics import Packet
from registries import Around, packet_of, streams_of
from router import Sensor

SENSOR = Sensor()
TRACED = {str(Path(module.__file__)) for module in (stream, opening, outbox, backlog)}


def packet(seq: int) -> Packet:
    return packet_of(SENSOR.detections(seq))


def test_totals_never_fall_and_count_nothing_twice() -> None:
    """Between any two lines that open, close or restore a session, the totals never fall."""
    around = Around()
    streams, seen = streams_of(around), [MessageCounters()]

    def look(frame: FrameType, *_: object) -> Any:
        if frame.f_code.co_filename not in TRACED:
            return None
        if not streams._lock.locked():  # another thread would wait for it
            seen.append(streams.totals())
        return look

    before = sys.gettrace()
    sys.settrace(look)
    try:
        for seq in (0, 1, 2, 2, 3):
            streams.receive(packet(seq))
        around.run()
        streams.command(SENSOR.stream, lambda one: one.close_session("idle"), urgent=False)
        around.run()
        assert streams.of(SENSOR.stream) is None
        for seq in (3, 4, 5):
            streams.receive(packet(seq))
        around.run()
    finally:
        sys.settrace(before)
    for name in (field.name for field in fields(MessageCounters)):
        values = [getattr(one, name) for one in seen]
        assert values == sorted(values), name
    assert (seen[-1].received, seen[-1].frames, seen[-1].duplicates) == (8, 6, 2)
    assert streams.totals() == seen[-1]


def test_a_message_on_a_key_of_no_stream_is_refused_as_what_it_is() -> None:
    """A cloud on a key that names no stream counts among the clouds refused, detections among the frames."""
    streams = streams_of(Around())
    streams.receive(Packet("optipmb/v1/nothing/points", b"", 0, "", 0, 0))
    assert streams.totals() == MessageCounters(clouds_refused=1)
    streams.receive(Packet("optipmb/v1/nothing/detections", b"", 0, "", 0, 0))
    assert streams.totals() == MessageCounters(received=1, refused=1, clouds_refused=1)


def test_what_one_sensor_too_many_sends_is_counted_as_what_it_is() -> None:
    """A frame of a sensor beyond the limit of a session counts as refused, and a cloud as a refused cloud."""
    around = Around()
    streams = streams_of(around, fuse=("site/node/*",), recovery_wait_s=0)
    for number in range(MAX_SENSORS):
        streams.receive(packet_of(replace(SENSOR, stream=f"site/node/s{number}").detections(0)))
    around.run()
    more = replace(SENSOR, stream="site/node/more")
    streams.receive(packet_of(more.detections(0)))
    streams.receive(packet_of(more.points(0)))
    around.run()
    totals = streams.totals()
    assert (totals.received, totals.frames, totals.refused, totals.clouds_refused) == (
        MAX_SENSORS + 1,
        MAX_SENSORS,
        1,
        1,
    )
