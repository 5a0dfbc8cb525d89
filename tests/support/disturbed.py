"""A seeded world of sensors, a network that disturbs and a service that crashes, all in one loop without time passing.

`World(seed).run()` lets streams send frames and clouds on a fake clock through a fake transport that delays, reorders,
repeats and garbles them, to sessions that are saved now and then, crash, and are restored from their last whole
checkpoint and the publishers' caches. The same messages go, once and in order, to undisturbed sessions. In the end both
must have the same state and have published the same tracks.
"""

import heapq
import random
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import optipmb_schemas as schemas
from lease_log import Alone
from optipmb_service.cluster.sqlite import SqliteStore
from optipmb_service.cluster.store import load_newest
from optipmb_service.session.checkpoint import CheckpointError, decode_checkpoint, encode_checkpoint, state_bytes
from optipmb_service.session.policy import Policy
from optipmb_service.session.session import Session
from router import SECOND, Sensor
from sessions import Merged, chained

import optipmb

NUSCENES = optipmb.load_profile("nuscenes")
PERIOD_NS = SECOND // 10


@dataclass(frozen=True)
class Trouble:
    """What may happen, as chances per message or, for crashes and checkpoints, per second.

    Attributes:
        late_s: longest delay of a delayed message; inside the window unless a test wants otherwise.
    """

    delayed: float = 0.3
    late_s: float = 0.7
    repeated: float = 0.3
    garbled: float = 0.05
    cloud_lost: float = 0.05
    jump: float = 0.005
    outage: float = 0.005
    restarted: float = 0.003
    crash: float = 0.1
    torn: float = 0.1
    checkpoint: float = 1.0


@dataclass
class Stream:
    """A publisher, and where its messages go."""

    sensor: Sensor
    number: int
    clock_ns: int
    seq: int = 0
    sent: list[schemas.Message] = field(default_factory=list)
    cache: list[tuple[int, schemas.Message]] = field(default_factory=list)


class World:
    """Everything, from one seed.

    Args:
        seed: of all chances.
        streams: sensors.
        seconds: how long they send.
        trouble: what happens.
        tracker: steps the sessions.
    """

    CACHE_NS = 10 * SECOND

    def __init__(
        self,
        seed: int,
        *,
        streams: int = 2,
        seconds: float = 20,
        trouble: Trouble | None = None,
        tracker: Callable[[optipmb.Parameters], Any] = chained,
    ) -> None:
        self.seed = seed
        self.random = random.Random(seed)
        self.trouble = trouble or Trouble()
        # A late cloud corrects, so that clouds that were used in order are used in disorder too.
        self.policy = Policy(rewind_ns=2 * SECOND, rewind_frames=200, late_clouds=True, recovery_wait_ns=SECOND)
        self.tracker = tracker
        self.seconds = seconds
        self.now_ns = 0
        self.store = SqliteStore(None)
        self.leases = Alone(self.store)
        self.streams = [
            Stream(Sensor(stream=f"site/node/s{number}", epoch=self.random.randbytes(16)), number, 10_000 * SECOND)
            for number in range(streams)
        ]
        self.sessions = {one.sensor.stream: self._fresh(one.sensor.stream) for one in self.streams}
        self.undisturbed = {one.sensor.stream: self._fresh(one.sensor.stream) for one in self.streams}
        self.merged = {one.sensor.stream: Merged() for one in self.streams}
        self.expected = {one.sensor.stream: Merged() for one in self.streams}
        self.quiet_ns = dict.fromkeys(self.sessions, 0)
        self.crashes = self.torn = self.messages = self.refused = 0
        self._way: list[tuple[int, int, str, bytes]] = []
        self._ticket = 0

    def run(self) -> None:
        frames = round(self.seconds * SECOND / PERIOD_NS)
        for _ in range(frames):
            for one in self.streams:
                self._send(one)
            self._until(self.now_ns + PERIOD_NS)
            self._service()
        self._until(self.now_ns + 5 * SECOND)
        for stream, session in self.sessions.items():
            self.merged[stream].take([*session.recovered(self.now_ns), *session.flush()], session.run)
        self.store.close()
        self.compare()

    def compare(self) -> None:
        for stream, session in self.sessions.items():
            where = f"seed {self.seed}, stream {stream}"
            other = self.undisturbed[stream]
            assert session.counters.late == 0, f"{where}: {session.counters.late} frames came later than the window"
            ours, theirs = session.counters, other.counters
            assert (ours.frames, ours.gaps) == (theirs.frames, theirs.gaps), f"{where}: {ours} instead of {theirs}"
            assert state_bytes(session.snapshot()) == state_bytes(other.snapshot()), f"{where}: another state"
            assert self.merged[stream].plain() == self.expected[stream].plain(), f"{where}: other tracks"

    # The publishers

    def _send(self, one: Stream) -> None:
        chance, trouble = self.random.random, self.trouble
        one.clock_ns += PERIOD_NS
        if self.now_ns >= self.quiet_ns[one.sensor.stream] and self.now_ns > 3 * SECOND:
            # What cannot be put in order by any window happens only when the dust of the last time has settled.
            event = chance()
            if event < trouble.jump:
                one.clock_ns += self.random.choice([-3600, 3600]) * SECOND
            elif event < trouble.jump + trouble.outage:
                one.clock_ns += self.random.choice([2, 4]) * SECOND
                one.seq += self.random.randrange(3)
            elif event < trouble.jump + trouble.outage + trouble.restarted:
                one.sensor, one.seq = replace(one.sensor, epoch=self.random.randbytes(16)), 0
                one.cache.clear()
            else:
                event = 2.0
            if event < 1.0:
                self._until(self.now_ns + round(2 * trouble.late_s * SECOND))
                self.quiet_ns[one.sensor.stream] = self.now_ns + 4 * SECOND
                self._save()
        stamp = one.clock_ns if chance() > 0.03 else one.clock_ns - PERIOD_NS
        has_points = chance() < 0.3
        frame = one.sensor.detections(one.seq, stamp_ns=max(stamp, 1), has_points=has_points)
        one.seq += 1
        messages: list[schemas.Message] = [frame]
        if has_points and chance() > trouble.cloud_lost:
            xyz = one.sensor.points(stamp // PERIOD_NS % 1000, count=5).xyz
            messages.insert(0, one.sensor.points(stamp // PERIOD_NS, stamp_ns=frame.stamp_ns, xyz=xyz))
        for message in messages:
            self._in_order(one.sensor.stream, message)
            self._put(one, message)

    def _in_order(self, stream: str, message: schemas.Message) -> None:
        session = self.undisturbed[stream]
        outputs = give(session, message, self.now_ns)
        self.expected[stream].take([*outputs, *session.flush()])

    def _put(self, one: Stream, message: schemas.Message) -> None:
        payload = schemas.encode(message)
        one.cache.append((self.now_ns, message))
        while one.cache[0][0] < self.now_ns - self.CACHE_NS:
            del one.cache[0]
        for copy in range(1 + (self.random.random() < self.trouble.repeated)):
            late = copy or self.random.random() < self.trouble.delayed
            delay = round(self.random.uniform(0, self.trouble.late_s) * SECOND) if late else 0
            self._deliver(self.now_ns + delay, one.sensor.stream, payload)
        if self.random.random() < self.trouble.garbled:
            self._deliver(self.now_ns, one.sensor.stream, garbled(payload, self.random))

    # The network

    def _deliver(self, at_ns: int, stream: str, payload: bytes) -> None:
        self._ticket += 1
        heapq.heappush(self._way, (at_ns, self._ticket, stream, payload))

    def _until(self, now_ns: int) -> None:
        while self._way and self._way[0][0] <= now_ns:
            at_ns, _, stream, payload = heapq.heappop(self._way)
            self.now_ns = max(self.now_ns, at_ns)
            self._receive(stream, payload)
        self.now_ns = now_ns
        for stream, session in self.sessions.items():
            self.merged[stream].take(session.on_tick(now_ns), session.run)

    def _receive(self, stream: str, payload: bytes) -> None:
        self.messages += 1
        for kind in (schemas.Detections, schemas.Points):
            try:
                message = schemas.decode(payload, kind)
            except schemas.MessageError:
                continue
            session = self.sessions[stream]
            outputs = [*session.on_tick(self.now_ns), *give(session, message, self.now_ns)]
            self.merged[stream].take(outputs, session.run)
            return
        self.refused += 1

    # The service

    def _service(self) -> None:
        per_period = PERIOD_NS / SECOND
        if self.random.random() < self.trouble.checkpoint * per_period:
            self._save()
        if self.random.random() < self.trouble.crash * per_period:
            self._crash()

    def _save(self) -> None:
        self.leases.save({name: encode_checkpoint(one.snapshot()) for name, one in self.sessions.items()})

    def _crash(self) -> None:
        """All sessions are gone; the checkpoints stay, perhaps the newest torn; the caches give all that they hold."""
        self.crashes += 1
        if self.random.random() < self.trouble.torn:
            self.torn += 1
            self.leases.save(
                {
                    name: (data := encode_checkpoint(one.snapshot()))[: self.random.randrange(len(data))]
                    for name, one in self.sessions.items()
                }
            )
        for one in self.streams:
            stream = one.sensor.stream
            session = load_newest(self.store, stream, self._restored, CheckpointError, lambda _: None)
            self.sessions[stream] = session or self._fresh(stream)
            self.leases.save({stream: encode_checkpoint(self.sessions[stream].snapshot())})
            # Some live frames come before the cached ones, as they do on a network.
            cached = [schemas.encode(message) for _, message in one.cache]
            live = self.random.sample(cached, k=min(3, len(cached)))
            for payload in (*live, *cached):
                self._receive(stream, payload)
            self.merged[stream].take(self.sessions[stream].recovered(self.now_ns), self.sessions[stream].run)

    def _restored(self, data: bytes) -> Session:
        return Session.restore(decode_checkpoint(data), self.now_ns, self.policy, tracker=self.tracker)

    def _fresh(self, stream: str) -> Session:
        return Session(stream, NUSCENES, self.policy, tracker=self.tracker)


def give(session: Session, message: schemas.Message, now_ns: int) -> list[Any]:
    if isinstance(message, schemas.Points):
        return list(session.on_points(message, now_ns))
    assert isinstance(message, schemas.Detections)
    return list(session.on_detections(message, now_ns))


def garbled(payload: bytes, chance: random.Random) -> bytes:
    if chance.random() < 0.5:
        return payload[: chance.randrange(len(payload))]
    return payload.replace(b"stamp_ns", b"stamp_ms")
