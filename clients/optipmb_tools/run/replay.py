"""Sending a data set through the service and collecting the tracks: the same files as offline tracking, byte for byte.

Each sequence becomes a stream `replay/<dataset>-<6 hex>/<sequence>` of its own, new in each run, so that nothing of an
earlier run is in the way. One thread per sequence does everything in turn: publish a frame, receive the tracks that
have come, wait for the time (at a recorded rate) or for room in the window (at full speed) of the next one.

A frame counts as missing when its tracks have not come although a later frame has some, or nothing has come for a long
time.
"""

import collections
import concurrent.futures
import secrets
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

import numpy as np
from optipmb_client.links import Link
from optipmb_client.publisher import Publisher
from optipmb_client.sessions import close_session, set_parameters
from optipmb_client.subscriber import Subscriber
from optipmb_schemas import PREFIX, Problem, SessionParameters, Tracks

from optipmb_tools.datasets import DataSequence, Dataset, DetectionFrame, selected_frames
from optipmb_tools.results.output import Latency, Results, TrackCounts, horizons_for, latency

FrameId: TypeAlias = tuple[bytes, int]  # epoch and sequence number

CLOUD_WAIT_S = 10.0  # a cloud may be late on a busy machine; tracking without it would change the result
CACHED_CLOUDS = 16  # for a service that is killed and restarted meanwhile; it keeps no more of a stream by default
CLOUDS_AHEAD = 4  # frames in flight then: a successor goes back to a checkpoint, and needs the clouds since then, too
STRAGGLERS_S = 5.0  # how long frames that were overtaken by later ones may still be recovered
POINTS_WANTED_S = 20.0  # how long to wait until the service's subscription to clouds has come to this session
TICK_S = 0.2  # how often a waiting thread looks whether it shall stop
KEPT_PROBLEMS = 20


@dataclass(frozen=True)
class ReplayPace:
    """How fast frames are sent, and how long a replay waits; at a `speed` it takes the time between the stamps."""

    speed: float | None = None  # multiple of the recorded rate; None: as fast as tracks come back
    window: int = 8  # frames in flight at most when `speed` is None
    patience_s: float = 30.0  # the replay ends when nothing has come back for so long
    service_s: float = 10.0  # how long to wait for a service to answer at the start


@dataclass(frozen=True)
class Replaying:
    """How sequences are replayed."""

    profile: str  # name that the service knows
    pace: ReplayPace
    classes: Sequence[str] = ()  # only detections of these; empty: all
    streams: int = 1  # sequences at once
    prefix: str = PREFIX  # first part of all keys
    full: bool = False  # whether all columns of the tracks are written too


@dataclass(frozen=True)
class ReplayedSequence:
    """Result of replaying one sequence. `latency` runs from publishing detections to receiving their tracks."""

    name: str
    stream: str
    file: Path
    frames: int
    sent: int
    returned: int
    clouds: int
    clouds_missed: int
    tracks: int  # that are shown in some frame
    seconds: float
    latency: Latency | None
    latencies_ns: tuple[int, ...]
    problems: int
    newest_problems: tuple[Problem, ...]

    @property
    def missing(self) -> int:
        """Frames of the sequence without tracks."""
        return self.frames - self.returned


class Exchange:
    """Frames that were published on one stream, and the tracks that came back, each of which `on_frame` counts."""

    def __init__(
        self, stream: str, link: Link, frames: int, *, pace: ReplayPace, prefix: str, on_frame: Callable[[], None]
    ) -> None:
        self.stop = threading.Event()  # set to end early
        self.results: dict[FrameId, Tracks] = {}  # newest revision
        self.latencies: list[int] = []
        self.problems: collections.deque[Problem] = collections.deque(maxlen=KEPT_PROBLEMS)
        self.problem_count = 0
        self.subscriber = Subscriber(
            stream, connection=link, on_problem=self._note, history=True, queue=4 * frames + 64, prefix=prefix
        )
        self._pace = pace
        self._on_frame = on_frame
        self._sent: dict[FrameId, tuple[int, int]] = {}  # place and time of publishing
        self._awaited = 0  # frames sent whose tracks are expected
        self._newest = 0  # place after the last of them that came back
        self._progress = time.monotonic()  # when something last came back, or was sent with nothing in flight

    @property
    def in_flight(self) -> int:
        """Frames sent after the newest one that came back, as far as their tracks are expected."""
        return self._awaited - self._newest

    @property
    def alive(self) -> bool:
        """Whether to go on: `stop` is not set, and tracks have come back lately or none are in flight."""
        return not self.stop.is_set() and (not self.in_flight or self._silent_s < self._pace.patience_s)

    @property
    def _silent_s(self) -> float:
        return time.monotonic() - self._progress

    def sent(self, frame: FrameId, put_ns: int, *, awaited: bool = True) -> None:
        """Note a published frame, and whether tracks are expected; `put_ns` is the monotonic time of publishing."""
        if not self.in_flight:
            self._progress = time.monotonic()  # patience begins now
        self._awaited += awaited
        self._sent[frame] = self._awaited, put_ns

    def receive(self, timeout: float) -> bool:
        """Take one message of tracks, waiting for it up to `timeout` seconds; False when none came."""
        received = self.subscriber.receive(timeout)
        if received is None:
            return False
        frame = (received.tracks.epoch, received.tracks.seq)
        if frame in self._sent:  # others are not of this run
            place, put_ns = self._sent[frame]
            if frame not in self.results:
                self.latencies.append(received.monotonic_ns - put_ns)
                self._on_frame()
            self.results[frame] = received.tracks  # the subscriber returns newer revisions only
            self._newest = max(self._newest, place)
            self._progress = time.monotonic()
        return True

    def until(self, due: float, most: int | None = None) -> bool:
        """Take tracks until the monotonic time `due`, and while `most` frames are in flight; False to end early."""
        while self.receive(0.0):
            pass
        while (left := due - time.monotonic()) > 0.0:
            if self.stop.is_set():
                return False
            self.receive(min(left, TICK_S))
        return self.alive if most is None else self.until_room(most) and self.alive

    def until_room(self, most: int) -> bool:
        """Take tracks until less than `most` frames are in flight; False to end early."""
        while self.in_flight >= most:
            if not self.alive:
                return False
            self.receive(TICK_S)
        return not self.stop.is_set()

    def drain(self, complete: Callable[[], bool]) -> None:
        """Take tracks until all are there, or no more will come."""
        while not complete() and self.alive:
            if not self.in_flight and self._silent_s > STRAGGLERS_S:
                return
            self.receive(TICK_S)

    def give_up(self) -> None:
        """Count frames in flight as lost."""
        self._newest = self._awaited

    def _note(self, problem: Problem) -> None:
        self.problems.append(problem)
        self.problem_count += problem.count


def replay(
    connection: Link,
    dataset: Dataset,
    sequences: Sequence[DataSequence],
    out: Path,
    how: Replaying,
    on_frame: Callable[[], None] = lambda: None,
) -> list[ReplayedSequence]:
    """Replay sequences, and write the results into `out`, a folder or a table.

    Raises:
        ServiceUnavailable: No service answers.
        ServiceRefused: The service does not know the profile, or takes no more streams.
        UsageError: No such class.
        KeyboardInterrupt: With what is complete in `out`.
    """
    run = f"{dataset.name}-{secrets.token_hex(3)}"
    results = Results(dataset, out, full=how.full)
    stop = threading.Event()

    def write(sequence: DataSequence) -> ReplayedSequence:
        begun = time.monotonic()
        one = _Replay(connection, how, sequence, f"replay/{run}/{sequence.name}", stop)
        one.run(horizons_for(out), on_frame)
        if stop.is_set():
            raise concurrent.futures.CancelledError
        seconds = time.monotonic() - begun
        written = results.write(sequence, one.results)
        results.take(sequence, written)
        return one.result(written if isinstance(written, Path) else out, seconds)

    with concurrent.futures.ThreadPoolExecutor(how.streams, thread_name_prefix="replay") as pool:
        try:
            futures = [pool.submit(write, one) for one in sequences]
            pending = set(futures)
            while pending:
                done, pending = concurrent.futures.wait(pending, TICK_S, concurrent.futures.FIRST_EXCEPTION)
                for future in done:
                    future.result()
        except BaseException as error:  # one sequence failed, or an interrupt: the others close their sessions early
            stop.set()
            pool.shutdown(cancel_futures=True)
            if isinstance(error, KeyboardInterrupt):
                raise KeyboardInterrupt(results.state(sequences)) from None
            raise
    results.close(sequences)
    return [future.result() for future in futures]


@dataclass
class _Replay:
    """One sequence on its way through the service."""

    connection: Link
    how: Replaying
    sequence: DataSequence
    stream: str
    stop: threading.Event
    results: dict[int, Tracks] = field(default_factory=dict)  # newest revision by frame index
    with_cloud: set[int] = field(default_factory=set)
    _index_of: dict[FrameId, int] = field(default_factory=dict)

    def run(self, horizons: Sequence[float] | None, on_frame: Callable[[], None]) -> None:
        """Publish every frame and collect the tracks until all are there, or no more will come."""
        cache = len(self.sequence)  # the service may lose its link, or restart, anywhere in the sequence
        clouds = CACHED_CLOUDS if self.sequence.has_clouds else 0
        prefix, pace = self.how.prefix, self.how.pace
        self.exchange = Exchange(self.stream, self.connection, cache, pace=pace, prefix=prefix, on_frame=on_frame)
        self.exchange.stop = self.stop
        with (
            self.exchange.subscriber,
            Publisher(
                self.stream, connection=self.connection, cache=cache, cache_clouds=clouds, prefix=prefix
            ) as publisher,
        ):
            wanted = SessionParameters(
                profile=self.how.profile,
                cloud_wait_s=CLOUD_WAIT_S,
                horizons=None if horizons is None else np.array(horizons),
            )
            set_parameters(
                self.connection, self.stream, wanted, prefix=prefix, patience_s=pace.service_s, stop=self.stop
            )
            try:
                if self.sequence.has_clouds:
                    await_wanted(lambda: publisher.points_wanted or self.stop.is_set())
                self._publish_all(publisher)
                self.exchange.drain(lambda: len(self.exchange.results) >= len(self._index_of))
            finally:
                close_session(self.connection, self.stream, prefix=prefix)
        self.results = {self._index_of[frame]: tracks for frame, tracks in self.exchange.results.items()}

    def _publish_all(self, publisher: Publisher) -> None:
        pace, exchange = self.how.pace, self.exchange
        zero: float | None = None  # when stamp 0 would have been published; known once the first frame has been read
        for frame in selected_frames(self.sequence, self.how.classes):
            if pace.speed is None:
                ready = exchange.until_room(pace.window)
            else:
                after = frame.stamp_ns / 1e9 / pace.speed
                zero = time.monotonic() - after if zero is None else zero
                # With clouds it waits longer while tracks are late, as when another service takes over.
                ready = exchange.until(zero + after, CLOUDS_AHEAD if self.sequence.has_clouds else None)
            if not ready:
                return
            self._publish(publisher, frame)

    def _publish(self, publisher: Publisher, frame: DetectionFrame) -> None:
        cloud = frame.cloud
        number = publisher.publish(
            stamp_ns=frame.stamp_ns,
            labels=frame.labels,
            **frame.columns,
            pose=frame.pose,
            points=None if cloud is None else cloud.xyz,
            points_pose=None if cloud is None else cloud.pose,
            has_points=cloud is not None,
            field_of_view=frame.field_of_view,
        )
        self.exchange.sent((publisher.epoch, number), publisher.last_put_ns)
        self._index_of[publisher.epoch, number] = frame.index
        if cloud is not None:
            self.with_cloud.add(frame.index)

    def result(self, file: Path, seconds: float) -> ReplayedSequence:
        """Return the result."""
        return ReplayedSequence(
            name=self.sequence.name,
            stream=self.stream,
            file=file,
            frames=len(self.sequence),
            sent=len(self._index_of),
            returned=len(self.results),
            clouds=len(self.with_cloud),
            clouds_missed=sum(not self.results[index].cloud_used for index in self.with_cloud & self.results.keys()),
            tracks=TrackCounts.of(self.results.values()).tracks,
            seconds=seconds,
            latency=latency(self.exchange.latencies),
            latencies_ns=tuple(self.exchange.latencies),
            problems=self.exchange.problem_count,
            newest_problems=tuple(self.exchange.problems),
        )


def await_wanted(wanted: Callable[[], bool]) -> None:
    """Wait until somebody subscribes to clouds; it comes with the network's own messages, nothing tells of it."""
    deadline = time.monotonic() + POINTS_WANTED_S
    while not wanted() and time.monotonic() < deadline:
        time.sleep(0.01)
