"""The service over real Zenoh: streams in, tracks out, questions answered, faults contained."""

import json
import os
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
import zenoh.ext
from optipmb_client import Connection
from optipmb_client.errors import ConnectionFailed as TransportError
from optipmb_client.zenoh.handles import Query
from optipmb_client.zenoh.session import HEARTBEAT_S
from optipmb_schemas import (
    Density,
    Detections,
    Keys,
    ResetRequest,
    ServiceStatus,
    SessionParameters,
    SessionState,
    Tracks,
    decode,
    decode_dump,
    encode,
    encode_json,
    encoding_of,
)
from optipmb_service.app.configuration import load
from optipmb_service.app.workers import QUERIES
from optipmb_service.session.outputs import TrackedFrame
from optipmb_service.session.session import Session
from optipmb_service.zenoh.transport import Transport
from router import Node, Sensor, plain, until
from routers import free_endpoint, open_router
from sessions import Gated
from structlog.testing import capture_logs

import optipmb

KEYS = Keys()
SENSOR = Sensor()
NUSCENES = optipmb.load_profile("nuscenes")


def offline(sensor: Sensor, seqs: Any, **changes: Any) -> list[bytes]:
    """What a session alone makes of the frames."""
    session = Session(sensor.stream, NUSCENES)
    outputs = [output for seq in seqs for output in session.on_detections(sensor.detections(seq, **changes), 0)]
    return [plain(output.tracks) for output in outputs if isinstance(output, TrackedFrame)]


def test_frames_become_tracks(node: Node) -> None:
    """Every frame of a stream gives one message of tracks, byte for byte what the session alone makes of it."""
    node.send(*(SENSOR.detections(seq) for seq in range(10)))
    received = node.tracks(SENSOR.stream, 10)
    assert [plain(message) for message in received] == offline(SENSOR, range(10))
    delivery = received[-1].delivery
    assert delivery is not None
    assert delivery.instance == "test"
    assert delivery.published_ns >= delivery.received_ns
    assert {encoding for _, _, encoding in node.tracks_seen.items} == {encoding_of(Tracks)}


def test_a_parent_that_is_busy_keeps_no_member_waiting() -> None:
    """While it carries out an order, no query to all members waits for it, and it answers with its status."""
    endpoint, began, gate = free_endpoint(), threading.Event(), threading.Event()

    def answer(request: Query) -> None:
        if request.key == KEYS.drain("test"):
            began.set()
            gate.wait(120)
        else:
            request.answer_text(request.key, b"here", "")
        request.finish()

    transport = Transport(load(None, {"listen": [endpoint], "instance": "test", "store": "none"}).settings)
    try:
        transport.serve_service(answer, QUERIES)
        with Node(endpoint) as node, ThreadPoolExecutor(1) as pool:

            def ordered() -> bool:
                node.query(KEYS.drain("test"), timeout=0.1)
                return began.is_set()

            until(ordered, "the order is taken")
            try:
                assert pool.submit(node.query, KEYS.recent(), b"", 100.0).result(30.0) == []
                until(lambda: [one[2] for one in node.query(KEYS.status("test"))] == [b"here"], "its status")
            finally:
                gate.set()
    finally:
        gate.set()
        transport.close()


def test_json_is_understood(node: Node) -> None:
    """A frame in JSON, without an encoding, gives the tracks of the same frame in msgpack."""
    node.send_raw(KEYS.detections(SENSOR.stream), encode_json(SENSOR.detections(0)))
    assert [plain(message) for message in node.tracks(SENSOR.stream, 1)] == offline(SENSOR, [0])


def test_a_fast_replay_keeps_all_its_clouds(node: Node) -> None:
    """Eight frames and clouds in flight at once, no cloud lost, in order."""
    wait = SessionParameters(cloud_wait_s=10.0)
    node.ask(KEYS.query(SENSOR.stream, "parameters"), SessionParameters, wait)
    for first in range(0, 64, 8):
        node.send(*(SENSOR.detections(seq, has_points=True) for seq in range(first, first + 8)))
        node.send(*(SENSOR.points(seq, count=30_000) for seq in range(first, first + 8)))
        node.tracks(SENSOR.stream, first + 8)
    received = node.tracks(SENSOR.stream, 64)
    assert [message.seq for message in received] == list(range(64))
    assert all(message.cloud_used for message in received)


def test_a_bad_frame_is_reported_with_its_field(node: Node) -> None:
    """A message that is not valid is answered on the problems key; the session and its next frames do not notice."""
    node.send(SENSOR.detections(0))
    bad = encode_json(SENSOR.detections(1)).replace(b'"score":[0.8', b'"score":[1.5')
    node.send_raw(KEYS.detections(SENSOR.stream), bad, "application/json;optipmb.Detections.v1")
    problem = node.problem(SENSOR.stream, "invalid_value")
    assert (problem.path, problem.instance) == ("score[0]", "test")
    node.send(SENSOR.detections(2))
    received = node.tracks(SENSOR.stream, 2)
    assert received[1].gap == 1
    assert node.ask(KEYS.query(SENSOR.stream, "state"), SessionState).refused == 1


@pytest.mark.parametrize(
    ("payload", "encoding", "code"),
    [
        (b"\xc1garbage", "", "malformed"),
        (encode(SENSOR.points(0)), encoding_of(SENSOR.points(0)), "wrong_type"),
        (encode(SENSOR.detections(0)), "application/msgpack;optipmb.Detections.v2", "unsupported_version"),
        (encode(replace(SENSOR, stream="an/other/one").detections(0)), "", "invalid_value"),
    ],
)
def test_bad_input_creates_no_session(node: Node, payload: bytes, encoding: str, code: str) -> None:
    """Garbage on a stream's key is reported there and leaves nothing behind: no session, no owner."""
    node.send_raw(KEYS.detections("a/new/stream"), payload, encoding)
    assert node.problem("a/new/stream", code).stream == "a/new/stream"
    status = node.ask(KEYS.status("test"), ServiceStatus)
    assert (status.sessions, status.refused) == ((), 1)
    assert node.alive(KEYS.all_owners()) == []
    assert node.ask(KEYS.query("a/new/stream", "state"), SessionState).state == "new"


def test_too_large_messages_are_refused_unread(start: Callable[..., Any]) -> None:
    """A payload above the limit is answered by a problem."""
    _, endpoint = start(limits={"max_bytes": 2000})
    with Node(endpoint) as node:
        node.send_raw(KEYS.points(SENSOR.stream), bytes(3000))
        assert node.problem(SENSOR.stream, "too_large").received == "3000 bytes"


def test_a_flooding_stream_does_not_touch_another(start: Callable[..., Any]) -> None:
    """One stream sends garbage as fast as it can; the other's tracks are byte for byte the same."""
    _, endpoint = start()
    flood = replace(SENSOR, stream="site/node/flood")
    with Node(endpoint) as node, Node(endpoint) as noisy:
        noisy.send(flood.detections(0))
        noisy.tracks(flood.stream, 1)
        for seq in range(50):
            node.send(SENSOR.detections(seq))
            for _ in range(40):
                noisy.send_raw(KEYS.detections(flood.stream), os.urandom(2000))
        received = node.tracks(SENSOR.stream, 50)
        assert [plain(message) for message in received] == offline(SENSOR, range(50))
        assert noisy.problems(flood.stream, 1)[0].code in {"malformed", "shed", "too_large"}


def test_streams_are_independent(node: Node) -> None:
    """Streams sent interleaved come out as each alone: same ids, same bytes."""
    sensors = [Sensor(stream=f"site/node/{index}", objects=index + 1) for index in range(4)]
    for seq in range(10):
        node.send(*(sensor.detections(seq) for sensor in sensors))
    for sensor in sensors:
        assert [plain(message) for message in node.tracks(sensor.stream, 10)] == offline(sensor, range(10))


def test_an_error_in_the_tracker_is_contained(start: Callable[..., Any], tmp_path: Path) -> None:
    """Fault 15: an exception in a step quarantines that stream and saves its frames; others go on, a reset helps."""

    class Failing(optipmb.Tracker):
        def step(self, density: optipmb.Density, frame: optipmb.Frame) -> optipmb.StepResult:
            if len(frame.score) == 7:
                raise ZeroDivisionError("seven")
            return super().step(density, frame)

    other = replace(SENSOR, stream="site/node/other")
    _, endpoint = start(tracker=Failing, store=str(tmp_path))
    with Node(endpoint) as node:
        node.send(SENSOR.detections(0), SENSOR.detections(1, objects=7), SENSOR.detections(2))
        problem = node.problem(SENSOR.stream, "quarantined")
        assert "ZeroDivisionError: seven" in problem.received
        (file,) = (tmp_path / "quarantine").iterdir()
        dump = decode_dump(file.read_bytes())
        assert (dump.stream, dump.error) == (SENSOR.stream, "ZeroDivisionError: seven")
        assert [frame.detections.seq for frame in dump.frames] == [0, 1]
        node.send(*(other.detections(seq) for seq in range(3)))
        node.tracks(other.stream, 3)
        state = node.ask(KEYS.query(SENSOR.stream, "reset"), SessionState)
        assert (state.received, state.frames, state.refused) == (3, 1, 2)
        node.send(SENSOR.detections(3))
        assert node.tracks(SENSOR.stream, 2)[-1].seq == 3


def test_the_service_fetches_what_it_missed(start: Callable[..., Any]) -> None:
    """Frames published just before the service came are tracked: they come from the publisher's cache."""
    endpoint = free_endpoint()
    with open_router(endpoint), Node(endpoint) as node:
        node.send(*(SENSOR.detections(seq) for seq in range(5)))
        start(listen=None, connect=[endpoint])
        assert [plain(message) for message in node.tracks(SENSOR.stream, 5)] == offline(SENSOR, range(5))


def test_the_service_fetches_history(start: Callable[..., Any]) -> None:
    """The same from a publisher that keeps a cache and sends no heartbeats."""
    endpoint = free_endpoint()
    with open_router(endpoint), Node(endpoint) as node:
        publisher = zenoh.ext.declare_advanced_publisher(
            node.session,
            KEYS.detections(SENSOR.stream),
            encoding=encoding_of(Detections),
            cache=zenoh.ext.CacheConfig(10),
            sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=None),
            publisher_detection=True,
        )
        for seq in range(5):
            publisher.put(encode(SENSOR.detections(seq)))
        start(listen=None, connect=[endpoint])
        assert [plain(message) for message in node.tracks(SENSOR.stream, 5)] == offline(SENSOR, range(5))


def test_state_of_a_stream(node: Node) -> None:
    """q/state tells what a session holds; a stream without one is new; a key expression asks all."""
    other = replace(SENSOR, stream="site/node/other")
    node.send(SENSOR.detections(0), other.detections(0))
    node.tracks(SENSOR.stream, 1)
    node.tracks(other.stream, 1)
    state = node.ask(KEYS.query(SENSOR.stream, "state"), SessionState)
    assert (state.state, state.frames, state.seq, state.tracks) == ("running", 1, 0, 3)
    assert node.ask(KEYS.query("no/such/stream", "state"), SessionState).state == "new"
    answers = node.query(KEYS.all_queries("state"))
    assert sorted(decode(payload, SessionState).stream for _, _, payload in answers) == [SENSOR.stream, other.stream]


def test_density_of_a_stream(node: Node) -> None:
    """q/density gives the Poisson components that the tracker holds, to the bit; none without a session."""
    parameters = optipmb.load_profile("kitti")  # makes Poisson components of first detections
    frame = SENSOR.detections(0, labels=("Car", "Cyclist"), score=np.full(3, 0.4))
    session = Session(SENSOR.stream, parameters)
    session.on_detections(frame, 0)
    node.ask(KEYS.query(SENSOR.stream, "parameters"), SessionParameters, SessionParameters(profile="kitti"))
    node.send(frame)
    tracks = node.tracks(SENSOR.stream, 1)[-1]
    answer = node.ask(KEYS.query(SENSOR.stream, "density"), Density)
    assert (answer.stream, answer.session, answer.stamp_ns) == (SENSOR.stream, tracks.session, tracks.stamp_ns)
    assert answer.labels == tuple(parameters.classes)
    poisson = session.density.poisson
    assert len(poisson) > 0
    for name in ("label", "weight", "mean", "covariance"):
        assert np.array_equal(getattr(answer, name), getattr(poisson, name)), name
    assert np.array_equal(answer.z, poisson.auxiliary[:, 3])
    state = node.ask(KEYS.query(SENSOR.stream, "state"), SessionState)
    assert state.poissons == len(answer.weight)
    nothing = node.ask(KEYS.query("no/such/stream", "density"), Density)
    assert (len(nothing.weight), nothing.session, nothing.stamp_ns) == (0, "0" * 32, None)


def test_zones_of_a_stream_without_any(node: Node) -> None:
    """q/zones is refused, with the name of the stream."""
    assert node.refused(KEYS.query(SENSOR.stream, "zones")).received == repr(SENSOR.stream)


def test_questions_that_are_none_are_refused(node: Node) -> None:
    """Unknown questions, wrong payloads and stranger keys get an error reply, at once."""
    assert node.refused("optipmb/v1/site/node/lidar/q/nonsense").code == "invalid_value"
    assert node.refused("optipmb/v1/owner/node/lidar/q/state").code == "invalid_value"
    assert node.refused(KEYS.query(SENSOR.stream, "reset"), b"\xc1").code == "malformed"
    assert node.refused(KEYS.query(SENSOR.stream, "parameters"), SENSOR.points(0)).code == "wrong_type"
    assert node.ask(KEYS.status("test"), ServiceStatus).sessions == ()


def test_reset(node: Node) -> None:
    """q/reset restarts the session, with close it frees it; then a new session has new ids."""
    node.send(*(SENSOR.detections(seq) for seq in range(3)))
    first = node.tracks(SENSOR.stream, 3)[-1]
    state = node.ask(KEYS.query(SENSOR.stream, "reset"), SessionState)
    assert (state.state, state.bernoullis) == ("running", 0)
    assert state.session != first.session
    node.send(SENSOR.detections(3))
    second = node.tracks(SENSOR.stream, 4)[-1]
    assert second.session == state.session
    assert node.alive(KEYS.owners(SENSOR.stream)) == [KEYS.owner(SENSOR.stream, "test")]
    closed = node.ask(KEYS.query(SENSOR.stream, "reset"), SessionState, ResetRequest(close=True))
    assert (closed.state, closed.frames) == ("closed", 4)
    until(lambda: node.alive(KEYS.all_owners()) == [], "the owner's token is withdrawn")
    node.send(SENSOR.detections(4))
    third = node.tracks(SENSOR.stream, 5)[-1]
    assert len({first.session, second.session, third.session}) == 3
    assert min(third.id) > max(second.id) > max(first.id)


def test_parameters(node: Node) -> None:
    """q/parameters asks and sets, ahead of the first frame or with a restart; impossible values are refused."""
    key = KEYS.query(SENSOR.stream, "parameters")
    asked = node.ask(key, SessionParameters)
    assert (asked.profile, asked.cloud_wait_s, len(asked.horizons)) == ("nuscenes", 0.1, 0)
    assert asked.values == json.loads(json.dumps(NUSCENES.model_dump(mode="json")))
    assert node.ask(KEYS.status("test"), ServiceStatus).sessions == ()
    given = node.ask(key, SessionParameters, SessionParameters(profile="kitti", cloud_wait_s=0.3))
    assert (given.profile, given.cloud_wait_s) == ("kitti", 0.3)
    assert node.ask(KEYS.query(SENSOR.stream, "state"), SessionState).state == "new"
    node.send(SENSOR.detections(0, labels=("Car", "Cyclist")))
    assert node.tracks(SENSOR.stream, 1)[0].profile == "kitti"
    refused = node.refused(key, SessionParameters(profile="nuscenes"))
    assert (refused.code, refused.path) == ("refused", "profile")
    assert node.refused(key, SessionParameters(profile="unheard-of")).path == "profile"
    assert node.refused(key, b'{"profile":"/etc/passwd"}').path == "profile"
    node.ask(key, SessionParameters, SessionParameters(profile="nuscenes", restart=True))
    node.send(SENSOR.detections(1))
    assert node.tracks(SENSOR.stream, 2)[1].profile == "nuscenes"
    given = node.ask(key, SessionParameters, SessionParameters(horizons=np.array([1.0, 3.0])))
    assert given.horizons.tolist() == [1.0, 3.0]
    node.send(SENSOR.detections(2))
    before, after = node.tracks(SENSOR.stream, 3)[1:]
    assert before.session == after.session
    assert before.horizons is None
    assert after.path_position is not None
    assert after.path_position.shape == (len(after.id), 2, 2)
    assert node.refused(key, b'{"horizons":[3,1]}').path == "horizons[1]"


def test_profiles_follow_patterns(start: Callable[..., Any]) -> None:
    """The first pattern that matches a stream names its profile."""
    _, endpoint = start(profiles={"site/*/lidar": "kitti", "site/*": "nuscenes"}, profile="kitti")
    with Node(endpoint) as node:
        profiles = [
            node.ask(KEYS.query(stream, "parameters"), SessionParameters).profile
            for stream in ("site/a/lidar", "site/a/radar", "other/a/lidar")
        ]
    assert profiles == ["kitti", "nuscenes", "kitti"]


def test_status(node: Node) -> None:
    """q/status lists sessions with their figures and the newest problems."""
    node.send(*(SENSOR.detections(seq) for seq in range(20)))
    node.tracks(SENSOR.stream, 20)
    node.send_raw(KEYS.detections("a/b/c"), b"\xc1")
    node.problem("a/b/c", "malformed")
    status = node.ask(KEYS.status("test"), ServiceStatus)
    assert (status.instance, status.state, status.frames, status.refused) == ("test", "ready", 20, 1)
    (summary,) = status.sessions
    assert (summary.stream, summary.frames, summary.tracks) == (SENSOR.stream, 20, 3)
    assert summary.rate_hz > 0
    assert 0 < summary.latency_p50_ms <= summary.latency_p99_ms
    assert summary.age_s is not None
    assert [problem.code for problem in status.problems] == ["malformed"]
    assert [key for _, key, _ in node.query(KEYS.all_status())] == [KEYS.status("test")]
    assert node.alive(KEYS.all_alive()) == [KEYS.alive("test")]


def test_a_silent_stream_is_stale(start: Callable[..., Any]) -> None:
    """A stream without frames for long is shown as stale, and no longer when it is back."""
    service, endpoint = start(stale_s=0.02)
    with Node(endpoint) as node:
        node.send(SENSOR.detections(0))
        node.tracks(SENSOR.stream, 1)

        def stale() -> bool:
            service.housekeeping()
            return bool(service.status().sessions[0].state == "stale")

        until(stale, "the stream is stale")
        node.send(SENSOR.detections(1))
        node.tracks(SENSOR.stream, 2)
        assert service.status().sessions[0].state == "running"


def test_a_step_that_does_not_end_does_not_keep_the_service(start: Callable[..., Any]) -> None:
    """Stopping gives up on a stuck step in time, says so, and closes the network all the same."""
    gated = Gated()

    service, endpoint = start(tracker=gated.tracker, grace_s=0.2)
    with Node(endpoint) as node, capture_logs() as logs:
        node.send(SENSOR.detections(0))
        assert gated.entered.wait(60)
        assert not service.stop(1.0)
    assert {"event": "step_hangs", "steps": ["tracking"], "log_level": "error"} in logs
    gated.gate.set()


def test_a_router_that_goes_and_comes_loses_nothing(start: Callable[..., Any]) -> None:
    """While the router is away publisher and service wait; afterwards missed messages are recovered, none twice."""
    endpoint = free_endpoint()
    router = open_router(endpoint)
    start(listen=None, connect=[endpoint])
    with Node(endpoint) as node:
        node.send(*(SENSOR.detections(seq) for seq in range(5)))
        node.tracks(SENSOR.stream, 5)
        router.close()  # type: ignore[no-untyped-call]  # zenoh's stubs leave it untyped
        node.send(*(SENSOR.detections(seq) for seq in range(5, 10)))
        with open_router(endpoint):
            state = KEYS.query(SENSOR.stream, "state")
            until(lambda: bool(node.query(state, timeout=5.0)), "the service is back")
            node.send(SENSOR.detections(10))

            def caught_up() -> bool:
                return node.ask(state, SessionState).frames == 11

            until(caught_up, "all frames are tracked")
            assert node.ask(state, SessionState).gaps == 0


def test_what_a_client_sent_last_while_the_router_was_away_is_recovered(start: Callable[..., Any]) -> None:
    """A last frame that could not be received, and silence: the next heartbeat after the router is back tells of it."""
    endpoint = free_endpoint()
    router = open_router(endpoint)
    start(listen=None, connect=[endpoint])
    with Connection(endpoint) as link, Node(endpoint) as node:
        sender = link.cached_sender(KEYS.detections(SENSOR.stream), encoding_of(Detections), cache=20)
        sender.put(encode(SENSOR.detections(0)))
        node.tracks(SENSOR.stream, 1)
        router.close()  # type: ignore[no-untyped-call]  # zenoh's stubs leave it untyped
        sender.put(encode(SENSOR.detections(1)))
        time.sleep(2 * HEARTBEAT_S)  # a heartbeat that is sent once alone is lost, too
        with open_router(endpoint):
            state = KEYS.query(SENSOR.stream, "state")
            until(lambda: bool(node.query(state, timeout=5.0)), "the service is back")
            until(lambda: node.ask(state, SessionState).frames == 2, "the last frame is tracked")


def test_a_publisher_whose_numbers_go_back_is_reported(start: Callable[..., Any]) -> None:
    """One that starts again with the Zenoh id of its last run is not heard, which is said with its stream."""
    service, endpoint = start()

    def codes() -> set[str]:
        service.housekeeping()
        return {one.code for one in service.status().problems}

    with Node(endpoint) as other:
        for frames in (20, 3):
            with Node(endpoint, zid="ab12") as node:
                node.send(*(SENSOR.detections(seq) for seq in range(frames)))
                if frames == 3:
                    until(lambda: "numbers_back" in codes(), "it is reported")
                else:
                    other.tracks(SENSOR.stream, frames)
                    assert "numbers_back" not in codes()
        problem = other.problem(SENSOR.stream, "numbers_back")
    assert (problem.expected, problem.received) == (
        "messages numbered from 20 on by Zenoh",
        "numbers that began again, now 2",
    )


def test_a_client_with_an_id_of_its_own_does_not_start(tmp_path: Path) -> None:
    """A configuration file with an id is refused by a service that is a client; a router may have one."""
    file = tmp_path / "zenoh.json5"
    file.write_text('{id: "ab12"}')
    settings = load(None, {"connect": [free_endpoint()], "zenoh_config": str(file), "instance": "test"}).settings
    with pytest.raises(TransportError, match='id: expected none, received "ab12"'):
        Transport(settings)


def test_garbage_on_every_key_costs_nothing(node: Node) -> None:
    """Random bytes on every kind of key, and a stream that is tracked meanwhile comes out unchanged."""
    random = np.random.default_rng(1)
    for seq in range(30):
        for topic in ("detections", "points", "tracks", "problems", "q/state", "other"):
            for stream in (SENSOR.stream, f"x/{seq}/y", f"owner/{seq}/y", f"bad key/{seq}/ü"):
                node.send_raw(f"optipmb/v1/{stream}/{topic}", random.bytes(int(random.integers(0, 200))))
        node.send(SENSOR.detections(seq))
    key = KEYS.tracks(SENSOR.stream)

    def ours() -> list[bytes]:
        good = encoding_of(Tracks)
        return [payload for at, payload, encoding in node.tracks_seen.items if at == key and encoding == good]

    node.tracks_seen.wait(lambda _: len(ours()) >= 30, "30 tracks")
    assert [plain(decode(payload, Tracks)) for payload in ours()] == offline(SENSOR, range(30))
    status = node.ask(KEYS.status("test"), ServiceStatus)
    assert [summary.stream for summary in status.sessions] == [SENSOR.stream]
    assert status.refused >= 60
