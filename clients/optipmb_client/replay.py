"""Sending a dataset through the service and collecting the tracks: the same files as offline tracking, byte for byte.

Each sequence becomes a stream `replay/<dataset>-<6 hex>/<sequence>` of its own, new in each run, so that nothing of an
earlier run is in the way. One thread per sequence does everything in turn: publish a frame, take in the tracks that
have come, wait for the time (at a recorded rate) or for room in the window (at full speed) of the next one.

A frame counts as missing when its tracks have not come although those of a later frame have, or although nothing has
come for a long time.
"""

import collections
import concurrent.futures
import secrets
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from optipmb_schemas import PREFIX, Problem, SessionParameters, Tracks

from optipmb_client.datasets import DataSequence, Dataset, DetectionFrame
from optipmb_client.datasets.interface import DETECTION_COLUMNS
from optipmb_client.links import Link
from optipmb_client.publisher import Publisher
from optipmb_client.recording import Latency, Results, horizons_for, latency, selected_frames
from optipmb_client.sessions import close_session, set_parameters
from optipmb_client.subscriber import Subscriber

CLOUD_WAIT_S = 10.0  # a cloud may be late on a busy machine; tracking without it would change the result
CACHED_CLOUDS = 16  # for a service that is killed and restarted meanwhile; it keeps no more of a stream by default
CLOUDS_AHEAD = 4  # frames under way then: a successor goes back to a checkpoint, and needs the clouds since then, too
STRAGGLERS_S = 5.0  # how long frames that were overtaken by later ones may still be recovered
POINTS_WANTED_S = 20.0  # how long to wait until the service's subscription to clouds has come to this session
TICK_S = 0.2  # how often a waiting thread looks whether it shall stop
KEPT_PROBLEMS = 20


@dataclass(frozen=True)
class Pace:
    """How fast frames are sent.

    Attributes:
        speed: Multiple of the recorded rate; None: as fast as tracks come back.
        window: Frames under way at most when `speed` is None.
        patience_s: The replay ends when nothing has come back for so long.
        service_s: How long to wait for a service to answer at the start.
    """

    speed: float | None = None
    window: int = 8
    patience_s: float = 30.0
    service_s: float = 10.0


@dataclass(frozen=True)
class ReplayedSequence:
    """What replaying one sequence gave. `latency` runs from publishing detections to receiving their tracks."""

    name: str
    stream: str
    file: Path
    frames: int
    sent: int
    returned: int
    clouds: int
    clouds_missed: int
    tracks: int
    seconds: float
    latency: Latency | None
    latencies_ns: tuple[int, ...]
    problems: int
    newest_problems: tuple[Problem, ...]

    @property
    def missing(self) -> int:
        """Frames of the sequence without tracks."""
        return self.frames - self.returned


def replay(  # noqa: PLR0913  one argument per decision of the caller
    connection: Link,
    dataset: Dataset,
    sequences: Sequence[DataSequence],
    out: Path,
    *,
    profile: str,
    pace: Pace,
    classes: Sequence[str] = (),
    streams: int = 1,
    prefix: str = PREFIX,
    full: bool = False,
    on_frame: Callable[[], None] = lambda: None,
) -> list[ReplayedSequence]:
    """Replay sequences, `streams` of them at once, and write the results into `out`, a folder or a table.

    With `full`, all that is known of the tracks is written too, beside each result file.

    Raises:
        ServiceUnavailable: No service answers.
        ServiceRefused: The service does not know the profile, or takes no more streams.
        UsageError: No such class.
    """
    run = f"{dataset.name}-{secrets.token_hex(3)}"
    results = Results(dataset, out, full=full)
    task = _Task(connection, out, results, profile, horizons_for(out), pace, classes, prefix, on_frame)
    work = [_Replay(task, sequence, f"replay/{run}/{sequence.name}") for sequence in sequences]
    with concurrent.futures.ThreadPoolExecutor(max_workers=streams, thread_name_prefix="replay") as pool:
        try:
            futures = [pool.submit(_replay_and_write, one) for one in work]
            pending = set(futures)
            while pending:
                done, pending = concurrent.futures.wait(pending, TICK_S, concurrent.futures.FIRST_EXCEPTION)
                for future in done:
                    future.result()
        except BaseException:  # one sequence failed, or an interrupt: the others end early and close their sessions
            task.stop.set()
            pool.shutdown(cancel_futures=True)
            raise
    results.close(sequences)
    return [future.result() for future in futures]


def _replay_and_write(one: "_Replay") -> ReplayedSequence:
    begun = time.monotonic()
    one.run()
    if one.task.stop.is_set():
        raise concurrent.futures.CancelledError
    seconds = time.monotonic() - begun
    written = one.task.results.write(one.sequence, one.results)
    one.task.results.take(one.sequence, written)
    return ReplayedSequence(
        name=one.sequence.name,
        stream=one.stream,
        file=written if isinstance(written, Path) else one.task.out,
        frames=len(one.sequence),
        sent=one.sent,
        returned=len(one.results),
        clouds=len(one.with_cloud),
        clouds_missed=sum(not one.results[index].cloud_used for index in one.with_cloud if index in one.results),
        tracks=len({int(number) for tracks in one.results.values() for number in tracks.id}),
        seconds=seconds,
        latency=latency(one.latencies),
        latencies_ns=tuple(one.latencies),
        problems=one.problem_count,
        newest_problems=tuple(one.problems),
    )


@dataclass(frozen=True)
class _Task:
    """What the sequences of one replay share."""

    connection: Link
    out: Path
    results: Results
    profile: str
    horizons: Sequence[float] | None
    pace: Pace
    classes: Sequence[str]
    prefix: str
    on_frame: Callable[[], None]
    stop: threading.Event = field(default_factory=threading.Event)


class _Replay:
    """One sequence on its way through the service."""

    def __init__(self, task: _Task, sequence: DataSequence, stream: str) -> None:
        self.task = task
        self.sequence = sequence
        self.stream = stream
        self.results: dict[int, Tracks] = {}  # newest revision by frame index
        self.with_cloud: set[int] = set()
        self.latencies: list[int] = []
        self.problems: collections.deque[Problem] = collections.deque(maxlen=KEPT_PROBLEMS)
        self.problem_count = 0
        self.sent = 0
        self._index_of: dict[int, int] = {}  # frame index by sequence number
        self._put_ns: dict[int, int] = {}  # time of publishing by sequence number
        self._epoch = b""
        self._newest = -1  # highest sequence number that came back
        self._progress = time.monotonic()  # when something last came back

    def run(self) -> None:
        """Publish every frame and collect the tracks until all are there, or no more will come."""
        cache = len(self.sequence)  # the service may lose its link, or restart, anywhere in the sequence
        with (
            Subscriber(
                self.stream,
                connection=self.task.connection,
                on_problem=self._note,
                queue=4 * cache + 64,
                prefix=self.task.prefix,
            ) as tracks,
            Publisher(
                self.stream,
                connection=self.task.connection,
                cache=cache,
                cache_clouds=CACHED_CLOUDS if self.sequence.has_clouds else 0,
                prefix=self.task.prefix,
            ) as publisher,
        ):
            self._epoch = publisher.epoch
            horizons = None if self.task.horizons is None else np.array(self.task.horizons)
            wanted = SessionParameters(profile=self.task.profile, cloud_wait_s=CLOUD_WAIT_S, horizons=horizons)
            set_parameters(
                self.task.connection, self.stream, wanted, prefix=self.task.prefix, patience_s=self.task.pace.service_s
            )
            try:
                self._await_points_subscription(publisher)
                self._publish_all(publisher, tracks)
                self._drain(tracks)
            finally:
                close_session(self.task.connection, self.stream, prefix=self.task.prefix)

    def _publish_all(self, publisher: Publisher, tracks: Subscriber) -> None:
        speed = self.task.pace.speed
        zero: float | None = None  # when stamp 0 would have been published; known once the first frame has been read
        for frame in selected_frames(self.sequence, self.task.classes):
            if speed is None:
                ready = self._until_room(tracks)
            else:
                after = frame.stamp_ns / 1e9 / speed
                zero = time.monotonic() - after if zero is None else zero
                ready = self._until(zero + after, tracks)
            if not ready:
                return
            self._publish(publisher, frame)

    def _publish(self, publisher: Publisher, frame: DetectionFrame) -> None:
        cloud = frame.cloud
        number = publisher.publish(
            stamp_ns=frame.stamp_ns,
            labels=frame.labels,
            **{name: getattr(frame, name) for name in DETECTION_COLUMNS},
            pose=frame.pose,
            points=None if cloud is None else cloud.xyz,
            points_pose=None if cloud is None else (cloud.translation, cloud.quaternion),
            has_points=cloud is not None,
            field_of_view=frame.field_of_view,
        )
        if self._newest == self.sent - 1:
            self._progress = time.monotonic()  # nothing was under way: patience begins now
        self._index_of[number] = frame.index
        self._put_ns[number] = publisher.last_put_ns
        if cloud is not None:
            self.with_cloud.add(frame.index)
        self.sent += 1

    def _until(self, due: float, tracks: Subscriber) -> bool:
        """Take in tracks until the monotonic time `due`; False when the replay shall end.

        With clouds it waits longer while tracks are late, as when another service takes over.
        """
        while self._take(tracks, 0.0):
            pass
        while (left := due - time.monotonic()) > 0.0:
            if self.task.stop.is_set():
                return False
            self._take(tracks, min(left, TICK_S))
        while self.sequence.has_clouds and self._under_way >= CLOUDS_AHEAD:
            if not self._alive():
                return False
            self._take(tracks, TICK_S)
        return self._alive()

    @property
    def _under_way(self) -> int:
        """Frames sent after the newest one that came back."""
        return self.sent - 1 - self._newest

    @property
    def _silent_s(self) -> float:
        """Time since something last came back."""
        return time.monotonic() - self._progress

    def _until_room(self, tracks: Subscriber) -> bool:
        """Take in tracks until less than a window of frames is under way; False when the replay shall end."""
        while self._under_way >= self.task.pace.window:
            if not self._alive():
                return False
            self._take(tracks, TICK_S)
        return not self.task.stop.is_set()

    def _drain(self, tracks: Subscriber) -> None:
        """Take in tracks until every frame sent has come back, or no more will come."""
        while len(self.results) < self.sent and self._alive():
            overtaken = self._newest == self.sent - 1
            if overtaken and self._silent_s > STRAGGLERS_S:
                return
            self._take(tracks, TICK_S)

    def _alive(self) -> bool:
        """Whether to go on: nobody has asked to stop, and tracks have come back lately or none are under way."""
        if self._newest == self.sent - 1:
            return not self.task.stop.is_set()
        return not self.task.stop.is_set() and self._silent_s < self.task.pace.patience_s

    def _take(self, tracks: Subscriber, timeout: float) -> bool:
        """Take in one tracks message, waiting for it up to `timeout` seconds; False when none came."""
        received = tracks.receive(timeout)
        if received is None:
            return False
        number = received.tracks.seq
        index = self._index_of.get(number)
        if index is None or received.tracks.epoch != self._epoch:
            return True  # not of this replay
        if index not in self.results:
            self.latencies.append(received.monotonic_ns - self._put_ns[number])
            self.task.on_frame()
        self.results[index] = received.tracks  # the subscriber gives out newer revisions only
        self._newest = max(self._newest, number)
        self._progress = time.monotonic()
        return True

    def _await_points_subscription(self, publisher: Publisher) -> None:
        if not self.sequence.has_clouds:
            return
        deadline = time.monotonic() + POINTS_WANTED_S
        while not publisher.points_wanted and time.monotonic() < deadline:
            time.sleep(0.01)  # it comes with the network's own messages; there is nothing to wait on

    def _note(self, problem: Problem) -> None:
        self.problems.append(problem)
        self.problem_count += problem.count
