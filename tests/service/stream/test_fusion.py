"""Sensors of one node in the service: one session, tracks on one key; problems go to the faulty sensor alone."""

import contextlib
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import optipmb_service.session.arrivals
import optipmb_service.streams.directory
import pytest
from fusing import FRONT, FUSED, REAR, drive
from optipmb_schemas import Detections, Keys, SessionParameters, SessionState, Tracks, decode
from optipmb_service.app.configuration import SettingsInvalidError, load
from optipmb_service.cluster.leases import partition_of
from optipmb_service.session.checkpoint import digest_of
from optipmb_service.session.policy import Policy
from optipmb_service.session.session import Session
from optipmb_service.streams.profiles import Fusion
from optipmb_service.units import SECOND
from router import Node, Sensor, until
from sessions import Merged, tracks

import optipmb

KEYS = Keys()
CROSSING = "site/fused/crossing"
OTHER = Sensor("site/other/lidar", b"o" * 16)


def undisturbed(frames: list[Detections]) -> tuple[dict[tuple[bytes, int], bytes], str]:
    """Tracks, and the digest of the state, of a session that gets the frames in order."""
    one, merged = Session(FUSED, optipmb.load_profile("nuscenes"), Policy(recovery_wait_ns=0), fused=True), Merged()
    for frame in frames:
        merged.take(one.on_detections(frame, 0))
    return merged.plain(), digest_of(one.snapshot())


def published(node: Node, key: str, wanted: dict[tuple[bytes, int], bytes]) -> Merged:
    """Wait until the tracks on a key, with their corrections, equal tracks of frames in order; return them."""
    found = Merged()

    def complete(items: list[tuple[str, bytes, str]]) -> bool:
        found.newest.clear()
        for at, payload, _ in items:
            if at == key:
                found.add(decode(payload, Tracks), 0)
        return found.plain() == wanted

    node.tracks_seen.wait(complete, "the tracks of the frames in order")
    return found


@pytest.mark.parametrize("gone", [False, True])
def test_after_a_restart_no_cache_is_waited_for_that_has_answered_or_is_gone(
    start: Callable[..., Any],
    tmp_path: Path,
    *,
    gone: bool,
) -> None:
    """The session goes on with what the caches of all its sensors held, long before `recovery_wait_s`."""
    frames = drive(40)
    options = {"fuse": ["site/node/*"], "store": str(tmp_path)}
    service, endpoint = start(recovery_wait_s=0, **options)
    with Node(endpoint) as front, contextlib.ExitStack() as nodes:
        rear = nodes.enter_context(Node(endpoint))

        def send(*messages: Detections) -> None:
            for message in messages:
                (front if message.stream == FRONT.stream else rear).send(message)

        def tracked() -> SessionState | None:
            service.housekeeping()
            answers = front.query(KEYS.query(FUSED, "state"))
            return decode(answers[0][2], SessionState) if answers and answers[0][0] else None

        def reached(frames: int) -> bool:
            return (state := tracked()) is not None and state.frames == frames

        for first in range(0, 40, 8):
            send(*frames[first : first + 8])
            until(partial(reached, first + 8), "they are tracked")
        assert service.stop()
        if gone:
            nodes.close()
        else:
            send(*(one for one in frames[40:] if one.stream == REAR.stream))
        send(*(one for one in frames[40:] if one.stream == FRONT.stream))
        rest = frames[:40] + [one for one in frames[40:] if not gone or one.stream == FRONT.stream]
        service, _ = start(listen=[endpoint], recovery_wait_s=60, **options)
        until(partial(reached, len(rest)), "all are tracked", 50.0)
        state = tracked()
    assert state is not None
    assert (state.digest, state.late, state.gaps) == (undisturbed(rest)[1], 0, 0)


def test_a_sensor_that_is_heard_of_after_the_session_began_loses_no_frame(
    start: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """While its token may be on its way, what a cache holds of another sensor goes no second ahead of its frames."""
    monkeypatch.setattr(optipmb_service.streams.directory, "BACK_NS", 0)
    monkeypatch.setattr(optipmb_service.session.arrivals, "BACK_NS", 600 * SECOND)
    frames = drive(40)
    service, endpoint = start(fuse=["site/node/*"], recovery_wait_s=60)
    with Node(endpoint) as node:

        def heard_of(*sensors: str) -> bool:
            service.housekeeping()
            return [one.sensors for one in service.status().sessions] == [sensors]

        def reached(frames: int) -> bool:
            service.housekeeping()
            return node.ask(KEYS.query(FUSED, "state"), SessionState).frames >= frames

        node.send(*(one for one in frames if one.stream == REAR.stream))
        until(lambda: heard_of(REAR.stream) and reached(1), "the rear sensor is heard of")
        node.send(*(one for one in frames if one.stream == FRONT.stream))
        until(lambda: heard_of(FRONT.stream, REAR.stream), "the front sensor is heard of")
        monkeypatch.setattr(optipmb_service.session.arrivals, "BACK_NS", 0)
        until(lambda: reached(80), "all are tracked")
        state = node.ask(KEYS.query(FUSED, "state"), SessionState)
    assert (state.digest, state.late, state.gaps) == (undisturbed(frames)[1], 0, 0)


def test_queries_are_answered_for_the_session(start: Callable[..., Any]) -> None:
    """State, parameters and a reset on the session's key; on a sensor's key the reply names the session."""
    service, endpoint = start(fuse=["site/node/*"], profiles={FUSED: "kitti"}, stale_s=0.2)
    with Node(endpoint) as node:
        node.send(FRONT.detections(0), REAR.detections(0))
        until(lambda: node.ask(KEYS.query(FUSED, "state"), SessionState).frames == 2, "both are tracked")
        assert node.ask(KEYS.query(FUSED, "parameters"), SessionParameters).profile == "kitti"
        state = node.ask(KEYS.query(FUSED, "reset"), SessionState)
        assert (state.stream, state.tracks, state.frames) == (FUSED, 0, 2)
        for what in ("state", "reset", "parameters", "density"):
            refused = node.refused(KEYS.query(FRONT.stream, what))
            assert (refused.path, refused.stream) == ("key", FRONT.stream)
            assert FUSED in refused.expected
        node.send(FRONT.detections(1))

        def silent() -> bool:
            service.housekeeping()
            (line,) = service.status().sessions
            return bool(line.silent)

        until(silent, "a sensor is silent")
        (line,) = service.status().sessions
        assert (line.stream, line.sensors) == (FUSED, (FRONT.stream, REAR.stream))


def test_what_is_wrong_is_said_to_the_sensor(start: Callable[..., Any]) -> None:
    """Bytes that are no message, another's message, a wrong clock: the other sensor is tracked on."""
    _, endpoint = start(fuse=["site/node/*"])
    with Node(endpoint) as node:
        node.send(FRONT.detections(0), REAR.detections(0))
        node.tracks(FUSED, 2)
        node.send_raw(KEYS.detections(REAR.stream), b"no message")
        assert node.problem(REAR.stream, "malformed").stream == REAR.stream
        node.send(REAR.detections(1, stamp_ns=5))
        assert node.problem(REAR.stream, "time_jump").seq == 1
        node.send(REAR.detections(2, score=np.full(3, 0.5), size=np.full((3, 3), 1e-300)), FRONT.detections(3))
        until(lambda: node.ask(KEYS.query(FUSED, "state"), SessionState).seq == 3, "the front sensor is tracked")
        node.send_raw(KEYS.detections(FUSED), b"")  # the name of the tracks is none of a sensor
        until(lambda: node.ask(KEYS.query(FUSED, "state"), SessionState).frames >= 3, "nobody is harmed")
        assert not [key for key, _, _ in node.problems_seen.items if key == KEYS.problems(FRONT.stream)]


def test_the_sensors_of_a_session_have_one_owner() -> None:
    """A session is given to a process by its name; a sensor outside the patterns has a session of its own."""
    fusion = Fusion(("site/*/lidar*", "yard/crane/*"))
    assert fusion.session_of("site/car-7/lidar-front") == fusion.session_of("site/car-7/lidar-rear")
    assert fusion.session_of("site/car-7/lidar-front") == "site/car-7/fused"
    assert fusion.session_of("site/car-7/radar") == "site/car-7/radar"
    assert fusion.session_of("site/car-8/lidar") == "site/car-8/fused"
    assert fusion.session_of("yard/crane/x") == fusion.session_of("yard/crane/fused") == "yard/crane/fused"
    assert fusion.is_session("site/car-7/fused")
    assert not fusion.is_session("street/car-7/fused")
    names = [f"yard/crane/s{number}" for number in range(20)]
    assert len({partition_of(fusion.session_of(name)) for name in names}) == 1


def test_streams_of_several_nodes_feed_one_session() -> None:
    """By the patterns of their site; no node has the name of such sessions."""
    options = {"crossing": {"streams": ["site/*/lidar*", "site/cam-*/front"]}, "yard": {"streams": ["other/a/*"]}}
    fusion = Fusion.of(load(None, {"fused": options, "fuse": ["site/*/radar"]}).settings)
    assert fusion.session_of("site/car-7/lidar-front") == fusion.session_of("site/cam-1/front") == CROSSING
    assert fusion.session_of("site/car-7/radar") == "site/car-7/fused"
    assert fusion.session_of("site/car-7/front") == "site/car-7/front"
    assert fusion.session_of("street/car-7/lidar") == "street/car-7/lidar"
    assert fusion.session_of("other/a/x") == "other/fused/yard"
    assert all(map(fusion.is_session, (CROSSING, "site/fused/another", "site/car-7/fused")))
    assert [fusion.seen_by(name) for name in (CROSSING, "site/car-7/fused")] == ["site/*/*", "site/car-7/*"]
    assert not Fusion.of(load(None, {}).settings).is_session(CROSSING)


def test_nodes_of_a_site_share_tracks(start: Callable[..., Any]) -> None:
    """The tracks equal one session with all their frames; detections below the node `fused` are refused."""
    fused = {"crossing": {"streams": ["site/*/front", "site/*/rear"]}}
    service, endpoint = start(fused=fused, sensors={"site/*/rear": {"trust_size": False}}, recovery_wait_s=1)
    there = replace(REAR, stream="site/other/rear")
    frames = [sensor.detections(seq) for seq in range(20) for sensor in (FRONT, there)]
    sensors = optipmb.Sensors.read({"site/*/rear": {"trust_size": False}})
    one = Session(CROSSING, optipmb.load_profile("nuscenes"), Policy(recovery_wait_ns=0, sensors=sensors), fused=True)
    merged = Merged()
    with Node(endpoint) as node:
        for frame in frames:
            merged.take(one.on_detections(frame, 0))
        node.send(*frames, OTHER.detections(0))
        until(lambda: node.ask(KEYS.query(CROSSING, "state"), SessionState).frames == len(frames), "all are tracked")
        assert node.ask(KEYS.query(CROSSING, "state"), SessionState).session == one.session
        published(node, KEYS.tracks(CROSSING), merged.plain())
        assert node.refused(KEYS.query(FRONT.stream, "state")).expected.startswith(CROSSING)
        node.send_raw(KEYS.detections("site/fused/lidar"), b"")
        blind = {FRONT.stream, there.stream}

        def reported() -> bool:
            found = service.status().problems
            named = any(one.expected == "a node not named fused, as its tracks" for one in found)
            return named and {one.stream for one in found if one.code == "no_view"} == blind

        until(reported, "sensors without field of view, and the reserved name")
        assert node.problem("site/fused/lidar", "invalid_value").path == "key"


@pytest.mark.parametrize(
    ("given", "setting"),
    [
        ({"fuse": ["site/car/fused"]}, "fuse"),
        ({"fuse": ["site/*/lidar*"], "inputs": {"site/car/fused": {}}}, "inputs"),
        ({"fuse": ["site/*/lidar*"], "mqtt": {"inputs": {"site/{1}/fused": {"topic": "a/+"}}}}, "mqtt.inputs"),
        ({"fuse": ["*/*/*"], "ros2": {"streams": {"site/car/fused": {"detections": "/a"}}}}, "ros2.streams"),
        ({"fused": {"a": {"streams": ["site/car/x"]}}, "inputs": {"site/fused/cam": {}}}, "inputs"),
    ],
)
def test_a_sensor_with_the_name_of_a_fused_session_is_refused(given: dict[str, Any], setting: str) -> None:
    """At the start, where a setting names it."""
    with pytest.raises(SettingsInvalidError, match=rf"setting {setting}: no (sensor|node) is named fused"):
        load(None, given)
    load(None, {name: one for name, one in given.items() if not name.startswith("fuse")})


def test_patterns_without_a_common_stream_are_allowed() -> None:
    """For any letters in common."""
    fused = {
        "a": {"streams": ["s/n/l*r", "s/n/x*"]},
        "b": {"streams": ["s/n/l*a", "s/m/*"]},
        "c": {"streams": ["t/n/*"]},
    }
    assert load(None, {"fused": fused, "fuse": ["s/n/y*"]}).settings.fused_sessions.keys() == {
        "s/fused/a",
        "s/fused/b",
        "t/fused/c",
    }


def test_a_list_of_patterns_comes_from_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    """With commas, as other lists do."""
    monkeypatch.setenv("OPTIPMB_FUSE", "site/*/lidar*, yard/*/*")
    assert load().settings.fuse == ("site/*/lidar*", "yard/*/*")


def test_tracks_of_a_session_are_merged_by_sensor() -> None:
    """Two sensors may share an epoch and a number: their tracks belong to two frames."""
    from optipmb_client.merging import Merging, Novelty  # noqa: PLC0415 - of the client

    one, merging = Session(FUSED, optipmb.load_profile("nuscenes"), Policy(recovery_wait_ns=0), fused=True), Merging(10)
    side = Sensor("site/node/side", FRONT.epoch)
    found = [*tracks(one.on_detections(FRONT.detections(0), 0)), *tracks(one.on_detections(side.detections(0), 0))]
    assert [merging.take(message) for message in found] == [Novelty.NEW] * 2
