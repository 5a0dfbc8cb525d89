"""Playing a recording into a service: the same messages, epochs, numbers and stamps; the tracks come out the same.

One thread publishes the frames of all streams in the order in which they were received, at the recorded pace or as fast
as tracks come back, and receives the tracks. They are compared with the recorded ones.
"""

import contextlib
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Self

from optipmb_client.errors import UsageError
from optipmb_client.sessions import close_session, session_state, set_parameters
from optipmb_client.zenoh import Connection
from optipmb_client.zenoh.handles import Sender
from optipmb_schemas import PREFIX, Keys, Problem, SessionParameters, Tracks

from optipmb_tools.recordings.plan import FrameId, Step, StreamPlan, content, plan, renamed, steps
from optipmb_tools.recordings.recording_file import Recorded, RecordingFile
from optipmb_tools.results.output import Latency, latency
from optipmb_tools.run.replay import CLOUD_WAIT_S, Exchange, ReplayPace, await_wanted


@dataclass(frozen=True)
class PlayedStream:
    """Result of playing one stream."""

    name: str  # in the recording
    stream: str  # that it was played as
    profile: str  # in force
    other_values: bool | None  # than when it was recorded has the profile; None: the recording does not tell
    frames: int
    returned: int  # frames whose tracks came back
    clouds: int  # frames that were played with a cloud
    clouds_lost: int  # frames whose recorded tracks were made with a cloud that the recording lacks
    recorded: int  # frames whose tracks are in the recording
    equal: int  # of these, came back with the same bytes, but for session, delivery and stream's name
    first_difference: int | None  # number of the first of them that did not
    begins_late: bool  # in the middle of a session
    never_tracked: int  # frames without recorded tracks between others that have some
    first_id: int  # above 1 the service had tracked a stream of this name before
    tracks: dict[FrameId, Tracks]  # newest
    latency: Latency | None  # from publishing to receiving
    problems: int
    newest_problems: tuple[Problem, ...]


@dataclass(frozen=True)
class Playing:
    """How a recording is played."""

    pace: ReplayPace
    site: str | None  # streams are played as `<site>-<their site>/...` and meet no session; None: as recorded
    profile: str | None = None  # default: the recorded one
    prefix: str = PREFIX  # first part of all keys
    on_frame: Callable[[], None] = lambda: None  # called when the tracks of a frame have come back


def choose(recording: Iterable[Recorded], streams: Iterable[str] = ()) -> dict[str, StreamPlan]:
    """Return the plans of the chosen streams; of all when none is named.

    Raises:
        UsageError: The recording does not hold one of them, or nothing at all.
    """
    plans = plan(recording)
    for name in streams:
        if name not in plans:
            raise UsageError(f"--streams: the recording has no detections of {name!r}, but of {', '.join(plans)}")
    if not plans:
        raise UsageError("the recording holds no detections")
    return {name: plans[name] for name in (tuple(streams) or plans)}


def play(
    connection: Connection, recording: RecordingFile, plans: dict[str, StreamPlan], how: Playing
) -> list[PlayedStream]:
    """Play the streams of `plans`.

    Raises:
        ServiceUnavailable: No service answers.
        ServiceRefused: It does not know the profile, or takes no more streams.
        UsageError: The recording does not say which profile was in force, and none is given.
    """
    with contextlib.ExitStack() as stack:
        players = {name: stack.enter_context(_Player(connection, one, how)) for name, one in plans.items()}
        zero: float | None = None
        for step in steps(recording, plans):
            player = players[step.detections.stream]
            if how.pace.speed is not None:
                after = step.detections.received_ns / 1e9 / how.pace.speed
                zero = time.monotonic() - after if zero is None else zero
                player.exchange.until(zero + after)
            elif not player.exchange.until_room(how.pace.window):
                player.exchange.give_up()
            player.send(step)
        for player in players.values():
            player.exchange.drain(player.complete)
        return [player.result() for player in players.values()]


class _Player:
    """One stream on its way through the service."""

    def __init__(self, connection: Connection, one: StreamPlan, how: Playing) -> None:
        recorded = one.parameters.profile if one.parameters else None
        newest = next((tracks.profile for tracks in one.tracks.values()), None)
        self._profile = how.profile or recorded or newest or ""
        if not self._profile:
            recorded = f"the recording does not say which was in force on {one.stream}"
            raise UsageError(f"--profile: expected a profile, for {recorded}")
        self._plan = one
        self._how = how
        self._connection = connection
        self._keys = Keys(how.prefix)
        self._stream = one.stream if how.site is None else f"{how.site}-{one.stream}"
        self._senders: dict[tuple[str, str], Sender] = {}
        self.exchange = Exchange(
            self._stream, connection, len(one.frames), pace=how.pace, prefix=how.prefix, on_frame=how.on_frame
        )

    def __enter__(self) -> Self:
        wanted = SessionParameters(profile=self._profile, cloud_wait_s=CLOUD_WAIT_S)
        prefix, patience_s = self._how.prefix, self._how.pace.service_s
        self._in_force = set_parameters(self._connection, self._stream, wanted, prefix=prefix, patience_s=patience_s)
        state = session_state(self._connection, self._stream, prefix=prefix)
        self._first_id = max(1, state.next_id) if state else 1
        return self

    def __exit__(self, *_: object) -> None:
        close_session(self._connection, self._stream, prefix=self._how.prefix)
        self.exchange.subscriber.close()
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
            awaited = step.frame in self._plan.tracks or not self._plan.tracks  # others had none when it was recorded
            self.exchange.sent(step.frame, time.monotonic_ns(), awaited=awaited)
        sender.put(detections.payload)

    def complete(self) -> bool:
        """Whether every frame has come back that gave tracks when it was recorded, with the corrections that it had."""
        recorded, results = self._plan.tracks, self.exchange.results
        wanted = [frame for frame in self._plan.frames if frame in recorded or not recorded]
        return all(
            frame in results and (not recorded or results[frame].revision >= recorded[frame].revision)
            for frame in wanted
        )

    def result(self) -> PlayedStream:
        """Return the result."""
        one, results = self._plan, self.exchange.results
        known = [frame for frame in one.frames if frame in one.tracks]
        differs = [
            frame for frame in known if frame not in results or content(results[frame]) != content(one.tracks[frame])
        ]
        return PlayedStream(
            name=one.stream,
            stream=self._stream,
            profile=self._profile,
            other_values=None if one.parameters is None else one.parameters.values != self._in_force.values,
            frames=len(one.frames),
            returned=len(results),
            clouds=len(one.with_cloud),
            clouds_lost=one.clouds_lost,
            recorded=len(known),
            equal=len(known) - len(differs),
            first_difference=differs[0][1] if differs else None,
            begins_late=one.begins_late,
            never_tracked=one.never_tracked,
            first_id=self._first_id,
            tracks=results,
            latency=latency(self.exchange.latencies),
            problems=self.exchange.problem_count,
            newest_problems=tuple(self.exchange.problems),
        )

    def _sender(self, message: Recorded) -> Sender:
        """Return the publisher for a message; for clouds once somebody wants them."""
        kind = (message.topic, message.encoding)
        if kind not in self._senders:
            if message.topic == "points":
                sender = self._connection.plain_sender(self._keys.points(self._stream), message.encoding)
                await_wanted(lambda: sender.wanted)
            else:
                cache = len(self._plan.frames)  # the service may lose its link, or restart, anywhere
                key = self._keys.detections(self._stream)
                sender = self._connection.cached_sender(key, message.encoding, cache=cache)
            self._senders[kind] = sender
        return self._senders[kind]
