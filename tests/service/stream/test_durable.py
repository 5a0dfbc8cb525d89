"""Durability and reports of a service: checkpoints, eviction, limits, the balance of its counters."""

import gc
import os
import resource
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import zenoh.ext
from lease_log import Alone
from optipmb_schemas import Keys, ServiceStatus, SessionState, encode
from optipmb_service.app.storage import STORE_FILE
from optipmb_service.cluster.leases import ALIVE, member_key
from optipmb_service.cluster.sqlite import SqliteStore
from optipmb_service.cluster.store import Fenced, StoreError, Write
from optipmb_service.session.session import Session
from optipmb_service.streams.persistence import CheckpointWriter
from optipmb_service.streams.stream import Stream
from router import Node, Sensor, plain, until
from sessions import Gated

import optipmb

KEYS = Keys()
SENSOR = Sensor()
LONG_STEP_S = 1.0
"""Longer than the grace of these services."""
STREAMS = int(os.environ.get("OPTIPMB_TEST_STREAMS", "100"))


def balance(state: SessionState) -> int:
    """Received frames not accounted for."""
    accounted = state.frames + state.duplicates + state.late + state.refused + state.shed + state.queue
    return state.received - accounted


def test_an_idle_session_is_kept_and_goes_on(start: Callable[..., Any], tmp_path: Path) -> None:
    """Fault 20: freed when idle, restored by the next message: the same session, ids, state and counters."""
    service, endpoint = start(store=str(tmp_path), checkpoint_s=0.05, idle_s=0.3)
    state = KEYS.query(SENSOR.stream, "state")
    with Node(endpoint) as node:
        node.send(*(SENSOR.detections(seq) for seq in range(5)))
        before = node.tracks(SENSOR.stream, 5)[-1]
        digest = node.ask(state, SessionState).digest

        def freed() -> bool:
            service.housekeeping()
            return bool(service.status().sessions == ()) and node.alive(KEYS.all_owners()) == []

        until(freed, "the idle session is freed")
        node.send(SENSOR.detections(4), SENSOR.detections(5))
        after = node.tracks(SENSOR.stream, 6)[-1]
        asked = node.ask(state, SessionState)
    assert (after.seq, after.session, after.gap) == (5, before.session, 0)
    assert set(after.id) == set(before.id)
    assert (asked.received, asked.frames, asked.duplicates) == (7, 6, 1)
    assert digest not in {"", asked.digest}


def test_a_store_that_hangs_keeps_no_end_waiting(start: Callable[..., Any], tmp_path: Path) -> None:
    """The service ends while its store still hangs, and says that nothing was kept."""
    service, endpoint = start(store=str(tmp_path))
    with Node(endpoint) as node:
        node.send(*(SENSOR.detections(seq) for seq in range(5)))
        node.tracks(SENSOR.stream, 5)
        files = service._member._store._leases, service._member._store._checkpoints
        for file in files:
            file._lock.acquire()  # as by a call that does not return
        ended: list[bool] = []
        ending = threading.Thread(target=lambda: ended.append(service.stop(2.0)), daemon=True)
        ending.start()
        ending.join(60.0)
        for file in files:
            file._lock.release()
    assert ended == [False]  # nothing was kept


def test_the_last_checkpoint_waits_for_a_long_step(start: Callable[..., Any], tmp_path: Path) -> None:
    """A step that ends after the grace, while there is time for the checkpoint, is in it."""
    gated = Gated(first=5)
    service, endpoint = start(tracker=gated.tracker, store=str(tmp_path))
    with Node(endpoint) as node:
        node.send(*(SENSOR.detections(seq) for seq in range(5)))
        session = node.tracks(SENSOR.stream, 4)[-1].session
        assert gated.entered.wait(60)
        threading.Timer(LONG_STEP_S, gated.gate.set).start()
        assert service.stop()
    _, endpoint = start(store=str(tmp_path))
    with Node(endpoint) as node:
        node.send(SENSOR.detections(5))
        node.tracks(SENSOR.stream, 1)
        asked = node.ask(KEYS.query(SENSOR.stream, "state"), SessionState)
    assert (asked.session, asked.frames) == (session, 6)


def test_a_closed_stream_that_moves_stays_closed(start: Callable[..., Any], tmp_path: Path) -> None:
    """The next owner has no session of it until its next frame, which then gets ids that were never used before."""
    service, endpoint = start(store=str(tmp_path))
    with Node(endpoint) as node:
        node.send(*(SENSOR.detections(seq) for seq in range(5)))
        before = node.tracks(SENSOR.stream, 5)[-1]
        assert node.ask(KEYS.query(SENSOR.stream, "reset"), SessionState, b'{"close": true}').state == "closed"
        until(lambda: not service._streams.waits(SENSOR.stream), "its state is kept")
        service._streams.hold(SENSOR.stream)
        service._streams.take_up(SENSOR.stream, [])
        until(lambda: not service._streams.waits(SENSOR.stream), "it is taken up, and no session is there")
        node.send(*(SENSOR.detections(seq) for seq in range(5, 10)))
        after = node.tracks(SENSOR.stream, 10)[-1]
    assert after.seq == 9
    assert not set(after.id) & set(before.id)


def test_numbers_outlive_an_expired_checkpoint(start: Callable[..., Any], tmp_path: Path) -> None:
    """After longer than `keep_days` the session is a new one, its track ids and runs go on, and so once more."""
    ids: list[set[int]] = []
    runs, sessions = [0], set()
    for expired in range(3):
        service, endpoint = start(store=str(tmp_path))
        with Node(endpoint) as node:
            node.send(*(SENSOR.detections(seq) for seq in range(5)))
            tracks = node.tracks(SENSOR.stream, 5)
        assert service.stop()
        ids.append({int(one) for message in tracks for one in message.id})
        assert min(ids[-1]) > max([0, *(one for known in ids[:-1] for one in known)])
        assert tracks[0].delivery is not None
        runs.append(tracks[0].delivery.run)
        sessions.add(tracks[0].session)
        store = SqliteStore(tmp_path / STORE_FILE, lambda: time.time() + 40 * 86_400)
        assert (store.expire(30 * 86_400), store.expire(30 * 86_400)) == (1, 0), expired
        store.close()
    assert runs == sorted(set(runs))
    assert len(sessions) == 3


def test_nothing_expires_at_a_start(start: Callable[..., Any], tmp_path: Path) -> None:
    """A service that was off for long, or whose clock is wrong, has its sessions: only later does it forget any."""
    other, settings = (
        Sensor(stream="site/node/other"),
        {"store": str(tmp_path), "checkpoint_s": 0.05, "keep_days": 1e-9},
    )
    service, endpoint = start(**settings)
    with Node(endpoint) as node:
        node.send(*(SENSOR.detections(seq) for seq in range(5)))
        before = node.tracks(SENSOR.stream, 5)
    assert service.stop()
    service, endpoint = start(**settings)
    store = SqliteStore(tmp_path / STORE_FILE)
    with Node(endpoint) as node:
        node.send(other.detections(0))
        until(lambda: store.load(other.stream) is not None, "a round that might have expired others")
        node.send(SENSOR.detections(5))
        after = node.tracks(SENSOR.stream, 1)
    assert {one.session for one in after} == {before[0].session}
    store.close()


def test_what_no_cache_holds_is_not_waited_for(start: Callable[..., Any], tmp_path: Path) -> None:
    """Fault 1: after a restart frames wait for those missing until the caches have answered, and no longer."""
    options = {"store": str(tmp_path), "recovery_wait_s": 60.0}
    service, endpoint = start(**options)
    with Node(endpoint) as node:
        publisher = zenoh.ext.declare_advanced_publisher(
            node.session,
            KEYS.detections(SENSOR.stream),
            cache=zenoh.ext.CacheConfig(3),
            sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=0.1, sporadic_heartbeat=None),
            publisher_detection=True,
        )
        for seq in range(5):
            publisher.put(encode(SENSOR.detections(seq)))
            node.tracks(SENSOR.stream, seq + 1)
        assert service.stop()
        for seq in range(5, 15):
            publisher.put(encode(SENSOR.detections(seq)))
        start(listen=[endpoint], **options)
        found = node.tracks(SENSOR.stream, 8)
        assert [(tracks.seq, tracks.gap) for tracks in found[5:]] == [(12, 7), (13, 0), (14, 0)]
        del publisher  # withdraws it; to undeclare it may stop the process for ten seconds


def test_a_torn_checkpoint_is_set_aside(start: Callable[..., Any], tmp_path: Path) -> None:
    """Fault 2: the newest checkpoint is damaged: the one before it is used, the damaged one is kept for inspection."""
    service, endpoint = start(store=str(tmp_path), checkpoint_s=0.05)
    state = KEYS.query(SENSOR.stream, "state")
    store = SqliteStore(tmp_path / STORE_FILE)
    with Node(endpoint) as node:
        for seq in range(10):
            node.send(SENSOR.detections(seq))
            node.tracks(SENSOR.stream, seq + 1)
            kept = store.load(SENSOR.stream)
            until(lambda kept=kept: store.load(SENSOR.stream) != kept, "a checkpoint of the frame")  # type: ignore[misc]  # bound now
        before = node.ask(state, SessionState)
    assert service.stop()
    whole = store.load(SENSOR.stream)
    assert whole is not None
    leases = Alone(store)
    leases.save({SENSOR.stream: whole[: len(whole) // 2]})
    leases.leave()
    _, endpoint = start(store=str(tmp_path))
    with Node(endpoint) as node:
        node.send(*(SENSOR.detections(seq) for seq in range(10)))
        until(lambda: node.ask(state, SessionState).frames == 10, "all frames are tracked")
        after = node.ask(state, SessionState)
    assert (after.digest, after.gaps) == (before.digest, 0)
    assert [(stream, data) for stream, _, data in store.aside()] == [(SENSOR.stream, whole[: len(whole) // 2])]
    store.close()


def test_a_store_that_cannot_be_opened_degrades(start: Callable[..., Any], tmp_path: Path) -> None:
    """Fault 19: no folder to write to: the service tracks all the same, and says that it keeps nothing."""
    (tmp_path / "file").write_text("")
    _, endpoint = start(store=str(tmp_path / "file" / "folder"))
    with Node(endpoint) as node:
        node.send(SENSOR.detections(0))
        node.tracks(SENSOR.stream, 1)
        assert node.ask(KEYS.status("test"), ServiceStatus).state == "degraded"


def test_a_store_that_others_use_is_no_reason_for_one_of_its_own(start: Callable[..., Any], tmp_path: Path) -> None:
    """While a member lives on a store, who cannot open it does not start: its streams would have two owners."""
    other = SqliteStore(tmp_path / STORE_FILE)
    assert other.put(Write(member_key("other/1"), ALIVE, 0))
    for path in tmp_path.glob(f"{STORE_FILE}*"):
        path.unlink()
    (tmp_path / STORE_FILE).write_text("no database, and longer than the hundred bytes that are the head of one" * 2)
    with pytest.raises(StoreError, match="not a database"):
        start(store=str(tmp_path))
    other.close()
    start(store=str(tmp_path))


def test_the_wall_clock_may_jump(start: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Fault 8: the wall clock jumps by hours, ahead and back, while every frame waits for its cloud: the same bytes."""

    def tracks(endpoint: str, jump: Callable[[int], None]) -> list[bytes]:
        with Node(endpoint) as node:
            for seq in range(20):
                node.send(SENSOR.detections(seq, has_points=True))
                jump(seq)
                node.send(SENSOR.points(seq))
                received = node.tracks(SENSOR.stream, seq + 1)
            return [plain(message) for message in received]

    expected = tracks(start(store=str(tmp_path / "a"), cloud_wait_s=60.0)[1], lambda _: None)
    true_ns = time.time_ns

    def jump(seq: int) -> None:
        monkeypatch.setattr(time, "time_ns", lambda: true_ns() + (-1) ** seq * seq * 3600 * 10**9)

    assert tracks(start(store=str(tmp_path / "b"), cloud_wait_s=60.0)[1], jump) == expected


def test_nothing_is_published_while_the_write_lease_has_lapsed(
    start: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Fault 17: who was away long enough for another to take over publishes only when it has renewed its lease."""
    put, may_put = SqliteStore.put, threading.Event()
    may_put.set()

    def late(store: SqliteStore, write: Write) -> int | None:
        assert may_put.wait(60.0)
        return put(store, write)

    monkeypatch.setattr(SqliteStore, "put", late)
    service, endpoint = start(store=str(tmp_path))
    with Node(endpoint) as node:
        node.send(SENSOR.detections(0))
        node.tracks(SENSOR.stream, 1)
        may_put.clear()
        until(lambda: service.state == "paused", "the write lease lapses")
        node.send(*(SENSOR.detections(seq) for seq in range(1, 4)))
        until(lambda: service.status().sessions[0].queue == 3, "the frames wait")
        assert len(node.tracks_seen.items) == 1
        may_put.set()
        assert [tracks.seq for tracks in node.tracks(SENSOR.stream, 4)] == [0, 1, 2, 3]


def test_what_a_checkpoint_contains_has_had_time_to_leave() -> None:
    """Fault 1: a kill between the writing of a checkpoint and the sending of its tracks would swallow them.

    So a checkpoint is written a quarter of a second after it was taken.
    """
    session = Session(SENSOR.stream, optipmb.load_profile("nuscenes"))
    taken: list[float] = []
    written: list[float] = []

    class Watched(SqliteStore):
        def save(self, checkpoints: Mapping[str, Fenced]) -> frozenset[str]:
            written.append(time.monotonic())
            return super().save(checkpoints)

    def gather() -> None:
        taken.append(time.monotonic())
        persistence.put(session.snapshot(), leases.fence(SENSOR.stream))

    store = Watched(None)
    leases = Alone(store)
    persistence = CheckpointWriter(store, 0.05, leases)
    persistence.start(gather)
    until(lambda: len(written) >= 2, "two checkpoints are written")
    delays = [at - before for before, at in zip(taken, written, strict=False)]
    persistence.close(1.0)
    assert min(delays) >= 0.25


def test_overload_costs_the_stream_that_is_overloaded(start: Callable[..., Any]) -> None:
    """Fault 14: more than its tracker can do: that stream sheds, another is served in time, every frame counts.

    Received is the sum of frames, duplicates, late, refused, shed and queue, at every moment and for both streams.
    """
    slow, sent = 7, 300

    class Slow(optipmb.Tracker):
        def step(self, density: optipmb.Density, frame: optipmb.Frame) -> optipmb.StepResult:
            if len(frame.score) == slow:
                threading.Event().wait(0.02)
            return super().step(density, frame)

    heavy = replace(SENSOR, stream="site/node/heavy", objects=slow)
    service, endpoint = start(tracker=Slow, queue_frames=8)
    with Node(endpoint) as node:
        state = KEYS.query(heavy.stream, "state")
        node.send(heavy.detections(0), SENSOR.detections(0))
        node.tracks(heavy.stream, 1)
        for seq in range(1, sent):  # ten at a time, in which one or two are tracked
            node.send(heavy.detections(seq))
            if seq % 10 == 0:
                node.send(SENSOR.detections(seq // 10))
                asked = node.ask(state, SessionState)
                assert (balance(asked), asked.queue <= 9) == (0, True)
        until(lambda: node.ask(state, SessionState).received == sent, "all frames are received")
        until(lambda: node.ask(state, SessionState).queue == 0, "the queue is empty")
        asked = node.ask(state, SessionState)
        other = node.ask(KEYS.query(SENSOR.stream, "state"), SessionState)
        status = service.status()
    assert (balance(asked), balance(other)) == (0, 0)
    assert asked.shed > sent // 4
    assert (other.received, other.frames, other.shed) == (30, 30, 0)
    assert status.received == status.frames + status.duplicates + status.late + status.refused + status.shed
    assert status.received == sent + 30


def parts_of(prefixes: tuple[str, ...]) -> list[Stream | Session]:
    """Streams and sessions, with these prefixes, that something still holds."""
    parts = [one for one in gc.get_objects() if type(one) in {Stream, Session}]
    return [one for one in parts if (one.name if isinstance(one, Stream) else one.stream).startswith(prefixes)]


def test_many_streams_come_and_go(start: Callable[..., Any], tmp_path: Path) -> None:
    """Fault 20: many streams with one frame each: all are freed again, their memory too; the store has them all."""
    service, endpoint = start(store=str(tmp_path), idle_s=0.5, max_sessions=STREAMS, checkpoint_s=0.2)

    def wave(name: str) -> None:
        sensors = [replace(SENSOR, stream=f"{name}/node-{number}/lidar") for number in range(STREAMS)]
        with Node(endpoint) as node:
            for sensor in sensors:
                node.send(sensor.detections(0))
            until(lambda: len({key for key, _, _ in node.tracks_seen.items}) == STREAMS, "all are tracked", 60.0)

        def freed() -> bool:
            service.housekeeping()
            return bool(service.status().sessions == ())

        until(freed, "all are freed", 60.0)

    wave("first")
    gc.collect()
    before = _memory_kb()
    for number in range(3):
        wave(f"wave{number}")
    gc.collect()
    grown = _memory_kb() - before

    def all_gone() -> bool:
        service.housekeeping()
        return len(parts_of(("first", "wave"))) <= 1  # the thread that tracks holds the stream that it ran last

    until(all_gone, "no part of them is left", 20.0)
    # Of a closed session 300 bytes are remembered here, and about 5 kB in Zenoh, which forgets no key that a client has
    # declared; so are rates of nodes and sites, up to a bound. Allocators hold back 4 to 10 MB on top.
    assert grown < 150 * STREAMS + 1000, f"{grown} kB more after {3 * STREAMS} streams"
    store = SqliteStore(tmp_path / STORE_FILE)
    until(lambda: len(store.streams()) == 4 * STREAMS, "the store has all of them")
    store.close()


def test_beyond_the_limit_a_stream_is_refused(start: Callable[..., Any]) -> None:
    """Fault 20: one stream too many gets a problem that says so; tracked streams do not notice."""
    _, endpoint = start(max_sessions=2)
    sensors = [replace(SENSOR, stream=f"site/node/{number}") for number in range(3)]
    with Node(endpoint) as node:
        for sensor in sensors:
            node.send(sensor.detections(0))
            if sensor is not sensors[2]:
                node.tracks(sensor.stream, 1)
        assert "no more sessions" in node.problem(sensors[2].stream, "refused").message
        for sensor in sensors[:2]:
            node.send(sensor.detections(1))
            assert node.tracks(sensor.stream, 2)[1].gap == 0


def _memory_kb() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * (resource.getpagesize() // 1024)
