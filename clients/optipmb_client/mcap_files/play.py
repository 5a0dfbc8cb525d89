"""Playing a recording into a service: the same messages, epochs, numbers and stamps; the tracks come out the same.

One thread publishes the frames of all streams in the order in which they were received, at the recorded pace or as fast
as tracks come back, and takes in the tracks. They are compared with the recorded ones.
"""

import collections
import contextlib
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final, Self

from optipmb_schemas import PREFIX, Keys, Problem, SessionParameters, Tracks

from optipmb_client.errors import UsageError
from optipmb_client.mcap_files.plan import FrameId, Step, StreamPlan, content, plan, renamed, steps
from optipmb_client.mcap_files.reading import Recorded, RecordingFile
from optipmb_client.recording import Latency, latency
from optipmb_client.replay import CLOUD_WAIT_S, KEPT_PROBLEMS, POINTS_WANTED_S, STRAGGLERS_S, TICK_S, Pace
from optipmb_client.sessions import close_session, session_state, set_parameters
from optipmb_client.subscriber import Subscriber
from optipmb_client.zenoh import Connection
from optipmb_client.zenoh.sender import Sender

NO_PROFILE: Final = "--profile: expected a profile, for the recording does not say which was in force on {}"


@dataclass(frozen=True)
class PlayedStream:
    """What playing one stream gave.

    Attributes:
        name: The stream in the recording.
        stream: The stream that it was played as.
        profile: Parameters in force.
        other_values: Whether the profile has other values than when it was recorded; None: the recording does not tell.
        frames: Frames of the recording.
        returned: Frames whose tracks came back.
        clouds: Frames that were played with a cloud.
        clouds_lost: Frames whose recorded tracks were made with a cloud that the recording lacks.
        recorded: Frames whose tracks are in the recording.
        equal: Those of them whose tracks came back with the same bytes, but for session, delivery and stream's name.
        first_difference: Number of the first of them whose tracks did not; None: there is none.
        begins_late: Whether the recording begins in the middle of a session.
        never_tracked: Frames without recorded tracks between others that have some.
        first_id: Where track ids began: above 1 the service had tracked a stream of this name before.
        tracks: Newest tracks by frame.
        latency: From publishing to receiving.
        problems: How many problems were reported.
        newest_problems: The last of them.
    """

    name: str
    stream: str
    profile: str
    other_values: bool | None
    frames: int
    returned: int
    clouds: int
    clouds_lost: int
    recorded: int
    equal: int
    first_difference: int | None
    begins_late: bool
    never_tracked: int
    first_id: int
    tracks: dict[FrameId, Tracks]
    latency: Latency | None
    problems: int
    newest_problems: tuple[Problem, ...]


def choose(recording: Iterable[Recorded], streams: Iterable[str] = ()) -> dict[str, StreamPlan]:
    """Return what a recording holds of the chosen streams; of all when none is named.

    Raises:
        UsageError: It does not hold one of them, or nothing at all.
    """
    plans = plan(recording)
    for name in streams:
        if name not in plans:
            raise UsageError(f"--streams: the recording has no detections of {name!r}, but of {', '.join(plans)}")
    if not plans:
        raise UsageError("the recording holds no detections")
    return {name: plans[name] for name in (tuple(streams) or plans)}


def play(
    connection: Connection,
    recording: RecordingFile,
    plans: dict[str, StreamPlan],
    *,
    pace: Pace,
    site: str | None,
    profile: str | None = None,
    prefix: str = PREFIX,
    on_frame: Callable[[], None] = lambda: None,
) -> list[PlayedStream]:
    """Play the streams of `plans`.

    Args:
        connection: To the service or its router.
        recording: The messages.
        plans: What `choose` gave of it.
        pace: How fast.
        site: Streams are played as `<site>-<their site>/...`, so that they meet no session; None: as recorded.
        profile: Parameters; default: what was in force when it was recorded.
        prefix: First part of all keys.
        on_frame: Called when the tracks of a frame have come back.

    Raises:
        ServiceUnavailable: No service answers.
        ServiceRefused: It does not know the profile, or takes no more streams.
        UsageError: The recording does not say which profile was in force, and none is given.
    """
    with contextlib.ExitStack() as stack:
        players = {
            name: stack.enter_context(_Player(connection, one, pace, site, profile, prefix, on_frame))
            for name, one in plans.items()
        }
        zero: float | None = None
        for step in steps(recording, plans):
            player = players[step.detections.stream]
            if pace.speed is not None:
                after = step.detections.received_ns / 1e9 / pace.speed
                zero = time.monotonic() - after if zero is None else zero
                player.take_until(zero + after)
            else:
                player.take_until_room()
            player.send(step)
        for player in players.values():
            player.drain()
        return [player.result() for player in players.values()]


class _Player:
    """One stream on its way through the service."""

    def __init__(
        self,
        connection: Connection,
        one: StreamPlan,
        pace: Pace,
        site: str | None,
        profile: str | None,
        prefix: str,
        on_frame: Callable[[], None],
    ) -> None:
        recorded = one.parameters.profile if one.parameters else None
        newest = next((tracks.profile for tracks in one.tracks.values()), None)
        self._profile = profile or recorded or newest or ""
        if not self._profile:
            raise UsageError(NO_PROFILE.format(one.stream))
        self._plan = one
        self._pace = pace
        self._connection = connection
        self._prefix = prefix
        self._keys = Keys(prefix)
        self._stream = one.stream if site is None else f"{site}-{one.stream}"
        self._on_frame = on_frame
        self._senders: dict[tuple[str, str], Sender] = {}
        self._put_ns: dict[FrameId, int] = {}
        self._under_way: dict[FrameId, None] = {}
        self._progress = time.monotonic()
        self._in_force = SessionParameters()
        self._first_id = 1
        self._results: dict[FrameId, Tracks] = {}
        self._latencies: list[int] = []
        self._problems: collections.deque[Problem] = collections.deque(maxlen=KEPT_PROBLEMS)
        self._problem_count = 0
        self._inbox = Subscriber(
            self._stream, connection=connection, on_problem=self._note, queue=4 * len(one.frames) + 64, prefix=prefix
        )

    def __enter__(self) -> Self:
        wanted = SessionParameters(profile=self._profile, cloud_wait_s=CLOUD_WAIT_S)
        self._in_force = set_parameters(
            self._connection, self._stream, wanted, prefix=self._prefix, patience_s=self._pace.service_s
        )
        state = session_state(self._connection, self._stream, prefix=self._prefix)
        self._first_id = max(1, state.next_id) if state else 1
        return self

    def __exit__(self, *_: object) -> None:
        close_session(self._connection, self._stream, prefix=self._prefix)
        self._inbox.close()
        for sender in self._senders.values():
            sender.close()

    def send(self, step: Step) -> None:
        """Publish a frame, its cloud first."""
        detections = renamed(step.detections, self._stream)
        if step.cloud is not None:
            cloud = renamed(step.cloud, self._stream)
            self._sender(cloud).put(cloud.payload)
        sender = self._sender(detections)
        if step.frame is not None:
            self._put_ns[step.frame] = time.monotonic_ns()
            if not self._under_way:
                self._progress = time.monotonic()
            if step.frame in self._plan.tracks or not self._plan.tracks:  # others gave none when it was recorded
                self._under_way[step.frame] = None
        sender.put(detections.payload)

    def take_until(self, due: float) -> None:
        """Take in tracks until the monotonic time `due`."""
        while self._take(0.0):
            pass
        while (left := due - time.monotonic()) > 0.0:
            self._take(min(left, TICK_S))

    def take_until_room(self) -> None:
        """Take in tracks until less than a window of frames is under way; frames without an answer are given up."""
        while len(self._under_way) >= self._pace.window:
            if time.monotonic() - self._progress > self._pace.patience_s:
                self._under_way.clear()
            self._take(TICK_S)

    def drain(self) -> None:
        """Take in tracks until every frame has come back, with the corrections that it had, or no more will come."""
        while not self._complete():
            overtaken = not self._under_way or max(self._put_ns, key=self._put_ns.__getitem__) in self._results
            if time.monotonic() - self._progress > (STRAGGLERS_S if overtaken else self._pace.patience_s):
                return
            self._take(TICK_S)

    def result(self) -> PlayedStream:
        """Return what came of it."""
        one = self._plan
        known = [frame for frame in one.frames if frame in one.tracks]
        differs = [frame for frame in known if not self._same(frame)]
        return PlayedStream(
            name=one.stream,
            stream=self._stream,
            profile=self._profile,
            other_values=None if one.parameters is None else one.parameters.values != self._in_force.values,
            frames=len(one.frames),
            returned=len(self._results),
            clouds=len(one.with_cloud),
            clouds_lost=one.clouds_lost,
            recorded=len(known),
            equal=len(known) - len(differs),
            first_difference=differs[0][1] if differs else None,
            begins_late=one.begins_late,
            never_tracked=one.never_tracked,
            first_id=self._first_id,
            tracks=self._results,
            latency=latency(self._latencies),
            problems=self._problem_count,
            newest_problems=tuple(self._problems),
        )

    def _complete(self) -> bool:
        recorded = self._plan.tracks
        return not self._under_way and all(
            frame in self._results and self._results[frame].revision >= recorded[frame].revision
            for frame in self._plan.frames
            if frame in recorded
        )

    def _same(self, frame: FrameId) -> bool:
        return frame in self._results and content(self._results[frame]) == content(self._plan.tracks[frame])

    def _take(self, timeout: float) -> bool:
        received = self._inbox.receive(timeout)
        if received is None:
            return False
        frame = (received.tracks.epoch, received.tracks.seq)
        if frame not in self._put_ns:
            return True  # not of this run
        if frame not in self._results:
            self._latencies.append(received.monotonic_ns - self._put_ns[frame])
            self._on_frame()
        self._results[frame] = received.tracks
        self._under_way.pop(frame, None)
        self._progress = time.monotonic()
        return True

    def _sender(self, message: Recorded) -> Sender:
        """Return the publisher for a message; that of clouds once somebody wants them."""
        kind = (message.topic, message.encoding)
        if kind not in self._senders:
            if message.topic == "points":
                sender = self._connection.plain_sender(self._keys.points(self._stream), message.encoding)
                deadline = time.monotonic() + POINTS_WANTED_S
                while not sender.wanted and time.monotonic() < deadline:
                    time.sleep(0.01)  # it comes with the network's own messages; there is nothing to wait on
            else:
                cache = len(self._plan.frames)  # the service may lose its link, or restart, anywhere
                sender = self._connection.cached_sender(
                    self._keys.detections(self._stream), message.encoding, cache=cache
                )
            self._senders[kind] = sender
        return self._senders[kind]

    def _note(self, problem: Problem) -> None:
        self._problems.append(problem)
        self._problem_count += problem.count
