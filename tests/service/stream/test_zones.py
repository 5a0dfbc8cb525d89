"""Events of zones in sessions: the same with late frames, after a restore, and with further zones."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from optipmb_client.merging import FinalEvents
from optipmb_schemas import Events, Problem, decode
from optipmb_service.app.configuration import SettingsInvalidError, load
from optipmb_service.session.checkpoint import decode_checkpoint, encode_checkpoint, state_bytes
from optipmb_service.session.outputs import Output, TrackedFrame
from optipmb_service.session.policy import Policy
from optipmb_service.session.session import Session
from optipmb_service.settings import SiteSettings, ZoneSettings
from optipmb_service.streams.profiles import Profiles
from optipmb_service.streams.streams import Streams
from registries import Around, packet_of, streams_of
from router import SECOND, Sensor
from sessions import feed

import optipmb
from optipmb.world.zones import Event, Zone

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
        if isinstance(one, TrackedFrame):
            seq, head = one.header["seq"], (one.run, one.header["revision"])
            if head >= newest.get(seq, (0, 0, ()))[:2]:
                newest[seq] = (*head, one.events)
    return [event for seq in sorted(newest) for event in newest[seq][2]]


def in_order(policy: Policy = POLICY, frames: int = 40) -> tuple[list[Event], Session]:
    session = Session(SENSOR.stream, PROFILE, policy)
    return final(feed(session, range(frames), SENSOR)), session


def test_objects_enter_cross_and_leave() -> None:
    """Three cars appear in the yard and cross the line; one of them passes the crossing."""
    events, _ = in_order()
    found = [(one.zone, one.kind, one.how or one.direction) for one in events]
    assert sorted(found) == sorted(
        [("yard", "entered", "appeared")] * 3
        + [("gate", "crossed", "right")] * 3
        + [("crossing", "entered", "crossed"), ("crossing", "stayed", ""), ("crossing", "left", "crossed")]
    )


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


def test_numbers_go_on_when_all_zones_come_back() -> None:
    """Sessions without zones in between, another session and a lost checkpoint do not restart them."""
    before, session = in_order()
    for policy, frames in ((Policy(), range(40, 50)), (POLICY, range(50, 60))):
        session = Session.restore(decode_checkpoint(encode_checkpoint(session.snapshot())), 0, policy)
        outputs = feed(session, frames, SENSOR)
        assert policy.zones or not any(one.events or one.counts for one in outputs if isinstance(one, TrackedFrame))
    again = Session(SENSOR.stream, PROFILE, POLICY, incarnation=session.incarnation)
    for events in (final(outputs), final(feed(again, range(60, 70), SENSOR))):
        entered = [one.n for one in events if (one.zone, one.kind) == ("yard", "entered")]
        assert entered == [
            1 + max(one.n for one in before if (one.zone, one.kind) == ("yard", "entered")) + k for k in range(3)
        ]
        before = events


SETTINGS: dict[str, Any] = {
    "crossing": {"streams": ["site/*/*"], "polygon": [(5, -6), (12, -6), (12, 6), (5, 6)], "dwell_s": [1.0]},
    "elsewhere": {"streams": ["other/*/*"], "line": [(8.2, -30), (8.2, 30)]},
    "gate": {"streams": ["*/*/*"], "line": [(8.2, -30), (8.2, 30)]},
    "yard": {"streams": ["site/*/*"], "polygon": [(-50, -50), (50, -50), (50, 50), (-50, 50)]},
}


class Reader(Around):
    """A process without network whose events and problems are read."""

    def __init__(self) -> None:
        super().__init__()
        self.messages: list[Events] = []
        self.merged = FinalEvents()
        self.final: list[Events] = []
        self.problems: list[Problem] = []

    def publish_events(self, payload: bytes) -> None:
        message = decode(payload, Events)
        self.messages.append(message)
        self.final += self.merged.take(message)

    def report(self, problem: Problem, _: int) -> None:
        self.problems.append(problem)

    def serve(self, seqs: Iterable[int], lost: Iterable[int] = (), sensor: Sensor = SENSOR, **settings: Any) -> None:
        """Track frames in a process that starts with the kept states, and is killed after saving its own.

        Every fifth frame the states are written too; those behind `lost` never are.
        """
        streams = streams_of(
            self, reporter=self, tracker=optipmb.Tracker, recovery_wait_s=0, **{"zones": SETTINGS} | settings
        )
        for number, seq in enumerate(seqs):
            streams.receive(packet_of(sensor.detections(seq)))
            self.run()
            if number % 5 == 4:
                self.keep(streams)
        self.keep(streams)
        for seq in lost:
            streams.receive(packet_of(sensor.detections(seq)))
            self.run()

    def keep(self, streams: Streams) -> None:
        streams.keep()
        self.run()
        for checkpoint in self.kept.values():
            streams.kept(checkpoint)

    @property
    def events(self) -> list[tuple[object, ...]]:
        rest = sorted(self.merged.held.values(), key=lambda one: one.stamp_ns)
        return told([*self.final, *rest])


def told(messages: Iterable[Events]) -> list[tuple[object, ...]]:
    return [
        (event.zone, event.kind, event.n, event.id, one.labels[event.label], event.at_ns, event.position)
        for one in messages
        for event in one.events
    ]


@pytest.mark.parametrize(
    "runs",
    [
        [(range(40), ())],
        [([0, 2, 1, *range(3, 20), 22, 21, 20, *range(23, 40)], ())],
        [(range(17), ()), ([19, 18, 17, *range(20, 40)], ())],
        [(range(12), range(12, 20)), (range(12, 40), ())],
        # A frame of the first run that the second never gets, and one that comes late in the second alone.
        [([*range(6), *range(7, 13)], range(13, 20)), ([6, *range(13, 40)], ())],
        [(range(22), (23, 22, 24)), (range(22, 30), (31, 30)), (range(30, 40), ())],
    ],
)
def test_final_events_never_change(runs: list[tuple[Iterable[int], Iterable[int]]]) -> None:
    """In order, with late frames and through restarts, they equal a session of frames in order."""
    reader = Reader()
    for seqs, lost in (*runs, (range(40, 60), ())):
        reader.serve(seqs, lost)
    expected = [one[:7] for one in in_order(frames=60)[0]]
    assert reader.events == expected
    settled = told(reader.final)
    assert settled == expected[: len(settled)]
    assert len(settled) >= len(in_order()[0])
    assert {one.stream for one in reader.messages} == {SENSOR.stream}


def test_events_of_frames_that_a_later_run_never_saw_are_void() -> None:
    """A process tracked frames and was killed before their state was kept; the next one begins behind them."""
    reader = Reader()
    reader.serve(range(10), range(10, 22))
    behind = told(reader.messages)
    reader.serve(range(22, 40))
    session = Session(SENSOR.stream, PROFILE, POLICY)
    expected = [one[:7] for one in final(feed(session, [*range(10), *range(22, 40)], SENSOR))]
    assert reader.events == expected
    assert not set(behind) <= set(expected)


def test_nothing_is_final_until_its_state_is_durable() -> None:
    """Neither in the window nor behind the last checkpoint; without a store the window decides."""
    reader = Reader()
    reader.serve([], range(40))
    assert not reader.final
    reader = Reader()
    reader.serve(range(20), range(20, 40))
    (newest,) = [one.delivery for one in reader.messages[-1:]]
    assert newest is not None
    assert newest.final_ns == SENSOR.stamp_ns(20 - 12)  # eleven frames are within a second of the last one kept
    reader = Reader()
    reader.durable = False
    reader.serve([], range(40))
    assert told(reader.final)


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
    _, session = in_order()
    now = session.zone_counts()
    assert now is not None
    assert (now.seq, now.session) == (39, session.session)
    assert {one.zone: sum(one.inside) for one in now.zones or ()} == {"crossing": 0, "gate": 0, "yard": 3}
    assert Session(SENSOR.stream, PROFILE, POLICY).zone_counts() is None


def test_a_stream_without_zones_has_no_events() -> None:
    """Nothing is published for a stream that no zone names."""
    reader = Reader()
    reader.serve(range(20), zones={"elsewhere": SETTINGS["elsewhere"]})
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
        ("line = [[0, 0], [0, 1]]\ngeo = true", r"zones\.gate\.geo: the site of a/\*/\* is not in"),
        ("line = [[11, 48], [11, 49]]\ngeo = true\n[sites.a]\norigin = [48, 11, 0]", r"zones\.gate\.line .*100 km"),
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


def test_points_in_latitude_and_longitude_are_those_of_the_site() -> None:
    """A zone that names places on the globe finds the events of one that names the same places in the world."""
    site = {"origin": (48.265, 11.671, 489.0), "x_heading": 30.0}
    place = optipmb.Georeference((48.265, 11.671, 489.0), 30.0)
    zones = {}
    for name, one in SETTINGS.items():
        shape = "polygon" if "polygon" in one else "line"
        lat, lon, _, _ = place.to_geographic([(x, y, 0) for x, y in one[shape]], 0.0)
        zones[name] = one | {shape: list(zip(lat, lon, strict=True)), "geo": True}
    plain, reader = Reader(), Reader()
    plain.serve(range(40))
    reader.serve(range(40), zones=zones, sites={"site": site})
    assert [one[:5] for one in reader.events] == [one[:5] for one in plain.events]
    for a, b in zip(reader.events, plain.events, strict=True):
        assert a[6] == pytest.approx(b[6], abs=1e-5)
    elsewhere = Reader()
    elsewhere.serve(range(20), sensor=Sensor("other/node/lidar"), zones=zones, sites={"site": site})
    assert not elsewhere.messages


def test_a_zone_across_the_date_line_is_one_zone() -> None:
    """A polygon with a notch has the same shape in the world at 180° of longitude as at 0°."""
    notched = [(0.0, -0.1), (0.0, 0.1), (-0.1, 0.1), (-0.1, 0.05), (-0.05, 0.05), (-0.05, -0.1)]
    shapes = []
    for origin in (0.0, 180.0):
        corners = tuple((lat - 17.0, (lon + origin + 180.0) % 360.0 - 180.0) for lat, lon in notched)
        zone = ZoneSettings(streams=("a/*/*",), geo=True, polygon=corners)
        shapes.append(zone.zone("one", SiteSettings(origin=(-17.0, origin, 0.0))).polygon)
    assert shapes[1] == pytest.approx(np.array(shapes[0]), abs=1e-5)


def test_tracks_far_from_their_site_are_reported_once() -> None:
    """As of coordinates of a grid that were sent as metres from the origin; without a place nothing is wrong."""
    for sites, codes in (({}, []), ({"site": {"origin": (48.265, 11.671, 489.0)}}, ["far"])):
        reader = Reader()
        streams = streams_of(reader, reporter=reader, tracker=optipmb.Tracker, zones={}, sites=sites)
        for seq in range(10):
            frame = SENSOR.detections(seq)
            streams.receive(
                packet_of(frame.model_copy(update={"center": frame.center + np.array([692_000, 5_348_000, 0])}))
            )
            reader.run()
        assert [one.code for one in reader.problems] == codes


def test_a_session_has_at_most_256_zones(tmp_path: Path) -> None:
    """A settings file may have more, of several streams; more of one pattern are refused, others are left out."""
    line = {"line": [(8.2, -30), (8.2, 30)]}
    zones = {f"{site}-{n}": line | {"streams": [f"{site}/*/*"]} for site in ("site", "other") for n in range(200)}
    reader = Reader()
    reader.serve(range(20), zones=zones)
    assert len(reader.messages[0].zones or ()) == 200
    zones |= {f"all-{n}": line | {"streams": ["*/*/lidar"]} for n in range(100)}
    reader = Reader()
    reader.serve(range(20), zones=zones)
    assert len(reader.messages[0].zones or ()) == 256
    assert [(one.code, one.path) for one in reader.problems] == [("refused", "zones")]
    file = tmp_path / "settings.toml"
    file.write_text("\n".join(f'[zones.z{n}]\nstreams = ["a/*/*"]\nline = [[0, 0], [0, 1]]' for n in range(257)))
    with pytest.raises(SettingsInvalidError, match=r"zones: at most 256 for a session, a/\*/\* has 257"):
        load(file)


def test_unknown_classes_of_a_zone_are_reported() -> None:
    """At the start where no profile has one, else as a problem of each session whose profile lacks it."""
    profiles = Profiles.read("nuscenes", {"other/*/*": "kitti"})
    zone = ZoneSettings(streams=("*/*/*",), line=((8.2, -30), (8.2, 30)), classes=("car", "Car"))
    profiles.check_zones({"gate": zone})
    with pytest.raises(optipmb.ParameterError, match=r"zones\.gate\.classes.*'tram'"):
        profiles.check_zones({"gate": zone.model_copy(update={"classes": ("tram",)})})
    reader = Reader()
    for run in (range(10), range(10, 20)):
        reader.serve(run, zones={"gate": zone})
    said = [(one.code, one.path, one.received) for one in reader.problems]
    assert said == [("unknown_class", "zones.gate.classes", "'Car'")] * 2
