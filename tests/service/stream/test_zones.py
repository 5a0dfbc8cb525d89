"""Events of zones in sessions: the same whatever came late, after a restore, and with other zones beside."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest
from optipmb_schemas import Events, decode
from optipmb_service.settings import SettingsInvalidError, ZoneSettings, load
from optipmb_service.stream.checkpoint import decode_checkpoint, encode_checkpoint, state_bytes
from optipmb_service.stream.session import Session
from optipmb_service.stream.values import Output, Policy, Tracked
from registries import Around, packet_of, streams_of
from router import SECOND, Sensor
from sessions import feed

import optipmb
from optipmb.zones import Event, Zone

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

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


SETTINGS: dict[str, Any] = {
    "crossing": {"streams": ["site/*/*"], "polygon": [(5, -6), (12, -6), (12, 6), (5, 6)], "dwell_s": [1.0]},
    "elsewhere": {"streams": ["other/*/*"], "line": [(8.2, -30), (8.2, 30)]},
    "gate": {"streams": ["*/*/*"], "line": [(8.2, -30), (8.2, 30)]},
    "yard": {"streams": ["site/*/*"], "polygon": [(-50, -50), (50, -50), (50, 50), (-50, 50)]},
}


class Reader(Around):
    """A process without network whose events are read."""

    def __init__(self) -> None:
        super().__init__()
        self.messages: list[Events] = []

    def publish_events(self, payload: bytes) -> None:
        """Read a message."""
        self.messages.append(decode(payload, Events))

    def serve(self, seqs: Iterable[int], zones: dict[str, Any] | None = None) -> None:
        """Track frames in a process that begins with what was kept, and is killed after its states were kept."""
        zones = SETTINGS if zones is None else zones
        streams = streams_of(self, tracker=optipmb.Tracker, recovery_wait_s=0, zones=zones)
        for seq in seqs:
            streams.receive(packet_of(SENSOR.detections(seq)))
            self.run()
        streams.keep()
        self.run()

    def final(self) -> list[tuple[object, ...]]:
        """Return the events as a consumer has them in the end."""
        newest: dict[int, Events] = {}
        for one in self.messages:
            newest[one.seq] = max(one, newest.get(one.seq, one), key=_version)
        return [
            (event.zone, event.kind, event.n, event.id, one.labels[event.label], event.at_ns, event.position)
            for seq in sorted(newest)
            for one in [newest[seq]]
            for event in one.events
        ]


def _version(one: Events) -> tuple[int, int]:
    assert one.delivery is not None
    return one.delivery.run, one.revision


@pytest.mark.parametrize(
    "runs",
    [[range(40)], [[0, 2, 1, *range(3, 20), 22, 21, 20, *range(23, 40)]], [range(17), [19, 18, 17, *range(20, 40)]]],
)
def test_a_service_publishes_the_events(runs: list[Iterable[int]]) -> None:
    """In order, with late frames and through a restart they are those of a session of frames in order."""
    reader = Reader()
    for seqs in runs:
        reader.serve(seqs)
    expected = [(*one[:2], *one[2:7]) for one in in_order()[0]]
    assert reader.final() == expected
    assert {one.stream for one in reader.messages} == {SENSOR.stream}


def test_counts_come_once_a_second_and_with_corrections() -> None:
    """The first frame of each second of stamps has the counts of all zones of the stream."""
    reader = Reader()
    reader.serve(range(40))
    counted = [one for one in reader.messages if one.zones is not None]
    seconds = [SENSOR.stamp_ns(seq) // SECOND for seq in range(40)]
    assert [one.seq for one in counted] == [seq for seq in range(40) if seq == 0 or seconds[seq] != seconds[seq - 1]]
    for one in reader.messages:
        assert one.events or one.zones
        for zone in one.zones or ():
            assert zone.inside == tuple(a - b for a, b in zip(zone.entered, zone.left, strict=True))
    assert [zone.zone for zone in counted[-1].zones or ()] == ["crossing", "gate", "yard"]
    assert [sum(zone.to_right) for zone in counted[-1].zones or ()] == [0, 3, 0]
    late = Reader()
    late.serve([0, 1, 3, 4, 2])
    assert [(one.seq, one.revision, one.zones is not None) for one in late.messages[-2:]] == [
        (3, 1, True),
        (4, 1, True),
    ]


def test_a_stream_without_zones_has_no_events() -> None:
    """Nothing is published for a stream that no zone names."""
    reader = Reader()
    reader.serve(range(20), {"elsewhere": SETTINGS["elsewhere"]})
    assert not reader.messages


@pytest.mark.parametrize(
    ("zone", "says"),
    [
        ("", r"zones\.gate\.line .*neither"),
        ("line = [[0, 0], [0, 1]]\npolygon = [[0, 0], [1, 0], [1, 1]]", r"zones\.gate\.line .*both"),
        ("line = [[0, 0]]", r"zones\.gate\.line .*2 to 100 points"),
        ("polygon = [[0, 0], [4, 4], [4, 0], [0, 4]]", r"zones\.gate\.polygon .*edges that do not cross"),
        ("line = [[0, 0], [0, inf]]", r"zones\.gate\.line\.1\.1 "),
        ("line = [[0, 0], [0, 1]]\nmargn = 0.3", r"zones\.gate\.margn .*unknown setting"),
    ],
)
def test_a_wrong_zone_is_refused_with_its_path(tmp_path: Path, zone: str, says: str) -> None:
    """Neither or both shapes, too few points, a polygon that crosses itself."""
    file = tmp_path / "settings.toml"
    file.write_text(f'[zones.gate]\nstreams = ["a/*/*"]\n{zone}\n')
    with pytest.raises(SettingsInvalidError, match=says):
        load(file)


def test_settings_of_a_zone_become_the_zone() -> None:
    """All values arrive; times of stay are in order."""
    shape = ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0))
    values: dict[str, Any] = {"z": (-1.0, 6.0), "classes": ("car",), "margin": 0.1, "min_s": 1.0, "lost_s": 3.0}
    made = ZoneSettings(streams=("a/*/*",), polygon=shape, dwell_s=(30.0, 2.0), **values).zone("one")
    assert made == Zone("one", polygon=shape, dwell_s=(2.0, 30.0), **values)
