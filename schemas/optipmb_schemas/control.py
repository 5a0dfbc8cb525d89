"""Messages about sessions and the service: parameters, resets, states and problems."""

from typing import Literal

from pydantic import Field

from optipmb_schemas.errors import MessageError
from optipmb_schemas.fields import (
    MAX_TEXT,
    Count,
    Epoch,
    Flag,
    Horizons,
    Name,
    NonNegative,
    Plain,
    SessionId,
    Stamp,
    Stream,
    Text,
    Word,
)
from optipmb_schemas.model import Message


class SessionParameters(Message):
    """Query `q/parameters`. Without a payload it asks; with one it sets what is present. The reply has all fields."""

    profile: Name | None = Field(default=None, description="Name of a profile of the service, such as `nuscenes`.")
    cloud_wait_s: NonNegative | None = Field(
        default=None, description="Longest time in seconds that detections wait for the cloud of the same stamp."
    )
    horizons: Horizons | None = Field(
        default=None,
        description="Times ahead of predicted paths, s, ascending; none: no paths. They may change at any time; a "
        "profile that is set brings its own.",
    )
    restart: Flag = Field(
        default=False,
        description="Restart the session when the parameters change; without it a running session refuses a change.",
    )
    values: Plain | None = Field(default=None, description="In replies: all parameters in force. Ignored in queries.")


class ResetRequest(Message):
    """Query `q/reset`, with or without a payload. The session starts anew without tracks. No track id is used again."""

    close: Flag = Field(default=False, description="End the session and free it instead of starting it anew.")


class TracksRequest(Message):
    """Query `q/tracks`, with or without a payload: tracks of a stream in a range of stamps, as far as they are kept.

    Each reply is a `Tracks` message as it was published: of each frame the one that holds, by stamp. The last reply
    repeats the request: all has come. Where there are more than one answer takes, a `Problem` with the code `cut` comes
    instead, and its `stamp_ns` is where the rest begins.
    """

    from_ns: Stamp = Field(default=0, description="First stamp, of the sensor's clock.")
    to_ns: Stamp | None = Field(default=None, description="Last stamp; absent: up to the newest frame.")


class MoveRequest(Message):
    """Query `service/<instance>/q/move`: move a stream to a worker of this instance, from wherever it is.

    The reply repeats it when it is done. All streams of its partition go with it, and stay until they are moved again.
    A stream may be moved before its first message.
    """

    stream: Stream = Field(description="Name of the stream.")
    worker: Count = Field(description="Number of the worker process, from 0; 0 for an instance without.")


class DrainRequest(Message):
    """Query `service/<instance>/q/drain`: give all streams to other members. The reply repeats it when that is done.

    With workers, all of them do so. A member that drains takes no streams until it ends or is told otherwise.
    """

    drain: Flag = Field(default=True, description="False: take a share of the streams again.")


class SessionState(Message):
    """Reply of `q/state` and `q/reset`: the state of one session.

    Counters go on through restarts and resets, and end with the session (`closed`).
    """

    stream: Stream = Field(description="Name of the stream.")
    session: SessionId = Field(description="32 hexadecimal digits, as in the tracks.")
    state: Literal["new", "running", "recovering", "quarantined", "closed"] = Field(
        description="New: no frame yet. Recovering: after a restart, missed frames may still come. Quarantined: "
        "tracking failed, frames are refused until a reset or another start of the publisher."
    )
    profile: Name = Field(description="Name of the parameters in force.")
    epoch: Epoch | None = Field(default=None, description="Epoch of the newest frame.")
    seq: Count | None = Field(default=None, description="Number of the newest frame.")
    stamp_ns: Stamp | None = Field(default=None, description="Stamp of the newest frame.")
    received: Count = Field(
        default=0,
        description="Detections messages that arrived: the sum of `frames`, `duplicates`, `late`, `refused`, `shed` "
        "and `queue`.",
    )
    frames: Count = Field(default=0, description="Frames tracked.")
    duplicates: Count = Field(default=0, description="Frames that had been tracked before and were dropped.")
    late: Count = Field(default=0, description="Frames that came too late and were dropped.")
    inserted: Count = Field(default=0, description="Late frames and clouds that were put in their place.")
    corrected: Count = Field(default=0, description="Tracks that were published anew because of these.")
    refused: Count = Field(default=0, description="Detections messages that were not valid, or could not be tracked.")
    shed: Count = Field(default=0, description="Frames dropped because the queue was full.")
    gaps: Count = Field(default=0, description="Frames missing.")
    new_epochs: Count = Field(default=0, description="How often the publisher started anew or its stamps jumped.")
    clouds_used: Count = Field(default=0, description="Frames tracked with their cloud.")
    clouds_missed: Count = Field(default=0, description="Frames that waited for a cloud in vain.")
    repaired: Count = Field(default=0, description="Covariances that had lost rank in rounding and were repaired.")
    clouds_refused: Count = Field(default=0, description="Points messages that were not valid.")
    tracks: Count = Field(default=0, description="Tracks extracted at the newest frame.")
    bernoullis: Count = Field(default=0, description="Bernoulli components now.")
    poissons: Count = Field(default=0, description="Poisson components now.")
    next_id: Count = Field(default=0, description="Lower bound of the next new track id.")
    queue: Count = Field(default=0, description="Frames waiting now.")
    digest: Text = Field(
        default="",
        description="32 hexadecimal digits over everything that later tracks depend on. Empty: without a session.",
    )


class Problem(Message):
    """What was refused or lost, why, and where. Texts are cut to their limits."""

    stream: Text = Field(description="Name of the stream; empty when the problem belongs to none.")
    instance: Name = Field(description="Name of the service instance that reports.")
    code: Word = Field(description="Kind of the problem, for programs. More may be added.")
    path: Text = Field(default="", description="Field and element at fault, as `score[3]`; empty: the whole message.")
    expected: Text = Field(default="", description="What was expected there.")
    received: Text = Field(default="", description="What was received, cut to a short printable text.")
    message: Text = Field(description="One sentence for people.")
    seq: Count | None = Field(default=None, description="Number of the frame, when known.")
    stamp_ns: Stamp | None = Field(default=None, description="Stamp of the frame, when known.")
    count: Count = Field(default=1, description="How many equal problems this one stands for.")
    reported_ns: Stamp | None = Field(default=None, description="When it was reported, ns since 1970 UTC.")

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
    latency_p50_ms: NonNegative = Field(default=0.0, description="Median time from arrival to publication, ms.")
    latency_p99_ms: NonNegative = Field(default=0.0, description="99th percentile of the same, ms.")
    frames: Count = Field(default=0, description="Frames tracked.")
    refused: Count = Field(default=0, description="Messages that were not valid.")
    shed: Count = Field(default=0, description="Frames dropped because the queue was full.")
    gaps: Count = Field(default=0, description="Frames missing.")
    tracks: Count = Field(default=0, description="Tracks extracted at the newest frame.")
    queue: Count = Field(default=0, description="Frames waiting now.")
    age_s: NonNegative | None = Field(default=None, description="Seconds since the last frame arrived.")
    worker: Count | None = Field(
        default=None, description="Number of the worker process that has the stream, where there are several."
    )
    sensors: tuple[Stream, ...] = Field(
        default=(), max_length=256, description="Streams that share the session; none where it is that of one stream."
    )
    silent: tuple[Stream, ...] = Field(
        default=(), max_length=256, description="Those of them that have sent no frame lately."
    )


class MemberSummary(Message):
    """A member: one run of a process that tracks, with the leases of partitions that it holds."""

    member: Text = Field(description="Name of the instance, `/`, and eight hexadecimal digits that no other run has.")
    state: Word = Field(description="`alive`, or `draining`: it gives its partitions up and takes none.")
    age_s: NonNegative = Field(description="Age of its lease: seconds since its last renewal was seen.")
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
    standby: Count = Field(
        default=0, description="Streams that another instance tracks and this one is ready to take over."
    )
    members: tuple[MemberSummary, ...] = Field(
        default=(),
        max_length=4096,
        fail_fast=True,
        description="The living members that share streams with this instance, itself among them.",
    )
    received: Count = Field(
        default=0,
        description="Detections messages since the start: the sum of `frames`, `duplicates`, `late`, `refused`, "
        "`shed`, and those that wait.",
    )
    frames: Count = Field(default=0, description="Frames tracked since the start.")
    duplicates: Count = Field(default=0, description="Frames dropped since the start because they had been tracked.")
    late: Count = Field(default=0, description="Frames that came too late since the start.")
    refused: Count = Field(default=0, description="Detections messages refused since the start.")
    shed: Count = Field(default=0, description="Frames dropped since the start because a queue was full.")
    clouds_refused: Count = Field(default=0, description="Points messages refused since the start.")
    problems: tuple[Problem, ...] = Field(
        default=(), max_length=100, fail_fast=True, description="The newest problems, the oldest first."
    )
