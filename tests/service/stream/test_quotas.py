"""What one node and one site may have: sessions, messages, bytes; and whose session goes when there is no room."""

import time
from collections.abc import Callable
from typing import Any

from hypothesis import given
from hypothesis import strategies as st
from optipmb_schemas import Keys
from optipmb_service.session.identity import Incarnation
from optipmb_service.settings import Settings
from optipmb_service.streams.admission import Admission, victim_of
from optipmb_service.telemetry.stream_meter import StreamMeter
from router import SECOND, Node, Sensor, until

KEYS = Keys()


def admission(**settings: Any) -> Admission:
    """The admission of a process without a session, with these quotas alone."""
    none = dict.fromkeys(("node_rate", "node_mb_s", "site_rate", "site_mb_s"), 0)
    return Admission(Settings(**none | settings), list, lambda _: None)


def test_a_rate_is_a_bucket_of_a_second() -> None:
    """A burst of a second's worth passes, then what the rate lets through; other nodes of the site have their own."""
    quotas = admission(node_rate=10)
    taken = [quotas.exceeded("site/node/lidar", 100, 0) for _ in range(12)]
    assert taken == [""] * 10 + ["node site/node: at most 10 messages a second"] * 2
    assert quotas.exceeded("site/node/camera", 100, 0)
    assert not quotas.exceeded("site/other/lidar", 100, 0)
    assert [bool(quotas.exceeded("site/node/lidar", 1, SECOND // 10)) for _ in range(2)] == [False, True]


def test_bytes_are_counted_over_a_site() -> None:
    """Nodes of one site share its bytes; a large message is paid for afterwards."""
    quotas = admission(site_mb_s=1)
    assert not quotas.exceeded("site/a/lidar", 3 * 2**20, 0)
    assert quotas.exceeded("site/b/lidar", 1, SECOND) == "site site: at most 1048576 bytes a second"
    assert not quotas.exceeded("site/b/lidar", 1, 4 * SECOND)
    assert not quotas.exceeded("yard/b/lidar", 1, 0)


def test_sessions_are_counted_per_node_and_site() -> None:
    """A node with its share of streams gets no further one, and a site likewise."""
    quotas = admission(node_sessions=2, site_sessions=3)
    for stream in ("site/a/1", "site/a/2"):
        assert quotas.room(stream) == ""
        quotas.admit(stream)
    assert quotas.room("site/a/3") == "node site/a: at most 2 streams at once"
    assert quotas.room("site/b/1") == ""
    quotas.admit("site/b/1")
    assert quotas.room("site/c/1") == "site site: at most 3 streams at once"
    quotas.release("site/a/2", Incarnation())
    assert quotas.room("site/a/3") == quotas.room("site/c/1") == ""


def test_the_least_recently_used_makes_room() -> None:
    """A silent session goes first; else one of the site that has most, and never one of a site that has no more."""
    silent = [("a/n/1", 99, False), ("b/n/1", 97, True), ("a/n/2", 96, False), ("a/n/3", 98, True)]
    assert victim_of("c/n/1", silent) == "b/n/1"
    busy = [("a/n/1", 99, False), ("b/n/1", 97, False), ("a/n/2", 98, False)]
    assert victim_of("c/n/1", busy) == "a/n/2"
    assert victim_of("a/n/3", busy) is None
    assert victim_of("b/n/2", busy) is None


@given(st.lists(st.integers(1, 10**10), min_size=1, max_size=50))
def test_a_stream_that_keeps_its_period_is_never_silent(distances: list[int]) -> None:
    """Frames in a burst, then at the stream's own period: it is silent three of its periods later, not before."""
    meter = StreamMeter(0)
    now_ns = 0
    assert meter.is_silent(now_ns)
    for distance in distances:
        meter.arrived(now_ns, frame=True)
        now_ns += distance
    meter.arrived(now_ns, frame=True)
    period = max(distances[-4:])
    assert not meter.is_silent(now_ns + period)
    assert meter.is_silent(now_ns + 3 * period + 1)


def test_strangers_of_one_frame_evict_nobody_who_sends(start: Callable[..., Any]) -> None:
    """Every session is taken, and streams of strangers send one frame each: no frame of a regular stream is lost."""
    service, endpoint = start(max_sessions=6)
    regular = [Sensor(f"plant/robot/lidar-{number}") for number in range(4)]
    frames = 40
    with Node(endpoint) as node:
        for seq in range(frames):
            node.send(*(sensor.detections(seq) for sensor in regular))
            strangers = [Sensor(f"stranger-{seq}-{number}/node/lidar") for number in range(3)]
            node.send_plain(*(sensor.detections(0) for sensor in strangers if seq > 1))
            received = 4 * (seq + 1) + 3 * max(0, seq - 1)
            until(lambda received=received: service._streams.totals().received >= received, "it is received")  # type: ignore[misc]
            time.sleep(0.05)  # a period of the regular streams
        for sensor in regular:
            assert [tracks.seq for tracks in node.tracks(sensor.stream, frames)] == list(range(frames))
        assert not [key for key, _, _ in node.problems_seen.items if "/plant/" in key]


def test_one_site_does_not_keep_the_others_out(start: Callable[..., Any]) -> None:
    """A site opens all sessions; another site's stream gets one all the same, the first site's oldest is closed."""
    service, endpoint = start(max_sessions=3)
    greedy = [Sensor(f"greedy/node/{number}") for number in range(3)]
    modest = Sensor("modest/node/lidar")
    with Node(endpoint) as node:
        for sensor in greedy:
            node.send(sensor.detections(0))
            node.tracks(sensor.stream, 1)
        for seq in range(40):
            node.send(modest.detections(seq))
            if any(key == KEYS.tracks(modest.stream) for key, _, _ in list(node.tracks_seen.items)):
                break
            until(lambda seq=seq: service._streams.totals().received > 3 + seq, "it is received")  # type: ignore[misc]
        node.tracks(modest.stream, 1)
        assert node.problem(greedy[0].stream, "refused").expected == "at most 3 streams at once"
        node.send(greedy[0].detections(1))
        assert node.problem(greedy[0].stream, "refused")
        assert modest.stream in {one.stream for one in service.status().sessions}


def test_a_flood_is_refused_and_counted(start: Callable[..., Any]) -> None:
    """A node beyond its rate gets a problem, its messages count as refused, and another node is tracked."""
    service, endpoint = start(node_rate=20)
    flood, other = Sensor("site/flood/lidar"), Sensor("site/other/lidar")
    with Node(endpoint) as node:
        node.send(*(flood.detections(seq) for seq in range(100)), other.detections(0))
        assert "node site/flood: at most 20 messages" in node.problem(flood.stream, "quota").expected
        node.tracks(other.stream, 1)
        until(lambda: service.status().received == 101, "all are counted")
        assert service.status().refused > 0
