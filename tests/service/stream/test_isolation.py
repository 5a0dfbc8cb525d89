"""Streams do not affect each other: each test runs a careless node next to a careful one."""

import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lease_log import Alone
from optipmb_schemas import (
    Detections,
    Keys,
    MessageError,
    MoveRequest,
    ServiceStatus,
    SessionState,
    decode,
    encode,
    encoding_of,
)
from optipmb_service.app.storage import STORE_FILE
from optipmb_service.cluster.leases import PARTITIONS
from optipmb_service.cluster.sqlite import SqliteStore
from optipmb_service.session.counts import MAX_COUNT
from optipmb_service.session.session import Session
from optipmb_service.settings import LimitSettings
from optipmb_service.streams import persistence, queries
from optipmb_service.streams.backlog import Backlog
from optipmb_service.streams.persistence import CheckpointWriter
from optipmb_service.streams.stream import Stream
from optipmb_service.telemetry.health import ProcessHealth
from optipmb_service.telemetry.metrics import Metrics
from optipmb_service.zenoh.topics import Packet
from router import Node, Sensor, until
from sessions import Gated

import optipmb

KEYS = Keys()
CAREFUL = Sensor("site/careful/lidar")
CARELESS = Sensor("site/careless/lidar")
LAST = 2**63 - 1
"""The highest sequence number of a message."""


def test_no_sequence_number_overflows_a_counter(start: Callable[..., Any], tmp_path: Path) -> None:
    """Gaps of 2^63 frames, three times: status, metrics, state and checkpoints of all streams go on."""
    service, endpoint = start(store=str(tmp_path), checkpoint_s=0.05)
    epochs = [bytes([number]) * 16 for number in range(3)]
    with Node(endpoint) as node:
        node.send(CAREFUL.detections(0))
        for number, epoch in enumerate(epochs):
            for place, seq in enumerate((0, LAST)):
                node.send(CARELESS.detections(2 * number + place).model_copy(update={"epoch": epoch, "seq": seq}))
        node.tracks(CARELESS.stream, 6)
        state = node.ask(KEYS.query(CARELESS.stream, "state"), SessionState)
        status = node.ask(KEYS.status("test"), ServiceStatus)
        assert b"optipmb_gaps_total" in node.query(KEYS.metrics("test"))[0][2]
        until(lambda: set(SqliteStore(tmp_path / STORE_FILE).streams()) == {CAREFUL.stream, CARELESS.stream}, "kept")
    assert state.gaps == MAX_COUNT
    assert {one.stream: one.gaps for one in status.sessions} == {CAREFUL.stream: 0, CARELESS.stream: MAX_COUNT}
    assert (status.state, service.state) == ("ready", "ready")


def crowd(seq: int, count: int) -> Detections:
    """Small boxes within a metre, a second after the frame before."""
    rng = np.random.default_rng(seq)
    center = np.c_[rng.uniform(-0.5, 0.5, (count, 2)), np.ones(count)]
    values = {"center": center, "size": np.full((count, 3), 0.05), "stamp_ns": CARELESS.stamp_ns(10 * seq)}
    return CARELESS.detections(seq, objects=count, **values)


def test_a_crowd_in_one_place_costs_its_stream_alone(start: Callable[..., Any]) -> None:
    """Frames of 1,500 boxes within a metre are refused with a problem; the stream goes on, and so do the others."""
    service, endpoint = start()
    with Node(endpoint) as node:
        node.send(CAREFUL.detections(0), CARELESS.detections(0))
        node.tracks(CAREFUL.stream, 1)
        node.tracks(CARELESS.stream, 1)
        for seq in range(1, 6):
            node.send(crowd(seq, 1500), CAREFUL.detections(seq))
        problem = node.problem(CARELESS.stream, "overload")
        tracks = node.tracks(CAREFUL.stream, 6)
        node.send(CARELESS.detections(6, stamp_ns=CARELESS.stamp_ns(60)))
        assert node.tracks(CARELESS.stream, 2)[-1].seq == 6
        state = node.ask(KEYS.query(CARELESS.stream, "state"), SessionState)
    assert (problem.path, "20000 pairs" in problem.expected) == ("center", True)
    assert (state.frames, state.refused) == (2, 5)
    assert [one.seq for one in tracks] == list(range(6))
    assert service.state == "ready"


class Slow:
    def __init__(self, parameters: optipmb.Parameters, busy: list[float]) -> None:
        self._tracker, self._busy = optipmb.Tracker(parameters), busy

    def step(self, density: optipmb.Density, frame: optipmb.Frame) -> optipmb.StepResult:
        ends = time.thread_time() + (self._busy.pop() if self._busy else 0.0)
        while time.thread_time() < ends:
            pass
        return self._tracker.step(density, frame)


def test_a_stream_that_takes_too_long_rests(start: Callable[..., Any]) -> None:
    """A message takes more processor time than one may: the stream's next ones are refused, for a while."""
    busy = [0.3]
    service, endpoint = start(tracker=lambda parameters: Slow(parameters, busy), step_limit_s=0.2)
    with Node(endpoint) as node:
        node.send(CARELESS.detections(0))
        node.tracks(CARELESS.stream, 1)
        until(lambda: [one.state for one in service.status().sessions] == ["degraded"], "the stream rests")
        node.send(CARELESS.detections(1), CAREFUL.detections(0))
        assert "0.2 s of processor time" in node.problem(CARELESS.stream, "overload").expected
        node.tracks(CAREFUL.stream, 1)
        until(lambda: {one.state for one in service.status().sessions} == {"running"}, "the rest ends")
        node.send(CARELESS.detections(2))
        assert [one.seq for one in node.tracks(CARELESS.stream, 2)] == [0, 2]


def test_catching_up_after_a_restart_is_no_overload(start: Callable[..., Any], tmp_path: Path) -> None:
    """A message lets many frames go that were held for it: it takes as long as they, and none is refused for that."""
    busy: list[float] = []
    options = {"store": str(tmp_path), "step_limit_s": 0.2, "recovery_wait_s": 60.0}
    make = {"tracker": lambda parameters: Slow(parameters, busy)}
    service, endpoint = start(**make, **options)
    with Node(endpoint) as node:
        node.send(CARELESS.detections(0))
        node.tracks(CARELESS.stream, 1)
    assert service.stop()
    service, endpoint = start(**make, **options)
    busy += [0.02] * 30
    with Node(endpoint) as node:
        node.send(*(CARELESS.detections(seq) for seq in range(2, 32)))
        until(lambda: [one.queue for one in service.status().sessions] == [30], "the frames are held")
        node.send(CARELESS.detections(1), CARELESS.detections(32))
        assert [one.seq for one in node.tracks(CARELESS.stream, 32)] == list(range(1, 33))


def test_catching_up_from_the_log_keeps_no_other_waiting(
    start: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Missed frames of a stream are tracked in order, before its new ones, and others are tracked in between."""
    missed, newest = 200, 203
    gated = Gated(missed // 10)

    class Log:
        def fetch(self, session: str, checkpoint: object, first: Callable[[list[Packet]], None], later: object) -> None:
            del checkpoint, later
            frames = [CARELESS.detections(seq) for seq in range(missed if session == CARELESS.stream else 0)]
            key, now_ns = KEYS.detections(session), time.monotonic_ns()
            payloads = [encode(one) for one in frames]
            encoding = encoding_of(Detections)
            first([Packet(key, one, len(one), encoding, time.time_ns(), now_ns) for one in payloads])

        def close(self, timeout: float) -> None:
            """Nothing is open."""

    monkeypatch.setattr("optipmb_service.app.service.open_log", lambda _: Log())
    service, endpoint = start(tracker=gated.tracker)
    with Node(endpoint) as node:
        node.send(CAREFUL.detections(0))
        node.tracks(CAREFUL.stream, 1)
        node.send(CARELESS.detections(missed))
        assert gated.entered.wait(60)
        node.send(CAREFUL.detections(1), *(CARELESS.detections(seq) for seq in range(missed + 1, newest)))
        queues = {CAREFUL.stream: 1, CARELESS.stream: 3}  # with the one that began its session
        until(lambda: {one.stream: one.queue for one in service.status().sessions} == queues, "frames wait")
        gated.gate.set()
        assert [one.seq for one in node.tracks(CARELESS.stream, newest)] == list(range(newest))
        node.tracks(CAREFUL.stream, 2)
    second = [index for index, one in enumerate(gated.steps) if one is gated.steps[0]][1]
    assert second < missed // 2


def test_a_tracking_thread_that_is_stuck_is_not_healthy(start: Callable[..., Any]) -> None:
    """A step that does not end is seen from outside: neither alive nor ready, until it ends."""
    gated = Gated()
    service, endpoint = start(tracker=gated.tracker, stuck_s=1.0)
    health = ProcessHealth("test", Metrics())
    health.report(service)
    with Node(endpoint) as node:
        node.send(CARELESS.detections(0))
        until(lambda: not health.alive(), "the thread is seen to be stuck")
        assert not health.ready()
        gated.gate.set()
        node.tracks(CARELESS.stream, 1)
        until(lambda: health.beat() is None and health.alive() and health.ready(), "it works again")


def test_a_checkpoint_that_cannot_be_made_is_its_streams_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """One stream's state does not encode: the others are written, the failure has a name, and ends when it does."""
    broken, encode = {CARELESS.stream}, persistence.encode_checkpoint

    def fragile(checkpoint: Any) -> bytes:
        if checkpoint.stream in broken:
            raise OverflowError("too large")
        return encode(checkpoint)

    monkeypatch.setattr(persistence, "encode_checkpoint", fragile)
    store, reported = SqliteStore(None), []
    leases = Alone(store)
    writer = CheckpointWriter(store, 0.05, leases, lambda stream, why: reported.append((stream, why)))
    parameters = optipmb.load_profile("nuscenes")
    snapshots = [Session(sensor.stream, parameters).snapshot() for sensor in (CARELESS, CAREFUL)]
    gathered = [0]

    def gather() -> None:
        gathered[0] += 1
        for snapshot in snapshots:
            writer.put(replace(snapshot), leases.fence(snapshot.stream))

    writer.start(gather)
    until(lambda: gathered[0] > 3, "rounds")
    assert store.streams() == (CAREFUL.stream,)
    assert writer.failure == f"checkpoint of {CARELESS.stream}: OverflowError: too large"
    assert set(reported) == {(CARELESS.stream, "OverflowError: too large")}
    broken.clear()
    until(lambda: writer.failure == "", "the failure ends")
    assert store.streams() == (CAREFUL.stream, CARELESS.stream)
    writer.close(5)


def test_a_checkpoint_waits_for_a_write_lease_that_lapsed() -> None:
    """A checkpoint put while the lease has lapsed is written when it holds again, and only then confirmed."""
    done = threading.Event()
    store = SqliteStore(None)
    leases = Alone(store)
    leases.lapsed = True
    writer = CheckpointWriter(store, 0.05, leases)
    rounds = [0]

    def gather() -> None:
        rounds[0] += 1

    writer.start(gather)
    session = Session(CAREFUL.stream, optipmb.load_profile("nuscenes"))
    writer.put(session.snapshot(), leases.fence(CAREFUL.stream), done.set)
    until(lambda: rounds[0] > 4, "rounds")
    assert (store.streams(), done.is_set()) == ((), False)
    leases.lapsed = False
    until(done.is_set, "it is written")
    assert store.streams() == (CAREFUL.stream,)
    writer.close(5)


def test_a_stream_goes_on_when_its_lease_holds_again_in_the_middle_of_a_turn(
    start: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A turn that has found the lease lapsed, and is asked for again before it takes messages, leaves none behind."""
    lapses, lapsed = threading.Event(), threading.Event()
    work, paused, take = Stream.work, vars(Stream)["_paused"].fget, Backlog.take

    def lapsed_at_first(self: Stream) -> bool:
        if lapses.is_set() and not self.backlog.empty:
            lapses.clear()
            lapsed.set()
        return work(self)

    def renewed_meanwhile(self: Backlog, *, urgent: bool = False) -> Any:
        if urgent:
            lapsed.clear()
            self.wake()
        return take(self, urgent=urgent)

    # Not `may_write`: a turn that is under way may take the second message, and publishes it without a renewal.
    monkeypatch.setattr(Stream, "_paused", property(lambda self: lapsed.is_set() or paused(self)))
    monkeypatch.setattr(Stream, "work", lapsed_at_first)
    monkeypatch.setattr(Backlog, "take", renewed_meanwhile)
    _, endpoint = start()
    with Node(endpoint) as node:
        node.send(CAREFUL.detections(0))
        node.tracks(CAREFUL.stream, 1)
        lapses.set()
        node.send(CAREFUL.detections(1))
        node.tracks(CAREFUL.stream, 2)


@pytest.mark.parametrize(("query", "frames"), [("state", 1), ("reset", 1)])
def test_a_question_about_the_state_keeps_no_frame_waiting(
    start: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, query: str, frames: int
) -> None:
    """The digest of a state, as a reset answers with it too, is made on a thread of its own: frames are tracked."""
    gate, asked = threading.Event(), threading.Event()
    digest = queries.digest_of

    def slow(checkpoint: Any) -> str:
        asked.set()
        assert gate.wait(20)
        return digest(checkpoint)

    monkeypatch.setattr(queries, "digest_of", slow)
    _, endpoint = start()
    with Node(endpoint) as node, ThreadPoolExecutor(1) as asking:
        node.send(CAREFUL.detections(0))
        node.tracks(CAREFUL.stream, 1)
        answer = asking.submit(node.query, KEYS.query(CAREFUL.stream, query), None, 30.0)
        assert asked.wait(20)
        node.send(CAREFUL.detections(1))
        node.tracks(CAREFUL.stream, 2)
        gate.set()
        assert decode(answer.result(60)[0][2], SessionState).frames == frames  # the state at the question


def test_many_small_values_are_refused_by_their_number() -> None:
    """Half a megabyte of nils is refused where the list begins, not where it ends."""
    payload = b"\x81\xa6labels\xdd" + (500_000).to_bytes(4, "big") + 500_000 * b"\xc0"
    with pytest.raises(MessageError, match="at most 131072 values") as refused:
        decode(payload, Detections, limits=LimitSettings().limits())
    assert refused.value.code == "too_large"


def test_a_full_instance_leaves_alone_what_another_one_tracks(start: Callable[..., Any], tmp_path: Path) -> None:
    """One instance has no room: it neither decodes nor refuses the streams that the other one tracks."""
    full, endpoint = start(instance="a", max_sessions=1, store=str(tmp_path))
    other, _ = start(instance="b", listen=[], connect=[endpoint], store=str(tmp_path))
    members = full._member, other._member
    until(lambda: all(len(one._table.held) == PARTITIONS // 2 for one in members), "each has its share")
    careful, careless = (
        next(
            sensor
            for sensor in (replace(CAREFUL, stream=f"site/node/{number}") for number in range(1000))
            if member.holds(sensor.stream)
        )
        for member in members
    )
    with Node(endpoint) as node:
        node.send(careful.detections(0))
        node.tracks(careful.stream, 1)
        node.send(*(careless.detections(seq) for seq in range(10)))
        node.tracks(careless.stream, 10)
        node.send(careful.detections(1))
        node.tracks(careful.stream, 2)
        assert (full.status().received, full.status().refused) == (2, 0)
        assert [one.stream for one in other.status().sessions] == [careless.stream]


def test_a_stream_is_moved_to_another_instance(start: Callable[..., Any], tmp_path: Path) -> None:
    """It goes on there with the same tracks, none missing; a worker that there is not is refused."""
    one, endpoint = start(instance="a", store=str(tmp_path))
    with Node(endpoint) as node:
        node.send(*(CAREFUL.detections(seq) for seq in range(5)))
        session = node.tracks(CAREFUL.stream, 5)[-1].session
        other, _ = start(instance="b", listen=[], connect=[endpoint], store=str(tmp_path))
        until(lambda: KEYS.alive("b") in node.alive(KEYS.all_alive()), "the other one is there")
        node.move("b", CAREFUL.stream)
        assert (one._member.fence(CAREFUL.stream), other._member.holds(CAREFUL.stream)) == (None, True)
        node.send(*(CAREFUL.detections(seq) for seq in range(5, 10)))
        tracks = node.tracks(CAREFUL.stream, 10)
        assert [(one.seq, one.session) for one in tracks] == [(seq, session) for seq in range(10)]
        assert tracks[-1].delivery is not None
        assert tracks[-1].delivery.instance == "b"
        problem = node.refused(KEYS.move("b"), MoveRequest(stream=CAREFUL.stream, worker=1))
    assert (problem.path, problem.received) == ("worker", "1")


def test_instances_without_a_common_store_are_told_of_each_other(start: Callable[..., Any]) -> None:
    """Both track the stream, as neither knows of the other; a problem says so while it lasts, and what helps."""
    one, endpoint = start(instance="a", lease_s=0.5)
    other, _ = start(instance="b", lease_s=0.5, listen=[], connect=[endpoint])
    with Node(endpoint) as node:
        until(lambda: len(node.alive(KEYS.all_alive())) == 2, "both are there")
        node.send(CAREFUL.detections(0))
        until(lambda: len(node.alive(KEYS.all_owners())) == 2, "both track it")

        def reported() -> bool:
            for service in (one, other):
                service.housekeeping()
            return all("contested" in {one.code for one in service.status().problems} for service in (one, other))

        until(reported, "both report it")
        assert "`cluster`" in node.problem(CAREFUL.stream, "contested").expected


def test_messages_that_wait_are_bounded_in_bytes(start: Callable[..., Any]) -> None:
    """A hundred messages of 1 MB while a step does not end: the queue keeps its bound, the rest is shed."""
    gated = Gated()

    service, endpoint = start(tracker=gated.tracker, stream_mb=16, memory_mb=16)
    queued = service._streams.queued
    with Node(endpoint) as node:
        node.send(CARELESS.detections(0))
        assert gated.entered.wait(20)
        for number in range(100):
            node.send_raw(KEYS.detections(CARELESS.stream), bytes([number]) * 2**20)
        until(lambda: queued.used > 2 * 2**20, "they came")
        node.send(CARELESS.detections(1))
        assert queued.used <= 4 * 2**20
        gated.gate.set()
        node.tracks(CARELESS.stream, 2)
        until(lambda: queued.used == 0, "all is worked off")
    assert service.status().shed > 0


def test_the_first_frames_of_many_new_streams_wait_for_room(
    start: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three times as many streams as may be new at once begin while a step does not end: each is tracked afterwards."""
    gated, most = Gated(), 16
    monkeypatch.setattr("optipmb_service.streams.streams.MAX_UNPROVEN", most)

    service, _ = start(tracker=gated.tracker)
    streams = service._streams
    for sensor in [CARELESS, *(Sensor(f"s{number}/node/lidar") for number in range(3 * most))]:
        now_ns, payload = time.monotonic_ns(), encode(sensor.detections(0))
        key = KEYS.detections(sensor.stream)
        streams.receive(Packet(key, payload, len(payload), encoding_of(Detections), time.time_ns(), now_ns))
        assert gated.entered.wait(60)
    gated.gate.set()
    until(lambda: service.status().frames == 1 + 3 * most, "all are tracked")
    status = service.status()
    assert (status.refused, status.shed, len(streams.tracking())) == (0, 0, 1 + 3 * most)


def test_a_stream_that_opens_keeps_no_other_waiting(
    start: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The store is slow: other streams are tracked meanwhile, and what the new one sent comes after."""
    gate, load = threading.Event(), SqliteStore.load

    def slow(store: SqliteStore, stream: str) -> bytes | None:
        assert stream != CARELESS.stream or gate.wait(20)
        return load(store, stream)

    monkeypatch.setattr(SqliteStore, "load", slow)
    _, endpoint = start(store=str(tmp_path))
    with Node(endpoint) as node:
        node.send(CAREFUL.detections(0))
        node.tracks(CAREFUL.stream, 1)
        node.send(*(CARELESS.detections(seq) for seq in range(3)))
        node.send(CAREFUL.detections(1))
        node.tracks(CAREFUL.stream, 2)
        gate.set()
        assert [one.seq for one in node.tracks(CARELESS.stream, 3)] == [0, 1, 2]
