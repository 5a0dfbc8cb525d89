"""Messages about sessions and the service: parameters, resets, states and problems."""

from typing import Literal

from pydantic import Field

from optipmb_schemas.errors import MessageError
from optipmb_schemas.model import (
    MAX_TEXT,
    Count,
    Epoch,
    Flag,
    Horizons,
    Message,
    Name,
    NonNegative,
    Plain,
    SessionId,
    Stamp,
    Stream,
    Text,
    Word,
)


class SessionParameters(Message):
    """Query `q/parameters`. Without a payload it asks; with one it sets the fields given. The reply has all fields."""

    profile: Name | None = Field(default=None, description="Name of a profile of the service, such as `nuscenes`.")
    cloud_wait_s: NonNegative | None = Field(default=None, description="Longest wait of detections for their cloud, s.")
    horizons: Horizons | None = Field(
        default=None,
        description="Times ahead of predicted paths, s, ascending; none: no paths. A profile that is set brings "
        "its own.",
    )
    restart: Flag = Field(
        default=False,
        description="Restart the session for a change; without it a running session refuses one.",
    )
    values: Plain | None = Field(default=None, description="In replies: all parameters in force. Ignored in queries.")
    sensors: Plain | None = Field(
        default=None,
        description="In replies of a fused session with the setting `sensors`: what its sensors have of their own, by "
        "pattern. Ignored in queries.",
    )
    session: SessionId | None = Field(
        default=None,
        description="In replies: the session that has them, as in its tracks; absent where the stream has none. "
        "Ignored in queries.",
    )


class ResetRequest(Message):
    """Query `q/reset`, with or without a payload. The session restarts without tracks. No track id is used again."""

    close: Flag = Field(default=False, description="Free the session instead of restarting it.")


class TracksRequest(Message):
    """Query `q/tracks`, with or without a payload: tracks of a stream in a range of stamps, as far as they are kept.

    Each reply is a `Tracks` message as it was published: of each frame the one that holds, by stamp. The last reply
    repeats the request: all has come. Where there are more than one answer takes, a `Problem` with the code `cut` comes
    instead, and its `stamp_ns` is where the rest begins.
    """

    from_ns: Stamp = Field(default=0, description="First stamp, of the sensor's clock.")
    to_ns: Stamp | None = Field(default=None, description="Last stamp; absent: up to the newest frame.")


class MoveRequest(Message):
    """Query `service/<instance>/q/move`: move a stream to a worker of this instance, from any member.

    The reply repeats it when it is done. All streams of its partition go with it, and stay until they are moved again.
    A stream may be moved before its first message.
    """

    stream: Stream = Field(description="Name of the stream.")
    worker: Count = Field(description="Number of the worker process, from 0; 0 for an instance without.")


class DrainRequest(Message):
    """Query `service/<instance>/q/drain`: give all streams to other members. The reply repeats it when that is done.

    With workers, all of them do so. A member that drains takes no streams until it ends or another order comes.
    """

    drain: Flag = Field(default=True, description="False: take a share of the streams again.")


class SessionState(Message):
    """Reply of `q/state` and `q/reset`: the state of one session.

    Counters go on through restarts and resets, and end with the session (`closed`).
    """

    stream: Stream = Field(description="Name of the stream.")
    session: SessionId = Field(description="32 hexadecimal digits, as in the tracks.")
    state: Literal["new", "running", "recovering", "quarantined", "closed"] = Field(
        description="New: no frame yet. Recovering: missed frames may still come. Quarantined: tracking failed, frames "
        "are refused until a reset or a restart of the publisher."
    )
    profile: Name = Field(description="Name of the parameters in force.")
    epoch: Epoch | None = Field(default=None, description="Epoch of the newest frame.")
    seq: Count | None = Field(default=None, description="Number of the newest frame.")
    stamp_ns: Stamp | None = Field(default=None, description="Stamp of the newest frame.")
    received: Count = Field(
        default=0,
        description="Detections messages: the sum of `frames`, `duplicates`, `late`, `refused`, `shed` and `queue`.",
    )
    frames: Count = Field(default=0, description="Frames tracked.")
    duplicates: Count = Field(default=0, description="Frames that had been tracked before.")
    late: Count = Field(default=0, description="Frames that came too late.")
    inserted: Count = Field(default=0, description="Late frames and clouds put in their place.")
    corrected: Count = Field(default=0, description="Tracks published again for these.")
    refused: Count = Field(default=0, description="Detections messages not valid, or that could not be tracked.")
    shed: Count = Field(default=0, description="Frames dropped because the queue was full.")
    gaps: Count = Field(default=0, description="Frames missing.")
    new_epochs: Count = Field(default=0, description="Restarts of the publisher and jumps of its stamps.")
    clouds_used: Count = Field(default=0, description="Frames tracked with their cloud.")
    clouds_missed: Count = Field(default=0, description="Frames that waited for a cloud in vain.")
    repaired: Count = Field(default=0, description="Covariances repaired after a loss of rank by rounding.")
    clouds_refused: Count = Field(default=0, description="Points messages not valid, or that could not be taken.")
    rejoined: Count | None = Field(
        default=None,
        description="Tracks joined with an earlier one of the same object. Absent, as the next three: none.",
    )
    lost_dropped: Count | None = Field(default=None, description="Lost objects dropped because there were too many.")
    embedding_ignored: Count | None = Field(
        default=None,
        description="Frames whose embeddings were ignored: not of the `embedding_model` of the setting `rejoin`.",
    )
    lost_objects: Count | None = Field(default=None, description="Lost objects that may still be joined.")
    tracks: Count = Field(default=0, description="Confirmed tracks of the newest frame.")
    bernoullis: Count = Field(default=0, description="Bernoulli components now.")
    poissons: Count = Field(default=0, description="Poisson components now.")
    next_id: Count = Field(default=0, description="Lower bound of the next new track id.")
    queue: Count = Field(default=0, description="Frames waiting now.")
    digest: Text = Field(
        default="",
        description="32 hexadecimal digits over everything that later tracks depend on. Empty: without a session.",
    )


class Problem(Message):
    """A message refused or lost, the reason and the place. Texts are cut to their limits."""

    stream: Text = Field(description="Name of the stream; empty: none.")
    instance: Name = Field(description="Instance that reports.")
    code: Word = Field(description="Kind of the problem; more may be added.")
    path: Text = Field(default="", description="Field and element at fault, as `score[3]`; empty: the whole message.")
    expected: Text = Field(default="", description="What was expected there.")
    received: Text = Field(default="", description="What was received, in short.")
    message: Text = Field(description="One sentence for people.")
    seq: Count | None = Field(default=None, description="Number of the frame, when known.")
    stamp_ns: Stamp | None = Field(default=None, description="Stamp of the frame, when known.")
    count: Count = Field(default=1, description="Number of equal problems.")
    reported_ns: Stamp | None = Field(default=None, description="Time of the report, ns since 1970 UTC.")

    @classmethod
    def of(cls, error: MessageError, *, stream: str, instance: str) -> "Problem":
        """Return the problem that reports `error`, its texts cut to their limits."""
        return cls(
            stream=stream[:MAX_TEXT],
            instance=instance,
            code=error.code,
            path=error.path[:MAX_TEXT],
            expected=error.expected[:MAX_TEXT],
            received=error.received[:MAX_TEXT],
            message=str(error)[:MAX_TEXT],
        )


class SessionSummary(Message):
    """One line of the service's status."""

    stream: Stream = Field(description="Name of the stream.")
    profile: Name = Field(description="Name of the parameters in force.")
    state: Word = Field(description="State of the session, such as `running`.")
    rate_hz: NonNegative = Field(default=0.0, description="Frames per second in the last 5 s.")
    latency_p50_ms: NonNegative = Field(default=0.0, description="Median from arrival to publication, ms.")
    latency_p99_ms: NonNegative = Field(default=0.0, description="99th percentile of the same, ms.")
    frames: Count = Field(default=0, description="Frames tracked.")
    refused: Count = Field(default=0, description="Detections messages not valid, or that could not be tracked.")
    shed: Count = Field(default=0, description="Frames dropped because the queue was full.")
    gaps: Count = Field(default=0, description="Frames missing.")
    tracks: Count = Field(default=0, description="Confirmed tracks of the newest frame.")
    queue: Count = Field(default=0, description="Frames waiting now.")
    age_s: NonNegative | None = Field(default=None, description="Seconds since the last frame arrived.")
    worker: Count | None = Field(
        default=None, description="Number of the worker that has the stream, where there are several."
    )
    sensors: tuple[Stream, ...] = Field(
        default=(), max_length=256, description="Streams that share the session; none: it is that of one stream."
    )
    silent: tuple[Stream, ...] = Field(default=(), max_length=256, description="Those of them without a frame lately.")
    late: Count = Field(default=0, description="Frames that came too late.")
    duplicates: Count = Field(default=0, description="Frames that had been tracked before.")
    configured: Name | None = Field(
        default=None,
        description="Profile that the settings name, where the session runs with another one, or with other values.",
    )
    learned: tuple[Text, ...] = Field(
        default=(),
        max_length=256,
        description="Noise of the detections of each class that the session has learned, in words.",
    )
    rejoined: Count | None = Field(
        default=None,
        description="Tracks joined with an earlier one of the same object. Absent, as the next three: none.",
    )
    lost_objects: Count | None = Field(default=None, description="Lost objects that may still be joined.")
    lost_dropped: Count | None = Field(default=None, description="Lost objects dropped because there were too many.")
    embedding_ignored: Count | None = Field(default=None, description="Frames whose embeddings were ignored.")


class MemberSummary(Message):
    """A member: one run of a process that tracks, with the leases of partitions that it holds."""

    member: Text = Field(description="Name of the instance, `/`, and eight hexadecimal digits of this run.")
    state: Word = Field(description="`alive`; `draining` or `unlinked` (it has no router): it takes no partitions.")
    age_s: NonNegative = Field(description="Seconds since its last renewal.")
    partitions: tuple[Count, ...] = Field(
        default=(), max_length=4096, fail_fast=True, description="Partitions that it holds."
    )
    fences: tuple[Count, ...] = Field(
        default=(), max_length=4096, fail_fast=True, description="Fence of each of these leases."
    )


class ServiceStatus(Message):
    """Reply of `q/status`: the service instance, its sessions and its newest problems."""

    instance: Name = Field(description="Name of the service instance.")
    version: Word = Field(description="Version of the software.")
    started_ns: Stamp = Field(description="When the instance started, ns since 1970 UTC.")
    uptime_s: NonNegative = Field(description="Seconds since then.")
    state: Word = Field(description="State of the instance, such as `ready` or `degraded`.")
    sessions: tuple[SessionSummary, ...] = Field(
        default=(), max_length=10_000, fail_fast=True, description="The sessions of this instance."
    )
    standby: Count = Field(default=0, description="Streams that another instance tracks and this one may take over.")
    members: tuple[MemberSummary, ...] = Field(
        default=(),
        max_length=4096,
        fail_fast=True,
        description="Members that share streams with this instance, itself among them.",
    )
    received: Count = Field(
        default=0,
        description="Detections messages since the start, as all counters here: as in `SessionState`, over "
        "all sessions.",
    )
    frames: Count = Field(default=0, description="Frames tracked.")
    duplicates: Count = Field(default=0, description="Frames that had been tracked before.")
    late: Count = Field(default=0, description="Frames that came too late.")
    refused: Count = Field(default=0, description="Detections messages not valid, or that could not be tracked.")
    shed: Count = Field(default=0, description="Frames dropped because the queue was full.")
    clouds_refused: Count = Field(default=0, description="Points messages not valid, or that could not be taken.")
    problems: tuple[Problem, ...] = Field(
        default=(), max_length=100, fail_fast=True, description="The newest problems, the oldest first."
    )
